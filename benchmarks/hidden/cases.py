"""Cases of the bench: machine, conditions, hidden effects, logs; all from a seed.

Three plants. `paper`: the drive of the paper (J_e 0.05, f_e 0.15, J_s 7, f_s 16, N 5) with a stiffness of 60 N m/rad and a
half gap of 0.08 rad, which the paper leaves open and with which the load really follows; as a hard dead zone or as law (3),
and without gap where the gap is what is hidden. `servo`: a geared axis with a resonance at 29 Hz. `direct`: one inertia and
one encoder. The machines of a kind scatter by 15 %.

Conditions of `single`, `pairs`, `none`, `unknown`: 10-20 s, 1 kHz or 500 Hz, three in ten in closed loop, nominal numbers
off by 1-3 %, a quarter with 1 % noise on the torque channel; `new` as `single`, with the effects that the package has learnt
since (`all` is without them); `clutter` as `single`, with a little cogging and a random torque besides. `hard` are single
effects with at least three of: closed loop, 3 s, coarse encoders, numbers off by 4-6 %, 1-3 % noise on the torque channel.
`rough` as `none`, on the geared plants: every nominal number is off by what data sheets are off by (`ROUGH`), at least three
times the 2 % that the model states.
Three in ten machines have another effect that the nominal model knows.
"""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from .effects import EFFECTS, LEVELS, NEW, UNKNOWN, Motion, draw, error_of, exclusive, on_rigid, rms
from .simulator import Machine, Run, Trace, simulate

KINDS = ("single", "pairs", "none", "unknown", "hard")
ALONE = ("new", "clutter", "rough")
"""Kinds that `all` leaves out: the effects of :data:`.effects.NEW`, as `single`; `single` with clutter beside it; and models
that lack nothing, with rough numbers."""
_CLUTTER = 0.002, 0.006
"""Least and largest size of clutter, as a share of the driving torque's rms: above what may be named, below what matters."""
ROUGH = {
    "inertia": (0.06, 0.2),
    "viscous": (0.2, 0.5),
    "torque": (0.2, 0.5),
    "stiffness": (0.2, 0.4),
    "half_gap": (0.2, 0.4),
    "dead_zone": (0.2, 0.4),
    "slope": (0.2, 0.4),
}
"""Last word of a number's name -> least and largest relative error of `rough`, of either sign."""
_STATED = 0.02
"""Relative uncertainty that the models of `rough` state: the package's default."""
EXCITATIONS = ("sine", "multisine", "chirp", "steps")

_PLANTS: dict[str, dict[str, Any]] = {
    "paper": {
        "drive": {
            "kind": "two_inertia",
            "motor_inertia": 0.05,
            "motor_viscous": 0.15,
            "load_inertia": 7.0,
            "load_viscous": 16.0,
            "gear_ratio": 5.0,
        },
        "stiffness": 60.0,
        "half_gap": 0.08,
        "dead_zone": 0.02,
        "slope": 20.0,
        "torque": (2.5, 5.0),
        "frequency": (0.2, 0.6),
        "bandwidth": (4.0, 8.0),
        "gap": 1.0,
    },
    "servo": {
        "drive": {
            "kind": "two_inertia",
            "motor_inertia": 4e-4,
            "motor_viscous": 2e-3,
            "load_inertia": 0.06,
            "load_viscous": 0.25,
            "gear_ratio": 10.0,
        },
        "stiffness": 8.0,
        "half_gap": 0.02,
        "dead_zone": 0.005,
        "slope": 60.0,
        "torque": (0.25, 0.5),
        "frequency": (0.4, 1.2),
        "bandwidth": (20.0, 35.0),
        "gap": 0.3,
    },
    "direct": {
        "drive": {"kind": "rigid", "motor_inertia": 0.02, "motor_viscous": 0.03},
        "torque": (0.3, 0.8),
        "frequency": (0.3, 1.2),
        "bandwidth": (15.0, 40.0),
        "gap": 0.0,
    },
}
"""Tables, rms torque (N m), frequency of excitation (Hz), bandwidth of the loop (rad/s), share of machines with a gap."""
PLANTS = tuple(_PLANTS)
GEARED = tuple(name for name, ranges in _PLANTS.items() if ranges["drive"]["kind"] == "two_inertia")

