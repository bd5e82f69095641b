"""One experiment through time: drive, encoders, observers, equivalent control and identifier in one step function.

:func:`step` is the whole chain for one sample of one lane; `vmap` makes it many. One loop over time calls it, with or
without a trace, with any reducers: :func:`scan` for simulated and :func:`replay` for recorded positions.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .drive.effects import AbstractEffect
from .drive.encoders import Encoders
from .drive.excitation import AbstractExcitation
from .drive.parameters import Scalar, option, parameter
from .drive.plant import AbstractDrive, Initial, Plant, PlantState
from .drive.transmission import AbstractTransmission
from .observer.base import Observers, ObserverState
from .observer.equivalent_control import EquivalentControl
from .observer.recursive import Identifier, IdentifierState

UNROLL_SUBSTEPS = False
# unrolled, XLA fuses each substep with copies of all before it: quadratic work (benchmarks/NOTES.md)

Number = Any  # an array of one number a lane: Float[Array, ""] inside a step


class Run(eqx.Module):
    """Time grid and tolerances."""

    sample_period: Scalar = parameter("s", "period of encoders, observers, identifier", default=1e-3, above=0.0, fixed=True)
    steps: int = eqx.field(static=True, default=20_000)
    # the largest frequency of a drive that is still to be resolved at 1 ms is then 2e8 rad/s
    substeps: int = option("plant steps per sample", default=10, minimum=1, maximum=100_000)
    position_tolerance: Scalar = parameter(
        "rad", "largest position error of a converged observer (load: divided by the gear ratio)", default=1e-3, above=0.0
    )
    velocity_tolerance: Scalar = parameter(
        "rad/s", "largest velocity error of a converged observer (load: divided by the gear ratio)", default=0.05, above=0.0
    )


class Experiment(eqx.Module):
    """A drive, its input, its sensors and what observes it. Every number is a leaf named by its config path."""

    drive: AbstractDrive
    transmission: AbstractTransmission | None
    effects: tuple[AbstractEffect, ...]
    initial: Initial
    excitation: AbstractExcitation
    encoders: Encoders
    observer: Observers
    equivalent_control: EquivalentControl
    identifier: Identifier | None
    run: Run

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
    """What the loop over time carries."""

    plant: PlantState | None
    observer: dict[str, ObserverState]
    equivalent_control: dict[str, Number]
    identifier: IdentifierState | None


class Sample(NamedTuple):
    """What a step is given: time, and either unit noise (simulation) or input and measured positions (a record).

    With unit noise, an `input` (N m) takes the place of the excitation's. `known` (rad/s^2) are accelerations by side that
    the observers add to their nominal ones, held from each sample to the next.
    """

    time: Number
    noise: dict[str, Number] | None = None
    input: Number | None = None
    measured: dict[str, Number] | None = None
    known: dict[str, Number] | None = None


class TrueSide(NamedTuple):
    """What only the simulator knows of a side: position (rad), velocity (rad/s), the mean acceleration (rad/s^2) from
    this sample to the next, and the right-hand side error f(x_2) - f(x_2_hat) + xi (rad/s^2) of the observer."""

    position: Number
    velocity: Number
    acceleration: Number
    perturbation: Number


class SideSignals(NamedTuple):
    """One side at one sample, SI units: reading, estimates, filtered equivalent control (rad/s^2), the transmitted torque
    that this stands for (17) (N m), and the truth (None on a record)."""

    measured: Number
    position_estimate: Scalar
    velocity_estimate: Scalar
    equivalent_control: Number
    torque_estimate: Number
    true: TrueSide | None


class Signals(NamedTuple):
    """All signals at one sample: time (s), input (N m), twist z (rad), transmitted torque C (N m), and the sides.

    On a rigid drive `torque` is everything that resists beyond the nominal model, and `twist` is None.
    """

    time: Number
    input: Number
    twist: Number | None
    torque: Number | None
    motor: SideSignals
    load: SideSignals | None

    def side(self, side: str) -> SideSignals:
        return self.motor if side == "motor" else self.load  # type: ignore[return-value]


def initial_state(experiment: Experiment, measured: dict[str, Number] | None = None) -> State:
    """State at t = 0; for a record, from its first measured positions (rad) and standstill."""
    zero = jnp.zeros_like(jnp.asarray(experiment.run.sample_period))
    rest = dict.fromkeys(experiment.sides, zero)
    plant = experiment.plant.init(experiment.initial) if measured is None else None
    position, velocity = measured or {}, rest
    if plant is not None:
        velocity = plant.velocity
        position = {side: experiment.plant.read(side, plant.position[side], velocity[side]) for side in experiment.sides}
    observers = {side: getattr(experiment.observer, side) for side in experiment.sides}
    observer = {
        side: observer_state(experiment, side, position[side] - o.position_error, velocity[side] - o.velocity_error)
        for side, o in observers.items()
    }
    identifier = None
    if experiment.identifier is not None and experiment.transmission is not None:
        identifier = experiment.identifier.init(experiment.transmission, experiment.sides, zero)
    return State(plant, observer, rest, identifier)


def observer_state(experiment: Experiment, side: str, position: Scalar, velocity: Scalar) -> ObserverState:
    """A side's observer before the first sample, for which it predicts a position (rad) and a velocity (rad/s)."""

    def nominal(velocity: Number) -> Number:
        return experiment.drive.acceleration(side, velocity, jnp.zeros_like(velocity))

    return getattr(experiment.observer, side).start(position, velocity, nominal, experiment.run.sample_period)


