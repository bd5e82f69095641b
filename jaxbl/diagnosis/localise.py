"""Where a model lacks torque: over time, speed, position, reversals, gap, load and frequency, each with its significance.

Two questions are asked of each region. How much of the residual's power beyond the noise lies there: judged against the
noise alone, and as many independent samples as its spectrum leaves. And is the mean torque there other than zero: judged
against the scatter of the means of blocks of time, so that a slow disturbance that the noise level does not know of is no
finding; over time, where each moment comes but once, against the noise. How much of the power a function of one
coordinate explains is counted on blocks of time that it was not made from.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import find_peaks, periodogram
from scipy.special import diric

from jaxbl.chain import Experiment
from jaxbl.estimation.segments import Segment
from jaxbl.records.least_squares import as_normal

from .coordinates import CoordinateValues
from .linearised_model import find_driving_torque
from .residuals import Residual, SideResiduals, mean_density, narrow
from .thresholds import LIMITS

_BINS = 24
"""Of a coordinate: fine enough for a picture, each with a few per cent of the samples."""
_SLOW_SHARES = np.concatenate([[0.0, 0.01, 0.025, 0.05, 0.075], np.linspace(0.1, 1.0, 19)])
"""Shares of the samples below the ends of bins of the size of the speed: finer where it is slow."""
_COUNTS = (2, 4, 8, 16, 32, 64, 128)
"""Numbers of bins that functions of a coordinate are tried with."""
_BLOCKS, _FOLDS = 40, 5
"""Blocks of time, and sets of them that a function is made from and tried on in turn."""
_LEAST_BLOCKS = 4
"""Blocks of time that a mean must come from to have a scatter."""
_LEVEL_UNKNOWN = 0.05
"""Relative uncertainty of the noise's deviation."""
_RESOLUTION = 5e-4
"""Share of the driving torque below which sampling alone may be what is missing."""
_NARROWER = 1.15
"""Factor by which the power behind a narrower low-pass must stand out more."""
_SHORTEST, _IN_A_BIN = 20.0, 10.0
"""Cycles at the low-pass in a part at least; independent values in a bin."""
_LOUD = 10.0
"""Power over the noise's from which on no narrower low-pass is tried."""
_PEAKS, _NARROW, _AROUND = 5, 10.0, 41
"""Peaks at most; power of one over the median around it; frequencies of that median."""
_WAVES = 4096
"""Frequencies that the noise of a mean over some time is summed over."""
_SLOWEST, _MOVED = 3, 0.2
"""First frequency of a spectrum that may be a peak; share of a peak that the motion has there, too, if it is its own."""
_LEAST_WEIGHT = 3.0
"""Blocks of equal length that those of a bin are worth at least."""


@dataclass(frozen=True)
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


@dataclass(frozen=True)
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


@dataclass(frozen=True)
class SpectralPeak:
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


@dataclass(frozen=True)
class Localised:
    """A place where one side lacks torque. Numbers only: `dataclasses.asdict` makes it JSON.

    Attributes:
        name: of the side.
        bandwidth: of what is looked at, Hz.
        noise: rms within it, N m.
        missing: rms beyond the noise, N m.
        excess_z: its significance.
        significant: whether there is anything beyond noise, as a whole or in a region.
        coordinates: by name.
        peaks: of the spectrum.
    """

    name: str
    bandwidth: float
    noise: float
    missing: float
    excess_z: float
    significant: bool
    coordinates: dict[str, Coordinate]
    peaks: tuple[SpectralPeak, ...]


