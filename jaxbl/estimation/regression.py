"""Equations of motion at known kinematics: torques that they leave over.

All torques pass one decimation filter.
Reference: A. Janot, M. Gautier, M. Brunot, Data set and reference models of EMPS, Workshop on Nonlinear System
Identification Benchmarks (2019).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbl.chain import Experiment, with_effects
from jaxbl.drive.effects import AbstractEffect
from jaxbl.drive.plant import EffectStates, Plant, PlantState
from jaxbl.fused.compilation import jit
from jaxbl.records.least_squares import BlockRegression, mean_error

Samples = Float[Array, " samples"]
SideSamples = dict[str, Samples]
"""A number a sample, of each side."""


class Path(eqx.Module):
    """Signals along a log that effects depend on.

    Attributes:
        time: s, shape (samples,).
        torque: commanded, N m, shape (samples,).
        position, velocity: of each side, rad and rad/s, shape (samples,).
        before: commanded before the first sample, N m, shape (earlier,); None where that is not known.
    """

    time: Samples
    torque: Samples
    position: SideSamples
    velocity: SideSamples
    before: Float[Array, " earlier"] | None = eqx.field(default=None, kw_only=True)


class Kinematics(Path):
    """Part of a record without gaps, with derivatives; its torque is the mean over the period around each sample.

    Attributes:
        acceleration: of each side, rad/s^2, shape (samples,).
        transmitted: measured transmitted torque in N m, shape (samples,), or None.
    """

    acceleration: SideSamples
    transmitted: Samples | None = None


class Balance(NamedTuple):
    """One equation of the drive along a record.

    Attributes:
        residual: torque that the equation leaves over, N m, shape (samples,).
        drive: torque that drives the side (input or transmitted torque; the measured one for the transmission), N m.
    """

    residual: Samples
    drive: Samples


def balance(experiment: Experiment, kinematics: Kinematics) -> dict[str, Balance]:
    """Equations of motion at known kinematics, by name: each side, and `transmission` where its torque was measured.

    A side's residual is the torque that the model has too much there: all torques less inertia times acceleration.
    """
    plant, drive, k = experiment.plant, experiment.drive, kinematics
    states, torque = effect_path(experiment, k)
    balances, through = {}, None if plant.transmission is None else transmit(plant, k, states)
    if k.transmitted is not None and through is not None:
        balances["transmission"] = Balance(k.transmitted - through, k.transmitted)
    through = through if k.transmitted is None else k.transmitted
    acting = jax.vmap(plant.side_torques)(k.position, k.velocity, states, torque, k.time, k.transmitted)
    for side, (total, level) in acting.items():
        resisting = drive.viscous(side) * k.velocity[side] + level * jnp.sign(k.velocity[side])
        driving = torque if side == "motor" or through is None else drive.torque_gain(side) * through
        balances[side] = Balance(total - resisting - plant.inertia(side) * k.acceleration[side], driving)
    return balances


@jit
def model_torques(experiment: Experiment, kinematics: Kinematics, deviation: SideSamples) -> dict[str, Samples]:
    """Torques by a model at known kinematics, N m: `torque` in the gear, and `SIDE.effects`, what effects take there if the
    side has any.

    Within the standard deviation of the velocities, rad/s, dry friction goes through zero.
    """
    plant, k, torques = experiment.plant, kinematics, {}
    states, torque = effect_path(experiment, k)
    loaded: Any = 0.0
    if plant.transmission is not None:
        torques["torque"] = transmit(plant, k, states)
        loaded = plant.gear_friction(states, torques["torque"])
    none = jnp.zeros_like(k.torque)
    acting = jax.vmap(plant.side_torques)(k.position, k.velocity, states, torque, k.time, none)
    places = {plant.drive.resolve_place(effect.place) for effect in plant.effects}
    if "actuator" in places or not isinstance(loaded, float):
        places.add("motor")
    for side, (total, level) in acting.items():
        if side not in places:
            continue
        commanded, more = (k.torque, loaded) if side == "motor" else (0.0, 0.0)
        direction = jnp.clip(k.velocity[side] / jnp.maximum(3.0 * deviation[side], jnp.finfo(float).tiny), -1.0, 1.0)
        added = (plant.inertia(side) - plant.drive.inertia(side)) * k.acceleration[side]
        torques[f"{side}.effects"] = (level + more) * direction + commanded - total + added
    return torques


@jit
def find_transmitted(experiment: Experiment, k: Kinematics) -> Samples:
    """Transmitted torque by a model at known kinematics, N m."""
    gear = with_effects(experiment, tuple(effect for effect in experiment.effects if effect.place == "transmission"))
    return transmit(gear.plant, k, effect_path(gear, k)[0])


def transmit(plant: Plant, k: Kinematics | PlantState, states: EffectStates) -> Samples:
    """Transmitted torque along a motion with these states of effects, N m."""
    return jax.vmap(plant.transmitted_torque)(k.position, k.velocity, states)[0]


def settle_states(experiment: Experiment, torque: Float[Array, ""]) -> EffectStates:
    """The effects' own states after an input (N m) that has lasted."""
    # as of their classes: of a method of a module equinox makes a module
    return tuple(type(effect).settled(effect, torque) for effect in experiment.effects)


def _receive(plant: Plant, states: EffectStates, torque: Array, period: Any) -> tuple[EffectStates, Array]:
    """The effects' own states once an input (N m) has arrived, and the torque that acts."""
    new, arriving = plant.receive(states, torque, period)
    return plant.actuate(new, arriving(0.0, period), period)


