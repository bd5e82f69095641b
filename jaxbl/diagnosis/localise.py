"""Where a residual torque lives: over time, speed, position, reversals, gap, load and frequency, each with its significance.

Two questions are asked of each region. How much of the residual's power beyond the noise lies there: judged against the
noise alone, with its deviation and correlation. And is the mean torque there other than zero: judged against the scatter
of the means of blocks of time, if that is larger, so that a slow disturbance that the noise level does not know of is no
finding. How much of the power a function of one coordinate explains is counted on blocks of time that it was not made from.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from jaxbl.identification import regression
from jaxbl.identification.regression import Kinematics, transmitted
from jaxbl.identification.smoother import Smoothed
from jaxbl.simulate import Experiment

from .residuals import Residual, narrowed, noise_spectrum

Array = np.ndarray

_BINS = 24
_COUNTS = (2, 4, 8, 16, 32, 64, 128)
"""Numbers of bins that functions of a coordinate are tried with."""
_BLOCKS, _FOLDS = 40, 5
_FEWEST = 4
"""Blocks of time that a mean must come from to have a scatter."""
_SAMPLES = 5
_LEVEL_UNKNOWN = 0.05
"""Relative uncertainty of the noise's deviation."""
SIGNIFICANT = 4.5
"""Standard deviations beyond which a region counts: several hundred regions are looked at."""
RESOLUTION = 5e-4
"""Share of the driving torque below which sampling alone may be what is missing."""
_CLEAR = 10.0
"""Power over the noise's from which on no narrower low-pass is tried."""
_PEAKS, _NARROW, _AROUND = 5, 10.0, 20
_SIMPLER = 0.04
"""Share of the power by which a later coordinate must explain more than an earlier one."""
_TELLING = 0.5
_CROWDED = 0.35
_EVERYWHERE = "all"


class Values(NamedTuple):
    """A coordinate along a part of a record.

    Attributes:
        values: a number a sample, or the index of its class.
        unit: of the number.
        classes: names of the classes; empty for numbers.
        symbol: for sentences.
    """

    values: Array
    unit: str = ""
    classes: tuple[str, ...] = ()
    symbol: str = ""


@dataclasses.dataclass(frozen=True)
class Region:
    """A bin of a coordinate.

    Attributes:
        label: name of a class; empty for numbers.
        low, high: ends of a bin of numbers.
        time_share: share of the samples.
        power_share: share of all power beyond the noise; may be negative by chance.
        excess: mean square beyond the noise, (N m)^2.
        excess_z: its significance, standard deviations.
        mean: mean missing torque, N m.
        mean_error: its standard error.
        mean_z: its significance.
    """

    label: str
    low: float | None
    high: float | None
    time_share: float
    power_share: float
    excess: float
    excess_z: float
    mean: float
    mean_error: float
    mean_z: float


@dataclasses.dataclass(frozen=True)
class Coordinate:
    """A residual over one coordinate.

    Attributes:
        name: of the coordinate.
        unit: of its numbers.
        symbol: for sentences.
        regions: its bins.
        explained: share of the power beyond the noise that a function of it explains, on data it was not made from.
    """

    name: str
    unit: str
    symbol: str
    regions: tuple[Region, ...]
    explained: float


@dataclasses.dataclass(frozen=True)
class Band:
    """Power in a band of frequencies.

    Attributes:
        low, high: Hz.
        power_share: share of all power beyond the noise.
        excess_z: significance.
    """

    low: float
    high: float
    power_share: float
    excess_z: float


@dataclasses.dataclass(frozen=True)
class Peak:
    """A narrow peak of the spectrum.

    Attributes:
        frequency: Hz.
        amplitude: N m.
        power_share: share of all power beyond the noise.
        excess_z: significance among all frequencies.
        in_motion: whether the motion has a peak there, too: then it says little of its own.
    """

    frequency: float
    amplitude: float
    power_share: float
    excess_z: float
    in_motion: bool


