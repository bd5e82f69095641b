"""The error of an observer in its phase plane with the majorant curve of the proof: the paper's Fig. 29."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from pandas import DataFrame

from jaxbl.gains.phase_plane import error_peaks, error_slope, majorant, worst_half_cycle
from jaxbl.json_types import JsonObject

from .panels import VERMILION, Array, Axis, Figure, Line, Panel, Part, arrange, literal

_MOST_PEAKS = 40
"""Half cycles of the error that are drawn."""
_MOST_POINTS = 6000
"""Of its line."""
_MOST_PLANES = 6
"""Marked gains that have a plane of their own."""


class ErrorPath(NamedTuple):
    """The error of an observer in its phase plane, as far as its peaks stand out from the chatter.

    Attributes:
        error: position error (rad).
        slope: its slope (rad/s), of the same shape.
        peaks: of the velocity error (rad/s), one a half cycle.
        ratio: of a peak to the one before, by the majorant (37); None where there is none.
        majorant: e (rad) and its slope (rad/s) along (36), from the first peak; empty where there is none.
    """

    error: Array
    slope: Array
    peaks: Array
    ratio: float | None
    majorant: tuple[Array, Array]


def error_path(trace: DataFrame, side: str, judged: JsonObject) -> ErrorPath:
    """The path of an observer's error. Arguments as of :func:`error_plane`."""
    error, rate = (
        (trace[f"{side}.{name}"] - trace[f"{side}.{name}_estimate"]).to_numpy() for name in ("position", "velocity")
    )
    gains = lambda_, *_ = [judged[name] for name in ("lambda", "alpha", "f_plus")]
    slope = error_slope(error, rate, lambda_)
    samples, peaks = error_peaks(error, rate, _MOST_PEAKS)
    end = samples[-1] + 2 if len(samples) > 1 else len(error)
    drawn = np.unique(np.linspace(0, end - 1, min(end, _MOST_POINTS)).astype(int))
    least = judged["least_lambda"]["davila_fridman"]
    ratio = None if least is None or lambda_ == 0.0 else least / lambda_
    curve = (np.zeros(0), np.zeros(0)) if ratio is None or not len(peaks) else majorant(peaks[0], *gains)
    return ErrorPath(error[drawn], slope[drawn], peaks, ratio, curve)


def error_plane(trace: DataFrame, side: str, judged: JsonObject) -> list[Figure]:
    """The error of an observer in its phase plane, and its peaks, beside the majorant of the proof; no figure where no two
    peaks stand out from the chatter.

    Args:
        trace: of a run, with true values and estimates.
        side: motor or load.
        judged: gains, f_plus, and what follows from them (`conditions` of the run's summary).
    """
    error, slope, peaks, ratio, curve = error_path(trace, side, judged)
    lambda_, alpha, bound = (judged[name] for name in ("lambda", "alpha", "f_plus"))
    if len(peaks) < 2:
        return []
    peaks = np.abs(peaks)
    name = f"run: ratio {np.median(peaks[1:] / peaks[:-1]):.3g} (median)"
    left = [Line(error, slope, "error", VERMILION, 1.2)]
    right = [Line(np.arange(len(peaks)), peaks, name, VERMILION, 0.0, marker="o", size=4.0)]
    axis = Axis("peak of |ė| (rad/s)", log=True, ends=(0.5 * peaks.min(), 3.0 * peaks.max()))
    if len(curve[0]):
        left.append(Line(*curve, "majorant (36)", width=1.0))
        count = np.arange(len(peaks))
        for name, factor, dashes in (("majorant (37)", ratio, "-"), ("exact worst case", judged["peak_ratio"], "--")):
            # a worst case that ends at once has no second peak
            if factor:
                right.append(Line(count, peaks[0] * factor**count, f"{name}: ratio {factor:.3g}", width=1.0, dashes=dashes))
    plane = _plane(("position error e (rad)", "its slope ė (rad/s)"), left, (error, slope), curve)
    reason = "" if ratio is not None else f" There is no majorant: {'λ is zero' if alpha > bound else 'α is not above f⁺'}."
    return [
        Figure(
            f"error_plane_{side}",
            [plane, Panel(Axis("half cycle"), axis, right)],
            f"Error of the {side} observer (λ = {lambda_:.3g} √rad/s, α = {alpha:.3g} rad/s²) in the phase plane, and its "
            f"velocity peaks (analogue of Fig. 29). The majorant of the proof is for the worst disturbance within "
            f"f⁺ = {bound:.3g} rad/s², without friction; a ratio below 1 proves convergence.{reason}",
            columns=2,
        )
    ]


def _plane(
    labels: Sequence[str], parts: Sequence[Part], path: Sequence[Array], curve: Sequence[Array], title: str = ""
) -> Panel:
    """A phase plane that goes as far as an error and, unless that is far outside, its majorant."""
    reaches = [plane_reach(*values) for values in zip(path, curve, strict=True)]
    x, y = (Axis(label, ends=(-reach, reach) if reach else None) for label, reach in zip(labels, reaches, strict=True))
    return Panel(x, y, parts, title)


def plane_reach(error: Array, majorant: Array) -> float:
    """The distance that an axis of the phase plane goes from zero; 0 where no finite error says so."""
    reach = float(np.nanmax(np.abs(error), initial=0.0))
    if not np.isfinite(reach):
        return 0.0
    # a majorant far outside would leave nothing of the error to be seen
    largest = max(reach, float(np.abs(majorant).max(initial=0.0)))
    return 1.1 * (largest if largest < 4.0 * reach else 1.2 * reach)


_TURNS = 6
"""Half cycles of a path that ends."""


def draw_worst_planes(marks: Sequence[JsonObject]) -> list[Figure]:
    """The worst path of the error and the majorant of the proof for marked gains (`marks` of a verdict), normalised so that
    f⁺ and the first peak are 1; nothing where no alpha is above f⁺."""
    panels = []
    for mark in [mark for mark in marks if (mark["alpha_ratio"] or 0.0) > 1.0 and mark["lambda_ratio"] > 0.0][:_MOST_PLANES]:
        gains, ratio = (mark["lambda_ratio"], mark["alpha_ratio"], 1.0), mark["peak_ratio"]
        x, y = worst_half_cycle(*gains)
        sizes = (-ratio) ** np.arange(_TURNS if ratio < 1.0 else 2)[:, None]
        path, curve = ((np.sign(sizes) * sizes**2 * x).ravel(), (sizes * y).ravel()), majorant(1.0, *gains)
        lines = [
            Line(*path, f"worst disturbance: ratio {ratio:.3g}", VERMILION),
            Line(*curve, f"majorant: ratio {-curve[1][101]:.3g}", width=1.0),
        ]
        panels.append(_plane(("e f⁺ / ė₀²", "ė / ė₀"), lines, path, curve, literal(mark["name"])))
    caption = (
        "Error of the marked gains in the phase plane, without friction, from a velocity error ė₀: under its worst "
        "disturbance within f⁺, and the majorant of the proof (36)-(37) (cf. Fig. 29). A ratio of successive peaks below 1 "
        "means convergence in finite time."
    )
    columns = arrange(len(panels))
    return [Figure("error_planes", panels, caption, columns, 3.2 * columns + 0.4)] * bool(panels)