def remembers_input(effect: AbstractEffect) -> bool:
    """Return True if an effect depends on inputs before a log's first sample."""
    return effect.place == "actuator" and bool(jax.tree.leaves(type(effect).init(effect)))


@jit
def begin_states(
    experiment: Experiment,
    torque: Samples,
    before: Float[Array, " earlier"] | None = None,
    from_rest: bool = False,
) -> EffectStates:
    """The effects' own states at the first sample.

    Args:
        experiment: the model, at the period of the inputs.
        torque: input from the first sample on, N m, shape (samples,).
        before: the input before it, N m, shape (earlier,), where it is known.
        from_rest: whether nothing had happened before the first input known; else that one had lasted.
    """
    plant, period = experiment.plant, experiment.run.sample_period
    first = torque[0] if before is None else before[0]
    start = tuple(type(effect).init(effect) for effect in plant.effects) if from_rest else settle_states(experiment, first)
    start = jax.tree.map(lambda x: jnp.asarray(x, torque.dtype), start)
    if before is None or not any(map(remembers_input, plant.effects)):
        return start

    return jax.lax.scan(lambda states, torque: (_receive(plant, states, torque, period)[0], None), start, before)[0]


@jit
def effect_path(experiment: Experiment, path: Path, from_rest: bool = False) -> tuple[EffectStates, Samples]:
    """The effects' own states at each sample of a known motion, and the torque (N m) that acts; they begin as
    :func:`begin_states` says."""
    plant, period = experiment.plant, experiment.run.sample_period
    speeds = {side: speed[0] for side, speed in path.velocity.items()}
    start = tuple(
        type(effect).set_in_motion(effect, state, speeds[place])
        if (place := plant.drive.resolve_place(effect.place)) in speeds
        else state
        for effect, state in zip(plant.effects, begin_states(experiment, path.torque, path.before, from_rest), strict=True)
    )
    if not plant.has_memory and all(effect.place != "actuator" for effect in plant.effects):
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (len(path.torque), *x.shape)), start), path.torque
    motion = ()
    if plant.has_memory:
        # memory follows the way covered
        steps = {side: jnp.diff(x, append=x[-1:]) / period for side, x in path.position.items()}
        motion = path.position, steps, path.time

    def sample(states: EffectStates, row: tuple[Any, Any]) -> tuple[EffectStates, tuple[EffectStates, Array]]:
        torque, motion = row
        new, acting = _receive(plant, states, torque, period)
        return plant.advance_effects(new, *motion, step=period) if motion else new, (states, acting)

    return jax.lax.scan(sample, start, (path.torque, motion))[1]


def effect_states(experiment: Experiment, path: Path) -> EffectStates:
    """The effects' own states at each sample of a known motion, by :func:`effect_path` unless there are none."""
    none = settle_states(experiment, path.torque[0])
    return effect_path(experiment, path)[0] if jax.tree.leaves(none) else none


def decimate(values: Samples, factor: int) -> Float[Array, " less"]:
    """Zero-phase low-pass (Hamming window) and every `factor`-th sample, but for the ends, where the filter does not fit."""
    if factor == 1:
        return values
    from scipy.signal import firwin

    return jnp.convolve(values, jnp.asarray(firwin(20 * factor + 1, 1.0 / factor), values.dtype), "valid")[::factor]


def decimate_balances(experiment: Experiment, parts: Sequence[Kinematics], factor: int) -> dict[str, Balance]:
    """Equations of motion after decimation, all parts one after the other."""
    balances = [jit(balance)(experiment, part) for part in parts]
    pieces = jax.tree.map(lambda torque: decimate(torque, factor), balances)
    return jax.tree.map(lambda *torques: jnp.concatenate(torques), *pieces) if pieces else {}


class MotionShare(NamedTuple):
    """Torque that an equation leaves over, and that goes with the motion.

    Attributes:
        equation: name of the side.
        channel: what it goes with.
        share: of its power, in parts of the log that did not choose.
    """

    equation: str
    channel: str
    share: float


_BLOCKS, _BINS, _SURE = 10, 8, 3.0
"""Parts of a log, ranges of a channel, and standard errors by which a torque surely goes with it: as for the terms of a
transmission on a rig."""


def find_motion_share(experiment: Experiment, parts: Sequence[Kinematics], factor: int) -> MotionShare | None:
    """Find whether torque that is left over goes with speed or position: that of frictions and loads does, noise does not.

    What goes with acceleration, twist or input is no sign: smoothed motion lacks some of it, too. The channel with the
    largest share, of those that surely predict the torque in each tenth of the log by its means in eight ranges in the other
    tenths; None if there is none.
    """
    shares = []
    for side, equation in decimate_balances(experiment, parts, factor).items():
        torque = np.asarray(equation.residual)
        # in each range and block some samples
        if side not in experiment.sides or len(torque) < 2 * _BLOCKS * _BINS:
            continue
        for name in ("velocity", "position"):
            values = np.concatenate([decimate(jnp.asarray(getattr(part, name)[side]), factor) for part in parts])
            ranges = np.eye(_BINS)[np.searchsorted(np.quantile(values, np.arange(1, _BINS) / _BINS), values)]
            regression = BlockRegression.of(torque - np.mean(torque), ranges, _BLOCKS)
            # power that its means over ranges predict, in each block from the others
            gains = regression.held_out(np.zeros((_BLOCKS, _BINS))) - regression.held_out()
            if np.mean(gains) > _SURE * mean_error(gains):
                shares.append(MotionShare(side, name, float(np.mean(gains) / np.var(torque))))
    return max(shares, key=lambda share: share.share, default=None)
