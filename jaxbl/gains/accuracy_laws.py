"""Accuracy laws: power laws between an error and an axis of a sweep, with the range in which they hold.

Theory gives an exponent for a regime, but not the borders of the regime. The borders are found first, from the data alone.
Points at which another cause determines the error are left out: float resolution, the floor set by another axis, or an error
as large as the signal. A straight line in log-log is then fitted to the widest run of neighbouring points that lie on one.
Reference: A. Levant, Higher-order sliding modes, differentiation and output-feedback control, Int. J. Control 76 (2003).
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportAttributeAccessIssue=false, reportReturnType=false

import dataclasses
import math
from collections.abc import Iterator
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from jaxbl.config import Config, FigureTable
from jaxbl.config.figures import check_selection, filter_rows, resolve_where
from jaxbl.files import to_jsonable
from jaxbl.json_types import JsonObject
from jaxbl.lines import percent
from jaxbl.sweeps.sweep import StudyResult

NOISE, PERIOD = "encoders.noise", "run.sample_period"

LEAST_POINTS = 4
LEAST_SPAN = 10.0
"""A law needs this many points (two for the slope of each half) over at least this ratio of x (a decade)."""
LARGEST_RESIDUAL = math.log(1.1)
"""Largest distance of a law's points from its line, in ln y: 10 %."""
LARGEST_BEND = 0.05
"""Largest difference between the slopes of a law's lower and upper half, if it is more than two standard errors."""
END_OF_SWEEP = "end of the sweep"
AGREEMENT = 0.1
"""A slope this close to theory's agrees with it: theory's exponents (1/2, 1, 2) differ by far more."""

_RESOLUTION_FACTOR = 10.0  # an error above this many resolutions: rounding is below 10 % of it
_FLOOR_FACTOR = 3.0  # an error above this many times another cause's: that adds below 6 %, in a sum of squares
_SIGNAL_FACTOR = 3.0  # a signal below this many errors is not estimated any more
_BENDING_FACTOR = 10.0  # a cause of a tenth of the error is named where a law ends
_PERIOD_EXPONENT = 0.1  # least exponent of the error in the period that is named; white noise alone gives 1/2

_SIGNAL_BY_METRIC = {"position_rmse": "position", "velocity_rmse": "velocity", "chatter": "velocity"}
_SIZE_METRICS = ("position_size", "velocity_size", "velocity_rmse")


def signal_size_columns(column: str) -> list[str]:
    """Return the columns that tell whether an error (`motor.velocity_rmse`) is as large as its signal."""
    side, _, metric = column.rpartition(".")
    return [f"{side}.{size}" for size in _SIZE_METRICS] if metric in _SIGNAL_BY_METRIC else []


class PowerLawFit(NamedTuple):
    """A straight line in log-log, y = exp(intercept) x^slope, over x[first] ... x[last].

    Attributes:
        standard_error: of the slope, from the scatter of the points about the line. It leaves out a bend of the data.
        half_slopes: slopes of the lower and of the upper half. Their difference shows a bend.
    """

    slope: float
    standard_error: float
    intercept: float
    first: int
    last: int
    half_slopes: tuple[float, float]

    def __call__(self, x: Any) -> Any:
        """The line's y at x."""
        return np.exp(self.intercept) * np.asarray(x) ** self.slope


@dataclasses.dataclass(frozen=True)
class Law:
    """The power law of one line of a figure.

    Attributes:
        value: metric.
        x: axis path.
        series: path and value of the line's series; empty without.
        where: the other axes that the line fixes (the figure's `where` and `facet`).
        theory: exponent that theory gives.
        fit: the fitted line, None if no single power law holds.
        stops: why the law ends, by end (`below`, `above`). Without a law: why there is none.
        x_values: float array (points,), increasing.
        y_values: float array (points,), geometric mean over seeds; NaN where a seed diverged.
        figure: index of the figure.
    """

    value: str
    x: str
    series: JsonObject
    where: JsonObject
    theory: float
    fit: PowerLawFit | None
    stops: dict[str, str]
    x_values: np.ndarray
    y_values: np.ndarray
    figure: int

    @property
    def slope(self) -> float | None:
        return self.fit and self.fit.slope

    @property
    def standard_error(self) -> float | None:
        return self.fit and self.fit.standard_error

    @property
    def in_range(self) -> np.ndarray:
        """True for the points that the law holds for: bool array (points,)."""
        index = np.arange(len(self.x_values))
        return index < 0 if self.fit is None else (index >= self.fit.first) & (index <= self.fit.last)

    @property
    def range(self) -> tuple[float, float] | None:
        """Least and largest x of the law."""
        return self.fit and (float(self.x_values[self.fit.first]), float(self.x_values[self.fit.last]))

    @property
    def agrees(self) -> bool:
        """True if a law was found and its slope is within :data:`AGREEMENT` of theory's."""
        return self.fit is not None and abs(self.fit.slope - self.theory) <= AGREEMENT

    def to_dict(self) -> JsonObject:
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
            "halves": self.fit and self.fit.half_slopes,
            "range": self.range,
            "points": int(self.in_range.sum()),
            "stops": self.stops,
        }


