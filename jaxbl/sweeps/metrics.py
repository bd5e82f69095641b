"""Metrics of a run, computed in the loop over time: observation errors, convergence, gain margins, identification.

A metric is one class: its column, unit, label and meaning, and how it is computed. Those that differ from others in a
signal or a formula alone are made by :meth:`Metric.of`. Further packages add classes derived from :class:`RunMetric` or
:class:`GainMetric`, or made so, through the entry-point group `jaxbl.metrics`; the entry's name is the metric's. RMS values
are over the last quarter of the run, in SI units. Position and velocity tolerances of the load are those of the motor
divided by the gear ratio.
"""

import abc
import functools
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxbl.drive.transmission import TRANSMISSIONS
from jaxbl.errors import InputError
from jaxbl.observer import AbstractSuperTwisting, conditions
from jaxbl.registry import Registry, check_subclass, check_text
from jaxbl.simulate import Experiment, Number, Reducer, Signals, State, TrueSide
from jaxbl.validation import suggest_word

from .elementwise import apply_elementwise


class Metric(abc.ABC):
    """A column of each side: `<side>.<name>`."""

    name: ClassVar[str]
    unit: ClassVar[str] = ""
    label: ClassVar[str]
    """Short name for axes of figures; what it means is in `doc`."""
    doc: ClassVar[str]
    better: ClassVar[str] = ""
    """Which is better of two values: `less` or `more`, or neither."""

    @classmethod
    def of(cls, name: str, unit: str, label: str, doc: str, **rest: Any) -> type[Self]:
        """A metric of this kind, with what the kind leaves open (`signal` of an rms or peak, `factor` of a
        peak, `judge` of gains)."""
        found: Any = type(name, (cls,), {"name": name, "unit": unit, "label": label, "doc": doc, **rest})
        return found

    def applies(self, experiment: Experiment) -> bool:
        """Whether an experiment has this metric."""
        return True


def _check(name: str, found: Any) -> None:
    base = GainMetric if isinstance(found, type) and issubclass(found, GainMetric) else RunMetric
    check_subclass(name, found, base)
    for about in ("unit", "label", "doc"):
        check_text(about, getattr(found, about, None))


class _Metrics(Registry):
    """Laws of installed packages may report errors of parameters of their own."""

    def _load_all(self) -> dict[str, Any]:
        if not self._loaded:
            super()._load_all()
            for law in TRANSMISSIONS.values():
                for name, parameter in law.errors.items():
                    if name not in self._members:
                        doc = f"relative error of the identified {parameter}"
                        self._members[name] = IdentificationError.of(name, "", f"error of {parameter}", doc)
        return self._members


SIDE_METRICS = _Metrics("jaxbl.metrics", _check)
"""The metrics of each side by name, in the order of the columns."""


class SideSample(NamedTuple):
    """What a metric sees of a side at one sample, SI units: errors are true values less estimates."""

    time: Number
    inside: Number
    """1 in the last quarter of the run, else 0."""
    within: Array
    """Whether position and velocity errors are within tolerance."""
    true: TrueSide
    position_error: Number
    velocity_error: Number
    torque_error: Number


class SideEnd(NamedTuple):
    """What a metric sees of a side at the end of the run."""

    experiment: Experiment
    state: State
    start: Any
    """Time of the first sample of the last quarter, s."""
    count: int
    """Samples of the last quarter."""
    identified: Mapping[str, Number]
    """Identified parameters of the transmission; none without an identifier."""


class RunMetric(Metric):
    """A metric with a state that each sample moves on; metrics with the same `carry` share that of the first of them."""

    carry: ClassVar[str | None] = None

    def init(self, zero: Number) -> Any:
        """State before the first sample, of zeros of the run's precision."""
        return ()

    def update(self, carry: Any, sample: SideSample) -> Any:
        """State after a sample."""
        return carry

    def known(self, carry: Any, experiment: Experiment, start: Number) -> Array | None:
        """Whether no further sample can change the result, from the state so far; None if that is never known.

        `start` is the time of the first sample of the last quarter, s. A lane whose metrics are all known need not go on.
        """
        return None

    @abc.abstractmethod
    def result(self, carry: Any, end: SideEnd) -> Array:
        """The metric, from the state after the last sample."""


