"""One experiment through time: drive, encoders, observers, equivalent control and identifier in one step function.

:func:`step` is the whole chain for one sample of one lane; `jax.vmap` makes it many lanes. :func:`scan` repeats it over
time for a simulated drive, :func:`replay` for recorded positions; both record traces and update reducers on the way.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .control import AbstractController, AbstractReference, ControllerState, Feedback, Target
from .drive.effects import AbstractEffect
from .drive.encoders import Encoders
from .drive.excitation import Sine
from .drive.parameters import Scalar, option, parameter
from .drive.plant import AbstractDrive, Initial, Plant, PlantState
from .drive.transmission import AbstractTransmission
from .observer.base import Observers, ObserverState
from .observer.equivalent_control import EquivalentControl
from .observer.recursive import Identifier, IdentifierState

UNROLL_SUBSTEPS = False
# if they are unrolled, XLA fuses each substep with copies of all before it: quadratic work (benchmarks/NOTES.md)

NamedArrays = dict[str, np.ndarray]
"""Arrays by the name of a side, a metric or a number."""
TracedArrays = dict[str, Array]
"""The same inside a traced function."""
Number = Any  # a number of one lane: Float[Array, ""] inside a step
Integer = Int[Array, ""]  # an index of a sample or plant step, or a seed


class Run(eqx.Module):
    """The grid of time, and the tolerances of the metric `converged`.

    `steps` is the number of samples of a run.
    """

    sample_period: Scalar = parameter("s", "period of encoders, observers, identifier", default=1e-3, above=0.0, fixed=True)
    steps: int = eqx.field(static=True, default=20_000)
    # at 1 ms, 100 000 substeps resolve frequencies up to 2e8 rad/s
    substeps: int = option("plant steps per sample", default=10, minimum=1, maximum=100_000)
    position_tolerance: Scalar = parameter(
        "rad", "largest position error of a converged observer (load: divided by the gear ratio)", default=1e-3, above=0.0
    )
    velocity_tolerance: Scalar = parameter(
        "rad/s", "largest velocity error of a converged observer (load: divided by the gear ratio)", default=0.05, above=0.0
    )


class Experiment(eqx.Module):
    """A drive with its input, encoders, observers and identifier. Every number is a leaf, named by its config path."""

    _: dataclasses.KW_ONLY
    drive: AbstractDrive
    transmission: AbstractTransmission | None = None
    effects: tuple[AbstractEffect, ...] = ()
    initial: Initial = Initial()
    excitation: Callable[[Any], Any] = Sine(0.0, 1.0)
    encoders: Encoders = Encoders()
    observer: Observers
    equivalent_control: EquivalentControl = EquivalentControl()
    identifier: Identifier | None = None
    run: Run = Run()
    controller: AbstractController | None = None
    reference: AbstractReference | None = None

    @property
    def plant(self) -> Plant:
        return Plant(self.drive, self.transmission, self.effects)

    @property
    def sides(self) -> tuple[str, ...]:
        """The sides of the drive that have an encoder and an observer."""
        return self.drive.sides


def with_effects(experiment: Experiment, effects: tuple[AbstractEffect, ...]) -> Experiment:
    """The experiment with other effects."""
    return dataclasses.replace(experiment, effects=effects)


class State(eqx.Module):
    """The state of the whole chain, which the loop carries from sample to sample.

    Attributes:
        plant: None in a replay of a record.
        observer: by side.
        equivalent_control: filtered equivalent control of each side, rad/s^2.
        identifier: None if the experiment has no identifier, or no transmission.
        controller: None in a replay of a record, or if the experiment has none.
    """

    plant: PlantState | None
    observer: dict[str, ObserverState]
    equivalent_control: dict[str, Number]
    identifier: IdentifierState | None
    controller: ControllerState | None = eqx.field(default=None, kw_only=True)


class Sample(NamedTuple):
    """The inputs of one step: unit noise for a simulated drive, or the input and measured positions of a record.

    Attributes:
        time: s.
        noise: one draw of a standard normal distribution for the encoder of each side.
        input: torque, N m; in a simulation it replaces excitation and controller.
        measured: position of each side, rad.
        added_accelerations: by side, rad/s^2; the observers add them to the nominal ones, held until the next sample.
        target: of the controlled side; it replaces the reference.
    """

    time: Number
    noise: dict[str, Number] | None = None
    input: Number | None = None
    measured: dict[str, Number] | None = None
    added_accelerations: dict[str, Number] | None = None
    target: Target | None = None


class TrueSide(NamedTuple):
    """The true motion of a side, which only a simulator knows.

    Attributes:
        position: rad.
        velocity: rad/s.
        acceleration: mean from this sample to the next, rad/s^2.
        perturbation: the error f(x_2) - f(x_2_hat) + xi of the observer's right-hand side (10), rad/s^2.
    """

    position: Number
    velocity: Number
    acceleration: Number
    perturbation: Number


class SideSignals(NamedTuple):
    """Signals of one side at one sample.

    Attributes:
        measured: reading of the encoder, rad; NaN where a simulated one is missed.
        position_estimate: rad.
        velocity_estimate: rad/s.
        equivalent_control: filtered equivalent control (15), rad/s^2.
        torque_estimate: the transmitted torque (17) that the equivalent control stands for, N m.
        true: None in a replay of a record.
    """

    measured: Number
    position_estimate: Scalar
    velocity_estimate: Scalar
    equivalent_control: Number
    torque_estimate: Number
    true: TrueSide | None


class Signals(NamedTuple):
    """All signals at one sample.

    Attributes:
        time: s.
        input: torque u, N m.
        twist: z = theta_e - N_0 theta_s of the readings, rad; None on a rigid drive.
        torque: transmitted torque C, N m; on a rigid drive, all that resists beyond the nominal model. None in a replay.
        motor, load: signals of the sides; `load` is None on a rigid drive.
        further: signals of further sides that a drive of one's own has, by side.
        target: of the controlled side; None without a controller.
    """

    time: Number
    input: Number
    twist: Number | None
    torque: Number | None
    motor: SideSignals
    load: SideSignals | None
    further: dict[str, SideSignals] = {}  # noqa: RUF012
    target: Target | None = None

    def side(self, side: str) -> SideSignals:
        return self.further[side] if side in self.further else getattr(self, side)


def initial_state(experiment: Experiment, measured: dict[str, Number] | None = None) -> State:
    """Return the state at t = 0; with `measured` positions (rad), the state of a replay that begins there, at standstill."""
    zero = jnp.zeros_like(jnp.asarray(experiment.run.sample_period))
    zeros = dict.fromkeys(experiment.sides, zero)
    plant, position, velocity = None, measured, zeros
    if position is None:
        plant = experiment.plant.init(experiment.initial)
        velocity = plant.velocity
        position = {side: experiment.plant.read(side, plant.position[side], velocity[side]) for side in experiment.sides}
    observer_states = {}
    for side in experiment.sides:
        observer = getattr(experiment.observer, side)
        observer_states[side] = initial_observer_state(
            experiment, side, position[side] - observer.position_error, velocity[side] - observer.velocity_error
        )
    identifier = None
    if experiment.identifier is not None and experiment.transmission is not None:
        identifier = experiment.identifier.init(experiment.transmission, experiment.sides, zero)
    controller = None
    if experiment.controller is not None and measured is None:
        controller = experiment.controller.start({side: zero + position[side] for side in experiment.sides})
    return State(plant, observer_states, zeros, identifier, controller=controller)


def initial_observer_state(experiment: Experiment, side: str, position: Scalar, velocity: Scalar) -> ObserverState:
    """Return the state of a side's observer that predicts a position (rad) and a velocity (rad/s) for the first sample."""
    return getattr(experiment.observer, side).start(
        position, velocity, lambda speed: experiment.drive.acceleration(side, speed, jnp.zeros_like(speed)),
        experiment.run.sample_period
    )  # fmt: skip


