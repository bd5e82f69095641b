"""A transmission alone on a test rig: stiffness, gap, friction and hysteresis from torque over displacement.

    u = K d + D dd/dt + T h + F s + mu |K d| s + u_0,   d = (x - x_0) - clip(x - x_0, -b, b)

with the displacement x of one side against the other, the half gap b, the direction of motion s = +-1, which stays at rest
what it was, and Bouc and Wen's hysteresis dh/dd = 1 / length where h returns to 0, (1 - h²) / length where it grows (that of
the package's effect). No mass and no nominal number is in it.

All but x_0, b and the length are linear: these are found by least squares for each choice of the others (variable
projection: G. Golub, V. Pereyra, SIAM J. Numer. Anal. 10, 1973). A term is kept if it lowers the squared error on blocks of
the log that its size was not fitted to.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from jaxbl.units import on_a_line

from .least_squares import BLOCKS, fit_with_jackknife
from .signal_quality import MIN_SAMPLES, find_bandwidth, longest_segment, low_pass

_MOST = 20_000
"""Samples that are fitted: a loop of torque over displacement is drawn by some hundred. Of longer logs means are."""
_LEAST = 8
"""Means that a part between gaps has at least: fewer hold no way there and back, and have no slope to speak of."""
_BAND = 20.0
"""Cutoff of the low-pass on the displacement, over its bandwidth: corners of a triangle stay sharp."""
_PER_PERIOD = 100
"""Samples that are left at least of a period at the bandwidth of the motion."""
_FEW = 3_000
"""Samples on which starts are compared."""
_FOLDS = 10
"""Parts of the log for cross-validation."""
_CLEAR = 3.0
"""Standard errors by which a term must lower the squared error: one chance in a thousand for each of five terms."""
_OPEN = 0.5
"""Relative standard error from which on a number counts as not found; as in `jaxbl identify`."""
_TURN = 6.0
"""Noise of the displacement, in rms, that a reversal exceeds: white noise of the range of a log stays below."""
_GAPS = 0.02, 0.1, 0.3, 0.5, 0.7
"""Half gaps tried, over half the range of the displacement."""
_CENTRES = -0.5, -0.2, 0.0, 0.2, 0.5
"""Centres of the gap tried, from the middle of the range, over half of it."""
_LENGTHS = 0.02, 0.06, 0.2, 0.6
"""Lengths of the hysteresis tried, over half the range."""

TERMS = ("gap", "damping", "dry friction", "hysteresis", "friction under load")
"""What may be in a transmission beside its stiffness."""
_SHAPES = {"gap": ("centre", "half_gap"), "hysteresis": ("length",), "friction under load": ("centre",)}
"""Numbers of a term that are not linear."""
_SIZES = {
    "damping": "damping",
    "dry friction": "dry_friction",
    "hysteresis": "hysteresis",
    "friction under load": "friction_coefficient",
}
"""Number of each other term, by which it is multiplied."""


class Number(NamedTuple):
    """A number with its standard error and 95 % interval; `unit` as on a turning axis or a linear one."""

    value: float
    error: float
    interval: tuple[float, float]
    unit: str


@dataclass(frozen=True)
class Element:
    """What torque over displacement says of a transmission.

    Attributes:
        numbers: `stiffness`, `offset` (torque at displacement 0, or at the centre) and what the terms need of `half_gap`,
            `centre` (displacement at the middle of the gap, or where nothing is transmitted), `damping`, `dry_friction`,
            `hysteresis` (its largest torque), `length`, `friction_coefficient` (friction under load, over the torque).
        open: those of them that the log leaves uncertain by more than half.
        gains: term that is kept -> squared error without it over that with it, less 1, on blocks that were left out.
        terms: that are kept.
        torque: of the model at each sample of the log, shape (samples,); nan about reversals.
        residual: rms of what it leaves, N m (N).
        share: the same over the rms of the torque about its mean.
        reversals: of the displacement.
        shapes, sizes: numbers of the model as it computes with them.
    """

    numbers: dict[str, Number]
    open: tuple[str, ...]
    gains: dict[str, float]
    terms: tuple[str, ...]
    torque: np.ndarray
    residual: float
    share: float
    reversals: int
    shapes: np.ndarray
    sizes: np.ndarray

    def to_dict(self) -> dict[str, Any]:
        """As in `inspection.json`."""
        numbers = {
            name: {"value": one.value, "standard_error": one.error, "interval": list(one.interval), "unit": one.unit}
            for name, one in self.numbers.items()
        }
        rest = {"open": list(self.open), "gains": self.gains, "residual": self.residual, "share": self.share}
        return {"numbers": numbers} | rest


@dataclass(frozen=True)
class _Rig:
    """Displacement and torque of a log, and what of them does not change while models are tried.

    Attributes:
        position: as measured, shape (samples,): corners matter more than noise.
        rate: slope of the low-passed one.
        blur: way within a sample, with that of the noise, rad (m), shape (samples,).
        direction: +1 or -1, shape (samples,).
        stretches: between reversals, in order; of all segments.
        begins: whether a stretch is the first of its segment.
        rows: that are fitted, after the first reversals of their segment.
        torque: shape (samples,).
    """

    position: np.ndarray
    rate: np.ndarray
    blur: np.ndarray
    direction: np.ndarray
    stretches: list[slice]
    begins: list[bool]
    rows: np.ndarray
    torque: np.ndarray
    middle: float = field(init=False)
    half: float = field(init=False)

    def __post_init__(self) -> None:
        low, high = float(self.position.min()), float(self.position.max())
        object.__setattr__(self, "middle", 0.5 * (low + high))
        object.__setattr__(self, "half", 0.5 * (high - low))

    def columns(self, terms: Sequence[str], shapes: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Torque of 1 of each linear number (stiffness, offset, then sizes of terms in order), shape (rows, numbers)."""
        given = dict(zip(_shape_names(terms), shapes, strict=True))
        x = self.position - given.get("centre", 0.0)
        b = given.get("half_gap", 0.0)
        deflection = x - np.clip(x, -b, b)
        found = [deflection[rows], np.ones(len(rows))]
        for term in terms:
            if term == "damping":
                # none inside the gap; a sample that meets its end has a part of it
                contact = np.clip((np.abs(x) - b) / self.blur + 0.5, 0.0, 1.0) if "gap" in terms else 1.0
                found.append((self.rate * contact)[rows])
            elif term == "dry friction":
                found.append(self.direction[rows])
            elif term == "hysteresis":
                found.append(self._hysteresis(deflection, given["length"])[rows])
            elif term == "friction under load":
                found.append((np.abs(deflection) * self.direction)[rows])
        return np.stack(found, axis=1)

    def _hysteresis(self, deflection: np.ndarray, length: float) -> np.ndarray:
        """h of Bouc and Wen along the deflection, exact on each stretch between reversals; shape (samples,)."""
        h, last = np.zeros(len(deflection)), 0.0
        for part, begins in zip(self.stretches, self.begins, strict=True):
            forward = float(self.direction[part.start])
            start = 0.0 if begins else last
            before = deflection[part.start] if begins else deflection[part.start - 1]
            way = np.maximum(forward * (deflection[part] - before), 0.0) / length
            w = forward * start
            rise = np.tanh(np.maximum(way + min(w, 0.0), 0.0))
            base = max(w, 0.0)
            h[part] = forward * np.where(w + way < 0.0, w + way, (base + rise) / (1.0 + base * rise))
            last = float(h[part.stop - 1])
        return h