_LEAST_MOTION, _LEAST_SEEN = 0.25, 4.0
"""A case is drawn again where the hidden effect leaves less than this share of the motion (the drive sticks), or changes
what the encoders read by less than this many times their noise."""
_MOST_DRAWS = 40


@dataclass(frozen=True)
class Log:
    """A measured log: s, N m, rad, rad; `theta_s` is None on a rigid drive."""

    t: np.ndarray
    u: np.ndarray
    theta_e: np.ndarray
    theta_s: np.ndarray | None

    def columns(self) -> dict[str, np.ndarray]:
        """The channels by the names of the package's log files."""
        named = {"t": self.t, "u": self.u, "theta_e": self.theta_e, "theta_s": self.theta_s}
        return {name: values for name, values in named.items() if values is not None}

    def write(self, path: Path) -> None:
        """Write the log as CSV, with all digits that the encoders have."""
        columns = self.columns()
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savetxt(path, np.column_stack(list(columns.values())), "%.10g", ",", header=",".join(columns), comments="")


@dataclass(frozen=True)
class Case:
    """One machine with something hidden in it.

    Attributes:
        name: kind, seed and number.
        kind: one of `KINDS` or `ALONE`.
        truth: `verdict` (as in diagnosis.json; of `rough` it is `rough_numbers`, which the package does not say yet),
            `effects` (name -> parameters; empty, or the unknown effect), `sizes` (name -> share of the driving torque's
            rms), `clutter` (names of small effects besides), `offsets` (dotted path -> relative error of the nominal
            number), `level` asked for (the largest of a pair), `seen` (change of what the encoders read over their noise),
            `growth` (change of the motor position for one of 1 rad/s in the initial speed, s; thousands mean that a free
            run cannot be foretold).
        conditions: plant, excitation, holdout (its excitation), loop, period, duration, initial_state, uncertainty, ...
        log, holdout: of the same machine, under two excitations.
        model: nominal study for the package, as plain data (no excitation, no observer).
        oracle: the same with the true numbers and the hidden effects (of `unknown`, what the package can say).
        runs, traces: how the logs were made, and the truth behind them.
    """

    name: str
    kind: str
    truth: dict[str, Any]
    conditions: dict[str, Any]
    log: Log
    holdout: Log
    model: dict[str, Any]
    oracle: dict[str, Any]
    runs: tuple[Run, Run] = field(repr=False)
    traces: tuple[Trace, Trace] = field(repr=False)

    @property
    def hidden(self) -> frozenset[str]:
        """Names of the hidden effects that the package knows."""
        return frozenset(self.truth["effects"]) if self.truth["verdict"] == "explained" else frozenset()

    @property
    def weak(self) -> bool:
        return self.truth["level"] == LEVELS[0]


@dataclass
class _Plan:
    """A case before its effects have a size."""

    index: int
    kind: str
    plant: str
    hidden: tuple[tuple[str, float], ...]
    rng: np.random.Generator
    seed: int
    machine: Machine
    conditions: dict[str, Any]
    runs: tuple[Run, Run]
    uncertainty: float


def cases(seed: int, count: int, kind: str = "single", duration: float | None = None) -> list[Case]:
    """Draw cases.

    Args:
        seed: the same seed, count and kind give the same cases.
        count: number of cases; effects, sizes and plants come equally often.
        kind: one of `KINDS` or `ALONE`, or `all`: half of the cases single, the rest of all other kinds alike.
        duration: of all logs in place of what is drawn, s: for quick trials.
    """
    if kind not in (*KINDS, *ALONE, "all"):
        raise ValueError(f"unknown kind {kind!r}; one of {', '.join((*KINDS, *ALONE, 'all'))}")
    counts = {kind: count}
    if kind == "all":
        share = count // (2 * (len(KINDS) - 1))
        counts = dict.fromkeys(KINDS, share) | {"single": count - share * (len(KINDS) - 1)}
    targets = [(part, i, *target) for part, n in counts.items() for i, target in enumerate(_targets(seed, n, part))]
    cases_by_number: dict[int, Case] = {}
    for draw_number in range(_MOST_DRAWS):
        missing = [i for i in range(len(targets)) if i not in cases_by_number]
        if not missing:
            break
        plans = [_plan(seed, draw_number, *targets[i], duration) for i in missing]
        for i, case in zip(missing, _carry_out(seed, plans), strict=True):
            if case is not None:
                cases_by_number[i] = case
    left = [targets[i] for i in range(len(targets)) if i not in cases_by_number]
    if left:
        raise RuntimeError(f"no fit case in {_MOST_DRAWS} draws for {left}")
    return [cases_by_number[i] for i in range(len(targets))]