class _Joined:
    """Residuals of all parts, one after the other, and blocks of time."""

    def __init__(self, residuals: Sequence[Residual]):
        self.parts = residuals
        self.torque = np.concatenate([residual.torque for residual in residuals])
        self.deviation = np.concatenate([residual.deviation for residual in residuals])
        self.count, self.power, self.noise = len(self.torque), np.sum(self.torque**2), np.sum(self.deviation**2)
        # samples that count in a power: correlated ones count once
        widths = [mean_density(part.density**2) / mean_density(part.density) ** 2 for part in residuals]
        self.effective = sum(len(part.time) / width for part, width in zip(residuals, widths, strict=True))
        slowest = max(width * part.period for part, width in zip(residuals, widths, strict=True))
        length = max(sum(_span(part) for part in residuals) / _BLOCKS, 4.0 * slowest)
        blocks = [_divide(part, max(round(_span(part) / length), 1)) for part in residuals]
        begun = np.cumsum([0, *(part[-1] + 1 for part in blocks)])
        self.block, self.blocks = np.concatenate([begun[i] + part for i, part in enumerate(blocks)]), int(begun[-1])

    @property
    def z(self) -> float:
        """Significance of all power beyond the noise's."""
        return float(self.excess_z(np.ones((1, self.count)))[0])

    def excess_z(self, masks: np.ndarray) -> np.ndarray:
        """Significance of power beyond the noise's in each of some sets of samples (Wilson and Hilferty)."""
        # of a set without samples nothing is used
        noise = np.where(masks.any(axis=1), masks @ self.deviation**2, 1.0)
        variance = 2.0 * (masks @ self.deviation**4) * self.count / self.effective
        small = (variance / noise**2 + (2.0 * _LEVEL_UNKNOWN) ** 2) / 9.0
        return (np.cbrt(masks @ self.torque**2 / noise) - (1.0 - small)) / np.sqrt(small)


def _span(residual: Residual) -> float:
    return residual.time[-1] - residual.time[0]


def _divide(residual: Residual, count: int) -> np.ndarray:
    """Number of the piece of time of each sample, of so many that are as long."""
    along = (residual.time - residual.time[0]) / max(_span(residual), np.finfo(float).tiny)
    return np.minimum((along * count).astype(int), count - 1)


def locate(
    residuals: Sequence[Residual], coordinates: Sequence[Mapping[str, CoordinateValues]], *, floor: float = 0.0
) -> Localised:
    """Locate where one side lacks torque.

    Of several low-passes the one is taken behind which the power stands out most from the noise. Below the torque `floor`
    (N m) nothing is said to be missing.
    """
    widest = max(residual.bandwidth for residual in residuals)
    shortest = min(map(_span, residuals))
    best: tuple[_Joined, list[np.ndarray]] | None = None
    for octave in range(7):
        cutoff = widest / 2.0**octave
        if cutoff * shortest < _SHORTEST and best is not None:
            break
        pairs = [narrow(residual, cutoff) for residual in residuals]
        joined = _Joined([low for low, _ in pairs])
        # a wider one shows more: a narrower one must be worth it
        if best is None or joined.z > _NARROWER * max(best[0].z, LIMITS.significant):
            best = joined, [rows for _, rows in pairs]
        if joined.power > _LOUD * joined.noise:
            break
    assert best is not None
    joined, rows_of = best
    names = [name for name in coordinates[0] if all(name in values_of for values_of in coordinates)]
    power, noise, z = joined.power, joined.noise, joined.z
    excess = max(power - noise, _LEVEL_UNKNOWN * noise)
    over = {}
    for name in names:
        values = [values_of[name].values[rows] for values_of, rows in zip(coordinates, rows_of, strict=True)]
        over[name] = _over_coordinate(name, coordinates[0][name]._replace(values=np.concatenate(values)), joined, excess)
    longest = int(np.argmax([len(residual.time) for residual in residuals]))
    peaks = _find_peaks(residuals[longest], coordinates[longest]["speed"].values, float(np.sqrt(excess / joined.count)))
    missing = float(np.sqrt(max(power - noise, 0.0) / joined.count))
    regions = [region for coordinate in over.values() for region in coordinate.regions]
    torques = [
        (z, missing),
        *((abs(region.mean_z), abs(region.mean)) for region in regions),
        *((region.excess_z, max(region.excess, 0.0) ** 0.5) for region in regions),
        *((peak.excess_z, peak.amplitude) for peak in peaks),
    ]
    beyond = any(significance > LIMITS.significant and torque > floor for significance, torque in torques)
    return Localised(
        residuals[0].name, joined.parts[0].bandwidth, float(np.sqrt(noise / joined.count)), missing, z, beyond, over,
        peaks,
    )  # fmt: skip


