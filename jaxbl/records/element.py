"""A transmission alone on a test rig: stiffness, gap, friction and hysteresis from torque over displacement.

    u = K d + D dd/dt + T h + F s + mu |K d| s + u_0,   d = (x - x_0) - clip(x - x_0, -b, b)

with the displacement x of one side against the other, the half gap b, the direction of motion s = +-1, which stays the same
at rest, and Bouc and Wen's hysteresis dh/dd = 1 / length while h returns to 0, (1 - h²) / length while it grows (as in the
package's effect). There are no masses and no nominal numbers in it. Where play, spring and slip in series say more (a band
on a pulley), x_0 is dragged along as soon as the spring is wound up by `windup`: the torque is at most K windup.

All numbers except x_0, b and the length are linear: they follow by least squares from a choice of these three (variable
projection: G. Golub, V. Pereyra, SIAM J. Numer. Anal. 10, 1973). A term stays in the model if it lowers the squared error on
blocks of the log to which its size was not fitted.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from jaxbl.quantity import Quantity
from jaxbl.units import on_a_line

from .least_squares import BlockRegression, column_rms, fit_residual, fit_with_jackknife, mean_error, rms, student_interval
from .signal_quality import MIN_SAMPLES, count_samples, find_motion_bandwidth, low_pass, slices_between

_MAX_SAMPLES = 20_000
"""Samples that are fitted; of longer logs, means. A few hundred describe a loop of torque over displacement."""
_MIN_MEANS = 8
"""Least number of means in a segment: fewer hardly cover a motion to and fro, and their slopes are uncertain."""
_CUTOFF_RATIO = 20.0
"""Cutoff of the low-pass on the displacement, over its bandwidth: corners of a triangle stay sharp."""
_SAMPLES_PER_PERIOD = 100
"""Least number of means in a period at the bandwidth of the motion."""
_START_SAMPLES = 3_000
"""Samples on which starts are compared."""
_FOLDS = 10
"""Parts of the log for cross-validation."""
_SURE_ERRORS = 3.0
"""Standard errors by which a term must lower the squared error: one chance in a thousand for each of five terms."""
_MAX_RELATIVE_ERROR = 0.5
"""Relative standard error from which on a number counts as open; as in `jaxbl identify`."""
_REVERSAL_NOISE = 6.0
"""Rms noises of the displacement that a reversal has to exceed: white noise over the length of a log does not."""
_SHAPE_STARTS = {
    "centre": (-0.5, -0.2, 0.0, 0.2, 0.5),
    "half_gap": (0.02, 0.1, 0.3, 0.5, 0.7),
    "length": (0.02, 0.06, 0.2, 0.6),
    "windup": (0.02, 0.06, 0.2, 0.6),
}
"""Nonlinear number -> where searches start, over half the range of the displacement; the centre from the middle of it."""
_SHAPE_BOUNDS = {"centre": (-1.0, 1.0), "half_gap": (0.0, 1.0), "length": (1e-4, 10.0), "windup": (1e-4, 1.0)}
"""Bounds of the search, likewise."""
_SERIES = "gap", "slip"
"""Terms of play, spring and slip in series."""

TERMS = ("gap", "damping", "dry friction", "hysteresis", "friction under load")
"""Terms of a transmission beside its stiffness."""
_SHAPES_BY_TERM = {"gap": ("centre", "half_gap"), "hysteresis": ("length",), "friction under load": ("centre",),
                   "slip": ("windup",)}  # fmt: skip
"""Term -> its nonlinear numbers."""
SIZE_NAMES = {
    "damping": "damping",
    "dry friction": "dry_friction",
    "hysteresis": "hysteresis",
    "friction under load": "friction_coefficient",
}
"""Term -> its linear number, by which it is multiplied."""


@dataclass(frozen=True)
class Element:
    """Model of a transmission, fitted to torque over displacement.

    Attributes:
        numbers: `stiffness`, `offset` (torque at displacement 0, or at the centre) and the numbers of the terms: `half_gap`,
            `centre` (displacement at the middle of the gap, or without torque), `damping`, `dry_friction`, `hysteresis`
            (its largest torque), `length`, `friction_coefficient` (friction under load, over the torque), `slip` (largest
            torque of a transmission that slips beyond it).
        open: names of the numbers that the log leaves uncertain by more than half.
        gains: term of the model -> squared error without it over that with it, less 1, on blocks that were left out.
        torque: of the model at each sample of the log, shape (samples,); NaN around reversals.
        residual: rms of measured minus modelled torque, N m (N).
        share: the same over the rms of the torque about its mean.
        reversals: number of reversals of the displacement.
        model: with the numbers as it uses them.
    """

    numbers: dict[str, Quantity]
    open: tuple[str, ...]
    gains: dict[str, float]
    torque: np.ndarray
    residual: float
    share: float
    reversals: int
    model: "Model"

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of `inspection.json`."""
        return {
            "numbers": {name: number.to_dict() for name, number in self.numbers.items()},
            "open": list(self.open),
            "gains": self.gains,
            "residual": self.residual,
            "share": self.share,
        }


