"""Cases of the kind `workshop`: machines as people record them, each case a folder with logs, model and truth.

Twelve recipes take turns. Each fixes what makes it a recipe, and draws the rest: gains from soft to stiff, period, encoder,
format of the file, size of the machine, what it has of effects together, and how well its numbers are known.

- velocity, position: a speed or position controller, and the current that the drive *measures* at the stamp;
- counts: a position controller that logs its command to the power stage in counts;
- constant_speeds: forth and back, one log each, other speeds held out;
- slow_turns: a few revolutions forth and back;
- spin_downs: spin-ups, and free runs down with the drive switched off;
- pendulum: moves of a pendulum that stands still half of the time;
- arm: friction under load; an arm with one encoder, or geared with two;
- host_stamps: 100 Hz, stamped by the host, with jitter;
- coarse: an encoder of 12 bits;
- two_encoders: a geared axis whose encoders have different zeros, and whose gear is eccentric;
- numbers_alone: the model has all effects, and its numbers are off, by what it states or by more.

Dry friction is always there. All effects that a case is asked for are seen: at least `_LEAST` of the driving torque (of a
cogging also `_UNALIASED`), or the case is drawn again. The truth has the rms torque of each over the logs that are fitted;
the main effect is the largest.
"""

import json
import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from numpy.typing import ArrayLike

from .bristle import EFFECTS, Axis, Drive, Truth, simulate
from .effects import rms
from .named import admissible_names

RECIPES = (
    "velocity", "position", "counts", "constant_speeds", "slow_turns", "spin_downs",
    "pendulum", "arm", "host_stamps", "coarse", "two_encoders", "numbers_alone",
)  # fmt: skip
WAVES = (3, 4, 6, 7, 8, 9, 10, 12, 14, 18, 20, 24, 30, 36, 42, 48, 60, 72, 84, 96, 120, 144, 168, 180, 216, 250)
"""Periods a turn of cogging: least common multiples of slots and poles, from small motors to torque motors."""
RELATIVE = (0.1, 0.2, 0.3, 0.5)
"""How well the numbers of a model are known."""
_ROUGHER = 0.05, (0.2, 0.5)
"""Of numbers that are further off than stated: what is stated, and by how much they are off."""
_LEAST = 0.05
"""Least rms torque of an effect as a share of the driving torque's."""
_UNALIASED = 0.35, 0.3
"""Waves below this share of the sampling rate, in at least this share of the moving samples: else no log shows them."""
_MOVING = 0.02
"""Share of the largest speed above which an axis moves."""
_MOST_DRAWS = 60


@dataclass(frozen=True)
class Motion:
    """What is asked of the axis in one log, at the controller's period: speed, rad/s, and whether the drive is on."""

    rate: np.ndarray
    on: np.ndarray


@dataclass(frozen=True)
class Setup:
    """A case before it is simulated.

    Attributes:
        motions: of the logs, and those of `held` last, which are held out; without these it is the last quarter.
        every: controller periods a sample.
        current: whether u is the measured current, noisy, at the stamp; else it is the command, held from the stamp on.
        jitter: of the stamps, s; `offset` between the encoders, rad at the load.
        stands: whether it has to stand still about half of the time.
    """

    axis: Axis
    drive: Drive
    motions: tuple[Motion, ...]
    held: int
    every: int
    current: bool
    jitter: float = 0.0
    offset: float = 0.0
    stands: bool = False


@dataclass(frozen=True)
class WorkshopCase:
    """A case: name, model as a study, truth as plain data, logs and held-out logs as columns, and the same as a person reads
    them: `t`, `u`, `theta_e`, `theta_s` in SI units, of the fitted and the held-out part."""

    name: str
    model: dict[str, Any]
    truth: dict[str, Any]
    logs: list[dict[str, np.ndarray]]
    holdout: list[dict[str, np.ndarray]]
    plain: list[dict[str, np.ndarray]]
    runs: list[Truth] = field(repr=False)


