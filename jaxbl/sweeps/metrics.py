"""Metrics of a run, computed in the loop over time: observation errors, convergence, gain margins, identification.

A metric is a class: its column, unit, label and meaning, and how it is computed. :meth:`Metric.of` makes metrics that
differ from others only in a signal or a formula. Other packages add subclasses of :class:`RunMetric` or :class:`GainMetric`
through the entry-point group `jaxbl.metrics`; the entry's name is the metric's. RMS values are over the last quarter of the
run, in SI units. Position and velocity tolerances of the load are those of the motor divided by the gear ratio.
"""

import abc
import functools
from collections.abc import Callable, Iterable, Mapping
from operator import attrgetter
from typing import Any, ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxbl.chain import Experiment, NamedArrays, Number, Reducer, Signals, State, TracedArrays, TrueSide
from jaxbl.drive.transmission import TRANSMISSIONS
from jaxbl.errors import InputError
from jaxbl.observer import AbstractSuperTwisting, conditions
from jaxbl.registry import Registry, check_subclass, check_text
from jaxbl.validation import suggest_word

from .elementwise import apply_elementwise


class Metric(abc.ABC):
    """A column of each side: `<side>.<name>`."""

    name: ClassVar[str]
    unit: ClassVar[str] = ""
    label: ClassVar[str]
    """Short name for axes of figures; `doc` has the meaning."""
    doc: ClassVar[str]
    better: ClassVar[str] = ""
    """The better one of two values: `less` or `more`; empty if neither is."""
    closed_loop: ClassVar[bool] = False
    """True if only experiments with a controller have it."""

    @classmethod
    def of(cls, name: str, unit: str, label: str, doc: str, **options: Any) -> type[Self]:
        """Make a metric of this kind; `options` are the attributes that the kind leaves open (`signal` of an rms or peak,
        `factor` of a peak, `judge` of gains)."""
        metric: Any = type(name, (cls,), {"name": name, "unit": unit, "label": label, "doc": doc, **options})
        return metric

    def applies(self, experiment: Experiment) -> bool:
        """True if an experiment has this metric."""
        return experiment.controller is not None or not self.closed_loop


def _check_metric(name: str, metric: Any) -> None:
    base = GainMetric if isinstance(metric, type) and issubclass(metric, GainMetric) else RunMetric
    check_subclass(name, metric, base)
    for attribute in ("unit", "label", "doc"):
        check_text(attribute, getattr(metric, attribute, None))


class _Metrics(Registry):
    """Metrics by name, with errors of identified parameters that transmission laws of other packages add."""

    def _load_all(self) -> dict[str, Any]:
        members = super()._load_all()
        for law in TRANSMISSIONS.values():
            for name, parameter in law.errors.items():
                if name not in members:
                    doc = f"relative error of the identified {parameter}"
                    members[name] = IdentificationError.of(name, "", f"error of {parameter}", doc)
        return members


SIDE_METRICS = _Metrics("jaxbl.metrics", _check_metric)
"""The metrics of each side by name, in the order of the columns."""


class SideSample(NamedTuple):
    """Signals of a side at one sample, as a metric gets them, in SI units; errors are true values minus estimates."""

    time: Number
    inside: Number
    """1 in the last quarter of the run, else 0."""
    within: Array
    """True if position and velocity errors are within tolerance."""
    true: TrueSide
    position_error: Number
    velocity_error: Number
    torque_error: Number
    following_error: Number = 0.0
    """Reference, in the side's units, minus true position, rad; 0 without a controller."""
    driving_torque: Number = 0.0
    """Torque that drives the side: the input on the motor, N_0 times the transmitted torque on the load, N m."""
    before: Number = 0.0
    """1 in the quarter before the last one, else 0."""
    settled: Number = True
    """True if the following error is within tolerance."""
    period: Number = 0.0
    """Sampling period, s."""
    twist: Number = 0.0
    """Twist of the gear, rad on the motor side."""
    twist_rate: Number = 0.0
    """Its rate, rad/s."""
    half_gap: Number = 0.0
    """Half of the free play, rad on the motor side."""


