"""Sentences that say where a model lacks torque, and how much of it."""

import numpy as np

from jaxbl.lines import percent

from .coordinates import EVERYWHERE
from .localise import Coordinate, Localised
from .thresholds import LIMITS

_SIMPLER = 0.04
"""Share of the power by which a later coordinate must explain more than an earlier one, to be named in its place."""
_HINT, _TELLING = 0.1, 0.5
"""Share of the power from which on a coordinate is hinted at; and from which on it, a region or a narrow peak is named."""
_CROWDED = 0.35
"""Share of the power less share of the time from which on a region is named."""
_PLACE = {
    EVERYWHERE: "alike everywhere",
    "direction": "by the direction of motion",
    "reversals": "at speed reversals",
    "gap": "by the gap",
    "load sign": "by the sign of the load",
    "speed": "a function of speed",
    "|speed|": "by the size of the speed",
    "turn": "a function of the position within a turn",
    "load turn": "a function of the load's position within a turn",
    "position": "a function of position",
    "load position": "a function of the load's position",
    "twist": "a function of the twist",
    "twist rate": "a function of the twist's rate",
    "input": "a function of the input",
    "acceleration": "a function of acceleration",
    "time": "it comes and goes with time",
}


def sentence_of(located: Localised, unit: str = "N m") -> str:
    """One sentence: which side, where, and how much of the residual power lies there."""
    side = f"{located.name} side"
    if not located.significant:
        return f"{side}: nothing beyond noise ({located.noise:.2g} {unit} rms up to {located.bandwidth:.3g} Hz)"
    size = f"{located.missing:.2g} {unit} rms"
    best = max(coordinate.explained for coordinate in located.coordinates.values())
    telling = next(coordinate for coordinate in located.coordinates.values() if coordinate.explained >= best - _SIMPLER)
    place = _PLACE[telling.name]
    crowd = _find_crowded(located)
    clauses = []
    if crowd is not None and (best < _TELLING or crowd[0] > _TELLING):
        clauses.append(crowd[1])
    lines = [peak for peak in located.peaks if not peak.in_motion]
    if lines and lines[0].power_share > max(best, _TELLING) - _SIMPLER:
        clauses.append(
            f"at {lines[0].frequency:.4g} Hz; {percent(lines[0].power_share)} of the residual power is a narrow peak there"
        )
    elif best >= _TELLING:
        means = [region for region in telling.regions if region.label and abs(region.mean_z) > LIMITS.significant]
        values = f" ({', '.join(f'{region.mean:+.2g} {unit} {region.label}' for region in means)})" if means else ""
        clauses.append(f"{place}{values}; {percent(telling.explained)} of the residual power goes with it")
    if not clauses and located.excess_z < LIMITS.significant:
        return f"{side}, {_faint(located, unit)}"
    if not clauses:
        hint = f" (most: {percent(best)}, {place})" if best > _HINT else ""
        clauses.append(f"spread over the log: no function of speed, position, load or time alone explains half of it{hint}")
    return f"{side}, {'; '.join(clauses)} ({size})"


def _faint(located: Localised, unit: str) -> str:
    """The region that stands out most where the whole does not."""
    regions = [(coordinate, region) for coordinate in located.coordinates.values() for region in coordinate.regions]
    coordinate, region = max(regions, key=lambda pair: max(abs(pair[1].mean_z), pair[1].excess_z))
    z = max(abs(region.mean_z), region.excess_z)
    if located.peaks and located.peaks[0].excess_z > z:
        peak = located.peaks[0]
        return f"faint: a narrow peak of {peak.amplitude:.2g} {unit} at {peak.frequency:.4g} Hz"
    place = region.label or f"where {region.low:.3g} < {coordinate.symbol} < {region.high:.3g} {coordinate.unit}"
    if abs(region.mean_z) >= region.excess_z:
        return f"faint: {region.mean:+.2g} ± {region.mean_error:.1g} {unit} on average {place}"
    return f"faint: {np.sqrt(max(region.excess, 0.0)):.2g} {unit} rms beyond noise {place}"


def _find_crowded(located: Localised) -> tuple[float, str] | None:
    """The region that holds much of the power in little of the time: its share of power less that of time, and a clause."""
    best: tuple[float, str] | None = None
    for coordinate in located.coordinates.values():
        if coordinate.name in (EVERYWHERE, "direction", "input", "acceleration", "twist rate"):
            continue
        keys = "power_share", "time_share", "excess_z"
        power, time, z = (np.array([getattr(r, key) for r in coordinate.regions]) for key in keys)
        if coordinate.name == "reversals":
            groups = [np.array([r.label.startswith("reversals") for r in coordinate.regions])]
        elif any(r.label for r in coordinate.regions):
            groups = list(np.eye(len(power), dtype=bool))
        else:
            numbers = np.arange(len(power))
            groups = [(numbers >= i) & (numbers <= j) for i in range(len(power)) for j in range(i, len(power))]
        for rows in groups:
            held, spent = float(power[rows].sum()), float(time[rows].sum())
            score = held - spent
            if held < _TELLING or held < 2.0 * spent or score < _CROWDED or np.max(z[rows]) < LIMITS.significant:
                continue
            # of regions that hold as much, the simpler coordinate's
            if best is None or score > best[0] + _SIMPLER:
                best = score, _region_text(coordinate, rows)
    return best


def _region_text(coordinate: Coordinate, rows: np.ndarray) -> str:
    chosen = [region for region, taken in zip(coordinate.regions, rows, strict=True) if taken]
    share = percent(min(sum(region.power_share for region in chosen), 1.0))
    if chosen[0].label:
        if coordinate.name == "reversals":
            return f"at speed reversals; {share} of the residual power lies near them"
        return f"{chosen[0].label}; {share} of the residual power lies there"
    low, high, symbol, unit = chosen[0].low, chosen[-1].high, coordinate.symbol, coordinate.unit
    if coordinate.name == "|speed|" and rows[0]:
        return f"at low speed; {share} of the residual power lies where {symbol} < {high:.2g} {unit}"
    if coordinate.name == "|speed|" and rows[-1]:
        return f"at high speed; {share} of the residual power lies where {symbol} > {low:.2g} {unit}"
    if coordinate.name == "time":
        return f"for a while; {share} of the residual power lies between {low:.4g} and {high:.4g} s"
    return f"at a place; {share} of the residual power lies where {low:.3g} < {symbol} < {high:.3g} {unit}"