def fit_element(
    position: np.ndarray, torque: np.ndarray, segments: Sequence[slice], period: float, *, noise: float, linear: bool
) -> Element | None:
    """Fit a transmission to its displacement and torque; None where the displacement never turns back, or hardly moves.

    Args:
        position: displacement of one side against the other, rad (m), shape (samples,).
        torque: through the transmission, N m (N), shape (samples,).
        segments: contiguous parts.
        period: of sampling, s.
        noise: of the displacement, rad (m) rms.
        linear: whether it is in m.
    """
    rig = _prepare_rig(*_average_samples(position, torque, segments, period, noise))
    if rig is None:
        return None
    # one of the two may end where no single step leads on
    ways = [
        _add_terms(rig, _fit_model(rig, ())),
        _add_terms(rig, _drop_terms(rig, _drop_negative_terms(rig, _fit_model(rig, TERMS)))),
    ]
    ways.sort(key=lambda one: len(one.sizes) + len(one.shapes))
    best = ways[1] if _gain(rig, *ways) is not None else ways[0]
    best = _drop_terms(rig, best)
    gains = {term: _gain(rig, _fit_without(rig, best, term), best) or 0.0 for term in best.terms}
    whole = _prepare_rig(position, torque, segments, period, noise)
    return _make_element(rig, whole or rig, best, gains, linear)