class SideEnd(NamedTuple):
    """A side at the end of the run, as a metric gets it."""

    experiment: Experiment
    state: State
    start: Any
    """Time of the first sample of the last quarter, s."""
    count: int
    """Number of samples of the last quarter."""
    identified: Mapping[str, Number]
    """Identified parameters of the transmission; none without an identifier."""


class RunMetric(Metric):
    """A metric with a state that each sample updates; metrics with the same `carry` share the state of the first of them."""

    carry: ClassVar[str | None] = None

    def init(self, zero: Number) -> Any:
        """The state before the first sample, made of `zero`, which has the run's precision."""
        return ()

    def update(self, carry: Any, sample: SideSample) -> Any:
        """The state after a sample."""
        return carry

    def is_final(self, carry: Any, experiment: Experiment, start: Number) -> Array | None:
        """True if no further sample can change the result, by the state so far; None if this cannot be told.

        `start` is the time of the first sample of the last quarter, s. A lane may stop once all its metrics are final.
        """
        return None

    @abc.abstractmethod
    def result(self, carry: Any, end: SideEnd) -> Array:
        """The metric, from the state after the last sample."""


class ObserverGains(NamedTuple):
    """Gains of an observer and its errors at t = 0, for the gain conditions."""

    lambda_: Array
    alpha: Array
    position_error: Array
    velocity_error: Array


class GainMetric(Metric):
    """A metric that follows from a super-twisting observer's gains and f_plus alone.

    It is computed after the loop over time, by a program that all studies share.
    """

    def applies(self, experiment):
        return bool(observer_gains(experiment))

    @abc.abstractmethod
    def judge(self, gains: ObserverGains, f_plus: Array) -> Array:
        """The metric of many lanes; all arrays have one shape."""


class SignalMetric(RunMetric):
    """A metric of one signal; its state is a number that begins at zero."""

    @abc.abstractmethod
    def signal(self, sample: SideSample) -> Number:
        """The signal at one sample."""

    def init(self, zero):
        return zero


class Rms(SignalMetric):
    """Root mean square of a signal over the last quarter."""

    def update(self, carry, sample):
        return carry + sample.inside * self.signal(sample) * self.signal(sample)

    def result(self, carry, end):
        return jnp.sqrt(carry / end.count)


class Peak(SignalMetric):
    """Largest absolute value of a signal along the run, times a factor."""

    factor: ClassVar[float] = 1.0

    def update(self, carry, sample):
        return jnp.maximum(carry, jnp.abs(self.signal(sample)))

    def result(self, carry, end):
        return self.factor * carry


class IdentificationError(RunMetric):
    """Relative error of an identified parameter that the law reports (`AbstractTransmission.errors`)."""

    better = "less"

    def applies(self, experiment):
        return experiment.identifier is not None and self.name in getattr(experiment.transmission, "errors", ())

    def result(self, carry, end):
        assert end.experiment.transmission is not None
        parameter = end.experiment.transmission.errors[self.name]
        return end.identified[parameter] / end.experiment.transmission.truth()[parameter] - 1.0


class Converged(RunMetric):
    """Convergence; the state is the last time at which an error was out of tolerance, or -1."""

    name = "converged"
    label = "converged"
    doc = "position and velocity errors stay within tolerance over the last quarter"
    better = "more"
    carry = "last_outside"

    def init(self, zero):
        return zero - 1.0

    def update(self, carry, sample):
        return jnp.where(sample.within, carry, sample.time)

    def is_final(self, carry, experiment, start):
        return carry >= start - 0.5 * experiment.run.sample_period

    def result(self, carry, end):
        return carry < end.start - 0.5 * end.experiment.run.sample_period


class ConvergenceTime(Converged):
    """Convergence time; it shares the state of :class:`Converged`."""

    name = "convergence_time"
    unit = "s"
    label = "convergence time"
    doc = "time from which both errors stay within tolerance; NaN where not converged"
    better = "less"

    def result(self, carry, end):
        entered = jnp.where(carry < 0.0, 0.0, carry + end.experiment.run.sample_period)
        return jnp.where(super().result(carry, end), entered, jnp.nan)