@dataclasses.dataclass(frozen=True)
class Localised:
    """Where the missing torque of one equation lives. Numbers only: `dataclasses.asdict` makes it JSON.

    Attributes:
        name: `motor`, `load` or `transmission`.
        bandwidth: of what is looked at, Hz.
        rms, noise: of residual and noise within it, N m.
        missing: rms beyond the noise, N m.
        excess_z: its significance.
        significant: whether there is anything beyond noise, as a whole or in a region.
        coordinates: by name.
        bands, peaks: of the spectrum.
    """

    name: str
    bandwidth: float
    rms: float
    noise: float
    missing: float
    excess_z: float
    significant: bool
    coordinates: dict[str, Coordinate]
    bands: tuple[Band, ...]
    peaks: tuple[Peak, ...]


def coordinates_of(
    experiment: Experiment,
    part: Kinematics,
    smoothed: Mapping[str, Smoothed],
    residual: Residual,
    *,
    rotating: bool | Mapping[str, bool] = True,
) -> dict[str, Values]:
    """Coordinates of a residual along its part of a record, the more telling of equals first.

    Args:
        experiment: the model.
        part: of the record.
        smoothed: its positions, by side.
        residual: of that part.
        rotating: whether positions are angles in rad; by side where they differ.
    """
    side = "motor" if residual.name == "transmission" else residual.name
    turns = dict.fromkeys(part.position, rotating) if isinstance(rotating, bool) else rotating
    length = "rad" if turns[side] else "m"
    omega = "ω" if turns[side] else "v"
    velocity = np.asarray(part.velocity[side])
    deviation = np.asarray(smoothed[side].deviation(1))
    still = np.abs(velocity) <= np.maximum(3.0 * deviation, 1e-3 * np.sqrt(np.mean(velocity**2)))
    found = {
        _EVERYWHERE: Values(np.zeros(len(velocity), int), classes=("everywhere",)),
        "direction": Values(
            np.where(still, 1, np.where(velocity > 0.0, 2, 0)), classes=("backward", "at rest", "forward"),
        ),
        "reversals": _reversals(part, velocity, still, residual.bandwidth),
    }  # fmt: skip
    geared = len(part.position) > 1 and experiment.transmission is not None
    if geared:
        plant = experiment.plant
        twist = np.asarray(plant.twist(part.position))  # type: ignore[arg-type]
        rate = np.asarray(plant.twist(part.velocity))  # type: ignore[arg-type]
        torque = part.transmitted
        if torque is None:
            torque = transmitted(experiment, part)
        torque = np.asarray(torque)
        gap = experiment.plant.half_gap
        if gap > 0.0:
            inside = np.where(np.abs(twist) < gap, 1, np.where(twist > 0.0, 2, 0))
            found["gap"] = Values(inside, classes=("outside, z < 0", "inside of the gap", "outside, z > 0"))
        idle = np.abs(torque) < 0.02 * np.sqrt(np.mean(torque**2))
        loaded = np.where(idle, 1, np.where(torque > 0.0, 2, 0))
        found["load sign"] = Values(loaded, classes=("negative load", "no load", "positive load"))
    found["|speed|"] = Values(np.abs(velocity), f"{length}/s", symbol=f"|{omega}|")
    found["speed"] = Values(velocity, f"{length}/s", symbol=omega)
    for one in part.position:
        position = np.asarray(part.position[one])
        if turns[one] and np.ptp(position) > 1.2 * 2.0 * np.pi and one in (side, "load"):
            name = "turn" if one == side else f"{one} turn"
            symbol = "θe mod 2π" if one == "motor" else "θs mod 2π"
            found[name] = Values(np.mod(position, 2.0 * np.pi), "rad", symbol=symbol)
    symbol = ("θe" if side == "motor" else "θs") if turns[side] else "x"
    found["position"] = Values(np.asarray(part.position[side]), length, symbol=symbol)
    if side != "load" and geared:
        found["load position"] = Values(
            np.asarray(part.position["load"]), "rad" if turns["load"] else "m", symbol="θs" if turns["load"] else "x"
        )
    if geared:
        found["twist"] = Values(twist, "rad" if turns["motor"] else "m", symbol="z")
        found["twist rate"] = Values(rate, "rad/s" if turns["motor"] else "m/s", symbol="ż")
    unit = "N m" if turns["motor"] else "N"
    if side == "motor":
        found["input"] = Values(np.asarray(part.torque), unit, symbol="u")
    acceleration = np.asarray(part.acceleration[side])
    if residual.name in experiment.sides:
        # by the model: the measured one's noise is the residual's, and would be found there
        acceleration = acceleration - residual.torque / float(experiment.plant.inertia(side))
    found["acceleration"] = Values(acceleration, f"{length}/s²", symbol="a")
    found["time"] = Values(np.asarray(part.time), "s", symbol="t")
    return found


