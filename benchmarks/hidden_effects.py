"""The bench of hidden effects: machines with something in them that the model does not have. Is it found, named, proved?

The truth comes from a simulator of its own (hidden/simulator.py: nothing of the package in it, another integrator, located
events), cases from a seed (hidden/cases.py, sizes in hidden/effects.py), figures from hidden/scoring.py. With numba (the
extra `bench`) 100 cases take a quarter of a CPU minute to draw; without it, in NumPy, some seven.

    python benchmarks/hidden_effects.py --seed 1 --count 66 --kind single          # all effects at 3, 10 and 30 %
    python benchmarks/hidden_effects.py --seed 1 --count 200 --kind all --out results/hidden
    python benchmarks/hidden_effects.py --seed 1 --count 100 --kind clutter --out results/clutter
    python benchmarks/hidden_effects.py --seed 1 --count 20 --kind rough --out results/rough   # nothing is missing
    python benchmarks/hidden_effects.py --seed 1 --count 200 --kind all --save results/cases    # logs and models as files
    python benchmarks/hidden_effects.py --seed 1 --count 200 --kind all --results results/diagnosed   # what a batch left

The kind `workshop` has logs as people record them (hidden/workshop.py), several effects together, a table of names that are
right for each (hidden/named.py), and other tools beside (real/rivals.py). It goes on where it was stopped. Needs numba:

    python benchmarks/hidden_effects.py --seed 1 --count 120 --kind workshop --rivals --out results/workshop
    python benchmarks/hidden_effects.py --seed 1 --first 24 --count 12 --kind workshop --out results/workshop   # 24 to 35
    python benchmarks/hidden_effects.py --seed 1 --count 120 --kind workshop --out results/workshop --tree . --tree ../older
    python benchmarks/hidden_effects.py --final --count 120 --kind workshop --rivals --out results/final   # once a commit
"""

import argparse
import importlib
import json
import tempfile
import time
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hidden import contest
from hidden.cases import ALONE, KINDS, Case, Log, cases, plant_numbers, save
from hidden.scoring import Diagnose, Oracle, Outcome, markdown, outcome, prove, run, write
from hidden.simulator import engine

CACHE = Path(__file__).parents[1] / ".cache" / "jax"


def _files(logs: Sequence[Log], holdout: Log, folder: Path) -> tuple[list[Path], Path]:
    """Logs as files, as people have them; programs compiled before are found again."""
    import jax

    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(CACHE))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    paths = [folder / f"log{i}.csv" for i in range(len(logs))]
    for log, path in zip([*logs, holdout], [*paths, folder / "holdout.csv"], strict=True):
        log.write(path)
    return paths, folder / "holdout.csv"


def _first_advice(
    logs: Sequence[Path], model: Mapping[str, Any], holdout: Path, diagnosis: Mapping[str, Any]
) -> dict[str, str]:
    """The answer of `jaxbl diagnose`, and the first command that it proposes."""
    from jaxbl.cli.next_steps import LogCall, after_diagnosis
    from jaxbl.diagnosis.diagnose import read_diagnosis_task
    from jaxbl.report.diagnose import describe as describe_diagnosis

    task = read_diagnosis_task(list(logs), model, holdout=holdout)
    log_call = LogCall(list(logs), Path("model.toml"), holdout, None, Path("diagnosed"), [])
    log_call = log_call._replace(again=["diagnose", *map(str, log_call.words())])
    steps = after_diagnosis(task, dict(diagnosis), log_call)
    return {"first_line": describe_diagnosis(dict(diagnosis)).headline, "next_step": steps[0].command}


def package(logs: Sequence[Log], model: Mapping[str, Any], holdout: Log) -> Mapping[str, Any]:
    """`jaxbl.diagnose`."""
    import jaxbl
    from jaxbl.workers import clear_programs_if_needed

    clear_programs_if_needed()
    with tempfile.TemporaryDirectory() as folder:
        paths, other = _files(logs, holdout, Path(folder))
        diagnosis = jaxbl.diagnose(paths if len(paths) > 1 else paths[0], model, holdout=other)
        advice = _first_advice(paths, model, other, diagnosis.summary)
    return {**diagnosis.summary, **advice, "model": diagnosis.model.to_dict()}


def oracle(case: Case) -> Mapping[str, float]:
    """Held-out rmse by channel of the true effects, all numbers fitted from the true ones of the effects."""
    import jax
    import numpy as np

    from jaxbl.diagnosis.choice import Choice
    from jaxbl.diagnosis.diagnose import read_diagnosis_task
    from jaxbl.diagnosis.proof import open_held_out
    from jaxbl.diagnosis.setup import set_up

    with tempfile.TemporaryDirectory() as folder:
        paths, other = _files([case.log], case.holdout, Path(folder))
        task = read_diagnosis_task(paths[0], case.model, holdout=other)
    with jax.enable_x64(True):
        setup = set_up(task)
        fitted = Choice(setup).search.fits.fit(case.truth["effects"], np.zeros(len(setup.free)))
        return open_held_out(setup)[1].compare(fitted.experiment).errors