def fit_power_law(x: np.ndarray, y: np.ndarray, usable: np.ndarray | None = None) -> PowerLawFit | None:
    """Fit the widest run of neighbouring points that one power law describes, by least squares in log-log.

    A run needs :data:`LEAST_POINTS` points over a ratio of :data:`LEAST_SPAN`. No point may be farther than
    :data:`LARGEST_RESIDUAL` from the line. The slopes of its halves may differ by :data:`LARGEST_BEND`, or by two standard
    errors of their difference. Among runs over the same ratio of x the one with the least scatter is chosen.

    Args:
        x: positive and increasing, shape (points,).
        y: shape (points,). A point that is not positive and finite ends a run.
        usable: bool array (points,). A point that is False ends a run, too.

    Returns:
        The fit, or None if there is no such run.

    Example:
        >>> x = np.geomspace(1.0, 1000.0, 7)
        >>> round(fit_power_law(x, 2.0 * x**0.5).slope, 6)
        0.5
    """
    is_usable = np.isfinite(y) & (y > 0.0) & (True if usable is None else usable)
    log_x, log_y = np.log(x), np.log(np.where(is_usable, y, 1.0))
    fits = [
        _fit_line(log_x, log_y, first, last)
        for first, last in combinations(range(len(x)), 2)
        if last - first >= LEAST_POINTS - 1
        and log_x[last] - log_x[first] >= math.log(LEAST_SPAN) * (1.0 - 1e-9)
        and is_usable[first : last + 1].all()
    ]
    return max(
        (fit for fit in fits if fit is not None),
        key=lambda fit: (round(float(log_x[fit.last] - log_x[fit.first]), 9), -fit.standard_error),
        default=None,
    )


def _fit_line(log_x: np.ndarray, log_y: np.ndarray, first: int, last: int) -> PowerLawFit | None:
    """Fit a line to the points first ... last by least squares; None if a point is too far from it, or it bends."""
    run_x, run_y = log_x[first : last + 1], log_y[first : last + 1]
    slope, intercept = map(float, np.polyfit(run_x, run_y, 1))
    residual = run_y - intercept - slope * run_x
    standard_error = math.sqrt(float(residual @ residual) / (len(run_x) - 2) / _squared_deviations(run_x))
    middle = (len(run_x) + 1) // 2
    halves = slice(middle), slice(-middle, None)
    lower, upper = (float(np.polyfit(run_x[half], run_y[half], 1)[0]) for half in halves)
    # the scatter is taken from each point's distance to the line through its neighbours; a bend moves all of them alike, and
    # is left out of the variance
    weights = (run_x[1:-1] - run_x[:-2]) / (run_x[2:] - run_x[:-2])
    misses = run_y[1:-1] - (1.0 - weights) * run_y[:-2] - weights * run_y[2:]
    variance = float(np.var(misses / np.sqrt(1.0 + weights**2 + (1.0 - weights) ** 2), ddof=1))
    difference_error = math.sqrt(variance * sum(1.0 / _squared_deviations(run_x[half]) for half in halves))
    bends = abs(upper - lower) > max(LARGEST_BEND, 2.0 * difference_error)
    if bends or np.abs(residual).max() > LARGEST_RESIDUAL:
        return None
    return PowerLawFit(slope, standard_error, intercept, first, last, (lower, upper))


def _squared_deviations(x: np.ndarray) -> float:
    return float(((x - x.mean()) ** 2).sum())