def _reversals(part: Kinematics, velocity: Array, still: Array, bandwidth: float) -> Values:
    """Whether the motion reverses nearby, and to which direction: near is what the low-pass smears, and some more."""
    time = np.asarray(part.time)
    sign = np.where(still, 0.0, np.sign(velocity))
    moving = np.flatnonzero(sign)
    turning = np.flatnonzero(np.diff(sign[moving]))
    near = np.zeros(len(time), int)
    if len(turning):
        first, last = moving[turning], moving[turning + 1]
        between = np.median(np.diff(time[first])) if len(first) > 1 else 0.5 * (time[-1] - time[0])
        window = min(max(0.3 / bandwidth, 0.05 * between), 0.2 * between)
        for begin, end in zip(first, last, strict=True):
            rows = slice(*np.searchsorted(time, (time[begin] - window, time[end] + window)))
            near[rows] = 1 if sign[end] > 0.0 else 2
    return Values(near, classes=("away from reversals", "reversals to forward", "reversals to backward"))


class _Joined:
    """Residuals of all parts, one after the other, and what their noise does to sums."""

    def __init__(self, residuals: Sequence[Residual]):
        self.parts = residuals
        self.torque = np.concatenate([one.torque for one in residuals])
        self.deviation = np.concatenate([one.deviation for one in residuals])
        ends = np.cumsum([0, *(len(one.time) for one in residuals)])
        self.slices = [slice(a, b) for a, b in itertools.pairwise(ends)]
        self.count = int(ends[-1])
        self.sizes = [2 ** int(np.ceil(np.log2(2 * len(one.time)))) for one in residuals]
        self.spectra = [
            [noise_spectrum(one.correlation**power, size) for one, size in zip(residuals, self.sizes, strict=True)]
            for power in (1, 2)
        ]
        # samples that count in a power: correlated ones count once
        widths = [2.0 * np.sum(one.correlation**2) - 1.0 for one in residuals]
        self.effective = sum(len(one.time) / max(width, 1.0) for one, width in zip(residuals, widths, strict=True))
        total = sum(one.time[-1] - one.time[0] for one in residuals)
        slowest = max(width * one.period for one, width in zip(residuals, widths, strict=True))
        length = max(total / _BLOCKS, 4.0 * slowest)
        self.block = np.empty(self.count, int)
        begun = 0
        for one, rows in zip(residuals, self.slices, strict=True):
            span = one.time[-1] - one.time[0]
            number = max(round(span / length), 1)
            along = (one.time - one.time[0]) / max(span, np.finfo(float).tiny)
            self.block[rows] = begun + np.minimum((along * number).astype(int), number - 1)
            begun += number
        self.blocks = begun

    @cached_property
    def z(self) -> float:
        """Significance of all power beyond the noise's."""
        power, noise = np.array([np.sum(self.torque**2)]), np.array([np.sum(self.deviation**2)])
        return float(_excess_z(power, noise, self.variance(np.ones((1, self.count)), 2))[0])

    def variance(self, masks: Array, power: int) -> Array:
        """Variance by noise of sums of residuals (1), or of their squares (2), over each of some sets of samples."""
        weights = self.deviation**power
        total = np.zeros(len(masks))
        for rows, size, spectrum in zip(self.slices, self.sizes, self.spectra[power - 1], strict=True):
            square = np.abs(np.fft.rfft(masks[:, rows] * weights[rows], size)) ** 2
            # the ends of a real signal's spectrum count once, all else twice
            counted = 2.0 * (square @ spectrum) - square[:, 0] * spectrum[0] - square[:, -1] * spectrum[-1]
            total += counted / size
        return power * total


