"""Hidden effects of a given size: how each is drawn, and what torque it adds along a motion.

The size of an effect is the rms of the torque that it adds at the motion of the same machine without it, referred to the
motor shaft (load torques over the gear ratio), as a share of the rms of the driving torque. Where the effect is no torque:

- backlash: the elastic torque that the gap takes away at the same twist; eccentricity: the change of the elastic torque;
- saturation and lag: what they take off the commanded torque.

The size that is asked for is not always to be had; what became of it stands in the truth of the case:

- an inertia, a viscous friction or a torque gain that is off by less than the nominal numbers are uncertain cannot be told
  from them, so it is made at least `APART` times that uncertainty (the gain, which moves all numbers at once, three
  quarters of that); the nominal number is off by nothing but the effect then, which is its error;
- an inertia or a viscous friction grows fourfold at most and loses 60 % at most (in one direction, too), a dent is at most
  80 % of the driving torque's rms high, a shaft at most one and a half times critically damped, an unknown drifting
  friction at most 40 %, friction under load at most 80 % of the transmitted torque.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .simulator import Machine, Trace

_SIDES = ("coulomb_friction", "stribeck_friction", "viscous_friction", "quadratic_drag", "constant_torque", "inertia")
SIDE_EFFECTS = tuple(f"{side}.{kind}" for side in ("motor", "load") for kind in _SIDES)
LOAD_EFFECTS = ("load.gravity", "load.periodic_disturbance")
GEAR_EFFECTS = ("transmission.backlash", "transmission.hardening", "transmission.damping", "transmission.eccentricity")
ACTUATOR_EFFECTS = ("actuator.gain_error", "actuator.saturation", "actuator.lag")
EFFECTS = (*SIDE_EFFECTS, *LOAD_EFFECTS, "motor.cogging", *GEAR_EFFECTS, *ACTUATOR_EFFECTS)
"""Effects that the package knows."""
PINION = "transmission.pinion"
"""Eccentricity of the motor's wheel: to the package a `transmission.eccentricity` of as many periods as the ratio says."""
_FRICTIONS = (f"{side}.{kind}_friction" for kind in ("presliding", "drifting", "asymmetric") for side in ("motor", "load"))
NEW = (
    "motor.torque_ripple", PINION, *_FRICTIONS, "transmission.load_friction", "motor.cogging_harmonics",
    "transmission.hysteresis", "load.flexibility", "actuator.delay",
)  # fmt: skip
"""Effects of the kind `new`: other kinds keep their cases."""
UNKNOWN = ("unknown.drifting_friction", "unknown.hysteresis", "unknown.dent", "unknown.random_torque")
LEVELS = (0.03, 0.1, 0.3)
"""Sizes as shares of the driving torque's rms; the first is called weak."""
APART = 4.0
"""Least change of a nominal number that counts as an effect, in standard deviations of the nominal one."""
_LARGEST, _LEAST = 3.0, -0.6


def on_rigid(effect: str) -> bool:
    """True if an effect has a meaning on a rigid drive."""
    return not effect.startswith("transmission.") and not (effect.startswith("load.") and effect not in LOAD_EFFECTS)


def error_of(effect: str) -> str | None:
    """The number of the drive that an effect is the error of."""
    side, _, kind = effect.partition(".")
    return {"inertia": f"{side}_inertia", "viscous_friction": f"{side}_viscous"}.get(kind) if side != "actuator" else None


def exclusive(first: str, second: str) -> bool:
    """True if two effects are too much alike to be hidden, or known, together."""
    place = first.split(".")[0]
    pair = {first, second}
    dry = {f"{place}.{kind}_friction" for kind in ("coulomb", "stribeck", "presliding", "drifting")}
    scaling = {"actuator.gain_error", "motor.inertia", "motor.viscous_friction"}
    return first == second or pair <= dry or (pair <= scaling and "actuator.gain_error" in pair)


