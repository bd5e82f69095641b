"""What a drive, its law and its effects ask of a MuJoCo model, as numbers; :mod:`jaxbl.exports.mjcf` writes them as XML.

An effect or a law is given :class:`MujocoParts` by its hook `to_mujoco`, adds what it needs, and answers with how well
MuJoCo then has it. Linear axes use kg, N, m in place of kg m^2, N m, rad.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

Number = Any
"""A Python float: the hooks are called on modules before their numbers become arrays."""
IMPEDANCE = 0.9999
"""Largest share of a constraint that MuJoCo enforces (its mjMAXIMP)."""


class Said(NamedTuple):
    """How well a MuJoCo model has a part of a study, and by which means, how far off, or why not."""

    how: Literal["exactly", "approximated", "not said"]
    text: str


def exactly(text: str) -> Said:
    """The model has it, to the accuracy of time steps; `text` names the element."""
    return Said("exactly", text)


def nearly(text: str) -> Said:
    """The model has something near; `text` names the element, and says how far off it is."""
    return Said("approximated", text)


def unsaid(text: str) -> Said:
    """The model does not have it; `text` says why."""
    return Said("not said", text)


class Wave(NamedTuple):
    """A torque A sin(n x + phase) that drives a side, N m; n = 0 makes it constant."""

    amplitude: Number
    harmonic: Number
    phase: Number


class Bristles(NamedTuple):
    """LuGre friction of a side: sigma_0 (N m/rad), sigma_1 (N m s/rad), sliding and break-away torque (N m), and the
    speed (rad/s) over which friction falls from one to the other."""

    stiffness: Number
    damping: Number
    sliding: Number
    breakaway: Number
    speed: Number


class Pendulum(NamedTuple):
    """An eccentric mass on a turning side: m g l in N m, and the position in rad at which it hangs down."""

    torque: Number
    phase: Number


class Behind(NamedTuple):
    """A further inertia (kg m^2) behind a spring (N m/rad) and a damper (N m s/rad) on a side."""

    inertia: Number
    stiffness: Number
    damping: Number


class Spring(NamedTuple):
    """A spring that is slack between two lengths: of the deflection x beyond them, a torque linear x + cubic x^3."""

    linear: Number
    cubic: Number
    low: Number
    high: Number


@dataclass
class SideParts:
    """One side: its inertia (kg m^2, with that of the effects), viscous friction (N m s/rad), drag (N m s^2/rad^2), dry
    friction (N m), and more. `slides`: it moves along a line."""

    inertia: Number
    slides: bool = False
    viscous: Number = 0.0
    drag: Number = 0.0
    dry: Number = 0.0
    waves: list[Wave] = field(default_factory=list)
    bristles: list[Bristles] = field(default_factory=list)
    pendulums: list[Pendulum] = field(default_factory=list)
    behind: list[Behind] = field(default_factory=list)
    springs: list[Spring] = field(default_factory=list)


@dataclass
class ActuatorParts:
    """What becomes of the input, in MuJoCo's order: delay (s), limit, first-order lag (s), gain, limit of the torque."""

    delay: Number = 0.0
    limit: Number = math.inf
    lag: Number | None = None
    gain: Number = 1.0
    torque_limit: Number = math.inf

    def scale(self, factor: Number) -> None:
        """A factor on the torque."""
        self.gain *= factor
        self.torque_limit *= abs(factor)

    def clip(self, limit: Number) -> None:
        """A limit of the torque, N m."""
        if self.lag is not None:
            self.torque_limit = min(self.torque_limit, limit)
        elif self.gain != 0.0:
            self.limit = min(self.limit, limit / abs(self.gain))


@dataclass
class MujocoParts:
    """All parts of a model; effects and laws add to it.

    Attributes:
        sides: by name.
        ratio: motor angle for one unit of the load's angle; None on a rigid drive.
        step: time step in s that the gear asks for; effects may ask for a shorter one, `longest`.
        half_gap: half of the free play, rad at the motor; it widens the dead band of every spring in the gear.
        damping: of the gear outside of the gap, N m s/rad.
        springs: of the gear, in parallel.
        longest: time step in s that effects ask for, at most.
    """

    sides: dict[str, SideParts]
    ratio: Number | None
    step: Number
    half_gap: Number = 0.0
    damping: Number = 0.0
    springs: list[Spring] = field(default_factory=list)
    actuator: ActuatorParts = field(default_factory=ActuatorParts)
    longest: Number = math.inf

    def resolve(self, rate: Number) -> None:
        """Ask for time steps that resolve a rate (rad/s or 1/s)."""
        if rate > 0.0:
            self.longest = min(self.longest, RESOLVED / rate)

    def shorten(self, factor: Number) -> Number:
        """Ask for time steps shorter by a factor than the gear asks for. Returns the step in s."""
        self.longest = min(self.longest, self.step / factor)
        return self.step / factor

    @property
    def mobility(self) -> float:
        """Acceleration of the twist for a torque in the gear of 1 N m, rad/s^2."""
        assert self.ratio is not None
        return 1.0 / self.sides["motor"].inertia + self.ratio**2 / self.sides["load"].inertia

    def wave(self, side: str, amplitude: Number, harmonic: Number, phase: Number) -> None:
        """A torque that resists on a side: A sin(n x + phase), N m and rad."""
        if amplitude:
            self.sides[side].waves.append(Wave(-amplitude, harmonic, phase))
            self.resolve(math.sqrt(abs(amplitude * harmonic) / self.sides[side].inertia))

    def constant(self, side: str, torque: Number) -> None:
        """A constant torque that resists on a side, N m."""
        self.wave(side, torque, 0.0, 0.5 * math.pi)

    def friction(self, side: str, bristles: Bristles) -> None:
        """LuGre friction of a side."""
        self.sides[side].bristles.append(bristles)
        self.resolve(math.sqrt(bristles.stiffness / self.sides[side].inertia))
        self.resolve(bristles.damping / self.sides[side].inertia)

    def spring(self, linear: Number, cubic: Number = 0.0, slack: Number = 0.0) -> None:
        """A spring in the gear, slack for twists up to `slack` (rad) beyond the gap; N m/rad and N m/rad^3."""
        self.springs.append(Spring(linear, cubic, -slack, slack))

    def piecewise(self, side: str, points: Sequence[Number], torques: Sequence[Number]) -> None:
        """A torque that resists on a side (N m), linear between points of its position (rad), constant beyond the last."""
        slope = 0.0
        self.constant(side, torques[0])
        for i, point in enumerate(points):
            last = i + 1 == len(points)
            new = 0.0 if last else (torques[i + 1] - torques[i]) / (points[i + 1] - point)
            # slack below its point
            self.sides[side].springs.append(Spring(new - slope, 0.0, -FAR, point))
            self.resolve(math.sqrt(abs(new) / self.sides[side].inertia))
            slope = new


RESOLVED = 0.1
"""Largest time step times the fastest rate of the model: Runge-Kutta steps are then off by 1e-6 a period or so."""
FAR = 1e12
"""A length in rad that no drive reaches."""