def _excess_z(power: Array, noise: Array, variance: Array) -> Array:
    """Significance of sums of squares beyond the noise's, whose variance is given (Wilson and Hilferty)."""
    noise = np.where(noise > 0.0, noise, 1.0)
    small = (variance / noise**2 + (2.0 * _LEVEL_UNKNOWN) ** 2) / 9.0
    return (np.cbrt(power / noise) - (1.0 - small)) / np.sqrt(small)


def locate(residuals: Sequence[Residual], coordinates: Sequence[Mapping[str, Values]], *, floor: float = 0.0) -> Localised:
    """Where the missing torque of one equation lives.

    Of several low-passes the one is taken behind which the power stands out most from the noise.

    Args:
        residuals: of each part of the record.
        coordinates: of each, the more telling of equals first (:func:`coordinates_of`).
        floor: torque below which nothing is said to be missing, N m.
    """
    widest = max(one.bandwidth for one in residuals)
    shortest = min(one.time[-1] - one.time[0] for one in residuals)
    best: tuple[float, _Joined, list[Array]] | None = None
    for octave in range(7):
        cutoff = widest / 2.0**octave
        if cutoff * shortest < 20.0 and best is not None:
            break
        pairs = [narrowed(one, cutoff) for one in residuals]
        joined = _Joined([low for low, _ in pairs])
        z = joined.z
        # a wider one shows more: a narrower one must be worth it
        if best is None or z > 1.15 * max(best[0], SIGNIFICANT):
            best = z, joined, [at for _, at in pairs]
        if np.sum(joined.torque**2) > _CLEAR * np.sum(joined.deviation**2):
            break
    assert best is not None
    z, joined, at = best
    names = [name for name in coordinates[0] if all(name in one for one in coordinates)]
    values = {
        name: coordinates[0][name]._replace(
            values=np.concatenate([one[name].values[rows] for one, rows in zip(coordinates, at, strict=True)])
        )
        for name in names
    }
    power, noise = float(np.sum(joined.torque**2)), float(np.sum(joined.deviation**2))
    excess = max(power - noise, _LEVEL_UNKNOWN * noise)
    found = {name: _over(name, one, joined, excess) for name, one in values.items()}
    longest = int(np.argmax([len(one.time) for one in residuals]))
    motion = coordinates[longest]["speed"].values if "speed" in names else None
    bands, peaks = _spectrum(residuals[longest], motion, joined.parts[longest])
    missing = float(np.sqrt(max(power - noise, 0.0) / joined.count))
    beyond = (z > SIGNIFICANT and missing > floor) or any(
        (abs(region.mean_z) > SIGNIFICANT and abs(region.mean) > floor)
        or (region.excess_z > SIGNIFICANT and region.excess > floor**2)
        for one in found.values()
        for region in one.regions
    )
    beyond = beyond or any(one.excess_z > SIGNIFICANT and one.amplitude > floor for one in peaks)
    return Localised(
        residuals[0].name, joined.parts[0].bandwidth, float(np.sqrt(power / joined.count)),
        float(np.sqrt(noise / joined.count)), missing, z, bool(beyond), found, bands, peaks,
    )  # fmt: skip


def _edges(values: Array, count: int, by_time: bool) -> Array:
    """Ends of bins: equal numbers of samples in each; for time and turns equal widths."""
    low, high = float(np.min(values)), float(np.max(values))
    if by_time or high <= low:
        return np.linspace(low, max(high, np.nextafter(low, np.inf)), count + 1)
    edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, count + 1)))
    return edges if len(edges) > 1 else np.array([low, high])


