"""How often the 95 % intervals of `jaxbl identify` hold the truth, by what disturbs the log.

Drives with hidden numbers, made by the bench's own simulator (hidden/simulator.py: fourth order through events, at least 50
steps a sample, nothing of the package in it), and identified with 10 plant steps a sample from numbers that are 5 to 25 %
off. Five kinds, three drives in turn (one inertia; two with an elastic shaft; two with a gap), each with viscous and dry
friction:

    quantised    encoders round to counts of 1/2^12 to 1/2^17 of a turn
    jitter       readings are late or early by 0.3 to 3 % of a period (rms); every other log stamps when they were taken
    noise        Gaussian noise of both encoders
    impacts      drives with a gap that is crossed some hundred times, driven by steps
    torque       a torque beside the recorded one, 0.3 to 3 % of it, correlated over 2 to 30 ms
    lacking      noise, and a model without the dry friction (on request: `--kinds lacking zero`)
    zero         noise, and half of the frictions, damping and gap nominally 0, some of them in truth, too

Each log is a line of `--out`; what is there already is not computed again.

    python benchmarks/interval_coverage.py --seed 1 --count 12 --out coverage.jsonl
    python benchmarks/interval_coverage.py --report coverage.jsonl
"""

import argparse
import json
import math
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402

sys.path.insert(0, str(Path(__file__).parent))

from hidden.simulator import Machine, Run, Trace, simulate  # noqa: E402

from jaxbl.estimation.identify import identify  # noqa: E402

KINDS = "quantised", "jitter", "noise", "impacts", "torque"
LACKING, ZERO = "lacking", "zero"
DRIVES = "rigid", "elastic", "gap"
SAMPLES = 2500
STEPS = 50
"""Of the bench's simulator in a sample, at least."""


def draw_factor(rng: np.random.Generator, low: float, high: float) -> float:
    """Evenly in the logarithm."""
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def draw_truth(rng: np.random.Generator, drive: str, torque: float, period: float) -> dict[str, float]:
    """Numbers of a drive by path, for an input of `torque` N m rms with most of it at a twentieth of the resonance or so."""
    motor = draw_factor(rng, 2e-4, 2e-2)
    load = 0.0 if drive == "rigid" else motor * draw_factor(rng, 0.5, 5.0)  # at the motor
    inertia = motor + load
    # time constants of half a second to two: the drive turns, and comes back
    speed = 0.3 * torque / inertia
    truth = {
        "drive.motor_inertia": motor,
        "drive.motor_viscous": draw_factor(rng, 0.05, 0.3) * torque / speed,
    }
    dry = torque * draw_factor(rng, 0.05, 0.25)
    if drive == "rigid":
        return truth | {"effects.motor.coulomb_friction.torque": dry}
    # resonance over the sampling rate: 1/60 to 1/12
    stiffness = (2.0 * math.pi * draw_factor(rng, 1 / 60, 1 / 12) / period) ** 2 * motor * load / inertia
    truth |= {
        "drive.load_inertia": load,
        "drive.load_viscous": draw_factor(rng, 0.05, 0.3) * torque / speed,
        "transmission.stiffness": stiffness,
        "effects.load.coulomb_friction.torque": dry,
        "effects.transmission.damping.damping": draw_factor(rng, 0.02, 0.1)
        * 2.0 * math.sqrt(stiffness * motor * load / inertia),
    }  # fmt: skip
    if drive == "gap":
        truth["transmission.half_gap"] = draw_factor(rng, 5e-3, 5e-2)
    return truth


def tables_of(truth: dict[str, float], ratio: float) -> dict[str, Any]:
    """Config tables of numbers that count at the motor; the load's are brought to its side."""
    data: dict[str, Any] = {"drive": {"kind": "rigid"}}
    if "drive.load_inertia" in truth:
        law = "dead_zone" if "transmission.half_gap" in truth else "linear_shaft"
        data = {"drive": {"kind": "two_inertia", "gear_ratio": ratio}, "transmission": {"law": law}}
    effects: dict[str, dict[str, Any]] = {}
    for path, value in truth.items():
        table, _, key = path.rpartition(".")
        if table.startswith("effects."):
            kind = table.removeprefix("effects.")
            effects.setdefault(kind, {"kind": kind})[key] = value
        else:
            data[table][key] = value
    return data | {"effects": list(effects.values())}


def at_load(truth: dict[str, float], ratio: float) -> dict[str, float]:
    """The same with inertia and frictions of the load as the load has them."""
    factor = {"drive.load_inertia": ratio**2, "drive.load_viscous": ratio**2, "effects.load.coulomb_friction.torque": ratio}
    return {path: value * factor.get(path, 1.0) for path, value in truth.items()}


