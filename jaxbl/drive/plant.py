"""The drive as it moves: eqs. (1)-(2) with a transmission law and any effects, one time step at a time.

Time stepping is Moreau's midpoint rule: drift half a step, kick, drift half a step. The kick takes the elastic torque at
the midpoint position, viscous friction implicitly, and dry friction as the set-valued law it is: the side sticks exactly
while the rest of the torque stays below the friction level. Within a step it comes to rest, or turns around, at the time
at which its velocity passes zero; a projection at the step's end, as in Moreau's rule, would take friction of one sign off
all of the step. On smooth drives this is the Stoermer-Verlet scheme (second order, symplectic, one evaluation of the law a
step). Measured against others in benchmarks/integrators.py.
References: J. J. Moreau, Numerical aspects of the sweeping process, CMAME 177 (1999); V. Acary, B. Brogliato, Numerical
Methods for Nonsmooth Dynamical Systems, Springer (2008), ch. 10.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .effects import AbstractEffect, ActuatorEffect, EncoderEffect, Motion
from .parameters import Scalar, parameter
from .transmission import AbstractTransmission

SideValues = dict[str, Float[Array, ""]]
"""One number for each side of the drive: keys "motor" and, on two inertias, "load"."""
EffectStates = tuple[Any, ...]
"""Each effect's own state, in the order of the effects."""


class AbstractDrive(eqx.Module):
    """Inertias and viscous frictions. Linear axes use kg, N, m in place of kg m^2, N m, rad."""

    name: ClassVar[str]
    sides: ClassVar[tuple[str, ...]]

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
        """Where effects of a place act."""
        return place

    def acceleration(self, side: str, velocity: Scalar, torque: Scalar) -> Scalar:
        """Nominal acceleration f(x_2, u) without transmitted torque, as the observers (7) know it; rad/s^2.

        `torque` is the input u, which acts on the motor only.
        """
        driving = torque if side == "motor" else 0.0
        return (driving - self.viscous(side) * velocity) / self.inertia(side)


class TwoInertia(AbstractDrive):
    """Motor and load over a gear, eq. (1)."""

    name: ClassVar[str] = "two_inertia"
    sides: ClassVar[tuple[str, ...]] = ("motor", "load")
    motor_inertia: Scalar = parameter("kg m²", "motor inertia J_e", above=0.0)
    motor_viscous: Scalar = parameter("N m s/rad", "motor viscous friction f_e", minimum=0.0)
    load_inertia: Scalar = parameter("kg m²", "load inertia J_s", above=0.0)
    load_viscous: Scalar = parameter("N m s/rad", "load viscous friction f_s", minimum=0.0)
    # on a linear axis rad for one m: a screw with a lead of a micrometre has 6e6
    gear_ratio: Scalar = parameter("", "gear ratio N_0: motor turns for one load turn", minimum=1e-7, maximum=1e7)

    def ratio(self, side):
        return 1.0 if side == "motor" else self.gear_ratio


class Rigid(AbstractDrive):
    """One inertia: everything beyond it is disturbance. `motor.*` effects act on it, and those that only a load has."""

    name: ClassVar[str] = "rigid"
    sides: ClassVar[tuple[str, ...]] = ("motor",)
    motor_inertia: Scalar = parameter("kg m²", "inertia (a mass in kg on a linear axis)", above=0.0)
    motor_viscous: Scalar = parameter("N m s/rad", "viscous friction", minimum=0.0)

    def resolve_place(self, place):
        return "motor" if place == "load" else place


DRIVES: dict[str, type[AbstractDrive]] = {drive.name: drive for drive in (TwoInertia, Rigid)}


class Initial(eqx.Module):
    """Positions and velocities at t = 0; `load_*` have no meaning on a rigid drive."""

    motor_position: Scalar = parameter("rad", "motor position at t = 0", default=0.0)
    motor_velocity: Scalar = parameter("rad/s", "motor velocity at t = 0", default=0.0)
    load_position: Scalar = parameter("rad", "load position at t = 0", default=0.0)
    load_velocity: Scalar = parameter("rad/s", "load velocity at t = 0", default=0.0)