@dataclass(frozen=True)
class Motion:
    """The run on which effects are sized, one number a sample."""

    machine: Machine
    period: float
    u: np.ndarray
    position: dict[str, np.ndarray]
    velocity: dict[str, np.ndarray]
    acceleration: dict[str, np.ndarray]
    deflection: np.ndarray
    rate: np.ndarray

    @classmethod
    def of(cls, machine: Machine, trace: Trace) -> "Motion":
        period = float(trace.t[1])
        theta_e, w_e, theta_s, w_s = trace.states
        ratio, law = machine.ratio, machine.transmission or {}
        z = theta_e - ratio * theta_s
        half = law.get("half_gap", 0.0)
        contact = np.abs(z) > half
        return cls(
            machine,
            period,
            trace.command,
            {"motor": theta_e, "load": theta_e if machine.rigid else theta_s},
            {"motor": w_e, "load": w_e if machine.rigid else w_s},
            {side: np.gradient(w, period) for side, w in (("motor", w_e), ("load", w_s))},
            z - np.clip(z, -half, half),
            np.where(contact, w_e - ratio * w_s, 0.0),
        )

    def elastic(self, extra: np.ndarray | float = 0.0, gap: float = 0.0) -> np.ndarray:
        """Transmitted torque with `extra` twist, N m."""
        law = self.machine.transmission or {}
        theta_e, theta_s = self.position["motor"], self.position["load"]
        half = law.get("half_gap", 0.0) + gap
        z = theta_e - self.machine.ratio * theta_s + extra
        bent = z - np.clip(z, -half, half)
        soft = 4.0 * law.get("dead_zone", 0.0) * np.tanh(0.5 * law.get("slope", 0.0) * bent)
        return law.get("stiffness", 0.0) * (bent - soft)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


Effect = dict[str, float | str]
Torque = Callable[[float], np.ndarray]


def draw(kind: str, size: float, motion: Motion, uncertainty: float, rng: np.random.Generator) -> tuple[list[Effect], float]:
    """An effect of a size along a motion.

    Args:
        kind: name of the effect.
        size: asked for, as a share of the driving torque's rms.
        motion: of the machine without it.
        uncertainty: relative standard deviation of the nominal numbers.
        rng: of whatever else there is to choose.

    Returns:
        The effect as a list of one, and the size that it has.
    """
    build, torque, least, most = _shape(kind, motion, uncertainty, rng)
    scale = rms(motion.u)
    target = size * scale

    def add_effect(amount: float) -> float:
        return rms(torque(amount))

    # all grow with their amount, most in proportion to it
    low, high = 1e-9, 1.0
    while add_effect(high) < target and high < 1e9:
        low, high = high, high * 10.0
    for _ in range(60):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if add_effect(middle) < target else (low, middle)
    amount = min(max(high, least), most)
    return [{"kind": kind, **build(amount)}], add_effect(amount) / scale


