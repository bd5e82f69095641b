"""What limits the error: why gains smaller or larger than those of the least one are not better, from the search's runs."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportReturnType=false

import numpy as np
import pandas as pd

from jaxbl.files import to_jsonable
from jaxbl.json_types import JsonObject

from .gain_search import LIMITED_COLUMNS, GainSearch, grid_ratio

LEAST_DIFFERENCE = 0.01
"""Smaller relative differences of the error do not count: another noise seed makes as much."""

GAINS = ("lambda", "alpha")

_ROUNDING = 1e-9
"""Relative difference up to which two gains are the same."""


def find_limits(search: GainSearch, side: str) -> JsonObject:
    """Find what limits a side's gains: the table `limits` of `tuning.json`.

    - `profiles`: for each gain the error along it, with the other gain at the optimum, and the constraints missed there;
    - `towards`: the reason against smaller and larger gains within about a cell of the coarse map (`_judge_direction`);
    - `constraints`: each one's value at the optimum, its limit, and the factor `room` between them (1 at the limit);
    - `binding`: the constraints that forbid a smaller error beside the optimum;
    - `range_ends`: gains whose searched range ends at the optimum.
    """
    best = search.least_candidate(side)
    profiles = {gain: _error_profile(search, side, gain, best) for gain in GAINS}
    signs = {"smaller": -1, "larger": 1}
    towards = {
        gain: {direction: _judge_direction(search, profile, best, gain, sign) for direction, sign in signs.items()}
        for gain, profile in profiles.items()
    }
    binding: list[str] = []
    ends = []
    for gain, judgements in towards.items():
        for direction, judgement in judgements.items():
            if judgement["limit"] == "constraint":
                binding += [name for name in judgement["missed"] if name not in binding]
            if judgement["limit"] == "range":
                ends.append(f"{direction} {gain}")
    constraints = {"converged": {"value": bool(best["converged"]), "binds": "converged" in binding}}
    for name, room in search.rooms(pd.DataFrame([best])).items():
        value, limit = best[LIMITED_COLUMNS[name]], getattr(search.table, name)
        constraints[name] = {"value": value, "limit": limit, "room": room[0], "binds": name in binding}
    profile_lists = {
        gain: {name: profile[name] for name in (gain, f"{gain}_ratio", "error", "chatter", "missed")}
        for gain, profile in profiles.items()
    }
    return to_jsonable(
        {"constraints": constraints, "binding": binding, "range_ends": ends, "towards": towards, "profiles": profile_lists}
    )


def _error_profile(search: GainSearch, side: str, gain: str, best: JsonObject) -> pd.DataFrame:
    """Return candidates along one gain, with the other gain at its optimum, and the constraints that each misses.

    They are interpolated between two rows of a map. Where maps overlap, the finer one counts.
    """
    other = GAINS[1 - GAINS.index(gain)]
    candidates, other_ratio, lines, window = search.candidates[side], best[f"{other}_ratio"], [], (np.inf, -np.inf)
    for stage in reversed(range(len(search.windows))):
        low, high = search.windows[stage][side][other]
        if not low * (1.0 - _ROUNDING) <= other_ratio <= high * (1.0 + _ROUNDING):
            continue
        line = _interpolate_line(candidates[candidates["stage"] == stage], gain, other, other_ratio)
        ratio = line[f"{gain}_ratio"]
        lines.append(line[(ratio < window[0] * (1.0 - _ROUNDING)) | (ratio > window[1] * (1.0 + _ROUNDING))])
        low, high = search.windows[stage][side][gain]
        window = min(window[0], low), max(window[1], high)
    line = pd.concat(lines)
    line = line[(line[gain] / best[gain] - 1.0).abs() > _ROUNDING]
    line = pd.concat([line, pd.DataFrame([best])[line.columns]]).sort_values(gain, ignore_index=True)
    constraints = search.constraints_met(line).items()
    return line.assign(missed=[[name for name, is_met in constraints if not is_met[i]] for i in range(len(line))])


def _interpolate_line(candidates: pd.DataFrame, gain: str, other: str, other_ratio: float) -> pd.DataFrame:
    """Interpolate a map along a gain at a ratio of the other gain; errors by their mean squares."""
    rows = np.unique(candidates[f"{other}_ratio"])
    i = int(np.clip(np.searchsorted(rows, other_ratio), 1, len(rows) - 1))
    share = np.log(other_ratio / rows[i - 1]) / np.log(rows[i] / rows[i - 1])
    ends = [candidates[candidates[f"{other}_ratio"] == rows[k]].sort_values(gain, ignore_index=True) for k in (i - 1, i)]
    if share < _ROUNDING or share > 1.0 - _ROUNDING:
        return ends[round(share)][_COLUMNS]
    (low, high), columns = ends, ["error", "chatter", *LIMITED_COLUMNS.values()]
    powers = np.where(np.isin(columns, ["error", "chatter"]), 2.0, 1.0)
    means = ((1.0 - share) * low[columns] ** powers + share * high[columns] ** powers) ** (1.0 / powers)
    return low[_COLUMNS].assign(**means, converged=low["converged"] & high["converged"])


_COLUMNS = ["lambda", "alpha", "lambda_ratio", "alpha_ratio", "error", "chatter", "converged", *LIMITED_COLUMNS.values()]


def _judge_direction(search: GainSearch, profile: pd.DataFrame, best: JsonObject, gain: str, sign: int) -> JsonObject:
    """Find the reason against a smaller (sign -1) or larger gain, within about one cell of the coarse map.

    Returns a dictionary:

    - `limit`: `constraint` if constraints forbid an error smaller by more than `LEAST_DIFFERENCE`; `range` if the searched
      range ends at the optimum; `error` if the error grows; else `flat`;
    - `missed`: the constraints that are missed there;
    - `at`, `change`: the gain there, and the relative change of the error;
    - `by`: the part of the error that grows most, `chatter` (changes from sample to sample) or `slow` (the remainder);
      None if that is unknown.
    """
    line = profile[sign * np.log(profile[gain] / best[gain]) > _ROUNDING]
    line = line.iloc[::sign]
    if not len(line):
        least_margin = search.table.margin_alpha * (1.0 + LEAST_DIFFERENCE)
        ends_at_margin = gain == "alpha" and sign < 0 and best["margin_alpha"] < least_margin
        limit, missed = ("constraint", ["margin_alpha"]) if ends_at_margin else ("range", [])
        return {"limit": limit, "missed": missed, "at": None, "change": None, "by": None}
    distance = sign * np.log(line[gain] / best[gain]).to_numpy()
    cell = np.log(grid_ratio(search.limits[gain], search.table.num)) * (1.0 - 1e-6)
    near = line.iloc[: int(np.searchsorted(distance, cell)) + 1]
    forbidden = near[near["missed"].map(bool)]
    if len(forbidden) and forbidden["error"].min() < (1.0 - LEAST_DIFFERENCE) * best["error"]:
        least = forbidden.loc[forbidden["error"].idxmin()]
        change = least["error"] / best["error"] - 1.0
        missed = forbidden["missed"].iloc[0]
        return {"limit": "constraint", "missed": missed, "at": least[gain], "change": change, "by": None}
    last = near.iloc[-1]
    change = last["error"] / best["error"] - 1.0
    # NaN, the error of diverged runs, counts as growth
    grows = not change <= LEAST_DIFFERENCE
    judgement = {"limit": "error" if grows else "flat", "missed": last["missed"], "at": last[gain], "change": change}
    return judgement | {"by": _growing_part(search, best, last) if grows else None}


def _growing_part(search: GainSearch, best: JsonObject, last: pd.Series) -> str | None:
    """Return the part of the velocity error that most of its growth is due to, by mean squares."""
    squares = [(row["error"] ** 2, row["chatter"] ** 2) for row in (best, last)]
    if search.table.objective != "velocity" or not all(chatter <= error for error, chatter in squares):
        return None
    (error, chatter), (more_error, more_chatter) = squares
    return "chatter" if more_chatter - chatter > 0.5 * (more_error - error) else "slow"