def step(experiment: Experiment, state: State, sample: Sample) -> tuple[State, Signals]:
    """Compute the whole chain for one sample: read encoders, observe, filter, identify, and move the plant.

    Args:
        experiment: with array leaves (:func:`jaxbl.drive.as_arrays`).
        state: of the chain before the sample.
        sample: with `noise` the drive is simulated, without it `input` and `measured` are those of a record.

    Returns:
        The state before the next sample, and the signals at this one.
    """
    drive, plant, period = experiment.drive, experiment.plant, experiment.run.sample_period
    before: Any = state.plant  # None in a replay
    torque_in: Any = sample.input
    if torque_in is None:
        torque_in = experiment.excitation(sample.time)
        torque_in = torque_in if state.controller is None else torque_in + state.controller.torque
    if sample.noise is None:
        measured, after = sample.measured or {}, None
    else:
        measured = {
            side: experiment.encoders.measure(
                side, plant.read(side, before.position[side], before.velocity[side]), sample.noise[side], drive.ratio(side)
            )
            for side in drive.sides
        }
        after = move_plant(plant, experiment.run, before, torque_in, sample.time)

    missed, readings = {}, measured
    if sample.noise is None or experiment.encoders.missed is not None:
        missed = find_missed(measured, torque_in)
        readings = {side: jnp.where(lost, state.observer[side].position, measured[side]) for side, lost in missed.items()}
        torque_in = jnp.where(jnp.isfinite(torque_in), torque_in, 0.0)

    observers, filtered, torques, sides = {}, {}, {}, {}
    for side in drive.sides:

        def nominal_acceleration(velocity: Number, side: str = side) -> Number:
            nominal = drive.acceleration(side, velocity, torque_in)
            return nominal if sample.added_accelerations is None else nominal + sample.added_accelerations[side]

        observer = getattr(experiment.observer, side)
        observers[side], estimate = observer.step(state.observer[side], readings[side], nominal_acceleration, period)
        last = state.equivalent_control[side]
        filtered[side] = experiment.equivalent_control.filter(last, estimate.control, period)
        if missed:
            filtered[side] = jnp.where(missed[side], last, filtered[side])
        torques[side] = drive.inertia(side) * filtered[side] / drive.torque_gain(side)
        true = None
        if after is not None:
            acceleration = (after.velocity[side] - before.velocity[side]) / period
            perturbation = acceleration - drive.acceleration(side, estimate.velocity, torque_in)
            true = TrueSide(before.position[side], before.velocity[side], acceleration, perturbation)
        sides[side] = SideSignals(measured[side], estimate.position, estimate.velocity, filtered[side], torques[side], true)

    identifier = state.identifier
    twist = plant.twist(readings) if "load" in drive.sides else None
    if identifier is not None:
        assert experiment.identifier is not None and experiment.transmission is not None and twist is not None
        # no sample counts before the start
        time = sample.time
        for lost in missed.values():
            time = jnp.where(lost, -period, time)
        identifier = experiment.identifier.step(
            identifier, experiment.transmission, experiment.equivalent_control, twist, torques, time, period
        )

    torque = None
    if after is not None and experiment.transmission is not None:
        torque, _ = plant.transmitted_torque(before.position, before.velocity, before.effects)
    elif after is not None:
        missing = drive.acceleration("motor", before.velocity["motor"], torque_in) - sides["motor"].true.acceleration
        torque = drive.inertia("motor") * missing
    control, target = state.controller, None
    if control is not None:
        assert experiment.controller is not None
        target = sample.target
        if target is None:
            assert experiment.reference is not None
            target = experiment.reference.target(sample.time)
        position = {side: sides[side].position_estimate for side in drive.sides}
        velocity = {side: sides[side].velocity_estimate for side in drive.sides}
        feedback = Feedback(readings, position, velocity, filtered, experiment.effects)
        control = experiment.controller.step(control, feedback, target, drive, period)
    return State(after, observers, filtered, identifier, controller=control), Signals(
        sample.time, torque_in, twist, torque, sides.pop("motor"), sides.pop("load", None), sides, target
    )


