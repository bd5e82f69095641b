"""The error of an observer in its phase plane with the majorant curve of the proof: the paper's Fig. 29."""

from typing import NamedTuple

import numpy as np
from pandas import DataFrame

from jaxbl.gains.phase_plane import error_peaks, error_slope, majorant
from jaxbl.json_types import JsonObject

from .panels import VERMILION, Array, Axis, Figure, Line, Panel

_MOST_PEAKS = 40
"""Half cycles of the error that are drawn."""
_MOST_POINTS = 6000
"""Of its line."""


class ErrorPath(NamedTuple):
    """The error of an observer in its phase plane, as far as its peaks stand out from the chatter.

    Attributes:
        error: position error (rad).
        slope: its slope (rad/s), of the same shape.
        peaks: of the velocity error (rad/s), one a half cycle.
        ratio: of a peak to the one before, by the majorant (37); None where there is none.
        majorant: e (rad) and its slope (rad/s) along (36), from the first peak; empty where there is none.
        reach: how far the axes of both go from zero; 0 where no finite error says so.
    """

    error: Array
    slope: Array
    peaks: Array
    ratio: float | None
    majorant: tuple[Array, Array]
    reach: list[float]


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
    path = error[drawn], slope[drawn]
    least = judged["least_lambda"]["davila_fridman"]
    ratio = None if least is None or lambda_ == 0.0 else least / lambda_
    curve = (np.zeros(0), np.zeros(0)) if ratio is None or not len(peaks) else majorant(peaks[0], *gains)
    return ErrorPath(*path, peaks, ratio, curve, [*map(_reach, path, curve)])


def _reach(error: Array, majorant: Array) -> float:
    """The distance that an axis of the phase plane goes from zero; 0 where no finite error says so."""
    reach = np.nanmax(np.abs(error), initial=0.0)
    if not np.isfinite(reach):
        return 0.0
    # a majorant far outside would leave nothing of the error to be seen
    largest = np.abs(majorant).max(initial=reach)
    return 1.1 * (largest if largest < 4.0 * reach else 1.2 * reach)


def error_plane(trace: DataFrame, side: str, judged: JsonObject) -> list[Figure]:
    """The error of an observer in its phase plane beside the majorant of the proof; no figure where no two
    peaks stand out from the chatter.

    Args:
        trace: of a run, with true values and estimates.
        side: motor or load.
        judged: gains, f_plus, and what follows from them (`conditions` of the run's summary).
    """
    error, slope, peaks, ratio, curve, reaches = error_path(trace, side, judged)
    lambda_, alpha, bound = (judged[name] for name in ("lambda", "alpha", "f_plus"))
    if len(peaks) < 2:
        return []
    worst = f", at most {judged['peak_ratio']:.3g}" if judged["peak_ratio"] else ""
    name = f"error: ratio of peaks {np.median(np.abs(peaks[1:] / peaks[:-1])):.3g} (median){worst}"
    parts = [Line(error, slope, name, VERMILION, 1.2)]
    if len(curve[0]):
        parts.append(Line(*curve, f"majorant (36)-(37): ratio {ratio:.3g}", width=1.0))
    x_ends, y_ends = ((-reach, reach) if reach else None for reach in reaches)
    axes = Axis("position error e (rad)", ends=x_ends), Axis("its slope ė (rad/s)", ends=y_ends)
    reason = "" if ratio is not None else f" There is no majorant: {'λ is zero' if alpha > bound else 'α is not above f⁺'}."
    return [
        Figure(
            f"error_plane_{side}",
            [Panel(*axes, parts)],
            f"Error of the {side} observer (λ = {lambda_:.3g} √rad/s, α = {alpha:.3g} rad/s²) in the phase plane (cf. "
            f"Fig. 29). The majorant of the proof is for the worst disturbance within f⁺ = {bound:.3g} rad/s², without "
            f"friction; a ratio below 1 proves convergence.{reason}",
        )
    ]