class ObserverGains(NamedTuple):
    """What the gain conditions ask of an observer: its gains and its errors at t = 0."""

    lambda_: Array
    alpha: Array
    position_error: Array
    velocity_error: Array


class GainMetric(Metric):
    """A metric of a super-twisting observer's gains and f_plus alone, computed after the loop over time by a program that
    serves all studies."""

    def applies(self, experiment):
        return bool(observer_gains(experiment))

    @abc.abstractmethod
    def judge(self, gains: ObserverGains, f_plus: Array) -> Array:
        """The metric of many lanes, from arrays of one shape."""


class SignalMetric(RunMetric):
    """A number that follows from one signal, and is zero at first."""

    @abc.abstractmethod
    def signal(self, sample: SideSample) -> Number:
        """The signal at one sample."""

    def init(self, zero):
        return zero


class Rms(SignalMetric):
    """Root of the mean square of a signal over the last quarter."""

    def update(self, carry, sample):
        return carry + sample.inside * self.signal(sample) * self.signal(sample)

    def result(self, carry, end):
        return jnp.sqrt(carry / end.count)


class Peak(SignalMetric):
    """Largest size of a signal along the run, times a factor."""

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
    """The state is the last time at which an error was out of tolerance, -1 before any."""

    name = "converged"
    label = "converged"
    doc = "position and velocity errors stay within tolerance over the last quarter"
    better = "more"
    carry = "last_outside"

    def init(self, zero):
        return zero - 1.0

    def update(self, carry, sample):
        return jnp.where(sample.within, carry, sample.time)

    def known(self, carry, experiment, start):
        return carry >= start - 0.5 * experiment.run.sample_period

    def result(self, carry, end):
        return carry < end.start - 0.5 * end.experiment.run.sample_period


class ConvergenceTime(Converged):
    """As :class:`Converged`, whose state it shares."""

    name = "convergence_time"
    unit = "s"
    label = "convergence time"
    doc = "time from which both errors stay within tolerance; NaN where not converged"
    better = "less"

    def result(self, carry, end):
        entered = jnp.where(carry < 0.0, 0.0, carry + end.experiment.run.sample_period)
        return jnp.where(super().result(carry, end), entered, jnp.nan)


class Chatter(RunMetric):
    """The state is the sum of squares, and the velocity error of the last sample."""

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
    """How well the input tells the unknowns of the law apart."""

    name = "excitation"
    label = "excitation"
    doc = "smallest eigenvalue of the normalised information matrix"

    def applies(self, experiment):
        return experiment.identifier is not None and experiment.transmission is not None

    def result(self, carry, end):
        assert end.experiment.identifier is not None and end.state.identifier is not None
        return end.experiment.identifier.excitation(end.state.identifier)


def _time(of: Callable[..., Array]) -> Callable[[GainMetric, ObserverGains, Array], Array]:
    """A convergence time that follows from gains, f_plus and the errors at the start."""
    return lambda _, g, f_plus: of(g.lambda_, g.alpha, f_plus, g.position_error, g.velocity_error)


def _margin(name: str, condition: conditions.Condition) -> type[GainMetric]:
    def judge(self: Any, gains: ObserverGains, f_plus: Array) -> Array:
        return gains.lambda_ / condition.least_lambda(gains.alpha, f_plus)

    about = f"margin to {condition.title}", f"λ over the least λ of {condition.title}"
    return GainMetric.of(f"margin_{name}", "", *about, judge=judge)