def _average_samples(
    position: np.ndarray, torque: np.ndarray, segments: Sequence[slice], period: float, noise: float
) -> tuple[np.ndarray, np.ndarray, list[slice], float, float]:
    """Of neighbouring samples of a long log, as arguments of :func:`_prepare_rig`."""
    width = find_bandwidth(position[longest_segment(segments)], period, differentiate=True) or 1.0 / (len(position) * period)
    count = min(math.ceil(len(position) / _MOST), int(1.0 / (_PER_PERIOD * width * period)))
    if count < 2:
        return position, torque, list(segments), period, noise
    parts, ends, found = [], [], 0
    for s in segments:
        left = (s.stop - s.start) // count
        if left < _LEAST:
            continue
        both = np.stack([position[s], torque[s]])[:, : left * count]
        parts.append(both.reshape(2, left, count).mean(axis=2))
        ends.append(slice(found, found + left))
        found += left
    means = np.concatenate(parts, axis=1)
    return means[0], means[1], ends, count * period, noise / math.sqrt(count)


def _prepare_rig(
    position: np.ndarray, torque: np.ndarray, segments: Sequence[slice], period: float, noise: float
) -> _Rig | None:
    width = find_bandwidth(position[longest_segment(segments)], period, differentiate=True)
    smooth, rate, direction = position.copy(), np.zeros(len(position)), np.zeros(len(position))
    stretches: list[slice] = []
    begins: list[bool] = []
    kept = []
    # noise within the band of the motion stays
    share = math.sqrt(min(2.0 * _BAND * width * period, 1.0)) if width else 1.0
    for s in segments:
        if width:
            smooth[s] = low_pass(position[s], _BAND * width, period)
        rate[s] = np.gradient(smooth[s], period)
        turns = _find_reversals(smooth[s], max(_TURN * noise * share, 1e-6 * float(np.ptp(position))))
        ends = [0, *(at + 1 for at in turns), s.stop - s.start]
        parts = [slice(s.start + a, s.start + b) for a, b in itertools.pairwise(ends) if b > a]
        for i, part in enumerate(parts):
            way = smooth[part.stop - 1] - smooth[max(part.start - 1, s.start)]
            direction[part] = 1.0 if way >= 0.0 else -1.0
            stretches.append(part)
            begins.append(i == 0)
        # before a whole stretch the state of friction is not known, at reversals neither direction nor rate are
        guard = max(round(0.5 / (_BAND * width * period)) if width else 0, 2)
        settled = parts[2:] if len(parts) > 3 else parts[1:]
        kept += [np.arange(part.start + guard, part.stop - guard) for part in settled]
    rows = np.concatenate([*kept, np.arange(0)])
    if len(rows) < MIN_SAMPLES or np.ptp(torque[rows]) == 0.0 or np.ptp(smooth[rows]) == 0.0:
        return None
    blur = np.abs(rate) * period + 4.0 * noise + 1e-9 * float(np.ptp(smooth))
    return _Rig(position, rate, blur, direction, stretches, begins, rows, torque)


def _find_reversals(values: np.ndarray, least: float) -> list[int]:
    """Where a signal turns back by more than `least`: indices of its extremes between, in order."""
    slope = np.sign(np.diff(values))
    moving = np.flatnonzero(slope)
    corners = moving[np.flatnonzero(np.diff(slope[moving])) + 1]
    found: list[int] = []
    extreme, way = 0, 0
    for at in [*corners.tolist(), len(values) - 1]:
        step = values[at] - values[extreme]
        if way == 0:
            way, extreme = (int(np.sign(step)), at) if abs(step) > least else (0, extreme)
        elif way * step >= 0.0:
            extreme = at
        elif -way * step > least:
            found.append(extreme)
            way, extreme = -way, at
    return found


class _Model(NamedTuple):
    """A model on a log: its terms, shapes, linear numbers, and mean square error."""

    terms: tuple[str, ...]
    shapes: np.ndarray
    sizes: np.ndarray
    error: float

    @property
    def possible(self) -> bool:
        """Whether stiffness and all sizes are positive."""
        return bool(self.sizes[0] > 0.0 and (self.sizes[2:] > 0.0).all())


