"""Gains of an observer against the gain conditions, in the units of a user's drive: the atlas of `verify` at one f⁺."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter

from jaxbl.json_types import JsonObject
from jaxbl.observer.conditions import CONDITIONS

from .figures import MISSING, Drawn, mark, style, subplots
from .maps import condition_curves

_SHORT = {name: condition.title.partition(",")[0] for name, condition in CONDITIONS.items()}
"""What sentences call the conditions."""


def name_gains(ax: Axes, bound: float) -> None:
    """Name axes, whose limits are set, of alpha (rad/s²) along x and lambda (√rad/s) along y; on the other sides stand α /
    f⁺ and λ / √f⁺."""
    ax.set(xscale="log", yscale="log", xlabel="α (rad/s²)", ylabel="λ (√rad/s)")
    name_ratio(ax, "x", bound, "α / f⁺")
    name_ratio(ax, "y", np.sqrt(bound), "λ / √f⁺")


def name_ratio(ax: Axes, which: str, unit: float, label: str) -> None:
    """A second axis on the top (`which` x) or on the right (y), which counts in a unit; both are logarithmic."""
    functions = (lambda value: value / unit, lambda ratio: ratio * unit)
    if which == "x":
        own, second = ax.xaxis, (other := ax.secondary_xaxis("top", functions=functions)).xaxis
    else:
        own, second = ax.yaxis, (other := ax.secondary_yaxis("right", functions=functions)).yaxis
    other.set(**{f"{which}label": label})
    low, high = own.get_view_interval()
    for axis in (own, second):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 100.0 * low else (1.0,)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())


def conditions_line(side: str, found: JsonObject, which: str) -> str:
    """Which conditions hold for a side's gains at an f⁺ (`which` says whose), and how far the exact one is from failing."""
    lambda_, alpha, bound, largest = (found[name] for name in ("lambda", "alpha", "f_plus", "largest_f_plus"))
    at = f"{side}: at f⁺ = {bound:.3g} rad/s², {which},"
    if bound == 0.0:
        return f"{at} nothing disturbs the observer: the exact gain condition asks for λ > 0 alone."
    holds = [name for name, held in found["holds"].items() if held]
    if not found["alpha_exceeds_f_plus"]:
        return (
            f"{at} no gain condition can hold, as α = {alpha:.3g} rad/s² does not exceed it. The exact one would hold up to "
            f"f⁺ = {largest:.3g} rad/s²."
        )
    least = found["least_lambda"]["exact"]
    if not found["holds"]["exact"]:
        more = "" if lambda_ == 0.0 else f" ({least / lambda_:.3g} times as large)"
        less = "" if largest == 0.0 else f", or f⁺ below {largest:.3g} rad/s² ({bound / largest:.3g} times smaller)"
        return f"{at} no gain condition holds. The exact one asks for λ above {least:.3g} √rad/s{more}{less}."
    missed = [_SHORT[name] for name in found["holds"] if name not in holds]
    what = f"gain conditions met: {', '.join(_SHORT[name] for name in holds)}"
    what += f"; not met: {', '.join(missed)}" if missed else " (all)"
    return (
        f"{at} {what}. λ may fall by a factor of {lambda_ / least:.4g} (to {least:.3g} √rad/s), or f⁺ grow by one of "
        f"{largest / bound:.4g} (to {largest:.3g} rad/s²), until the exact one fails."
    )


@style()
def draw_gain_plane(side: str, found: JsonObject) -> Drawn:
    """The plane of gains with all conditions at one f⁺ > 0, and where the gains lie in it.

    Args:
        side: motor or load.
        found: gains, f⁺ and what follows from them, as of :func:`jaxbl.observer.conditions.judge_gains`.
    """
    lambda_, alpha, bound, largest = (found[name] for name in ("lambda", "alpha", "f_plus", "largest_f_plus"))
    least = found["least_lambda"]["exact"]
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
        condition_curves(ax, {"exact": CONDITIONS["exact"]}, largest, alphas)
        edge = ax.lines[-1]
        x, y = np.asarray(edge.get_xydata()).T
        label = f"where it would fail at f⁺ = {largest:.3g} rad/s²"
        edge.set(data=([x[0], *x], [lambdas[1], *y]), color="black", ls="--", lw=1.2, path_effects=[], label=label)
        handles.append(Line2D([], [], color="black", ls="--", lw=1.2, label=label))
    if least is not None:
        ends = [least, max(lambda_, lambdas[0])]
        ax.plot([alpha, alpha], ends, color="black", lw=1.2)
    ax.set(xlim=alphas, ylim=lambdas)
    name_gains(ax, bound)
    handles.append(mark(ax, (alpha, lambda_), "*", "the observer's gains", 15))
    ax.set_title(f"{side}: λ = {lambda_:.3g} √rad/s, α = {alpha:.3g} rad/s²,  f⁺ = {bound:.3g} rad/s²")
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    caption = (
        f"Gains of the {side} observer and the least λ of each gain condition at the true f⁺ = {bound:.3g} rad/s² along the "
        "run. Above and on the right: the axes of the atlas (jaxbl verify)."
    )
    if least is not None and lambda_ > 0.0:
        caption += f" Stroke: λ is {lambda_ / least:.3g} times the least one of the exact condition."
    return Drawn(f"gain_conditions_{side}", figure, caption)
