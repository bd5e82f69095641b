"""Accuracy laws: the power of an axis that an error follows, fitted with its range, and why it ends there.

Theory gives exponents for a regime and not its borders. So the borders are found from the data first, without a look at
theory's exponent: points where something else rules are left out (float resolution, the floor that another cause sets, an
error as large as the signal), and of the rest the widest run of neighbours on one straight line in log-log is fitted.
Reference: A. Levant, Higher-order sliding modes, differentiation and output-feedback control, Int. J. Control 76 (2003).
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportAttributeAccessIssue=false, reportReturnType=false

import dataclasses
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from jaxbl.config import Config, FigureTable
from jaxbl.config.figures import check_selection, filter_rows, resolve_where
from jaxbl.files import to_jsonable
from jaxbl.sweeps.sweep import StudyResult

NOISE, PERIOD = "encoders.noise", "run.sample_period"

LEAST_POINTS = 4
LEAST_SPAN = 10.0
"""A law needs this many points, two for the slope of each half, over at least this ratio of x: a decade."""
LARGEST_RESIDUAL = math.log(1.1)
"""No point of a law lies farther from its line, in ln y: 10 %."""
LARGEST_BEND = 0.05
"""Slopes of the lower and upper half of a law differ by less, or by less than two standard errors."""
END_OF_SWEEP = "end of the sweep"
AGREEMENT = 0.1
"""A slope this close to theory's agrees with it: theory's exponents (1/2, 1, 2) differ by far more."""

_FLOAT = 10.0  # times the resolution: rounding then is 10 % of the error
_FLOOR = 3.0  # times another cause's error: that is then a third of it, 6 % in a sum of squares
_SIGNAL = 3.0  # the signal is less than so many errors: no estimate any more
_NEAR = 10.0  # beyond a law's end, a cause of this strength is named: a tenth of the error, or an error of a tenth
_PERIOD_EXPONENT = 0.1  # of the error in the period, under noise; white noise alone gives 1/2

_SIGNALS = {"position_rmse": "position", "velocity_rmse": "velocity", "chatter": "velocity"}
_SIZES = ("position_size", "velocity_size", "velocity_rmse")


def sizes_for(value: str) -> list[str]:
    """The columns besides its own that a law of a metric is judged by."""
    side, _, name = value.rpartition(".")
    return [f"{side}.{size}" for size in _SIZES] if name in _SIGNALS else []


class PowerLawFit(NamedTuple):
    """A straight line in log-log, y = exp(intercept) x^slope, over x[first] ... x[last].

    The standard error is that of least squares, from the scatter of the points about the line; a bend that the criterion
    lets pass is not in it: `halves` are the slopes of the lower and the upper half.
    """

    slope: float
    standard_error: float
    intercept: float
    first: int
    last: int
    halves: tuple[float, float]

    def __call__(self, x: Any) -> Any:
        """The line's y at x."""
        return np.exp(self.intercept) * np.asarray(x) ** self.slope


@dataclasses.dataclass(frozen=True)
class Law:
    """What a line of a figure says about a power law.

    Attributes:
        value: metric.
        x: axis path.
        series: path and value of the line's series; empty without.
        where: the other axes that the line fixes (the figure's `where` and `facet`).
        theory: exponent that theory gives.
        fit: the line found, None where no single power law holds.
        stops: why the law holds neither below nor above its range (keys `below`, `above`); without a law, why there is none.
        x_values: float array (points,), increasing.
        y_values: float array (points,), geometric mean over seeds; NaN where a seed diverged.
        figure: index of the figure.
    """

    value: str
    x: str
    series: dict[str, Any]
    where: dict[str, Any]
    theory: float
    fit: PowerLawFit | None
    stops: dict[str, str]
    x_values: np.ndarray
    y_values: np.ndarray
    figure: int

    @property
    def slope(self) -> float | None:
        return None if self.fit is None else self.fit.slope

    @property
    def standard_error(self) -> float | None:
        return None if self.fit is None else self.fit.standard_error

    @property
    def inside(self) -> np.ndarray:
        """Which points the law holds for: bool array (points,)."""
        index = np.arange(len(self.x_values))
        return index < 0 if self.fit is None else (index >= self.fit.first) & (index <= self.fit.last)

    @property
    def range(self) -> tuple[float, float] | None:
        """Least and largest x of the law."""
        return None if self.fit is None else (float(self.x_values[self.fit.first]), float(self.x_values[self.fit.last]))

    @property
    def agrees(self) -> bool:
        """Whether a law was found and its slope is within :data:`AGREEMENT` of theory's."""
        return self.fit is not None and abs(self.fit.slope - self.theory) <= AGREEMENT

    def to_dict(self) -> dict[str, Any]:
        """Plain data for `laws.json`."""
        return {
            "value": self.value,
            "x": self.x,
            "series": self.series or None,
            "where": self.where,
            "theory": self.theory,
            "slope": self.slope,
            "standard_error": self.standard_error,
            "agrees": self.agrees,
            "halves": None if self.fit is None else list(self.fit.halves),
            "range": None if self.range is None else list(self.range),
            "points": int(self.inside.sum()),
            "stops": self.stops,
        }