class Chatter(RunMetric):
    """Chatter of the velocity; the state is the sum of squares, and the velocity error of the last sample."""

    name = "chatter"
    unit = "rad/s"
    label = "chatter of the velocity"
    doc = "rms sample-to-sample change of the velocity error, divided by √2"
    better = "less"

    def init(self, zero):
        return zero, zero

    def update(self, carry, sample):
        total, previous = carry
        change = sample.velocity_error - previous
        return total + sample.inside * change * change, sample.velocity_error

    def result(self, carry, end):
        return jnp.sqrt(0.5 * carry[0] / end.count)


class Excitation(RunMetric):
    """Smallest eigenvalue of the identifier's information: small if the input cannot separate the parameters of the law."""

    name = "excitation"
    label = "excitation"
    doc = "smallest eigenvalue of the normalised information matrix"

    def applies(self, experiment):
        return experiment.identifier is not None and experiment.transmission is not None

    def result(self, carry, end):
        assert end.experiment.identifier is not None and end.state.identifier is not None
        return end.experiment.identifier.excitation(end.state.identifier)


class SettlingTime(ConvergenceTime):
    """Time after which the following error stays within tolerance."""

    name = "settling_time"
    label = "settling time"
    doc = "time from which the following error stays within the position tolerance; NaN where it does not"
    carry = "last_unsettled"
    closed_loop = True

    def update(self, carry, sample):
        return jnp.where(sample.settled, carry, sample.time)


class TorqueReversals(RunMetric):
    """Reversals of the driving torque; the state is their number and the last torque."""

    name = "torque_reversals"
    unit = "Hz"
    label = "torque reversals"
    doc = "sign changes of the driving torque (motor: the input; load: through the gear) a second, in the last quarter"
    better = "less"
    closed_loop = True

    def init(self, zero):
        return zero, zero

    def update(self, carry, sample):
        count, last = carry
        torque = jnp.where(sample.driving_torque == 0.0, last, sample.driving_torque)
        return count + sample.inside * (last * torque < 0.0), torque

    def result(self, carry, end):
        return carry[0] / (end.count * end.experiment.run.sample_period)


class ImpactRate(RunMetric):
    """Closings of the gap; the state is their number, the largest speed, and the last twist with its derivatives."""

    name = "impact_rate"
    unit = "Hz"
    label = "gear impacts"
    doc = "closings of the gap a second, in the last quarter"
    better = "less"
    carry = "impacts"
    closed_loop = True

    def applies(self, experiment):
        return super().applies(experiment) and experiment.transmission is not None

    def init(self, zero):
        return (zero,) * 5

    def update(self, carry, sample):
        count, largest, twist, rate, acceleration = carry
        was_free, is_free = jnp.abs(twist) < sample.half_gap, jnp.abs(sample.twist) < sample.half_gap
        closes = (was_free | (twist * sample.twist < 0.0)) & ~is_free & (sample.half_gap > 0.0)
        # free flight goes on up to the face; at the sample after, the contact has braked it
        path = jnp.maximum(sample.half_gap - jnp.sign(rate) * twist, 0.0)
        flight = jnp.minimum(path / jnp.maximum(jnp.abs(rate), 1e-12), sample.period)
        mean = jnp.abs(rate + 0.5 * acceleration * flight)
        flight = jnp.minimum(path / jnp.maximum(mean, 1e-12), sample.period)
        speed = jnp.abs(rate + acceleration * flight)
        largest = jnp.where(closes, jnp.maximum(largest, speed), largest)
        acceleration = jnp.where(was_free & is_free, (sample.twist_rate - rate) / sample.period, 0.0)
        return count + sample.inside * closes, largest, sample.twist, sample.twist_rate, acceleration

    def result(self, carry, end):
        return carry[0] / (end.count * end.experiment.run.sample_period)


class ImpactSpeed(ImpactRate):
    """Speed of the hardest closing of the gap."""

    name = "impact_speed"
    unit = "rad/s"
    label = "gear impacts, speed"
    doc = "largest relative speed of the faces as the gap closes, along the run, on the motor side"

    def result(self, carry, end):
        return carry[1]


