"""Gains of an observer against the gain conditions, in the units of a user's drive: the atlas of `verify` at one f⁺."""

from typing import Any

import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter

from jaxbl.json_types import JsonObject
from jaxbl.observer.conditions import CONDITIONS

from .figures import MISSING, Axes, Drawn, Patch, legend_below, mark, style, subplots
from .maps import condition_curves


def name_gains(ax: Axes, bound: float) -> None:
    """Name axes, whose limits are set, of alpha (rad/s²) along x and lambda (√rad/s) along y; on the other sides stand α /
    f⁺ and λ / √f⁺."""
    ax.set(xscale="log", yscale="log", xlabel="α (rad/s²)", ylabel="λ (√rad/s)")
    name_ratio(ax, "x", bound, "α / f⁺")
    name_ratio(ax, "y", np.sqrt(bound), "λ / √f⁺")


def name_ratio(ax: Axes, axis_name: str, unit: float, label: str) -> None:
    """A second axis on the top (`which` x) or on the right (y), which counts in a unit; both are logarithmic."""
    functions = (lambda value: value / unit, lambda ratio: ratio * unit)
    if axis_name == "x":
        axes = ax.xaxis, ax.secondary_xaxis("top", functions=functions).xaxis
    else:
        axes = ax.yaxis, ax.secondary_yaxis("right", functions=functions).yaxis
    axes[1].set_label_text(label)
    low, high = axes[0].get_view_interval()
    for axis in axes:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 100.0 * low else (1.0,)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())


_GAINS = "lambda", "alpha", "f_plus", "largest_f_plus"


def conditions_line(side: str, judged: JsonObject, source: str) -> str:
    """Say whether a side's gains are safe at an f⁺ (`source` says whose), how far from where the exact condition fails."""
    lambda_, alpha, bound, largest = (judged[key] for key in _GAINS)
    lead = f"{side}: f⁺ = {bound:.3g} rad/s² is {source};"
    if bound == 0.0:
        return f"{lead} nothing disturbs the observer, and any λ > 0 is enough."
    if not judged["alpha_exceeds_f_plus"]:
        return f"{lead} α = {alpha:.3g} rad/s² is too small, as it has to exceed f⁺."
    least = judged["least_lambda"]["exact"]
    if not judged["holds"]["exact"]:
        return f"{lead} λ = {lambda_:.3g} √rad/s is too small: it has to exceed {least:.3g} (exact condition)."
    return (
        f"{lead} the gains are safe. λ may fall to {least:.3g} √rad/s ({lambda_ / least:.4g} times less), or f⁺ grow to "
        f"{largest:.3g} rad/s² ({largest / bound:.4g} times more), until the exact condition fails."
    )


@style()
def draw_gain_plane(side: str, judged: JsonObject) -> Drawn:
    """The plane of gains with all conditions at one f⁺ > 0, and where the gains lie in it.

    Args:
        side: motor or load.
        judged: gains, f⁺ and what follows from them, as of :func:`jaxbl.observer.conditions.judge_gains`.
    """
    lambda_, alpha, bound, largest = (judged[key] for key in _GAINS)
    least = judged["least_lambda"]["exact"]
    figure, (ax,) = subplots(6.6, 5.8, beside=True)
    ax.grid(False)
    # a gain of zero has no place on a logarithmic axis
    alphas = min(0.7 * bound, 0.5 * alpha or bound), max(20.0 * bound, 3.0 * alpha)
    lowest, highest = 0.15 * np.sqrt(bound), 30.0 * np.sqrt(bound)
    lambdas = min(0.3 * (lambda_ or lowest), 0.5 * (least or lowest), lowest), max(3.0 * lambda_, highest)
    ax.set(xscale="log", yscale="log", xlim=alphas, ylim=lambdas)
    handles: list[Any] = condition_curves(ax, CONDITIONS, bound, alphas)
    # α has to exceed f⁺, whatever λ is
    x, y = np.asarray(ax.lines[-1].get_xydata()).T
    ax.fill_between([alphas[0], x[0], *x], [lambdas[1], lambdas[1], *y], lambdas[0], color=MISSING, alpha=0.6, lw=0.0)
    handles.append(Patch(facecolor=MISSING, alpha=0.6, label="exact one fails"))
    if largest > 0.0:
        (edge,) = condition_curves(ax, {"exact": CONDITIONS["exact"]}, largest, alphas)
        x, y = np.asarray(edge.get_xydata()).T
        label = f"where it would fail at f⁺ = {largest:.3g} rad/s²"
        edge.set(data=([x[0], *x], [lambdas[1], *y]), color="black", ls="--", lw=1.2, path_effects=[], label=label)
        handles.append(edge)
    if least is not None:
        ax.plot([alpha, alpha], [least, max(lambda_, lambdas[0])], color="black", lw=1.2)
    ax.set(xlim=alphas, ylim=lambdas)
    name_gains(ax, bound)
    handles.append(mark(ax, (alpha, lambda_), "*", "the observer's gains", 15))
    ax.set_title(f"{side}: λ = {lambda_:.3g} √rad/s, α = {alpha:.3g} rad/s²,  f⁺ = {bound:.3g} rad/s²")
    legend_below(figure, handles, 2)
    caption = (
        f"Gains of the {side} observer and the least λ of each gain condition at the true f⁺ = {bound:.3g} rad/s² along the "
        "run. Above and on the right: the axes of the atlas (jaxbl verify)."
    )
    if least is not None and lambda_ > 0.0:
        caption += f" Stroke: λ is {lambda_ / least:.3g} times the least one of the exact condition."
    return Drawn(f"gain_conditions_{side}", figure, caption)
