"""A gap and friction behind the gear from the motor's encoder and torque alone: is it found, how well, and is it refused
where the log does not show it?

Drives in reciprocating moves, made by the bench's own simulator (hidden/simulator.py: nothing of the package in it). Their
numbers scatter by factors: inertias, stiffness, damping, gap, frictions on both sides, encoder noise and counts, noise of
the torque channel, kind of the move. Who identifies them has the motor's inertia from a data sheet (5 %), the load's and
the stiffness roughly (20 and 30 %), and only guesses of gap and frictions (up to a factor of five). The load's position is
not in the log.

    python benchmarks/motor_encoder_alone.py --seed 1               # 40 drives with a gap, 20 that do not show one
    python benchmarks/motor_encoder_alone.py --seed 1 --count 4 --refused 2
"""

import argparse
import math
import os
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from hidden.simulator import Machine, Run, Trace, simulate

CACHE = Path(__file__).parents[1] / ".cache" / "jax"
REFUSED = "no gap", "one flank", "within the gap"
"""Kinds of drives whose log does not show a gap: there is none; a weight keeps the load on one flank; the motor moves so
little that it meets one flank at most."""
_WEIGHT = 4.0
"""Torque of the weight over the largest of inertia."""
MOVES = "sine", "triangle", "point to point", "open loop"


@dataclass(frozen=True)
class Drive:
    """A machine, its log and what is known of it.

    Attributes:
        name: kind and number.
        kind: "gap" or one of `REFUSED`.
        run: the experiment.
        study: nominal numbers for the package.
        half_gap: that is true, rad at the motor.
        friction: Coulomb friction of the load, N m.
    """

    name: str
    kind: str
    run: Run
    study: dict[str, Any]
    half_gap: float
    friction: float


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """Evenly in the logarithm."""
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def draw(seed: int, number: int, kind: str = "gap") -> Drive:
    """A drive; the same arguments give the same one."""
    rng = np.random.default_rng([seed, number, ("gap", *REFUSED).index(kind)])
    ratio = float(rng.choice([3.0, 5.0, 10.0, 20.0, 50.0]))
    motor = _between(rng, 1e-4, 2e-3)
    load = motor * _between(rng, 0.5, 5.0)  # at the motor
    total_inertia = motor + load
    amplitude, frequency = _between(rng, 1.0, 10.0), _between(rng, 0.4, 1.5)
    speed = 2.0 * math.pi * frequency * amplitude
    torque = total_inertia * 2.0 * math.pi * frequency * speed  # of inertia, its peak in a sine
    viscous = [torque / speed * _between(rng, 0.03, 0.3) for _ in range(2)]
    dry = [torque * _between(rng, low, high) for low, high in ((0.03, 0.1), (0.05, 0.3))]
    stiffness = (2.0 * math.pi * _between(rng, 12.0, 50.0)) ** 2 * motor * load / total_inertia
    damping = 2.0 * _between(rng, 0.02, 0.1) * math.sqrt(stiffness * motor * load / total_inertia)
    half_gap = 0.0 if kind == "no gap" else _between(rng, 5e-3, 0.1)
    if kind == "within the gap":
        half_gap = amplitude * float(rng.uniform(1.2, 2.0))
    law = {"law": "dead_zone", "stiffness": stiffness, "half_gap": half_gap}
    effects = [
        {"kind": "motor.coulomb_friction", "torque": dry[0]},
        {"kind": "load.coulomb_friction", "torque": dry[1] * ratio},
        {"kind": "transmission.damping", "damping": damping},
    ]
    if kind == "one flank":
        # more than inertia, friction and a margin for the controller can take off
        effects.append({"kind": "load.constant_torque", "torque": _WEIGHT * torque * ratio})
    drive = {
        "kind": "two_inertia", "motor_inertia": motor, "motor_viscous": viscous[0], "load_inertia": load * ratio**2,
        "load_viscous": viscous[1] * ratio**2, "gear_ratio": ratio,
    }  # fmt: skip
    if kind == "no gap":
        law = {"law": "linear_shaft", "stiffness": stiffness}
    run = _run(rng, Machine(drive, law, effects), kind, amplitude, frequency, torque, total_inertia, sum(viscous))
    law = law if half_gap else {"law": "dead_zone", "stiffness": stiffness, "half_gap": 0.02}
    study = _study(rng, Machine(drive, law, effects), run)
    return Drive(f"{kind} {number}", kind, run, study, half_gap, dry[1] * ratio)