def draw_case(seed: int, index: int) -> WorkshopCase:
    """Draw the case of a number; the same seed and number give the same case."""
    recipe = RECIPES[index % len(RECIPES)]
    for draw_number in range(_MOST_DRAWS):
        rng = np.random.default_rng([seed, index, draw_number, 12])
        setup = _setup(recipe, index // len(RECIPES), rng)
        runs = _simulate(setup, int(rng.integers(2**31)))
        effects = _effects(setup, runs)
        if effects is not None:
            return _case(f"workshop-{seed}-{index:03d}", recipe, index // len(RECIPES), setup, runs, effects, rng)
    raise RuntimeError(f"no fit case in {_MOST_DRAWS} draws for {recipe}, seed {seed}, number {index}")


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """A number, evenly on a logarithmic scale."""
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


# ---- machines ----

_EXTRAS: dict[str, tuple[tuple[str, ...], ...]] = {
    "velocity": (("cogging",), ("offset",), ("cogging", "offset"), ("gravity",), ("gravity", "cogging")),
    "position": (("gravity",), ("cogging",), ("gravity", "offset"), ("cogging", "gravity"), ("cogging", "offset")),
    "counts": (("gravity",), ("cogging",), ("offset",), ("gravity", "offset")),
    "constant_speeds": (("gravity",), ("cogging",), ("gravity", "offset"), ("cogging", "gravity")),
    "slow_turns": (("cogging",), ("cogging", "gravity"), ("cogging", "offset"), ("cogging", "gravity", "offset")),
    "spin_downs": (("offset",), ("gravity",), ("cogging",), ("gravity", "offset")),
    "pendulum": (("gravity",), ("gravity", "offset"), ("gravity", "cogging")),
    "arm": (("gravity", "under_load"), ("gravity", "under_load", "offset")),
    "host_stamps": (("gravity",), ("offset",), ("cogging",), ("gravity", "offset")),
    "coarse": (("cogging",), ("gravity",), ("cogging", "offset"), ("gravity", "cogging")),
    "two_encoders": (("eccentricity",), ("eccentricity", "offset"), ("eccentricity", "cogging")),
    "numbers_alone": ((), (), ("gravity",)),
}
"""What each recipe has besides dry friction."""
_SPEEDS = {
    "slow_turns": (0.5, 2.5),
    "pendulum": (2.0, 8.0),
    "arm": (1.0, 4.0),
    "spin_downs": (20.0, 100.0),
    "position": (2.0, 20.0),
}
"""Typical speeds, rad/s at the motor; of the others between 3 and 40."""


def _axis(recipe: str, number: int, speed: float, fastest_wave: float, rng: np.random.Generator) -> Axis:
    """A machine whose friction stops it from its typical speed within 0.1 to 1.5 s."""
    friction = _between(rng, 0.005, 2.0)
    inertia = friction * _between(rng, 0.1, 1.5 if recipe != "spin_downs" else 4.0) / speed
    axis = Axis(
        inertia,
        float(rng.uniform(0.2, 1.0)) * friction / speed,
        friction,
        rise=float(rng.uniform(1.1, 1.5)) if rng.random() < 0.4 else 1.0,
        fall=float(rng.uniform(0.03, 0.15)) * speed,
        length=_between(rng, 3e-4, 5e-3),
    )
    pool = _EXTRAS[recipe]
    extras = pool[int(rng.integers(len(pool)))]
    phase, hangs = (float(value) for value in rng.uniform(-math.pi, math.pi, 2))
    if "gravity" in extras:
        # an arm weighs more than its friction, an unbalanced wheel often less
        strong = recipe in ("pendulum", "arm")
        axis = replace(axis, gravity=(float(rng.uniform(2.0, 5.0)) if strong else _between(rng, 0.4, 3.0)) * friction)
        axis = replace(axis, hangs=hangs if not strong else float(rng.uniform(-0.5, 0.5)))
    if "cogging" in extras:
        possible = [n for n in WAVES if n <= max(fastest_wave, 4.0)]
        waves, double = float(rng.choice(possible)), float(rng.uniform(0.3, 0.6)) if rng.random() < 0.3 else 0.0
        axis = replace(axis, waves=waves, phase=phase, double=double, amplitude=_between(rng, 0.3, 3.0) * friction)
    if "offset" in extras:
        axis = replace(axis, offset=float(rng.choice([-1.0, 1.0]) * rng.uniform(0.2, 0.6)) * friction)
    if "under_load" in extras:
        axis = replace(axis, under_load=float(rng.uniform(0.15, 0.4)))
    if recipe == "two_encoders" or (recipe == "arm" and number % 5 >= 3):
        axis = _gear(axis, "eccentricity" in extras, rng)
    return axis


def _gear(axis: Axis, eccentric: bool, rng: np.random.Generator) -> Axis:
    """The same with its load behind a gear that bends."""
    ratio, share = float(rng.choice([3, 5, 10, 20])), float(rng.uniform(0.3, 0.7))
    motor, load = share * axis.inertia, (1.0 - share) * axis.inertia * ratio**2
    resonance = 2.0 * math.pi * _between(rng, 8.0, 30.0)
    reduced = 1.0 / (1.0 / motor + ratio**2 / load)
    stiffness = reduced * resonance**2
    return replace(
        axis,
        inertia=motor,
        viscous=0.5 * axis.viscous,
        load_inertia=load,
        load_viscous=0.5 * axis.viscous * ratio**2,
        gravity=axis.gravity * ratio,
        ratio=ratio,
        stiffness=stiffness,
        damping=2.0 * float(rng.uniform(0.03, 0.1)) * resonance * reduced,
        eccentric=_between(rng, 0.4, 3.0) * axis.friction / stiffness if eccentric else 0.0,
        eccentric_phase=float(rng.uniform(-math.pi, math.pi)),
    )


def _drive(recipe: str, axis: Axis, speed: float, period: float, every: int, rng: np.random.Generator) -> Drive:
    """Controller with gains from soft to stiff, as stiff as its rate, its encoder and the gear allow."""
    bits = 12 if recipe == "coarse" else int(rng.choice([12, 13, 14, 16, 17, 20]))
    motor_step, load_step = 2.0 * math.pi / 2**bits, 1.0
    inertia = axis.inertia + (axis.load_inertia / axis.ratio**2 if axis.geared else 0.0)
    stiff = [0.15 / period, math.sqrt(0.05 * axis.friction / (inertia * motor_step))]
    if axis.geared:
        motor_step = 2.0 * math.pi / 2 ** int(rng.choice([14, 16, 17]))
        fine = axis.eccentric or axis.friction / axis.stiffness
        load_step = 2.0 * math.pi / 2 ** min(math.ceil(math.log2(2.0 * math.pi * axis.ratio * 4.0 / fine)), 22)
        stiff.append(0.25 * math.sqrt(axis.stiffness * (1.0 / axis.inertia + axis.ratio**2 / axis.load_inertia)))
    # constant speeds call for a controller that keeps them
    softest = 25.0 if recipe in ("constant_speeds", "slow_turns", "pendulum") else 8.0
    bandwidth = min(_between(rng, softest, 120.0), *stiff)
    gain = inertia * bandwidth
    in_position = recipe in ("position", "counts", "pendulum", "arm") or (
        recipe not in ("velocity", "spin_downs") and rng.random() < 0.5
    )  # fmt: skip
    torque = (
        axis.friction * axis.rise * 1.5 + axis.amplitude + abs(axis.offset) + 1.5 * axis.gravity / axis.ratio
        + 2.0 * axis.viscous * speed + inertia * speed / 0.05
    )  # fmt: skip
    return Drive(
        period,
        bandwidth / 4.0 if in_position else 0.0,
        gain,
        # without an integral part a pendulum comes to rest between moves
        gain * bandwidth / 4.0 if recipe != "pendulum" else 0.0,
        min(1.0, 6.0 * bandwidth * period),
        torque,
        torque_step=float(f"{torque / int(rng.choice([885, 1000, 2048])):.4g}") if recipe == "counts" else 0.0,
        lag=float(rng.uniform(3e-4, 1.5e-3)) if every > 1 else 0.0,
        motor_step=motor_step,
        load_step=load_step,
    )


# ---- motions ----


def _ramps(speeds: ArrayLike, seconds: ArrayLike, ramp: float, period: float) -> np.ndarray:
    """Constant speeds one after the other, each reached by a ramp of so many seconds."""
    seconds = np.asarray(seconds, float)
    ends = np.cumsum(seconds)
    times = np.concatenate(
        [[0.0], *([end - length + min(ramp, 0.5 * length), end] for end, length in zip(ends, seconds, strict=True))]
    )
    return np.interp(
        np.arange(round(ends[-1] / period)) * period, times, np.concatenate([[0.0], np.repeat(np.asarray(speeds), 2)])
    )


def _multisine(seconds: float, speed: float, slowest: float, period: float, rng: np.random.Generator) -> np.ndarray:
    """Six sines of speed from a slowest frequency to six times it."""
    t, k = np.arange(round(seconds / period)) * period, np.arange(1, 7)
    wave = np.sin(2.0 * math.pi * slowest * k[:, None] * t + rng.uniform(-math.pi, math.pi, (6, 1))) / np.sqrt(k)[:, None]
    rate = np.sum(wave, axis=0)
    return speed * rate / np.max(np.abs(rate)) * np.minimum(1.0, t / 0.2)


def _moves(ways: np.ndarray, moving: np.ndarray, standing: np.ndarray, period: float) -> np.ndarray:
    """Moves with smooth speed and standstills between them."""
    parts = []
    for way, move, stand in zip(ways, moving, standing, strict=True):
        n = max(2, round(move / period))
        parts += [way / (n * period) * (1.0 - np.cos(2.0 * math.pi * np.arange(n) / n)), np.zeros(round(stand / period))]
    return np.concatenate(parts)


def _setup(recipe: str, number: int, rng: np.random.Generator) -> Setup:
    """Draw machine, drive, encoder and motions of a recipe."""
    kind = recipe if recipe != "numbers_alone" else ("velocity", "position", "pendulum", "slow_turns", "counts")[number % 5]
    speed = _between(rng, *_SPEEDS.get(kind, (3.0, 40.0)))
    periods = {
        "host_stamps": [0.01],
        "constant_speeds": [2e-3, 4e-3, 5e-3],
        "pendulum": [2e-3, 5e-3, 0.01],
        "slow_turns": [2e-3, 5e-3],
    }
    sample = float(rng.choice(periods.get(kind, [1e-3, 2e-3, 4e-3] if kind != "velocity" else [1e-3, 2e-3, 5e-3, 0.01])))
    current = kind in ("velocity", "position") or (kind != "counts" and rng.random() < 0.5)
    # a drive that reports its current has a controller of its own, which is quicker than the log
    every = 1 if not current else max(4, round(sample / 1e-3))
    period = sample / every
    low = speed if kind in ("slow_turns", "constant_speeds") else 0.4 * speed
    axis = _axis(recipe, number, speed, 0.25 * 2.0 * math.pi / sample / low, rng)
    drive = _drive(kind, axis, speed, period, every, rng)
    if recipe == "numbers_alone":
        # contacts bend by less than the encoder sees: that would be an effect that the model lacks
        axis = replace(axis, rise=1.0, length=min(axis.length, 0.3 * drive.motor_step))
    # what a position controller lets through
    slow = min(0.8, (drive.position or drive.speed / axis.inertia / 4.0) / (2.0 * math.pi)) * float(rng.uniform(0.15, 0.3))
    sign = float(rng.choice([-1.0, 1.0]))
    held = 0
    length = float(rng.uniform(12.0, 22.0))
    if kind == "constant_speeds":
        shares = (0.35, 0.6, 1.0)[: int(rng.integers(2, 4))]
        seconds = float(rng.uniform(3.0, 6.0))
        held_shares = (0.5,) if rng.random() < 0.5 else (0.5, -0.5)
        every_share = [direction * share for share in shares for direction in (1.0, -1.0)] + [*held_shares]
        rates, held = [_ramps([share * speed], [seconds], 0.3, period) for share in every_share], len(held_shares)
    elif kind == "slow_turns":
        way = 2.0 * math.pi * float(rng.uniform(0.5, 1.5))
        turns = max(4, round(length / (way / speed + 0.5)))
        shares = rng.uniform(0.6, 1.2, turns)
        rates = [_ramps(sign * (-1.0) ** np.arange(turns) * shares * speed, way / (shares * speed), 0.2, period)]
    elif kind == "spin_downs":
        stop = axis.inertia * speed / (axis.friction + 0.5 * axis.viscous * speed)
        count = max(4, min(8, round(20.0 / (1.5 + 1.3 * stop))))
        shares = rng.uniform(0.4, 1.0, count) * (-1.0) ** np.arange(count) * sign
        rates = [np.concatenate([_ramps([share * speed, 0.0], [1.2, 0.3 + 1.3 * stop], 0.3, period) for share in shares])]
    elif kind == "pendulum":
        count = int(rng.integers(10, 16))
        way = rng.uniform(0.4, 1.4, count)
        way = np.diff(np.concatenate([[0.0], sign * (-1.0) ** np.arange(count) * way]))
        moving = np.abs(way) * 2.0 / speed * rng.uniform(0.8, 1.5, count)
        rates = [_moves(way, moving, moving * rng.uniform(0.8, 1.4, count), period)]
    elif kind == "arm":
        rates = [_multisine(length, speed * axis.ratio, slow, period, rng)]
    else:
        rates = [_multisine(length, speed, slow, period, rng)]
        if kind in ("velocity", "coarse", "host_stamps") and rng.random() < 0.5:
            count = round(length / 1.0)
            levels = rng.uniform(0.1, 1.0, count) * rng.choice([-1.0, 1.0], count)
            rates = [_ramps(levels * speed, np.full(count, 1.0), 0.25, period)]
    if not held and kind in ("slow_turns", "spin_downs", "velocity", "arm", "coarse", "two_encoders") and rng.random() < 0.3:
        # another log is held out, slower and the other way round
        rates, held = [*rates, -0.8 * rates[0]], 1
    motions = tuple(Motion(rate, _switched_on(rate) if kind == "spin_downs" else np.ones(len(rate), bool)) for rate in rates)
    return Setup(
        axis,
        drive,
        motions,
        held,
        every,
        current,
        jitter=float(rng.uniform(2e-4, 1.5e-3)) if kind == "host_stamps" else 0.0,
        offset=float(rng.uniform(-1.0, 1.0)) * 0.3 if kind == "two_encoders" else 0.0,
        stands=kind == "pendulum",
    )


def _switched_on(rate: np.ndarray) -> np.ndarray:
    """Off from where a spin-up ends."""
    return ~((np.abs(rate) == 0.0) | (np.sign(rate) * np.gradient(rate) < -1e-12))


def _simulate(setup: Setup, seed: int) -> list[Truth]:
    runs = []
    for i, motion in enumerate(setup.motions):
        reference = np.cumsum(motion.rate) * setup.drive.period
        # a weight hangs down, or is held, when a log begins
        begin = setup.axis.hangs if setup.axis.gravity and not setup.axis.geared else 0.0
        start = (begin, 0.0, begin / setup.axis.ratio, 0.0)
        runs.append(
            simulate(setup.axis, setup.drive, reference + begin, motion.rate, motion.on, setup.every, seed + i, start)
        )  # fmt: skip
    return runs


# ---- truth ----


def _effects(setup: Setup, runs: Sequence[Truth]) -> list[dict[str, Any]] | None:
    """Effects of the machine with their rms torque over the fitted logs, largest first; None if a log does not show them."""
    axis, period = setup.axis, setup.drive.period * setup.every
    fitted = runs[: len(runs) - setup.held]
    if not all(np.isfinite(run.states).all() for run in runs):
        return None
    torques, speeds = (np.concatenate([getattr(run, name) for run in fitted]) for name in ("torques", "states"))
    driving = rms(np.concatenate([run.current for run in fitted]))
    present = {
        "dry": True,
        "under_load": axis.under_load > 0.0,
        "cogging": axis.amplitude > 0.0,
        "gravity": axis.gravity > 0.0,
        "offset": axis.offset != 0.0,
        "eccentricity": axis.eccentric > 0.0,
    }
    sizes = {name: rms(torques[:, i]) for i, name in enumerate(EFFECTS) if present[name]}
    speed = np.abs(speeds[:, 1])
    moving = speed > _MOVING * np.max(speed)
    rate = axis.waves * speed[moving] / (2.0 * math.pi) * period
    limited = np.mean(np.abs(np.concatenate([run.command for run in runs])) >= 0.999 * setup.drive.limit)
    travels = [np.ptp(run.states[:, 2 if axis.geared else 0]) for run in fitted]
    if setup.stands and abs(np.mean(moving) - 0.5) > 0.15:
        return None
    seen = (
        all(size >= _LEAST * driving for size in sizes.values())
        and np.mean(moving) > 0.2
        and limited < 0.02
        and max(travels) < 3000.0
        and (axis.amplitude == 0.0 or np.mean(rate < _UNALIASED[0]) > _UNALIASED[1])
        and (axis.amplitude == 0.0 or max(np.ptp(run.states[:, 0]) for run in fitted) * axis.waves > 4.0 * math.pi)
        and (axis.gravity == 0.0 or max(travels) > 1.0)
        and (axis.eccentric == 0.0 or max(travels) > math.pi)
    )
    if not seen:
        return None
    names = sorted(sizes, key=lambda name: -sizes[name])
    return [{"effect": name, "rms": sizes[name], "share": sizes[name] / driving} for name in names]


def _case(
    name: str,
    recipe: str,
    number: int,
    setup: Setup,
    runs: list[Truth],
    effects: list[dict[str, Any]],
    rng: np.random.Generator,
) -> WorkshopCase:
    """Files of a case."""
    axis = setup.axis
    alone = recipe == "numbers_alone"
    rougher = alone and number % 2 == 1
    relative = _ROUGHER[0] if rougher else float(rng.choice(RELATIVE))
    viscous_zero = not alone and rng.random() < 0.2

    def state(value: float) -> float:
        """A number as a person knows it."""
        if rougher:
            off = float(rng.choice([-1.0, 1.0]) * rng.uniform(*_ROUGHER[1]))
        else:
            off = relative * float(np.clip(rng.standard_normal(), -1.5, 1.5))
        return float(f"{value * (1.0 + off):.3g}")

    model: dict[str, Any] = {"title": name, "drive": {"kind": "two_inertia" if axis.geared else "rigid"}}
    model["drive"] |= {"motor_inertia": state(axis.inertia), "motor_viscous": state(axis.viscous)}
    offsets = {"drive.motor_inertia": axis.inertia, "drive.motor_viscous": axis.viscous}
    if viscous_zero:
        model["drive"]["motor_viscous"] = 0.0
    if axis.geared:
        loads = {"load_inertia": axis.load_inertia, "load_viscous": axis.load_viscous}
        model["drive"] |= {key: state(value) for key, value in loads.items()} | {"gear_ratio": axis.ratio}
        model["transmission"] = {"law": "linear_shaft", "stiffness": state(axis.stiffness)}
        offsets |= {f"drive.{key}": value for key, value in loads.items()} | {"transmission.stiffness": axis.stiffness}
    if alone:
        model["effects"] = [{"kind": "motor.coulomb_friction", "torque": state(axis.friction)}]
        if axis.gravity:
            model["effects"].append(
                {"kind": "load.gravity", "torque": state(axis.gravity), "phase": float(f"{axis.hangs:.4g}")}
            )
    if axis.geared and axis.damping:
        model["effects"] = [{"kind": "transmission.damping", "damping": state(axis.damping)}]
    model["uncertainty"] = {"relative": relative} | ({"exact": ["drive.gear_ratio"]} if axis.geared else {})
    table, columns, plain = _files(recipe, setup, runs, rng)
    if rng.random() < 0.7:
        table["closed_loop"] = True
    model["log"] = table
    fitted = len(runs) - setup.held
    if not setup.held:
        cut = round(0.75 * len(plain[0]["t"]))
        plain = [{key: values[part] for key, values in plain[0].items()} for part in (slice(cut), slice(cut, None))]
    truth = {
        "recipe": recipe,
        "effects": [] if alone else [effect | admissible_names(effect["effect"], axis, setup.drive) for effect in effects],
        "known": [effect["effect"] for effect in effects] if alone else [],
        "optional": ["encoder.offset", "transmission.offset"] * bool(setup.offset)
        + ["motor.viscous_friction"] * viscous_zero,
        "further_off": rougher,
        "relative": relative,
        "true_numbers": offsets,
        "current": setup.current,
        "period": setup.drive.period * setup.every,
        "held_logs": setup.held,
        "driving": rms(np.concatenate([run.current for run in runs[:fitted]])),
        "axis": vars(axis),
        "drive": vars(setup.drive),
        "jitter": setup.jitter,
        "offset": setup.offset,
    }
    return WorkshopCase(name, model, truth, columns[:fitted], columns[fitted:], plain, runs)


def _files(
    recipe: str, setup: Setup, runs: Sequence[Truth], rng: np.random.Generator
) -> tuple[dict[str, Any], list[dict[str, np.ndarray]], list[dict[str, np.ndarray]]]:
    """The `[log]` table, the columns of each log, and the same in SI units over even times."""
    axis, drive, period = setup.axis, setup.drive, setup.drive.period * setup.every
    driving = rms(np.concatenate([run.current for run in runs]))
    constant, counts = float(f"{_between(rng, 0.02, 0.3):.3g}"), round(2.0 * math.pi / drive.motor_step)
    in_ms, in_counts, in_ampere = (bool(rng.random() < share) for share in (0.3, 0.4, 0.5))
    wraps = in_counts and not axis.geared and rng.random() < 0.4
    if recipe == "counts" or (recipe == "numbers_alone" and drive.torque_step):
        factor, u_name = drive.torque_step, str(rng.choice(["pwm", "load", "command"]))
        u = {"column": u_name, "unit": "counts", "factor": factor}
    elif setup.current and in_ampere:
        factor, u_name = constant, "current"
        u = {"column": u_name, "unit": "A", "factor": factor}
    else:
        factor, u_name, u = 1.0, "u", None
    t_name = "time_ms" if in_ms else "t"
    e_name = "counts" if in_counts else "theta_e"
    table: dict[str, Any] = {} if u is None else {"u": u}
    if in_ms:
        table["t"] = {"column": t_name, "unit": "ms"}
    if in_counts:
        table["theta_e"] = {"column": e_name, "unit": "counts", "counts_per_turn": counts}
    if wraps:
        table["theta_e"]["wrap"] = counts
    if not axis.geared:
        table["absent"] = ["theta_s"]
    noise, step = float(rng.uniform(0.003, 0.01)) * driving, driving / 500.0
    columns, plain = [], []
    for run in runs:
        even = np.arange(len(run.command)) * period
        stamps = even + setup.jitter * rng.standard_normal(len(even)) * 0.3
        if setup.jitter:  # now and then the host is late
            stamps += setup.jitter * rng.exponential(1.0, len(even)) * (rng.random(len(even)) < 0.1)
            stamps = np.maximum.accumulate(np.round(stamps, 6)) + 1e-6 * np.arange(len(even)) / len(even)
        torque = run.command
        if setup.current:
            torque = step * np.round((run.current + noise * rng.standard_normal(len(even))) / step)
        motor, load = run.readings[:, 0], run.readings[:, 1] + setup.offset
        words = np.round(motor / drive.motor_step)
        position = (words % counts if wraps else words) if in_counts else motor
        log = {t_name: stamps * (1e3 if in_ms else 1.0), u_name: torque / factor, e_name: position}
        simple = {"t": even, "u": torque, "theta_e": motor}
        if axis.geared:
            log["theta_s"], simple["theta_s"] = load, load
        columns.append(log)
        plain.append(simple)
    return table, columns, plain


# ---- folders ----


def save_case(case: WorkshopCase, folder: Path) -> Path:
    """Write a case's folder, whole or not at all; one that is there stays. Returns it."""
    target, draft = folder / case.name, folder / f".{case.name}.draft"
    if target.exists():
        return target
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    for stem, logs in (("log", case.logs), ("holdout", case.holdout)):
        for i, log in enumerate(logs):
            rows = np.column_stack(list(log.values()))
            np.savetxt(draft / f"{stem}{i}.csv", rows, "%.9g", ",", header=",".join(log), comments="")
    arrays: dict[str, Any] = {f"{i}.{key}": values for i, part in enumerate(case.plain) for key, values in part.items()}
    np.savez_compressed(draft / "plain.npz", **arrays)
    (draft / "model.toml").write_text(tomli_w.dumps(case.model), encoding="utf-8")
    (draft / "truth.json").write_text(json.dumps(case.truth, indent=1), encoding="utf-8")
    draft.rename(target)
    return target


def make_cases(
    seed: int, numbers: Sequence[int], folder: Path, report: Callable[[str], None] = lambda _line: None
) -> list[Path]:
    """Folders of cases; those that are there are not made again."""
    folders = []
    for number in numbers:
        path = folder / f"workshop-{seed}-{number:03d}"
        if not path.exists():
            save_case(draw_case(seed, number), folder)
            report(f"{path.name} made")
        folders.append(path)
    return folders
