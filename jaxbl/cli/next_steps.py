"""Commands to try after a command, for its page and the terminal: only those that its result leaves open."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jaxbl.files import is_remote
from jaxbl.json_types import JsonObject
from jaxbl.lines import NextStep, command_line

if TYPE_CHECKING:
    from jaxbl.config import Config
    from jaxbl.estimation.logs import LogTask
    from jaxbl.monitoring.watch import WatchTask
    from jaxbl.result import Result


def _propose(question: str, *words: object) -> NextStep:
    """Propose the command of these words, which answers a question."""
    return NextStep(command_line(*words), question)


def after_init(file: Path) -> list[NextStep]:
    """Propose commands for a first study from a data sheet."""
    return [
        _propose("How do the drive and the estimates of its observers move? One run.", "simulate", file),
        _propose("Which gains of the motor observer work? A map.", "sweep", file),
        _propose("Which gains have the least error, and how large is it?", "tune", file),
    ]


def after_demo(card: "Result", study: "Config", folder: Path) -> list[NextStep]:
    """Propose commands after a sweep, and a study of the user's own drive."""
    steps, own_study = after_sweep(card, study, folder), Path("drive.toml")
    if not own_study.exists():
        steps.append(_propose("And my own drive? A study of it, from the numbers of its data sheet.", "init", own_study))
    return steps


def after_sweep(card: "Result", study: "Config", folder: Path) -> list[NextStep]:
    """Propose commands for a sweep's folder, and for the study in it."""
    file = folder / "study.toml"
    explore = _propose("How do other metrics look, over other axes? Maps in the browser.", "explore", folder)
    if is_remote(file):
        return [explore]
    run = _propose("What happens over time, with the study's own numbers?", "simulate", file, "--out", f"{folder}_run")
    gains = {f"observer.{side}.{gain}" for side in study.sides for gain in ("lambda", "alpha")}
    # where no gains work, none can be chosen
    if gains & {*study.axis_paths} and card.verdict != "failed":
        question = "Which gains have the least error, and are they better than the usual rule?"
        return [_propose(question, "tune", file, "--out", f"{folder}_gains"), explore, run]
    return [explore, run]


def after_run(card: "Result", config: Path) -> list[NextStep]:
    """Propose the command that chooses gains, after one run with those of the study."""
    gains = "have less error, and what limits them" if card.verdict == "good" else "surely converge"
    return [_propose(f"Which gains {gains}?", "tune", config)]


def after_tuning(card: "Result", config: Path, folder: Path) -> list[NextStep]:
    """Propose commands that take the gains which were found."""
    if card.verdict == "failed":
        return []
    gains = config, "--gains", folder / "gains.toml", "--out"
    return [
        _propose("How does the drive run with these gains?", "simulate", *gains, f"{folder}_run"),
        _propose("How do they come onto a controller? As C code.", "export", *gains, f"{folder}_code"),
    ]


def after_inspection(log: Path, model: Path | None) -> list[NextStep]:
    """Propose the fit of a model to the log, or a first model where there is none."""
    if model is not None:
        return after_proposal(log, model)
    return [_propose("What would a first model look like?", "inspect", log, "--write", f"{log.stem}.toml")]


def after_comparison(card: "Result", folder: Path) -> list[NextStep]:
    """Propose to look at the points of both studies, if they have some."""
    return [_propose("How do both look, point by point? Maps in the browser.", "explore", folder)] * (
        card.verdict != "no answer"
    )


def after_proposal(log: Path, model: Path) -> list[NextStep]:
    """Propose the command that takes a proposed model."""
    return [_propose("Which numbers does the machine have, and how sure are they?", "identify", log, "--model", model)]


def after_identification(task: "LogTask", summary: JsonObject, log_call: "LogCall") -> list[NextStep]:
    """Propose commands after an identification.

    Args:
        task: the log and its model.
        summary: its `identification.json`.
        log_call: the call.
    """
    from jaxbl.diagnosis.diagnosis_task import can_hold_out
    from jaxbl.estimation.search import is_noise

    steps, folder = [], log_call.folder
    if not all(map(is_noise, summary["residual"].values())):
        if log_call.holdout is not None or can_hold_out(task.record):
            words = "diagnose", *log_call.words(), "--out", f"{folder}_diagnosed"
            steps.append(_propose("What does the model lack? Its errors are larger than noise.", *words))
    elif _has_input(task):
        question = "How does the drive move with these numbers, and what do observers see?"
        steps.append(_propose(question, "simulate", folder / "model.toml", "--out", f"{folder}_run"))
    return [*steps, *_propose_gap_experiment(summary, log_call), _explore_log(folder)]


def after_diagnosis(task: "LogTask", summary: JsonObject, log_call: "LogCall") -> list[NextStep]:
    """Propose commands after a diagnosis. Arguments as for :func:`after_identification`."""
    from jaxbl.diagnosis.diagnosis_summary import find_tie

    steps, folder = _propose_gap_experiment(summary, log_call), log_call.folder
    pair = None if "backlash" in summary or log_call.next_experiment else find_tie(summary)
    if pair is not None:
        steps.append(log_call.propose_experiment(f"Is it {pair[0]} or {pair[1]}? An input that shows it."))
    if summary["verdict"] == "no_discrepancy":
        words = "identify", *log_call.words(), "--out", f"{folder}_identified"
        steps.append(_propose("How sure are the model's numbers? 95 % intervals of each.", *words))
    if summary["findings"] and _has_input(task):
        question = "How does the drive move with what was found? The extended study, run."
        steps.append(_propose(question, "simulate", folder / "model.toml", "--out", f"{folder}_run"))
    return [*steps, _explore_log(folder)]


def after_watch(task: "WatchTask", summary: JsonObject, model: Path) -> list[NextStep]:
    """Propose commands after a log was watched; a stream cannot be read again."""
    if task.record is None:
        return []
    if summary["contradictions"]:
        return [_propose("Which effect does the model lack?", "diagnose", task.name, "--model", model)]
    if summary["alarm"]:
        return [_propose("How large are gap and stiffness, by a fit?", "identify", task.name, "--model", model)]
    return []


class LogCall(NamedTuple):
    """Logs, model, hold-out log, file for the next experiment, folder of the results, and all words of a call."""

    logs: Sequence[Path]
    model: Path
    holdout: Path | None
    next_experiment: Path | None
    folder: Path
    again: Sequence[str]

    def words(self) -> list[object]:
        """Logs and model on a command line."""
        return [*self.logs, "--model", self.model, *(["--holdout", self.holdout] if self.holdout else [])]

    def propose_experiment(self, question: str) -> NextStep:
        """Propose the same call with an experiment that answers a question."""
        return _propose(question, *self.again, "--next-experiment", f"{self.folder}_next.csv")


def _explore_log(folder: Path) -> NextStep:
    return _propose("Where along the log do model and machine differ? In the browser.", "explore", folder)


def _propose_gap_experiment(summary: JsonObject, log_call: LogCall) -> list[NextStep]:
    """The move that would show a gap to the motor's encoder alone, where the log does not."""
    backlash = summary.get("backlash")
    if backlash is None or backlash["shown"] or log_call.next_experiment is not None:
        return []
    return [log_call.propose_experiment("Is there a gap? A move that shows it to the motor's encoder.")]


def _has_input(task: "LogTask") -> bool:
    """Return True if the written model has an input: its own, or that of a log without gaps."""
    return "excitation" not in task.missing or len(task.record.segments) == 1
