"""What the tool recommends, on the machine: each figure announced beside the one achieved on a machine simulated apart.

    python benchmarks/advice.py sheets [--count 30]    # data sheets: init, tune
    python benchmarks/advice.py logs [--count 20]      # logs: inspect --write, identify, tune
    python benchmarks/advice.py logs --only 3

Machines are drawn within the tolerances of the sheet, or are those of `hidden_effects.py` without a hidden effect. Plant and
observers are the bench's own (`hidden.simulator`, and below); of the package come the study, its numbers and gains alone.
"""

import argparse
import contextlib
import dataclasses
import io
import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from hidden.cases import cases
from hidden.simulator import Machine, Run, Trace, simulate

import jaxbl
from jaxbl.datasheet import KINDS, write_first_study
from jaxbl.records.proposal import propose_study

GAIN_STEPS = 24
"""Values of each gain in the search on the machine."""


class Gains(NamedTuple):
    """lambda (√rad/s) and alpha (rad/s²) of several observers of one side, shape (n,)."""

    lambda_: np.ndarray
    alpha: np.ndarray


def observe(study: Mapping[str, Any], trace: Trace, side: str, gains: Gains) -> tuple[np.ndarray, np.ndarray]:
    """Run observers with a study's numbers on readings of a machine.

    The scheme is backward Euler of (7)-(8); friction acts at the mean velocity of a period.

    Returns:
        rms velocity error over the last quarter (rad/s), and largest missing acceleration (rad/s²), shape (n,) and ().
    """
    drive, period = study["drive"], float(trace.t[1] - trace.t[0])
    rate = drive[f"{side}_viscous"] / drive[f"{side}_inertia"]
    push = trace.command / drive["motor_inertia"] if side == "motor" else np.zeros(len(trace.t))
    readings, true = (trace.theta_e, trace.states[1]) if side == "motor" else (trace.theta_s, trace.states[3])
    assert readings is not None
    position, velocity = np.full(len(gains.alpha), float(readings[0])), np.full(len(gains.alpha), float(true[0]))
    reach, damping = period**2 * gains.alpha, period * gains.lambda_
    first, squares = 3 * len(true) // 4, 0.0
    for i, reading in enumerate(readings):
        innovation = reading - position
        sliding = np.clip(innovation, -reach, reach)
        beyond = np.abs(innovation - sliding)
        error = np.sign(innovation) * (0.5 * (np.sqrt(damping**2 + 4.0 * beyond) - damping)) ** 2
        control = sliding / period**2
        position, velocity = reading - error, velocity + period * control
        if i >= first:
            squares = squares + (velocity - true[i]) ** 2
        # friction at the mean velocity of the period, to which what the model lacks belongs
        nominal = push[i] - rate * (velocity + period * (control + 0.5 * (push[i] - rate * velocity)))
        position, velocity = position + period * (velocity + 0.5 * period * nominal), velocity + period * nominal
    missing = np.gradient(true, period) - (push - rate * true)
    return np.sqrt(squares / (len(true) - first)), np.quantile(np.abs(missing), 0.999)


def search_gains(study: Mapping[str, Any], trace: Trace, side: str, f_plus: float) -> float:
    """Return the least velocity error (rad/s) on the machine of gains that keep `tune`'s margins of 1.1."""
    ratio, root = np.meshgrid(np.geomspace(1.1, 100.0, GAIN_STEPS), np.geomspace(0.3, 50.0, GAIN_STEPS))
    gains = Gains(root.ravel() * math.sqrt(f_plus), ratio.ravel() * f_plus)
    with np.errstate(invalid="ignore", over="ignore"):
        errors, _ = observe(study, trace, side, gains)
    from jaxbl.observer.conditions import least_lambda_exact

    least = np.asarray(least_lambda_exact(ratio.ravel(), np.ones(ratio.size))) * math.sqrt(f_plus)
    return float(np.nanmin(np.where(gains.lambda_ >= 1.1 * least, errors, np.nan)))


class Row(NamedTuple):
    """A side of a machine: announced over achieved error, and achieved over the best that a search on the machine finds."""

    name: str
    side: str
    expected: float
    tuned: float
    over_best: float
    remark: str


def judge_gains(name: str, study: Mapping[str, Any], tuning: Any, trace: Trace, expected: float = math.nan) -> list[Row]:
    """Compare what `tune` announced of a study's gains with what they do on a machine."""
    rows = []
    for side, gains in tuning.summary["gains"].items():
        announced = tuning.summary["achieved"][side]["velocity_rmse"]
        pairs = [gains, {key: study["observer"][side][key] for key in ("lambda", "alpha")}]
        errors, _ = observe(
            study, trace, side, Gains(*(np.array([pair[key] for pair in pairs]) for key in ("lambda", "alpha")))
        )
        best = search_gains(study, trace, side, tuning.summary["f_plus"][side])
        share = expected / errors[1] if side == "motor" else math.nan
        word = tuning.summary["verdict"][side]["gains_matter"]
        rows.append(Row(name, side, share, announced / errors[0], errors[0] / best, f"gains matter: {word}"))
    return rows


