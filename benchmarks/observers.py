"""Kinds of observer in the situations of an engineer: figure of docs/choosing_an_observer.md, tables of the notes.

    python benchmarks/observers.py [--out results/observers]    # about 12 minutes of processor time; goes on if stopped

Two drives: the axis of docs/tutorial.md, whose hard gap makes the transmitted torque jump, and that of
sweeps/tune_paper_drive.toml, whose soft gap does not. Each kind is tuned by `jaxbl.tune` on the drive's own input: all by
the same search (`tune.observers`) but super-twisting, which has the search of its own that keeps the gain conditions with
their margins. Then every kind meets the same situations with these gains, and some with gains tuned for the situation.
"""

import argparse
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

import jaxbl
from jaxbl.report.drawing import save_canvas, style
from jaxbl.report.panels import COLOURS, FAINT
from jaxbl.sweeps.metrics import SIDE_METRICS, RunMetric

ROOT = Path(__file__).parents[1]
PICTURE = ROOT / "docs" / "figures" / "choosing_an_observer.png"
SUPER_TWISTING = "super_twisting"
FREE = "super_twisting, free gains"
"""Super-twisting with gains of the same search as the other kinds, which asks for no gain condition."""
KINDS = (SUPER_TWISTING, "differentiator_2", "differentiator_3", "kalman", "luenberger", "dirty_derivative")
SEEDS = {"seeds": 8, "first_seed": 100}
"""Seeds that no search has seen."""
MODEL_ERROR = 0.3
ENCODER_FACTOR = 10.0

Table = dict[str, Any]
GainsByKind = dict[str, dict[str, dict[str, float]]]
"""Gains by kind, side and key."""


class VelocityPeak(RunMetric):
    """The largest velocity error; its state is the largest one so far."""

    name = "velocity_peak"
    unit = "rad/s"
    label = "velocity error, peak"
    doc = "largest velocity error in the last quarter of the run"
    better = "less"

    def init(self, zero):
        return zero

    def update(self, carry, sample):
        return jnp.maximum(carry, sample.inside * jnp.abs(sample.velocity_error))

    def result(self, carry, end):
        return carry


class Drive(NamedTuple):
    """A drive, and what it meets.

    Attributes:
        title: heading of its panel.
        study: tables of the study that kinds are tuned on.
        holdout: input that they are compared on.
        jumps: input of the same size that jumps; its last bit of `order` differs between tuning and comparison.
        start_error: velocity error at the start, rad/s at the motor.
        friction: dry friction of the motor that the model lacks beside its wrong inertias, N m.
    """

    title: str
    study: Table
    holdout: Table
    jumps: Table
    start_error: float
    friction: float


class Situation(NamedTuple):
    """A situation that kinds are compared in.

    Attributes:
        name: of the row.
        tuned: the tuning whose gains are used: `smooth`, `jumps` or `torque`.
        jumps: True if the input jumps.
        metric: that is compared, of each side.
        cases: which of :func:`list_cases` are run; the worst counts.
        worst: True if the worst of the seeds counts, else their geometric mean.
    """

    name: str
    tuned: str
    jumps: bool
    metric: str
    cases: tuple[str, ...] = ("nominal",)
    worst: bool = False


SITUATIONS = (
    Situation("drive and encoder as tuned for", "smooth", False, "velocity_rmse"),
    Situation("model 30 % wrong", "smooth", False, "velocity_rmse", ("light", "heavy")),
    Situation("encoder 10 times better", "smooth", False, "velocity_rmse", ("better encoder",)),
    Situation("encoder 10 times worse", "smooth", False, "velocity_rmse", ("worse encoder",)),
    Situation("torque jumps, tuned for it", "jumps", True, "velocity_peak", worst=True),
    Situation("torque jumps, not tuned for it", "smooth", True, "velocity_peak", worst=True),
    Situation("time from a wrong start", "smooth", False, "convergence_time", ("wrong start",), worst=True),
    Situation("transmitted torque, tuned for it", "torque", False, "torque_rmse"),
)


