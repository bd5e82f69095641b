"""From a record to numbers: several starts on short windows, the whole record from the best, and what it does not show."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaxbl.chain import Experiment
from jaxbl.config.logs import IdentifyTable
from jaxbl.errors import InputError

from .free_parameters import FreeParameter, set_free_parameters
from .intervals import Refusal, Spread, refusals, spread
from .plant_steps import refine_steps
from .prediction import predictor
from .segments import Segment, windows_of
from .trajectory import Fit, Windows, fit

_LONG, _SHORT = 500, 50
"""Samples of the windows that are tried where no length is asked for."""
_MOST_COARSE = 100
"""Short windows, spread over the record, that the starts are compared on."""
_FEW_STEPS = 30
"""Of the solver, from each start."""
_FEWEST = 20
"""Samples of a window at least: ten times the states that are fitted to it."""
_PASSES = 2
"""Choices of the predictor's gain, each followed by a fit."""
_SURE = 3.0
"""Standard errors by which residuals' variances differ surely."""
NOISE_ALONE = 1.1
"""Residuals over the noise, rms, up to which a model counts as explaining a record."""


def is_noise(residual: Mapping[str, float]) -> bool:
    """Return True if a residual of the positions (its `rms` and `noise`) counts as noise alone."""
    return residual["rms"] < NOISE_ALONE * residual["noise"]


@dataclass(frozen=True)
class SearchFit:
    """A fit to all of a log.

    Attributes:
        free: numbers that were fitted.
        fit: from the best start.
        spread: its covariance.
        windows: the record as it was fitted.
        smoothness: of each side's predictor; empty for output error.
        steps: plant steps in a sample.
        errors: of theta, that finer steps or windows of another length show, each of shape (parameters,).
        between: by how much theta differs between the window lengths that were tried; None if there was one.
        refused: directions that the record does not show.
        held: numbers that were left at their nominal values therefore.
        condition: of the information about all numbers asked for.
        starts: whether each start agrees with the best.
    """

    free: tuple[FreeParameter, ...]
    fit: Fit
    spread: Spread
    windows: Windows
    smoothness: dict[str, float]
    steps: int
    errors: Sequence[np.ndarray] = ()
    between: np.ndarray | None = None
    refused: Sequence[Refusal] = ()
    held: Sequence[str] = ()
    condition: float = np.nan
    starts: Sequence[bool] = ()

    @property
    def samples(self) -> int:
        """Length of a window."""
        return self.windows.torque.shape[1]

    @property
    def openness(self) -> float:
        """Logarithm of how much of the numbers is left open; not finite where the model diverges."""
        return float(2.0 * np.sum(np.log(self.spread.deviations)))