def _shape(
    kind: str, motion: Motion, uncertainty: float, rng: np.random.Generator
) -> tuple[Callable[[float], Effect], Torque, float, float]:
    """Parameters and motor-referred torque of an effect as functions of its amount, and the bounds of that."""
    place, name = kind.split(".")
    machine, u = motion.machine, motion.u
    side = "load" if place == "load" and not machine.rigid else "motor"
    if place == "unknown":
        side = "motor" if machine.rigid or (name == "hysteresis" and rng.random() < 0.5) else "load"
    over = machine.ratio if side == "load" else 1.0
    x, v, a = motion.position[side], motion.velocity[side], motion.acceleration[side]
    speed, sign = rms(v), float(rng.choice([-1.0, 1.0]))
    phase = float(rng.uniform(-math.pi, math.pi))
    half_turn = 0.5 * math.pi
    drive = machine.drive

    def linear(key: str, wave: np.ndarray, /, least: float = 0.0, most: float = math.inf, factor: float = 1.0, **more):
        return lambda c: {key: factor * c, **more}, lambda c: c * wave / over, least, most

    match name:
        case "coulomb_friction":
            return linear("torque", np.sign(v))
        case "stribeck_friction":
            excess, width = rng.uniform(0.8, 1.5), rng.uniform(0.2, 0.5) * speed
            wave = np.sign(v) * (1.0 + excess * np.exp(-((v / width) ** 2)))
            return (
                lambda c: {"torque": c, "breakaway_torque": c * (1.0 + excess), "stribeck_velocity": width},
                lambda c: c * wave / over, 0.0, math.inf,
            )  # fmt: skip
        case "viscous_friction" | "inertia":
            key = name.removesuffix("_friction")
            number = drive[f"{side}_{key}"]
            # less of it only where there is enough to take away
            wave = v if key == "viscous" else a
            share = LEVELS[1] * rms(u) * over / (number * rms(wave))
            sign = sign if share < -_LEAST and APART * uncertainty < -_LEAST else 1.0
            most = number * (_LARGEST if sign > 0.0 else -_LEAST)
            return linear(key, wave, least=APART * uncertainty * number, most=most, factor=sign)
        case "quadratic_drag":
            return linear("drag", v * np.abs(v))
        case "constant_torque":
            return linear("torque", np.ones_like(v), factor=sign)
        case "gravity":
            # swinging around any position, not balanced on top
            phase = float(np.mean(x)) + float(rng.uniform(-half_turn, half_turn))
            return linear("torque", np.sin(x - phase), phase=phase)
        case "periodic_disturbance":
            frequency = float(rng.uniform(0.7, 6.0))
            t = np.arange(len(u)) * motion.period
            wave = np.sin(2.0 * math.pi * frequency * t + phase)
            return linear("amplitude", wave, frequency=frequency, phase=phase)
        case "cogging":
            harmonic = float(rng.choice([6, 8, 12, 14, 18, 24] if not machine.rigid else [6, 8, 12, 18, 24, 36]))
            return linear("amplitude", np.sin(harmonic * x + phase), harmonic=harmonic, phase=phase)
        case "cogging_harmonics":
            base, phases = float(rng.choice([3, 4, 6, 7, 8, 9])), rng.uniform(-math.pi, math.pi, 3)
            shares = [1.0, *rng.uniform(0.3, 0.8, 2)]
            parts = {}
            for k, (share, turn) in enumerate(zip(shares, phases, strict=True), 1):
                end = f"_{k}" if k > 1 else ""
                parts |= {f"sine{end}": share * math.cos(turn), f"cosine{end}": share * math.sin(turn)}
            wave = np.sin(np.outer((1, 2, 3), base * x) + phases[:, None]).T @ shares
            return (
                lambda c: {"harmonic": base} | {key: c * value for key, value in parts.items()},
                lambda c: c * wave, 0.0, math.inf,
            )  # fmt: skip
        case "flexibility":
            # seen in the speeds that the drive has, and lightly damped
            frequency, damping = float(np.exp(rng.uniform(*np.log([2.0, 15.0])))), float(rng.uniform(0.01, 0.1))
            wave = _swinging(v, motion.period, 2.0 * math.pi * frequency, damping)
            most = _LARGEST * drive[f"{side}_inertia"]
            return linear("inertia", wave, most=most, frequency=frequency, damping_ratio=damping)
        case "hysteresis" if place == "transmission":
            length = float(rng.uniform(0.1, 0.5) * np.std(motion.deflection))
            return linear("torque", _bouc_wen(motion.rate, motion.period, length), length=length)
        case "torque_ripple":
            # one or two periods a pole pair: offset of a current sensor, unequal gains
            harmonic = float(rng.choice([1, 2]) * rng.choice([2, 3, 4, 5, 7]))
            return linear("amplitude", u * np.sin(harmonic * x + phase), harmonic=harmonic, phase=phase)
        case "backlash":
            plain = motion.elastic()
            return lambda c: {"half_gap": c}, lambda c: motion.elastic(gap=c) - plain, 0.0, math.inf
        case "hardening":
            return linear("cubic_stiffness", motion.deflection**3)
        case "damping":
            reduced = 1.0 / (1.0 / drive["motor_inertia"] + machine.ratio**2 / drive["load_inertia"])
            critical = 2.0 * math.sqrt((machine.transmission or {})["stiffness"] * reduced)
            return linear("damping", motion.rate, most=1.5 * critical)
        case "eccentricity" | "pinion":
            harmonic = (
                float(rng.choice([1, 1, 2, 3])) if name == "eccentricity" else machine.ratio * float(rng.choice([1, 2]))
            )
            wave, plain = np.sin(harmonic * motion.position["load"] + phase), motion.elastic()
            return (
                lambda c: {"kind": "transmission.eccentricity", "amplitude": c, "harmonic": harmonic, "phase": phase},
                lambda c: motion.elastic(c * wave) - plain, 0.0, math.inf,
            )  # fmt: skip
        case "gain_error":
            return lambda c: {"relative": sign * c}, lambda c: c * u, 0.75 * APART * uncertainty, math.inf
        case "saturation":
            # the less the limit the more it takes: amount is the share of the largest torque that is cut off
            top = float(np.max(np.abs(u)))
            return (
                lambda c: {"limit": top / (1.0 + c)},
                lambda c: u - np.clip(u, -top / (1.0 + c), top / (1.0 + c)), 0.0, math.inf,
            )  # fmt: skip
        case "delay":
            # of whole samples; controllers and buses have a few
            def shift_phase(c: float) -> np.ndarray:
                late = _samples_of(c, motion.period)
                return u - np.concatenate([np.zeros(late), u[: len(u) - late]])

            return lambda c: {"delay": _samples_of(c, motion.period) * motion.period}, shift_phase, 0.0, math.inf
        case "lag":
            return lambda c: {"time_constant": c}, lambda c: u - _lag(u, motion.period, c), 0.0, math.inf
        case "presliding_friction":
            length = float(np.exp(rng.uniform(*np.log([0.02, 0.3])))) * float(np.std(x))
            return linear("torque", dahl(v, motion.period, length), length=length)
        case "asymmetric_friction":
            # friction must not drive
            return linear("viscous_difference", 0.5 * np.abs(v), most=1.2 * drive[f"{side}_viscous"], factor=sign)
        case "load_friction":
            # all but self-locking at most
            return linear("coefficient", np.abs(motion.elastic()) * np.sign(v), most=0.8)
        case "drifting_friction" if place != "unknown":
            # falls to between a third and two thirds
            warm, time = float(rng.uniform(0.3, 0.7)), float(rng.uniform(0.1, 0.5)) * len(u) * motion.period
            wave = np.sign(v) * (warm + (1.0 - warm) * np.exp(-np.arange(len(u)) * motion.period / time))
            return (
                lambda c: {"torque": c * warm, "initial_torque": c, "time_constant": time},
                lambda c: c * wave / over, 0.0, math.inf,
            )  # fmt: skip
        case "drifting_friction":
            share = float(rng.uniform(0.7, 0.95)) * sign
            drift = 1.0 - 2.0 * np.arange(len(u)) / len(u)
            wave, time = abs(share) * drift * np.sign(v), len(u) * motion.period
            return linear("torque", wave, most=0.4 * rms(u) * over, side=side, share=share, time=time)
        case "hysteresis":
            length = float(rng.uniform(0.3, 0.8) * np.std(x))
            return linear("torque", _bouc_wen(v, motion.period, length), side=side, length=length)
        case "dent":
            spread = float(np.quantile(x, 0.9) - np.quantile(x, 0.1))
            position, width = float(np.quantile(x, rng.uniform(0.3, 0.7))), float(rng.uniform(0.03, 0.1)) * spread
            wave = np.sign(v) * np.exp(-(((x - position) / width) ** 2))
            return linear("torque", wave, most=0.8 * rms(u) * over, side=side, position=position, width=width)
        case "random_torque":
            return linear("torque", np.ones_like(v), side=side)
    raise ValueError(f"unknown effect {kind}")