class LimitCycle(NamedTuple):
    """State of the limit cycle's metrics.

    Attributes:
        low, high: least and largest following error, rad, of the quarter before the last.
        lowest, highest: the same of the last quarter.
        armed: 1 if the error has been a quarter of the amplitude below the middle since it last crossed that upward.
        last_error: of the sample before, rad.
        first, last, count: first and last time of an upward crossing in the last quarter, s, and their number.
    """

    low: Number
    high: Number
    lowest: Number
    highest: Number
    armed: Number
    last_error: Number
    first: Number
    last: Number
    count: Number


class LimitCycleAmplitude(RunMetric):
    """Half of the peak-to-peak following error in the last quarter; the state is a :class:`LimitCycle`."""

    name = "limit_cycle_amplitude"
    unit = "rad"
    label = "limit cycle, amplitude"
    doc = "half of the following error's range in the last quarter"
    better = "less"
    carry = "limit_cycle"
    closed_loop = True

    def init(self, zero):
        return LimitCycle(*[zero + jnp.inf, zero - jnp.inf] * 2, *[zero] * 5)

    def update(self, carry, sample):
        error, before, inside = sample.following_error, sample.before > 0.0, sample.inside > 0.0
        middle, quarter = 0.5 * (carry.low + carry.high), 0.125 * (carry.high - carry.low)
        crosses = inside & (carry.armed > 0.0) & (carry.last_error <= middle) & (error > middle)
        rise = jnp.where(crosses, error - carry.last_error, 1.0)
        time = sample.time - sample.period * jnp.where(crosses, (error - middle) / rise, 0.0)
        return LimitCycle(
            jnp.where(before, jnp.minimum(carry.low, error), carry.low),
            jnp.where(before, jnp.maximum(carry.high, error), carry.high),
            jnp.where(inside, jnp.minimum(carry.lowest, error), carry.lowest),
            jnp.where(inside, jnp.maximum(carry.highest, error), carry.highest),
            jnp.where(crosses, 0.0, jnp.where(inside & (error < middle - quarter), 1.0, carry.armed)),
            error,
            jnp.where(crosses & (carry.count == 0.0), time, carry.first),
            jnp.where(crosses, time, carry.last),
            carry.count + jnp.where(crosses, 1.0, 0.0),
        )

    def result(self, carry, end):
        return 0.5 * (carry.highest - carry.lowest)


class LimitCycleFrequency(LimitCycleAmplitude):
    """Frequency at which the following error crosses its middle upward."""

    name = "limit_cycle_frequency"
    unit = "Hz"
    label = "limit cycle, frequency"
    doc = "frequency of the following error in the last quarter; 0 with less than two cycles there"
    better = ""

    def result(self, carry, end):
        cycles = carry.count - 1.0
        return jnp.where(cycles > 0.0, cycles / jnp.where(cycles > 0.0, carry.last - carry.first, 1.0), 0.0)


def _convergence_time(formula: Callable[..., Array]) -> Callable[[GainMetric, ObserverGains, Array], Array]:
    """Make the method `judge` of a convergence time from its formula in gains, f_plus and initial errors."""
    return lambda _, gains, f_plus: formula(gains.lambda_, gains.alpha, f_plus, gains.position_error, gains.velocity_error)


def _make_margin(name: str, condition: conditions.Condition) -> type[GainMetric]:
    label, doc = f"margin to {condition.title}", f"λ over the least λ of {condition.title}"
    return GainMetric.of(
        f"margin_{name}", "", label, doc,
        judge=lambda _, gains, f_plus: gains.lambda_ / condition.least_lambda(gains.alpha, f_plus),
    )  # fmt: skip


