"""The error of an observer in its phase plane with the majorant curve of the proof: the paper's Fig. 29."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from jaxbl.gains.phase_plane import error_peaks, error_slope, majorant, worst_half_cycle
from jaxbl.json_types import JsonObject

from .figures import COLOURS, Drawn, legend, literal, style, subplots

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

    error: np.ndarray
    slope: np.ndarray
    peaks: np.ndarray
    ratio: float | None
    majorant: tuple[np.ndarray, np.ndarray]


def error_path(trace: pd.DataFrame, side: str, found: JsonObject) -> ErrorPath:
    """The path of an observer's error. Arguments as of :func:`error_plane`."""
    error = (trace[f"{side}.position"] - trace[f"{side}.position_estimate"]).to_numpy()
    rate = (trace[f"{side}.velocity"] - trace[f"{side}.velocity_estimate"]).to_numpy()
    lambda_, alpha, bound = (found[name] for name in ("lambda", "alpha", "f_plus"))
    slope = error_slope(error, rate, lambda_)
    at, peaks = error_peaks(error, rate, _MOST_PEAKS)
    end = at[-1] + 2 if len(at) > 1 else len(error)
    shown = np.unique(np.linspace(0, end - 1, min(end, _MOST_POINTS)).astype(int))
    least = found["least_lambda"]["davila_fridman"]
    ratio = None if least is None or lambda_ == 0.0 else least / lambda_
    curve = (np.zeros(0), np.zeros(0))
    if len(peaks) and ratio is not None:
        curve = majorant(peaks[0], lambda_, alpha, bound)
    return ErrorPath(error[shown], slope[shown], peaks, ratio, curve)


@style()
def error_plane(trace: pd.DataFrame, side: str, found: JsonObject) -> Drawn:
    """The error of an observer in its phase plane, and its peaks, beside the majorant of the proof.

    Args:
        trace: of a run, with true values and estimates.
        side: motor or load.
        found: gains, f_plus, and what follows from them (`conditions` of the run's summary).
    """
    error, slope, peaks, ratio, curve = error_path(trace, side, found)
    lambda_, alpha, bound = (found[name] for name in ("lambda", "alpha", "f_plus"))
    figure, (left, right) = subplots(8.0, 3.8, columns=2)
    left.plot(error, slope, color=COLOURS[1], lw=1.2, label="error")
    ratios = np.abs(peaks[1:] / peaks[:-1])
    said = f"ratio {np.median(ratios):.3g} (median)" if len(ratios) else "no two peaks beyond the chatter"
    right.plot(np.abs(peaks), "o", ms=4, color=COLOURS[1], label=f"run: {said}")
    if len(curve[0]):
        left.plot(*curve, color=COLOURS[6], lw=1.0, label="majorant (36)")
        count = np.arange(max(len(peaks), 2))
        for label, one, dashes in (("majorant (37)", ratio, "-"), ("exact worst case", found["peak_ratio"], "--")):
            # a worst case that ends at once has no second peak
            if one:
                label = f"{label}: ratio {one:.3g}"
                right.plot(np.abs(peaks[0]) * one**count, dashes, color=COLOURS[6], lw=1.0, label=label, scaley=False)
    if not len(peaks):
        right.text(0.5, 0.5, "no peak stands out\nfrom the chatter", ha="center", va="center", transform=right.transAxes)
        right.set(xticks=[], yticks=[])
    else:
        right.set(yscale="log", ylim=(0.5 * np.abs(peaks).min(), 3.0 * np.abs(peaks).max()))
    _set_limits(left, (error, slope), curve)
    left.set(xlabel="position error e (rad)", ylabel="its slope ė (rad/s)")
    right.set(xlabel="half cycle", ylabel="peak of |ė| (rad/s)")
    left.locator_params(axis="x", nbins=5)
    for ax in (left, right) if len(peaks) else (left,):
        legend(ax)
    why = "" if ratio is not None else f" There is no majorant: {'λ is zero' if alpha > bound else 'α is not above f⁺'}."
    caption = (
        f"Error of the {side} observer (λ = {lambda_:.3g} √rad/s, α = {alpha:.3g} rad/s²) in the phase plane, and its "
        f"velocity peaks (analogue of Fig. 29). The majorant of the proof is for the worst disturbance within "
        f"f⁺ = {bound:.3g} rad/s², without friction; a ratio below 1 proves convergence.{why}"
    )
    return Drawn(f"error_plane_{side}", figure, caption)


def _set_limits(ax: Axes, shown: Any, outside: Any) -> None:
    """Ends of the plane, from x and y of the error and of its majorant."""
    for axis, values, outer in zip(("x", "y"), shown, outside, strict=True):
        if reach := plane_reach(values, outer):
            ax.set(**{f"{axis}lim": (-reach, reach)})


def plane_reach(error: np.ndarray, majorant: np.ndarray) -> float:
    """How far an axis of the phase plane goes from zero; 0 where no finite error says so."""
    reach = float(np.nanmax(np.abs(error), initial=0.0))
    if not np.isfinite(reach):
        return 0.0
    # a majorant far outside would leave nothing of the error to be seen
    largest = max(reach, float(np.abs(majorant).max(initial=0.0)))
    return 1.1 * (largest if largest < 4.0 * reach else 1.2 * reach)


_TURNS = 6
"""Half cycles of a path that ends."""


@style()
def draw_worst_planes(marks: Sequence[JsonObject]) -> Drawn | None:
    """The worst path of the error and the majorant of the proof for marked gains (`marks` of a verdict), normalised so that
    f⁺ and the first peak are 1; None where no alpha is above f⁺."""
    known = [one for one in marks if (one["alpha_ratio"] or 0.0) > 1.0 and one["lambda_ratio"] > 0.0][:_MOST_PLANES]
    if not known:
        return None
    columns = 2 if len(known) == 4 else min(len(known), 3)
    rows = -(-len(known) // columns)
    figure, axes = subplots(3.2 * columns + 0.4, 3.6 * rows, rows, columns)
    for ax in axes[len(known) :]:
        ax.set_visible(False)
    for ax, one in zip(axes, known, strict=False):
        gains = one["lambda_ratio"], one["alpha_ratio"], 1.0
        x, y = worst_half_cycle(*gains)
        ratio = one["peak_ratio"]
        sizes = (-ratio) ** np.arange(_TURNS if ratio < 1.0 else 2)
        path = np.concatenate([np.sign(size) * size**2 * x for size in sizes]), np.concatenate([size * y for size in sizes])
        ax.plot(*path, color=COLOURS[1], lw=1.4, label=f"worst disturbance: ratio {ratio:.3g}")
        curve = majorant(1.0, *gains)
        ax.plot(*curve, color=COLOURS[6], lw=1.0, label=f"majorant: ratio {-curve[1][101]:.3g}")
        _set_limits(ax, path, curve)
        ax.locator_params(axis="x", nbins=4)
        ax.set(xlabel="e f⁺ / ė₀²", ylabel="ė / ė₀")
        ax.set_title(literal(one["name"]), loc="left", pad=34)
        legend(ax)
    caption = (
        "Error of the marked gains in the phase plane, without friction, from a velocity error ė₀: under its worst "
        "disturbance within f⁺, and the majorant of the proof (36)-(37) (cf. Fig. 29). A ratio of successive peaks below 1 "
        "means convergence in finite time."
    )
    return Drawn("error_planes", figure, caption)