def make_input(rng: np.random.Generator, kind: str, period: float) -> np.ndarray:
    """Input of 1 N m rms: sines below a tenth of the sampling rate, or steps; shape (samples,)."""
    t = period * np.arange(SAMPLES)
    if kind == "impacts":
        lengths = rng.uniform(12, 60, SAMPLES).astype(int)
        signs = np.repeat(np.where(np.arange(SAMPLES) % 2 == 0, 1.0, -1.0) * rng.uniform(0.5, 1.5, SAMPLES), lengths)
        u = signs[:SAMPLES]
        u = u - np.mean(u)
    else:
        frequencies = np.exp(rng.uniform(math.log(2.0 / t[-1]), math.log(0.03 / period), 8))
        u = sum(np.sin(2.0 * math.pi * (f * t + rng.uniform())) for f in frequencies)
    return u / np.sqrt(np.mean(u**2))


def make_log(seed: int, number: int, kind: str) -> tuple[pd.DataFrame, dict[str, Any], dict[str, float], dict[str, Any]]:
    """A log, its study, the truth by path, and what was drawn; the same arguments give the same ones."""
    rng = np.random.default_rng([seed, number, (*KINDS, LACKING, ZERO).index(kind)])
    drive = "gap" if kind == "impacts" else DRIVES[number % 3]
    period, ratio = draw_factor(rng, 1e-3, 4e-3), float(rng.choice([1.0, 5.0, 20.0]))
    size = draw_factor(rng, 0.1, 2.0)
    at_motor = draw_truth(rng, drive, size, period)
    may_be_zero = [path for path in at_motor if not path.endswith(("inertia", "stiffness"))]
    zeros = [path for path in may_be_zero if rng.uniform() < 0.5] if kind == ZERO else []
    at_motor |= {path: 0.0 for path in zeros if rng.uniform() < 0.3}
    truth = at_load(at_motor, ratio)
    tables = tables_of(truth, ratio)
    effects = list(tables["effects"])
    drawn: dict[str, Any] = {"drive": drive, "period": period, "zeros": zeros}
    disturbance = None
    if kind == "torque":
        share, memory = draw_factor(rng, 0.003, 0.03), draw_factor(rng, 2e-3, 3e-2)
        keep = math.exp(-period / memory)
        white = rng.standard_normal(SAMPLES + 1)
        values = [float(white[0])]
        for each in white[1:]:
            values.append(keep * values[-1] + math.sqrt(1.0 - keep**2) * float(each))
        disturbance = np.array(values)
        effects.append({"kind": "unknown.random_torque", "side": "motor", "torque": share * size})
        drawn |= {"share": share, "memory": memory}
    noise = draw_factor(rng, 1e-5, 2e-4)
    count = 2.0 * math.pi / 2.0 ** rng.integers(12, 18)
    run = Run(
        machine=Machine(tables["drive"], tables.get("transmission"), effects),
        period=period,
        torque=size * make_input(rng, kind, period),
        motor_noise=0.2 * count if kind == "quantised" else noise,
        load_noise=(0.2 * count if kind == "quantised" else noise) / ratio,
        motor_resolution=count if kind == "quantised" else 0.0,
        load_resolution=count if kind == "quantised" else 0.0,
        disturbance=disturbance,
        seed=int(rng.integers(2**31)),
    )
    trace = simulate([run], period / STEPS)[0]
    t, readings = trace.t, {"theta_e": trace.theta_e, "theta_s": trace.theta_s}
    if kind == "jitter":
        late = period * draw_factor(rng, 3e-3, 3e-2) * rng.standard_normal(SAMPLES)
        late = np.clip(late, -0.4 * period, 0.4 * period)
        drawn |= {"late": float(np.std(late) / period), "stamped": number // 3 % 2 == 1}
        for i, name in enumerate(readings):
            if readings[name] is not None:
                readings[name] = readings[name] + moved(trace, i, late, period)
        if drawn["stamped"]:
            t = t + late - late[0]
    drawn["noise"] = count if kind == "quantised" else noise
    log = pd.DataFrame({"t": t, "u": trace.u} | {name: one for name, one in readings.items() if one is not None})
    nominal = {path: value * math.exp(rng.uniform(-0.22, 0.22)) for path, value in truth.items()} | dict.fromkeys(zeros, 0.0)
    study = tables_of(nominal, ratio) | {
        "title": f"{kind} {number}",
        "run": {"sample_period": period, "substeps": 10, "duration": 1.0},
        "uncertainty": {"exact": ["drive.gear_ratio"]},
        "log": {"absent": ["theta_s"]} if drive == "rigid" else {},
    }
    if kind == LACKING:
        truth.pop(dry := next(path for path in truth if "coulomb" in path))
        study["effects"] = [effect for effect in study["effects"] if effect["kind"] not in dry]
    return log, study, truth, drawn


def moved(trace: Trace, side: int, late: np.ndarray, period: float) -> np.ndarray:
    """By how much a side turns from each sample to a time near it, rad: cubic from positions and velocities there."""
    position, velocity = trace.states[2 * side], trace.states[2 * side + 1]
    k = np.arange(len(late))
    left = np.clip(np.where(late < 0.0, k - 1, k), 0, len(late) - 2)
    s = (k - left) + late / period
    p0, p1, v0, v1 = position[left], position[left + 1], period * velocity[left], period * velocity[left + 1]
    at = (1 + 2 * s) * (1 - s) ** 2 * p0 + s * (1 - s) ** 2 * v0 + s * s * (3 - 2 * s) * p1 + s * s * (s - 1) * v1
    return at - position


def identify_log(seed: int, number: int, kind: str, changes: dict[str, Any]) -> dict[str, Any]:
    """One line of the results."""
    log, study, truth, drawn = make_log(seed, number, kind)
    study["run"] |= changes
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "log.parquet"
        log.to_parquet(file)
        start = time.perf_counter()
        summary = identify(file, study).summary
        seconds = time.perf_counter() - start
    rows = {}
    for path, true in truth.items():
        if path in summary["parameters"]:
            estimate = summary["parameters"][path]
            rows[path] = {
                "true": true, "value": estimate["value"], "error": estimate["standard_error"],
                "interval": estimate["interval"],
            }  # fmt: skip
    trajectory = summary["method"]["trajectory"]
    return {
        "seed": seed, "number": number, "kind": kind, **drawn, "changes": changes, "seconds": seconds, "numbers": rows,
        "missing": [path for path in truth if path not in rows], "warnings": summary["warnings"],
        "residual": {side: one["rms"] / one["noise"] for side, one in summary["residual"].items()},
        "variance": trajectory["variance_over_noise"], "inflation": trajectory["inflation"],
        "window": trajectory["window"], "steps": summary.get("steps"), "rejected": summary.get("rejected"),
    }  # fmt: skip


def wilson(hits: int, total: int) -> tuple[float, float]:
    """95 % interval of a share."""
    z, share = 1.959964, hits / total
    reach = z * math.sqrt(share * (1.0 - share) / total + z**2 / (4.0 * total**2))
    middle, size = share + z**2 / (2.0 * total), 1.0 + z**2 / total
    return (middle - reach) / size, (middle + reach) / size


def print_report(lines: list[dict[str, Any]]) -> None:
    """How many intervals hold the truth, by kind, by drive and in all."""
    rows = []
    for line in lines:
        rows += [(line["kind"], line["drive"], None, 0.0)] * len(line["missing"])
        for number in line["numbers"].values():
            low, high = number["interval"]
            held = None if None in (low, high) else low <= number["true"] <= high
            away = 0.0 if held is None else (number["value"] - number["true"]) / number["error"]
            rows.append((line["kind"], line["drive"], held, away))
    frame = pd.DataFrame(rows, columns=["kind", "drive", "held", "away"])
    print(f"{'':12} intervals  hold    %  (95 %)          no interval  rms error / standard error")
    groups = [*frame.groupby("kind", sort=False), *frame.groupby("drive", sort=False), ("all", frame)]
    for name, group in groups:
        bounded = group[group["held"].notna()]
        total, hits = len(bounded), int(bounded["held"].sum())
        if not total:
            print(f"{name:12} {0:9} {'':27} {len(group):12}")
            continue
        low, high = wilson(hits, total)
        print(
            f"{name:12} {total:9} {hits:5} {100 * hits / total:5.1f}  ({100 * low:.1f} to {100 * high:.1f}) "
            f"{len(group) - total:12} {np.sqrt(np.mean(bounded['away'] ** 2)):12.2f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=12, help="logs of each kind")
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=[*KINDS, LACKING, ZERO])
    parser.add_argument("--substeps", type=int, default=10, help="plant steps a sample of the study")
    parser.add_argument("--out", type=Path, default=Path("coverage.jsonl"), help="a line a log")
    parser.add_argument("--report", type=Path, help="print the figures of such a file alone")
    options = parser.parse_args()
    if options.report:
        print_report([json.loads(line) for line in options.report.read_text().splitlines()])
        return
    lines = [json.loads(line) for line in options.out.read_text().splitlines()] if options.out.exists() else []
    done = {(line["seed"], line["number"], line["kind"], line["changes"]["substeps"]) for line in lines}
    for number in range(options.count):
        for kind in options.kinds:
            if (options.seed, number, kind, options.substeps) in done:
                continue
            line = identify_log(options.seed, number, kind, {"substeps": options.substeps})
            lines.append(line)
            with options.out.open("a") as file:
                file.write(json.dumps(line) + "\n")
            print(f"{kind} {number} ({line['drive']}): {line['seconds']:.1f} s", flush=True)
    print_report([line for line in lines if line["changes"]["substeps"] == options.substeps])


if __name__ == "__main__":
    main()