class RigLog(NamedTuple):
    """Log of a transmission.

    Attributes:
        position: displacement of one side against the other, rad (m), shape (samples,).
        torque: through the transmission, N m (N), shape (samples,).
        segments: contiguous parts.
        period: of sampling, s.
        noise: of the displacement, rad (m) rms.
        unit: of the displacement, rad or m.
    """

    position: np.ndarray
    torque: np.ndarray
    segments: Sequence[slice]
    period: float
    noise: float
    unit: str = "rad"


@dataclass(frozen=True)
class _Rig:
    """Displacement and torque of a log, and signals that are the same for all models.

    Attributes:
        position: displacement as measured, shape (samples,): corners matter more than noise.
        rate: slope of the low-passed displacement, shape (samples,).
        blur: displacement within a sample, and by noise, rad (m), shape (samples,).
        direction: of motion, +1 or -1, shape (samples,).
        stretches: samples between reversals, in order, of all segments, each with True if it is the first of its segment.
        rows: samples that are fitted, after the first reversals of their segment.
        torque: N m (N), shape (samples,).
    """

    position: np.ndarray
    rate: np.ndarray
    blur: np.ndarray
    direction: np.ndarray
    stretches: list[tuple[slice, bool]]
    rows: np.ndarray
    torque: np.ndarray

    @property
    def half_range(self) -> float:
        return 0.5 * float(np.ptp(self.position))

    @property
    def fitted_torque(self) -> np.ndarray:
        return self.torque[self.rows]

    def compute_torque(self, model: "Model") -> np.ndarray:
        """Return the torque of a model, N m (N), shape (rows,)."""
        return self.compute_columns(model.terms, model.shapes) @ model.sizes

    def compute_error(self, model: "Model") -> tuple[float, float]:
        """Return the rms torque error of a model, N m (N), and the same over the rms of the torque about its mean."""
        error = rms(self.fitted_torque - self.compute_torque(model))
        return error, error / float(np.std(self.fitted_torque))

    def compute_columns(self, terms: Sequence[str], shapes: Mapping[str, float]) -> np.ndarray:
        """Return the torque per unit of stiffness, offset, and sizes of terms in order; shape (rows, linear numbers)."""
        x = self.position - shapes.get("centre", 0.0)
        b = shapes.get("half_gap", 0.0)
        if "slip" in terms:
            x = x - self._drag(b + shapes["windup"])
        deflection = x - np.clip(x, -b, b)
        # no damping inside the gap; a part of it in a sample that crosses an end of the gap
        contact = np.clip((np.abs(x) - b) / self.blur + 0.5, 0.0, 1.0) if "gap" in terms else 1.0
        signals = {
            "damping": self.rate * contact,
            "dry friction": self.direction,
            "friction under load": np.abs(deflection) * self.direction,
        }
        if "hysteresis" in terms:
            signals["hysteresis"] = self._compute_hysteresis(deflection, shapes["length"])
        columns = [deflection, np.ones(len(x)), *(signals[term] for term in terms if term in signals)]
        return np.stack([column[self.rows] for column in columns], axis=1)

    def _drag(self, reach: float) -> np.ndarray:
        """Return where the position has dragged what follows it at a distance of at most `reach`, shape (samples,)."""
        dragged, last = np.zeros(len(self.position)), 0.0
        for part, begins in self.stretches:
            forward = self.direction[part.start]
            # how it was wound up before is unknown: not at all errs least
            last = self.position[part.start] if begins else last
            ahead = np.maximum.accumulate(forward * self.position[part]) - reach
            dragged[part] = forward * np.maximum(ahead, forward * last)
            last = dragged[part.stop - 1]
        return dragged

    def _compute_hysteresis(self, deflection: np.ndarray, length: float) -> np.ndarray:
        """Return h of Bouc and Wen along the deflection, shape (samples,); exact on each stretch between reversals."""
        h, last = np.zeros(len(deflection)), 0.0
        for part, begins in self.stretches:
            forward = self.direction[part.start]
            before = deflection[part.start - (not begins)]
            way = np.maximum(forward * (deflection[part] - before), 0.0) / length
            w = 0.0 if begins else forward * last
            rise = np.tanh(np.maximum(way + min(w, 0.0), 0.0))
            base = max(w, 0.0)
            h[part] = forward * np.where(w + way < 0.0, w + way, (base + rise) / (1.0 + base * rise))
            last = h[part.stop - 1]
        return h