def step(experiment: Experiment, state: State, sample: Sample) -> tuple[State, Signals]:
    """The whole chain for one sample: sense, observe, filter, identify, and move the plant on to the next sample."""
    drive, plant, period = experiment.drive, experiment.plant, experiment.run.sample_period
    before: Any = state.plant  # None on a record
    torque_in: Any = experiment.excitation(sample.time) if sample.input is None else sample.input
    if sample.noise is None:
        measured, moved = sample.measured or {}, None
    else:
        noise = {side: value.astype(jnp.result_type(period)) for side, value in sample.noise.items()}
        measured = {
            side: experiment.encoders.measure(
                side, plant.read(side, before.position[side], before.velocity[side]), noise[side], drive.ratio(side)
            )
            for side in drive.sides
        }
        moved = move(plant, experiment.run, before, torque_in, sample.time)

    observers, filtered, estimates = {}, {}, {}
    for side in drive.sides:

        def nominal(velocity: Number, side: str = side) -> Number:
            expected = drive.acceleration(side, velocity, torque_in)
            return expected if sample.known is None else expected + sample.known[side]

        observer = getattr(experiment.observer, side)
        observers[side], estimates[side] = observer.step(state.observer[side], measured[side], nominal, period)
        filtered[side] = experiment.equivalent_control.filter(
            state.equivalent_control[side], estimates[side].control, period
        )
    torques = {side: drive.inertia(side) * filtered[side] / drive.torque_gain(side) for side in drive.sides}

    identifier = state.identifier
    twist = plant.twist(measured) if len(drive.sides) == 2 else None
    if identifier is not None:
        assert experiment.identifier is not None and experiment.transmission is not None and twist is not None
        identifier = experiment.identifier.step(
            identifier, experiment.transmission, experiment.equivalent_control, twist, torques, sample.time, period
        )

    sides = {}
    for side in drive.sides:
        estimate = estimates[side]
        true = None
        if moved is not None:
            acceleration = (moved.velocity[side] - before.velocity[side]) / period
            perturbation = acceleration - drive.acceleration(side, estimate.velocity, torque_in)
            true = TrueSide(before.position[side], before.velocity[side], acceleration, perturbation)
        sides[side] = SideSignals(measured[side], estimate.position, estimate.velocity, filtered[side], torques[side], true)
    torque = None
    if moved is not None and experiment.transmission is not None:
        torque, _ = plant.transmitted(before.position, before.velocity, before.effects)
    elif moved is not None:
        expected = drive.acceleration("motor", before.velocity["motor"], torque_in)
        torque = drive.inertia("motor") * (expected - sides["motor"].true.acceleration)
    signals = Signals(sample.time, torque_in, twist, torque, sides["motor"], sides.get("load"))
    return State(moved, observers, filtered, identifier), signals


def move(plant: Plant, run: Run, state: PlantState, torque: Scalar, time: Number) -> PlantState:
    """The plant from one sample to the next, in `substeps` steps under a held input."""
    small = run.sample_period / run.substeps
    effects, arriving = plant.receive(state.effects, torque, run.sample_period)
    state = PlantState(state.position, state.velocity, effects)

    def substep(i: Int[Array, ""], state: PlantState) -> PlantState:
        return plant.advance(state, arriving(i * small, small), time + i * small, small)

    if run.substeps == 1:
        return substep(jnp.asarray(0), state)
    return jax.lax.fori_loop(0, run.substeps, substep, state, unroll=UNROLL_SUBSTEPS)