def _run(
    rng: np.random.Generator, machine: Machine, kind: str, amplitude: float, frequency: float, torque: float, inertia: float,
    viscous: float,
) -> Run:  # fmt: skip
    """A reciprocating move of 10 s, the motor under position control by its encoder, or under a torque in open loop."""
    period, move = float(rng.choice([1e-3, 2e-3])), str(rng.choice(MOVES[:3] if kind in REFUSED[1:] else MOVES))
    n = round(10.0 / period)
    t = period * np.arange(n)
    phase = float(rng.uniform(0.0, 1.0))
    where = np.mod(frequency * t + phase, 1.0)
    wave = {
        "sine": np.sin(2.0 * np.pi * where),
        "triangle": 4.0 * np.abs(where - 0.5) - 1.0,
        "point to point": np.clip(3.0 * (4.0 * np.abs(where - 0.5) - 1.0), -1.0, 1.0),
        "open loop": np.sin(2.0 * np.pi * where),
    }[move]
    counts = int(2 ** rng.integers(14, 21)) if rng.random() < 0.5 else 0
    noise = _between(rng, 1e-5, 1e-4)
    shared: dict[str, Any] = {
        "motor_noise": noise,
        "motor_resolution": 2.0 * math.pi / counts if counts else 0.0,
        "torque_noise": 0.01 * torque if rng.random() < 0.5 else 0.0,
        "seed": int(rng.integers(2**31)),
    }
    if move == "open loop":
        return Run(machine, period, torque * wave * float(rng.uniform(0.8, 1.6)), **shared)
    width = max(1, round(float(rng.uniform(0.05, 0.15)) / frequency / period))
    if move != "sine":
        # corners rounded by parabolas: limited acceleration
        wave = np.convolve(np.pad(wave, (width, width), "wrap"), np.ones(width) / width, "same")[width:-width]
    reference = amplitude * (wave - wave[0])
    bandwidth = float(rng.uniform(20.0, 40.0))
    loop = {"kp": inertia * bandwidth**2, "kd": max(1.6 * inertia * bandwidth - viscous, 0.1 * inertia * bandwidth)}
    loop |= {"filter": min(1.0, 10.0 * bandwidth * period), "torque_limit": 20.0 * torque}
    rate = np.gradient(reference, period)
    weight = _WEIGHT * torque if kind == "one flank" else 0.0
    law = machine.transmission or {}
    # it hangs on its flank when the log begins
    shared["initial"] = (0.0, 0.0, -(law["half_gap"] + weight / law["stiffness"]) / machine.ratio if weight else 0.0, 0.0)
    return Run(machine, period, np.full(n, weight), reference=np.stack([reference, rate]), **loop, **shared)


_KNOWN = {"motor_inertia": 0.05, "load_inertia": 0.2, "stiffness": 0.3, "damping": 0.5}
"""Relative standard deviation of what is known; of other numbers:"""
_GUESS = 0.7


def _study(rng: np.random.Generator, machine: Machine, run: Run) -> dict[str, Any]:
    """Nominal numbers, as someone has them."""

    def off(table: Mapping[str, Any]) -> dict[str, Any]:
        nominal = {}
        for key, value in table.items():
            if isinstance(value, str) or key == "gear_ratio":
                nominal[key] = value
            elif key == "half_gap":
                nominal[key] = float(f"{value * _between(rng, 0.2, 5.0):.3g}")
            else:
                error = float(np.clip(rng.standard_normal(), -2.0, 2.0))
                nominal[key] = float(f"{value * math.exp(_KNOWN.get(key, _GUESS) * error):.3g}")
        return nominal

    return {
        "title": "motor encoder alone",
        "drive": off(machine.drive),
        "transmission": off(machine.transmission or {}),
        "effects": [off(effect) for effect in machine.effects],
        "run": {"sample_period": run.period, "duration": 10.0, "substeps": 5},
        "log": {"absent": ["theta_s"]},
    }


def write(drive: Drive, trace: Trace, folder: Path) -> Path:
    """The log without the load, as CSV."""
    path = folder / f"{drive.name.replace(' ', '_')}.csv"
    np.savetxt(path, np.column_stack([trace.t, trace.u, trace.theta_e]), "%.10g", ",", header="t,u,theta_e", comments="")
    return path


@dataclass(frozen=True)
class Outcome:
    """Result of an identification of a drive.

    Attributes:
        shown: whether a gap is said to be there.
        error: of the half gap, relative; NaN where none is shown.
        covered: whether its 95 % interval holds the truth.
        width: half width of the interval over the value.
        friction: relative error of the load's Coulomb friction; NaN where it is refused.
        friction_covered: whether its interval holds the truth.
        at_most: upper limit where none is shown, rad.
        seconds: of wall time.
    """

    shows_gap: bool
    error: float = math.nan
    covered: bool = False
    width: float = math.nan
    friction: float = math.nan
    friction_covered: bool = False
    at_most: float = math.nan
    seconds: float = math.nan


def identify_drive(drive: Drive, path: Path) -> Outcome:
    """`jaxbl.identify` on the log."""
    import jaxbl

    begin = time.perf_counter()
    identification = jaxbl.identify(path, drive.study).summary
    seconds = time.perf_counter() - begin
    numbers, gap = identification["parameters"], identification["backlash"]
    dry = numbers.get("effects.load.coulomb_friction.torque")
    friction, friction_covered = math.nan, False
    if dry is not None and None not in dry["interval"]:
        friction = dry["value"] / drive.friction - 1.0
        friction_covered = dry["interval"][0] <= drive.friction <= dry["interval"][1]
    if not gap["shown"]:
        return Outcome(False, friction=friction, friction_covered=friction_covered, at_most=gap["at_most"], seconds=seconds)
    half_gap = numbers["transmission.half_gap"]
    low, high = half_gap["interval"]
    error = half_gap["value"] / drive.half_gap - 1.0 if drive.half_gap else math.inf
    return Outcome(
        True, error, low <= drive.half_gap <= high, 0.5 * (high - low) / half_gap["value"], friction, friction_covered,
        seconds=seconds,
    )  # fmt: skip