def read_drives() -> dict[str, Drive]:
    """Read both drives by name."""
    tutorial = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"^```toml\n(title = .*?)^```", tutorial, re.S | re.M)
    axis = tomllib.loads(text)
    # a noise beside its counts makes runs differ by seed
    axis["encoders"] |= {"noise": 1e-4, "load_noise": 1e-4 / axis["drive"]["gear_ratio"]}
    axis["run"]["duration"] = 4.0
    paper = tomllib.loads((ROOT / "sweeps" / "tune_paper_drive.toml").read_text(encoding="utf-8"))
    holdout = paper["tune"]["holdout"]
    paper = {key: paper[key] for key in ("drive", "transmission", "excitation", "encoders", "observer", "run")}
    paper["encoders"]["load_noise"] = paper["encoders"]["noise"] / paper["drive"]["gear_ratio"]
    chirp = {"kind": "chirp", "amplitude": 0.15, "start_frequency": 0.2, "stop_frequency": 2.0, "sweep_time": 4.0}
    return {
        "axis": Drive(
            "a geared axis with a hard gap", axis, chirp, {"kind": "prbs", "amplitude": 0.15, "hold": 0.05}, 50.0, 0.02
        ),
        "paper": Drive(
            "the paper's drive: a soft gap", paper, holdout, {"kind": "prbs", "amplitude": 0.1, "hold": 0.5}, 1.0, 0.01
        ),
    }


def tune_kinds(drive: Drive, goal: str, folder: Path) -> GainsByKind:
    """Tune all kinds for a goal: `smooth`, `jumps` (velocity under that input) or `torque`."""
    study, holdout = dict(drive.study), drive.holdout
    if goal == "jumps":
        study["excitation"], holdout = drive.jumps | {"order": 10}, drive.jumps | {"order": 11}
    table: Table = {"objective": "torque" if goal == "torque" else "velocity", "holdout": holdout}
    study["sweep"] = {"seeds": 2}
    kinds = jaxbl.tune(
        study | {"tune": table | {"observers": list(KINDS), "trials": 64, "refine": 3}}, folder / f"{goal}_kinds"
    )
    sides = kinds.summary["points"][0]["sides"]
    gains = {kind: {side: dict(ranks["kinds"][kind]["gains"]) for side, ranks in sides.items()} for kind in KINDS}
    if goal != "torque":
        gains[FREE] = gains[SUPER_TWISTING]
        tuned = jaxbl.tune(study | {"tune": table}, folder / f"{goal}_super_twisting").summary["gains"]
        gains[SUPER_TWISTING] = {side: {key: tuned[side][key] for key in ("lambda", "alpha")} for side in ("motor", "load")}
    return gains


def list_cases(drive: Drive) -> dict[str, dict[str, float]]:
    """List the values of the numbers that differ from case to case, by the case's name and the number's path."""
    encoders, numbers = drive.study["encoders"], drive.study["drive"]
    friction = sum(effect["torque"] for effect in drive.study.get("effects", ()))
    nominal = {f"encoders.{key}": value for key, value in encoders.items()} | {
        "effects.motor.inertia.inertia": 0.0, "effects.load.inertia.inertia": 0.0,
        "effects.motor.coulomb_friction.torque": friction,
        "observer.motor.velocity_error": 0.0, "observer.load.velocity_error": 0.0,
    }  # fmt: skip

    def scale_encoders(factor: float) -> dict[str, float]:
        return {f"encoders.{key}": value * factor for key, value in encoders.items()}

    def add_inertias(share: float) -> dict[str, float]:
        added = {f"effects.{side}.inertia.inertia": share * numbers[f"{side}_inertia"] for side in ("motor", "load")}
        return added | {"effects.motor.coulomb_friction.torque": friction + drive.friction}

    start = {"motor": drive.start_error, "load": drive.start_error / numbers["gear_ratio"]}
    changes = {
        "nominal": {},
        "light": add_inertias(-MODEL_ERROR),
        "heavy": add_inertias(MODEL_ERROR),
        "better encoder": scale_encoders(1.0 / ENCODER_FACTOR),
        "worse encoder": scale_encoders(ENCODER_FACTOR),
        "wrong start": {f"observer.{side}.velocity_error": error for side, error in start.items()},
    }
    return {name: nominal | change for name, change in changes.items()}