def fit_power_law(x: np.ndarray, y: np.ndarray, usable: np.ndarray | None = None) -> PowerLawFit | None:
    """The widest run of neighbouring points that one power law describes, by least squares in log-log.

    A run is taken if it has :data:`LEAST_POINTS` over :data:`LEAST_SPAN`, no point farther than :data:`LARGEST_RESIDUAL`
    from the line, and halves whose slopes differ by at most :data:`LARGEST_BEND` or two standard errors of that difference.
    Of runs over the same ratio of x the one with the least scatter is taken.

    `x` is positive and increasing, `(points,)`; points whose y is not positive and finite, or that are not `usable`, break a
    run.
    """
    good = np.isfinite(y) & (y > 0.0) & (True if usable is None else usable)
    log_x, log_y = np.log(x), np.log(np.where(good, y, 1.0))
    best: tuple[float, float] | None = None
    found = None
    for first in range(len(x)):
        for last in range(first + LEAST_POINTS - 1, len(x)):
            if not good[first : last + 1].all():
                break
            span = log_x[last] - log_x[first]
            if span < math.log(LEAST_SPAN) * (1.0 - 1e-9):
                continue
            fit, worst = _line(log_x, log_y, first, last)
            difference, error = _bend(log_x, log_y, fit)
            if worst > LARGEST_RESIDUAL or abs(difference) > max(LARGEST_BEND, 2.0 * error):
                continue
            rank = (round(span, 9), -fit.standard_error)
            if best is None or rank > best:
                best, found = rank, fit
    return found


def _line(log_x: np.ndarray, log_y: np.ndarray, first: int, last: int) -> tuple[PowerLawFit, float]:
    """Least squares over a run, and the largest residual in ln y."""
    u, v = log_x[first : last + 1], log_y[first : last + 1]
    about, slope = u - u.mean(), _slope(u, v)
    intercept = float(v.mean() - slope * u.mean())
    residual = v - intercept - slope * u
    error = math.sqrt(float(residual @ residual) / (len(u) - 2) / float(about @ about))
    middle = (len(u) + 1) // 2
    halves = (_slope(u[:middle], v[:middle]), _slope(u[-middle:], v[-middle:]))
    return PowerLawFit(slope, error, intercept, first, last, halves), float(np.abs(residual).max())


def _slope(u: np.ndarray, v: np.ndarray) -> float:
    about = u - u.mean()
    return float(about @ v / (about @ about))


def _bend(log_x: np.ndarray, log_y: np.ndarray, fit: PowerLawFit) -> tuple[float, float]:
    """Upper half's slope less lower half's, and the standard error that scatter alone gives this difference."""
    u, v = log_x[fit.first : fit.last + 1], log_y[fit.first : fit.last + 1]
    middle = (len(u) + 1) // 2
    # scatter from how each point misses the line through its neighbours; what all miss alike is the bend itself
    weights = (u[1:-1] - u[:-2]) / (u[2:] - u[:-2])
    missed = v[1:-1] - (1.0 - weights) * v[:-2] - weights * v[2:]
    variance = float(np.var(missed / np.sqrt(1.0 + weights**2 + (1.0 - weights) ** 2), ddof=1))
    spread = sum(1.0 / float(((part - part.mean()) ** 2).sum()) for part in (u[:middle], u[-middle:]))
    return fit.halves[1] - fit.halves[0], math.sqrt(variance * spread)