def _add_terms(rig: _Rig, best: _Model) -> _Model:
    """With terms added as long as one lowers the error clearly."""
    while True:
        models = [
            _drop_negative_terms(rig, _fit_model(rig, (*best.terms, term), best), term)
            for term in TERMS
            if term not in best.terms
        ]
        tried = [(model, gain) for model in models if model.possible and (gain := _gain(rig, best, model)) is not None]
        if not tried:
            return best
        # of two that do as well the one with fewer numbers
        tried.sort(key=lambda one: (len(one[0].shapes), -one[1]))
        best = tried[0][0]
        for model, _ in tried[1:]:
            if _gain(rig, best, model) is not None:
                best = model


def _drop_terms(rig: _Rig, model: _Model) -> _Model:
    """Without terms that do not lower the error clearly, the least of them first."""
    while True:
        others = [_fit_without(rig, model, term) for term in model.terms]
        needless = [one for one in others if one.sizes[0] > 0.0 and _gain(rig, one, model) is None]
        if not needless:
            return model
        model = min(needless, key=lambda one: float(np.mean(_held_out_errors(rig, one))))


def _fit_without(rig: _Rig, model: _Model, term: str) -> _Model:
    return _drop_negative_terms(rig, _fit_model(rig, tuple(one for one in model.terms if one != term), model))


def _drop_negative_terms(rig: _Rig, found: _Model, new: str = "") -> _Model:
    """A model without terms whose size is negative; as it is where that of the `new` one is."""
    while True:
        sized = [one for one in found.terms if one in _SIZES]
        kept = {one for one, size in zip(sized, found.sizes[2:], strict=True) if size > 0.0}
        terms = tuple(one for one in found.terms if one not in _SIZES or one in kept)
        if terms == found.terms or (new in _SIZES and new not in kept):
            return found
        found = _fit_model(rig, terms, found)


def _shape_names(terms: Sequence[str]) -> list[str]:
    return list(dict.fromkeys(name for term in terms for name in _SHAPES.get(term, ())))


def _fit_sizes(columns: np.ndarray, torque: np.ndarray) -> np.ndarray:
    scale = np.sqrt(np.mean(columns**2, axis=0)) + 1e-300
    return np.linalg.lstsq(columns / scale, torque, rcond=1e-10)[0] / scale