def fit_element(log: RigLog) -> Element | None:
    """Fit a transmission to its displacement and torque; None if it never turns back, or hardly moves."""
    rig = _prepare_rig(_average_samples(log))
    if rig is None:
        return None
    # either way may end at a model that no single step improves
    models = [
        _add_terms(rig, _fit_model(rig, ())),
        _add_terms(rig, _drop_terms(rig, _fit_model(rig, TERMS))),
    ]
    models.sort(key=lambda model: len(model.sizes) + len(model.shapes))
    best = models[1] if _compute_gain(*models) is not None else models[0]
    best = _drop_terms(rig, best)
    series = _drop_terms(rig, _fit_model(rig, _SERIES))
    if "slip" in series.terms and series.sizes[0] > 0.0 and _compute_gain(best, series) is not None:
        best = series
    gains = {term: _compute_gain(_fit_without(rig, best, term), best) or 0.0 for term in best.terms}
    return _make_element(log, rig, best, gains)


def _average_samples(log: RigLog) -> RigLog:
    """Average neighbouring samples of a long log."""
    position, torque, segments, period, noise, unit = log
    width = find_motion_bandwidth(position, segments, period) or 1.0 / (len(position) * period)
    count = min(math.ceil(len(position) / _MAX_SAMPLES), int(1.0 / (_SAMPLES_PER_PERIOD * width * period)))
    if count < 2:
        return log
    parts = []
    for s in segments:
        mean_count = count_samples(s) // count
        if mean_count >= _MIN_MEANS:
            samples = np.stack([position[s], torque[s]])[:, : mean_count * count]
            parts.append(samples.reshape(2, mean_count, count).mean(axis=2))
    ends = itertools.accumulate((part.shape[1] for part in parts), initial=0)
    position, torque = np.concatenate(parts, axis=1)
    return RigLog(position, torque, slices_between(ends), count * period, noise / math.sqrt(count), unit)


def _prepare_rig(log: RigLog) -> _Rig | None:
    position, torque, segments, period, noise, _ = log
    width = find_motion_bandwidth(position, segments, period)
    cutoff = _CUTOFF_RATIO * width or math.inf
    smooth, rate, direction = np.zeros((3, len(position)))
    stretches: list[tuple[slice, bool]] = []
    fitted_rows = [np.arange(0)]
    # noise within the band of the motion stays
    share = math.sqrt(min(2.0 * cutoff * period, 1.0))
    for s in segments:
        smooth[s] = low_pass(position[s], cutoff, period)
        rate[s] = np.gradient(smooth[s], period)
        turns = _find_reversals(smooth[s], max(_REVERSAL_NOISE * noise * share, 1e-6 * np.ptp(position)))
        parts = slices_between([s.start, *(s.start + index + 1 for index in turns), s.stop])
        for part in parts:
            travel = smooth[part.stop - 1] - smooth[max(part.start - 1, s.start)]
            direction[part] = 1.0 if travel >= 0.0 else -1.0
            stretches.append((part, part.start == s.start))
        # the state of friction is unknown before a complete stretch, direction and rate at reversals
        guard = max(round(0.5 / (cutoff * period)), 2)
        settled_parts = parts[2:] if len(parts) > 3 else parts[1:]
        fitted_rows += [np.arange(part.start + guard, part.stop - guard) for part in settled_parts]
    rows = np.concatenate(fitted_rows)
    if len(rows) < MIN_SAMPLES or np.ptp(torque[rows]) == 0.0 or np.ptp(smooth[rows]) == 0.0:
        return None
    blur = np.abs(rate) * period + 4.0 * noise + 1e-9 * np.ptp(smooth)
    return _Rig(position, rate, blur, direction, stretches, rows, torque)


