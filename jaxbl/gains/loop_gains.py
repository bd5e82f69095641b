"""Gains of a closed loop: `jaxbl tune` with an objective of the loop, and the loop's margins in `jaxbl verify`.

Where a controller reads the observers, each gain makes another motion, so that no bound f⁺ of one pilot run holds for all.
Observer and controller gains are searched together, by simulation: quasi-random ones, then zooms around the best.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from jaxbl.chain import NamedArrays
from jaxbl.config import LOOP_OBJECTIVES, numeric_paths
from jaxbl.config.study import suggest_path
from jaxbl.drive.parameters import get_leaf
from jaxbl.errors import InputError, NoResult
from jaxbl.files import to_jsonable
from jaxbl.json_types import JsonObject
from jaxbl.sweeps.metrics import SIDE_METRICS
from jaxbl.sweeps.points import draw_sobol

from .observer_choice import LEAST_HELD_OUT_SEEDS, GainValues, SideSearch, rank_kinds
from .pilot import Scenarios, list_scenarios
from .stages import GainChoice, Stages

GAIN_SECTIONS = "controller.", "observer.", "equivalent_control."
"""Where the gains of a loop stand."""
_REACH = 10.0
"""Factor up and down from the study's own gain that is searched where no range is given."""
_ZOOM = 1.0 / 6.0
"""Half width of the next window, as a share of the last one on a log scale: a dozen gains leave no finer grid."""
_COARSE, _FINE = 2.0 ** (np.arange(1, 13) / 2.0), np.arange(40)
"""Factors on a gain by which a margin is sought; steps in the interval of them in which the loop fails."""


@dataclasses.dataclass(frozen=True)
class LoopTuning(GainChoice):
    """Gains of a closed loop, tuned together.

    Attributes:
        candidates: one row for each set of gains tried: `stage`, gains by path, and the largest of each metric of
            `LOOP_OBJECTIVES` over all runs, infinite where one has none; `error`, infinite where a limit is not kept.
    """

    candidates: pd.DataFrame


class LoopRuns:
    """Runs of a closed loop with other gains, on all drives that they must serve.

    Attributes:
        side: whose position follows the reference.
    """

    def __init__(self, scenarios: Scenarios, stages: Stages):
        assert stages.config.controller is not None
        self.scenarios, self.stages, self.side = scenarios, stages, stages.config.controller.side
        self.experiment = stages.config.build()

    def read_study_gains(self, paths: Iterable[str]) -> GainValues:
        """Return the study's own gains."""
        return {path: float(get_leaf(self.experiment, path) or 0.0) for path in paths}

    def simulate(self, name: str, gains: pd.DataFrame, held_out_seeds: int | None = None) -> NamedArrays:
        """Simulate sets of gains, one a row. Returns metrics of `LOOP_OBJECTIVES`, shape (sets, runs), infinite for none."""
        corners = pd.DataFrame(self.scenarios.columns, index=range(len(self.scenarios.names)))
        trials = gains.merge(corners, how="cross")
        data = self.stages.tables_of(self.scenarios.config, name, held_out_seeds)
        data["sweep"]["metrics"] = metrics = list(LOOP_OBJECTIVES.values())
        names = [f"{self.side}.{metric}" for metric in metrics]
        values = self.stages.run_trials(data, name, trials, names).values()
        return {
            metric: np.where(np.isnan(runs), np.inf, runs).reshape(len(gains), -1)
            for metric, runs in zip(metrics, values, strict=True)
        }

    def find_margins(self, gains: GainValues) -> JsonObject:
        """Find by what factors each gain alone may fall and rise, until the loop no longer holds.

        It holds while the following error's range in the last quarter stays within twice the given gains' one, or within the
        position tolerance. Returns `down` and `up` by path, the last factor that holds; None where the largest one does.
        """
        tolerance = self.experiment.run.position_tolerance / self.experiment.drive.ratio(self.side)

        def try_factors(ladders: Mapping[Any, np.ndarray], stage: str) -> tuple[dict[Any, np.ndarray], float]:
            sets = [
                gains | {path: gains[path] * factor**way} for (path, way), ladder in ladders.items() for factor in ladder
            ]
            ranges = self.simulate(f"margins-{stage}", pd.DataFrame([gains, *sets]))["limit_cycle_amplitude"].max(axis=1)
            holds = ranges[1:] <= max(tolerance, 2.0 * ranges[0])
            return dict(zip(ladders, holds.reshape(len(ladders), -1), strict=True)), float(ranges[0])

        holds, given_range = try_factors({(path, way): _COARSE for path in gains for way in (-1, 1)}, "coarse")
        if not np.isfinite(given_range):
            return {}
        first_failures = {key: int(np.argmin(there)) for key, there in holds.items() if not there.all()}
        ladders = {key: _COARSE[i] * _COARSE[0] ** (_FINE / len(_FINE) - 1.0) for key, i in first_failures.items()}
        last = {}
        if ladders:
            fine, _ = try_factors({key: ladder[1:] for key, ladder in ladders.items()}, "fine")
            last = {key: float(ladders[key][np.argmin([True, *there, False]) - 1]) for key, there in fine.items()}
        return {path: {"down": last.get((path, -1)), "up": last.get((path, 1))} for path in gains}