def crossings(drive: Drive, trace: Trace) -> int:
    """Number of times that the simulated load changes flanks."""
    twist = trace.states[0] - drive.run.machine.ratio * trace.states[2]
    flank = np.sign(twist[np.abs(twist) >= drive.half_gap])
    return int(np.count_nonzero(np.diff(flank)))


def draw_drives(seed: int, count: int, refused: int) -> list[tuple[Drive, Trace]]:
    """Drives with a gap that is crossed, and drives without one, or that do not cross it."""
    drives = [draw(seed, i) for i in range(count)]
    # of three one does not cross it
    drives += [draw(seed, i, kind) for kind in REFUSED for i in range(refused if kind == REFUSED[0] else 3 * refused)]
    runs = list(zip(drives, simulate([drive.run for drive in drives]), strict=True))
    chosen = runs[:count]
    for k, kind in enumerate(REFUSED):
        fit = [(d, t) for d, t in runs if d.kind == kind and (not d.half_gap or not crossings(d, t))]
        chosen += fit[: (refused + len(REFUSED) - 1 - k) // len(REFUSED)]
    return chosen


def line(drive: Drive, outcome: Outcome) -> str:
    """One row of the table."""
    if outcome.shows_gap:
        text = (
            f"{100.0 * outcome.error:+9.3f} %  ± {100.0 * outcome.width:7.3f} %  {'holds' if outcome.covered else 'MISSES'}"
        )
    else:
        text = f"  refused; at most {outcome.at_most:.3g} rad"
    dry = (
        "refused"
        if math.isnan(outcome.friction)
        else f"{100.0 * outcome.friction:+.2f} %{'' if outcome.friction_covered else ' MISSES'}"
    )
    return (
        f"{drive.name:18s} {drive.half_gap:8.4f} {drive.run.motor_noise:8.1e}  {text:42s} {dry:20s} {outcome.seconds:5.1f}"
    )


def summary(drives: list[Drive], outcomes: list[Outcome]) -> list[str]:
    """Figures over all drives."""
    lines = []
    with_gap = [outcome for drive, outcome in zip(drives, outcomes, strict=True) if drive.kind == "gap"]
    accepted = [outcome for outcome in with_gap if outcome.shows_gap]
    if with_gap:
        lines.append(f"drives with a gap: {len(with_gap)}, refused {len(with_gap) - len(accepted)}")
    if accepted:
        errors = [abs(outcome.error) for outcome in accepted]
        held = sum(outcome.covered for outcome in accepted)
        lines.append(
            f"  half gap: median error {100.0 * np.median(errors):.3f} %, largest {100.0 * max(errors):.3f} %; "
            f"95 % intervals hold the truth in {held} of {len(accepted)} ({100.0 * held / len(accepted):.0f} %)"
        )
        dry = [outcome for outcome in with_gap if not math.isnan(outcome.friction)]
        if dry:
            held = sum(outcome.friction_covered for outcome in dry)
            lines.append(
                f"  load's Coulomb friction: said in {len(dry)}, median error "
                f"{100.0 * np.median([abs(outcome.friction) for outcome in dry]):.2f} %; "
                f"intervals hold it in {held} of {len(dry)}"
            )
    for kind in REFUSED:
        of_kind = [outcome for drive, outcome in zip(drives, outcomes, strict=True) if drive.kind == kind]
        if of_kind:
            lines.append(f"{kind}: refused {sum(not outcome.shows_gap for outcome in of_kind)} of {len(of_kind)}")
    lines.append(f"seconds for a log, median: {np.median([outcome.seconds for outcome in outcomes]):.1f}")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True, help="of the drives; take one that development has not seen")
    parser.add_argument("--count", type=int, default=40, help="drives with a gap")
    parser.add_argument("--refused", type=int, default=20, help="drives whose log does not show one")
    asked = parser.parse_args()
    import jax

    jax.config.update("jax_compilation_cache_dir", str(CACHE))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    os.environ.setdefault("JAXBL_PROGRAMS", str(CACHE / "programs"))
    runs = draw_drives(asked.seed, asked.count, asked.refused)
    print("drive              half gap    noise  said of it" + " " * 34 + "load's friction       s", flush=True)
    outcomes = []
    with tempfile.TemporaryDirectory() as folder:
        for drive, trace in runs:
            outcomes.append(identify_drive(drive, write(drive, trace, Path(folder))))
            print(line(drive, outcomes[-1]), flush=True)
    print(*summary([drive for drive, _ in runs], outcomes), sep="\n")


if __name__ == "__main__":
    main()