def _find_reversals(values: np.ndarray, least: float) -> list[int]:
    """Return the indices of the extremes at which a signal turns back by more than `least`."""
    slope = np.sign(np.diff(values))
    moving = np.flatnonzero(slope)
    corners = moving[np.flatnonzero(np.diff(slope[moving])) + 1]
    reversals: list[int] = []
    extreme, direction = 0, 0
    for index in [*corners.tolist(), len(values) - 1]:
        step = values[index] - values[extreme]
        if direction == 0:
            direction, extreme = (int(np.sign(step)), index) if abs(step) > least else (0, extreme)
        elif direction * step >= 0.0:
            extreme = index
        elif -direction * step > least:
            reversals.append(extreme)
            direction, extreme = -direction, index
    return reversals


class Model(NamedTuple):
    """A model that was fitted to a log.

    Attributes:
        terms: names of its terms.
        shapes: nonlinear numbers by name.
        sizes: linear numbers: stiffness, offset, and those of the terms, which are positive.
        errors: mean square error on each block of the log with sizes fitted to all other blocks, shape (blocks,).
    """

    terms: tuple[str, ...]
    shapes: dict[str, float]
    sizes: np.ndarray
    errors: np.ndarray


def _add_terms(rig: _Rig, best: Model) -> Model:
    """Add terms, as long as one of them lowers the error clearly."""
    while True:
        models = {term: _fit_model(rig, (*best.terms, term), best.shapes) for term in TERMS if term not in best.terms}
        candidates = [
            (len(model.shapes), -gain, model)
            for term, model in models.items()
            if term in model.terms and model.sizes[0] > 0.0 and (gain := _compute_gain(best, model)) is not None
        ]
        if not candidates:
            return best
        # of two that are equally good, the one with fewer numbers
        (*_, best), *further = sorted(candidates, key=lambda candidate: candidate[:2])
        for *_, model in further:
            if _compute_gain(best, model) is not None:
                best = model


def _drop_terms(rig: _Rig, model: Model) -> Model:
    """Drop terms that do not lower the error clearly, those with the smallest gain first."""
    while True:
        sufficient_models = [
            reduced
            for term in model.terms
            if (reduced := _fit_without(rig, model, term)).sizes[0] > 0.0 and _compute_gain(reduced, model) is None
        ]
        if not sufficient_models:
            return model
        model = min(sufficient_models, key=lambda reduced: np.mean(reduced.errors))


def _fit_without(rig: _Rig, model: Model, term: str) -> Model:
    return _fit_model(rig, tuple(name for name in model.terms if name != term), model.shapes)


