"""Gains of an observer against the gain conditions, in the units of a user's drive: the atlas of `verify` at one f⁺."""

from collections.abc import Iterator, Mapping

import jax
import numpy as np

from jaxbl.gains.gain_search import usual_rule
from jaxbl.json_types import JsonObject
from jaxbl.observer.conditions import CONDITIONS, Condition
from jaxbl.sweeps.elementwise import apply_elementwise

from .panels import MISSING, Array, Axis, Band, Figure, Line, Pair, Panel, mark

EXACT = {"exact": CONDITIONS["exact"]}
_LOOKS = {
    "davila_fridman": ("-", "#FF5FA2"),
    "levant": ("-.", "#FF9E4A"),
    "seeber_horn": ("--", "#7FDBFF"),
    "moreno_osorio": ("-.", "#B6F09C"),
    "exact": ("-", "#FFD400"),
}
"""Dashes and colour of each gain condition's curve."""


def least_lambdas(condition: Condition, alphas: Array, bound: float) -> Array:
    """The least lambda of a condition at each alpha, for one f_plus."""
    with jax.enable_x64(True):
        return apply_elementwise(condition.least_lambda, [alphas, np.full_like(alphas, bound)])


def condition_curves(conditions: Mapping[str, Condition], bound: float, alphas: Pair, alpha_is_x: bool = True) -> list[Line]:
    """Curves of the least lambda of gain conditions over a range of alpha, for one f_plus."""
    low, high = max(alphas[0], bound * 1.0001), alphas[1]
    fine = np.geomspace(low, high, 400) if high > low else np.array([])
    curves = []
    for name, condition in conditions.items():
        x, y = fine, least_lambdas(condition, fine, bound) if fine.size else fine
        if not alpha_is_x:
            x, y = y, x
        dashes, colour = _LOOKS[name]
        # named where it is drawn; a dark line beneath parts it from any colour
        curves += Line(x, y, colour="#222222", width=3.4), Line(x, y, condition.title, colour, 2.0, dashes, at_line=True)
    return curves


def usual_rule_curve(bound: float, alphas: Pair) -> Line:
    """The usual rule's gains for each f_plus from `bound` on, as far as alpha goes."""
    bounds = np.geomspace(bound, max(alphas[1] / usual_rule(1.0)[1], bound), 100)
    lambdas, curve_alphas = zip(*map(usual_rule, bounds), strict=True)
    return Line(curve_alphas, lambdas, "usual rule", "#FF9E4A", 2.0, "--", at_line=True)


def gain_axes(bound: float, alphas: Pair, lambdas: Pair) -> tuple[Axis, Axis]:
    """Axes of alpha (rad/s²) along x and lambda (√rad/s) along y; on the other sides stand α / f⁺ and λ / √f⁺."""
    return (
        Axis("α, switching gain (rad/s²)", log=True, ends=alphas, ratio=(bound, "α / f⁺")),
        Axis("λ, correction gain (√rad/s)", log=True, ends=lambdas, ratio=(np.sqrt(bound), "λ / √f⁺")),
    )


RESERVE_WORDS = "factor from these gains to the nearest that fail or err twice as much"
"""What the reserve of gains is, behind its number."""
_LEAST_RESERVE = 1.25
"""Factor by which gains may change until they fail, below which the card says so: f⁺ of a machine is known to about this."""


def say_thin_reserve(reserves: Mapping[str, float]) -> str:
    """Name the sides whose gains may change by too small a factor; "" if none are."""
    thin = [f"{side} × {reserve:.3g}" for side, reserve in reserves.items() if reserve < _LEAST_RESERVE]
    return f"Little reserve until they fail or err twice as much: {', '.join(thin)}." if thin else ""


_GAINS = "lambda", "alpha", "f_plus", "largest_f_plus"


def describe_conditions(judged: Mapping[str, JsonObject], source: str = "the largest of all runs") -> Iterator[str]:
    """Say whether each side has safe gains at an f⁺ (of `source`), and how far they are from where the exact condition
    fails."""
    for side, gains in judged.items():
        lambda_, alpha, bound, largest = (gains[key] for key in _GAINS)
        least = gains["least_lambda"]["exact"]
        lead = f"{side}: f⁺ = {bound:.3g} rad/s² is {source};"
        if bound == 0.0:
            yield f"{lead} nothing disturbs the observer, and any λ > 0 is enough."
        elif not gains["alpha_exceeds_f_plus"]:
            yield f"{lead} α = {alpha:.3g} rad/s² is too small, as it has to exceed f⁺."
        elif not gains["holds"]["exact"]:
            yield f"{lead} λ = {lambda_:.3g} √rad/s is too small: it has to exceed {least:.3g} (exact condition)."
        else:
            yield (
                f"{lead} the exact condition holds. λ may fall to {least:.3g} √rad/s ({lambda_ / least:.4g} times less), or "
                f"f⁺ grow to {largest:.3g} rad/s² ({largest / bound:.4g} times more), until it fails."
            )


def draw_gain_plane(side: str, judged: JsonObject) -> Figure:
    """The plane of gains with the exact condition and the usual rule at one f⁺ > 0, and where the gains lie in it.

    Args:
        side: motor or load.
        judged: gains, f⁺ and what follows from them, as of :func:`jaxbl.observer.conditions.judge_gains`.
    """
    lambda_, alpha, bound, _ = (judged[key] for key in _GAINS)
    least = judged["least_lambda"]["exact"]
    # a gain of zero has no place on a logarithmic axis
    alphas = min(0.7 * bound, 0.5 * alpha or bound), max(20.0 * bound, 3.0 * alpha)
    lowest = 0.15 * np.sqrt(bound)
    lambdas = min(0.3 * (lambda_ or lowest), 0.5 * (least or lowest), lowest), max(3.0 * lambda_, 30.0 * np.sqrt(bound))
    _, exact = condition_curves(EXACT, bound, alphas)
    # α has to exceed f⁺, whatever λ is
    x, y = [alphas[0], exact.x[0], *exact.x], [lambdas[1], lambdas[1], *exact.y]
    parts = [
        Band(x, np.full(len(x), lambdas[0]), y, "fails", MISSING, 0.6),
        exact._replace(colour="#000000", at_line=False),
        usual_rule_curve(bound, alphas),
        mark(alpha, lambda_, "the observer's gains"),
    ]
    caption = (
        f"Gains of the {side} observer (λ = {lambda_:.3g} √rad/s, α = {alpha:.3g} rad/s²) and the least λ of the exact "
        f"condition at the true f⁺ = {bound:.3g} rad/s² along the run; the usual rule's gains for this f⁺ and larger ones. "
        "Above and on the right: the axes of the atlas (jaxbl verify)."
    )
    panel = Panel(*gain_axes(bound, alphas, lambdas), parts, title=f"{side} observer")
    return Figure(f"gain_conditions_{side}", [panel], caption, width=5.6, height=4.4)
