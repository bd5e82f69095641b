"""The equations of motion (1)-(2) with a transmission law and any effects, and their integration over one time step.

    J_e dv_e/dt = u - f_e v_e - C - (effects on the motor)
    J_s dv_s/dt = N_0 C - f_s v_s - (effects on the load)

The integrator is Moreau's midpoint rule: drift half a step, kick, drift half a step. The kick takes the transmitted torque
C at the midpoint and viscous friction implicitly. Dry friction is a set-valued law: a side sticks exactly while the other
torques stay below the friction level. Within a step a side comes to rest, or turns around, at the time at which its velocity
passes zero. (Moreau's rule projects at the end of the step; friction of one sign would then act over all of it.) Without dry
friction this is the Stoermer-Verlet scheme: second order, symplectic, one evaluation of the law a step.
benchmarks/integrators.py compares it with others.

References: J. J. Moreau, Numerical aspects of the sweeping process, CMAME 177 (1999); V. Acary, B. Brogliato, Numerical
Methods for Nonsmooth Dynamical Systems, Springer (2008), ch. 10.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxbl.registry import Registry, check_module

from .effects import AbstractEffect, ActuatorEffect, EncoderEffect, Motion
from .parameters import Scalar, ScalarArray, parameter
from .transmission import AbstractTransmission

SideValues = dict[str, ScalarArray]
"""One number for each side of the drive: keys "motor" and, on two inertias, "load"."""
EffectStates = tuple[Any, ...]
"""The state of each effect, in the order of the effects."""


class AbstractDrive(eqx.Module):
    """Nominal inertias and viscous frictions of the sides. A linear axis has kg, N, m in place of kg m^2, N m, rad.

    Attributes:
        name: key `kind` of the config.
        sides: those with an encoder and an observer: "motor", on which the input acts, and, on two inertias, "load".
        hidden: further bodies of a drive of one's own, which no encoder sees.
    """

    name: ClassVar[str]
    sides: ClassVar[tuple[str, ...]]
    hidden: ClassVar[tuple[str, ...]] = ()

    @property
    def bodies(self) -> tuple[str, ...]:
        """All that moves."""
        return self.sides + self.hidden

    def body_torques(self, position: SideValues, velocity: SideValues) -> SideValues:
        """Torques by which the bodies act on each other beside a transmission, N m, by body; none on drives of two inertias.

        Args:
            position, velocity: of the bodies, rad and rad/s.
        """
        return {}

    def inertia(self, side: str) -> Scalar:
        """Nominal inertia, kg m^2."""
        return getattr(self, f"{side}_inertia")

    def viscous(self, side: str) -> Scalar:
        """Nominal viscous friction, N m s/rad."""
        return getattr(self, f"{side}_viscous")

    def torque_gain(self, side: str) -> Scalar:
        """Factor of the transmitted torque C in the side's equation of motion: -1 on the motor, N_0 on the load."""
        return -1.0 if side == "motor" else self.ratio(side)

    def ratio(self, side: str) -> Scalar:
        """Motor angle for one unit of the side's angle."""
        return 1.0

    def resolve_place(self, place: str) -> str:
        """Return the place of this drive at which effects of `place` act."""
        return place

    def acceleration(self, side: str, velocity: Scalar, torque: Scalar) -> Scalar:
        """Nominal acceleration f(x_2, u) of the observers (7), without transmitted torque, rad/s^2.

        Args:
            side: "motor" or "load".
            velocity: of the side, rad/s.
            torque: the input u, N m, which acts on the motor only.
        """
        driving = torque if side == "motor" else 0.0
        return (driving - self.viscous(side) * velocity) / self.inertia(side)


def _check_drive(name: str, cls: Any) -> None:
    check_module(name, cls, AbstractDrive)
    if "motor" not in getattr(cls, "sides", ()):
        raise ValueError("its sides should have 'motor', on which the input acts")