def _fit_model(rig: _Rig, terms: tuple[str, ...], near: Mapping[str, float] = MappingProxyType({})) -> Model:
    """Fit a model by least squares, without terms that then have a negative size.

    The search starts at the shapes `near`; other shapes start at the best of a grid.
    """
    from scipy.optimize import least_squares

    names = dict.fromkeys(name for term in terms for name in _SHAPES_BY_TERM.get(term, ()))
    if "slip" in terms:
        # a transmission that slips has no centre
        names.pop("centre", None)
    half, middle = rig.half_range, 0.5 * (rig.position.min() + rig.position.max())

    def scale_shapes(name: str, shares: tuple[float, ...]) -> list[float]:
        return [half * share + (middle if name == "centre" else 0.0) for share in shares]

    def compute_residual(shapes: np.ndarray, rig: _Rig) -> np.ndarray:
        return fit_residual(rig.fitted_torque, rig.compute_columns(terms, dict(zip(names, shapes, strict=True))))

    shapes: dict[str, float] = {}
    if names:
        low, high = np.array([scale_shapes(name, _SHAPE_BOUNDS[name]) for name in names]).T
        search = partial(least_squares, compute_residual, bounds=(low, high), x_scale=half, diff_step=1e-4)
        few = replace(rig, rows=rig.rows[:: max(len(rig.rows) // _START_SAMPLES, 1)])
        choices = ([near[name]] if name in near else scale_shapes(name, _SHAPE_STARTS[name]) for name in names)
        starts = sorted(map(np.array, itertools.product(*choices)), key=lambda start: rms(compute_residual(start, few)))
        solutions = [search(start, args=(few,)) for start in starts[:3]]
        best = min(solutions, key=lambda solution: solution.cost)
        shapes = dict(zip(names, search(best.x, args=(rig,)).x.tolist(), strict=True))
    columns, torque = rig.compute_columns(terms, shapes), rig.fitted_torque
    scale = column_rms(columns) + 1e-300
    sizes = np.linalg.lstsq(columns / scale, torque, rcond=1e-10)[0] / scale
    size_by_term = dict(zip((term for term in terms if term in SIZE_NAMES), sizes[2:], strict=True))
    positive = tuple(term for term in terms if size_by_term.get(term, 1.0) > 0.0)
    if positive != terms:
        return _fit_model(rig, positive, shapes)
    # rounding, for a log without noise
    errors = BlockRegression.of(torque, columns, _FOLDS).held_out() + 1e-14 * np.mean(torque**2)
    return Model(terms, shapes, sizes, errors)


def _compute_gain(without: Model, model: Model) -> float | None:
    """Compute the squared error without a term over that with it, less 1, on left-out blocks; None if not clearly above 0.

    Logarithms are compared: a term may matter a hundred times as much in one block as in another.
    """
    gains = np.log(without.errors / model.errors)
    mean = np.mean(gains)
    return math.expm1(mean) if mean > _SURE_ERRORS * mean_error(gains) else None


def _make_element(log: RigLog, rig: _Rig, model: Model, gains: dict[str, float]) -> Element:
    """Compute the numbers, with errors by a jackknife over blocks: these hold for errors of any correlation in time."""
    names = ["stiffness", "offset", *(SIZE_NAMES[term] for term in model.terms if term in SIZE_NAMES), *model.shapes]
    values = np.array([*model.sizes, *model.shapes.values()])
    slopes, step = [], 1e-4 * rig.half_range
    for name, value in model.shapes.items():
        ends = ({name: value - step}, {name: value + step})
        low, high = (rig.compute_torque(model._replace(shapes=model.shapes | end)) for end in ends)
        slopes.append((high - low) / (2.0 * step))
    jacobian = np.column_stack([rig.compute_columns(model.terms, model.shapes), *slopes])
    residual = rig.fitted_torque - rig.compute_torque(model)
    if "windup" in names:
        # the torque at which it slips, in place of the windup there
        place, stiffness = names.index("windup"), values[0]
        names[place] = "slip"
        jacobian[:, 0] -= jacobian[:, place] * values[place] / stiffness
        jacobian[:, place] /= stiffness
        values[place] *= stiffness
    _, errors = fit_with_jackknife(residual + jacobian @ values, jacobian)
    numbers, open_ = {}, []
    for name, value, error in zip(names, values.tolist(), errors.tolist(), strict=True):
        if name == "friction_coefficient":
            # fitted as its product with the stiffness
            error = math.hypot(error / model.sizes[0], value * errors[0] / model.sizes[0] ** 2)
            value = value / float(model.sizes[0])
        low, high = student_interval(value, error)
        if name not in ("offset", "centre"):
            low = max(low, 0.0)
            if not error < _MAX_RELATIVE_ERROR * abs(value):
                open_.append(name)
        unit = on_a_line(_UNITS[name]) if log.unit == "m" else _UNITS[name]
        numbers[name] = Quantity(value, error, (low, high), unit)
    full_rig = _prepare_rig(log) or rig
    torque = np.full(len(full_rig.position), np.nan)
    torque[full_rig.rows] = full_rig.compute_torque(model)
    reversals = sum(not begins for _, begins in rig.stretches)
    return Element(numbers, tuple(open_), gains, torque, *rig.compute_error(model), reversals, model)


_UNITS = {
    "stiffness": "N m/rad", "offset": "N m", "damping": "N m s/rad", "dry_friction": "N m", "hysteresis": "N m",
    "slip": "N m", "centre": "rad", "half_gap": "rad", "length": "rad", "friction_coefficient": "",
}  # fmt: skip
"""Units of numbers on a rotary axis."""


def element_error(element: Element, log: RigLog) -> tuple[float, float] | None:
    """Compute the rms torque error of a fitted transmission on another log, N m (N), and the same over the rms torque.

    None if the log cannot be fitted.
    """
    rig = _prepare_rig(log)
    return None if rig is None else rig.compute_error(element.model)
