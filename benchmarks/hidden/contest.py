"""Answers to the cases of `workshop` by trees of the package and by other tools, kept case by case, and their tables.

A folder OUT holds `cases/`, and of each tree `COMMIT/`: what is there is not made again, so that a run goes on where it was
stopped. The other tools, and the torque that is left on the held-out part, are of the bench's own tree, on the readings as a
person has them (even times, one zero): they do not depend on what a tree makes of a log.
"""

import csv
import hashlib
import json
import math
import os
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from .named import TRUTH, findings_of_terms, score, tables
from .workshop import make_cases

ROOT = Path(__file__).parents[2]
FINAL_RUNS = Path(__file__).with_name("final_runs.csv")
_CUTOFFS = (40.0, 20.0, 10.0, 5.0)
"""Low-passes, Hz; the highest whose noise is small (`_NOISE`), and below a fifth of the sampling rate."""
_NOISE = 0.05
"""Most torque that the encoder's steps may make of the nominal inertia behind the low-pass, as a share of the input."""
_WAVES = 250
"""Most periods a turn that the regressions try."""
RIVALS = ("stepwise", "pysindy", "mujoco")
NAMING = RIVALS[:2]
"""Those that name what is missing."""


def _read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _write(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".draft")
    draft.write_text(json.dumps(content, indent=1), encoding="utf-8")
    draft.replace(path)


def _git(tree: Path, *words: str) -> str:
    return subprocess.run(["git", "-C", str(tree), *words], check=True, capture_output=True, text=True).stdout.strip()


def commit_of(tree: Path) -> str:
    """Short hash of the commit that changed a tree's package last, and a hash of what differs from it."""
    change = _git(tree, "diff", "HEAD", "--", "jaxbl")
    digest = f"+{hashlib.sha256(change.encode()).hexdigest()[:6]}" if change else ""
    return _git(tree, "log", "-1", "--format=%h", "--", "jaxbl") + digest


def final_commit(tree: Path) -> str:
    """Hash of a tree's commit, for final cases.

    Raises:
        SystemExit: the package differs from it.
    """
    if "+" in commit_of(tree):
        raise SystemExit(f"{tree}: final cases are of a commit; commit what the package differs from it")
    return _git(tree, "rev-parse", "HEAD")


# ---- trees ----