def accuracy_laws(result: StudyResult, figures: list[FigureTable] | None = None) -> list[Law]:
    """Fit every line of the figures that name a `theory`; by default the figures of the study.

    Raises:
        InputError: `where` names what the study does not have, or an axis varies that the figure does not fix.
    """
    config = result.config
    found = []
    for index, figure in enumerate(config.figures if figures is None else figures):
        if figure.theory is None:
            continue
        check_selection(config, figure, index)
        sizes = [name for name in sizes_for(figure.value) if name in result.columns]
        # a line is judged beside those without noise and at other periods
        fixed = {path: value for path, value in resolve_where(config, figure).items() if path not in (NOISE, PERIOD)}
        parts = result.batches([*(axis.path for axis in config.axes), "finite", figure.value, *sizes])
        frame = pd.concat([filter_rows(part, fixed) for part in parts], ignore_index=True)
        found += _of_figure(config, frame, figure, index)
    return found


def _of_figure(config: Config, frame: pd.DataFrame, figure: FigureTable, index: int) -> Iterator[Law]:
    """The laws of a figure: one a panel and series."""
    assert figure.theory is not None
    fixed = resolve_where(config, figure)
    chosen = filter_rows(frame, fixed)
    for facet in [None] if figure.facet is None else sorted(chosen[figure.facet].unique()):
        for name in [None] if figure.series is None else sorted(chosen[figure.series].unique()):
            where = fixed | ({} if figure.facet is None else {figure.facet: to_jsonable(facet)})
            series = {} if figure.series is None else {figure.series: to_jsonable(name)}
            line = _Line(config, frame, figure, where | series)
            fit = fit_power_law(line.x, line.y, line.usable)
            yield Law(figure.value, figure.x, series, where, figure.theory, fit, line.stops(fit), line.x, line.y, index)


