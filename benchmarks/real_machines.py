"""The bench of real machines: what does `jaxbl diagnose` say of recordings, and is it better than a plain regression?

The recordings are no part of the project. `--data` names the folder with them; real/machines.py says which files, their
SHA-256, the split into fitted and held-out logs, the nominal model and what is published. A file that is missing or another
version is said in one line, and its row is left out.

    python benchmarks/real_machines.py --data ../shared/data
    python benchmarks/real_machines.py --data ../shared/data --only emps servo_1khz --rivals --out results/real

`--rivals` fits three other tools to the same logs; two of them on terms of filtered derivatives (4th-order Butterworth forth
and back, central differences): inertia, viscous and Coulomb friction, Stribeck friction, constant torque, quadratic drag,
viscous friction by direction, up to 40 periods a turn, and the twist of a shaft.

- stepwise least squares: a term is added if it takes 3 % off the rms of a blocked cross-validation, and more than one
  standard error of the blocks' gains;
- pysindy (`pip install pysindy`): sequentially thresholded ridge regression, threshold and ridge by the same blocks;
- mujoco (`pip install "mujoco[sysid]"`, 4.0): the numbers that a MuJoCo joint has (inertia, damping, dry friction, gravity
  on a rotary axis, a spring between two inertias), fitted to the positions over windows of 0.5 s. It names nothing.

All torque errors of that comparison are those of the same filtered derivatives, behind the same low-pass: the equation of
motion of the model that jaxbl returned is applied to them as the terms of the others are, and its error is referred to the
input. Its own account (errors before, after, limit) is on its smoothed motion, behind a low-pass that it chose; that would
favour it in a comparison. Where the drive is at rest (a speed within its noise) nothing is compared, and nothing fitted by
the others: dry friction takes there what it has to. All tools have the positions as jaxbl turned them to one zero.
"""

import argparse
import sys
import tempfile
import time
import traceback
from pathlib import Path

import numpy as np
from real.derivatives import driving, parts_of, terms_of, torque_error
from real.machines import CASES, Case, logs_of, unfit
from real.mujoco_sysid import sysid
from real.rivals import sindy, stepwise
from real.table import Row, markdown, row_of, write

CACHE = Path(__file__).parents[1] / ".cache" / "jax"


def diagnose_case(case: Case, data: Path, rivals: bool) -> Row:
    """The row of a case."""
    from jaxbl.diagnosis.diagnose import run_diagnosis
    from jaxbl.diagnosis.diagnosis_task import read_diagnosis_task
    from jaxbl.errors import InputError

    row, task, model = row_of(case), None, None
    with tempfile.TemporaryDirectory() as folder:
        logs, holdout = logs_of(case, data, Path(folder))
        start = time.perf_counter()
        try:
            task = read_diagnosis_task(logs, case.study, holdout=holdout)
            diagnosis = run_diagnosis(task)
            row.summary, model = diagnosis.summary, diagnosis.model
        except InputError as error:
            row.error, row.expected = str(error).replace(f"{data}/", ""), not case.readable
            if row.expected:
                row.error += _lost_motion(case, logs[0])
        except Exception as error:
            traceback.print_exc()
            row.error = f"{type(error).__name__}: {error}"
        row.seconds = time.perf_counter() - start
        # what is held out is read once by the diagnosis, and anew for the comparison
        again = None if task is None else read_diagnosis_task(logs, case.study, holdout=holdout)
    if task is None or again is None or not case.readable:
        return row
    _compare(row, case, task, again.holdout.open(), model, rivals)
    return row


def _lost_motion(case: Case, log: Path) -> str:
    """Gap by `jaxbl inspect` of a recording that cannot be diagnosed."""
    from jaxbl.records import inspect

    gearing = inspect(log, case.study["log"]).record.statistics.gearing
    return "" if gearing is None else f"; lost motion by inspect: {gearing.describe_lost_motion('rad')}"


def _compare(row: Row, case: Case, task, holdout, model, rivals: bool) -> None:
    """Add the torque errors of all tools on the held-out record behind one low-pass."""
    sides = ("motor", "load") if task.config.drive.kind == "two_inertia" else ("motor",)
    fitted, held = (parts_of(part, sides, case.cutoff) for part in (task.record, holdout))
    linear = task.record.statistics.channels["theta_e"].unit == "m"
    row.unit = "N" if linear else "N m"
    row.driving = driving(held, float(task.config.drive.motor_inertia))
    errors = {"nominal": torque_error(task.config, holdout, held)}
    if model is not None:
        errors["jaxbl"] = torque_error(model, holdout, held)
    row.torques = {name: float(np.sqrt(np.mean(part**2))) for name, part in errors.items()}
    if not rivals:
        return
    speed = max(float(np.max(np.abs(part.kinematics.velocity["motor"]))) for part in fitted)
    travel = max(float(np.ptp(part.kinematics.position["motor"])) for part in fitted)
    terms, other = (terms_of(parts, task.config, linear, (speed, travel)) for parts in (fitted, held))
    errors_of_rivals = []
    tools = {
        "stepwise": lambda: stepwise(terms, other),
        "pysindy": lambda: sindy(terms, other),
        "mujoco": lambda: sysid(fitted, held, task.config, linear),
    }
    for name, tool in tools.items():
        result = tool()
        row.rivals[name], row.torques[name] = result.to_dict(), result.rms
        errors_of_rivals += [result.left] if result.rms is not None else []
    # beside all of them or none
    if "jaxbl" in errors and len(errors_of_rivals) == len(row.rivals):
        row.margin = _margin(errors["jaxbl"], min(errors_of_rivals, key=lambda part: float(np.mean(part**2))))


_BLOCKS = 16
"""Blocks of the held-out data: enough for a standard error."""


def _margin(errors: np.ndarray, other: np.ndarray) -> float | None:
    """Standard errors by which the squares of errors are less than those of another tool; None of too few of them."""
    if len(errors) < 4 * _BLOCKS:
        return None
    gains = np.array([np.mean(block) for block in np.array_split(other**2 - errors**2, _BLOCKS)])
    return float(np.mean(gains) / max(np.std(gains, ddof=1) / np.sqrt(_BLOCKS), 1e-300))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="folder with the recordings")
    parser.add_argument(
        "--only", nargs="+", metavar="NAME", choices=[known_case.name for known_case in CASES], help="these rows alone"
    )
    parser.add_argument("--rivals", action="store_true", help="fit the other tools as well")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="leave scores.md, JSON files and a figure there")
    asked = parser.parse_args()

    import jax

    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(CACHE))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    rows, files = [], []
    for case in CASES:
        if asked.only and case.name not in asked.only:
            continue
        if reason := unfit(case, asked.data):
            print(f"{case.name} is left out: {reason}", file=sys.stderr)
            continue
        rows.append(diagnose_case(case, asked.data, asked.rivals))
        print(f"{case.name}: {rows[-1].summary.get('verdict', 'no diagnosis')}, {rows[-1].seconds:.0f} s", file=sys.stderr)
        # after each: some take minutes
        files = [] if asked.out is None else write(rows, markdown(rows, asked.rivals), asked.out)
    print(markdown(rows, asked.rivals))
    for path in files:
        print(path)


if __name__ == "__main__":
    main()
