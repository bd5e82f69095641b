"""Physical effects beyond the nominal drive, each written once.

An effect is a module that overrides the hooks that concern it; the plant asks every effect of its tuple at every step,
and the neutral answers (the Python number 0.0, or the argument itself) cost nothing after compilation. Simulation,
sweeps, identification and diagnosis all use these same modules. Sign convention: `resist` torques are subtracted on
their side, J dv/dt = ... - resist, so that a positive number always opposes a positive drive torque.

Further packages add effects through the entry-point group `jaxbl.effects`: the entry's name is the effect's name
(`load.my_effect`), its object a subclass of :class:`AbstractEffect`.
"""

import functools
from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from .parameters import Scalar, parameter

Side = Literal["motor", "load"]
Value = Any  # a number or an array of one: hooks are duck-typed, neutral ones answer the Python number 0.0


class Motion(NamedTuple):
    """What a side's torque may depend on: time in s, position in rad, velocity in rad/s."""

    time: Value
    position: Value
    velocity: Value


class AbstractEffect(eqx.Module):
    """Base of all effects; every hook has a neutral default.

    `place` says where the effect acts: motor, load, transmission or actuator. `velocity_dependent` effects are evaluated
    twice a step (predictor and corrector) to keep the integrator's second order. `neutral` are numbers with which the
    effect does nothing; one without them is no candidate of a diagnosis.
    """

    kind: ClassVar[str]
    velocity_dependent: ClassVar[bool] = False
    neutral: ClassVar[Mapping[str, float]] = {}

    @property
    def place(self) -> str:
        raise NotImplementedError

    @property
    def name(self) -> str:
        """Full name, e.g. `load.coulomb_friction`."""
        return f"{self.place}.{self.kind}"

    def init(self) -> Any:
        """The effect's own state at t = 0, a tuple of numbers."""
        return ()

    def actuate(self, state: Any, torque: Value, step: Value) -> tuple[Any, Value]:
        """Turn the commanded torque (N m) into the one that acts over the next `step` seconds."""
        return state, torque

    def transmission_error(self, load_position: Value) -> Value:
        """Kinematic error in rad on the motor side, added to z = theta_e - N_0 theta_s."""
        return 0.0

    def deflect(self, z: Value) -> Value:
        """Deflection in rad that is left of z."""
        return z

    def transmit(self, deflection: Value, rate: Value) -> Value:
        """Torque in N m added to the transmitted one, from deflection (rad) and its rate (rad/s)."""
        return 0.0

    def resist(self, motion: Motion) -> Value:
        """Torque in N m subtracted on the effect's side."""
        return 0.0

    def dry_friction(self, velocity: Value) -> Value:
        """Level in N m of set-valued dry friction on the effect's side: it holds up to it, and opposes motion with it."""
        return 0.0

    def added_inertia(self) -> Value:
        """Inertia in kg m^2 added to the side's nominal one."""
        return 0.0


class SideEffect(AbstractEffect):
    """An effect on the motor or on the load."""

    side: Side = eqx.field(static=True, kw_only=True)

    @property
    def place(self) -> str:
        return self.side


class TransmissionEffect(AbstractEffect):
    """An effect in the gear."""

    @property
    def place(self) -> str:
        return "transmission"


class ActuatorEffect(AbstractEffect):
    """An effect on the input torque. Several act one after the other, in the order of the config."""

    @property
    def place(self) -> str:
        return "actuator"


class CoulombFriction(SideEffect):
    """Dry friction of constant level: sticks below it, F_c sign(v) in motion."""

    kind: ClassVar[str] = "coulomb_friction"
    neutral: ClassVar[Mapping[str, float]] = {"torque": 0.0}
    torque: Scalar = parameter("N m", "friction torque F_c", minimum=0.0)

    def dry_friction(self, velocity):
        return self.torque


class StribeckFriction(SideEffect):
    """Dry friction that falls from break-away F_s to F_c with speed: F_c + (F_s - F_c) exp(-(v / v_s)^2)."""

    kind: ClassVar[str] = "stribeck_friction"
    velocity_dependent: ClassVar[bool] = True
    neutral: ClassVar[Mapping[str, float]] = {"torque": 0.0, "breakaway_torque": 0.0, "stribeck_velocity": 1.0}
    torque: Scalar = parameter("N m", "sliding friction torque F_c", minimum=0.0)
    breakaway_torque: Scalar = parameter("N m", "break-away torque F_s", minimum=0.0)
    stribeck_velocity: Scalar = parameter("rad/s", "speed v_s over which friction falls", above=0.0)

    def dry_friction(self, velocity):
        return self.torque + (self.breakaway_torque - self.torque) * jnp.exp(-((velocity / self.stribeck_velocity) ** 2))