def find_missed(measured: TracedArrays, torque: Number) -> TracedArrays:
    """Tell which sides miss a sample: its reading (rad), or the input torque (N m), is not finite."""
    return {side: ~jnp.isfinite(reading + torque) for side, reading in measured.items()}


def begin_sample(
    plant: Plant, run: Run, state: PlantState, torque: Scalar, time: Number
) -> tuple[PlantState, Callable[..., PlantState]]:
    """The state with the `torque` (N m) that arrives at a sample (at `time`, s) and is held until the next one, and the
    plant's step from there, by its number."""
    period = run.sample_period / run.substeps
    effects, arriving_torque = plant.receive(state.effects, torque, run.sample_period)

    def substep(i: Integer, state: PlantState) -> PlantState:
        return plant.advance(state, arriving_torque(i * period, period), time + i * period, period)

    return PlantState(state.position, state.velocity, effects), substep


def move_plant(plant: Plant, run: Run, state: PlantState, torque: Scalar, time: Number) -> PlantState:
    """Move the plant from one sample to the next, in `run.substeps` steps; arguments as of :func:`begin_sample`."""
    state, substep = begin_sample(plant, run, state, torque, time)
    if run.substeps == 1:
        return substep(jnp.asarray(0), state)
    return jax.lax.fori_loop(0, run.substeps, substep, state, unroll=UNROLL_SUBSTEPS)