def _targets(seed: int, count: int, kind: str) -> list[tuple[str, tuple[tuple[str, float], ...]]]:
    """Plant and hidden effects of each case, in equal shares."""
    rng = np.random.default_rng([seed, (*KINDS, *ALONE).index(kind), 1])

    def plants(effects: Iterable[str]) -> list[str]:
        return [plant for plant in PLANTS if plant != "direct" or all(on_rigid(effect) for effect in effects)]

    if kind in ("none", "rough"):
        # two numbers of a rigid drive that are off are a pair of effects
        possible = PLANTS if kind == "none" else GEARED
        return [(possible[i % len(possible)], ()) for i in range(count)]
    if kind == "unknown":
        hidden = [(((effect, level),), PLANTS) for effect in UNKNOWN for level in LEVELS[1:]]
    elif kind == "pairs":
        hidden = []
        for i, first in enumerate(EFFECTS):
            for second in EFFECTS[i + 1 :]:
                if not exclusive(first, second) and not first.split(".")[0] == second.split(".")[0] == "actuator":
                    levels = [(LEVELS[1], LEVELS[1]), (LEVELS[1], LEVELS[2]), (LEVELS[2], LEVELS[1])][rng.integers(3)]
                    hidden.append((((first, levels[0]), (second, levels[1])), plants((first, second))))
    else:
        sought = NEW if kind == "new" else EFFECTS
        hidden = [(((effect, level),), plants([effect])) for effect in sought for level in LEVELS]
    targets: list[tuple[str, tuple[tuple[str, float], ...]]] = []
    while len(targets) < count:
        for i in rng.permutation(len(hidden)):
            effects, possible = hidden[i]
            weights = [1.0 + (plant == "direct") for plant in possible]  # which has a place for fewer of them
            targets.append((str(rng.choice(possible, p=np.array(weights) / sum(weights))), effects))
    return targets[:count]


def _plan(
    seed: int,
    draw_number: int,
    kind: str,
    index: int,
    plant: str,
    hidden: tuple[tuple[str, float], ...],
    duration: float | None,
) -> _Plan:
    rng = np.random.default_rng([seed, (*KINDS, *ALONE).index(kind), 2, index, draw_number])
    names = [name for name, _ in hidden]
    ranges = _PLANTS[plant]
    conditions, uncertainty = _conditions(kind, plant, rng)
    if duration is not None:
        conditions["duration"] = duration
    # machines of a kind are not all alike
    drive = {
        key: value * float(np.exp(rng.normal(0.0, 0.15))) if key not in ("kind", "gear_ratio") else value
        for key, value in ranges["drive"].items()
    }
    machine = Machine(drive, None if plant == "direct" else _law(ranges, names, rng))
    machine = replace(machine, effects=_add_known_effect(machine, names, ranges, rng))
    runs = _runs(machine, ranges, conditions, rng)
    return _Plan(index, kind, plant, hidden, rng, seed, machine, conditions, runs, uncertainty)


def _conditions(kind: str, plant: str, rng: np.random.Generator) -> tuple[dict[str, Any], float]:
    """Draw excitations, encoders and sampling of a case, and the relative uncertainty of its nominal numbers."""
    hard = set(rng.permutation(5)[: rng.integers(3, 6)].tolist()) if kind == "hard" else set()
    easy_loop = kind != "hard" and rng.random() < 0.3
    coarse = 2 in hard
    torque_noise = float(rng.uniform(0.01, 0.03)) if 4 in hard else 0.01 if kind != "hard" and rng.random() < 0.25 else 0.0
    uncertainty = round(float(rng.uniform(0.04, 0.06) if 3 in hard else rng.uniform(0.01, 0.03)), 3)
    uncertainty = _STATED if kind == "rough" else uncertainty
    quantised = rng.random() < (0.7 if coarse else 0.4)
    first, second = rng.permutation(EXCITATIONS)[:2]
    conditions = {
        "plant": plant,
        "excitation": str(first),
        "holdout": str(second),
        "loop": "closed" if easy_loop or 0 in hard else "open",
        "period": float(rng.choice([1e-3, 2e-3])),
        "duration": 3.0 if 1 in hard else float(rng.integers(10, 21)),
        "initial_state": "rest" if rng.random() < 0.35 else "unknown",
        "uncertainty": uncertainty,
        "noise": float(np.exp(rng.uniform(*np.log([1e-4, 3e-4] if coarse else [1e-5, 1e-4])))),
        "counts": int(2 ** rng.integers(12, 15) if coarse else 2 ** rng.integers(16, 21)) if quantised else 0,
        "torque_noise": torque_noise,
    }
    return conditions, uncertainty


