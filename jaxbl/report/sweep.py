"""What `jaxbl sweep` and `jaxbl plot` leave to be read: maps and lines, accuracy laws, tables."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from pandas.api.types import is_numeric_dtype

from jaxbl.config import is_boolean
from jaxbl.files import write_json
from jaxbl.gains.accuracy_laws import AGREEMENT, END_OF_SWEEP, Law
from jaxbl.gains.best_gains import NEARLY_AS_GOOD
from jaxbl.lines import percent
from jaxbl.result import KeyFigure, Result, ResultTable
from jaxbl.sweeps.axis_importance import rank_axes
from jaxbl.sweeps.metrics import find_metric, is_magnitude
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.sweep import StudyResult

from .aggregates import Groups, Rows
from .checks import values_of
from .gain_plane import RESERVE_WORDS, say_thin_reserve
from .maps import MARGINS, best_gains, draw as draw, laws_of, slope_text, value_words, with_value, worst_runs


def write(result: StudyResult, folder: Path) -> None:
    """Write `laws.json` if figures ask for laws."""
    if laws := laws_of(result):
        write_json(folder / "laws.json", [law.to_dict() for law in laws])


def describe(result: StudyResult) -> Result:
    """Say where the observers work, and which gains are best, with tables of axes that matter and of laws."""
    answer, laws = answer_sweep(result), laws_of(result)
    if not laws:
        return answer
    # the table says which
    agreeing = (
        f"Accuracy laws: {sum(law.agrees for law in laws)} of {len(laws)} have a slope within {AGREEMENT:g} of theory."
    )
    return replace(answer, remarks=[*answer.remarks, agreeing], tables=[_law_table(laws), *answer.tables])


def answer_sweep(result: StudyResult) -> Result:
    """Say where the observers work, and which gains are best, with tables of axes that matter."""
    config, survey, remarks = result.config, _Survey(result), []
    finished, figures, reserves = result.is_finished(survey.runs), [], {}
    if not finished:
        remarks.append(
            f"The study is not finished: {survey.runs} runs so far, white where none is. Go on with 'jaxbl sweep'."
        )
    if survey.diverged:
        remarks.append(f"{survey.diverged} runs diverged: finite = false in the table, grey in the figures.")
    for side, (best, runs) in survey.best.items():
        if best is None:
            remarks.append(f"{side}: no gains converge in all runs and fulfil the exact condition.")
            continue
        remarks += [
            f"{side}: the best {gain} is the {way.replace('er', 'est')} of its axis; a wider axis may have better ones."
            for gain, way in best.ends.items()
        ]
        row, reserves[side] = runs.reset_index().iloc[best.index], best.margin
        place = ", ".join(f"{name.rpartition('.')[2]} = {row[name]:.3g}" for name in runs.index.names)
        figures += [
            KeyFigure(f"{row['error']:.3g} rad/s", f"{side}: worst velocity error, rms, of the best gains ({place})"),
            KeyFigure(
                f"× {best.margin:.3g}",
                f"{side}: {RESERVE_WORDS}; {best.nearly_as_good} of {len(runs)} gains are as good within "
                f"{100 * NEARLY_AS_GOOD:g} %",
            ),
        ]
    # where gains are not varied, runs that fail are not what was sought
    partly = any(count < survey.even for side, count in survey.converged.items() if side not in survey.best)
    thin = say_thin_reserve(reserves)
    verdict = "doubtful" if not finished or partly or len(reserves) < len(survey.best) or thin else "good"
    if finished and not (survey.diverged < survey.runs and all(survey.converged.values())):
        verdict = "failed"
    elif verdict == "good" and not survey.converged:
        # of what no convergence is asked nothing is good or bad
        verdict = "no answer"
    tables = []
    for side, ranked in survey.importance.items():
        first, heading = ranked[0], f"{side}: which axis matters for the velocity error"
        way = "" if first.total is None else " and what it does together with others"
        text = (
            f"of the {side} observer's velocity error goes with {first.path}{way} (share of the variance of its logarithm)"
        )
        figures.append(KeyFigure(_share(first.total or first.alone), text))
        rows = [[axis.path, _share(axis.alone), _share(axis.total)] for axis in ranked]
        tables.append(ResultTable(heading, ["axis", "by itself", "with others"], rows))
    # the headline has the first
    figures += [*survey.list_ranges()][1:]
    headline = f"{_headline(result, survey, reserves)} {thin}".rstrip()
    return Result(config.title or "Study", verdict, headline, figures, remarks, config.notes, tables)


def _share(share: tuple[float, float] | None) -> str:
    return "–" if share is None else f"{100 * share[0]:.0f} ± {100 * share[1]:.0f} %"


_PARTED = 0.8
"""Difference of two shares of converged runs above which the value between them is said: an edge in place of a slope."""


class _Survey:
    """The numbers behind the sentences and the table of axes, found in one reading.

    Attributes:
        config: of the study.
        runs: their number; `even` those on points that are always simulated; `diverged`.
        converged: how many of the even ones converged, by side; none where the study does not say.
        by_value: the even runs and those that converged at each value of an axis of a grid, by side and path.
        best: the best gains, by side, and the worst runs with each pair of gains; none where the study does not say.
        importance: axes by what they explain of the velocity error, by side; of random designs alone.
        ranges: where the study does not say what converged: least and largest number of each metric that its figures show,
            and how many are 0.
    """

    def __init__(self, result: StudyResult):
        config = self.config = result.config
        paths = config.axis_paths
        metrics = [name for name in result.columns if name.rpartition(".")[2] in ("converged", "velocity_rmse", *MARGINS)]
        # a refined study has most of its runs at the boundary: a share of all runs would depend on the refinement
        points = Points(config)
        varied = [axis.path for axis in config.axes if values_of(config, axis) > 1] * (config.sweep.design == "grid")
        self.runs = self.even = self.diverged = 0
        self.converged = {side: 0 for side in config.sides if f"{side}.converged" in metrics}
        self.best, self.importance, self.by_value = {}, {}, {}
        self.ranges = {
            figure.value: (math.inf, -math.inf, 0)
            for figure in config.figures
            if figure.value in result.columns and not (self.converged or is_boolean(figure.value))
        }
        for frame in result.batches([*paths, "seed", "finite", *metrics, *self.ranges]):
            even = frame[points.on_coarse_grid(frame)]
            self.runs += len(frame)
            self.even += len(even)
            self.diverged += (~frame["finite"].astype(bool)).sum()
            for side in self.converged:
                self.converged[side] += even[f"{side}.converged"].sum()
                for path in varied:
                    counts = even.groupby(path)[f"{side}.converged"].agg(["size", "sum"])
                    self.by_value[side, path] = counts.add(self.by_value.get((side, path), 0.0), fill_value=0.0)
            for column, (low, high, zeros) in self.ranges.items():
                values = frame[column].abs() if is_magnitude(column) else frame[column]
                self.ranges[column] = min(low, values.min()), max(high, values.max()), zeros + (values == 0.0).sum()
        for side in config.sides:
            error, gains = f"{side}.velocity_rmse", [path for path in varied if path.startswith(f"observer.{side}.")]
            if error in metrics and (ranked := rank_axes(result, error)):
                self.importance[side] = ranked
            if error in metrics and side in self.converged and gains:
                columns = [*paths, "finite", *(name for name in metrics if name.startswith(side))]
                runs = worst_runs(Groups(Rows(result, columns), gains, paths), error)
                self.best[side] = best_gains(runs), runs

    def describe_edge(self, side: str) -> str:
        """Say up to which value of an axis, and beyond it, a side converges in the most different shares of runs; "" where
        no axis parts them by `_PARTED`."""
        edges = []
        for (judged, path), counts in self.by_value.items():
            if judged == side and is_numeric_dtype(counts.index):
                below = counts.cumsum().iloc[:-1]
                above = counts.sum() - below
                shares = zip(below.index, below["sum"] / below["size"], above["sum"] / above["size"], strict=True)
                edges += [(path, *split) for split in shares if abs(split[1] - split[2]) >= _PARTED]
        if not edges:
            return ""
        path, value, first, second = max(edges, key=lambda edge: abs(edge[2] - edge[3]))
        place = with_value(self.config, path, float(f"{value:.3g}"))
        return f" ({percent(first)} up to {place}, {percent(second)} beyond)"

    def list_ranges(self) -> Iterator[KeyFigure]:
        """From where to where metrics go, and in how many runs they are 0."""
        for column, (low, high, zeros) in self.ranges.items():
            # of a metric that no run has, nothing
            if low <= high:
                none = f" (0 in {percent(zeros / self.runs)} of the runs)" if zeros else ""
                yield KeyFigure(f"{low:.3g} to {high:.3g} {find_metric(column).unit}{none}", value_words(column))


def _headline(result: StudyResult, survey: _Survey, with_best: Iterable[str]) -> str:
    """Say in how many runs the observers converge; `with_best` are the sides that have best gains."""
    runs, among = f"{survey.runs} runs", ""
    if result.config.sweep.refine is not None:
        points = len(Points(result.config))
        simulated = survey.runs // result.config.sweep.seeds
        runs = f"{runs} at {simulated} of {points} grid points ({percent(simulated / points)})"
        among = " on the coarse grid"
    even = survey.even or math.nan
    works = dict.fromkeys(with_best, ", with the best gains in every run")
    for side in survey.converged.keys() - survey.best.keys():
        works[side] = survey.describe_edge(side)
    shares = [
        f"the {side} observer converges in {100 * count / even:.1f} %{among}{works.get(side, '')}"
        for side, count in survey.converged.items()
    ]
    if shares:
        return f"{runs}: {'; '.join(shares)}."
    extents = (f"{metric} goes from {ends}" for ends, metric in survey.list_ranges())
    return f"The study does not ask what converges. In {runs}, {next(extents, 'no figure has a number')}."


def _law_table(laws: list[Law]) -> ResultTable:
    rows = []
    for law in laws:
        texts = "no law", "–", "–"
        if law.fit and law.range:
            halves = f"{law.fit.half_slopes[0]:.2f}, {law.fit.half_slopes[1]:.2f}"
            texts = slope_text(law.fit), halves, f"{law.range[0]:g} to {law.range[1]:g} ({law.in_range.sum()})"
        slope, halves, ends = (text.replace(" ", "\u00a0") for text in texts)
        # a word stands without its path
        values = (law.series | law.where).items()
        where = ", ".join(value if isinstance(value, str) else f"{path} = {value:g}" for path, value in values)
        reason = law.stops["below"]
        if reason != law.stops["above"]:
            # the end of the sweep is named only where both ends are that
            reason = "; ".join(f"{end}: {stop}" for end, stop in law.stops.items() if stop != END_OF_SWEEP)
        rows.append(
            [f"{law.value} over {law.x}", where or "all points", law.theory, slope, halves, law.agrees, ends, reason]
        )
    columns = ["error", "where", "theory", "slope", "halves", "agrees", "range (points)", "why it ends there"]
    return ResultTable("Accuracy laws", columns, rows)