def identify(case: Case) -> dict[str, tuple[float, float]]:
    """Relative error of each number by `jaxbl.identify` from the case's log and model, and the standard error it states."""
    import jaxbl

    with tempfile.TemporaryDirectory() as folder:
        paths, _ = _files([case.log], case.holdout, Path(folder))
        parameters = jaxbl.identify(paths[0], case.model).summary["parameters"]
    return {
        path: (parameters[path]["value"] / true - 1.0, parameters[path]["standard_error"] / abs(true))
        for path, true in plant_numbers(case.oracle).items()
        if path in case.truth["offsets"]
    }


def read_outcomes(hidden_cases: Sequence[Case], folder: Path) -> list[Outcome]:
    """Outcomes of a finished batch: FOLDER/NAME/diagnosis.json, and model.toml beside it, for each case."""
    outcomes, models = [], []
    for case in hidden_cases:
        path = folder / case.name / "diagnosis.json"
        exists = path.exists()
        diagnosis = json.loads(path.read_text(encoding="utf-8")) if exists else {}
        if exists and (path.parent / "model.toml").exists():
            diagnosis["model"] = tomllib.loads((path.parent / "model.toml").read_text(encoding="utf-8"))
        if exists and case.kind == "rough":
            with tempfile.TemporaryDirectory() as logs:
                paths, other = _files([case.log], case.holdout, Path(logs))
                diagnosis |= _first_advice(paths, case.model, other, diagnosis)
        models.append(diagnosis.get("model"))
        outcomes.append(outcome(case, diagnosis, error="" if exists else f"{path}: no such file"))
        if case.kind == "rough":
            outcomes[-1].identified = identify(case)
    prove(hidden_cases, outcomes, models)
    return outcomes


def run_workshop(asked: argparse.Namespace) -> None:
    """Make, answer and compare cases of `workshop`, or make them alone (`--save`)."""
    numbers = range(asked.first, asked.first + asked.count)
    trees = asked.tree or [contest.ROOT]
    commit, seed = "", asked.seed
    if asked.final:
        commit = contest.final_commit(trees[0])
        seed = contest.final_seed(commit)
        contest.log_final_run("started", commit, seed, asked.count)
    if asked.save is not None:
        contest.make_cases(seed, numbers, asked.save)
        print(f"written to {asked.save}")
        return
    out = asked.out or Path("results") / f"workshop_{seed}"
    text, counts = contest.hold_contest(seed, numbers, out, trees, asked.rivals, asked.jobs)
    (out / "scores.md").write_text(text, encoding="utf-8")
    print(text)
    if asked.final:
        contest.log_final_run("finished", commit, seed, asked.count, json.dumps(counts))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, help="of the cases; take one that development has not seen")
    parser.add_argument("--count", type=int, default=66, help="number of cases")
    parser.add_argument("--kind", choices=(*KINDS, *ALONE, "all", "workshop"), default="single")
    parser.add_argument(
        "--save", type=Path, metavar="FOLDER", help="write logs, models and truth there, and diagnose nothing"
    )
    parser.add_argument("--results", type=Path, metavar="FOLDER", help="score the diagnosis.json files of a batch")
    parser.add_argument(
        "--diagnose", metavar="MODULE:FUNCTION", help="diagnose(logs, model, holdout); left out: the package's"
    )
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes that share the work")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="leave scores and figures there, and go on there")
    workshop = parser.add_argument_group("workshop")
    workshop.add_argument("--first", type=int, default=0, metavar="N", help="number of the first case")
    workshop.add_argument(
        "--tree", type=Path, action="append", metavar="FOLDER", help="checkout of the package; several are compared"
    )
    workshop.add_argument("--rivals", action="store_true", help="ask the other tools as well")
    workshop.add_argument("--final", action="store_true", help="the seed is the commit's; the run is logged, and run once")
    asked = parser.parse_args()
    if asked.seed is None and not (asked.final and asked.kind == "workshop"):
        parser.error("--seed is missing")
    if asked.kind == "workshop":
        run_workshop(asked)
        return

    start, seed = time.perf_counter(), int(asked.seed)
    hidden_cases = cases(seed, asked.count, asked.kind)
    print(f"{len(hidden_cases)} cases of seed {asked.seed} in {time.perf_counter() - start:.0f} s ({engine()[1]})")
    if asked.save is not None:
        save(hidden_cases, asked.save)
        print(f"written to {asked.save}")
        return
    if asked.results is not None:
        outcomes = read_outcomes(hidden_cases, asked.results)
    else:
        diagnose: Diagnose = package
        best: Oracle | None = oracle
        if asked.diagnose:
            module, _, function = asked.diagnose.partition(":")
            diagnose, best = getattr(importlib.import_module(module), function), None
        answers = None if asked.out is None else asked.out / "answers"
        if answers is not None:
            answers.mkdir(parents=True, exist_ok=True)
        outcomes = run(hidden_cases, diagnose, best, asked.jobs, identify, answers)
    heading = f"Seed {asked.seed}, {len(hidden_cases)} cases, {asked.kind}"
    print(markdown(outcomes, heading))
    if asked.out is not None:
        for path in write(outcomes, asked.out, heading):
            print(path)


if __name__ == "__main__":
    main()