def tune_loop(stages: Stages) -> LoopTuning:
    """Tune the gains of a closed loop.

    Raises:
        InputError: a path of `tune.gains` does not exist, or is 0 and has no range.
        NoResult: no gains keep the limits.
    """
    stages.write_manifest()
    config, table = stages.config, stages.table
    runs = LoopRuns(list_scenarios(config, table.worst_over_uncertainty), stages)
    objective = LOOP_OBJECTIVES[table.objective]
    search = SideSearch(_find_ranges(runs), widest_cell=_ZOOM)
    study_gains = runs.read_study_gains(search.limits)
    stages.total_lanes = (1 + table.refine) * table.trials * config.sweep.seeds * len(runs.scenarios.names)
    tables = []
    for stage in range(1 + table.refine):
        trials = search.trial_gains(draw_sobol(len(study_gains), table.trials, stage))
        if stage == 0:
            trials = [study_gains, *trials]
        frame = pd.DataFrame(trials)
        worst = {name: values.max(axis=1) for name, values in runs.simulate(f"loop-{stage}", frame).items()}
        keeps = (worst["settling_time"] <= (table.longest_settling or np.inf)) & (
            worst["limit_cycle_amplitude"] <= (table.largest_limit_cycle or np.inf)
        )
        errors = np.where(keeps, worst[objective], np.inf)
        tables.append(frame.assign(**worst, stage=stage, error=errors))
        search.zoom_in(trials, errors)
    if not search.best:
        raise NoResult("tune: no gains of the loop stay finite and keep longest_settling and largest_limit_cycle")
    best = {path: float(f"{value:.6g}") for path, value in search.best.items()}
    seeds = max(config.sweep.seeds, LEAST_HELD_OUT_SEEDS)
    sets = {"tuned": best} | ({} if best == study_gains else {"study": study_gains})
    # under other noise
    metrics = runs.simulate("loop-holdout", pd.DataFrame(list(sets.values())), seeds)
    summary = stages.describe() | {
        "objective_metric": f"{runs.side}.{objective} ({SIDE_METRICS[objective].unit})",
        "gains": best,
        "trials": table.trials * (1 + table.refine),
        "held_out_seeds": seeds,
        "error_in_search": search.error,
        "at_range_end": search.gains_at_ends(),
        "compared": {
            name: {"gains": gains} | {metric: values[i].max() for metric, values in metrics.items()}
            for i, (name, gains) in enumerate(sets.items())
        },
        "ranking": rank_kinds(dict(zip(sets, metrics[objective], strict=True))),
        "margins": runs.find_margins(best),
    }
    return LoopTuning(config, to_jsonable(summary), stages.cost, tuple(stages.fallback_reasons), pd.concat(tables))


def _find_ranges(runs: LoopRuns) -> dict[str, tuple[float, float]]:
    """Return the range of each gain, by path: those of the study, or a decade around each of the observers' gains."""
    config, table = runs.stages.config, runs.stages.table
    ranges: dict[str, Any] = {gain.path: (gain.start, gain.stop) for gain in table.gains}
    paths = {path: doc for path, doc in numeric_paths(config).items() if path.startswith(GAIN_SECTIONS)}
    for i, path in enumerate(ranges):
        if path not in paths:
            raise InputError(f"tune.gains[{i}].path: unknown path '{path}'; {suggest_path(path, paths)}")
    for side in () if ranges else runs.experiment.sides:
        ranges |= {f"observer.{side}.{key}": (None, None) for key in getattr(runs.experiment.observer, side).gains()}
    for path, value in runs.read_study_gains([path for path, ends in ranges.items() if None in ends]).items():
        if not value > 0.0:
            raise InputError(f"tune.gains: {path} is {value:g} in the study; give its start and stop in [[tune.gains]]")
        low, high = ranges[path]
        ranges[path] = low or min(value, high or value) / _REACH, high or max(value, low or value) * _REACH
    return ranges