DRIVES = Registry("jaxbl.drives", _check_drive)
"""Drives by the key `kind` of the config, those of installed packages included."""


@DRIVES.add
class TwoInertia(AbstractDrive):
    """Motor and load, connected by a gear: J_e dv_e/dt = u - f_e v_e - C, J_s dv_s/dt = N_0 C - f_s v_s (1)."""

    name = "two_inertia"
    sides = ("motor", "load")
    motor_inertia: Scalar = parameter("kg m²", "motor inertia J_e", above=0.0)
    motor_viscous: Scalar = parameter("N m s/rad", "motor viscous friction f_e", minimum=0.0)
    load_inertia: Scalar = parameter("kg m²", "load inertia J_s", above=0.0)
    load_viscous: Scalar = parameter("N m s/rad", "load viscous friction f_s", minimum=0.0)
    # on a linear axis, rad for one m: a screw with a lead of a micrometre has 6e6
    gear_ratio: Scalar = parameter("", "gear ratio N_0: motor turns for one load turn", minimum=1e-7, maximum=1e7)

    def ratio(self, side):
        return 1.0 if side == "motor" else self.gear_ratio


@DRIVES.add
class Rigid(AbstractDrive):
    """One inertia: J_e dv_e/dt = u - f_e v_e - (effects). Effects of motor and load act on it; all else is disturbance."""

    name = "rigid"
    sides = ("motor",)
    motor_inertia: Scalar = parameter("kg m²", "inertia (a mass in kg on a linear axis)", above=0.0)
    motor_viscous: Scalar = parameter("N m s/rad", "viscous friction", minimum=0.0)

    def resolve_place(self, place):
        return "motor" if place == "load" else place


class Initial(eqx.Module):
    """Positions and velocities at t = 0; `load_*` have no meaning on a rigid drive."""

    motor_position: Scalar = parameter("rad", "motor position at t = 0", default=0.0)
    motor_velocity: Scalar = parameter("rad/s", "motor velocity at t = 0", default=0.0)
    load_position: Scalar = parameter("rad", "load position at t = 0", default=0.0)
    load_velocity: Scalar = parameter("rad/s", "load velocity at t = 0", default=0.0)

    def of(self, body: str, quantity: str) -> Any:
        """Return the position (rad) or velocity (rad/s) of a body; further bodies of a drive of one's own begin at 0."""
        name = f"{body}_{quantity}"
        return getattr(self, name) if hasattr(self, name) else 0.0 * self.motor_position


class PlantState(eqx.Module):
    """Positions (rad) and velocities (rad/s) of the sides, and the states of the effects."""

    position: SideValues
    velocity: SideValues
    effects: EffectStates