def _law(ranges: Mapping[str, Any], names: Sequence[str], rng: np.random.Generator) -> dict[str, Any]:
    stiffness = ranges["stiffness"] * float(np.exp(rng.normal(0.0, 0.15)))
    gap, smooth = rng.random() < ranges["gap"], rng.random() < 0.25
    if not gap or "transmission.backlash" in names:
        return {"law": "linear_shaft", "stiffness": stiffness}
    scale = float(np.exp(rng.normal(0.0, 0.15)))
    if smooth:
        return {
            "law": "sigmoid_backlash",
            "stiffness": stiffness,
            "dead_zone": ranges["dead_zone"] * scale,
            "slope": ranges["slope"],
        }
    return {"law": "dead_zone", "stiffness": stiffness, "half_gap": ranges["half_gap"] * scale}


def _add_known_effect(
    machine: Machine, names: Sequence[str], ranges: Mapping[str, Any], rng: np.random.Generator
) -> tuple[dict[str, Any], ...]:
    """Another effect, which the nominal model has too."""
    rigid = machine.rigid
    possible = ["motor.coulomb_friction", "load.gravity"] + ([] if rigid else ["load.coulomb_friction"])
    possible = [kind for kind in possible if not any(exclusive(name, kind) for name in names)]
    if not possible:
        return ()
    chosen, adds_effect = str(rng.choice(possible)), rng.random() < 0.3
    torque = float(rng.uniform(0.05, 0.12)) * float(np.mean(ranges["torque"]))
    torque *= machine.ratio if chosen.startswith("load.") else 1.0
    if "unknown.drifting_friction" in names or not adds_effect:
        return ()
    return ({"kind": chosen, "torque": torque} | ({"phase": 0.0} if chosen == "load.gravity" else {}),)


def _runs(
    machine: Machine, ranges: Mapping[str, Any], conditions: dict[str, Any], rng: np.random.Generator
) -> tuple[Run, Run]:
    drive, ratio, period = machine.drive, machine.ratio, conditions["period"]
    inertia = drive["motor_inertia"] + drive.get("load_inertia", 0.0) / ratio**2
    viscous = drive["motor_viscous"] + drive.get("load_viscous", 0.0) / ratio**2
    torque = float(rng.uniform(*ranges["torque"]))
    frequency = float(rng.uniform(*ranges["frequency"]))
    bandwidth = float(rng.uniform(*ranges["bandwidth"]))
    if conditions["duration"] < 5.0:
        frequency *= 2.0
    half_gap = (machine.transmission or {}).get("half_gap", 0.0)
    speed = torque / math.hypot(viscous, inertia * 2.0 * math.pi * frequency)
    resolution = 2.0 * math.pi / conditions["counts"] if conditions["counts"] else 0.0
    runs = []
    for number, key in enumerate(("excitation", "holdout")):
        duration = conditions["duration"]
        if number == 1 and duration >= 3.0:
            duration = max(5.0, 0.5 * duration)
        n = round(duration / period)
        wave = _wave(conditions[key], n, period, frequency * float(rng.uniform(0.8, 1.25)), rng)
        turn = float(rng.uniform(-0.5, 0.5))
        start = (ratio * turn + half_gap * float(rng.uniform(-0.8, 0.8)), 0.0, turn, 0.0)
        if conditions["initial_state"] == "unknown":
            first = 0.6 * speed * float(rng.uniform(-1.0, 1.0))
            start = (start[0], first, start[2], first / ratio * float(rng.uniform(0.95, 1.05)))
        shared = {
            "initial": start,
            "motor_noise": conditions["noise"],
            "load_noise": conditions["noise"] / ratio,
            "motor_resolution": resolution,
            "load_resolution": resolution / ratio,
            "torque_noise": conditions["torque_noise"] * torque,
            "disturbance": _band_limited(n + 1, period, 3.0 * frequency, rng),
            "seed": int(rng.integers(2**31)),
        }
        if conditions["loop"] == "open":
            runs.append(Run(machine, period, torque * wave / rms(wave), **shared))
            continue
        reference = _smooth(wave, period, 4.0 * frequency) if conditions[key] == "steps" else wave
        rate = np.gradient(reference, period)
        needed = rms(inertia * np.gradient(rate, period) + viscous * rate)
        reference, rate = torque / needed * reference, torque / needed * rate
        kp, kd = inertia * bandwidth**2, max(1.6 * inertia * bandwidth - viscous, 0.1 * inertia * bandwidth)
        loop = {"kp": kp, "kd": kd, "filter": min(1.0, 10.0 * bandwidth * period), "torque_limit": 6.0 * torque}
        reference = np.stack([reference - reference[0] + start[0], rate])
        runs.append(Run(machine, period, np.zeros(n), reference=reference, **loop, **shared))
    return runs[0], runs[1]


