"""Result, figures and report of what Python calls and commands return."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

from jaxbl.diagnosis.diagnose import Diagnosis
from jaxbl.errors import InputError
from jaxbl.estimation.element import ElementIdentification
from jaxbl.estimation.identify import Identification
from jaxbl.files import ResultFolder, Subject, lock_folder, log_subject, to_path
from jaxbl.fused import SCAN_MESSAGE
from jaxbl.gains.loop_gains import LoopTuning
from jaxbl.gains.observer_choice import ObserverChoice
from jaxbl.gains.tune import Tuning
from jaxbl.gains.verify import Verdict
from jaxbl.lines import format_duration
from jaxbl.monitoring.watch import Watch
from jaxbl.records import Inspection
from jaxbl.result import Result
from jaxbl.sweeps.compare import Comparison
from jaxbl.sweeps.store import study_subject
from jaxbl.sweeps.sweep import StudyResult
from jaxbl.sweeps.trial import Trial
from jaxbl.validation import suggest_word

from .compare import describe_comparison, draw_comparison, write_comparison
from .diagnose import describe_diagnosis, draw_diagnosis, write_diagnosis
from .drawing import picture
from .element import describe_element, draw_element, write_element
from .identify import describe_identification, write_identification
from .identify_figures import draw_identification
from .inspect import describe_inspection, draw_inspection, write_inspection
from .loop_gains import describe_loop_tuning, draw_loop_tuning, write_loop_tuning
from .maps import draw as draw_study
from .observer_choice import describe_choice, draw_choice, write_choice
from .page import PAGE, write_page
from .panels import Figure
from .simulate import describe_trial, draw_trial, write_trial
from .sweep import describe_sweep, write_sweep
from .tune import describe_tuning, draw_tuning, write_tuning
from .verify import describe_verdict, draw_verdict, write_verdict
from .watch import describe_watch, draw_watch, write_watch


class _Kind(NamedTuple):
    """Functions of one kind of result.

    Attributes:
        describe: says what was found.
        draw: draws the figures; the first is the one beside the answer.
        write: writes the files beside the page into a folder, and returns the study or model that the page shows, as TOML.
        file: what was found, as data; names the result in the manifest of its folder.
        subject: what the result is about.
    """

    describe: Callable[[Any], Result]
    draw: Callable[[Any], list[Figure]]
    write: Callable[[Any, Path], str]
    file: str = PAGE
    subject: Callable[[Any], Subject] = lambda result: study_subject(result.config)


def _of_summary(describe: Callable[[Any], Result]) -> Callable[[Any], Result]:
    return lambda result: describe(result.summary)


def _log(result: Any) -> Subject:
    return log_subject(Path(result.summary["file"]))


_KINDS = {
    Trial: _Kind(describe_trial, draw_trial, write_trial, "summary.json"),
    StudyResult: _Kind(describe_sweep, draw_study, write_sweep),
    Tuning: _Kind(describe_tuning, draw_tuning, write_tuning, "tuning.json"),
    ObserverChoice: _Kind(describe_choice, draw_choice, write_choice, "tuning.json"),
    LoopTuning: _Kind(describe_loop_tuning, draw_loop_tuning, write_loop_tuning, "tuning.json"),
    Verdict: _Kind(describe_verdict, draw_verdict, write_verdict),
    Comparison: _Kind(
        describe_comparison, draw_comparison, write_comparison, "comparison.json", lambda _: Subject("comparison")
    ),
    Inspection: _Kind(
        describe_inspection,
        draw_inspection,
        write_inspection,
        "inspection.json",
        lambda result: log_subject(result.record.path),
    ),
    Identification: _Kind(
        _of_summary(describe_identification), draw_identification, write_identification, "identification.json", _log
    ),
    ElementIdentification: _Kind(_of_summary(describe_element), draw_element, write_element, "identification.json", _log),
    Diagnosis: _Kind(_of_summary(describe_diagnosis), draw_diagnosis, write_diagnosis, "diagnosis.json", _log),
    Watch: _Kind(describe_watch, draw_watch, write_watch, "watch.json", lambda watch: log_subject(Path(watch.task.name))),
}


class Drawings(list[Figure]):
    """Figures (:class:`jaxbl.report.panels.Figure`), which a notebook shows."""

    def _repr_html_(self) -> str:
        return "".join(map(_format_figure, self))


def _format_figure(figure: Figure) -> str:
    image = picture(figure)
    return (
        f'<figure><img src="{image.source}" alt="{escape(image.described)}" style="max-width:100%">'
        f"<figcaption>{escape(image.caption)}</figcaption></figure>"
    )


def draw(result: Any, *names: str) -> Drawings:
    """Figures of a result, as its report has them; a notebook shows them.

    Args:
        result: what :func:`jaxbl.run`, :func:`jaxbl.sweep`, :func:`jaxbl.tune`, :func:`jaxbl.verify`, :func:`jaxbl.compare`,
            :func:`jaxbl.inspect`, :func:`jaxbl.identify`, :func:`jaxbl.identify_element`, :func:`jaxbl.diagnose` or
            :func:`jaxbl.watch` returned.
        names: those wanted, by the names of their files; left out, all.

    Raises:
        InputError: no result of these, or no figure of that name.
    """
    figures = {figure.name: figure for figure in _kind_of(result).draw(result)}
    if unknown := [name for name in names if name not in figures]:
        raise InputError(f"no figure '{unknown[0]}'; {suggest_word(unknown[0], figures)}")
    return Drawings(figures[name] for name in names or figures)


def describe(result: Any) -> Result:
    """Verdict, answer, key figures, remarks and tables of a result, as its report has them.

    Args:
        result: as of :func:`jaxbl.draw`.

    Raises:
        InputError: no result of these.
    """
    described, cost = _kind_of(result).describe(result), getattr(result, "cost", None)
    details = [*described.details]
    if cost and cost["lanes"]:
        compiling, computing = format_duration(cost["compile_seconds"]), format_duration(cost["run_seconds"])
        details.append(f"Compiled in {compiling}, ran {cost['lanes']:.0f} lanes in {computing}.")
    details += (SCAN_MESSAGE % reason for reason in getattr(result, "fallback_reasons", ()))
    details += (f"Damaged, and computed anew: {reason}" for reason in getattr(result, "damaged", ()))
    return replace(described, details=details)


def write_report(result: Any, folder: str | Path | ResultFolder, described: Result | None = None) -> Result:
    """Write figures, `report.html` and the files that the command leaves beside them. Returns what the page says.

    Args:
        result: as of :func:`jaxbl.draw`.
        folder: made if it is not there; files of the same names are replaced.
        described: what the page says; left out, what :func:`jaxbl.describe` returns.

    Raises:
        InputError: no result of these, or another process writes into the folder.
        NoResult: the files cannot be written.
    """
    kind, described = _kind_of(result), described or describe(result)
    identity = (getattr(result, "summary", None) or {}).get("identity", "")
    with ExitStack() as stack:
        if not isinstance(folder, ResultFolder):
            place = to_path(folder)
            stack.enter_context(lock_folder(place, wait=_WAIT))
            folder = ResultFolder.read(place) or ResultFolder(place, kind.subject(result))
        # without details, of which one is how long compiling took: the same results have the same manifest
        card = {"title": described.title, "sentences": replace(described, details=()).sentences}
        draft = stack.enter_context(folder.write_files(kind.file, identity=identity, **card))
        config = kind.write(result, draft)
        write_page(draft, described, kind.draw(result), config)
    return described


_WAIT = 10.0
"""Seconds to wait for another process that writes into the folder."""


def _kind_of(result: Any) -> _Kind:
    for kind, functions in _KINDS.items():
        if isinstance(result, kind):
            return functions
    kinds = ", ".join(kind.__name__ for kind in _KINDS)
    raise InputError(f"no report of {type(result).__name__}; a result should be one of {kinds}")