def run_cases(drive: Drive, kind: str, gains: Mapping[str, Any], jumps: bool, folder: Path) -> dict[str, pd.DataFrame]:
    """Run all cases of a drive with one kind of observer; each case has a table with a row a seed."""
    cases = list_cases(drive)
    study = dict(drive.study)
    study["effects"] = [{"kind": f"{side}.inertia", "inertia": 0.0} for side in ("motor", "load")]
    study["effects"].append({"kind": "motor.coulomb_friction", "torque": 0.0})
    study["excitation"] = drive.jumps | {"order": 11} if jumps else drive.holdout
    time_constant = gains["motor"].get("equivalent_control.time_constant")
    observer = {side: {key: value for key, value in gains[side].items() if "." not in key} for side in gains}
    study["observer"] = {"kind": kind.partition(",")[0]} | observer
    if time_constant is not None:
        study["equivalent_control"] = {"time_constant": time_constant}
    metrics = [*dict.fromkeys(situation.metric for situation in SITUATIONS), "velocity_size", "f_plus"]
    study["sweep"] = SEEDS | {"metrics": metrics}
    paths = list(cases["nominal"])
    study["axes"] = [{"path": path, "values": [case[path] for case in cases.values()], "zip": "case"} for path in paths]
    frame = jaxbl.sweep(study, folder).frame
    tables = {}
    for name, case in cases.items():
        is_case = np.all([np.isclose(frame[path], value, atol=0.0) for path, value in case.items()], axis=0)
        tables[name] = frame.loc[is_case]
        assert len(tables[name]) == SEEDS["seeds"]
    return tables


def measure(name: str, drive: Drive, folder: Path) -> pd.DataFrame:
    """Measure all situations of a drive: a row for each kind, situation and side."""
    rows = []
    for goal in ("smooth", "jumps", "torque"):
        gains = tune_kinds(drive, goal, folder / name)
        for jumps in (False, True):
            situations = [situation for situation in SITUATIONS if (situation.tuned, situation.jumps) == (goal, jumps)]
            for kind in gains if situations else ():
                # a low-pass for each side: torques of the load come from a run of their own
                for side in ("motor", "load") if goal == "torque" else ("both",):
                    of_kind = dict(gains[kind])
                    if side == "load":
                        key = "equivalent_control.time_constant"
                        of_kind["motor"] = of_kind["motor"] | {key: of_kind["load"][key]}
                    run = f"{goal}_{'jumps' if jumps else 'smooth'}_{kind.replace(', ', '_').replace(' ', '_')}_{side}"
                    tables = run_cases(drive, kind, of_kind, jumps, folder / name / run)
                    for situation in situations:
                        for of_side in ("motor", "load") if side == "both" else (side,):
                            value = judge_runs(tables, situation, of_side)
                            rows.append((name, situation.name, of_side, kind, value, repr(gains[kind][of_side])))
    return pd.DataFrame(rows, columns=["drive", "situation", "side", "kind", "value", "gains"])


def judge_runs(tables: Mapping[str, pd.DataFrame], situation: Situation, side: str) -> float:
    """Judge a kind by its runs: the worst case, NaN if a run does not converge."""
    values = []
    for case in situation.cases:
        of_seeds = tables[case][f"{side}.{situation.metric}"].to_numpy(float)
        values.append(np.max(of_seeds) if situation.worst else np.exp(np.mean(np.log(of_seeds))))
    return float(np.max(values))


MARKS = {
    SUPER_TWISTING: ("super-twisting, the default", COLOURS[1], "D", 11.0),
    "differentiator_2": ("differentiator 2", COLOURS[4], "^", 8.0),
    "differentiator_3": ("differentiator 3", COLOURS[3], "v", 8.0),
    "kalman": ("Kalman filter", COLOURS[0], "o", 8.0),
    "luenberger": ("Luenberger observer", COLOURS[5], "s", 8.0),
    "dirty_derivative": ("filtered difference", FAINT, "X", 8.0),
}
"""Label, colour, marker and its size of each kind, in the order of the legend."""