class Plant(eqx.Module):
    """Drive, transmission law and effects together."""

    drive: AbstractDrive
    transmission: AbstractTransmission | None
    effects: tuple[AbstractEffect, ...] = ()

    def init(self, initial: Initial) -> PlantState:
        """Return the state at t = 0."""
        bodies = self.drive.bodies
        return PlantState(
            position={body: initial.of(body, "position") for body in bodies},
            velocity={body: initial.of(body, "velocity") for body in bodies},
            effects=tuple(effect.init() for effect in self.effects),
        )

    def inertia(self, side: str) -> Scalar:
        """True inertia of a side, kg m^2."""
        # the class is asked first: equinox makes a module of each method that is looked up on an effect
        heavy = [effect for effect in self.effects if type(effect).added_inertia is not AbstractEffect.added_inertia]
        added = [effect.added_inertia() for effect in heavy if self.drive.resolve_place(effect.place) == side]
        return self.drive.inertia(side) + sum(added)

    @property
    def half_gap(self) -> float:
        """Half of the free play of law and effects together, rad on the motor side; 0 without any."""
        gap = 0.0 if self.transmission is None else float(self.transmission.half_gap)
        return gap + sum(float(effect.free_play()) for effect in self.effects)

    def twist(self, position: SideValues) -> ScalarArray:
        """Twist of the transmission, z = theta_e - N_0 theta_s, rad."""
        return position["motor"] - self.drive.ratio("load") * position["load"]

    def transmitted_torque(
        self, position: SideValues, velocity: SideValues, states: EffectStates
    ) -> tuple[ScalarArray, Scalar]:
        """Transmitted torque C (N m) of law and effects, and the gear ratio at this position (N_0 without effects)."""
        assert self.transmission is not None
        deflection, rate, ratio = self._elastic_motion(position, velocity, states)
        torque = self.transmission.torque(deflection)
        for effect, state in self._effects_at("transmission", states):
            torque = torque + effect.transmit(state, deflection, rate)
        return torque, ratio

    def gear_friction(self, states: EffectStates, transmitted: Scalar) -> Scalar:
        """Level of the dry friction that the transmitted torque (N m) causes on the motor's side, N m.

        On a rigid drive that is the torque that gravity and other effects on the load take: how its inertia is divided is
        not known.
        """
        in_gear = self._effects_at("transmission", states)
        return sum((effect.gear_friction(state, transmitted) for effect, state in in_gear), 0.0)

    def load_torque(self, states: EffectStates, motion: Motion) -> Scalar:
        """Torque (N m) that gravity and other effects without a memory take on the load of a rigid drive."""
        pairs = zip(self.effects, states, strict=True)
        steady = [pair for pair in pairs if pair[0].place == "load" and type(pair[0]).advance is AbstractEffect.advance]
        return sum((effect.resist(state, motion) for effect, state in steady), 0.0)

    def _elastic_motion(
        self, position: SideValues, velocity: SideValues, states: EffectStates
    ) -> tuple[ScalarArray, Scalar, Scalar]:
        """Elastic deflection of the transmission (rad), its rate (rad/s), and the gear ratio at this position.

        A transmission error e adds e(theta_s) to the twist; the ratio is then N_0 - e'(theta_s), so that no power is lost.
        """
        effects = self._effects_at("transmission", states)
        ratio = self.drive.ratio("load")
        z = self.twist(position)
        rate = velocity["motor"] - ratio * velocity["load"]
        for effect, state in effects:
            error, slope = jax.jvp(
                lambda angle, effect=effect, state=state: jnp.asarray(effect.transmission_error(state, angle), angle.dtype),
                (position["load"],),
                (jnp.ones_like(position["load"]),),
            )
            z, rate, ratio = z + error, rate + slope * velocity["load"], ratio - slope

        def deflect(z):
            for effect, state in effects:
                z = effect.deflect(state, z)
            assert self.transmission is not None
            return self.transmission.deflection(z)

        deflection, rate = jax.jvp(deflect, (z,), (rate,))
        return deflection, rate, ratio

    def advance(self, state: PlantState, torque: Scalar, time: Scalar, step: Scalar) -> PlantState:
        """Integrate over one step of `step` seconds from `time` (s), with a commanded torque (N m) that is held.

        The states of effects advance with the positions: half a step before the kick, half a step after it. Effects that
        depend on a velocity see it at the beginning of the step (predictor), then its mean over the step (corrector).
        """
        states, torque = self.actuate(state.effects, torque, step)
        states = self.advance_effects(states, state.position, state.velocity, time, 0.5 * step)
        middle = {side: state.position[side] + 0.5 * step * state.velocity[side] for side in self.drive.bodies}
        middle_time = time + 0.5 * step

        def kick(effect_velocity: SideValues) -> SideValues:
            """Velocities after the step, with effects at `effect_velocity` (rad/s)."""
            new_velocity = {}
            for side, (total, level) in self.side_torques(middle, effect_velocity, states, torque, middle_time).items():
                mass = self.inertia(side) / step
                drag = 0.5 * self.drive.viscous(side)
                free = ((mass - drag) * state.velocity[side] + total) / (mass + drag)
                if not isinstance(level, float):
                    free = _apply_dry_friction(state.velocity[side], free, level / (mass + drag))
                new_velocity[side] = free
            return new_velocity

        velocity = kick(state.velocity)
        if any(effect.velocity_dependent for effect in self.effects):
            velocity = kick({side: 0.5 * (state.velocity[side] + velocity[side]) for side in self.drive.bodies})
        position = {side: middle[side] + 0.5 * step * velocity[side] for side in self.drive.bodies}
        return PlantState(position, velocity, self.advance_effects(states, middle, velocity, middle_time, 0.5 * step))

    def receive(
        self, states: EffectStates, torque: Any, period: Scalar
    ) -> tuple[EffectStates, Callable[[Scalar, Scalar], Any]]:
        """Delay a torque (N m) that is commanded for a sample of `period` seconds.

        Returns:
            The states of the effects, and a function `arriving(since, step)`: the mean torque that arrives over `step`
            seconds, from `since` seconds after the sample began.
        """
        new_states, arriving = [], lambda since, step: torque
        for effect, state in zip(self.effects, states, strict=True):
            if type(effect).receive is not AbstractEffect.receive:
                state, first, then, switch = effect.receive(state, arriving(0.0, period), period)
                arriving = partial(_mean_torque, first, then, switch)
            new_states.append(state)
        return tuple(new_states), arriving

    def actuate(self, states: EffectStates, torque: Any, step: Scalar) -> tuple[EffectStates, Any]:
        """Turn a commanded torque (N m), held over `step` seconds, into the one that acts. The new states come first."""
        new_states = []
        for effect, state in zip(self.effects, states, strict=True):
            state, torque = effect.actuate(state, torque, step)
            new_states.append(state)
        return tuple(new_states), torque

    @property
    def input_gain(self) -> Scalar:
        """Steady torque on the motor for one unit of the input (which may be a voltage), below all limits."""
        states = tuple(effect.settled(_SMALL_INPUT) for effect in self.effects)
        return self.actuate(states, _SMALL_INPUT, _LONG_TIME)[1] / _SMALL_INPUT

    @property
    def input_unit(self) -> str:
        """Unit of the input: N m, unless an effect of the actuator says otherwise."""
        units = (effect.input_unit for effect in self.effects if isinstance(effect, ActuatorEffect))
        return next(filter(None, units), "N m")

    @property
    def has_memory(self) -> bool:
        """True if the state of an effect depends on how the drive moves."""
        return any(type(effect).advance is not AbstractEffect.advance for effect in self.effects)

    def advance_effects(
        self, states: EffectStates, position: SideValues, velocity: SideValues, time: Scalar, step: Scalar
    ) -> EffectStates:
        """Advance the effects' states by `step` seconds at steady velocities (rad/s), from positions (rad) at `time` (s)."""
        if not self.has_memory:
            return states
        motions = {side: Motion(time, position[side], velocity[side]) for side in self.drive.bodies}
        motions["actuator"] = motions["encoder"] = motions["transmission"] = motions["motor"]
        if self.transmission is not None:
            # the rate of deflection changes with the position: in the middle of the step it is its mean
            middle = {side: position[side] + 0.5 * step * velocity[side] for side in self.drive.bodies}
            motions["transmission"] = Motion(time, *self._elastic_motion(middle, velocity, states)[:2])
        return tuple(
            effect.advance(state, motions[self.drive.resolve_place(effect.place)], step)
            for effect, state in zip(self.effects, states, strict=True)
        )

    def side_torques(
        self,
        position: SideValues,
        velocity: SideValues,
        states: EffectStates,
        torque: Scalar,
        time: Scalar,
        transmitted: Scalar | None = None,
    ) -> dict[str, tuple[Scalar, Scalar]]:
        """Torques on each side, except its nominal viscous friction.

        Args:
            position, velocity: of the sides, rad and rad/s.
            states: of the effects.
            torque: on the motor, N m.
            time: s.
            transmitted: transmitted torque C, N m; left out, that of law and effects.

        Returns:
            By side, the sum of the torques and the level of set-valued dry friction beside it, N m. Without dry friction the
            level is the Python number 0.0.
        """
        gains: dict[str, Scalar] = {"motor": -1.0}
        law_torque: Scalar = 0.0
        if self.transmission is not None:
            law_torque, gains["load"] = self.transmitted_torque(position, velocity, states)
        if transmitted is None:
            transmitted = law_torque
        carried = transmitted
        if self.transmission is None and self._effects_at("transmission", states):
            carried = self.load_torque(states, Motion(time, position["motor"], velocity["motor"]))
        torques, mutual = {}, self.drive.body_torques(position, velocity)
        for side in self.drive.bodies:
            driving = torque if side == "motor" else 0.0
            for effect, state in self._effects_at("actuator", states) if side == "motor" else ():
                driving = driving - effect.resist(state, Motion(time, position[side], velocity[side], torque))
            total = gains[side] * transmitted + driving if side in gains else driving
            total = total + mutual[side] if side in mutual else total
            level: Scalar = self.gear_friction(states, carried) if side == "motor" else 0.0
            motion = Motion(time, position[side], velocity[side], driving)
            for effect, state in self._effects_at(side, states):
                total = total - effect.resist(state, motion)
                level = level + effect.dry_friction(state, motion)
            torques[side] = total, level
        return torques

    def read(self, side: str, position: Any, velocity: Any) -> Any:
        """Reading (rad) of a side's encoder at a position (rad) and velocity (rad/s), before noise and quantisation."""
        for effect in self.effects:
            if isinstance(effect, EncoderEffect) and self.drive.resolve_place(effect.encoder) == side:
                position = effect.read(position, velocity)
        return position

    def holding_torque(self, side: str, motion: Motion, states: EffectStates) -> tuple[Scalar, Scalar]:
        """Torque of a side's frictions with a memory, and the level up to which they may hold the side while it is not seen
        to move (:meth:`AbstractEffect.holds`), N m."""
        torque: Scalar = 0.0
        level: Scalar = 0.0
        for effect, state in self._effects_at(side, states):
            if type(effect).holds is not AbstractEffect.holds:
                torque, level = torque + effect.resist(state, motion), level + effect.holds()
        return torque, level

    def _effects_at(self, place: str, states: EffectStates) -> list[tuple[AbstractEffect, Any]]:
        """The effects that act at a place, each with its state."""
        pairs = zip(self.effects, states, strict=True)
        return [(effect, state) for effect, state in pairs if self.drive.resolve_place(effect.place) == place]


