"""The truth behind the kind `workshop`: an axis with the friction, the drive and the encoders that workshops have.

Equations (SI units; one inertia, or two with a stiff gear in between):

    J_e dω_e/dt = u_a - f_e ω_e - friction - cogging - offset - C [- gravity, of one inertia]
    J_s dω_s/dt = N C - f_s ω_s - gravity
    C = K (θ_e - N θ_s + e(θ_s)) + D (ω_e - N ω_s)

Dry friction is the elasto-plastic bristle of Dupont, Hayward, Armstrong and Altpeter (IEEE TAC 47, 2002): below break-away a
purely elastic contact, which does not creep at standstill, unlike Dahl's and LuGre's:

    friction = σ_0 z + σ_1 dz/dt,   dz/dt = ω (1 - α(z, ω) sign(ω) z / z_s)
    σ_0 z_s = F_c + (F_s - F_c) exp(-(ω/ω_s)²) + μ |L|

L is what the gear transmits, or on one inertia the gravity torque. Integrator: half a step of the positions, one of the
speeds, half a step of the positions (Strang). A half step of the bristle is an exponential, exact for the speed and the α of
its middle, and so stable at any speed; a step of the speeds is the trapezoidal rule for what is viscous. Checked against
SciPy in tests/benchmarks.

The drive is a cascade (position, then speed with an integral part) on the encoder's counts, at its own rate, with a
first-order current loop behind it.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

try:
    from numba import njit  # type: ignore[import-not-found]
except ImportError:  # slower, and the same

    def njit(**_options: Any) -> Any:
        return lambda function: function


STEP = 4e-5
"""Longest step, s; a sample has at least 50. With a tenth of it positions change by less than a step of the encoder (rms; in
free runs by two, as they end a little elsewhere), and friction by less than 1 % of the driving torque."""
_SHARE = 0.08
"""Longest step over the time in which the stiffest part turns by 1 rad."""
_ELASTIC = 0.7
"""Share of the break-away deflection below which a contact is purely elastic."""

EFFECTS = ("dry", "under_load", "cogging", "gravity", "offset", "eccentricity")
"""Columns of :attr:`Truth.torques`."""


@dataclass(frozen=True)
class Axis:
    """A machine; SI units, load numbers at the load, all else at the motor.

    Attributes:
        inertia, viscous: of the motor, or of all where there is one inertia.
        friction: F_c, N m. `rise` is F_s / F_c, `fall` the speed ω_s, rad/s.
        length: way over which the contacts bend, F_c / σ_0, rad.
        under_load: μ.
        waves, amplitude, phase, double: cogging A (sin(nθ + phase) + double sin(2(nθ + phase))).
        gravity, hangs: m g l, N m, and the position at which the mass hangs down, rad.
        offset: constant torque against the drive, N m.
        ratio, stiffness, damping: of the gear; a stiffness of 0 is one inertia.
        eccentric, eccentric_phase: amplitude on the motor side, rad, once a turn of the load.
    """

    inertia: float
    viscous: float
    friction: float
    rise: float = 1.0
    fall: float = 1.0
    length: float = 1e-3
    under_load: float = 0.0
    waves: float = 1.0
    amplitude: float = 0.0
    phase: float = 0.0
    double: float = 0.0
    gravity: float = 0.0
    hangs: float = 0.0
    offset: float = 0.0
    load_inertia: float = 1.0
    load_viscous: float = 0.0
    ratio: float = 1.0
    stiffness: float = 0.0
    damping: float = 0.0
    eccentric: float = 0.0
    eccentric_phase: float = 0.0

    @property
    def geared(self) -> bool:
        return self.stiffness > 0.0


@dataclass(frozen=True)
class Drive:
    """Controller and encoder.

    Attributes:
        period: of the controller, s.
        position, speed, integral: gains in 1/s, N m s/rad and N m/rad; without `position` it is a speed controller.
        smoothing: share 0..1 of a new difference of counts in the speed.
        limit: N m; `torque_step`: of a command in counts, N m, 0 for none.
        lag: time constant of the current loop, s.
        motor_step, load_step: of the encoders, rad; `noise`: before the counts, in steps.
    """

    period: float
    position: float
    speed: float
    integral: float
    smoothing: float
    limit: float
    torque_step: float = 0.0
    lag: float = 0.0
    motor_step: float = 1e-4
    load_step: float = 1e-4
    noise: float = 0.2


@dataclass(frozen=True)
class Truth:
    """A run, one row a sample of the log.

    Attributes:
        command: held from the sample on, N m, shape (samples,).
        current: torque of the motor at the sample, N m, shape (samples,).
        readings: of the encoders, rad, shape (samples, 2).
        states: θ_e, ω_e, θ_s, ω_s, shape (samples, 4).
        torques: of :data:`EFFECTS`, N m at the motor, shape (samples, 6); of the eccentricity its part of the elastic one.
    """

    command: np.ndarray
    current: np.ndarray
    readings: np.ndarray
    states: np.ndarray
    torques: np.ndarray = field(repr=False)


@njit(cache=True)
def _bend(z: float, v: float, h: float, most: float) -> float:
    """Deflection after h seconds at one speed: exact for a share α of slip, which is that of the middle of the way."""
    share = _slip(_slide(z, v, 0.5 * h, most, _slip(z, v, most)), v, most)
    return _slide(z, v, h, most, share)


@njit(cache=True)
def _slide(z: float, v: float, h: float, most: float, share: float) -> float:
    """Deflection after h seconds at one speed and one share of slip."""
    if share == 0.0:
        return z + v * h
    steady = most / share if v > 0.0 else -most / share
    return steady + (z - steady) * math.exp(-share * abs(v) * h / most)


@njit(cache=True)
def _slip(z: float, v: float, most: float) -> float:
    """α: 0 of an elastic contact, 1 of one that slides."""
    x = abs(z) / most
    if z * v <= 0.0 or x <= _ELASTIC:
        return 0.0
    if x >= 1.0:
        return 1.0
    return 0.5 + 0.5 * math.sin(math.pi * (x - 0.5 * (1.0 + _ELASTIC)) / (1.0 - _ELASTIC))


@njit(cache=True)
def _loop(
    axis, drive, reference, rate, on, unit, every, fine, start, kicks, command, current, readings, states, torques
):  # fmt: skip
    (inertia, viscous, friction, rise, fall, length, under, waves, amplitude, phase, double, gravity, hangs, offset,
     load_inertia, load_viscous, ratio, stiffness, damping, eccentric, turn_phase) = axis  # fmt: skip
    (period, k_position, k_speed, k_integral, smoothing, limit, torque_step, lag, motor_step, load_step, noise) = drive
    geared = stiffness > 0.0
    hard = friction / length
    bristle_damping = 0.6 * math.sqrt(hard * inertia)
    h = period / fine
    x, v, q, w = start
    z, acting, integral, speed = 0.0, 0.0, 0.0, v
    before = motor_step * round(x / motor_step)
    held, load = 0.0, (stiffness * (x - ratio * q + eccentric * math.sin(q + turn_phase)) if geared else (
        gravity * math.sin(x - hangs)))  # fmt: skip
    for k in range(len(reference)):
        row = k // every
        reading = motor_step * math.floor(x / motor_step + noise * unit[k, 0] + 0.5)
        if k > 0:
            speed += smoothing * ((reading - before) / period - speed)
        before = reading
        if on[k]:
            error = rate[k] - speed
            if k_position > 0.0:
                error += k_position * (reference[k] - reading)
            held = k_speed * error + integral
            if abs(held) < limit:
                integral += k_integral * period * error
            held = min(max(held, -limit), limit)
        else:
            held, integral = 0.0, 0.0
        if torque_step > 0.0:
            held = torque_step * math.floor(held / torque_step + 0.5)
        if k % every == 0:
            command[row], current[row] = held, held if lag == 0.0 else acting
            readings[row, 0] = reading
            readings[row, 1] = load_step * math.floor(q / load_step + noise * unit[k, 1] + 0.5)
            states[row, 0], states[row, 1], states[row, 2], states[row, 3] = x, v, q, w
        for i in range(fine):
            # positions, half a step
            fallen = friction * (1.0 + (rise - 1.0) * math.exp(-((v / fall) ** 2)))
            z = _bend(z, v, 0.5 * h, (fallen + under * abs(load)) / hard)
            x += 0.5 * h * v
            q += 0.5 * h * w
            # speeds
            if lag > 0.0:
                middle = held + (acting - held) * math.exp(-0.5 * h / lag)
                acting = held + (acting - held) * math.exp(-h / lag)
            else:
                middle = acting = held
            turn = waves * x + phase
            cogging = amplitude * (math.sin(turn) + double * math.sin(2.0 * turn))
            weight = gravity * math.sin((q if geared else x) - hangs)
            mesh = eccentric * math.sin(q + turn_phase)
            slope = eccentric * math.cos(q + turn_phase)
            elastic = stiffness * (x - ratio * q + mesh)
            load = elastic if geared else weight
            fallen = friction * (1.0 + (rise - 1.0) * math.exp(-((v / fall) ** 2)))
            level = fallen + under * abs(load)
            damped = bristle_damping * (1.0 - _slip(z, v, level / hard) * abs(z) * hard / level)
            if i == 0 and k % every == 0:
                dry = hard * z + damped * v
                torques[row, 0], torques[row, 1] = dry * fallen / level, dry * (level - fallen) / level
                torques[row, 2], torques[row, 3], torques[row, 4] = cogging, weight / ratio, offset
                torques[row, 5] = stiffness * mesh
            push = middle - hard * z - cogging - offset - elastic - (0.0 if geared else weight) + kicks[row]
            if geared:
                through = ratio - slope
                pull = through * elastic - weight
                a11, a12 = (viscous + damped + damping) / inertia, -damping * through / inertia
                a21, a22 = -damping * through / load_inertia, (load_viscous + damping * through * through) / load_inertia
                r1 = v - 0.5 * h * (a11 * v + a12 * w) + h * push / inertia
                r2 = w - 0.5 * h * (a21 * v + a22 * w) + h * pull / load_inertia
                m11, m12, m21, m22 = 1.0 + 0.5 * h * a11, 0.5 * h * a12, 0.5 * h * a21, 1.0 + 0.5 * h * a22
                determinant = m11 * m22 - m12 * m21
                v, w = (m22 * r1 - m12 * r2) / determinant, (m11 * r2 - m21 * r1) / determinant
            else:
                a = 0.5 * h * (viscous + damped) / inertia
                v = ((1.0 - a) * v + h * push / inertia) / (1.0 + a)
                w = v
            # positions, the other half
            x += 0.5 * h * v
            q += 0.5 * h * w
            load = stiffness * (x - ratio * q + eccentric * math.sin(q + turn_phase)) if geared else (
                gravity * math.sin(x - hangs))  # fmt: skip
            fallen = friction * (1.0 + (rise - 1.0) * math.exp(-((v / fall) ** 2)))
            z = _bend(z, v, 0.5 * h, (fallen + under * abs(load)) / hard)


def fine_steps(axis: Axis, drive: Drive, every: int, step: float = STEP) -> int:
    """Steps in one period of the controller."""
    rates = [math.sqrt(axis.friction / axis.length / axis.inertia)]
    if axis.geared:
        rates.append(math.sqrt(axis.stiffness * (1.0 / axis.inertia + axis.ratio**2 / axis.load_inertia)))
    longest = min(step, _SHARE / max(rates), drive.period * every / 50.0)
    return max(1, math.ceil(drive.period / longest - 1e-9))


def simulate(
    axis: Axis,
    drive: Drive,
    reference: np.ndarray,
    rate: np.ndarray,
    on: np.ndarray,
    every: int = 1,
    seed: int = 0,
    start: tuple[float, float, float, float] | None = None,
    kicks: np.ndarray | None = None,
    step: float = STEP,
) -> Truth:
    """Run an axis.

    Args:
        axis, drive: machine and controller.
        reference, rate: position asked for, rad, and its rate, rad/s, at each period of the controller.
        on: whether the drive is switched on, at each period.
        every: periods of the controller a sample of the log.
        seed: of the encoders' noise.
        start: θ_e, ω_e, θ_s, ω_s; left out: at rest at the first reference.
        kicks: torque besides, at each sample, N m; for trials of the axis alone.
        step: longest step, s.
    """
    rows = len(reference) // every
    unit = np.random.default_rng([seed, 11]).standard_normal((rows * every, 2))
    first = float(reference[0])
    begin = (first, 0.0, first / axis.ratio, 0.0) if start is None else start
    command, current = np.zeros(rows), np.zeros(rows)
    readings, states, torques = np.zeros((rows, 2)), np.zeros((rows, 4)), np.zeros((rows, len(EFFECTS)))
    numbers = tuple(tuple(float(value) for value in vars(part).values()) for part in (axis, drive))
    window = slice(rows * every)
    _loop(
        *numbers, np.asarray(reference, float)[window], np.asarray(rate, float)[window], np.asarray(on, bool)[window], unit,
        every, fine_steps(axis, drive, every, step), tuple(float(value) for value in begin),
        np.zeros(rows) if kicks is None else np.asarray(kicks, float), command, current, readings, states, torques,
    )  # fmt: skip
    return Truth(command, current, readings, states, torques)