def accuracy_laws(result: StudyResult, figures: list[FigureTable] | None = None) -> list[Law]:
    """Fit a power law to every line of the figures that name a `theory`.

    Args:
        result: a finished sweep.
        figures: tables as in `[[figures]]`; by default those of the study.

    Raises:
        InputError: `where` names a path or a number that the study lacks, or an axis varies that the figure does not fix.
    """
    config = result.config
    laws = []
    for index, figure in enumerate(config.figures if figures is None else figures):
        if figure.theory is None:
            continue
        check_selection(config, figure, index)
        sizes = [name for name in signal_size_columns(figure.value) if name in result.columns]
        # lines without noise and at other periods tell which cause determines the error
        fixed = {path: value for path, value in resolve_where(config, figure).items() if path not in (NOISE, PERIOD)}
        parts = result.batches([*config.axis_paths, "finite", figure.value, *sizes])
        frame = pd.concat([filter_rows(part, fixed) for part in parts], ignore_index=True)
        laws += _fit_figure_lines(config, frame, figure, index)
    return laws


def _fit_figure_lines(config: Config, frame: pd.DataFrame, figure: FigureTable, index: int) -> Iterator[Law]:
    """Yield the law of each line of a figure: one for each panel and series."""
    assert figure.theory is not None
    fixed = resolve_where(config, figure)
    rows = filter_rows(frame, fixed)

    def list_values(path: str | None) -> list[JsonObject]:
        return [{}] if path is None else [{path: to_jsonable(value)} for value in sorted(rows[path].unique())]

    for facet in list_values(figure.facet):
        for series in list_values(figure.series):
            where = fixed | facet
            line = _FigureLine(config, frame, figure, where | series)
            fit = fit_power_law(line.x, line.y, line.usable)
            ends = line.explain_ends(fit)
            yield Law(figure.value, figure.x, series, where, figure.theory, fit, ends, line.x, line.y, index)