def _bin_samples(name: str, coordinate: CoordinateValues, shares: np.ndarray) -> tuple[np.ndarray | None, np.ndarray, int]:
    """Ends of bins, the bin of each sample, and the number of bins; a class is a bin without ends.

    Bins hold shares of the samples, those of time and turns shares of the width.
    """
    if coordinate.classes:
        return None, coordinate.values, len(coordinate.classes)
    low, high = float(np.min(coordinate.values)), float(np.max(coordinate.values))
    if name == "time" or name.endswith("turn") or high <= low:
        edges = np.linspace(low, max(high, np.nextafter(low, np.inf)), len(shares))
    else:
        edges = np.unique(np.quantile(coordinate.values, shares))
    return edges, np.digitize(coordinate.values, edges[1:-1]), len(edges) - 1


def _over_coordinate(name: str, values_of: CoordinateValues, joined: _Joined, excess: float) -> Coordinate:
    edges, index, count = _bin_samples(
        name, values_of, _SLOW_SHARES if name == "|speed|" else np.linspace(0.0, 1.0, _BINS + 1)
    )
    masks = (index[None, :] == np.arange(count)[:, None]).astype(float)
    number = np.maximum(masks.sum(axis=1), 1.0)
    mean = (masks @ joined.torque) / number
    error, mean_z = _mean_error(joined, index, count, mean, number, name)
    z, beyond = joined.excess_z(masks), masks @ (joined.torque**2 - joined.deviation**2)
    labels = values_of.classes or ("",) * count
    ends = [(None, None)] * count if edges is None else list(itertools.pairwise(edges.tolist()))
    numbers = np.stack([number / joined.count, beyond / excess, beyond / number, z, mean, error, mean_z], axis=1).tolist()
    regions = tuple(Region(labels[i], *ends[i], *numbers[i]) for i in range(count) if masks[i].any())
    return Coordinate(name, values_of.unit, values_of.symbol, regions, _explained_share(name, values_of, joined, excess))


def _mean_error(
    joined: _Joined, index: np.ndarray, count: int, mean: np.ndarray, number: np.ndarray, name: str
) -> tuple[np.ndarray, np.ndarray]:
    """Standard errors of the means over bins, by the scatter of blocks, and how many of them each mean is away from zero."""
    if name == "time":
        # each moment comes but once: by the noise that remains in a mean over so many samples
        wave = np.linspace(1e-9, np.pi, _WAVES)
        densities = np.mean([part.density_at(wave) / mean_density(part.density) for part in joined.parts], axis=0)
        square = np.bincount(index, joined.deviation**2, count) / number
        error = np.sqrt(square * [mean_density(densities * diric(wave, n) ** 2) for n in number])
        return error, mean / np.maximum(error, np.finfo(float).tiny)
    sums, numbers = _sums(joined.torque, joined.block, joined.blocks, index, count)
    # blocks with few samples of a bin are no block of their own
    weight = np.sum(numbers, axis=0) ** 2 / np.maximum(np.sum(numbers.astype(float) ** 2, axis=0), 1.0)
    freedom = np.maximum(weight - 1.0, 0.5)
    scatter = np.sqrt(np.sum((sums - mean * numbers) ** 2, axis=0) * (freedom + 1.0) / freedom) / number
    size = np.sqrt(np.bincount(index, joined.torque**2, count) / number)
    enough = (np.sum(numbers > 0, axis=0) >= _LEAST_BLOCKS) & (weight >= _LEAST_WEIGHT)
    error = np.maximum(np.where(enough, scatter, np.maximum(scatter, size)), np.finfo(float).tiny)
    return error, as_normal(mean / error, freedom)