def _over(name: str, one: Values, joined: _Joined, excess: float) -> Coordinate:
    even = name == "time" or name.endswith("turn")
    if one.classes:
        labels, edges, index = list(one.classes), None, np.asarray(one.values)
        count = len(labels)
    else:
        edges = _edges(one.values, _BINS, even)
        if name == "|speed|":
            # finer where it is slow
            shares = np.concatenate([[0.0, 0.01, 0.025, 0.05, 0.075], np.linspace(0.1, 1.0, 19)])
            edges = np.unique(np.quantile(one.values, shares))
        labels, count = [""] * (len(edges) - 1), len(edges) - 1
        index = np.clip(np.searchsorted(edges, one.values, "right") - 1, 0, count - 1)
    masks = (index[None, :] == np.arange(count)[:, None]).astype(float)
    number = np.maximum(masks.sum(axis=1), 1.0)
    power, noise = masks @ joined.torque**2, masks @ joined.deviation**2
    z = _excess_z(power, noise, joined.variance(masks, 2))
    mean = (masks @ joined.torque) / number
    error, mean_z = _mean_error(joined, index, count, mean, number, np.sqrt(joined.variance(masks, 1)) / number, name)
    regions = tuple(
        Region(
            labels[i], None if edges is None else float(edges[i]), None if edges is None else float(edges[i + 1]),
            float(number[i] / joined.count), float((power[i] - noise[i]) / excess), float((power[i] - noise[i]) / number[i]),
            float(z[i]), float(mean[i]), float(error[i]), float(mean_z[i]),
        )
        for i in range(count)
        if masks[i].any()
    )  # fmt: skip
    return Coordinate(name, one.unit, one.symbol, regions, _explained(name, one, joined, excess, even))


def _mean_error(
    joined: _Joined, index: Array, count: int, mean: Array, number: Array, by_noise: Array, name: str
) -> tuple[Array, Array]:
    """Standard errors of the means over bins, and how many of them each mean is away from zero."""
    if name == "time":
        # each moment comes but once
        return by_noise, mean / np.maximum(by_noise, np.finfo(float).tiny)
    cell = joined.block * count + index
    size = joined.blocks * count
    sums, numbers = (
        np.bincount(cell, weights, minlength=size).reshape(joined.blocks, count) for weights in (joined.torque, None)
    )
    visits = np.sum(numbers > 0, axis=0)
    # blocks with few samples of a bin are no block of their own
    weight = np.sum(numbers, axis=0) ** 2 / np.maximum(np.sum(numbers.astype(float) ** 2, axis=0), 1.0)
    freedom = np.maximum(weight - 1.0, 0.5)
    scatter = np.sum((sums - mean * numbers) ** 2, axis=0) * (freedom + 1.0) / freedom
    by_scatter = np.sqrt(scatter) / number
    square = np.bincount(index, joined.torque**2, minlength=count)[:count] / number
    enough = (visits >= _FEWEST) & (weight >= 0.75 * _FEWEST)
    by_scatter = np.where(enough, by_scatter, np.maximum(by_scatter, np.sqrt(square)))
    error = np.maximum(np.maximum(by_noise, by_scatter), np.finfo(float).tiny)
    t = mean / error
    # Wallace: Student's t as a normal number
    normal = np.sign(t) * (8.0 * freedom + 1.0) / (8.0 * freedom + 3.0) * np.sqrt(freedom * np.log1p(t**2 / freedom))
    return error, np.where(by_noise >= by_scatter, t, normal)


def _folds(joined: _Joined, name: str, count: int) -> Array:
    """To which fold each sample belongs; over time, whose moments do not come again, each bin is parted among the folds."""
    if name != "time":
        return joined.block % _FOLDS
    fold = np.empty(joined.count, int)
    for one, rows in zip(joined.parts, joined.slices, strict=True):
        along = (one.time - one.time[0]) / (one.time[-1] - one.time[0])
        fold[rows] = (along * count * _FOLDS).astype(int) % _FOLDS
    return fold