class PlantState(eqx.Module):
    """Positions (rad) and velocities (rad/s) of the sides, and the effects' own states."""

    position: SideValues
    velocity: SideValues
    effects: EffectStates


class Plant(eqx.Module):
    """Drive, transmission law and effects together."""

    drive: AbstractDrive
    transmission: AbstractTransmission | None
    effects: tuple[AbstractEffect, ...] = ()

    def init(self, initial: Initial) -> PlantState:
        sides = self.drive.sides
        return PlantState(
            position={side: getattr(initial, f"{side}_position") for side in sides},
            velocity={side: getattr(initial, f"{side}_velocity") for side in sides},
            effects=tuple(effect.init() for effect in self.effects),
        )

    def inertia(self, side: str) -> Scalar:
        """True inertia of a side, kg m^2."""
        # of a method of a module equinox makes a module: only of those that answer
        some = [one for one in self.effects if type(one).added_inertia is not AbstractEffect.added_inertia]
        return self.drive.inertia(side) + sum(
            one.added_inertia() for one in some if self.drive.resolve_place(one.place) == side
        )

    @property
    def half_gap(self) -> float:
        """Half of the free play that law and effects describe together, rad at the motor; 0 where there is none."""
        gap = 0.0 if self.transmission is None else float(self.transmission.half_gap)
        return gap + sum(float(effect.free_play()) for effect in self.effects)

    def twist(self, position: SideValues) -> Float[Array, ""]:
        """z = theta_e - N_0 theta_s in rad."""
        return position["motor"] - self.drive.ratio("load") * position["load"]

    def transmitted_torque(
        self, position: SideValues, velocity: SideValues, states: EffectStates
    ) -> tuple[Float[Array, ""], Scalar]:
        """Transmitted torque C (N m) and the motor angle that one unit of load angle takes up (N_0 without effects)."""
        assert self.transmission is not None
        deflection, rate, ratio = self._elastic_motion(position, velocity, states)
        torque = self.transmission.torque(deflection)
        for effect, own in self._effects_at("transmission", states):
            torque = torque + effect.transmit(own, deflection, rate)
        return torque, ratio

    def gear_friction(self, states: EffectStates, transmitted: Scalar) -> Scalar:
        """Level of the dry friction that the transmitted torque (N m) causes on the motor's side, N m."""
        return sum((effect.gear_friction(own, transmitted) for effect, own in self._effects_at("transmission", states)), 0.0)

    def _elastic_motion(
        self, position: SideValues, velocity: SideValues, states: EffectStates
    ) -> tuple[Float[Array, ""], Scalar, Scalar]:
        """Elastic deflection of the gear (rad), its rate (rad/s), and the motor angle for one unit of load angle."""
        effects = self._effects_at("transmission", states)
        ratio = self.drive.ratio("load")
        z = self.twist(position)
        rate = velocity["motor"] - ratio * velocity["load"]
        for effect, own in effects:
            error, slope = jax.jvp(
                lambda angle, effect=effect, own=own: jnp.asarray(effect.transmission_error(own, angle), angle.dtype),
                (position["load"],),
                (jnp.ones_like(position["load"]),),
            )
            z, rate, ratio = z + error, rate + slope * velocity["load"], ratio - slope

        def contact(z):
            for effect, own in effects:
                z = effect.deflect(own, z)
            assert self.transmission is not None
            return self.transmission.deflection(z)

        deflection, rate = jax.jvp(contact, (z,), (rate,))
        return deflection, rate, ratio

    def advance(self, state: PlantState, torque: Scalar, time: Scalar, step: Scalar) -> PlantState:
        """One step of Moreau's midpoint rule under a commanded torque (N m) held over `step` seconds from `time`.

        Effects with a memory move on with the positions: half a step before the kick and half a step after it.
        """
        states, torque = self.actuate(state.effects, torque, step)
        states = self.advance_effects(states, state.position, state.velocity, time, 0.5 * step)
        middle = {side: state.position[side] + 0.5 * step * state.velocity[side] for side in self.drive.sides}
        middle_time = time + 0.5 * step
        velocity = self._kick(state.velocity, middle, state.velocity, states, torque, middle_time, step)
        if any(effect.velocity_dependent for effect in self.effects):
            mean = {side: 0.5 * (state.velocity[side] + velocity[side]) for side in self.drive.sides}
            velocity = self._kick(state.velocity, middle, mean, states, torque, middle_time, step)
        position = {side: middle[side] + 0.5 * step * velocity[side] for side in self.drive.sides}
        return PlantState(position, velocity, self.advance_effects(states, middle, velocity, middle_time, 0.5 * step))

    def receive(
        self, states: EffectStates, torque: Any, period: Scalar
    ) -> tuple[EffectStates, Callable[[Scalar, Scalar], Any]]:
        """What the effects let arrive of a torque (N m) that is commanded for `period` seconds: their states, and
        its mean as a function of the time since the sample began and the seconds that the mean is over."""
        new, arriving = [], lambda since, step: torque
        for effect, own in zip(self.effects, states, strict=True):
            if type(effect).receive is not AbstractEffect.receive:
                own, first, then, switch = effect.receive(own, arriving(0.0, period), period)
                arriving = partial(_mean_torque, first, then, switch)
            new.append(own)
        return tuple(new), arriving

    def actuate(self, states: EffectStates, torque: Any, step: Scalar) -> tuple[EffectStates, Any]:
        """What the effects make of a commanded torque (N m) held over `step` seconds: their states, and the torque."""
        new = []
        for effect, own in zip(self.effects, states, strict=True):
            own, torque = effect.actuate(own, torque, step)
            new.append(own)
        return tuple(new), torque

    @property
    def input_gain(self) -> Scalar:
        """Torque on the motor for one unit of the input, which may be a voltage: of a small one that has lasted."""
        states = tuple(effect.settled(_SMALL_INPUT) for effect in self.effects)
        return self.actuate(states, _SMALL_INPUT, _LONG_TIME)[1] / _SMALL_INPUT

    @property
    def input_unit(self) -> str:
        """Unit of the input."""
        return next((one.input_unit for one in self.effects if isinstance(one, ActuatorEffect) and one.input_unit), "N m")

    @property
    def has_memory(self) -> bool:
        """Whether some effect's own state depends on how the drive moves."""
        return any(type(effect).advance is not AbstractEffect.advance for effect in self.effects)

    def advance_effects(
        self, states: EffectStates, position: SideValues, velocity: SideValues, time: Scalar, step: Scalar
    ) -> EffectStates:
        """The effects' own states after `step` seconds at steady velocities (rad/s), from positions (rad) at `time` (s)."""
        if not self.has_memory:
            return states
        motions = {side: Motion(time, position[side], velocity[side]) for side in self.drive.sides}
        motions["actuator"] = motions["encoder"] = motions["motor"]
        if self.transmission is not None:
            # the rate changes with the position: its mean over the step is that at the middle
            middle = {side: position[side] + 0.5 * step * velocity[side] for side in self.drive.sides}
            motions["transmission"] = Motion(time, *self._elastic_motion(middle, velocity, states)[:2])
        return tuple(
            effect.advance(own, motions[self.drive.resolve_place(effect.place)], step)
            for effect, own in zip(self.effects, states, strict=True)
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
        """What acts on each side but for its nominal viscous friction, N m: the sum of all torques, and the level of
        set-valued dry friction that opposes motion beside it (the Python number 0.0 without any).

        `torque` (N m) is the one that acts on the motor; `transmitted` (N m), where it is known, stands for the gear's.
        """
        gains: dict[str, Scalar] = {"motor": -1.0}
        through: Scalar = 0.0
        if self.transmission is not None:
            through, gains["load"] = self.transmitted_torque(position, velocity, states)
        if transmitted is not None:
            through = transmitted
        found = {}
        for side in self.drive.sides:
            driving = torque if side == "motor" else 0.0
            for effect, own in self._effects_at("actuator", states) if side == "motor" else ():
                driving = driving - effect.resist(own, Motion(time, position[side], velocity[side], torque))
            total = gains[side] * through + driving
            level: Scalar = self.gear_friction(states, through) if side == "motor" else 0.0
            motion = Motion(time, position[side], velocity[side], driving)
            for effect, own in self._effects_at(side, states):
                total = total - effect.resist(own, motion)
                level = level + effect.dry_friction(own, motion)
            found[side] = total, level
        return found

    def read(self, side: str, position: Any, velocity: Any) -> Any:
        """What the encoder of a side reads at a position (rad) and velocity (rad/s), before noise and counts; rad."""
        for effect in self.effects:
            if isinstance(effect, EncoderEffect) and self.drive.resolve_place(effect.encoder) == side:
                position = effect.read(position, velocity)
        return position

    def holding_torque(self, side: str, motion: Motion, states: EffectStates) -> tuple[Scalar, Scalar]:
        """Torque (N m) of a side's frictions with a memory that may hold it, and the level up to which they do so while it
        is not seen to move."""
        torque: Scalar = 0.0
        level: Scalar = 0.0
        for effect, own in self._effects_at(side, states):
            if type(effect).holds is not AbstractEffect.holds:
                torque, level = torque + effect.resist(own, motion), level + effect.holds()
        return torque, level

    def _kick(
        self,
        velocity: SideValues,
        position: SideValues,
        seen: SideValues,
        states: EffectStates,
        torque: Scalar,
        time: Scalar,
        step: Scalar,
    ) -> SideValues:
        """Velocities after `step`; `seen` are the velocities at which velocity-dependent effects are evaluated."""
        new = {}
        for side, (total, level) in self.side_torques(position, seen, states, torque, time).items():
            mass = self.inertia(side) / step
            drag = 0.5 * self.drive.viscous(side)
            free = ((mass - drag) * velocity[side] + total) / (mass + drag)
            if not isinstance(level, float):
                free = _apply_dry_friction(velocity[side], free, level / (mass + drag))
            new[side] = free
        return new

    def _effects_at(self, place: str, states: EffectStates) -> list[tuple[AbstractEffect, Any]]:
        """Effects of a place, each with its own state."""
        pairs = zip(self.effects, states, strict=True)
        return [(effect, own) for effect, own in pairs if self.drive.resolve_place(effect.place) == place]


_SMALL_INPUT, _LONG_TIME = 1e-6, 1e9
"""Input below every limit, and a time in s after which nothing lags behind."""


def _mean_torque(first: Scalar, then: Scalar, switch: Scalar, since: Scalar, step: Scalar) -> Scalar:
    """Mean over `step` seconds, from `since`, of a torque that changes once, at `switch`."""
    return then + (first - then) * jnp.clip((switch - since) / step, 0.0, 1.0)


def _apply_dry_friction(before: Float[Array, ""], free: Scalar, stop: Scalar) -> Float[Array, ""]:
    """Velocity after a step under set-valued friction, from that before, that which it would `free` reach without friction,
    and what friction takes from it in a whole step of motion; all rad/s."""
    direction = jnp.where(before != 0.0, jnp.sign(before), -jnp.sign(free))
    along = free - direction * stop
    apart = before - along
    rests = direction * along <= 0.0
    # it comes to rest within the step: friction has the other sign for what is left of it, or holds
    left = 1.0 - before / jnp.where(apart == 0.0, 1.0, apart)
    turned = direction * jnp.minimum(direction * along + 2.0 * stop * left, 0.0)
    return jnp.where(rests, turned, along)