for _metric in (
    Converged,
    ConvergenceTime,
    GainMetric.of(
        "convergence_time_bound", "s", "bound on convergence time",
        "bound (42) on it for the noise-free observer; inf where (32) fails",
        judge=_time(conditions.convergence_time_bound),
    ),
    GainMetric.of(
        "convergence_time_worst", "s", "worst convergence time",
        "longest convergence time that a disturbance within f_plus can cause; inf where ρ ≥ 1",
        judge=_time(conditions.convergence_time_worst),
    ),
    Rms.of("position_rmse", "rad", "position error, rms", "rms position error", better="less",
           signal=lambda _, at: at.position_error),
    Rms.of("velocity_rmse", "rad/s", "velocity error, rms", "rms velocity error", better="less",
           signal=lambda _, at: at.velocity_error),
    Rms.of(
        "torque_rmse", "N m", "torque error, rms",
        "rms error of the transmitted torque from this side's equivalent control",
        better="less",
        signal=lambda _, at: at.torque_error,
    ),
    Rms.of(
        "position_size", "rad", "position, rms", "rms true position: the size that its errors compare with",
        signal=lambda _, at: at.true.position,
    ),
    Rms.of(
        "velocity_size", "rad/s", "velocity, rms", "rms true velocity: the size that its errors compare with",
        signal=lambda _, at: at.true.velocity,
    ),
    Chatter,
    Peak.of(
        "f_plus", "rad/s²", "true bound f⁺", "largest true right-hand side error |f(x₂) − f(x̂₂) + ξ| along the run",
        signal=lambda _, at: at.true.perturbation,
    ),
    Peak.of(
        "f_plus_acceleration", "rad/s²", "twice the largest acceleration",
        "twice the largest acceleration: the paper's text for f⁺",
        signal=lambda _, at: at.true.acceleration,
        factor=2.0,
    ),
    GainMetric.of(
        "margin_alpha", "", "α / f⁺", "gain alpha over the true bound f_plus",
        judge=lambda _, gains, f_plus: gains.alpha / f_plus,
    ),
    *(_margin(name, condition) for name, condition in conditions.CONDITIONS.items()),
    IdentificationError.of("stiffness_error", "", "error of K", "relative error of the identified stiffness"),
    IdentificationError.of(
        "dead_zone_error", "", "error of the dead zone",
        "relative error of the identified dead zone (half gap of law dead_zone)",
    ),
    Excitation,
):  # fmt: skip
    SIDE_METRICS.add(_metric)


Names = tuple[str, ...] | None
"""The metrics that a study asks for; None asks for all."""

_OVERFLOW = ("position_rmse", "velocity_rmse", "torque_rmse", "f_plus", "f_plus_acceleration")
"""Metrics that overflow with the lane: they show whether it stayed finite."""


@functools.cache
def _metrics(kind: type[Metric], names: Names = None) -> dict[str, Any]:
    """The metrics of a kind that are asked for, by name."""
    return {name: cls() for name, cls in SIDE_METRICS.items() if issubclass(cls, kind) and (names is None or name in names)}


def _given(experiment: Experiment, names: Names) -> dict[str, RunMetric]:
    """The metrics of a side that the loop gives: those asked for, and f_plus where others follow from it."""
    if names is not None and needs_conditions(names):
        names = (*names, "f_plus")
    return {name: metric for name, metric in _metrics(RunMetric, names).items() if metric.applies(experiment)}


def _carries(experiment: Experiment, names: Names) -> dict[str, RunMetric]:
    """The states of a side: by name, the metric that moves each on."""
    found: dict[str, RunMetric] = {}
    for name, metric in _metrics(RunMetric).items():
        if name in _OVERFLOW or name in _given(experiment, names):
            found.setdefault(metric.carry or name, metric)
    return found


