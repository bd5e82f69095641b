"""The error of an observer in its phase plane with the majorant curve of the proof: the paper's Fig. 29."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from pandas import DataFrame

from jaxbl.gains.phase_plane import error_peaks, error_slope, majorant, worst_half_cycle
from jaxbl.json_types import JsonObject

from .figures import BLACK, VERMILION, Axes, Drawn, arrange, legend, literal, style, subplots, write_inside

Array = np.ndarray

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


@style()
def error_plane(trace: DataFrame, side: str, judged: JsonObject) -> Drawn:
    """The error of an observer in its phase plane, and its peaks, beside the majorant of the proof.

    Args:
        trace: of a run, with true values and estimates.
        side: motor or load.
        judged: gains, f_plus, and what follows from them (`conditions` of the run's summary).
    """
    error, slope, peaks, ratio, curve = error_path(trace, side, judged)
    lambda_, alpha, bound = (judged[name] for name in ("lambda", "alpha", "f_plus"))
    figure, (left, right) = subplots(8.0, 3.8, columns=2)
    left.plot(error, slope, color=VERMILION, lw=1.2, label="error")
    peaks = np.abs(peaks)
    ratios = peaks[1:] / peaks[:-1]
    text = f"ratio {np.median(ratios):.3g} (median)" if len(ratios) else "no two peaks beyond the chatter"
    right.plot(peaks, "o", ms=4, color=VERMILION, label=f"run: {text}")
    if len(curve[0]):
        left.plot(*curve, color=BLACK, lw=1.0, label="majorant (36)")
        count = np.arange(max(len(peaks), 2))
        for label, factor, dashes in (("majorant (37)", ratio, "-"), ("exact worst case", judged["peak_ratio"], "--")):
            # a worst case that ends at once has no second peak
            if factor:
                label += f": ratio {factor:.3g}"
                right.plot(peaks[0] * factor**count, dashes, color=BLACK, lw=1.0, label=label, scaley=False)
    if not len(peaks):
        write_inside(right, "no peak stands out\nfrom the chatter", va="center")
        right.set(xticks=[], yticks=[])
    else:
        right.set(yscale="log", ylim=(0.5 * peaks.min(), 3.0 * peaks.max()))
        legend(right)
    _set_limits(left, (error, slope), curve)
    left.set(xlabel="position error e (rad)", ylabel="its slope ė (rad/s)")
    right.set(xlabel="half cycle", ylabel="peak of |ė| (rad/s)")
    left.locator_params(axis="x", nbins=5)
    legend(left)
    reason = "" if ratio is not None else f" There is no majorant: {'λ is zero' if alpha > bound else 'α is not above f⁺'}."
    return Drawn(
        f"error_plane_{side}",
        figure,
        f"Error of the {side} observer (λ = {lambda_:.3g} √rad/s, α = {alpha:.3g} rad/s²) in the phase plane, and its "
        f"velocity peaks (analogue of Fig. 29). The majorant of the proof is for the worst disturbance within "
        f"f⁺ = {bound:.3g} rad/s², without friction; a ratio below 1 proves convergence.{reason}",
    )


def _set_limits(ax: Axes, path: Any, curve: Any) -> None:
    """Ends of the plane, from x and y of the error and of its majorant."""
    for axis, *values in zip("xy", path, curve, strict=True):
        if reach := plane_reach(*values):
            ax.set(**{f"{axis}lim": (-reach, reach)})


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


@style()
def draw_worst_planes(marks: Sequence[JsonObject]) -> Drawn | None:
    """The worst path of the error and the majorant of the proof for marked gains (`marks` of a verdict), normalised so that
    f⁺ and the first peak are 1; None where no alpha is above f⁺."""
    marks = [mark for mark in marks if (mark["alpha_ratio"] or 0.0) > 1.0 and mark["lambda_ratio"] > 0.0][:_MOST_PLANES]
    if not marks:
        return None
    rows, columns = arrange(len(marks))
    figure, axes = subplots(3.2 * columns + 0.4, 3.6 * rows, rows, columns)
    for ax in axes[len(marks) :]:
        ax.set_visible(False)
    for ax, mark in zip(axes, marks, strict=False):
        gains = mark["lambda_ratio"], mark["alpha_ratio"], 1.0
        x, y = worst_half_cycle(*gains)
        ratio = mark["peak_ratio"]
        sizes = (-ratio) ** np.arange(_TURNS if ratio < 1.0 else 2)[:, None]
        path = (np.sign(sizes) * sizes**2 * x).ravel(), (sizes * y).ravel()
        ax.plot(*path, color=VERMILION, lw=1.4, label=f"worst disturbance: ratio {ratio:.3g}")
        curve = majorant(1.0, *gains)
        ax.plot(*curve, color=BLACK, lw=1.0, label=f"majorant: ratio {-curve[1][101]:.3g}")
        _set_limits(ax, path, curve)
        ax.locator_params(axis="x", nbins=4)
        ax.set(xlabel="e f⁺ / ė₀²", ylabel="ė / ė₀")
        ax.set_title(literal(mark["name"]), loc="left", pad=34)
        legend(ax)
    return Drawn(
        "error_planes",
        figure,
        "Error of the marked gains in the phase plane, without friction, from a velocity error ė₀: under its worst "
        "disturbance within f⁺, and the majorant of the proof (36)-(37) (cf. Fig. 29). A ratio of successive peaks below 1 "
        "means convergence in finite time.",
    )
