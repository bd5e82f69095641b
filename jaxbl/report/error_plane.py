"""The error of an observer in its phase plane with the majorant curve of the proof: the paper's Fig. 29."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from scipy.integrate import cumulative_simpson

from .figures import COLOURS, Drawn, legend, literal, style, subplots

_MOST_PEAKS = 40
"""Half cycles of the error that are drawn."""
_MOST_POINTS = 6000
"""Of its line."""
_MOST_PLANES = 6
"""Marked gains that have a plane of their own."""


def error_peaks(error: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Peaks of an observer's velocity error: its values where the position error changes sign.

    Args:
        error: position error (rad) at each sample.
        rate: velocity error without the square-root term (rad/s), which is the slope of `error` where that is zero.

    Returns:
        Indices of the samples before, and peaks (rad/s); those that stand out from the chatter of the last quarter (three
        times its rms), the first ones only.
    """
    at = np.flatnonzero((error[:-1] * error[1:] < 0.0) | ((error[:-1] == 0.0) & (error[1:] != 0.0)))
    share = error[at] / (error[at] - error[at + 1])
    peaks = rate[at] + share * (rate[at + 1] - rate[at])
    chatter = 3.0 * np.sqrt(np.mean(rate[-max(len(rate) // 4, 1) :] ** 2))
    low = np.flatnonzero(~(np.abs(peaks) > chatter))
    count = min(low[0] if len(low) else len(peaks), _MOST_PEAKS)
    return at[:count], peaks[:count]


@style()
def error_plane(trace: pd.DataFrame, side: str, found: dict[str, Any]) -> Drawn:
    """The error of an observer in its phase plane, and its peaks, beside the majorant of the proof.

    Args:
        trace: of a run, with true values and estimates.
        side: motor or load.
        found: gains, f_plus, and what follows from them (`conditions` of the run's summary).
    """
    error = (trace[f"{side}.position"] - trace[f"{side}.position_estimate"]).to_numpy()
    rate = (trace[f"{side}.velocity"] - trace[f"{side}.velocity_estimate"]).to_numpy()
    lambda_, alpha, bound = (found[name] for name in ("lambda", "alpha", "f_plus"))
    slope = rate - lambda_ * np.sqrt(np.abs(error)) * np.sign(error)
    at, peaks = error_peaks(error, rate)
    end = at[-1] + 2 if len(at) > 1 else len(error)
    figure, (left, right) = subplots(8.0, 3.8, columns=2)
    shown = np.unique(np.linspace(0, end - 1, min(end, _MOST_POINTS)).astype(int))
    left.plot(error[shown], slope[shown], color=COLOURS[1], lw=1.2, label="error")
    ratios = np.abs(peaks[1:] / peaks[:-1])
    said = f"ratio {np.median(ratios):.3g} (median)" if len(ratios) else "no two peaks beyond the chatter"
    right.plot(np.abs(peaks), "o", ms=4, color=COLOURS[1], label=f"run: {said}")
    least = found["least_lambda"]["davila_fridman"]
    ratio = None if least is None or lambda_ == 0.0 else least / lambda_
    curve: Any = (np.zeros(1), np.zeros(1))
    if len(peaks) and ratio is not None:
        curve = _majorant(peaks[0], lambda_, alpha, bound)
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
    _set_limits(left, (error[shown], slope[shown]), curve)
    left.set(xlabel="position error e (rad)", ylabel="its slope ė (rad/s)")
    right.set(xlabel="half cycle", ylabel="peak of |ė| (rad/s)")
    left.locator_params(axis="x", nbins=5)
    for ax in (left, right) if len(peaks) else (left,):
        legend(ax)
    why = "" if ratio is not None else f" There is no majorant: {'α is not above f⁺' if least is None else 'λ is zero'}."
    caption = (
        f"Error of the {side} observer (λ = {lambda_:.3g} √rad/s, α = {alpha:.3g} rad/s²) in the phase plane, and its "
        f"velocity peaks (analogue of Fig. 29). The majorant of the proof is for the worst disturbance within "
        f"f⁺ = {bound:.3g} rad/s², without friction; a ratio below 1 proves convergence.{why}"
    )
    return Drawn(f"error_plane_{side}", figure, caption)


def _set_limits(ax: Axes, shown: Any, majorant: Any) -> None:
    """Ends of the plane, from x and y of the error and of its majorant."""
    for axis, values, outer in zip(("x", "y"), shown, majorant, strict=True):
        reach = np.nanmax(np.abs(values), initial=0.0)
        if np.isfinite(reach) and reach > 0.0:
            # a majorant far outside would leave nothing of the error to be seen
            largest = max(reach, np.abs(outer).max())
            reach = 1.1 * (largest if largest < 4.0 * reach else 1.2 * reach)
            ax.set(**{f"{axis}lim": (-reach, reach)})


def worst_half_cycle(lambda_: float, alpha: float, bound: float) -> tuple[np.ndarray, np.ndarray]:
    """The outermost path of (34) from e = 0, ė = 1 rad/s to e = 0 again: e (rad) and ė (rad/s).

    With y = sqrt(e) and ė = p y, sqrt(ė² + lambda ė y + c y²) falls by exp(-(lambda / 2) ∫ dp / (p² + lambda p + c)); c is
    2 (alpha - f) while ė > 0 and 2 (alpha + f) after (docs/theory.md). Needs alpha > f.
    """
    c1, c2 = 2.0 * (alpha - bound), 2.0 * (alpha + bound)
    # where the roots are real, the second half ends at the origin, along a ray
    square = lambda_**2 / 4.0 - c2
    end = -0.5 * np.pi if square < 0.0 else np.arctan(np.sqrt(square) - 0.5 * lambda_) * (1.0 - 1e-6)
    size, xs, ys = 1.0, [], []
    for c, first, last in ((c1, 0.5 * np.pi, 0.0), (c2, 0.0, end)):
        angle = np.linspace(first, last, 1001)
        form = np.sin(angle) ** 2 + lambda_ * np.sin(angle) * np.cos(angle) + c * np.cos(angle) ** 2
        # negative steps: simpson's rule is of the mirrored angle
        level = size * np.exp(-0.5 * lambda_ * cumulative_simpson(1.0 / form, x=first - angle, initial=0.0))
        xs.append((level * np.cos(angle)) ** 2 / form)
        ys.append(level * np.sin(angle) / np.sqrt(form))
        size = level[-1] * np.sqrt(c2 / c1)
    return np.concatenate(xs), np.concatenate(ys)


_TURNS = 6
"""Half cycles of a path that ends."""


@style()
def draw_worst_planes(marks: Sequence[dict[str, Any]]) -> Drawn | None:
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
        curve = _majorant(1.0, *gains)
        ax.plot(*curve, color=COLOURS[6], lw=1.0, label=f"majorant: ratio {-curve[1][-103]:.3g}")
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


def _majorant(peak: float, lambda_: float, alpha: float, bound: float) -> tuple[np.ndarray, np.ndarray]:
    """The curve (36) of a half cycle and the next one, from a peak (rad/s) of the velocity error: e (rad) and its slope."""
    xs, ys = [], []
    for _ in range(2):
        largest = peak**2 / (2.0 * (alpha - bound))
        x = largest * (1.0 - np.linspace(1.0, 0.0, 100) ** 2)
        sign = np.sign(peak)
        following = -2.0 / lambda_ * (bound + alpha) * np.sqrt(largest) * sign
        xs.append(sign * np.r_[x, largest, 0.0])
        ys.append(np.r_[sign * np.sqrt(2.0 * (alpha - bound) * (largest - x)), following, following])
        peak = following
    return np.concatenate(xs), np.concatenate(ys)