@dataclass(frozen=True)
class ParameterSearch:
    """Search of one log's numbers.

    Attributes:
        experiment: the nominal model, with array leaves; its sample period is that of the log.
        segments: of the log.
        settings: `[identify]` of the study.
        at_rest: whether the log begins at rest.
        name: of the log, for messages.
    """

    experiment: Experiment
    segments: Sequence[Segment]
    settings: IdentifyTable
    at_rest: bool
    name: str

    @property
    def lengths(self) -> list[int]:
        """Samples of the windows that are tried.

        Raises:
            InputError: windows of a length that the log does not allow.
        """
        settings, period = self.settings, self.segments[0].period
        shortest, longest = (of(map(len, self.segments)) for of in (min, max))
        if settings.window is None:
            short = min(_SHORT, shortest // 2)
            lengths = [short, min(_LONG, max(shortest // 2, short))]
            return lengths[1:] if settings.method == "prediction_error" else lengths
        asked = round(settings.window / period)
        if not _FEWEST <= asked <= longest:
            raise InputError(
                f"identify.window: {settings.window:g} s are {asked} samples; it should be between {_FEWEST} samples "
                f"({_FEWEST * period:g} s) and the log's longest part ({longest * period:g} s)"
            )
        return [asked]

    def run(self, free: tuple[FreeParameter, ...]) -> SearchFit:
        """Fit; of directions that the record does not show, one number at a time is taken out.

        Raises:
            InputError: the model diverges, or windows are of a length that the log does not allow.
        """
        theta, starts = self._coarse(free)
        best = self._whole(free, theta)
        refused, condition = refusals(best.free, best.spread)
        held, left = [], refused
        while left and len(free) > 1:
            worst = max(left, key=lambda refusal: refusal.deviation)
            out = max(worst.direction, key=lambda path: abs(worst.direction[path]))
            held.append(out)
            is_free = np.array([parameter.path != out for parameter in free])
            free, theta = tuple(itertools.compress(free, is_free)), theta[is_free]
            best = self._whole(free, theta)
            left, _ = refusals(best.free, best.spread)
        return replace(best, refused=refused, held=held, condition=condition, starts=starts)

    def _coarse(self, free: tuple[FreeParameter, ...]) -> tuple[np.ndarray, list[bool]]:
        """Best of several starts, on short windows from all over the record; phases within half a turn of nominal ones.

        Starts agree with it whose costs are at most 1 % larger; of the cost of noise alone, if that is more.
        """
        windows = windows_of(self.segments, self.experiment, self.lengths[0], self.at_rest).some(_MOST_COARSE)
        random = np.random.default_rng(self.settings.seed)
        reach = np.log(self.settings.spread)
        thetas = np.zeros((self.settings.starts, len(free)))
        thetas[1:] = random.uniform(-reach, reach, thetas[1:].shape)
        tries = [fit(self.experiment, free, windows, theta, _FEW_STEPS, rounds=1) for theta in thetas]
        cost = np.array([end.cost for end in tries])
        cost = np.where(np.isfinite(cost), cost, np.inf)
        if not np.isfinite(cost).any():
            raise InputError(f"{self.name}: the model diverges from every start; its nominal numbers should be nearer")
        best = int(np.argmin(cost))
        # fits end where they change residuals by little beside the noise: without noise, costs may be any times one another
        same = cost[best] + 0.01 * max(cost[best], tries[best].residual.size / 2)
        theta, is_angle = tries[best].theta, np.array([parameter.role == "angle" for parameter in free])
        return theta - 2.0 * np.pi * np.round(theta / (2.0 * np.pi)) * is_angle, (cost <= same).tolist()

    def _whole(self, free: tuple[FreeParameter, ...], theta: np.ndarray) -> SearchFit:
        """Fit of the numbers that are kept to all of the record, in windows of the length that leaves them least open."""
        fits: list[SearchFit] = []
        for samples in self.lengths:
            windows = windows_of(self.segments, self.experiment, samples, self.at_rest)
            smoothness: dict[str, float] = {}
            if self.settings.method == "prediction_error":
                for _ in range(_PASSES):
                    windows, smoothness = predictor(set_free_parameters(self.experiment, free, theta), windows)
                    theta = fit(self.experiment, free, windows, theta).theta
            end = fit(self.experiment, free, windows, theta)
            windows, end, errors, steps = refine_steps(self.experiment, free, windows, end)
            width = spread(end).with_error(*errors)
            fits.append(SearchFit(free, end, width, windows, smoothness, steps, errors))
        fits = [candidate for candidate in fits if np.isfinite(candidate.openness)]
        if not fits:
            raise InputError(f"{self.name}: the model diverges on this log; its nominal numbers should be nearer")
        growth = fits[-1].spread.variance / fits[0].spread.variance - 1.0
        best, *runners_up = sorted(fits, key=lambda candidate: candidate.openness)
        grows = growth > _SURE * np.sqrt(2.0 / best.fit.residual.size)
        return _between(best, runners_up[0], grows) if runners_up else best


def _between(best: SearchFit, other: SearchFit, grows: bool) -> SearchFit:
    """Count what another window length would have said, where the model leaves more than noise, or the longer windows leave
    more than the shorter ones (`grows`).

    Then each length finds other numbers, by more than noise does: free runs weigh what is missing by its duration; and what
    a disturbance leaves is alike for as long as a window lasts.
    """
    change = other.fit.theta - best.fit.theta
    width = best.spread
    if grows or float(width.variance) > NOISE_ALONE**2:
        width = spread(best.fit, best.samples).with_error(change, *best.errors)
    return replace(best, spread=width, between=change)