def _sums(torque: np.ndarray, row: np.ndarray, rows: int, index: np.ndarray, bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Sums over the samples of each row (block or fold) and bin, and their numbers; shape (rows, bins)."""
    cell = row * bins + index
    sums, numbers = (np.bincount(cell, weights, rows * bins).reshape(rows, bins) for weights in (torque, None))
    return sums, numbers


def _explained_share(name: str, values_of: CoordinateValues, joined: _Joined, excess: float) -> float:
    if joined.z < LIMITS.significant:
        # nothing to be shared out
        return 0.0
    best, least = 0.0, _FOLDS if name == "time" else 1
    counts = [n for n in _COUNTS if n * least <= max(joined.effective / _IN_A_BIN, 2 * least)]
    for count in [1] if values_of.classes else counts:
        _, index, bins = _bin_samples(name, values_of, np.linspace(0.0, 1.0, count + 1))
        piece = joined.block
        if name == "time":
            # moments do not come again: each bin is parted among the folds
            piece = np.concatenate([_divide(part, bins * _FOLDS) for part in joined.parts])
        fold = piece % _FOLDS
        sums, numbers = _sums(joined.torque, fold, _FOLDS, index, bins)
        other_counts = np.sum(numbers, axis=0) - numbers
        predicted = ((np.sum(sums, axis=0) - sums) / np.maximum(other_counts, 1))[fold, index]
        gained = joined.power - np.sum((joined.torque - predicted) ** 2)
        best = max(best, float(gained))
    return min(best / excess, 1.0)


def _find_peaks(residual: Residual, speed: np.ndarray, missing: float) -> tuple[SpectralPeak, ...]:
    """Find narrow peaks in the spectrum of a part; shares are of the square of the torque that is `missing`, N m."""
    frequency, power = _spectrum(residual.torque, residual.period)
    audible = frequency <= 2.0 * residual.bandwidth
    frequency, power = frequency[audible], power[audible]
    density = residual.density_at(2.0 * np.pi * frequency * residual.period) / mean_density(residual.density)
    floor = np.mean(residual.deviation**2) * density * 2.0 / len(residual.time)
    floor = np.maximum(floor, 1e-12 * np.max(floor))
    motion = _spectrum(speed, residual.period)[1][audible]
    # a line of noise is exponential: so many times its mean is the largest of all
    z = np.sqrt(np.maximum(2.0 * (power / (1.1 * floor) - np.log(len(power))), 0.0))
    stands_out = (z > LIMITS.significant) & (power > _NARROW * median_filter(power, _AROUND))
    stands_out[:_SLOWEST] = False
    peaks, _ = find_peaks(np.where(stands_out, power, 0.0), distance=3)
    loudest = []
    for peak in peaks[np.argsort(-power[peaks])][:_PEAKS]:
        near = slice(max(peak - 2, 0), peak + 3)
        here = float(np.sum(np.maximum(power - floor, 0.0)[near]))
        share = here / max(missing**2, here)
        moved = bool(np.sum(motion[near]) > _MOVED * share * np.sum(motion))
        loudest.append(SpectralPeak(float(frequency[peak]), float(np.sqrt(2.0 * here)), share, float(z[peak]), moved))
    return tuple(loudest)


def _spectrum(values: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies, Hz, and mean square of a signal about its mean in each of them."""
    frequency, density = periodogram(values, 1.0 / period, "hann")
    return frequency, density * (frequency[1] - frequency[0])


def localise(
    experiment: Experiment,
    residuals: SideResiduals,
    segments: Sequence[Segment],
    coordinates: Mapping[str, Sequence[Mapping[str, CoordinateValues]]],
) -> dict[str, Localised]:
    """Locate where each side lacks torque, by its residuals (:func:`.residuals.residual_torques`), segment by segment, and
    the coordinates along them (:func:`.coordinates.all_coordinates`)."""
    driving, _ = find_driving_torque(experiment, segments)
    return {
        side: locate(pieces, coordinates[side], floor=_RESOLUTION * driving * float(experiment.drive.ratio(side)))
        for side, pieces in residuals.items()
    }