def _wave(kind: str, n: int, period: float, frequency: float, rng: np.random.Generator) -> np.ndarray:
    """An excitation of unit size: torque in open loop, position in closed loop."""
    t = np.arange(n) * period
    if kind == "sine":
        return np.sin(2.0 * math.pi * frequency * t + rng.uniform(-math.pi, math.pi))
    if kind == "multisine":
        k = np.arange(1, 11)
        phases = rng.uniform(-math.pi, math.pi, len(k))
        return np.sum(
            np.sin(2.0 * math.pi * 0.3 * frequency * k[:, None] * t + phases[:, None]) / np.sqrt(k)[:, None], axis=0
        )
    if kind == "chirp":
        low, high, length = frequency / 3.0, 4.0 * frequency, n * period
        return np.sin(2.0 * math.pi * (low + 0.5 * (high - low) * t / length) * t)
    hold = max(1, round(float(rng.uniform(0.25, 0.6)) / frequency / period))
    levels = rng.uniform(0.3, 1.0, n // hold + 1) * rng.choice([-1.0, 1.0], n // hold + 1)
    return np.repeat(levels, hold)[:n]


def _smooth(wave: np.ndarray, period: float, frequency: float) -> np.ndarray:
    """Third-order low-pass: steps that a drive can follow."""
    from scipy.signal import lfilter

    keep = math.exp(-2.0 * math.pi * frequency * period)
    for _ in range(3):
        wave = lfilter([1.0 - keep], [1.0, -keep], wave)
    return wave


def _band_limited(n: int, period: float, frequency: float, rng: np.random.Generator) -> np.ndarray:
    """Noise of unit rms below a frequency."""
    spectrum = np.fft.rfft(rng.standard_normal(n)) * (np.fft.rfftfreq(n, period) < max(frequency, 2.0 / (n * period)))
    spectrum[0] = 0.0
    noise = np.fft.irfft(spectrum, n)
    return noise / rms(noise)


def _carry_out(seed: int, plans: list[_Plan]) -> list[Case | None]:
    """Size the effects along runs without them, run the machines, and leave out what is not fit for a case."""
    plain = simulate([plan.runs[0] for plan in plans])
    full, sizes, clutter = [], [], []
    for plan, trace in zip(plans, plain, strict=True):
        motion = Motion.of(plan.machine, trace)
        effects, sizes_by_effect = [], {}
        fine = bool(np.isfinite(trace.states).all()) and rms(trace.states[1]) > 0.0
        for name, level in plan.hidden if fine else ():
            drawn, size = draw(name, level, motion, plan.uncertainty, plan.rng)
            effects.extend(drawn)
            sizes_by_effect[str(drawn[0]["kind"])] = size
        small = _clutter(plan, list(sizes_by_effect), motion) if fine and plan.kind == "clutter" else []
        full.append(replace(plan.machine, effects=(*plan.machine.effects, *_order_effects(effects), *small)))
        sizes.append(sizes_by_effect)
        clutter.append(small)
    runs = [replace(run, machine=machine) for plan, machine in zip(plans, full, strict=True) for run in plan.runs]
    nudges = [_NUDGE * rms(trace.states[1]) for trace in plain]
    traces = simulate(runs)
    nudged = simulate([_nudge(runs[2 * i], nudge) for i, nudge in enumerate(nudges)])
    result: list[Case | None] = []
    for i, plan in enumerate(plans):
        pair, pair_traces = (runs[2 * i], runs[2 * i + 1]), (traces[2 * i], traces[2 * i + 1])
        visibility = _measure_visibility(pair[0], plain[i], pair_traces[0])
        fit = all(_fit(trace, plain[i], plan.machine) for trace in pair_traces) and (
            not plan.hidden or visibility >= _LEAST_SEEN
        )
        if not fit:
            result.append(None)
            continue
        growth = rms(nudged[i].states[0] - pair_traces[0].states[0]) / nudges[i]
        result.append(_case(seed, plan, sizes[i], clutter[i], {"seen": visibility, "growth": growth}, pair, pair_traces))
    return result


def _clutter(plan: _Plan, hidden: Sequence[str], motion: Motion) -> list[dict[str, Any]]:
    """Cogging and a random torque that are small, as every machine has something of."""
    names = [name for name in ("motor.cogging", "unknown.random_torque") if name not in hidden]
    return [draw(name, float(plan.rng.uniform(*_CLUTTER)), motion, plan.uncertainty, plan.rng)[0][0] for name in names]


_ORDER = ("actuator.delay", "actuator.gain_error", "actuator.saturation", "actuator.lag")


def _order_effects(effects: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Actuator effects in the order in which the simulator applies them."""
    return sorted(effects, key=lambda effect: _ORDER.index(effect["kind"]) if effect["kind"] in _ORDER else -1)


_NUDGE = 1e-6


def _nudge(run: Run, nudge: float) -> Run:
    theta_e, w_e, theta_s, w_s = run.initial
    return replace(run, initial=(theta_e, w_e + nudge, theta_s, w_s))


def _measure_visibility(run: Run, plain: Trace, trace: Trace) -> float:
    """Change of what the encoders read, over their noise; the larger of both sides."""
    noises = [math.hypot(noise, count / math.sqrt(12.0)) for noise, count in
              ((run.motor_noise, run.motor_resolution), (run.load_noise, run.load_resolution))]  # fmt: skip
    change = trace.states - plain.states
    ratios = [rms(change[0]) / noises[0]]
    if not run.machine.rigid:
        ratios.append(rms(change[2]) / noises[1])
    return float(max(ratios))


def _fit(trace: Trace, plain: Trace, machine: Machine) -> bool:
    """True if a drive moves, and stays within bounds."""
    if not np.isfinite(trace.states).all():
        return False
    moving = rms(trace.states[1]) / rms(plain.states[1])
    bounded = np.max(np.abs(trace.states[2 if not machine.rigid else 0])) < 500.0
    return bool(_LEAST_MOTION < moving < 10.0 and bounded)


def _case(
    seed: int,
    plan: _Plan,
    sizes: dict[str, float],
    clutter: list[dict[str, Any]],
    more: dict[str, float],
    runs: tuple[Run, Run],
    traces: tuple[Trace, Trace],
) -> Case:
    machine = runs[0].machine
    hidden = {str(effect["kind"]): {k: v for k, v in effect.items() if k != "kind"} for effect in
              machine.effects[len(plan.machine.effects) : len(machine.effects) - len(clutter)]}  # fmt: skip
    nominal_effects = list(plan.machine.effects)
    drift = hidden.get("unknown.drifting_friction")
    if drift is not None:  # its mean is known
        nominal_effects.append({"kind": f"{drift['side']}.coulomb_friction", "torque": drift["torque"]})
    no_effect = {"none": "no_discrepancy", "unknown": "unknown_effect", "rough": "rough_numbers"}
    verdict = no_effect.get(plan.kind, "explained")
    true = Machine(machine.drive, machine.transmission, (*nominal_effects, *_order_effects(_explain(machine, hidden))))
    nominal = Machine(
        _off(machine.drive, plan.uncertainty, plan.rng, [error_of(kind) for kind in hidden]),
        None if machine.transmission is None else _off(machine.transmission, plan.uncertainty, plan.rng),
        [_off(effect, plan.uncertainty, plan.rng) for effect in nominal_effects],
    )
    if plan.kind == "rough":
        nominal = Machine(
            _misstate(machine.drive, plan.rng),
            _misstate(machine.transmission or {}, plan.rng),
            [_misstate(effect, plan.rng) for effect in nominal_effects],
        )
    name = f"{plan.kind}-{seed}-{plan.index:03d}"
    study, oracle = (
        _study(title, model, plan.conditions, runs[0]) for title, model in ((name, nominal), (f"{name} as it is", true))
    )
    true_numbers = plant_numbers(oracle)
    truth = {
        "verdict": verdict,
        "effects": hidden,
        "sizes": sizes,
        "clutter": [str(effect["kind"]) for effect in clutter],
        "offsets": {
            path: value / true_numbers[path] - 1.0
            for path, value in plant_numbers(study).items()
            if true_numbers.get(path) and path != "drive.gear_ratio"
        },
        "level": max((level for _, level in plan.hidden), default=0.0),
        **more,
    }
    logs = [Log(trace.t, trace.u, trace.theta_e, trace.theta_s) for trace in traces]
    return Case(
        name,
        plan.kind,
        truth,
        plan.conditions,
        logs[0],
        logs[1],
        study,
        oracle,
        runs,
        traces,
    )


def _explain(machine: Machine, hidden: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [{"kind": kind, **values} for kind, values in hidden.items() if not kind.startswith("unknown.")]


def _off(
    table: Mapping[str, Any], uncertainty: float, rng: np.random.Generator, exact: Collection[str | None] = ()
) -> dict[str, Any]:
    """A table as someone knows it who knows its numbers so well, to four digits; but for those that are exact."""
    nominal = {}
    for key, value in table.items():
        if isinstance(value, str) or key == "gear_ratio":
            nominal[key] = value
        else:
            error = 0.0 if key in exact else 1.0
            error *= float(np.clip(rng.standard_normal(), -2.0, 2.0))
            nominal[key] = float(f"{value * (1.0 + uncertainty * error):.4g}")
    return nominal


def _misstate(table: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """A table as a data sheet has it, to four digits."""
    nominal = dict(table)
    for key, value in table.items():
        reach = next((reach for word, reach in ROUGH.items() if key.endswith(word)), None)
        if reach is not None:
            nominal[key] = float(f"{value * (1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(*reach)):.4g}")
    return nominal


def plant_numbers(study: Mapping[str, Any]) -> dict[str, float]:
    """Numbers of a study's drive, transmission and effects by dotted path, as the package names them."""
    tables = {"drive": study["drive"], "transmission": study.get("transmission") or {}}
    tables |= {f"effects.{effect['kind']}": effect for effect in study["effects"]}
    return {
        f"{name}.{key}": value for name, table in tables.items() for key, value in table.items() if isinstance(value, float)
    }


def _study(title: str, machine: Machine, conditions: Mapping[str, Any], run: Run) -> dict[str, Any]:
    """A study in the package's words: everything but excitation and observer."""
    study: dict[str, Any] = {"title": title, "drive": dict(machine.drive)}
    if machine.transmission is not None:
        study["transmission"] = dict(machine.transmission)
    study["effects"] = [dict(effect) for effect in machine.effects]
    encoders = {"noise": run.motor_noise, "motor_resolution": run.motor_resolution}
    if not machine.rigid:
        encoders |= {"load_noise": run.load_noise, "load_resolution": run.load_resolution}
    study["encoders"] = encoders
    study["run"] = {"sample_period": conditions["period"], "duration": conditions["duration"]}
    study["uncertainty"] = {
        "relative": conditions["uncertainty"],
        "exact": [] if machine.rigid else ["drive.gear_ratio"],
    }
    study["log"] = {"hold": "zoh", "initial_state": conditions["initial_state"]}
    return study


def save(hidden_cases: Sequence[Case], folder: Path) -> None:
    """Write cases as files: NAME.csv and NAME.toml side by side, hold-out logs in `holdout/`, the truth in truth.json."""
    import json

    import tomli_w

    folder.mkdir(parents=True, exist_ok=True)
    for case in hidden_cases:
        case.log.write(folder / f"{case.name}.csv")
        case.holdout.write(folder / "holdout" / f"{case.name}.csv")
        (folder / f"{case.name}.toml").write_text(tomli_w.dumps(case.model), encoding="utf-8")
    truths = {
        case.name: {"truth": case.truth, "conditions": case.conditions, "oracle": case.oracle} for case in hidden_cases
    }
    (folder / "truth.json").write_text(json.dumps(truths, indent=1), encoding="utf-8")