def select_values(table: pd.DataFrame, drive: str, situation: Situation, side: str) -> dict[str, float]:
    """Select the values of a situation by kind."""
    is_chosen = (table["drive"] == drive) & (table["situation"] == situation.name) & (table["side"] == side)
    return dict(zip(table.loc[is_chosen, "kind"], table.loc[is_chosen, "value"], strict=True))


@style()
def draw_situations(table: pd.DataFrame, drives: Mapping[str, Drive]) -> Figure:
    """Draw error over the least one, a row for each situation and a panel for each drive."""
    figure = Figure(figsize=(11.0, 6.0))
    panels = figure.subplots(1, len(drives), sharey=True)
    for ax, (name, drive) in zip(panels, drives.items(), strict=True):
        for row, situation in enumerate(SITUATIONS):
            values = select_values(table, name, situation, "motor")
            least = np.nanmin([values[kind] for kind in MARKS])
            ax.plot(
                [1.0, np.nanmax([values[kind] for kind in MARKS]) / least], [row, row], color="#DDDDDD", lw=2.0, zorder=1
            )
            for kind, (label, colour, marker, size) in MARKS.items():
                ax.plot(
                    values[kind] / least, row, marker, ms=size, color=colour, mec="white", mew=0.8, ls="none",
                    zorder=3 + (size > 10.0), label=label if row == 0 else None,
                )  # fmt: skip
            best = next(kind for kind in MARKS if values[kind] == least)
            ax.text(
                0.97, row - 0.29, f"least: {MARKS[best][0].partition(',')[0]}", color="#555555", fontsize=8.5, va="center"
            )
        ax.set(xscale="log", xlim=(0.85, None), xlabel="error (or time) ÷ the least of all kinds", title=drive.title)
        ax.xaxis.set_major_locator(FixedLocator([1, 2, 5, 10, 20, 50, 100, 200, 500]))
        ax.xaxis.set_major_formatter(FuncFormatter(lambda ratio, _: f"{ratio:g}"))
        ax.xaxis.set_minor_locator(NullLocator())
        ax.grid(visible=False, axis="y")
    panels[0].set_yticks(range(len(SITUATIONS)), [situation.name for situation in SITUATIONS])
    panels[0].set_ylim(len(SITUATIONS) - 0.6, -0.6)
    figure.legend(
        *panels[0].get_legend_handles_labels(),
        loc="outside upper center",
        ncols=len(MARKS),
        columnspacing=1.4,
        handletextpad=0.3,
    )
    return figure


def write_tables(table: pd.DataFrame, drives: Mapping[str, Drive]) -> str:
    """Write the tables in Markdown: for each drive and side each kind's value over the least one, and that one."""
    lines = []
    kinds = [*KINDS, FREE]
    for name, side in ((name, side) for name in drives for side in ("motor", "load")):
        lines += ["", f"{name}, {side}", "", f"| situation | {' | '.join(kinds)} | least |", "|---" * (len(kinds) + 2) + "|"]
        for situation in SITUATIONS:
            values = select_values(table, name, situation, side)
            least = np.nanmin([values[kind] for kind in KINDS])
            ratios = " | ".join(f"{values[kind] / least:.3g}" if kind in values else "" for kind in kinds)
            lines.append(f"| {situation.name} | {ratios} | {least:.3g} {SIDE_METRICS[situation.metric].unit} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "observers", help="folder of the runs")
    parser.add_argument("--draw", action="store_true", help="draw what is in the folder, without running anything")
    asked = parser.parse_args()
    SIDE_METRICS.add(VelocityPeak)
    drives, stored = read_drives(), asked.out / "situations.csv"
    if not asked.draw:
        pd.concat([measure(name, drive, asked.out) for name, drive in drives.items()]).to_csv(stored, index=False)
    table = pd.read_csv(stored)
    print(write_tables(table, drives))
    save_canvas(draw_situations(table, drives), PICTURE)


if __name__ == "__main__":
    main()