# data sheets


def draw_sheet(index: int) -> tuple[str, dict[str, str]]:
    """Draw the kind of a drive and the numbers of its data sheet."""
    rng = np.random.default_rng([42, index])

    def spread(low: float, high: float) -> float:
        return math.exp(rng.uniform(math.log(low), math.log(high)))

    name = ("servo", "screw", "direct", "linear", "robot")[index % 5]
    numbers: dict[str, str] = {
        "sample_period": str(rng.choice(["2 ms", "1 ms", "0.25 ms"])), "frequency": str(rng.choice(["0.5 Hz", "1 Hz"])),
    }  # fmt: skip
    has_encoders = bool(rng.random() < 0.7)
    if name in ("servo", "robot"):
        inertia = spread(1e-5, 1e-3)
        torque = spread(0.3, 5.0) * (inertia / 1e-4) ** 0.6
        ratio = int(rng.choice([5, 10, 20, 50] if name == "servo" else [50, 80, 100, 160]))
        numbers |= {
            "motor_inertia": f"{inertia:.3g} kg m²", "torque": f"{torque:.3g} N m", "speed": f"{spread(1500, 6000):.0f} rpm",
            "gear_ratio": str(ratio), "stiffness": f"{spread(3, 60) * torque * ratio / 50:.3g} N m/arcmin",
            "backlash": f"{rng.choice([0.5, 1, 3, 5])} arcmin",
            "load_inertia": f"{inertia * ratio**2 * spread(0.3, 5):.3g} kg m²",
            "motor_friction": f"{0.05 * torque:.3g} N m", "load_viscous": f"{6e-5 * torque * ratio**2:.3g} N m s/rad",
        }  # fmt: skip
        if has_encoders:
            numbers |= {"motor_encoder": str(rng.choice(["17 bit", "20 bit", "2500 lines"])), "load_encoder": "20 bit"}
        return "geared", numbers
    if name == "screw":
        torque = spread(0.5, 10.0)
        numbers |= {
            "motor_inertia": f"{spread(5e-5, 1e-3):.3g} kg m²", "torque": f"{torque:.3g} N m", "speed": "3000 rpm",
            "lead": f"{rng.choice([5, 10, 20])} mm", "stiffness": f"{spread(50, 300):.3g} N/um",
            "backlash": f"{rng.choice([5, 10, 20])} um", "mass": f"{spread(20, 300):.3g} kg",
            "load_viscous": f"{spread(50, 1000):.3g} N s/m", "motor_friction": f"{0.05 * torque:.3g} N m",
        }  # fmt: skip
        if has_encoders:
            numbers |= {"motor_encoder": "20 bit", "load_encoder": str(rng.choice(["100 nm", "1 um"]))}
        return "screw", numbers
    if name == "direct":
        torque = spread(2.0, 50.0)
        numbers |= {
            "motor_inertia": f"{spread(1e-3, 1.0):.3g} kg m²", "torque": f"{torque:.3g} N m",
            "speed": f"{spread(100, 600):.0f} rpm", "motor_friction": f"{0.05 * torque:.3g} N m",
            "encoder_noise": f"{spread(0.2, 5.0):.2g} arcsec",
        }  # fmt: skip
        return "direct", numbers | ({"motor_encoder": str(rng.choice(["20 bit", "23 bit"]))} if has_encoders else {})
    mass = spread(1.0, 50.0)
    numbers |= {
        "mass": f"{mass:.3g} kg", "force": f"{mass * spread(5, 50):.3g} N", "speed": f"{spread(0.5, 4.0):.2g} m/s",
        "motor_friction": f"{mass * spread(0.3, 2.0):.3g} N",
    }  # fmt: skip
    return "linear", numbers | ({"motor_encoder": str(rng.choice(["100 nm", "50 nm"]))} if has_encoders else {})


def draw_machine(study: Mapping[str, Any], rng: np.random.Generator) -> Machine:
    """Draw a machine within the tolerances of a data sheet: relative standard deviations of its numbers."""

    def off(value: float, share: float) -> float:
        return value * (1.0 + share * float(np.clip(rng.normal(), -2.0, 2.0)))

    shares = {"motor_inertia": 0.03, "load_inertia": 0.05, "motor_viscous": 0.2, "load_viscous": 0.2}
    drive = {
        key: off(value, shares.get(key, 0.0)) if isinstance(value, float) else value for key, value in study["drive"].items()
    }
    law = study.get("transmission")
    law = (
        None if law is None else {key: off(value, 0.1) if isinstance(value, float) else value for key, value in law.items()}
    )
    effects = [
        {key: off(value, 0.2) if isinstance(value, float) else value for key, value in effect.items()}
        for effect in study["effects"]
    ]
    return Machine(drive, law, effects)


