"""What `jaxbl tune` with `tune.observers` leaves to be read: how many times the best observer's error each kind has."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tomli_w

from jaxbl.config import Config
from jaxbl.files import write_atomic
from jaxbl.gains.observer_choice import TIME_CONSTANT, ObserverChoice, runs_are_equal
from jaxbl.json_types import JsonObject
from jaxbl.result import KeyFigure, Result, ResultTable

from .maps import axis_label, with_value
from .panels import SIDE_COLOURS, Axis, Figure, Line, Map, Panel, Scale, Span, arrange, intervals, name_rows, tick_text
from .tune import error_label, for_title


def draw(choice: ObserverChoice) -> Iterator[Figure]:
    """All figures of a choice: intervals for a single point, else a map for each side."""
    first, *more = choice.summary["points"]
    if more:
        yield from (_map(choice.config, choice.summary, side) for side in first["sides"])
    else:
        yield _ratios(choice.summary)


_RATIO = "ratio", "low", "high"


def _ratios(summary: JsonObject) -> Figure:
    """Ratios with their intervals, a panel for each side."""
    panels = []
    for side, result in summary["points"][0]["sides"].items():
        kinds = result["kinds"]
        # the last ones have no ratio
        ratios = pd.DataFrame(kinds, _RATIO).astype(float)
        ratio, low, high = ratios.dropna(axis=1).to_numpy()
        texts = [
            "best" if kind == result["best"] else _ratio(numbers, "diverged, or too slow") for kind, numbers in kinds.items()
        ]
        parts = [
            Span(1.0, 1.0, width=0.8, dashes="-"),
            *intervals(range(len(high)), low, ratio, high, colour=SIDE_COLOURS[side]),
            Line(ratios.loc["high"].fillna(0.9), range(len(kinds)), width=0.0, marker=" ", texts=texts),
        ]
        x = Axis("times the best one's error", log=True, ends=(0.9, 1.2 * (2.0 + max(high, default=1.0)) ** 1.5))
        panels.append(Panel(x, name_rows([*kinds]), parts, side))
    caption = (
        f"{error_label(summary)} of each kind over the best one's, {_where(summary)}: geometric mean over noise seeds, with "
        "its 95 % interval where they differ."
    )
    return Figure("observers", panels, caption, len(panels), 5.2 * len(panels), 0.9 + 0.34 * len(summary["observers"]))


def _ratio(result: JsonObject, none: str = "–") -> str:
    """The ratio, with its interval if runs differ; more digits where it would read as one; `none` where there is none."""
    if result["ratio"] is None:
        return none
    ratio, low, high = (f"{result[key]:.{3 if abs(result[key] - 1.0) > 0.005 else 6}g}" for key in _RATIO)
    return ratio if runs_are_equal(result) else f"{ratio} ({low} to {high})"


def _varied_values(config: Config, summary: JsonObject, side: str) -> dict[str, list[Any]]:
    """Values of the axes that have several, in their order; of axes that advance together, those of the side's own, or of
    the first."""
    together = {}
    assert config.tune is not None
    for axis in config.tune.axes:
        together.setdefault(axis.zip or axis.path, []).append(axis.path)
    paths = [min(zipped, key=lambda path: f".{side}_" not in path) for zipped in together.values()]
    columns = {path: list(dict.fromkeys(point["values"][path] for point in summary["points"])) for path in paths}
    return {path: values for path, values in columns.items() if len(values) > 1}


def short_names(kinds: Sequence[str]) -> dict[str, str]:
    """Few letters for each kind: the initials of its words, with a number in full, and a stroke where two are the same."""
    names = {}
    for kind in kinds:
        name = "".join(word if word.isdigit() else word[0].upper() for word in kind.split("_"))
        while name in names.values():
            name += "'"
        names[kind] = name
    return names


def _axis(config: Config, path: str, values: Sequence[Any]) -> Axis:
    """An axis with its values in words, evenly."""
    texts = [tick_text(value) if isinstance(value, int | float) else str(value) for value in values]
    return Axis(axis_label(config, path), path, ends=(-0.5, len(values) - 0.5), names=tuple(enumerate(texts)))


def _map(config: Config, summary: JsonObject, side: str) -> Figure:
    """The best kind at each point; a panel for each value of further axes."""
    varied, short, kinds = _varied_values(config, summary, side), short_names(summary["observers"]), summary["observers"]
    # over one axis a map has a single row
    (x, xs), (y, ys), *_ = [*reversed(varied.items()), ("", [None])]
    further = dict([*varied.items()][:-2])
    points = {
        tuple(point["values"].get(path) for path in (*further, y, x)): point["sides"][side] for point in summary["points"]
    }
    axes = _axis(config, x, xs), _axis(config, y, ys) if y else Axis(names=((0.0, ""),))
    edges = [np.arange(len(values) + 1) - 0.5 for values in (xs, ys)]
    numbers = {kind: i % 10 for i, kind in enumerate(kinds)}
    winners = {point["best"] for point in points.values()}
    panels, columns = [], arrange(math.prod(map(len, further.values())))
    for values in product(*further.values()):
        cells = [points[*values, v, u] for v in ys for u in xs]
        best = np.array([numbers.get(cell["best"], np.nan) for cell in cells]).reshape(len(ys), len(xs))
        rows_of_cells, columns_of_cells = np.indices(best.shape).reshape(2, -1)
        parts = [
            Map(*edges, best, Scale(-0.5, 9.5, "", colours="tab10"), np.isnan(best), "all diverge, or are too slow"),
            Line(columns_of_cells, rows_of_cells, width=0.0, texts=[_cell_text(cell, short) for cell in cells]),
        ]
        title = ", ".join(with_value(config, *pair) for pair in zip(further, values, strict=True))
        panels.append(Panel(*axes, parts, title))
    names = ", ".join(f"{short[kind]}: {kind}" for kind in kinds if kind in winners)
    caption = (
        f"{side}: the kind with the least {error_label(summary)} at each point ({names}), {_where(summary)}, and below it "
        f"how many times that error {kinds[0]} ({short[kinds[0]]}) has (–: diverged). An equals sign: another kind's error "
        "may be as small (95 % interval)."
    )
    width, height = max(0.95 * len(xs), 2.6) * columns + 1.0, max(0.72 * len(ys), 1.6) + 0.7
    return Figure(f"observers_{side}", panels, caption, columns, width, height)


def _cell_text(point: JsonObject, short: dict[str, str]) -> str:
    """The best kind at a point in letters, and how many times its error the first kind has."""
    best, (reference, *_) = point["best"], short
    if best is None:
        return ""
    text, ratio = short[best] + ("=" if point["not_told_apart"] else ""), point["kinds"][reference]["ratio"]
    return text if best == reference else f"{text}\n{short[reference]} {'–' if ratio is None else f'×{ratio:.2g}'}"


def write(choice: ObserverChoice, folder: Path) -> None:
    """Write `gains.toml` of a single point."""
    if gains := observer_toml(choice.summary):
        write_atomic(folder / "gains.toml", gains)


def describe(choice: ObserverChoice) -> Result:
    """Say which kind of observer is best, and by how much."""
    config, summary = choice.config, choice.summary
    points, kind = summary["points"], summary.get("for_both_sides")
    figures = [
        KeyFigure(name, f"{side}: {share} ({summary['objective']} error, {_where(summary)})")
        for side in points[0]["sides"]
        for name, share in _best_kinds(points, side)[:1]
    ]
    verdict, headline = "good", f"Take {kind}: gains.toml has its gains."
    if not figures:
        verdict, headline = "failed", "All kinds of observers diverge, or are too slow."
    elif kind is None:
        headline = "Which observer is best depends on the point; the map shows where."
        if len(points) == 1:
            verdict, headline = "doubtful", "No kind converges on both sides."
    title, remarks, tables = config.title or "Observers", [*choice_headline(summary)], [*_tables(config, summary)]
    return Result(title, verdict, headline, figures, remarks, summary["remarks"], tables)


def observer_toml(summary: JsonObject) -> str | None:
    """The kind that is best on both sides together, with its gains, as TOML that a study can `include`; None where several
    points were compared, or no kind converges on both sides."""
    kind = summary.get("for_both_sides")
    if kind is None:
        return None
    sides = {side: result["kinds"][kind] for side, result in summary["points"][0]["sides"].items()}
    lines = [
        f"# Observer chosen by 'jaxbl tune'{for_title(summary)}",
        f"# Objective: {summary['objective_metric']}, among {', '.join(summary['observers'])}.",
        *(f"# {side}: {result['ratio']:.3g} times the error of the best kind there." for side, result in sides.items()),
        '# To use it, put include = "gains.toml" at the top of a study and leave its own [observer] out.',
    ]
    gains = {side: dict(result["gains"]) for side, result in sides.items()}
    constants = {side: gains[side].pop(TIME_CONSTANT) for side in sides if TIME_CONSTANT in gains[side]}
    data = {"observer": {"kind": kind, **gains}}
    if constants:
        data["equivalent_control"] = {"time_constant": constants.get("motor")}
        if len(constants) > 1:
            times = ", ".join(f"{side}: {value:.3g} s" for side, value in constants.items())
            lines.append(f"# A study has one equivalent_control.time_constant; the best of each side: {times}.")
    return "\n".join([*lines, tomli_w.dumps(data)])


def _where(summary: JsonObject) -> str:
    """Which runs were compared."""
    runs = summary["holdout"]
    first, last = runs["seeds"]
    input_ = "the study's excitation, other noise" if runs["same_excitation"] else f"held out: {runs['excitation']['kind']}"
    return f"{input_}, {last - first + 1} seeds"


def _best_kinds(points: Sequence[JsonObject], side: str) -> list[tuple[str, str]]:
    """Kinds that are best somewhere on a side, the most frequent one first, and the words for where."""
    counts = Counter(point["sides"][side]["best"] for point in points)
    del counts[None]
    where = " at {} of {} points" if len(points) > 1 else ""
    return [(kind, f"best{where.format(count, len(points))}") for kind, count in counts.most_common()]


def choice_headline(summary: JsonObject) -> Iterator[str]:
    """Which kind is best on each side, at how many points, and what fails; the table has by how much."""
    points = summary["points"]
    for side in points[0]["sides"]:
        results = [point["sides"][side] for point in points]
        kinds = [f"{kind} is {share}" for kind, share in _best_kinds(points, side)]
        clauses = [f"{side}: {', '.join(kinds) or 'all kinds diverge, or are too slow'}"]
        further = {
            "not told apart from the best": [kind for result in results for kind in result["not_told_apart"]],
            "diverge somewhere, or are too slow": [
                kind for result in results for kind, numbers in result["kinds"].items() if numbers["ratio"] is None
            ],
        }
        if kinds:
            clauses += [f"{lead}: {', '.join(dict.fromkeys(names))}" for lead, names in further.items() if names]
        yield f"{'; '.join(clauses)}."


def _tables(config: Config, summary: JsonObject) -> Iterator[ResultTable]:
    """A table for each side: of a single point all kinds with their gains, else the ratios at each point."""
    points, kinds, axes = summary["points"], summary["observers"], summary["axes"]
    for side, first in points[0]["sides"].items():
        if len(points) == 1:
            heading = side
            columns = ["observer", error_label(summary), "worst run", "times the best", "from", "to", "gains"]
            rows = [
                [kind, *(numbers[key] for key in ("error", "worst", *_RATIO)),
                 ", ".join(f"{key} = {value:.4g}" for key, value in numbers["gains"].items())]
                for kind, numbers in first["kinds"].items()
            ]  # fmt: skip
        else:
            heading = f"{side}: times the best one's error (95 % interval)"
            columns = [*(axis_label(config, path) for path in axes), "best", "not told apart", *kinds]
            rows = [
                [*(point["values"][path] for path in axes), result["best"] or "none", ", ".join(result["not_told_apart"]),
                 *(_ratio(result["kinds"][kind]) for kind in kinds)]
                for point in points
                for result in [point["sides"][side]]
            ]  # fmt: skip
        yield ResultTable(f"{heading}, {_where(summary)}", columns, rows)