def _explained(name: str, one: Values, joined: _Joined, excess: float, even: bool) -> float:
    if joined.z < SIGNIFICANT:
        # nothing to be shared out
        return 0.0
    best = 0.0
    counts = [len(one.classes)] if one.classes else [n for n in _COUNTS if n <= max(joined.effective / 10.0, 2.0)]
    if name == "time":
        counts = [n for n in counts if n * _FOLDS <= max(joined.effective / 10.0, 10.0)]
    for count in counts:
        if one.classes:
            index, bins = np.asarray(one.values), count
        else:
            edges = _edges(one.values, count, even)
            bins = len(edges) - 1
            index = np.clip(np.searchsorted(edges, one.values, "right") - 1, 0, bins - 1)
        fold = _folds(joined, name, bins)
        cell = fold * bins + index
        sums, numbers = (
            np.bincount(cell, weights, minlength=_FOLDS * bins).reshape(_FOLDS, bins) for weights in (joined.torque, None)
        )
        others = np.sum(numbers, axis=0) - numbers
        predicted = ((np.sum(sums, axis=0) - sums) / np.maximum(others, 1))[fold, index]
        gained = np.sum(joined.torque**2) - np.sum((joined.torque - predicted) ** 2)
        best = max(best, float(gained))
    return min(best / excess, 1.0)


def _spectrum(one: Residual, speed: Array | None, low: Residual) -> tuple[tuple[Band, ...], tuple[Peak, ...]]:
    """Bands and narrow peaks in the spectrum of a part; shares are of the power that its low-passed version shows."""
    frequency, power, floor = spectrum_of(one)
    count, resolution = len(one.time), frequency[1]
    seen = frequency <= 2.0 * one.bandwidth
    frequency, power, floor = frequency[seen], power[seen], np.maximum(floor[seen], 1e-12 * np.max(floor))
    beyond = power - floor
    total = float(np.sum(low.torque**2) - np.sum(low.deviation**2)) / len(low.time) * count
    total = max(total, _LEVEL_UNKNOWN * float(np.sum(one.deviation**2)))
    edges = one.bandwidth * 2.0 ** np.arange(-9.0, 2.0)
    edges = np.concatenate([[0.0], edges[edges > 4.0 * resolution]])
    bands = []
    for begin, end in itertools.pairwise(edges):
        inside = (frequency >= begin) & (frequency < end)
        if np.count_nonzero(inside) < 2:
            continue
        level = np.array([np.sum(floor[inside])])
        # neighbours of a Hann window share 1.5 bins
        z = _excess_z(np.array([np.sum(power[inside])]), level, np.array([1.5 * np.sum(floor[inside] ** 2)]))
        bands.append(Band(float(begin), float(end), float(np.sum(beyond[inside])) / total, float(z[0])))
    motion = None
    if speed is not None:
        moving = np.asarray(speed) - np.mean(speed)
        motion = np.abs(np.fft.rfft(moving * np.hanning(count))) ** 2
    peaks: list[Peak] = []
    taken = np.arange(len(power)) < 3
    for at in np.argsort(-power):
        if len(peaks) == _PEAKS:
            break
        if taken[at]:
            continue
        near = slice(max(at - 2, 0), at + 3)
        taken[near] = True
        # a line of noise is exponential: so many times its mean is the largest of all
        z = float(np.sqrt(max(2.0 * (power[at] / (1.1 * floor[at]) - np.log(len(power))), 0.0)))
        if z < SIGNIFICANT or power[at] < _NARROW * _around(power, at):
            continue
        here = float(np.sum(np.maximum(beyond[near], 0.0)))
        share = here / max(total, here)
        moved = motion is not None and float(np.sum(motion[near]) / np.sum(motion)) > 0.2 * share
        peaks.append(Peak(float(frequency[at]), float(np.sqrt(2.0 * here / count)), share, z, moved))
    return tuple(bands), tuple(peaks)