class Reducer(NamedTuple):
    """Metrics of a whole run, computed sample by sample, so that memory does not grow with the duration.

    Attributes:
        init: `init(experiment)` returns the carry before the first sample.
        update: `update(experiment, carry, index, signals)` returns the carry after sample `index`.
        result: `result(experiment, carry, state)` returns the metrics by name, from the last carry and the last state.
        done: `done(experiment, carry, state)` is True if no further sample can change the metrics, so that the lane may
            stop. None: the reducer needs all samples.
    """

    init: Callable[[Experiment], Any]
    update: Callable[[Experiment, Any, Integer, Signals], Any]
    result: Callable[[Experiment, Any, State], TracedArrays]
    done: Callable[[Experiment, Any, State], Array] | None = None


Reducers = tuple[Reducer, ...]


def unit_noise(seed: Integer, indices: Int[Array, " samples"], sides: tuple[str, ...]) -> TracedArrays:
    """Draw standard normal noise for each side, shape (samples,), which depends on seed and sample index alone.

    Runs with the same seed have common random numbers. The draws are float32 in all runs, so that both precisions see the
    same noise.
    """
    key, count = jax.random.key(seed), max(2, len(sides))
    draws = jax.vmap(lambda index: jax.random.normal(jax.random.fold_in(key, index), (count,), jnp.float32))(indices)
    return {side: draws[:, i] for i, side in enumerate(sides)}


LONGEST_BLOCK = 512
"""Most samples in a block, whose noise is drawn at once."""


def block_length(steps: int) -> int:
    """Return the samples in a block: the largest divisor of `steps` up to the longest block, or 256 if there is none."""
    return max((n for n in range(64, LONGEST_BLOCK + 1) if steps % n == 0), default=min(256, steps))


Carry = tuple[State, tuple[Any, ...]]
"""The state of the chain, and the carry of each reducer."""


def initial_carry(experiment: Experiment, reducers: Reducers, state: State | None = None) -> Carry:
    """Return the carry before the first sample, with the given state of the chain or that at t = 0."""
    return initial_state(experiment) if state is None else state, tuple(reducer.init(experiment) for reducer in reducers)


