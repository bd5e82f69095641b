"""Logs in wrong units: does any command take them in silence?

Five logs, each wrong in five ways: torque 1000 times too large, both encoders in degrees, sign of u reversed, time in ms,
positions 1000 times too small. `inspect`, `identify` and `diagnose` should refuse each in one line (exit code 2), or begin
with a warning, and end within a minute. As a control, `--right` runs the logs as they are: no doubt should be said.

    python benchmarks/wrong_units.py --data ../shared/data
    python benchmarks/wrong_units.py --only axis hidden --commands inspect identify --right

The simulated logs are the axis of docs/logs.md and a case of the bench of hidden effects; the recordings are those of
real/machines.py, left out without `--data`. A linear axis has no degrees: there, positions in mm are read as m.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import tomli_w
from hidden.cases import cases
from real.machines import CASES, logs_of, unfit

from jaxbl.config import read_model
from jaxbl.records import read_record
from jaxbl.sweeps.trial import run

ROOT = Path(__file__).parents[1]
COMMANDS = ("inspect", "identify", "diagnose")
RECORDINGS = ("emps", "servo_1khz-S1", "flexible_link")
LONGEST = 60.0
"""Seconds that a command may take."""
DOUBT = "Doubtful: "
"""Beginning of a warning of wrong units."""


class MeasuredLog(NamedTuple):
    """A log in SI units, the study that it is read by, and whether its axis is linear."""

    frame: pd.DataFrame
    study: dict
    linear: bool = False


class Ended(NamedTuple):
    """End of a command: its first line, exit code, wall time in s, and processor time in s."""

    line: str
    code: int
    seconds: float
    computed: float


def simulated_axis() -> MeasuredLog:
    """The axis of docs/logs.md."""
    frame = run(ROOT / "sweeps" / "geared_axis.toml").trace[["t", "u", "theta_e", "theta_s"]]
    config, _ = read_model(ROOT / "sweeps" / "geared_axis_nominal.toml")
    return MeasuredLog(frame, config.to_dict())


def hidden_effect() -> MeasuredLog:
    """A case of the bench of hidden effects."""
    (case,) = cases(5, 1, "single")
    return MeasuredLog(pd.DataFrame(case.log.columns()), dict(case.model))


def recording(name: str, data: Path, folder: Path) -> MeasuredLog:
    """One of real/machines.py, its first log."""
    case = next(candidate for candidate in CASES if candidate.name == name)
    if reason := unfit(case, data):
        raise SystemExit(f"{name}: {reason}")
    logs, _ = logs_of(case, data, folder)
    config, _ = read_model(case.study)
    record = read_record(logs[0], config.log)
    frame = pd.DataFrame({"t": record.time, "u": record.torque, "theta_e": record.positions["motor"]})
    if config.drive.kind == "two_inertia":
        frame["theta_s"] = record.positions["load"]
    linear = record.statistics.channels["theta_e"].unit == "m"
    log = {"closed_loop": True} | ({"theta_e": {"unit": "m"}} if linear else {})
    return MeasuredLog(frame, dict(case.study) | {"log": log}, linear)


def _scale(log: MeasuredLog, columns: tuple[str, ...], factor: float) -> pd.DataFrame:
    return log.frame.assign(**{name: factor * log.frame[name] for name in columns if name in log.frame})


_BOTH = ("theta_e", "theta_s")
WRONG: dict[str, Callable[[MeasuredLog], pd.DataFrame]] = {
    "torque x 1000": lambda log: _scale(log, ("u",), 1e3),
    "degrees": lambda log: _scale(log, _BOTH, 1e3 if log.linear else 180.0 / np.pi),
    "sign of u": lambda log: _scale(log, ("u",), -1.0),
    "time in ms": lambda log: _scale(log, ("t",), 1e3),
    "positions / 1000": lambda log: _scale(log, _BOTH, 1e-3),
}
RIGHT: dict[str, Callable[[MeasuredLog], pd.DataFrame]] = {"nothing": lambda log: log.frame}


def run_command(command: str, log: Path, model: Path, out: Path, limit: float) -> Ended:
    """Run a command in a process of its own, ended after `limit` seconds."""
    call = [sys.executable, "-m", "jaxbl", command, str(log), "--model", str(model), "--out", str(out), "--overwrite"]
    start, before = time.perf_counter(), _processor_seconds()
    try:
        done = subprocess.run(call, capture_output=True, text=True, timeout=limit, check=False, env=os.environ)
    except subprocess.TimeoutExpired:
        return Ended("(not ended)", -1, time.perf_counter() - start, _processor_seconds() - before)
    output = done.stderr if done.returncode else done.stdout
    line = next(iter(output.splitlines()), "")
    return Ended(line.replace(f"{log}: ", ""), done.returncode, time.perf_counter() - start, _processor_seconds() - before)


def _processor_seconds() -> float:
    """Processor time of all processes that have ended, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def fault(change_name: str, run: Ended) -> str:
    """Fault in a command's answer to a log; empty if there is none."""
    doubts = run.line.startswith(DOUBT)
    if change_name in RIGHT:
        return "false doubt" if run.code or doubts else ""
    if run.code == 2 or (run.code == 0 and doubts):
        return "slow" if run.seconds > LONGEST else ""
    return "silent" if run.code == 0 else "failed"


def rows(asked: argparse.Namespace, folder: Path) -> Iterator[tuple[str, str, str, Ended, str]]:
    """Log, what is wrong, command, how it ended, fault."""
    makers: dict[str, Callable[[], MeasuredLog]] = {"axis": simulated_axis, "hidden": hidden_effect}
    if asked.data is not None:
        makers |= {name: (lambda name=name: recording(name, asked.data, folder)) for name in RECORDINGS}
    for name, maker in makers.items():
        if asked.only and name not in asked.only:
            continue
        log = maker()
        model = folder / f"{name}.toml"
        model.write_text(tomli_w.dumps(log.study))
        for change_name, change in (RIGHT if asked.right else WRONG).items():
            if asked.wrong and change_name not in asked.wrong:
                continue
            path = folder / f"{name}.parquet"
            change(log).to_parquet(path)
            for command in asked.commands:
                run = run_command(command, path, model, folder / "out" / command, asked.limit)
                yield name, change_name, command, run, fault(change_name, run)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder with the recordings")
    parser.add_argument("--only", nargs="+", metavar="LOG", choices=("axis", "hidden", *RECORDINGS), help="these logs alone")
    parser.add_argument("--wrong", nargs="+", metavar="WHAT", choices=WRONG, help="wrong in these ways alone")
    parser.add_argument("--commands", nargs="+", metavar="NAME", choices=COMMANDS, default=COMMANDS, help="these alone")
    parser.add_argument("--right", action="store_true", help="the logs as they are: nothing should be doubted")
    parser.add_argument("--limit", type=float, default=180.0, metavar="S", help="end a command after so long")
    asked = parser.parse_args()
    faults, count = 0, 0
    print("| log | wrong | command | first line | exit | s | processor s | fault |")
    print("|---|---|---|---|---:|---:|---:|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name, change_name, command, run, wrong in rows(asked, Path(folder)):
            count, faults = count + 1, faults + bool(wrong)
            line = run.line.replace("|", "/")
            line = f"{line[:150]}..." if len(line) > 150 else line
            print(
                f"| {name} | {change_name} | {command} | {line} | {run.code} | {run.seconds:.1f} | "
                f"{run.computed:.1f} | {wrong} |",
                flush=True,
            )
    print(f"\n{faults} of {count} with a fault")
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