_SMALL_INPUT, _LONG_TIME = 1e-6, 1e9
"""An input below every limit, and a time (s) after which nothing lags behind."""


def _mean_torque(first: Scalar, then: Scalar, switch: Scalar, since: Scalar, step: Scalar) -> Scalar:
    """Mean over `step` seconds, from the time `since`, of a torque that changes from `first` to `then` at `switch`."""
    return then + (first - then) * jnp.clip((switch - since) / step, 0.0, 1.0)


def _apply_dry_friction(before: ScalarArray, free: Scalar, loss: Scalar) -> ScalarArray:
    """Velocity after a step under set-valued dry friction; all arguments in rad/s.

    Args:
        before: velocity before the step.
        free: velocity after it without dry friction.
        loss: speed that dry friction takes off in a whole step of motion.
    """
    direction = jnp.where(before != 0.0, jnp.sign(before), -jnp.sign(free))
    sliding = free - direction * loss
    change = before - sliding
    stops = direction * sliding <= 0.0
    # a side that stops within the step turns around for the rest of it, against friction of the other sign, or sticks
    remaining = 1.0 - before / jnp.where(change == 0.0, 1.0, change)
    turned = direction * jnp.minimum(direction * sliding + 2.0 * loss * remaining, 0.0)
    return jnp.where(stops, turned, sliding)