def advance_sample(
    experiment: Experiment, reducers: Reducers, carry: Carry, index: Integer, *sample_inputs: Any
) -> tuple[Carry, Signals]:
    """Advance the carry by sample `index`, and return the signals there.

    `sample_inputs` are the fields of :class:`Sample` after its time; in a simulation the unit noise is enough.
    """
    state, totals = carry
    period = experiment.run.sample_period
    state, signals = step(experiment, state, Sample(index.astype(jnp.result_type(period)) * period, *sample_inputs))
    totals = tuple(
        reducer.update(experiment, total, index, signals) for reducer, total in zip(reducers, totals, strict=True)
    )
    return (state, totals), signals


def end_block(experiment: Experiment, carry: Carry) -> Carry:
    """Return the carry at the end of a block, with the identifier's sums compensated: long runs in float32 lose nothing."""
    state, totals = carry
    if experiment.identifier is None or state.identifier is None:
        return carry
    return dataclasses.replace(state, identifier=experiment.identifier.settle(state.identifier)), totals


def compute_metrics(experiment: Experiment, reducers: Reducers, carry: Carry) -> TracedArrays:
    """Compute the metrics of all reducers from the last carry, by name."""
    state, totals = carry
    metrics: TracedArrays = {}
    for reducer, total in zip(reducers, totals, strict=True):
        metrics |= reducer.result(experiment, total, state)
    return metrics


def all_done(experiment: Experiment, reducers: Reducers, carry: Carry) -> Array | None:
    """Return True if no further sample can change any metric; None if a reducer needs all samples."""
    state, totals = carry
    if not reducers or any(reducer.done is None for reducer in reducers):
        return None
    done = (reducer.done(experiment, total, state) for reducer, total in zip(reducers, totals, strict=True))  # type: ignore[misc]
    return functools.reduce(jnp.logical_and, done)


def scan(
    experiment: Experiment,
    seed: Integer,
    reducers: Reducers = (),
    record: Callable[[State, Signals], Any] | None = None,
    stride: int = 1,
) -> tuple[TracedArrays, Any]:
    """Simulate one experiment.

    Args:
        experiment: with array leaves (:func:`jaxbl.drive.as_arrays`).
        seed: seed of the encoder noise.
        reducers: the metrics to compute.
        record: `record(state, signals)` returns what the trace has of a sample; None: no trace.
        stride: the trace has one sample of each `stride` samples.

    Returns:
        The metrics by name, and the trace with a leading time axis, shape (samples, ...); None without `record`.

    Example:
        >>> _, velocity = scan(experiment, 0, record=lambda state, signals: signals.motor.velocity_estimate)
    """

    return _scan(
        experiment, initial_carry(experiment, reducers), experiment.run.steps,
        lambda indices: (unit_noise(seed, indices, experiment.sides),), reducers, record, stride
    )  # fmt: skip


def replay(
    experiment: Experiment,
    torque: Float[Array, " samples"],
    measured: dict[str, Float[Array, " samples"]],
    reducers: Reducers = (),
    record: Callable[[State, Signals], Any] | None = None,
    stride: int = 1,
    state: State | None = None,
    added_accelerations: dict[str, Float[Array, " samples"]] | None = None,
) -> tuple[TracedArrays, Any]:
    """Run observers, filter and identifier on a record, which takes the place of the plant.

    Args:
        experiment: with array leaves; its sample period is that of the record.
        torque: input, N m, shape (samples,).
        measured: position of each side, rad, shape (samples,).
        reducers, record, stride: as in :func:`scan`.
        state: before the first sample; left out, standstill at the first positions.
        added_accelerations: by side, rad/s^2, shape (samples,): part of the model (:class:`Sample`), so that the equivalent
            control has only what is missing beyond them.

    Returns:
        As :func:`scan`.
    """
    if state is None:
        state = initial_state(experiment, {side: measured[side][0] for side in experiment.sides})
    state = dataclasses.replace(state, plant=None)

    columns = torque, {side: measured[side] for side in experiment.sides}, added_accelerations
    return _scan(
        experiment, initial_carry(experiment, reducers, state), len(torque),
        lambda indices: (None, *jax.tree.map(lambda column: column[indices], columns)), reducers, record, stride
    )  # fmt: skip