for _metric in (
    Converged,
    ConvergenceTime,
    GainMetric.of(
        "convergence_time_bound", "s", "bound on convergence time",
        "bound (42) on it for the noise-free observer; inf where (32) fails",
        judge=_convergence_time(conditions.convergence_time_bound),
    ),
    GainMetric.of(
        "convergence_time_worst", "s", "worst convergence time",
        "longest convergence time that a disturbance within f_plus can cause; inf where ρ ≥ 1",
        judge=_convergence_time(conditions.convergence_time_worst),
    ),
    Rms.of("position_rmse", "rad", "position error, rms", "rms position error", better="less",
           signal=attrgetter("position_error")),
    Rms.of("velocity_rmse", "rad/s", "velocity error, rms", "rms velocity error", better="less",
           signal=attrgetter("velocity_error")),
    Rms.of(
        "torque_rmse", "N m", "torque error, rms",
        "rms error of the transmitted torque from this side's equivalent control",
        better="less",
        signal=attrgetter("torque_error"),
    ),
    Rms.of(
        "position_size", "rad", "position, rms", "rms true position: the size that its errors compare with",
        signal=attrgetter("true.position"),
    ),
    Rms.of(
        "velocity_size", "rad/s", "velocity, rms", "rms true velocity: the size that its errors compare with",
        signal=attrgetter("true.velocity"),
    ),
    Chatter,
    Peak.of(
        "f_plus", "rad/s²", "true bound f⁺", "largest true right-hand side error |f(x₂) − f(x̂₂) + ξ| along the run",
        signal=attrgetter("true.perturbation"),
    ),
    Peak.of(
        "f_plus_acceleration", "rad/s²", "twice the largest acceleration",
        "twice the largest acceleration: the paper's text for f⁺",
        signal=attrgetter("true.acceleration"),
        factor=2.0,
    ),
    GainMetric.of(
        "margin_alpha", "", "α / f⁺", "gain alpha over the true bound f_plus",
        judge=lambda _, gains, f_plus: gains.alpha / f_plus,
    ),
    *(_make_margin(name, condition) for name, condition in conditions.CONDITIONS.items()),
    IdentificationError.of("stiffness_error", "", "error of K", "relative error of the identified stiffness"),
    IdentificationError.of(
        "dead_zone_error", "", "error of the dead zone",
        "relative error of the identified dead zone (half gap of law dead_zone)",
    ),
    Excitation,
    Rms.of("following_rmse", "rad", "following error, rms", "rms difference of reference and true position",
           better="less", closed_loop=True, signal=attrgetter("following_error")),
    Peak.of("following_peak", "rad", "following error, peak", "largest difference of reference and true position",
            better="less", closed_loop=True, signal=attrgetter("following_error")),
    SettlingTime,
    LimitCycleAmplitude,
    LimitCycleFrequency,
    TorqueReversals,
    ImpactRate,
    ImpactSpeed,
    Rms.of("torque_rms", "N m", "driving torque, rms",
           "rms torque that drives the side (motor: the input; load: through the gear)",
           better="less", closed_loop=True, signal=attrgetter("driving_torque")),
):  # fmt: skip
    SIDE_METRICS.add(_metric)


MetricNames = tuple[str, ...] | None
"""Names of the metrics that a study requests; None requests all."""

Carries = dict[str, dict[str, Any]]
"""States of metrics by side and name."""
_OVERFLOW_METRICS = ("position_rmse", "velocity_rmse", "torque_rmse", "f_plus", "f_plus_acceleration")
"""Metrics that overflow if the lane does: they show whether it stayed finite."""


@functools.cache
def _select_metrics(kind: type[Metric], names: MetricNames = None) -> dict[str, Any]:
    """The requested metrics of a kind by name."""
    return {name: cls() for name, cls in SIDE_METRICS.items() if issubclass(cls, kind) and (names is None or name in names)}


clear_metrics = _select_metrics.cache_clear
"""Forget the selections of metrics, to be called as another one is registered."""


def _loop_metrics(experiment: Experiment, names: MetricNames) -> dict[str, RunMetric]:
    """Metrics of a side that the loop over time gives: those requested, and f_plus if gain metrics follow from it."""
    if names is not None and needs_gain_metrics(names):
        names = (*names, "f_plus")
    return {name: metric for name, metric in _select_metrics(RunMetric, names).items() if metric.applies(experiment)}


def _carried_metrics(experiment: Experiment, names: MetricNames) -> dict[str, RunMetric]:
    """The metric that updates each state of a side, by the state's name."""
    carry_metrics: dict[str, RunMetric] = {}
    for name, metric in _select_metrics(RunMetric).items():
        if name in _OVERFLOW_METRICS or name in _loop_metrics(experiment, names):
            carry_metrics.setdefault(metric.carry or name, metric)
    return carry_metrics