def run_machine(study: Mapping[str, Any], machine: Machine, torque: np.ndarray, seed: int) -> Trace:
    """Simulate a machine under a torque, with the encoders of a study."""
    encoders, ratio = study["encoders"], machine.ratio
    run = Run(
        machine, study["run"]["sample_period"], torque, motor_noise=encoders.get("noise", 0.0),
        load_noise=encoders.get("load_noise", encoders.get("noise", 0.0) / ratio), seed=seed,
        motor_resolution=encoders.get("motor_resolution", 0.0), load_resolution=encoders.get("load_resolution", 0.0),
    )  # fmt: skip
    return simulate([run], step=min(2.5e-4, study["run"]["sample_period"] / max(study["run"].get("substeps", 2), 2)))[0]


def multisine(table: Mapping[str, Any], period: float, duration: float) -> np.ndarray:
    """Torque of the multisine of a study at its samples."""
    time, count = period * np.arange(round(duration / period)), table["count"]
    k = np.arange(1, count + 1)
    waves = np.cos(2.0 * np.pi * table["frequency"] * time[:, None] * k - np.pi * k * (k - 1) / count)
    return table["amplitude"] / math.sqrt(count) * waves.sum(axis=1)


def try_sheet(index: int) -> list[Row]:
    """From a data sheet to gains, and those on a machine of it."""
    kind, numbers = draw_sheet(index)
    items = {item.name: item for item in KINDS[kind].items}
    answers = {name: item.read(numbers[name]) if name in numbers else item.default_answer() for name, item in items.items()}
    text, pilot = write_first_study(KINDS[kind], answers, "")
    study = tomllib.loads(text)
    trial, shares = jaxbl.run(study), jaxbl.sweep(study).frame["motor.converged"].mean()
    metrics = trial.summary["metrics"]
    checks = [
        f"map {100 * shares:.0f} %",
        f"speed {np.abs(trial.trace['motor.velocity']).max() / answers['speed'].value:.2f}",
    ]
    checks += [f"{side} does not converge" for side in ("motor", "load") if not metrics.get(f"{side}.converged", True)]
    rng = np.random.default_rng([43, index])
    machine = draw_machine(study, rng)
    torque = multisine(study["excitation"], study["run"]["sample_period"], study["run"]["duration"])
    trace = run_machine(study, machine, torque, index)
    name = f"{index} {('servo', 'screw', 'direct', 'linear', 'robot')[index % 5]}"
    rows = judge_gains(name, study, jaxbl.tune(study), trace, pilot["motor"]["expected"]["velocity"])
    return [row._replace(remark=f"{', '.join(checks)}; {row.remark}") for row in rows]


# logs


def try_log(index: int, folder: Path) -> list[Row]:
    """From a log to gains by `inspect --write`, `identify` and `tune`, and those on the machine that made the log."""
    (case,) = cases(700 + index, 1, "none")
    case.log.write(folder / "log.csv")
    proposal, _, _ = propose_study(folder / "log.csv", gear_ratio=case.model["drive"].get("gear_ratio"))
    identification = jaxbl.identify(folder / "log.csv", proposal)
    with contextlib.redirect_stdout(io.StringIO()):
        jaxbl.write_report(identification, folder / "identified")
    study = jaxbl.read_config(folder / "identified" / "model.toml")
    tuning = jaxbl.tune(study)
    # the machine again, with other noise
    run, data = case.runs[0], study.to_dict()
    trace = simulate([dataclasses.replace(run, seed=run.seed + 1)])[0]
    name = f"{index} {case.conditions['plant']}, {case.conditions['loop']} loop"
    return judge_gains(name, data, tuning, trace)


def main() -> None:
    """Print a row for each side of each machine, then medians and worst."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("sheets", "logs"))
    parser.add_argument("--count", type=int)
    parser.add_argument("--only", type=int, help="number of one sheet or log")
    arguments = parser.parse_args()
    count = arguments.count or (30 if arguments.what == "sheets" else 20)
    rows: list[Row] = []
    for index in range(count) if arguments.only is None else [arguments.only]:
        with TemporaryDirectory() as place:
            try:
                found = try_sheet(index) if arguments.what == "sheets" else try_log(index, Path(place))
            except (jaxbl.InputError, jaxbl.NoResult) as error:
                print(f"{index}: {error}", flush=True)
                continue
        rows += found
        for row in found:
            expected = "" if math.isnan(row.expected) else f"expected {row.expected:.2f}, "
            figures = f"{expected}announced {row.tuned:.2f} of achieved; {row.over_best:.2f} of the best"
            print(f"{row.name}, {row.side}: {figures}; {row.remark}", flush=True)
    for field in ("expected", "tuned", "over_best"):
        values = np.array([getattr(row, field) for row in rows])
        values = values[np.isfinite(values)]
        if len(values):
            worst = values[np.argmax(np.abs(np.log(values)))]
            print(f"{field}: median {np.median(values):.3f}, worst {worst:.3f}, of {len(values)}")


if __name__ == "__main__":
    main()