class _FigureLine:
    """One line of a figure: its points, and the size of other causes of error at each of them.

    Arrays have the shape (points,).
    """

    def __init__(self, config: Config, frame: pd.DataFrame, figure: FigureTable, fixed: JsonObject):
        self._config, self._frame, self._figure, self._fixed = config, frame, figure, fixed
        self._rows = filter_rows(frame, fixed)
        self.x, self.y = self._geometric_means(figure.value)
        self._unknown = np.full(len(self.x), np.nan)
        self._noise = self._numbers_along_line(NOISE)
        self._signal_size, self._resolution, self._relative_velocity_error = self._signal_sizes()
        self._noiseless_error = self._unknown
        if NOISE in (figure.x, *fixed):
            # along the noise axis this is one number, the floor
            noiseless_x, noiseless_y = self._geometric_means(figure.value, {NOISE: 0.0})
            if len(noiseless_x) == len(self.x) or (figure.x == NOISE and len(noiseless_y)):
                self._noiseless_error = np.broadcast_to(noiseless_y, self.x.shape)
        self._exponent_of_period = self._period_exponent() if figure.x == NOISE else self._unknown
        self.usable = np.array([self._find_other_cause(i, True) is None for i in range(len(self.x))], dtype=bool)

    def _numbers_along_line(self, path: str) -> np.ndarray:
        """Return the number at a path at each point; NaN for one that is not the line's x and varies."""
        if path == self._figure.x:
            return self.x
        section, key = path.split(".")
        numbers = self._rows[path].unique() if path in self._rows else [getattr(getattr(self._config, section), key)]
        return np.full(len(self.x), float(numbers[0]) if len(numbers) == 1 else math.nan)

    def _geometric_means(self, column: str, changes: dict[str, float] | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return each x > 0 of the line and the geometric mean of a column over the seeds there.

        `changes` are fixed values that replace those of the line.
        """
        path, changes = self._figure.x, changes or {}
        rows = filter_rows(self._frame, self._fixed | changes) if changes else self._rows
        if path not in changes:
            rows = rows[rows[path] > 0.0]
        sizes = np.abs(rows[column].astype(float)).where(rows["finite"].astype(bool))
        with np.errstate(divide="ignore"):
            means = np.exp(np.log(sizes).groupby(rows[path], sort=True).agg(lambda logs: logs.mean(skipna=False)))
        return means.index.to_numpy(float), means.to_numpy(float)

    def _signal_sizes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the size of the true signal, its float resolution, and the relative velocity error; NaN where unknown.

        A reading is rounded to eps times the position. A velocity is a change of readings divided by the period.
        """
        column = self._figure.value
        columns = signal_size_columns(column)
        if not columns or not set(columns) <= set(self._frame.columns):
            return self._unknown, self._unknown, self._unknown
        position, velocity, velocity_error = (self._geometric_means(size)[1] for size in columns)
        eps = float(np.finfo(self._config.run.precision).eps)
        if _SIGNAL_BY_METRIC[column.rpartition(".")[2]] == "position":
            return position, eps * position, velocity_error / velocity
        return velocity, eps * (position / self._numbers_along_line(PERIOD) + velocity), velocity_error / velocity

    def _period_exponent(self) -> np.ndarray:
        """Return the exponent of the error in the sampling period at each x, from the nearest other period; NaN without."""
        if PERIOD not in self._fixed:
            return self._unknown
        period = self._fixed[PERIOD]
        other_periods = np.unique(self._frame[PERIOD].to_numpy(float))
        other_periods = other_periods[~np.isclose(other_periods, period, rtol=1e-9, atol=0.0)]
        if not len(other_periods):
            return self._unknown
        nearest = float(other_periods[np.argmin(np.abs(np.log(other_periods / period)))])
        x, y = self._geometric_means(self._figure.value, {PERIOD: nearest})
        if len(x) != len(self.x):
            return self._unknown
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.log(y / self.y) / math.log(nearest / period)

    def _find_other_cause(self, i: int, must_dominate: bool) -> str | None:
        """Return the cause, other than the law, that determines the error at point i, or None.

        Unless it `must_dominate`, a weaker cause that bends the line is named as well.
        """
        y, noiseless_error, signal_size = self.y[i], self._noiseless_error[i], self._signal_size[i]
        if not math.isfinite(y):
            return "no number: a run diverged, or the metric is undefined"
        factor = 1.0 if must_dominate else _BENDING_FACTOR / _FLOOR_FACTOR
        if y <= 0.0:
            return "float resolution: the error is exactly zero"
        if y <= _RESOLUTION_FACTOR * factor * self._resolution[i]:
            return f"float resolution: the error is {_format_times(y / self._resolution[i])} the rounding of a reading"
        if y >= signal_size / (_SIGNAL_FACTOR * factor):
            return f"saturation: the error is {percent(y / signal_size)} of the signal"
        if self._figure.x == NOISE and y <= _FLOOR_FACTOR * factor * noiseless_error:
            return f"sampling period: the error is {_format_times(y / noiseless_error)} that without noise, its floor"
        noise_factor = _FLOOR_FACTOR if must_dominate else 1.1
        if self._figure.x != NOISE and self._noise[i] > 0.0 and y >= noise_factor * noiseless_error:
            share = f"{_format_times(y / noiseless_error)} that without noise" if noiseless_error else "noise alone"
            return f"noise floor: the error is {share}"
        if must_dominate:
            return None
        exponent, velocity_error = self._exponent_of_period[i], self._relative_velocity_error[i]
        if exponent > _PERIOD_EXPONENT:
            return f"sampling period: the error grows with it as h^{exponent:.2f}, as under averaged white noise"
        if velocity_error >= 1.0 / (_SIGNAL_FACTOR * factor):
            return f"saturation: the velocity error is {percent(velocity_error)} of the velocity"
        return None

    def explain_ends(self, fit: PowerLawFit | None) -> dict[str, str]:
        """Say why the law ends below and above its range; without a law, why there is none."""
        x, y = self.x, self.y
        if not len(x):
            return {"below": "no points", "above": "no points"}
        if fit is None:
            ends = {"below": 0, "above": len(x) - 1}
            other = "other: no run of points on one line"
            return {key: self._find_other_cause(i, must_dominate=False) or other for key, i in ends.items()}
        stops = {"below": END_OF_SWEEP, "above": END_OF_SWEEP}
        for key, outer, inner in (("below", fit.first - 1, fit.first), ("above", fit.last + 1, fit.last)):
            if 0 <= outer < len(x):
                cause = self._find_other_cause(outer, must_dominate=False)
                # z: no minus before a zero
                stops[key] = cause or f"other: local slope {math.log(y[outer] / y[inner], x[outer] / x[inner]):z.2f}"
        return stops


def _format_times(ratio: float) -> str:
    return f"{ratio:.2f} times" if ratio < 10.0 else f"{ratio:.2g} times"