def window_start(steps: int) -> int:
    """First sample of the last quarter."""
    return steps - max(steps // 4, 1)


def _window_start_time(experiment: Experiment) -> Number:
    """Time of the first sample of the last quarter."""
    return window_start(experiment.run.steps) * experiment.run.sample_period


def _init_carries(names: MetricNames, experiment: Experiment) -> Carries:
    zero = jnp.zeros_like(experiment.run.sample_period)
    metrics = _carried_metrics(experiment, names)
    return {side: {name: metric.init(zero) for name, metric in metrics.items()} for side in experiment.sides}


def _are_metrics_final(names: MetricNames, experiment: Experiment, carry: Mapping[str, Any]) -> Array | None:
    """True if no further sample can change any requested metric of a side; None if this cannot be told."""
    if names is None or needs_gain_metrics(names):
        return None
    start = _window_start_time(experiment)
    metrics = _loop_metrics(experiment, names)
    flags: Any = [metric.is_final(carry[metric.carry or name], experiment, start) for name, metric in metrics.items()]
    return None if not flags or any(flag is None for flag in flags) else functools.reduce(jnp.logical_and, flags)


def identified_parameters(experiment: Experiment, state: State) -> Mapping[str, Mapping[str, Number]]:
    """Identified parameters of the transmission by side; none without an identifier."""
    if state.identifier is None:
        return {}
    assert experiment.identifier is not None and experiment.transmission is not None
    return experiment.identifier.estimate(state.identifier, experiment.transmission)


def _update_carries(
    names: MetricNames, experiment: Experiment, carries: Carries, index: Int[Array, ""], signals: Signals
) -> Carries:
    """Carries after a sample, by side."""
    run = experiment.run
    inside = (index >= window_start(run.steps)).astype(signals.time.dtype)
    new_carries = {}
    for side, carry in carries.items():
        s = signals.side(side)
        true = s.true
        assert true is not None
        ratio = experiment.drive.ratio(side)
        position = true.position - s.position_estimate
        velocity = true.velocity - s.velocity_estimate
        torque = _true_torque(experiment, side, signals) - s.torque_estimate
        within = (jnp.abs(position) * ratio <= run.position_tolerance) & (
            jnp.abs(velocity) * ratio <= run.velocity_tolerance
        )
        sample = SideSample(signals.time, inside, within, true, position, velocity, torque)
        if signals.target is not None:
            sample = _add_following(experiment, sample, side, index, signals)
        metrics = _carried_metrics(experiment, names)
        new_carry = {name: metric.update(carry[name], sample) for name, metric in metrics.items()}
        is_final = _are_metrics_final(names, experiment, carry)
        if is_final is not None:
            # the result must not depend on whether the lane stops here: a later overflow does not count
            new_carry = jax.tree.map(functools.partial(jnp.where, is_final), carry, new_carry)
        new_carries[side] = new_carry
    return new_carries


def _true_torque(experiment: Experiment, side: str, signals: Signals) -> Number:
    """The torque that a side's equivalent control stands for, N m: where no law transmits it, all that acts on the side."""
    if side == "motor" or experiment.transmission is not None:
        return signals.torque
    drive, true = experiment.drive, signals.side(side).true
    assert true is not None
    missing = true.acceleration - drive.acceleration(side, true.velocity, signals.input)
    return drive.inertia(side) * missing / drive.torque_gain(side)


def _add_following(
    experiment: Experiment, sample: SideSample, side: str, index: Int[Array, ""], signals: Signals
) -> SideSample:
    """Add to a side's sample what the metrics of a closed loop need."""
    drive, run, controller = experiment.drive, experiment.run, experiment.controller
    assert controller is not None and signals.target is not None and signals.torque is not None
    start = window_start(run.steps)
    error = signals.target.position * drive.ratio(controller.side) / drive.ratio(side) - sample.true.position
    if experiment.transmission is not None:
        true: Any = {name: signals.side(name).true for name in ("motor", "load")}
        twist, rate = (experiment.plant.twist({k: getattr(v, n) for k, v in true.items()}) for n in ("position", "velocity"))
        half_gap = experiment.transmission.half_gap + sum(effect.free_play() for effect in experiment.effects)
        sample = sample._replace(twist=twist, twist_rate=rate, half_gap=half_gap)
    return sample._replace(
        following_error=error,
        driving_torque=signals.input if side == "motor" else drive.ratio(side) * _true_torque(experiment, side, signals),
        before=((index >= 2 * start - run.steps) & (index < start)).astype(signals.time.dtype),
        settled=jnp.abs(error) * drive.ratio(side) <= run.position_tolerance,
        period=run.sample_period,
    )


def _compute_results(
    experiment: Experiment, carry: Mapping[str, Any], state: State, side: str, names: Iterable[str]
) -> TracedArrays:
    """Metrics of a side by name, from its states so far."""
    run = experiment.run
    parameters = identified_parameters(experiment, state).get(side, {})
    end = SideEnd(experiment, state, _window_start_time(experiment), run.steps - window_start(run.steps), parameters)
    metrics = _select_metrics(RunMetric)
    return {name: metrics[name].result(carry[metrics[name].carry or name], end) for name in names}


def _is_finite(results: TracedArrays) -> Array:
    return jnp.isfinite(sum(results[name] for name in _OVERFLOW_METRICS))


def _is_done(names: MetricNames, experiment: Experiment, carries: Carries, state: State) -> Array:
    """True if the requested metrics of each side are final, or the side has overflowed.

    A metric that has overflowed does not become finite again, and all metrics of its side are then NaN.
    """
    undecided = []
    for side, carry in carries.items():
        finite = _is_finite(_compute_results(experiment, carry, state, side, _OVERFLOW_METRICS))
        is_final = _are_metrics_final(names, experiment, carry)
        undecided.append(finite if is_final is None else finite & ~is_final)
    return ~functools.reduce(jnp.logical_or, undecided)


def _finish_metrics(names: MetricNames, experiment: Experiment, carries: Carries, state: State) -> dict[str, Array]:
    """`finite` and the metrics of both sides by column, from the last carries."""
    columns: dict[str, Array] = {}
    all_finite = jnp.asarray(True)
    metrics = _loop_metrics(experiment, names)
    for side, carry in carries.items():
        results = _compute_results(experiment, carry, state, side, dict.fromkeys([*metrics, *_OVERFLOW_METRICS]))
        finite = _is_finite(results)
        for name in metrics:
            columns[f"{side}.{name}"] = jnp.where(finite, results[name], False if name == "converged" else jnp.nan)
        all_finite = all_finite & finite
    return {"finite": all_finite, **columns}


@functools.cache
def metrics_reducer(names: MetricNames = None) -> Reducer:
    """The reducer that computes `finite` and the requested metrics in the loop over time.

    It is the same object for the same names, so that programs are compiled once.
    """
    return Reducer(
        functools.partial(_init_carries, names),
        functools.partial(_update_carries, names),
        functools.partial(_finish_metrics, names),
        functools.partial(_is_done, names),
    )


ALL_METRICS = metrics_reducer()
"""The reducer of all metrics."""


def needs_gain_metrics(names: MetricNames) -> bool:
    """True if requested metrics are left to :func:`add_gain_metrics`."""
    return bool(_select_metrics(GainMetric, names))


def observer_gains(experiment: Experiment) -> dict[str, ObserverGains]:
    """Gains of the experiment's observers by side; empty unless all are super-twisting observers."""
    observers = {side: getattr(experiment.observer, side) for side in experiment.sides}
    if not all(isinstance(observer, AbstractSuperTwisting) for observer in observers.values()):
        return {}
    return {
        side: ObserverGains(*(getattr(observer, field) for field in ObserverGains._fields))
        for side, observer in observers.items()
    }


def add_gain_metrics(metrics: Mapping[str, Any], gains: dict[str, ObserverGains], names: MetricNames = None) -> NamedArrays:
    """Metrics by column together with those that follow from gains and f_plus alone: margins and convergence times.

    They are computed apart from the loop over time, by programs that all studies share.

    Args:
        metrics: columns of the loop over time, `(seeds, points)` or numbers.
        gains: gains by side, of shapes that broadcast to that.
        names: requested metrics; nothing is added if none of them follows from gains.
    """
    columns = {name: np.asarray(metric) for name, metric in metrics.items()}
    for side, side_gains in (gains if needs_gain_metrics(names) else {}).items():
        f_plus = columns[f"{side}.f_plus"]
        arguments = (np.broadcast_to(argument, f_plus.shape).ravel() for argument in (*side_gains, f_plus))
        # lanes share the numbers that no axis varies
        rows = np.stack([*arguments], axis=1, dtype=f_plus.dtype)
        # compared bit by bit
        row_bytes = np.ascontiguousarray(rows).view(f"V{rows.shape[1] * rows.itemsize}")[:, 0]
        _, first_rows, row_index = np.unique(row_bytes, return_index=True, return_inverse=True)
        # the program that the study's chunks have compiled, however few of the rows differ
        results = apply_elementwise(compute_gain_metrics, list(rows[first_rows].T), largest=f_plus.size)
        columns |= {f"{side}.{name}": result[row_index].reshape(f_plus.shape) for name, result in results.items()}
    return columns


@functools.cache
def compile_gain_metrics(names: MetricNames, dtype: str, lanes: int) -> None:
    """Compile the program of :func:`add_gain_metrics` for a number of lanes and a precision, once; all studies share it."""
    if needs_gain_metrics(names):
        apply_elementwise(compute_gain_metrics, [np.ones(lanes, dtype)] * (len(ObserverGains._fields) + 1))


@jax.jit
def compute_gain_metrics(
    lambda_: Array, alpha: Array, position_error: Array, velocity_error: Array, f_plus: Array
) -> dict[str, Array]:
    """Compute the metrics of a side that follow from its gains and f_plus, by name."""
    gains = ObserverGains(lambda_, alpha, position_error, velocity_error)
    results = {name: metric.judge(gains, f_plus) for name, metric in _select_metrics(GainMetric).items()}
    # a lane that overflowed has no bound
    return {name: jnp.where(jnp.isnan(f_plus), jnp.nan, result) for name, result in results.items()}


_FINITE_METRIC = Metric.of(
    "finite", "", "finite", "no number of the lane overflowed, as far as metrics were not known yet", better="more"
)
"""The only column that belongs to no side."""


def find_metric(column: str) -> type[Metric]:
    """The metric of a column such as `motor.velocity_rmse`."""
    return _FINITE_METRIC if column == "finite" else SIDE_METRICS[column.partition(".")[2]]


def is_magnitude(column: str) -> bool:
    """True for columns whose sign does not count: signed errors must not cancel in a mean or median."""
    return column.endswith("_error")


def metric_columns(
    experiment: Experiment, names: Iterable[str] | None = None, variants: Iterable[Experiment] = ()
) -> list[str]:
    """Columns that :func:`metrics_reducer` and :func:`add_gain_metrics` give, in their order.

    Args:
        experiment: experiment whose metrics apply.
        names: requested metrics; left out, all.
        variants: experiments with the same sides whose metrics apply as well.

    Raises:
        InputError: there is no such metric, or it applies to no experiment.
    """
    experiments = [experiment, *variants]
    available = [
        name for name, metric in _select_metrics(Metric).items() if any(metric.applies(variant) for variant in experiments)
    ]
    requested = available if names is None else list(names)
    for i, name in enumerate(requested):
        if name not in available:
            fault = "does not apply to this study" if name in SIDE_METRICS else "is no metric"
            raise InputError(f"sweep.metrics[{i}]: '{name}' {fault}; {suggest_word(name, available)}")
    return ["finite", *(f"{side}.{name}" for side in experiment.sides for name in available if name in requested)]


def explain_missing_metric(column: str, experiment: Experiment, columns: Iterable[str]) -> str:
    """The message for a metric that is not among a study's columns."""
    if column in metric_columns(experiment):
        return f"'{column}' is not computed; add '{column.rpartition('.')[2]}' to sweep.metrics"
    return f"'{column}' is no metric; {suggest_word(column, columns)}"


ROUNDING = {"float64": 1e-9, "float32": 1e-4}
"""Relative errors below this are rounding, by precision; for f_plus relative to the acceleration."""


def no_disturbance_error(side: str) -> InputError:
    """The error to raise where f_plus is zero."""
    return InputError(
        f"{side}: f⁺ = 0: nothing disturbs the observer's model, so that gains have nothing to overcome; "
        "add a transmission, an effect, or an excitation that moves the drive"
    )