class _Line:
    """One line of a figure, and what is known about other causes of its errors at each of its points."""

    def __init__(self, config: Config, frame: pd.DataFrame, figure: FigureTable, fixed: dict[str, Any]):
        self._frame, self._figure, self._fixed = frame, figure, fixed
        self.x, self.y = self._means(figure.value)
        self._noise = np.full(len(self.x), self._level(config, NOISE))
        if figure.x == NOISE:
            self._noise = self.x
        period = self.x if figure.x == PERIOD else np.full(len(self.x), self._level(config, PERIOD))
        self._signal, self._resolution, self._velocity = self._sizes(config, period)
        # the same points without noise: along the noise axis one number, the floor; else the law that noise covers
        bare = self._means(figure.value, {NOISE: 0.0}) if NOISE in (figure.x, *fixed) else (np.array([]), np.array([]))
        self._bare = np.full(len(self.x), np.nan)
        if len(bare[0]) == len(self.x) or (figure.x == NOISE and len(bare[1])):
            self._bare = np.broadcast_to(bare[1], self.x.shape)
        self._exponent = self._period_exponent(config) if figure.x == NOISE else np.full(len(self.x), np.nan)
        self.usable = np.array([self._reason(i, strict=True) is None for i in range(len(self.x))], dtype=bool)

    def _level(self, config: Config, path: str) -> float:
        """The value that a number has along the line; NaN where it varies."""
        if path in self._fixed:
            return float(self._fixed[path])
        if path in self._frame:
            values = filter_rows(self._frame, self._fixed)[path].unique()
            return float(values[0]) if len(values) == 1 else math.nan
        section, key = path.split(".")
        return float(getattr(getattr(config, section), key))

    def _means(self, column: str, other: dict[str, float] | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Geometric means over seeds at each x > 0 along the line, or along one with `other` values."""
        path = self._figure.x
        rows = filter_rows(self._frame, self._fixed | (other or {}))
        if path not in (other or {}):
            rows = rows[rows[path] > 0.0]
        values = np.abs(rows[column].astype(float)).where(rows["finite"].astype(bool))
        with np.errstate(divide="ignore"):
            means = np.exp(np.log(values).groupby(rows[path], sort=True).agg(lambda v: v.mean(skipna=False)))
        return means.index.to_numpy(float), means.to_numpy(float)

    def _sizes(self, config: Config, period: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Size of the true signal, the resolution that rounding leaves to its estimate, and the velocity error relative to
        the velocity; NaN where unknown.

        A reading is rounded to eps times the position, and a change of it divided by the period is a velocity.
        """
        name = self._figure.value.rpartition(".")[2]
        unknown = np.full(len(self.x), np.nan)
        eps = float(np.finfo(config.run.precision).eps)
        kind = _SIGNALS.get(name)
        if kind is None or not set(sizes_for(self._figure.value)) <= set(self._frame.columns):
            return unknown, unknown, unknown
        position, velocity, error = (self._means(size)[1] for size in sizes_for(self._figure.value))
        if kind == "position":
            return position, eps * position, error / velocity
        return velocity, eps * (position / period + velocity), error / velocity

    def _period_exponent(self, config: Config) -> np.ndarray:
        """Exponent of the error in the sampling period at each noise, from the neighbouring period; NaN without one."""
        here = self._level(config, PERIOD)
        unknown = np.full(len(self.x), np.nan)
        if PERIOD not in self._fixed or not math.isfinite(here):
            return unknown
        others = np.unique(self._frame[PERIOD].to_numpy(float))
        others = others[~np.isclose(others, here, rtol=1e-9, atol=0.0)]
        if not len(others):
            return unknown
        near = float(others[np.argmin(np.abs(np.log(others / here)))])
        x, y = self._means(self._figure.value, {PERIOD: near})
        if len(x) != len(self.x):
            return unknown
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.log(y / self.y) / math.log(near / here)

    def _reason(self, i: int, strict: bool) -> str | None:
        """What else than the law rules the error at a point; not `strict`, also what merely bends it."""
        y, bare, signal, resolution = self.y[i], self._bare[i], self._signal[i], self._resolution[i]
        if not math.isfinite(y):
            return "no number: a run diverged, or the figure is undefined"
        factor = 1.0 if strict else _NEAR / _FLOOR
        if y <= 0.0:
            return "float resolution: the error is exactly zero"
        if y <= _FLOAT * factor * resolution:
            return f"float resolution: the error is {_times(y / resolution)} the rounding of a reading"
        if y >= signal / (_SIGNAL * factor):
            return f"saturation: the error is {100.0 * y / signal:.2g} % of the signal"
        if self._figure.x == NOISE and y <= _FLOOR * factor * bare:
            return f"sampling period: the error is {_times(y / bare)} that without noise, its floor"
        if self._figure.x != NOISE and self._noise[i] > 0.0 and y >= (_FLOOR if strict else 1.1) * bare:
            return "noise floor: the error is " + (f"{_times(y / bare)} that without noise" if bare else "noise alone")
        if not strict and self._exponent[i] > _PERIOD_EXPONENT:
            return f"sampling period: the error grows with it as h^{self._exponent[i]:.2f}, as under averaged white noise"
        if not strict and self._velocity[i] >= 1.0 / (_SIGNAL * factor):
            return f"saturation: the velocity error is {100.0 * self._velocity[i]:.2g} % of the velocity"
        return None

    def stops(self, fit: PowerLawFit | None) -> dict[str, str]:
        """Why the law ends, at each end; without a law why there is none."""
        if not len(self.x):
            return {"below": "no points", "above": "no points"}
        if fit is None:
            ends = {"below": 0, "above": len(self.x) - 1}
            other = "other: no run of points on one line"
            return {key: self._reason(i, strict=False) or other for key, i in ends.items()}
        stops = {"below": END_OF_SWEEP, "above": END_OF_SWEEP}
        for key, i, inner in (("below", fit.first - 1, fit.first), ("above", fit.last + 1, fit.last)):
            if 0 <= i < len(self.x):
                stops[key] = self._reason(i, strict=False) or f"other: local slope {self._local(i, inner):.2f}"
        return stops

    def _local(self, i: int, j: int) -> float:
        slope = math.log(self.y[i] / self.y[j]) / math.log(self.x[i] / self.x[j])
        return round(slope, 2) + 0.0  # no minus before a zero


def _times(ratio: float) -> str:
    return f"{ratio:.2f} times" if ratio < 10.0 else f"{ratio:.2g} times"