def window_start(steps: int) -> int:
    """First sample of the last quarter."""
    return steps - max(steps // 4, 1)


def _start(experiment: Experiment) -> Number:
    """Time of the first sample of the last quarter."""
    return window_start(experiment.run.steps) * experiment.run.sample_period


def _init(names: Names, experiment: Experiment) -> dict[str, tuple]:
    zero = jnp.zeros_like(experiment.run.sample_period)
    carries = _carries(experiment, names).values()
    return {side: tuple(metric.init(zero) for metric in carries) for side in experiment.sides}


def _known(names: Names, experiment: Experiment, totals: tuple) -> Array | None:
    """Whether all that is asked for of a side is known from its states so far; None if that is never known."""
    if names is None or needs_conditions(names):
        return None
    carries = dict(zip(_carries(experiment, names), totals, strict=True))
    start = _start(experiment)
    each = [
        metric.known(carries[metric.carry or name], experiment, start) for name, metric in _given(experiment, names).items()
    ]
    found = [one for one in each if one is not None]
    return functools.reduce(jnp.logical_and, found) if found and len(found) == len(each) else None


def identified(experiment: Experiment, state: State) -> Mapping[str, Mapping[str, Number]]:
    """Identified parameters of the transmission by side; none without an identifier."""
    if state.identifier is None:
        return {}
    assert experiment.identifier is not None and experiment.transmission is not None
    return experiment.identifier.estimate(state.identifier, experiment.transmission)


def _update(
    names: Names, experiment: Experiment, totals: dict[str, tuple], index: Int[Array, ""], signals: Signals
) -> dict[str, tuple]:
    run = experiment.run
    inside = (index >= window_start(run.steps)).astype(signals.time.dtype)
    new = {}
    for side, old in totals.items():
        s = signals.side(side)
        true = s.true
        assert true is not None
        ratio = experiment.drive.ratio(side)
        position = true.position - s.position_estimate
        velocity = true.velocity - s.velocity_estimate
        torque = signals.torque - s.torque_estimate
        within = (jnp.abs(position) * ratio <= run.position_tolerance) & (
            jnp.abs(velocity) * ratio <= run.velocity_tolerance
        )
        sample = SideSample(signals.time, inside, within, true, position, velocity, torque)
        metrics = _carries(experiment, names).values()
        moved = tuple(metric.update(carry, sample) for metric, carry in zip(metrics, old, strict=True))
        known = _known(names, experiment, old)
        if known is not None:
            # whether it stays finite is not asked any more, be the lane taken further or not
            moved = jax.tree.map(functools.partial(jnp.where, known), old, moved)
        new[side] = moved
    return new


def _found(
    names: Names, experiment: Experiment, totals: dict[str, tuple], state: State, side: str, wanted: Iterable[str]
) -> dict[str, Any]:
    """Some metrics of a side, from its states so far."""
    run = experiment.run
    parameters = identified(experiment, state).get(side, {})
    end = SideEnd(experiment, state, _start(experiment), run.steps - window_start(run.steps), parameters)
    carries = dict(zip(_carries(experiment, names), totals[side], strict=True))
    metrics = _metrics(RunMetric)
    return {name: metrics[name].result(carries[metrics[name].carry or name], end) for name in wanted}


def _finite(found: dict[str, Any]) -> Array:
    return jnp.isfinite(sum(found[name] for name in _OVERFLOW))


def _done(names: Names, experiment: Experiment, totals: dict[str, tuple], state: State) -> Array:
    """Whether of each side all that is asked for is known, or it did not stay finite: none of the metrics that show that
    becomes finite again, and all others are NaN then."""
    goes_on = []
    for side, own in totals.items():
        finite, known = _finite(_found(names, experiment, totals, state, side, _OVERFLOW)), _known(names, experiment, own)
        goes_on.append(finite if known is None else finite & ~known)
    return ~functools.reduce(jnp.logical_or, goes_on)


def _result(names: Names, experiment: Experiment, totals: dict[str, tuple], state: State) -> dict[str, Array]:
    figures: dict[str, Array] = {}
    finite = jnp.asarray(True)
    given = _given(experiment, names)
    for side in totals:
        out = _found(names, experiment, totals, state, side, dict.fromkeys([*given, *_OVERFLOW]))
        ok = _finite(out)
        out = {name: jnp.where(ok, out[name], False if name == "converged" else jnp.nan) for name in given}
        finite = finite & ok
        figures |= {f"{side}.{name}": value for name, value in out.items()}
    return {"finite": finite, **figures}


@functools.cache
def metrics(names: Names = None) -> Reducer:
    """What computes `finite` and the metrics asked for in the loop over time; the same object for the same names."""
    own = functools.partial
    return Reducer(own(_init, names), own(_update, names), own(_result, names), own(_done, names))


METRICS = metrics()
"""All metrics."""


def needs_conditions(names: Names) -> bool:
    """Whether some of the metrics asked for are left to :func:`with_conditions`."""
    return bool(_metrics(GainMetric, names))


def observer_gains(experiment: Experiment) -> dict[str, ObserverGains]:
    """Gains of the experiment's observers by side; none of observers that the conditions are not for."""
    fields = ObserverGains._fields
    if not isinstance(experiment.observer.motor, AbstractSuperTwisting):
        return {}
    return {s: ObserverGains(*(getattr(getattr(experiment.observer, s), f) for f in fields)) for s in experiment.sides}


def with_conditions(figures: Mapping[str, Any], gains: dict[str, ObserverGains]) -> dict[str, np.ndarray]:
    """Figures together with those that follow from gains and f_plus alone: margins to conditions, convergence times.

    Apart from the loop over time, by programs that serve all studies.
    """
    found = {name: np.asarray(value) for name, value in figures.items()}
    if not gains:
        return found
    f_plus = np.stack([found[f"{side}.f_plus"] for side in gains])
    columns = [[np.asarray(x, f_plus.dtype) for x in given] for given in zip(*gains.values(), strict=True)]
    for side, *given in zip(gains, *columns, f_plus, strict=True):
        # gains and f_plus of all seeds and points, and which of those that differ each is
        rows = np.stack([np.broadcast_to(one, f_plus.shape[1:]).ravel() for one in given], axis=1)
        different, which = _different(rows)
        # the program that the study's chunks have compiled, however few of the lanes differ
        judged = apply_elementwise(_judged, list(different.T), largest=f_plus[0].size)
        found |= {f"{side}.{name}": value[which].reshape(f_plus.shape[1:]) for name, value in judged.items()}
    return found


def _different(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows that differ in a bit, and the place among them of each: lanes share what their axes leave alone."""
    whole = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.shape[1] * rows.itemsize)))[:, 0]
    _, first, which = np.unique(whole, return_index=True, return_inverse=True)
    return rows[first], which


def compile_conditions(dtype: str, lanes: int) -> None:
    """Compile what :func:`with_conditions` computes of so many lanes, for all studies of a precision."""
    apply_elementwise(_judged, [np.ones(lanes, dtype)] * (len(ObserverGains._fields) + 1))


@jax.jit
def _judged(lambda_: Array, alpha: Array, position_error: Array, velocity_error: Array, f_plus: Array) -> dict[str, Array]:
    gains = ObserverGains(lambda_, alpha, position_error, velocity_error)
    out = {name: metric.judge(gains, f_plus) for name, metric in _metrics(GainMetric).items()}
    # a lane that overflowed has no bound
    return {name: jnp.where(jnp.isnan(f_plus), jnp.nan, value) for name, value in out.items()}


_FINITE = Metric.of(
    "finite", "", "finite", "no number of the lane overflowed, as far as metrics were not known yet", better="more"
)
"""The one column that is not of a side."""


def metric_of(column: str) -> type[Metric]:
    """The metric of a column such as `motor.velocity_rmse`."""
    return _FINITE if column == "finite" else SIDE_METRICS[column.partition(".")[2]]


def is_magnitude(column: str) -> bool:
    """Whether a metric counts by its size: a median or mean of signed relative errors must not cancel them."""
    return column.endswith("_error")


def metric_columns(
    experiment: Experiment, names: Iterable[str] | None = None, others: Iterable[Experiment] = ()
) -> list[str]:
    """The columns of this experiment, or of any of several with the same sides, of the metrics asked for or of all: what
    :func:`metrics` and :func:`with_conditions` give.

    Raises:
        InputError: there is no such metric, or no experiment has it.
    """
    each = [experiment, *others]
    own = [name for name, metric in _metrics(Metric).items() if any(metric.applies(one) for one in each)]
    wanted = own if names is None else list(names)
    for i, name in enumerate(wanted):
        if name not in own:
            what = "does not apply to this study" if name in SIDE_METRICS else "is no metric"
            raise InputError(f"sweep.metrics[{i}]: '{name}' {what}; {suggest_word(name, own)}")
    return ["finite", *(f"{side}.{name}" for side in experiment.sides for name in own if name in wanted)]


def no_metric(column: str, experiment: Experiment, columns: Iterable[str]) -> str:
    """What to say of a metric that is not among a study's columns."""
    if column in metric_columns(experiment):
        return f"'{column}' is not computed; add '{column.rpartition('.')[2]}' to sweep.metrics"
    return f"'{column}' is no metric; {suggest_word(column, columns)}"


NOTHING = {"float64": 1e-9, "float32": 1e-4}
"""By precision: a right-hand side error this small against the acceleration is rounding."""


def undisturbed(side: str) -> InputError:
    """What to say where f_plus is zero."""
    return InputError(
        f"{side}: nothing acts on it that its observer does not know (f⁺ = 0), so that gains have nothing to meet; "
        "add a transmission, an effect, or an excitation that moves the drive"
    )