def answer_cases(tree: Path, folders: Sequence[Path], out: Path, jobs: int = 1) -> None:
    """Have a tree's package diagnose what it has not answered yet; a process that dies has failed its case."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tree), os.environ.get("PYTHONPATH", "")])}
    environment.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".cache" / "jax"))
    environment.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
    while left := [folder for folder in folders if not (out / f"{folder.name}.json").exists()]:
        shares = [left[i::jobs] for i in range(min(jobs, len(left)))]
        command = [sys.executable, str(Path(__file__).with_name("answer.py")), str(out)]
        processes = [subprocess.Popen([*command, *map(str, share)], env=environment) for share in shares]
        codes = [process.wait() for process in processes]
        for code, share in zip(codes, shares, strict=True):
            unanswered = [folder for folder in share if not (out / f"{folder.name}.json").exists()]
            if code and unanswered:
                _write(
                    out / f"{unanswered[0].name}.json", {"failure": "traceback", "error": f"the process ended with {code}"}
                )


# ---- torques that are left, and other tools ----


def _pick_cutoff(truth: dict[str, Any], inertia: float) -> float:
    """Low-pass for a log, Hz: by its period, its encoder and the nominal inertia, as a person would by its looks."""
    for cutoff in _CUTOFFS:
        acceleration = (2.0 * np.pi * cutoff) ** 2 * _reading_noise(truth) * np.sqrt(0.4 * cutoff * truth["period"])
        if cutoff <= 0.2 / truth["period"] and inertia * acceleration <= _NOISE * truth["driving"]:
            return cutoff
    return _CUTOFFS[-1]


def _reading_noise(truth: dict[str, Any]) -> float:
    drive = truth["drive"]
    return float(drive["motor_step"] * np.hypot(drive["noise"], 1.0 / np.sqrt(12.0)))


def _parts(folder: Path, truth: dict[str, Any], config: Any) -> tuple[list[Any], list[Any], float]:
    """Filtered derivatives of the fitted and of the held-out logs, and the low-pass, Hz."""
    from real.derivatives import Part, differentiate

    inertia = float(config.drive.motor_inertia)
    cutoff, period, parts = _pick_cutoff(truth, inertia), truth["period"], []
    least = 5.0 * 2.0 * np.pi * _reading_noise(truth) * np.sqrt(2.0 * period * cutoff**3 / 3.0)
    with np.load(folder / "plain.npz") as stored:
        count = 1 + max(int(key.split(".")[0]) for key in stored.files)
        for i in range(count):
            log = {key.split(".")[1]: stored[key] for key in stored.files if key.split(".")[0] == str(i)}
            positions = {"motor": log["theta_e"]}
            if "theta_s" in log:
                positions = {"motor": log["theta_e"] + truth["axis"]["ratio"] * truth["offset"], "load": log["theta_s"]}
            motion = differentiate(log["t"], log["u"], positions, cutoff)
            if truth["current"]:  # it is what it is at the stamp
                motion = replace(motion, torque=log["u"])
            moving = np.abs(np.asarray(motion.velocity["motor"])) > least
            parts.append(Part(motion, period, cutoff, moving))
    held = truth["held_logs"] or 1
    return parts[:-held], parts[-held:], cutoff


def left_by(folder: Path, models: dict[str, Any]) -> dict[str, float | None]:
    """Torque error on the held-out part by models of a case, rms, N m; None of one that it cannot be computed for."""
    import jax
    from real.derivatives import torque_error

    from jaxbl.config import read_model
    from jaxbl.drive.effects import EFFECTS

    truth = _read(folder / "truth.json")
    errors: dict[str, float | None] = {}
    with jax.enable_x64(True):
        _, held, _ = _parts(folder, truth, read_model(folder / "model.toml")[0])
        record: Any = SimpleNamespace(sample_period=truth["period"])
        for name, model in models.items():
            try:
                study = read_model(model)[0]
                # the motion is read as the encoders are meant: an offset of theirs is no torque
                torques = [effect for effect in study.effects if not EFFECTS[effect.kind].in_log]
                study = study.model_copy(update={"effects": torques})
                errors[name] = float(np.sqrt(np.mean(torque_error(study, record, held) ** 2)))
            except Exception as error:
                print(f"{folder.name}: {name} leaves no torque: {error}", file=sys.stderr)
                errors[name] = None
    return errors


def write_true_study(folder: Path) -> dict[str, Any] | None:
    """The study of a case's machine as it is, with the laws of the package that are nearest to the bench's; None of a geared
    one and of friction under load, which have none. What it leaves is what no model can do without."""
    truth, study = _read(folder / "truth.json"), tomllib.loads((folder / "model.toml").read_text())
    axis = truth["axis"]
    if axis["stiffness"] > 0.0 or axis["under_load"] > 0.0:
        return None
    study["drive"] |= {path.partition(".")[2]: value for path, value in truth["true_numbers"].items()}
    sizes = axis["amplitude"], axis["amplitude"] * axis["double"]
    waves = {
        f"{part}{end}": size * of(number * axis["phase"])
        for number, (size, end) in enumerate(zip(sizes, ("", "_2"), strict=True), 1)
        for part, of in (("sine", math.cos), ("cosine", math.sin))
    }
    friction = {"torque": axis["friction"], "length": axis["length"], "breakaway_ratio": axis["rise"]}
    effects = {
        "motor.presliding_friction": friction | {"stribeck_velocity": axis["fall"]},
        "motor.cogging_harmonics": {"harmonic": axis["waves"]} | waves,
        "motor.constant_torque": {"torque": axis["offset"]},
        "load.gravity": {"torque": axis["gravity"], "phase": axis["hangs"]},
    }
    there = axis["friction"], axis["amplitude"], axis["offset"], axis["gravity"]
    acting = [{"kind": kind} | numbers for size, (kind, numbers) in zip(there, effects.items(), strict=True) if size]
    return study | {"effects": acting}


def ask_rivals(folder: Path) -> dict[str, Any]:
    """What the other tools say of a case, the torque each leaves on the held-out part, N m, and their processor time, s."""
    import jax
    from real.derivatives import terms_of
    from real.mujoco_sysid import sysid
    from real.rivals import sindy, stepwise

    from jaxbl.config import read_model

    truth, config = _read(folder / "truth.json"), read_model(folder / "model.toml")[0]
    with jax.enable_x64(True):
        fitted, held, cutoff = _parts(folder, truth, config)
        speed = max(float(np.max(np.abs(part.kinematics.velocity["motor"]))) for part in fitted)
        travel = max(float(np.ptp(part.kinematics.position["motor"])) for part in fitted)
        terms, other = (terms_of(parts, config, False, (speed, travel), _WAVES) for parts in (fitted, held))
        tools: dict[str, Callable[[], Any]] = {
            "stepwise": lambda: stepwise(terms, other),
            "pysindy": lambda: sindy(terms, other),
            "mujoco": lambda: sysid(fitted, held, config, False),
        }
        said: dict[str, Any] = {"cutoff": cutoff, "base": terms.base}
        for name, tool in tools.items():
            start = time.process_time()
            try:
                said[name] = tool().to_dict()
            except Exception as error:
                said[name] = {"names": [], "rms": None, "note": f"{type(error).__name__}: {error}"}
            said[name]["seconds"] = time.process_time() - start
    return said


# ---- the whole ----


def hold_contest(
    seed: int, numbers: Sequence[int], out: Path, trees: Sequence[Path], rivals: bool, jobs: int = 1
) -> tuple[str, dict[str, dict[str, int]]]:
    """Make cases, have them answered, and compare.

    Args:
        seed, numbers: of the cases.
        out: folder for all of it; what is there is not made again.
        trees: of the package; each has the same cases.
        rivals: whether the other tools answer, too.
        jobs: processes that diagnose.

    Returns:
        The tables as Markdown, and of each tool how often `main` and `all` were right, and how many cases there are.
    """
    import jax

    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(ROOT / ".cache" / "jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    folders = make_cases(seed, numbers, out / "cases", lambda line: print(line, file=sys.stderr, flush=True))
    truths = {folder.name: _read(folder / "truth.json") for folder in folders}
    labels = {commit_of(tree): tree for tree in trees}
    for label, tree in labels.items():
        answer_cases(tree, folders, out / label, jobs)
    tools: dict[str, dict[str, Any]] = {
        label: {name: _read(out / label / f"{name}.json") for name in truths} for label in labels
    }
    left: dict[str, dict[str, Any]] = {}
    for folder in folders:
        path = out / "left" / f"{folder.name}.json"
        torques = _read(path) if path.exists() else {}
        models = {label: model for label in labels if (model := tools[label][folder.name].get("model"))}
        if rivals and (study := write_true_study(folder)) is not None:
            models[TRUTH] = study
        models = {name: model for name, model in {"nominal": folder / "model.toml", **models}.items() if name not in torques}
        if models:
            torques |= left_by(folder, models)
            _write(path, torques)
        left[folder.name] = torques
    if rivals:
        for tool in NAMING:
            tools[tool] = {}
        for folder in folders:
            path = out / "rivals" / f"{folder.name}.json"
            if not path.exists():
                _write(path, ask_rivals(folder))
                print(f"{folder.name} answered by the other tools", file=sys.stderr, flush=True)
            said = _read(path)
            left[folder.name] |= {tool: said[tool]["rms"] for tool in RIVALS}
            for tool in NAMING:
                truth = truths[folder.name]
                geared = truth["axis"]["stiffness"] > 0.0
                findings = findings_of_terms(said[tool]["names"], said["base"], geared, truth["known"])
                tools[tool][folder.name] = {"findings": findings, "seconds": said[tool]["seconds"]}
                if note := said[tool]["note"]:
                    tools[tool][folder.name] |= {"error": note, "failure": "traceback"}
    numbers_text = f"{min(numbers)} to {max(numbers)}"
    text = tables(truths, tools, left, RIVALS if rivals else (), f"Workshop, seed {seed}, cases {numbers_text}")
    counts = {}
    for tool, answers in tools.items():
        scores = [score(truths[name], answer) for name, answer in answers.items()]
        counts[tool] = {key: sum(result[key] for result in scores) for key in ("main", "all")} | {"cases": len(scores)}
    return text, counts


def final_seed(commit: str) -> int:
    """Seed of the final cases of a commit: nobody can have developed on it."""
    return int(hashlib.sha256(f"workshop {commit}".encode()).hexdigest()[:8], 16)


def log_final_run(event: str, commit: str, seed: int, count: int, results: str = "", path: Path = FINAL_RUNS) -> None:
    """Append a line to the list of final runs.

    Raises:
        SystemExit: a run that has been finished is begun once more.
    """
    header, exists = ["date", "event", "commit", "seed", "cases", "results"], path.exists()
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines())) if exists else []
    if any(row["commit"] == commit and row["event"] == "finished" for row in rows):
        raise SystemExit(f"{path.name}: the final cases of {commit} have been run; they are run once")
    with path.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerows([] if exists else [header])
        writer.writerow([time.strftime("%Y-%m-%d %H:%M:%S"), event, commit, seed, count, results])