class ViscousFriction(SideEffect):
    """Error of the nominal viscous friction: an additional torque f v."""

    kind: ClassVar[str] = "viscous_friction"
    velocity_dependent: ClassVar[bool] = True
    neutral: ClassVar[Mapping[str, float]] = {"viscous": 0.0}
    viscous: Scalar = parameter("N m s/rad", "viscous friction on top of the nominal one; may be negative")

    def resist(self, motion):
        return self.viscous * motion.velocity


class QuadraticDrag(SideEffect):
    """Fluid drag b v |v|."""

    kind: ClassVar[str] = "quadratic_drag"
    velocity_dependent: ClassVar[bool] = True
    neutral: ClassVar[Mapping[str, float]] = {"drag": 0.0}
    drag: Scalar = parameter("N m s²/rad²", "drag coefficient b", minimum=0.0)

    def resist(self, motion):
        return self.drag * motion.velocity * jnp.abs(motion.velocity)


class ConstantTorque(SideEffect):
    """A constant resisting torque (an offset of the amplifier, a weight on a drum)."""

    kind: ClassVar[str] = "constant_torque"
    neutral: ClassVar[Mapping[str, float]] = {"torque": 0.0}
    torque: Scalar = parameter("N m", "resisting torque; may be negative")

    def resist(self, motion):
        return self.torque


class Inertia(SideEffect):
    """Error of the nominal inertia."""

    kind: ClassVar[str] = "inertia"
    neutral: ClassVar[Mapping[str, float]] = {"inertia": 0.0}
    inertia: Scalar = parameter("kg m²", "inertia on top of the nominal one; may be negative")

    def added_inertia(self):
        return self.inertia


class Gravity(SideEffect):
    """An eccentric mass: m g l sin(theta - phase)."""

    kind: ClassVar[str] = "gravity"
    neutral: ClassVar[Mapping[str, float]] = {"torque": 0.0, "phase": 0.0}
    torque: Scalar = parameter("N m", "largest gravity torque m g l")
    phase: Scalar = parameter("rad", "position at which the mass hangs down", default=0.0)

    def resist(self, motion):
        return self.torque * jnp.sin(motion.position - self.phase)


class PeriodicDisturbance(SideEffect):
    """A torque periodic in time: A sin(2 pi f t + phase)."""

    kind: ClassVar[str] = "periodic_disturbance"
    neutral: ClassVar[Mapping[str, float]] = {"amplitude": 0.0, "frequency": 1.0, "phase": 0.0}
    amplitude: Scalar = parameter("N m", "amplitude A")
    frequency: Scalar = parameter("Hz", "frequency f", minimum=0.0)
    phase: Scalar = parameter("rad", "phase at t = 0", default=0.0)

    def resist(self, motion):
        return self.amplitude * jnp.sin(2.0 * jnp.pi * self.frequency * motion.time + self.phase)


class Cogging(SideEffect):
    """Cogging of the motor: A sin(n theta + phase)."""

    kind: ClassVar[str] = "cogging"
    neutral: ClassVar[Mapping[str, float]] = {"amplitude": 0.0, "harmonic": 1.0, "phase": 0.0}
    amplitude: Scalar = parameter("N m", "amplitude A")
    harmonic: Scalar = parameter("1/turn", "periods n a turn", above=0.0)
    phase: Scalar = parameter("rad", "phase at theta = 0", default=0.0)

    def resist(self, motion):
        return self.amplitude * jnp.sin(self.harmonic * motion.position + self.phase)


class Backlash(TransmissionEffect):
    """A hard gap in series with the law: contact only outside of +-half_gap."""

    kind: ClassVar[str] = "backlash"
    neutral: ClassVar[Mapping[str, float]] = {"half_gap": 0.0}
    half_gap: Scalar = parameter("rad", "half of the free play, on the motor side", minimum=0.0)

    def deflect(self, z):
        return z - jnp.clip(z, -self.half_gap, self.half_gap)


class Hardening(TransmissionEffect):
    """Stiffness that grows with deflection: + K_3 z^3."""

    kind: ClassVar[str] = "hardening"
    neutral: ClassVar[Mapping[str, float]] = {"cubic_stiffness": 0.0}
    cubic_stiffness: Scalar = parameter("N m/rad³", "cubic stiffness K_3")

    def transmit(self, deflection, rate):
        return self.cubic_stiffness * deflection**3


