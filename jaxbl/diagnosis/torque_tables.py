"""What no known effect explains, as a table: torque over position, over speed, or both, from what a model still lacks.

Piecewise linear functions are fitted to the missing torque by penalised least squares. Their smoothness, and over which of
the coordinates they go, are chosen by cross-validation on blocks of the log. They have no name and explain nothing; they are
kept if the model with them predicts each quarter of the log better by tables that were fitted without it.
Reference: P. Eilers, B. Marx, Flexible smoothing with B-splines and penalties, Statistical Science 11 (1996).
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from jaxbl.chain import Experiment, with_effects
from jaxbl.drive.effects import Tabulated
from jaxbl.drive.parameters import as_arrays
from jaxbl.estimation.segments import Segment
from jaxbl.json_types import JsonObject
from jaxbl.records.least_squares import BlockRegression, mean_error

from .blocks import QUARTERS, standard_errors_better
from .reference_log import BLOCKS, Comparison, ReferenceLog, parts_of_blocks
from .residuals import Residual, SideResiduals, as_smoothed, low_passed
from .thresholds import LIMITS

_POINTS = {"position": 25, "turn": 37, "speed": 17}
"""Points of a table: waves of 12 periods over the range, or 18 a turn, still show; speeds have them where samples are."""
_GAIN = 0.03
"""Share of the rms that a table has to take away by cross-validation."""
_STIFFNESS = 10.0 ** np.arange(-4.0, 5.0)
"""Weights of the squared second differences that are tried, over the mean square of the columns."""
_RIDGE = 1e-6
"""Weight of the squares: where there are no data a table goes to zero."""
_LEAST = 5
"""Samples behind the low-pass for each point; smoothness leaves fewer free numbers than points."""
_TURN = 2.0 * np.pi


class Table(NamedTuple):
    """Torque over one coordinate.

    Attributes:
        over: position, turn (position within a turn) or speed.
        points: of it, rad or rad/s.
        torques: resisting torque at each, N m.
        errors: their standard errors, from the scatter of blocks of the log.
        left_out: torques by the rest of the log where one quarter after the other is left out, shape (quarters, points).
    """

    over: str
    points: np.ndarray
    torques: np.ndarray
    errors: np.ndarray
    left_out: np.ndarray


class Tabulation(NamedTuple):
    """A model with tables, which predicts parts of the log that they were not fitted to better than without.

    Attributes:
        tables: by side.
        experiment: the model with them.
        compared: how it compares on the log.
        z: standard errors by which it beats the model without them there.
    """

    tables: dict[str, list[Table]]
    experiment: Experiment
    compared: Comparison
    z: float

    def effects(self) -> list[JsonObject]:
        """The tables as effects of a study."""
        return [{"kind": f"{side}.{Tabulated.kind}"} | _numbers(tables) for side, tables in self.tables.items()]

    def summarise(self, held_out: ReferenceLog, compared: Comparison) -> JsonObject:
        """Write the tables as JSON, and how the model with them compares on what was held out; `compared`: the model without
        them there."""
        with_tables = held_out.compare(self.experiment)
        return {
            "tables": {
                side: [{"over": table.over, "points": table.points, "torques": table.torques, "errors": table.errors}
                       for table in tables]
                for side, tables in self.tables.items()
            },
            "z": self.z,
            "holdout_z": standard_errors_better(held_out, compared, with_tables),
            "holdout_rmse": with_tables.errors,
        }  # fmt: skip


def tabulate(
    log: ReferenceLog, experiment: Experiment, compared: Comparison, lacking: SideResiduals, sliding: Sequence[str]
) -> Tabulation | None:
    """Tables of what a model still lacks, if parts of the log that they were not fitted to are predicted better with them;
    else None.

    Args:
        log: that models are compared on.
        experiment: the model.
        compared: how it compares there.
        lacking: torques that it lacks on the log, by side, segment by segment.
        sliding: sides whose positions are no angles.
    """
    best: Tabulation | None = None
    for side in experiment.sides:
        if any(effect.name == f"{side}.{Tabulated.kind}" for effect in experiment.effects):
            continue
        tables = _fit_tables(log, lacking[side], side, rotary=side not in sliding)
        if not tables:
            continue
        tables_of_all = {**(best.tables if best else {}), side: tables}
        model = _with_tables(experiment, tables_of_all)
        quarters = [_with_tables(experiment, tables_of_all, quarter) for quarter in range(QUARTERS)]
        with_tables, before = log.compare(model, models=quarters), best.compared if best else compared
        if standard_errors_better(log, before, with_tables) > LIMITS.sure:
            best = Tabulation(tables_of_all, model, with_tables, standard_errors_better(log, compared, with_tables))
    return best


def _fit_tables(log: ReferenceLog, lacking: Sequence[Residual], side: str, *, rotary: bool) -> list[Table]:
    """Tables of the torque that a side lacks, by cross-validation; none where they take nothing away."""
    cutoff = log.bandwidth[side]
    target = -np.concatenate([low_passed(residual.torque, residual, cutoff) for residual in lacking])
    choices = _choices(log.segments, side, rotary)
    widths = {over: len(points) for over, points in choices.items()}
    columns = {
        over: np.concatenate(
            [
                _columns(segment, residual, side, over, points, cutoff)
                for segment, residual in zip(log.segments, lacking, strict=True)
            ]
        )
        for over, points in choices.items()
    }
    nothing = np.array([np.mean(part**2) for part in np.array_split(target, BLOCKS)])
    trials = []
    # coordinates alone, then a position with the speed
    for overs in [*([over] for over in choices), *([over, "speed"] for over in choices if over != "speed")]:
        if len(target) < _LEAST * sum(widths[over] for over in overs):
            continue
        matrix = np.concatenate([columns[over] for over in overs], axis=1)
        bends = np.asarray(block_diag(*(np.diff(np.eye(widths[over]), n=2, axis=0) for over in overs)))
        size, ridge = np.mean(matrix**2) * len(target), _RIDGE * np.eye(matrix.shape[1])
        regressions = [
            BlockRegression.of(target, matrix, BLOCKS, (ridge + stiffness * bends.T @ bends) * size)
            for stiffness in _STIFFNESS
        ]
        # mean squared errors of each block left out
        squares, regression = min(((fit.held_out(), fit) for fit in regressions), key=lambda trial: np.mean(trial[0]))
        gain = nothing - squares
        sure = np.mean(gain) > mean_error(gain)
        if sure and 1.0 - np.sqrt(np.mean(squares) / np.mean(nothing)) > _GAIN:
            trials.append((overs, squares, regression))
    if not trials:
        return []
    _, best, _ = min(trials, key=lambda trial: np.mean(trial[1]))
    # the fewest tables of those within one standard error of the best
    limit = np.mean(best) + mean_error(best - nothing)
    overs, _, regression = next(trial for trial in trials if np.mean(trial[1]) <= limit)
    left_out = [regression.fit(np.flatnonzero(parts_of_blocks(QUARTERS) == part)) for part in range(QUARTERS)]
    ends = np.cumsum([widths[over] for over in overs])[:-1]
    parts = (np.split(values, ends, axis=-1) for values in (regression.fit(), regression.errors(), np.stack(left_out)))
    return [Table(*columns) for columns in zip(overs, [choices[over] for over in overs], *parts, strict=True)]


def _choices(segments: Sequence[Segment], side: str, rotary: bool) -> dict[str, np.ndarray]:
    """Points over each coordinate that a log shows."""
    position, speed = (np.concatenate([segment.smoothed[side].state[:, i] for segment in segments]) for i in (0, 1))
    points = {"position": np.linspace(position.min(), position.max(), _POINTS["position"])}
    if rotary and np.ptp(position) > _TURN:
        points["turn"] = np.linspace(0.0, _TURN, _POINTS["turn"])
    # apart from one another by a share of the range, so that rows of equal samples make no point twice
    spread = np.quantile(speed, np.linspace(0.0, 1.0, _POINTS["speed"]))
    even = np.linspace(speed.min(), speed.max(), _POINTS["speed"])
    points["speed"] = 0.9 * spread + 0.1 * even
    return points


def _columns(segment: Segment, lacking: Residual, side: str, over: str, points: np.ndarray, cutoff: float) -> np.ndarray:
    """Torque of height 1 at each point of a table along a segment, as missing torques are seen; (samples, points)."""
    smoothed = segment.smoothed[side]
    values = smoothed.state[:, 1 if over == "speed" else 0]
    values = np.mod(values, _TURN) if over == "turn" else np.clip(values, points[0], points[-1])
    hats = np.stack([np.interp(values, points, heights) for heights in np.eye(len(points))])
    return low_passed(as_smoothed(hats, smoothed, segment.period), lacking, cutoff).T


def _numbers(tables: Sequence[Table]) -> JsonObject:
    """Tables as numbers of the effect."""
    numbers: JsonObject = {}
    for table in tables:
        points, torques = ("speeds", "speed_torques") if table.over == "speed" else ("positions", "position_torques")
        numbers |= {points: table.points.tolist(), torques: table.torques.tolist()}
        if table.over == "turn":
            numbers["turn"] = True
    return numbers


def _with_tables(experiment: Experiment, tables: Mapping[str, Sequence[Table]], without: int | None = None) -> Experiment:
    """A model with tables on its sides; `without`: the quarter of the log that they are fitted without."""
    added = []
    for side, of_side in tables.items():
        if without is not None:
            of_side = [table._replace(torques=table.left_out[without]) for table in of_side]
        numbers = {key: tuple(number) if isinstance(number, list) else number for key, number in _numbers(of_side).items()}
        added.append(as_arrays(Tabulated(side=side, **numbers), float))
    return with_effects(experiment, (*added, *experiment.effects))
