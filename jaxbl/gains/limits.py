"""What keeps the gains that `tune` chose from going further, towards each side, from the runs that the search made."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportReturnType=false

from typing import Any

import numpy as np
import pandas as pd

from jaxbl.files import to_jsonable

from .gain_search import GainSearch

WORTH = 0.01
"""Relative differences of the error below this count for nothing: another noise makes as much."""

GAINS = ("lambda", "alpha")
PLACES = {
    "converged": "converged",
    "margin_alpha": "margin_alpha",
    "margin_exact": "margin_exact",
    "longest_convergence": "convergence_time",
}
"""Column of the candidates that a constraint is about."""
_NUMBERS = {name: column for name, column in PLACES.items() if name != "converged"}

_SAME = 1e-9
"""Relative difference of a gain that is the same, but for rounding."""


def limits_of(search: GainSearch, side: str) -> dict[str, Any]:
    """Plain data of what limits a side's gains (`limits` in `tuning.json`).

    `profiles`: for each gain, the error along it with the other gain held at the optimum, and which constraints are missed
    there. `towards`: what that says of smaller and larger gains, within about a cell of the coarse map (:func:`_towards`).
    `constraints`: their values at the optimum, their limits, and the factor between them, 1 at the limit, None without end.
    `binding`: the constraints that forbid a smaller error beside the optimum. `range_ends`: where the range searched ends at
    the optimum.
    """
    best = search.best_candidate(side)
    profiles = {gain: _profile(search, side, gain, best) for gain in GAINS}
    towards = {
        gain: {way: _towards(search, profile, best, gain, sign) for way, sign in (("smaller", -1), ("larger", 1))}
        for gain, profile in profiles.items()
    }
    every = [way for ways in towards.values() for way in ways.values()]
    binding = list(dict.fromkeys(name for way in every if way["limit"] == "constraint" for name in way["missed"]))
    constraints = {"converged": {"value": bool(best["converged"]), "binds": "converged" in binding}}
    for name, column in _NUMBERS.items():
        limit = getattr(search.table, name)
        if limit is not None:
            ratio = best[column] / limit
            # a time of zero has any room
            room = ratio if name != "longest_convergence" else 1.0 / ratio if ratio else np.inf
            constraints[name] = {"value": best[column], "limit": limit, "room": room, "binds": name in binding}
    ends = [f"{way} {gain}" for gain, ways in towards.items() for way, found in ways.items() if found["limit"] == "range"]
    shown = {
        gain: {name: profile[name].tolist() for name in (gain, f"{gain}_ratio", "error", "chatter", "missed")}
        for gain, profile in profiles.items()
    }
    return to_jsonable(
        {"constraints": constraints, "binding": binding, "range_ends": ends, "towards": towards, "profiles": shown}
    )


def _profile(search: GainSearch, side: str, gain: str, best: dict[str, Any]) -> pd.DataFrame:
    """Candidates along one gain with the other at its optimum, in the order of the gain; between two rows of a map,
    interpolated. Of maps that overlap the finer one counts."""
    other = GAINS[1 - GAINS.index(gain)]
    found, at, lines, window = search.candidates[side], best[f"{other}_ratio"], [], (np.inf, -np.inf)
    for stage in reversed(range(len(search.windows))):
        low, high = search.windows[stage][side][other]
        if not low * (1.0 - _SAME) <= at <= high * (1.0 + _SAME):
            continue
        line = _between(found[found["stage"] == stage], gain, other, at)
        ratio = line[f"{gain}_ratio"]
        lines.append(line[(ratio < window[0] * (1.0 - _SAME)) | (ratio > window[1] * (1.0 + _SAME))])
        low, high = search.windows[stage][side][gain]
        window = min(window[0], low), max(window[1], high)
    line = pd.concat(lines)
    line = line[(line[gain] / best[gain] - 1.0).abs() > _SAME]
    line = pd.concat([line, pd.DataFrame([best])[line.columns]]).sort_values(gain, ignore_index=True)
    kept = search.constraints_met(line)
    return line.assign(missed=[[name for name, good in kept.items() if not good[i]] for i in range(len(line))])


def _between(part: pd.DataFrame, gain: str, other: str, at: float) -> pd.DataFrame:
    """A line of a map along a gain, where the other one's ratio is `at`; errors by their mean squares."""
    rows = np.unique(part[f"{other}_ratio"])
    i = int(np.clip(np.searchsorted(rows, at), 1, len(rows) - 1))
    share = np.log(at / rows[i - 1]) / np.log(rows[i] / rows[i - 1])
    ends = [part[part[f"{other}_ratio"] == rows[k]].sort_values(gain, ignore_index=True) for k in (i - 1, i)]
    if share < _SAME or share > 1.0 - _SAME:
        return ends[round(share)][_COLUMNS]
    low, high = ends

    def mean(name: str, power: int = 1) -> pd.Series:
        return ((1.0 - share) * low[name] ** power + share * high[name] ** power) ** (1.0 / power)

    new = {name: mean(name, 2) for name in ("error", "chatter")}
    new |= {name: mean(name) for name in _NUMBERS.values()} | {"converged": low["converged"] & high["converged"]}
    return low[_COLUMNS].assign(**new)


