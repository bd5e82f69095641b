"""Result, figures and report of what Python calls and commands return."""

from collections.abc import Callable
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

from jaxbl.errors import InputError
from jaxbl.files import ResultFolder, Subject, lock_folder, log_subject, to_jsonable, to_path, write_json
from jaxbl.fused import SCAN_MESSAGE
from jaxbl.json_types import JsonObject
from jaxbl.lines import format_duration
from jaxbl.result import Result
from jaxbl.sweeps.store import study_subject
from jaxbl.validation import suggest_word

from . import (
    compare,
    diagnose,
    element,
    identify,
    inspect,
    loop_gains,
    observer_choice,
    simulate,
    sweep,
    tune,
    verify,
    watch,
)
from .drawing import picture
from .page import PAGE, write_page
from .panels import Figure


class _Kind(NamedTuple):
    """One kind of result.

    Attributes:
        report: module with `describe`, which says what was found (of logs by the summary), `draw`, which draws the figures
            (the first is the one beside the answer), and `write`, which writes further files beside the page into a folder
            and returns the study or model that the page shows, as TOML; nothing where that is the result's `config`.
        file: what was found, as data, or the page where that is all; names the result in the manifest of its folder.
        subject: what the result is about.
    """

    report: Any
    file: str = PAGE
    subject: Callable[[Any], Subject] = lambda result: study_subject(result.config)


def _log(result: Any) -> Subject:
    return log_subject(Path(result.summary["file"]))


# by the type of the result, which is the argument of its module's `draw`
_KINDS = {
    next(iter(kind.report.draw.__annotations__.values())): kind
    for kind in (
        _Kind(simulate, "summary.json"),
        _Kind(sweep),
        _Kind(tune, "tuning.json"),
        _Kind(observer_choice, "tuning.json"),
        _Kind(loop_gains, "tuning.json"),
        _Kind(verify),
        _Kind(compare, "comparison.json", lambda _: Subject("comparison")),
        _Kind(inspect, "inspection.json", lambda result: log_subject(result.record.path)),
        _Kind(identify, "identification.json", _log),
        _Kind(element, "identification.json", _log),
        _Kind(diagnose, "diagnosis.json", _log),
        _Kind(watch, "watch.json", lambda result: log_subject(Path(result.task.name))),
    )
}


class Drawings(list[Figure]):
    """Figures (:class:`jaxbl.report.panels.Figure`), which a notebook shows."""

    def _repr_html_(self) -> str:
        return "".join(
            f'<figure><img src="{image.source}" alt="{escape(image.described)}" style="max-width:100%">'
            f"<figcaption>{escape(image.caption)}</figcaption></figure>"
            for image in map(picture, self)
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
    figures = {figure.name: figure for figure in _kind_of(result).report.draw(result)}
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
    kind, cost = _kind_of(result), getattr(result, "cost", None)
    described = kind.report.describe(result.summary if kind.subject is _log else result)
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
    if not isinstance(folder, ResultFolder):
        place = to_path(folder)
        with lock_folder(place, wait=_WAIT):
            results = ResultFolder.read(place) or ResultFolder(place, kind.subject(result))
            return write_report(result, results, described)
    summary: JsonObject = getattr(result, "summary", None) or {}
    # without details, of which one is how long compiling took: the same results have the same manifest
    sentences = replace(described, details=()).sentences
    with folder.write_files(
        kind.file, identity=summary.get("identity", ""), title=described.title, sentences=sentences
    ) as draft:
        if kind.file != PAGE:
            write_json(draft / kind.file, to_jsonable(summary or result.to_dict()))
        config = kind.report.write(result, draft) or result.config.to_toml()
        write_page(draft, described, kind.report.draw(result), config)
    return described


_WAIT = 10.0
"""Seconds to wait for another process that writes into the folder."""


def _kind_of(result: Any) -> _Kind:
    for kind, functions in _KINDS.items():
        if isinstance(result, kind):
            return functions
    kinds = ", ".join(kind.__name__ for kind in _KINDS)
    raise InputError(f"no report of {type(result).__name__}; a result should be one of {kinds}")