def _around(power: Array, at: int) -> float:
    low, high = max(at - _AROUND, 0), min(at + _AROUND + 1, len(power))
    rows = np.r_[low : max(at - 3, low), min(at + 4, high) : high]
    return float(np.median(power[rows])) if len(rows) else float("inf")


def spectrum_of(residual: Residual) -> tuple[Array, Array, Array]:
    """Frequencies (Hz), power of a residual in each of them, and its noise's; the powers add up to the sum of squares."""
    count = len(residual.time)
    window = np.hanning(count)
    window = window / np.sqrt(np.mean(window**2))
    frequency = np.fft.rfftfreq(count, residual.period)
    once = np.full(len(frequency), 2.0)
    once[0] = 1.0
    power = once * np.abs(np.fft.rfft(residual.torque * window)) ** 2 / count
    size = 2 ** int(np.ceil(np.log2(max(2 * len(residual.correlation), count))))
    density = noise_spectrum(residual.correlation, size)
    grid = np.linspace(0.0, 0.5 / residual.period, len(density))
    floor = once * np.mean(residual.deviation**2) * np.interp(frequency, grid, density)
    return frequency, power, floor


_PLACE = {
    _EVERYWHERE: "alike everywhere",
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


def describe(found: Localised, unit: str = "N m") -> str:
    """One sentence: which equation, where, and how much of the residual power lies there."""
    side = found.name if found.name == "transmission" else f"{found.name} side"
    if not found.significant:
        return f"{side}: nothing beyond noise ({found.noise:.2g} {unit} rms up to {found.bandwidth:.3g} Hz)"
    size = f"{found.missing:.2g} {unit} rms"
    best = max((one.explained for one in found.coordinates.values()), default=0.0)
    telling = next((one for one in found.coordinates.values() if one.explained >= best - _SIMPLER), None)
    crowd = _crowded(found)
    clauses = []
    if crowd is not None and (best < _TELLING or crowd[0] > 0.6):
        clauses.append(crowd[1])
    own = [one for one in found.peaks if not one.in_motion]
    if own and own[0].power_share > max(best, _TELLING) - _SIMPLER:
        clauses.append(
            f"at {own[0].frequency:.4g} Hz; {_percent(own[0].power_share)} of the residual power is a narrow peak there"
        )
    elif telling is not None and best >= _TELLING:
        values = _values(telling, unit)
        place = _PLACE.get(telling.name, f"a function of {telling.name}")
        clauses.append(f"{place}{values}; {_percent(telling.explained)} of the residual power goes with it")
    if not clauses and found.excess_z < SIGNIFICANT:
        return f"{side}, {_faint(found, unit)}"
    if not clauses:
        hint = ""
        if telling is not None and best > 0.1:
            hint = f" (most: {_percent(best)}, {_PLACE.get(telling.name, telling.name)})"
        clauses.append(f"nowhere in particular: neither speed nor position, load or time explains half of it{hint}")
    return f"{side}, {'; '.join(clauses)} ({size})"


def _faint(found: Localised, unit: str) -> str:
    """The region that stands out most where the whole does not."""
    each = [(one, region) for one in found.coordinates.values() for region in one.regions]
    one, region = max(each, key=lambda pair: max(abs(pair[1].mean_z), pair[1].excess_z))
    z = max(abs(region.mean_z), region.excess_z)
    if found.peaks and found.peaks[0].excess_z > z:
        peak = found.peaks[0]
        return f"faint: a narrow peak of {peak.amplitude:.2g} {unit} at {peak.frequency:.4g} Hz"
    place = region.label or f"where {region.low:.3g} < {one.symbol or one.name} < {region.high:.3g} {one.unit}".rstrip()
    if abs(region.mean_z) >= region.excess_z:
        return f"faint: {region.mean:+.2g} ± {region.mean_error:.1g} {unit} on average {place}"
    return f"faint: {np.sqrt(max(region.excess, 0.0)):.2g} {unit} rms beyond noise {place}"


def _percent(share: float) -> str:
    return f"{100.0 * min(share, 1.0):.0f} %"


def _values(coordinate: Coordinate, unit: str) -> str:
    """Mean torques of the few classes of a coordinate."""
    shown = [one for one in coordinate.regions if one.label and abs(one.mean_z) > 3.0]
    return f" ({', '.join(f'{one.mean:+.2g} {unit} {one.label}' for one in shown)})" if shown else ""


def _crowded(found: Localised) -> tuple[float, str] | None:
    """The region that holds much of the power in little of the time, and how it is told."""
    best: tuple[float, str] | None = None
    for one in found.coordinates.values():
        if one.name in (_EVERYWHERE, "direction", "input", "acceleration", "twist rate"):
            continue
        power, time = (np.array([getattr(r, key) for r in one.regions]) for key in ("power_share", "time_share"))
        z = np.array([r.excess_z for r in one.regions])
        if one.name == "reversals":
            near = np.array([r.label.startswith("reversals") for r in one.regions])
            groups = [near] if near.any() else []
        elif any(r.label for r in one.regions):
            groups = [np.arange(len(power)) == i for i in range(len(power))]
        else:
            numbers = np.arange(len(power))
            groups = [(numbers >= i) & (numbers <= j) for i in range(len(power)) for j in range(i, len(power))]
        for rows in groups:
            held, spent = float(power[rows].sum()), float(time[rows].sum())
            score = held - spent
            if held < 0.6 or held < 2.0 * spent or score < _CROWDED or np.max(z[rows]) < SIGNIFICANT:
                continue
            # of regions that hold as much, the simpler coordinate's
            if best is None or score > best[0] + _SIMPLER:
                best = score, f"{_told(one, rows)}"
    return best


def _told(coordinate: Coordinate, rows: Array) -> str:
    chosen = [one for one, taken in zip(coordinate.regions, rows, strict=True) if taken]
    share = _percent(sum(one.power_share for one in chosen))
    if chosen[0].label:
        if coordinate.name == "reversals":
            return f"at speed reversals; {share} of the residual power lies near them"
        return f"{chosen[0].label}; {share} of the residual power lies there"
    low, high = chosen[0].low, chosen[-1].high
    unit = f" {coordinate.unit}" if coordinate.unit else ""
    symbol = coordinate.symbol or coordinate.name
    if coordinate.name == "|speed|" and rows[0]:
        return f"at low speed; {share} of the residual power lies where {symbol} < {high:.2g}{unit}"
    if coordinate.name == "|speed|" and rows[-1]:
        return f"at high speed; {share} of the residual power lies where {symbol} > {low:.2g}{unit}"
    if coordinate.name == "time":
        return f"for a while; {share} of the residual power lies between {low:.4g} and {high:.4g} s"
    return f"at a place; {share} of the residual power lies where {low:.3g} < {symbol} < {high:.3g}{unit}"


def where(
    experiment: Experiment,
    residuals: Mapping[str, Sequence[Residual]],
    parts: Sequence[Kinematics],
    smoothed: Sequence[Mapping[str, Smoothed]],
    *,
    rotating: bool | Mapping[str, bool] = True,
) -> dict[str, Localised]:
    """Where each equation's missing torque lives, by equation (:func:`jaxbl.diagnosis.residuals.residual_torques`)."""
    found = {}
    balance = eqx.filter_jit(regression.balance)
    for name, pieces in residuals.items():
        coordinates = [
            coordinates_of(experiment, part, channels, one, rotating=rotating)
            for part, channels, one in zip(parts, smoothed, pieces, strict=True)
        ]
        driving = np.concatenate([np.asarray(balance(experiment, part)[name].drive) for part in parts])
        found[name] = locate(pieces, coordinates, floor=RESOLUTION * float(np.sqrt(np.mean(driving**2))))
    return found


def as_json(found: Mapping[str, Localised]) -> dict[str, Any]:
    """What was found, as plain dicts, lists and numbers, each with its sentence."""
    return {name: dataclasses.asdict(one) | {"sentence": describe(one)} for name, one in found.items()}