def dahl(v: np.ndarray, period: float, length: float) -> np.ndarray:
    """Share of the sliding friction that bent contacts have along a motion."""
    w = np.zeros_like(v)
    for k in range(1, len(v)):
        way, end = abs(v[k]) * period / length, math.copysign(1.0, v[k])
        w[k] = end + (w[k - 1] - end) * math.exp(-way)
    return w


def _samples_of(delay: float, period: float) -> int:
    return int(min(max(round(delay / period), 1), 12))


def _lag(u: np.ndarray, period: float, time_constant: float) -> np.ndarray:
    """Mean over each sample of a first-order lag of the held torque."""
    from scipy.signal import lfilter

    keep = math.exp(-period / time_constant)
    after = lfilter([1.0 - keep], [1.0, -keep], u)
    before = np.concatenate([[0.0], after[:-1]])
    return u + (before - u) * (time_constant / period) * (1.0 - keep)


def _bouc_wen(v: np.ndarray, period: float, length: float) -> np.ndarray:
    """The hysteresis of the simulator along a given motion."""
    w = np.zeros_like(v)
    for k in range(len(v) - 1):
        now = w[k]
        w[k + 1] = now + period / length * (v[k] - 0.5 * (abs(v[k]) * now * abs(now) + v[k] * now * now))
    return w


def _swinging(v: np.ndarray, period: float, rate: float, damping: float) -> np.ndarray:
    """Acceleration of what hangs on a moving side by a spring and a damper, rad/s^2."""
    from scipy.signal import cont2discrete, dlsim

    system = np.array([[0.0, 1.0], [-(rate**2), -2.0 * damping * rate]]), np.array([[-1.0], [2.0 * damping * rate]])
    outputs = np.array([[-(rate**2), -2.0 * damping * rate]]), np.array([[2.0 * damping * rate]])
    discrete = cont2discrete((*system, *outputs), period, "foh")
    return dlsim(discrete, v)[1][:, 0]