def _fit_model(rig: _Rig, terms: tuple[str, ...], near: _Model | None = None) -> _Model:
    """Least squares; shapes that `near` has begin there, others at the best of a grid."""
    from scipy.optimize import least_squares

    names = _shape_names(terms)
    known = dict(zip(_shape_names(near.terms), near.shapes, strict=True)) if near is not None else {}
    grids = {
        "centre": [rig.middle + rig.half * one for one in _CENTRES],
        "half_gap": [rig.half * one for one in _GAPS],
        "length": [rig.half * one for one in _LENGTHS],
    }

    def left(shapes: np.ndarray, rows: np.ndarray) -> np.ndarray:
        columns = rig.columns(terms, shapes, rows)
        return rig.torque[rows] - columns @ _fit_sizes(columns, rig.torque[rows])

    shapes = np.empty(0)
    if names:
        few = rig.rows[:: max(len(rig.rows) // _FEW, 1)]
        starts = list(itertools.product(*([known[name]] if name in known else grids[name] for name in names)))
        order = sorted(starts, key=lambda one: float(np.mean(left(np.array(one), few) ** 2)))
        low = np.array(
            [rig.middle - rig.half if n == "centre" else 0.0 if n == "half_gap" else 1e-4 * rig.half for n in names]
        )
        high = np.array(
            [rig.middle + rig.half if n == "centre" else rig.half if n == "half_gap" else 10.0 * rig.half for n in names]
        )
        tried = []
        for start in order[:3]:
            begin = np.clip(np.array(start), low + 1e-9 * rig.half, high - 1e-9 * rig.half)
            done = least_squares(left, begin, bounds=(low, high), args=(few,), x_scale=rig.half, diff_step=1e-4)
            tried.append((done.cost, done.x))
        shapes = min(tried, key=lambda one: one[0])[1]
        shapes = least_squares(left, shapes, bounds=(low, high), args=(rig.rows,), x_scale=rig.half, diff_step=1e-4).x
    columns = rig.columns(terms, shapes, rig.rows)
    sizes = _fit_sizes(columns, rig.torque[rig.rows])
    return _Model(terms, shapes, sizes, float(np.mean((rig.torque[rig.rows] - columns @ sizes) ** 2)))


def _held_out_errors(rig: _Rig, model: _Model) -> np.ndarray:
    """Mean square error on each block of the log, by sizes from the others; shape (blocks,)."""
    columns, torque = rig.columns(model.terms, model.shapes, rig.rows), rig.torque[rig.rows]
    found = []
    for block in np.array_split(np.arange(len(torque)), _FOLDS):
        others = np.ones(len(torque), dtype=bool)
        others[block] = False
        sizes = _fit_sizes(columns[others], torque[others])
        found.append(float(np.mean((torque[block] - columns[block] @ sizes) ** 2)))
    # what rounding leaves of a log without noise
    return np.array(found) + 1e-24 * float(np.mean(torque**2))


def _gain(rig: _Rig, without: _Model, model: _Model) -> float | None:
    """Squared error on left-out blocks without a term over that with it, less 1; None where it is not clearly above 0.

    By logarithms: a term may matter a hundred times as much in one block as in another.
    """
    gains = np.log(_held_out_errors(rig, without) / _held_out_errors(rig, model))
    error = float(np.std(gains, ddof=1)) / math.sqrt(_FOLDS)
    mean = float(np.mean(gains))
    return math.expm1(mean) if mean > _CLEAR * error else None


def _make_element(rig: _Rig, whole: _Rig, model: _Model, gains: dict[str, float], linear: bool) -> Element:
    """Numbers with errors by a jackknife over blocks, which holds for errors of any correlation in time."""
    from scipy.special import stdtrit

    names = ["stiffness", "offset", *(_SIZES[term] for term in model.terms if term in _SIZES), *_shape_names(model.terms)]
    values = np.concatenate([model.sizes, model.shapes])
    columns = rig.columns(model.terms, model.shapes, rig.rows)
    slopes = []
    for i in range(len(model.shapes)):
        step = 1e-4 * rig.half
        ends = [model.shapes.copy(), model.shapes.copy()]
        ends[0][i] -= step
        ends[1][i] += step
        low, high = (rig.columns(model.terms, one, rig.rows) @ model.sizes for one in ends)
        slopes.append((high - low) / (2.0 * step))
    jacobian = np.column_stack([columns, *slopes])
    left = rig.torque[rig.rows] - columns @ model.sizes
    _, errors = fit_with_jackknife(left + jacobian @ values, jacobian)
    reach = float(stdtrit(BLOCKS - 1, 0.975))
    numbers, open_ = {}, []
    for name, value, error in zip(names, values.tolist(), errors.tolist(), strict=True):
        if name == "friction_coefficient":
            # fitted as its product with the stiffness
            error = math.hypot(error / model.sizes[0], value * errors[0] / model.sizes[0] ** 2)
            value = value / float(model.sizes[0])
        low, high = value - reach * error, value + reach * error
        if name not in ("offset", "centre"):
            low = max(low, 0.0)
            if not error < _OPEN * abs(value):
                open_.append(name)
        numbers[name] = Number(value, error, (low, high), _unit(name, linear))
    torque = np.full(len(whole.position), np.nan)
    torque[whole.rows] = whole.columns(model.terms, model.shapes, whole.rows) @ model.sizes
    spread = float(np.std(rig.torque[rig.rows]))
    rms = float(np.sqrt(np.mean(left**2)))
    turns = len(rig.stretches) - sum(rig.begins)
    return Element(numbers, tuple(open_), gains, model.terms, torque, rms, rms / spread, turns, model.shapes, model.sizes)


_UNITS = {
    "stiffness": "N m/rad", "offset": "N m", "damping": "N m s/rad", "dry_friction": "N m", "hysteresis": "N m",
    "centre": "rad", "half_gap": "rad", "length": "rad", "friction_coefficient": "",
}  # fmt: skip
"""Units of numbers on a turning axis."""


def _unit(name: str, linear: bool) -> str:
    return on_a_line(_UNITS[name]) if linear else _UNITS[name]


def element_error(
    found: Element, position: np.ndarray, torque: np.ndarray, segments: Sequence[slice], period: float, noise: float
) -> tuple[float, float] | None:
    """Rms torque by which a transmission that was found misses another log, and that over the rms of the log's torque.

    Arguments and None as of :func:`fit_element`.
    """
    rig = _prepare_rig(position, torque, segments, period, noise)
    if rig is None:
        return None
    left = torque[rig.rows] - rig.columns(found.terms, found.shapes, rig.rows) @ found.sizes
    rms = float(np.sqrt(np.mean(left**2)))
    return rms, rms / float(np.std(torque[rig.rows]))
