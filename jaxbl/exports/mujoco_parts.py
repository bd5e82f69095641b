"""Parts of a MuJoCo model as numbers: a drive, its law and its effects add to them, :mod:`.mjcf` writes them as XML.

Linear axes use kg, N, m in place of kg m^2, N m, rad.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

Number = Any
"""A Python float: parts are made of modules before their numbers become arrays."""
IMPEDANCE = 0.9999
"""Largest share of a constraint that MuJoCo enforces (its mjMAXIMP)."""
RESOLUTION = 0.1
"""Largest time step times the fastest rate of the model: Runge-Kutta steps are then off by 1e-6 a period or so."""
_INFINITY = 1e12
"""A length in rad that no drive reaches."""


class Answer(NamedTuple):
    """An answer to how well a MuJoCo model has a part of a study.

    Attributes:
        fidelity: key in `export.json`.
        text: the element of the model, and how far off it is; or why the model lacks the part.
    """

    fidelity: Literal["exactly", "approximated", "not said"]
    text: str


def exactly(text: str) -> Answer:
    """The model has the part, to the accuracy of time steps. `text` names the element."""
    return Answer("exactly", text)


def nearly(text: str) -> Answer:
    """The model has something near. `text` names the element, and says how far off it is."""
    return Answer("approximated", text)


def unsaid(text: str) -> Answer:
    """The model lacks the part. `text` says why."""
    return Answer("not said", text)


class Wave(NamedTuple):
    """A torque A sin(n x + phase) that drives a side, N m; n = 0 makes it constant."""

    amplitude: Number
    harmonic: Number
    phase: Number


class Bristles(NamedTuple):
    """LuGre friction of a side.

    Attributes:
        stiffness: sigma_0, N m/rad.
        damping: sigma_1, N m s/rad.
        sliding: torque while sliding, N m.
        breakaway: torque at break-away, N m.
        speed: speed over which friction falls from break-away to sliding, rad/s.
    """

    stiffness: Number
    damping: Number
    sliding: Number
    breakaway: Number
    speed: Number


class Pendulum(NamedTuple):
    """An eccentric mass on a turning side: m g l in N m, and the position in rad at which it hangs down."""

    torque: Number
    phase: Number


class FlexibleInertia(NamedTuple):
    """A further inertia (kg m^2) behind a spring (N m/rad) and a damper (N m s/rad) on a side."""

    inertia: Number
    stiffness: Number
    damping: Number


class Spring(NamedTuple):
    """A spring that is slack between the lengths `low` and `high` (rad).

    At a deflection x beyond them its torque is linear x + cubic x^3 (N m).
    """

    linear: Number
    cubic: Number
    low: Number
    high: Number


@dataclass
class SideParts:
    """One side of the drive.

    Attributes:
        inertia: kg m^2, with that of the effects.
        slides: True if the side moves along a line.
        viscous: viscous friction, N m s/rad.
        drag: N m s^2/rad^2.
        dry: dry friction, N m.
        waves, bristles, pendulums, flexible_inertias, springs: further elements on the side.
    """

    inertia: Number
    slides: bool = False
    viscous: Number = 0.0
    drag: Number = 0.0
    dry: Number = 0.0
    waves: list[Wave] = field(default_factory=list)
    bristles: list[Bristles] = field(default_factory=list)
    pendulums: list[Pendulum] = field(default_factory=list)
    flexible_inertias: list[FlexibleInertia] = field(default_factory=list)
    springs: list[Spring] = field(default_factory=list)


@dataclass
class ActuatorParts:
    """The chain from input to torque, in MuJoCo's order: delay (s), limit, first-order lag (s), gain, torque limit (N m)."""

    delay: Number = 0.0
    limit: Number = math.inf
    lag: Number | None = None
    gain: Number = 1.0
    torque_limit: Number = math.inf

    def scale(self, factor: Number) -> None:
        """Multiply the torque by a factor."""
        self.gain *= factor
        self.torque_limit *= abs(factor)

    def clip(self, limit: Number) -> None:
        """Limit the torque, N m."""
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
        step: time step that the gear needs, s.
        half_gap: half of the free play, rad at the motor; it widens the dead band of every spring in the gear.
        damping: of the gear outside of the gap, N m s/rad.
        springs: of the gear, in parallel.
        longest_step: longest time step that the effects allow, s.
    """

    sides: dict[str, SideParts]
    ratio: Number | None
    step: Number
    half_gap: Number = 0.0
    damping: Number = 0.0
    springs: list[Spring] = field(default_factory=list)
    actuator: ActuatorParts = field(default_factory=ActuatorParts)
    longest_step: Number = math.inf

    def resolve_rate(self, rate: Number) -> None:
        """Limit the time step so that it resolves a rate (rad/s or 1/s)."""
        if rate > 0.0:
            self.longest_step = min(self.longest_step, RESOLUTION / rate)

    def shorten_step(self, factor: Number) -> Number:
        """Limit the time step to the gear's over a factor. Returns the limit, s."""
        self.longest_step = min(self.longest_step, self.step / factor)
        return self.step / factor

    @property
    def mobility(self) -> float:
        """Acceleration of the twist for a torque in the gear of 1 N m, rad/s^2."""
        assert self.ratio is not None
        return 1.0 / self.sides["motor"].inertia + self.ratio**2 / self.sides["load"].inertia

    def add_wave(self, side: str, amplitude: Number, harmonic: Number, phase: Number) -> None:
        """Add a torque that resists on a side: A sin(n x + phase), N m and rad."""
        if amplitude:
            self.sides[side].waves.append(Wave(-amplitude, harmonic, phase))
            self.resolve_rate(math.sqrt(abs(amplitude * harmonic) / self.sides[side].inertia))

    def add_constant_torque(self, side: str, torque: Number) -> None:
        """Add a constant torque that resists on a side, N m."""
        self.add_wave(side, torque, 0.0, 0.5 * math.pi)

    def add_bristles(self, side: str, bristles: Bristles) -> None:
        """Add LuGre friction to a side."""
        self.sides[side].bristles.append(bristles)
        self.resolve_rate(math.sqrt(bristles.stiffness / self.sides[side].inertia))
        self.resolve_rate(bristles.damping / self.sides[side].inertia)

    def add_gear_spring(self, linear: Number, cubic: Number = 0.0, slack: Number = 0.0) -> None:
        """Add a spring to the gear, slack for twists up to `slack` (rad) beyond the gap; N m/rad and N m/rad^3."""
        self.springs.append(Spring(linear, cubic, -slack, slack))

    def add_piecewise_torque(self, side: str, points: Sequence[Number], torques: Sequence[Number]) -> None:
        """Add a torque that resists on a side (N m).

        It is linear between points of the side's position (rad), and constant beyond the first and the last.
        """
        slope = 0.0
        self.add_constant_torque(side, torques[0])
        for i, point in enumerate(points):
            is_last = i + 1 == len(points)
            next_slope = 0.0 if is_last else (torques[i + 1] - torques[i]) / (points[i + 1] - point)
            # slack below its point
            self.sides[side].springs.append(Spring(next_slope - slope, 0.0, -_INFINITY, point))
            self.resolve_rate(math.sqrt(abs(next_slope) / self.sides[side].inertia))
            slope = next_slope