_COLUMNS = ["lambda", "alpha", "lambda_ratio", "alpha_ratio", "error", "chatter", *PLACES.values()]


def _towards(search: GainSearch, profile: pd.DataFrame, best: dict[str, Any], gain: str, sign: int) -> dict[str, Any]:
    """What a smaller (sign -1) or larger gain meets, up to the first value at least a cell of the coarse map away.

    `limit` is `constraint` where constraints forbid a smaller error (by more than `WORTH`): `missed` are those met first.
    It is `range` where the range searched ends at the optimum, else `error` where the error grows, or `flat`. `at` and
    `change` are the gain, and the error there over the optimum's less 1; `by` the part of the error that makes most of the
    growth, `chatter` (what changes from sample to sample) or `slow` (the rest), None where that is not known.
    """
    line = profile[sign * np.log(profile[gain] / best[gain]) > _SAME]
    line = line.iloc[::sign]
    if not len(line):
        # it is the margin that ends the range there
        if gain == "alpha" and sign < 0 and best["margin_alpha"] < search.table.margin_alpha * (1.0 + WORTH):
            return {"limit": "constraint", "missed": ["margin_alpha"], "at": None, "change": None, "by": None}
        return {"limit": "range", "missed": [], "at": None, "change": None, "by": None}
    distance = sign * np.log(line[gain] / best[gain]).to_numpy()
    cell = np.log(search.coarse_cell_ratio(gain)) * (1.0 - 1e-6)
    near = line.iloc[: int(np.searchsorted(distance, cell)) + 1]
    forbidden = near[near["missed"].map(bool)]
    if len(forbidden) and forbidden["error"].min() < (1.0 - WORTH) * best["error"]:
        least = forbidden.loc[forbidden["error"].idxmin()]
        found = {"limit": "constraint", "missed": forbidden["missed"].iloc[0], "at": least[gain]}
        return found | {"change": least["error"] / best["error"] - 1.0, "by": None}
    last = near.iloc[-1]
    change = last["error"] / best["error"] - 1.0
    # runs that diverged have no error: they are worse
    grows = not change <= WORTH
    found = {"limit": "error" if grows else "flat", "missed": last["missed"], "at": last[gain], "change": change}
    return found | {"by": _part(search, best, last) if grows else None}


def _part(search: GainSearch, best: dict[str, Any], last: pd.Series) -> str | None:
    """The part of the velocity error that most of its growth is due to, by mean squares."""
    squares = [(row["error"] ** 2, row["chatter"] ** 2) for row in (best, last)]
    if search.table.objective != "velocity" or not all(chatter <= error for error, chatter in squares):
        return None
    (error, chatter), (more_error, more_chatter) = squares
    return "chatter" if more_chatter - chatter > 0.5 * (more_error - error) else "slow"