class Damping(TransmissionEffect):
    """Damping of the shaft: + D dz/dt of the elastic deflection (none inside a hard gap)."""

    kind: ClassVar[str] = "damping"
    velocity_dependent: ClassVar[bool] = True
    neutral: ClassVar[Mapping[str, float]] = {"damping": 0.0}
    damping: Scalar = parameter("N m s/rad", "damping D", minimum=0.0)

    def transmit(self, deflection, rate):
        return self.damping * rate


class Eccentricity(TransmissionEffect):
    """Eccentric gear: a transmission error A sin(n theta_s + phase); the torque ratio follows it (no power is lost)."""

    kind: ClassVar[str] = "eccentricity"
    neutral: ClassVar[Mapping[str, float]] = {"amplitude": 0.0, "harmonic": 1.0, "phase": 0.0}
    amplitude: Scalar = parameter("rad", "amplitude A, on the motor side")
    harmonic: Scalar = parameter("1/turn", "periods n a load turn", above=0.0, default=1.0)
    phase: Scalar = parameter("rad", "phase at theta_s = 0", default=0.0)

    def transmission_error(self, load_position):
        return self.amplitude * jnp.sin(self.harmonic * load_position + self.phase)


class GainError(ActuatorEffect):
    """Torque constant off by a relative error: u (1 + e)."""

    kind: ClassVar[str] = "gain_error"
    neutral: ClassVar[Mapping[str, float]] = {"relative": 0.0}
    relative: Scalar = parameter("", "relative error e of the torque", minimum=-1.0)

    def actuate(self, state, torque, step):
        return state, (1.0 + self.relative) * torque


class Saturation(ActuatorEffect):
    """Torque limit: clip(u, -limit, limit)."""

    kind: ClassVar[str] = "saturation"
    neutral: ClassVar[Mapping[str, float]] = {"limit": 1e30}
    limit: Scalar = parameter("N m", "largest torque", above=0.0)

    def actuate(self, state, torque, step):
        return state, jnp.clip(torque, -self.limit, self.limit)


class Lag(ActuatorEffect):
    """First-order lag of the torque: T du_a/dt = u - u_a, advanced exactly for a held u; starts at zero torque."""

    kind: ClassVar[str] = "lag"
    neutral: ClassVar[Mapping[str, float]] = {"time_constant": 1e-30}
    time_constant: Scalar = parameter("s", "time constant T", above=0.0)

    def init(self):
        return (jnp.zeros_like(self.time_constant),)

    def actuate(self, state, torque, step):
        (lagged,) = state
        steps = step / self.time_constant
        new = torque + (lagged - torque) * jnp.exp(-steps)
        # the mean over the step keeps the impulse
        return (new,), torque + (lagged - torque) * -jnp.expm1(-steps) / steps


def _both(cls: type[SideEffect]) -> dict[str, Callable[..., AbstractEffect]]:
    return {f"{side}.{cls.kind}": functools.partial(cls, side=side) for side in ("motor", "load")}


_BUILT_IN: dict[str, Callable[..., AbstractEffect]] = {
    **_both(CoulombFriction),
    **_both(StribeckFriction),
    **_both(ViscousFriction),
    **_both(QuadraticDrag),
    **_both(ConstantTorque),
    **_both(Inertia),
    "load.gravity": functools.partial(Gravity, side="load"),
    "load.periodic_disturbance": functools.partial(PeriodicDisturbance, side="load"),
    "motor.cogging": functools.partial(Cogging, side="motor"),
    "transmission.backlash": Backlash,
    "transmission.hardening": Hardening,
    "transmission.damping": Damping,
    "transmission.eccentricity": Eccentricity,
    "actuator.gain_error": GainError,
    "actuator.saturation": Saturation,
    "actuator.lag": Lag,
}


@functools.cache
def effect_kinds() -> Mapping[str, Callable[..., AbstractEffect]]:
    """All effects by full name: the built-in ones and those of installed packages (group `jaxbl.effects`)."""
    return {**{entry.name: entry.load() for entry in entry_points(group="jaxbl.effects")}, **_BUILT_IN}


def effect_class(name: str) -> type[AbstractEffect]:
    """The module class behind an effect name."""
    kind = effect_kinds()[name]
    return kind.func if isinstance(kind, functools.partial) else kind  # type: ignore[return-value]