class Reducer(NamedTuple):
    """A figure over a whole run, computed as it goes: memory does not grow with duration.

    `init(experiment)` gives the carry, `update(experiment, carry, index, signals)` takes in sample `index`, and
    `result(experiment, carry, state)` gives a dict of numbers from the last carry and the last state. `done(experiment,
    carry, state)`, where there is one, says that no further sample can change them: a lane may then stop.
    """

    init: Callable[[Experiment], Any]
    update: Callable[[Experiment, Any, Int[Array, ""], Signals], Any]
    result: Callable[[Experiment, Any, State], dict[str, Array]]
    done: Callable[[Experiment, Any, State], Array] | None = None


def unit_noise(seed: Int[Array, ""], indices: Int[Array, " samples"], sides: tuple[str, ...]) -> dict[str, Array]:
    """Common random numbers: standard normal noise of each side, a function of seed and sample index alone.

    Drawn in float32 whatever the precision of the run, so that both precisions see the same noise.
    """
    key = jax.random.key(seed)
    keys = jax.vmap(lambda index: jax.random.fold_in(key, index))(indices)
    draws = jax.vmap(lambda key: jax.random.normal(key, (2,), jnp.float32))(keys)
    return {side: draws[:, i] for i, side in enumerate(sides)}


LONGEST_BLOCK = 512
"""Samples whose noise is drawn at once, at most."""


def block_length(steps: int) -> int:
    """Samples whose noise is drawn at once: the largest divisor of `steps` up to the longest block, or 256 with a rest."""
    divisors = [n for n in range(64, LONGEST_BLOCK + 1) if steps % n == 0]
    return divisors[-1] if divisors else min(256, steps)


Carry = tuple[State, tuple[Any, ...]]
"""The state of the chain, and each reducer's carry."""


def begin(experiment: Experiment, reducers: tuple[Reducer, ...], state: State | None = None) -> Carry:
    """What the loop over time starts from."""
    return initial_state(experiment) if state is None else state, tuple(r.init(experiment) for r in reducers)


def advance(
    experiment: Experiment, reducers: tuple[Reducer, ...], carry: Carry, index: Int[Array, ""], *given: Any
) -> tuple[Carry, Signals]:
    """One sample further: state, reducers, and the signals at sample `index`. `given` is a :class:`Sample` without its time:
    of a simulation the unit noise of each side."""
    state, totals = carry
    period = experiment.run.sample_period
    state, signals = step(experiment, state, Sample(index.astype(jnp.result_type(period)) * period, *given))
    return (state, tuple(r.update(experiment, t, index, signals) for r, t in zip(reducers, totals, strict=True))), signals


def end_of_block(experiment: Experiment, carry: Carry) -> Carry:
    """What goes from one block of samples to the next: sums in float32 lose nothing over more than some thousand samples."""
    state, totals = carry
    if experiment.identifier is None or state.identifier is None:
        return carry
    return eqx.tree_at(lambda s: s.identifier, state, experiment.identifier.settle(state.identifier)), totals


def figures(experiment: Experiment, reducers: tuple[Reducer, ...], carry: Carry) -> dict[str, Array]:
    """The reducers' figures from the last carry."""
    state, totals = carry
    found: dict[str, Array] = {}
    for reducer, total in zip(reducers, totals, strict=True):
        found |= reducer.result(experiment, total, state)
    return found


def done(experiment: Experiment, reducers: tuple[Reducer, ...], carry: Carry) -> Array | None:
    """Whether no further sample can change the figures; None where a reducer cannot know."""
    state, totals = carry
    each = [r.done(experiment, total, state) for r, total in zip(reducers, totals, strict=True) if r.done is not None]
    return functools.reduce(jnp.logical_and, each) if each and len(each) == len(reducers) else None


def scan(
    experiment: Experiment,
    seed: Int[Array, ""],
    reducers: tuple[Reducer, ...] = (),
    record: Callable[[State, Signals], Any] | None = None,
    every: int = 1,
) -> tuple[dict[str, Array], Any]:
    """Simulate one experiment.

    Args:
        experiment: with array leaves (:func:`jaxbl.drive.as_arrays`).
        seed: seed of the encoder noise.
        reducers: figures to compute along the run.
        record: what to keep of every `every`-th sample; None keeps nothing.
        every: decimation of the record.

    Returns:
        The reducers' figures, and the record with a leading time axis (None without one).
    """

    def samples(indices: Int[Array, " samples"]) -> tuple[dict[str, Array], ...]:
        return (unit_noise(seed, indices, experiment.sides),)

    return _scan(experiment, begin(experiment, reducers), experiment.run.steps, samples, reducers, record, every)