def _scan(
    experiment: Experiment,
    carry: Carry,
    steps: int,
    sample_inputs: Callable[[Int[Array, " samples"]], tuple[Any, ...]],
    reducers: Reducers,
    record: Callable[[State, Signals], Any] | None,
    stride: int,
) -> tuple[TracedArrays, Any]:
    """Loop over time, block by block; `sample_inputs(indices)` returns the inputs of :func:`advance_sample` for a block."""

    def run_sample(carry: Carry, inputs: tuple[Array, tuple[Any, ...]]) -> tuple[Carry, Any]:
        carry, signals = advance_sample(experiment, reducers, carry, inputs[0], *inputs[1])
        return carry, None if record is None else record(carry[0], signals)

    def run_block(carry: Carry, first: Array, length: int) -> tuple[Carry, Any]:
        indices = first + jnp.arange(length, dtype=jnp.int32)
        carry, trace = jax.lax.scan(run_sample, carry, (indices, sample_inputs(indices)))
        return end_block(experiment, carry), jax.tree.map(lambda x: x[::stride], trace)

    length = block_length(steps) if record is None or stride == 1 else stride
    blocks, remaining = divmod(steps, length)
    carry, trace = jax.lax.scan(
        lambda carry, i: run_block(carry, i * length, length), carry, jnp.arange(blocks, dtype=jnp.int32)
    )
    trace = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), trace)
    if remaining:
        carry, end = run_block(carry, jnp.asarray(blocks * length, jnp.int32), remaining)
        trace = jax.tree.map(lambda *parts: jnp.concatenate(parts), trace, end)
    return compute_metrics(experiment, reducers, carry), trace


def correct_by_readings(state: PlantState, readings: TracedArrays, gain: dict[str, Any]) -> PlantState:
    """Correct positions and velocities by `gain` (1, and 1/s) times the prediction error of each side's reading (rad)."""
    errors = {side: readings[side] - state.position[side] for side in gain}
    position = {side: state.position[side] + gain[side][0] * errors[side] for side in gain}
    velocity = {side: state.velocity[side] + gain[side][1] * errors[side] for side in gain}
    return PlantState(state.position | position, state.velocity | velocity, state.effects)


def plant_trajectory(
    experiment: Experiment,
    start: PlantState,
    torque: Float[Array, " samples"],
    time: Scalar = 0.0,
    measured: dict[str, Float[Array, " samples"]] | None = None,
    gain: dict[str, Float[Array, " 2"]] | None = None,
) -> PlantState:
    """Simulate the plant alone under a recorded input, freely or as a predictor.

    Args:
        experiment: with array leaves.
        start: state at the first sample.
        torque: input, N m, held from each sample to the next, shape (samples,).
        time: of the first sample, s.
        measured: position of each side, rad, shape (samples,). With `gain`, each state is then the prediction from the
            samples before it.
        gain: by side, factors of the prediction error in the corrections of position (1) and velocity (1/s).

    Returns:
        The states at the samples, with a leading time axis.
    """
    plant, run = experiment.plant, experiment.run

    def predict_sample(state: PlantState, inputs: tuple[Array, Array, TracedArrays]) -> tuple[PlantState, PlantState]:
        index, torque, readings = inputs
        t = time + index.astype(torque.dtype) * run.sample_period
        return move_plant(plant, run, correct_by_readings(state, readings, gain or {}), torque, t), state

    readings = measured if measured and gain else {}
    _, states = jax.lax.scan(predict_sample, start, (jnp.arange(len(torque), dtype=jnp.int32), torque, readings))
    return states
