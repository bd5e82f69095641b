"""Figures and report of any result: what Python calls, and a notebook shows."""

from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

from jaxbl.diagnosis.diagnose import Diagnosis
from jaxbl.errors import InputError
from jaxbl.estimation.element import ElementIdentification
from jaxbl.estimation.identify import Identification
from jaxbl.files import catch_write_errors, to_path
from jaxbl.gains.observer_choice import ObserverChoice
from jaxbl.gains.tune import Tuning
from jaxbl.gains.verify import Verdict
from jaxbl.monitoring.watch import Watch
from jaxbl.records import Inspection
from jaxbl.sweeps.sweep import StudyResult
from jaxbl.sweeps.trial import Trial
from jaxbl.validation import suggest_word

from .diagnose import draw_diagnosis, write_diagnosis_report
from .element import draw_element, write_element_report
from .figures import Drawn, lay_out
from .identify import write_identification_report
from .identify_figures import draw_identification
from .inspect import draw_inspection, write_inspection_report
from .maps import draw as draw_study
from .observer_choice import draw_choice, write_choice_report
from .picture import picture
from .simulate import draw_trial, write_trial_report
from .sweep import write_sweep_report
from .tune import draw_tuning, write_tune_report
from .verify import draw_verdict, write_verify_report
from .watch import draw_watch, write_watch_report

_Functions = tuple[Callable[[Any], list[Drawn]], Callable[..., list[str]]]
_KINDS: dict[type, _Functions] = {
    Trial: (draw_trial, write_trial_report),
    StudyResult: (draw_study, write_sweep_report),
    Tuning: (draw_tuning, write_tune_report),
    ObserverChoice: (draw_choice, write_choice_report),
    Verdict: (draw_verdict, write_verify_report),
    Inspection: (draw_inspection, write_inspection_report),
    Identification: (draw_identification, write_identification_report),
    ElementIdentification: (draw_element, write_element_report),
    Diagnosis: (draw_diagnosis, write_diagnosis_report),
    Watch: (draw_watch, write_watch_report),
}


class Drawings(list[Drawn]):
    """Figures: a list of names, `matplotlib` figures and captions, which a notebook shows."""

    def _repr_html_(self) -> str:
        return "".join(map(_figure, self))


def _figure(drawn: Drawn) -> str:
    lay_out(drawn.figure)
    image = picture(drawn)
    return (
        f'<figure><img src="{image.source}" alt="{escape(image.described)}" style="max-width:100%">'
        f"<figcaption>{escape(image.caption)}</figcaption></figure>"
    )


def draw(result: Any, *names: str) -> Drawings:
    """Figures of a result, as its report has them; a notebook shows them.

    Args:
        result: what :func:`jaxbl.run`, :func:`jaxbl.sweep`, :func:`jaxbl.tune`, :func:`jaxbl.verify`, :func:`jaxbl.inspect`,
            :func:`jaxbl.identify`, :func:`jaxbl.identify_element`, :func:`jaxbl.diagnose` or :func:`jaxbl.watch` returned.
        names: those wanted, by the names of their files; left out, all.

    Raises:
        InputError: no result of these, or no figure of that name.
    """
    drawn = {figure.name: figure for figure in _functions_for(result)[0](result)}
    if unknown := [name for name in names if name not in drawn]:
        raise InputError(f"no figure '{unknown[0]}'; {suggest_word(unknown[0], drawn)}")
    return Drawings(drawn[name] for name in names or drawn)


def write_report(result: Any, folder: str | Path) -> list[str]:
    """Write figures, `report.html` and the files that the command leaves beside them. Returns the lines that it prints.

    Args:
        result: as of :func:`jaxbl.draw`.
        folder: made if it is not there; files of the same names are replaced.

    Raises:
        InputError: no result of these.
        NoResult: the files cannot be written.
    """
    write, place = writer(result), to_path(folder)
    with catch_write_errors(place):
        place.mkdir(parents=True, exist_ok=True)
    return write(result, place)


def writer(result: Any) -> Callable[..., list[str]]:
    """The function that writes the report of a result into a folder that exists. Raises `InputError`."""
    return _functions_for(result)[1]


def _functions_for(result: Any) -> _Functions:
    for kind, functions in _KINDS.items():
        if isinstance(result, kind):
            return functions
    kinds = ", ".join(kind.__name__ for kind in _KINDS)
    raise InputError(f"no report of {type(result).__name__}; a result should be one of {kinds}")