def replay(
    experiment: Experiment,
    torque: Float[Array, " samples"],
    measured: dict[str, Float[Array, " samples"]],
    reducers: tuple[Reducer, ...] = (),
    record: Callable[[State, Signals], Any] | None = None,
    every: int = 1,
    state: State | None = None,
    known: dict[str, Float[Array, " samples"]] | None = None,
) -> tuple[dict[str, Array], Any]:
    """Run observers, filter and identifier on a record in place of the plant.

    Args:
        experiment: with array leaves; its sample period is that of the record.
        torque: input in N m.
        measured: positions of each side in rad.
        reducers, record, every: as of :func:`scan`.
        state: where to begin; left out, at the first position and standstill.
        known: of each sample, as of :class:`Sample`; the equivalent control is then what is missing beyond these, too.

    Returns:
        As :func:`scan`.
    """
    if state is None:
        state = initial_state(experiment, {side: measured[side][0] for side in experiment.sides})
    state = State(None, state.observer, state.equivalent_control, state.identifier)

    def samples(indices: Int[Array, " samples"]) -> tuple[Any, ...]:
        given = torque, {side: measured[side] for side in experiment.sides}, known
        return None, *jax.tree.map(lambda column: column[indices], given)

    return _scan(experiment, begin(experiment, reducers, state), len(torque), samples, reducers, record, every)


def _scan(
    experiment: Experiment,
    start: Carry,
    steps: int,
    samples: Callable[[Int[Array, " samples"]], tuple[Any, ...]],
    reducers: tuple[Reducer, ...],
    record: Callable[[State, Signals], Any] | None,
    every: int,
) -> tuple[dict[str, Array], Any]:
    """The loop over time; `samples` gives what :func:`advance` is given for the samples of a block."""

    def sample(carry: Carry, given: tuple[Array, tuple[Any, ...]]) -> tuple[Carry, Any]:
        carry, signals = advance(experiment, reducers, carry, given[0], *given[1])
        return carry, None if record is None else record(carry[0], signals)

    def block(carry: Carry, first: Array, length: int) -> tuple[Carry, Any]:
        indices = first + jnp.arange(length, dtype=jnp.int32)
        carry, kept = jax.lax.scan(sample, carry, (indices, samples(indices)))
        return end_of_block(experiment, carry), jax.tree.map(lambda x: x[::every], kept)

    length = block_length(steps) if record is None or every == 1 else every
    blocks, rest = divmod(steps, length)
    carry, kept = jax.lax.scan(lambda carry, i: block(carry, i * length, length), start, jnp.arange(blocks, dtype=jnp.int32))
    kept = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), kept)
    if rest:
        carry, last = block(carry, jnp.asarray(blocks * length, jnp.int32), rest)
        kept = jax.tree.map(lambda *parts: jnp.concatenate(parts), kept, last)
    return figures(experiment, reducers, carry), kept


def corrected(state: PlantState, readings: dict[str, Array], gain: dict[str, Any]) -> PlantState:
    """A state after a look at the encoders: positions (1) and velocities (1/s) moved by gains times prediction errors."""
    errors = {side: readings[side] - state.position[side] for side in gain}
    return PlantState(
        {side: value + gain[side][0] * errors[side] if side in gain else value for side, value in state.position.items()},
        {side: value + gain[side][1] * errors[side] if side in gain else value for side, value in state.velocity.items()},
        state.effects,
    )


def trajectory(
    experiment: Experiment,
    start: PlantState,
    torque: Float[Array, " samples"],
    time: Scalar = 0.0,
    measured: dict[str, Float[Array, " samples"]] | None = None,
    gain: dict[str, Float[Array, " 2"]] | None = None,
) -> PlantState:
    """The plant alone under a recorded input: its states at the samples, with a leading time axis.

    Args:
        experiment: with array leaves.
        start: state at the first sample.
        torque: input in N m, held from each sample to the next.
        time: time of the first sample in s.
        measured: positions of each side in rad, to predict from: each state is then what follows from the samples before.
        gain: by which a prediction error corrects position (1) and velocity (1/s) of its side; needs `measured`.
    """
    plant, run = experiment.plant, experiment.run

    def sample(state: PlantState, given: tuple[Array, Array, dict[str, Array]]) -> tuple[PlantState, PlantState]:
        index, torque, readings = given
        at = time + index.astype(torque.dtype) * run.sample_period
        return move(plant, run, corrected(state, readings, gain or {}), torque, at), state

    samples = jnp.arange(len(torque), dtype=jnp.int32), torque, measured if measured is not None and gain is not None else {}
    _, states = jax.lax.scan(sample, start, samples)
    return states
