"""What `jaxbl tune` with `tune.observers` leaves to be read: how many times the best observer's error each kind has."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false

from collections import Counter
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from matplotlib.colors import to_rgb
from matplotlib.ticker import LogLocator

from jaxbl.config import Config, numeric_paths
from jaxbl.files import write_json
from jaxbl.gains.observer_choice import TIME_CONSTANT, ObserverChoice, runs_are_equal
from jaxbl.json_types import JsonObject
from jaxbl.lines import Lines
from jaxbl.result import KeyFigure, Result, ResultTable
from jaxbl.sweeps.metrics import SIDE_METRICS

from .figures import COLOURS, MISSING, SIDE_COLOURS, Axes, Drawn, Line2D, Patch, legend_below, style, subplots
from .maps import axis_label, set_up_map
from .tune import error_label, for_title

_KIND_COLOURS = (
    "#CC6677",
    "#88CCEE",
    "#DDCC77",
    "#117733",
    "#AA4499",
    "#44AA99",
    "#999933",
    "#882255",
    "#332288",
    "#DDDDDD",
)
"""Of kinds on a map: P. Tol's muted scheme, for all colour visions."""


@style()
def draw_choice(choice: ObserverChoice) -> list[Drawn]:
    """All figures of a choice: bars for a single point, else a map for each side."""
    summary = choice.summary
    sides = list(summary["points"][0]["sides"])
    if len(summary["points"]) == 1:
        return [_bars(summary, sides)]
    if len(_varied_values(choice.config, summary, sides[0])) == 1:
        return [_lines(choice.config, summary, side) for side in sides]
    return [_map(choice.config, summary, side) for side in sides]


def _sort_kinds(kinds: JsonObject) -> tuple[dict[str, JsonObject], list[str]]:
    """Kinds with a ratio, best first, and names of those without."""
    compared = {kind: result for kind, result in kinds.items() if result["ratio"] is not None}
    return compared, [kind for kind in kinds if kind not in compared]


def _bars(summary: JsonObject, sides: Sequence[str]) -> Drawn:
    """Ratios with their intervals, a panel for each side."""
    count = len(summary["observers"])
    figure, axes = subplots(5.4 * len(sides), 1.3 + 0.34 * count, 1, len(sides), beside=True)
    for ax, side in zip(axes, sides, strict=True):
        kinds = summary["points"][0]["sides"][side]["kinds"]
        compared, _ = _sort_kinds(kinds)
        highest = max((result["high"] for result in compared.values()), default=1.0)
        for i, result in enumerate(compared.values()):
            ratio, low, high = (result[key] for key in _RATIO)
            ax.errorbar(ratio, i, xerr=[[ratio - low], [high - ratio]], fmt="o", ms=6, capsize=3, color=SIDE_COLOURS[side])
            text = "best" if i == 0 else _ratio(result)
            ax.annotate(f"  {text}", (high, i), va="center", fontsize=9, xytext=(4, 0), textcoords="offset points")
        for i in range(len(compared), count):
            ax.annotate("diverged, or too slow", (0.02, i), xycoords=("axes fraction", "data"), va="center", color="#555555")
        ax.axvline(1.0, color="black", lw=0.8)
        ax.set(xscale="log", xlim=(0.9, 1.2 * (2.0 + highest) ** 1.5), title=side, xlabel="times the best one's error")
        ax.xaxis.set_major_locator(LogLocator(numticks=5))
        ax.xaxis.set_major_formatter("{x:g}")
        ax.set_yticks(range(count), kinds)
        ax.set_ylim(count - 0.5, -0.5)
        ax.grid(axis="y", visible=False)
    return Drawn(
        "observers",
        figure,
        f"{error_label(summary)} of each kind over the best one's, {_where(summary)}: geometric mean over noise seeds, with "
        "its 95 % interval where they differ.",
    )


_RATIO = "ratio", "low", "high"


def _ratio(result: JsonObject) -> str:
    """The ratio, with its interval if runs differ; more digits where it would read as one."""
    ratio, low, high = (f"{result[key]:.{3 if abs(result[key] - 1.0) > 0.005 else 6}g}" for key in _RATIO)
    return ratio if runs_are_equal(result) else f"{ratio} ({low} to {high})"


def _varied_values(config: Config, summary: JsonObject, side: str) -> dict[str, list[Any]]:
    """Values of the axes that have several, in their order; of axes that advance together, those of the side's own, or of
    the first."""
    together: dict[str, list[str]] = {}
    for axis in config.tune.axes if config.tune is not None else ():
        together.setdefault(axis.zip or axis.path, []).append(axis.path)
    paths = [min(zipped, key=lambda path: f".{side}_" not in path) for zipped in together.values()]
    columns = {path: list(dict.fromkeys(point["values"][path] for point in summary["points"])) for path in paths}
    return {path: values for path, values in columns.items() if len(values) > 1}


def _place(ax: Axes, name: str, values: Sequence[Any]) -> tuple[np.ndarray, bool]:
    """Set up the axis x or y for values. Returns where each of them is, and whether that is on a logarithmic scale, where
    they grow by factors."""
    are_numbers = all(isinstance(value, int | float) for value in values)
    if are_numbers and min(values) > 0.0 and max(values) / min(values) > 20.0:
        ax.set(**{f"{name}scale": "log"})
        return np.asarray(values, float), True
    texts = [f"{value:.4g}" if are_numbers else str(value) for value in values]
    ax.set(**{f"{name}ticks": range(len(values)), f"{name}ticklabels": texts})
    return np.arange(len(values), dtype=float), False


def _lines(config: Config, summary: JsonObject, side: str) -> Drawn:
    """Errors over the one axis that has several values."""
    ((path, values),) = _varied_values(config, summary, side).items()
    figure, (ax,) = subplots(8.4, 4.6, beside=True)
    xs, _ = _place(ax, "x", values)
    for i, kind in enumerate(summary["observers"]):
        errors = [point["sides"][side]["kinds"][kind]["error"] for point in summary["points"]]
        look: JsonObject = {"color": COLOURS[i % len(COLOURS)], "ls": ("-", "--", ":")[i // len(COLOURS) % 3]}
        ax.plot(xs, np.array(errors, float), "o", ms=4, label=kind, **look)
    ax.set(yscale="log", xlabel=axis_label(config, path), ylabel=f"{side}: {error_label(summary)}", title=side)
    figure.legend(handles=ax.get_legend_handles_labels()[0], loc="outside right center")
    return Drawn(f"observers_{side}", figure, f"{side}: error of each kind, tuned at each point, {_where(summary)}.")


def _two_digits(value: float) -> str:
    """A number that is read at a glance."""
    return f"{float(f'{value:.2g}'):g}" if value < 1e5 else f"{value:.0e}"


_SHORT_LIMIT = 3
"""Letters of a kind on a map."""


def short_names(kinds: Sequence[str]) -> dict[str, str]:
    """Few letters for each kind: the initials of its words, with a number in full; more letters where two are the same."""
    names: dict[str, str] = {}
    for kind in kinds:
        words = kind.split("_")
        name = "".join(word if word.isdigit() else word[0].upper() for word in words)
        if name in names.values():
            name = words[0][:_SHORT_LIMIT].capitalize()
        while name in names.values():
            name += "'"
        names[kind] = name
    return names


def _map(config: Config, summary: JsonObject, side: str) -> Drawn:
    """The best kind at each point; a panel for each value of further axes."""
    varied, short = _varied_values(config, summary, side), short_names(summary["observers"])
    (x, xs), (y, ys) = list(varied.items())[-1:-3:-1]
    further = {path: values for path, values in varied.items() if path not in (x, y)}
    panels = list(product(*further.values()))
    kinds = summary["observers"]
    reference = kinds[0]
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    size = max(0.95 * len(xs), 2.6) * columns + 1.6, max(0.72 * len(ys), 1.6) * rows + 1.8
    figure, axes = subplots(*size, rows, columns, beside=True, sharex=True, sharey=True)
    colours = dict(zip(kinds, _KIND_COLOURS * 5, strict=False))
    points = {tuple(point["values"][path] for path in (*further, y, x)): point["sides"][side] for point in summary["points"]}
    winners: set[str] = set()
    tied = False
    for i, (ax, panel) in enumerate(zip(axes, panels, strict=False)):
        cells = set_up_map(ax, *zip(_place(ax, "x", xs), _place(ax, "y", ys), strict=True))
        colour = np.empty((len(ys), len(xs), 3))
        for (j, v), (k, u) in product(enumerate(ys), enumerate(xs)):
            point = points[*panel, v, u]
            best = point["best"]
            colour[j, k] = to_rgb(MISSING if best is None else colours[best])
            if best is None:
                continue
            winners.add(best)
            tied |= bool(point["not_told_apart"])
            ratio = point["kinds"][reference]["ratio"]
            text = short[best] + ("=" if point["not_told_apart"] else "")
            if best != reference:
                text += f"\n{short[reference]} {'–' if ratio is None else f'×{_two_digits(ratio)}'}"
            dark = colour[j, k] @ (0.299, 0.587, 0.114) < 0.5
            place = cells.centres[0][k], cells.centres[1][j]
            ax.text(*place, text, ha="center", va="center", fontsize=9, color="white" if dark else "black")
        ax.pcolormesh(*cells.edges, colour, edgecolors="white", lw=0.8, rasterized=True)
        ax.set_title(", ".join(f"{p} = {v:g} {numeric_paths(config)[p].unit}" if not isinstance(v, str) else f"{p} = {v}"
                               for p, v in zip(further, panel, strict=True)), fontsize=9)  # fmt: skip
        if i + columns >= len(panels):
            ax.set_xlabel(axis_label(config, x))
        if not i % columns:
            ax.set_ylabel(axis_label(config, y))
    for ax in axes[len(panels) :]:
        ax.set_visible(False)
    handles: list[Any] = [Patch(color=colours[kind], label=f"{short[kind]}: {kind}") for kind in kinds if kind in winners]
    remarks = {
        f"{short[reference]} ×: error of {reference} over the best one's": winners - {reference},
        "=: another kind may be as good": tied,
    }
    handles += [Line2D([], [], ls="", label=remark) for remark, holds in remarks.items() if holds]
    figure.suptitle(f"{side}: observer with the least {summary['objective']} error", fontsize=11)
    legend_below(figure, handles, max(int(size[0] / 2.7), 1))
    return Drawn(
        f"observers_{side}",
        figure,
        f"{side}: the kind with the least {error_label(summary)} at each point, {_where(summary)}, and below it how many "
        f"times that error {reference} has (–: diverged). An equals sign: another kind's error may be as small (95 % "
        "interval).",
    )


def write_choice(choice: ObserverChoice, folder: Path) -> str:
    """Write `tuning.json`, and of a single point `gains.toml`. Returns the study's TOML."""
    summary = choice.summary
    if (gains := observer_toml(summary)) is not None:
        (folder / "gains.toml").write_text(gains, encoding="utf-8")
    write_json(folder / "tuning.json", summary, allow_nan=False)
    return choice.config.to_toml()


def describe_choice(choice: ObserverChoice) -> Result:
    """Say which kind of observer is best, and by how much."""
    config, summary = choice.config, choice.summary
    points, kind = summary["points"], summary.get("for_both_sides")
    figures = []
    for side in points[0]["sides"]:
        best = Counter(point["sides"][side]["best"] for point in points)
        del best[None]
        for name, count in best.most_common(1):
            share = f"best at {count} of {len(points)} points" if len(points) > 1 else "best"
            figures.append(KeyFigure(name, f"{side}: {share} ({summary['objective']} error, {_where(summary)})"))
    verdict, headline = "good", f"Take {kind}: gains.toml has its gains."
    if not figures:
        verdict, headline = "failed", "All kinds of observers diverge, or are too slow."
    elif kind is None:
        headline = "Which observer is best depends on the point; the map shows where."
        if len(points) == 1:
            verdict, headline = "doubtful", "No kind converges on both sides."
    title, remarks = config.title or "Observers", choice_headline(summary)
    return Result(title, verdict, headline, figures, remarks, summary["remarks"], _tables(config, summary))


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
        "",
    ]
    gains = {side: dict(result["gains"]) for side, result in sides.items()}
    constants = {side: gains[side].pop(TIME_CONSTANT) for side in sides if TIME_CONSTANT in gains[side]}
    data: JsonObject = {"observer": {"kind": kind, **gains}}
    if constants:
        data["equivalent_control"] = {"time_constant": constants.get("motor")}
        if len(constants) > 1:
            times = ", ".join(f"{side}: {value:.3g} s" for side, value in constants.items())
            lines[-1:] = [f"# A study has one equivalent_control.time_constant; the best of each side: {times}.", ""]
    return "\n".join(lines) + tomli_w.dumps(data)


def _where(summary: JsonObject) -> str:
    """Which runs were compared."""
    runs = summary["holdout"]
    first, last = runs["seeds"]
    input_ = "the study's excitation, other noise" if runs["same_excitation"] else f"held out: {runs['excitation']['kind']}"
    return f"{input_}, {last - first + 1} seeds"


def choice_headline(summary: JsonObject) -> Lines:
    """Which kind is best, and by how much, in sentences."""
    points = summary["points"]
    sides = points[0]["sides"]
    if len(points) > 1:
        return [line for side in sides for line in _map_lines(side, summary)]
    return [_best_line(side, result, summary) for side, result in sides.items()]


def _best_line(side: str, result: JsonObject, summary: JsonObject) -> str:
    compared, lost = _sort_kinds(result["kinds"])
    if not compared:
        return f"{side}: all kinds diverged or were too slow."
    best, *worse = compared
    equal = result["not_told_apart"]
    lead = (
        f"{side}: {best} and {', '.join(equal)} are the best and cannot be told apart"
        if equal
        else f"{side}: {best} is the best of {len(result['kinds'])}"
    )
    unit = SIDE_METRICS[f"{summary['objective']}_rmse"].unit
    line = f"{lead}: {summary['objective']} error {compared[best]['error']:.3g} {unit} rms with {best} ({_where(summary)})."
    if worse:
        line += f" Times as much with: {', '.join(f'{kind} {_ratio(compared[kind])}' for kind in worse)}."
    return f"{line} Diverged, or too slow: {', '.join(lost)}." if lost else line


def _map_lines(side: str, summary: JsonObject) -> Lines:
    points = [point["sides"][side] for point in summary["points"]]
    counts = Counter(point["best"] for point in points if point["best"] is not None)
    shared = Counter(point["best"] for point in points if point["not_told_apart"])
    parts = [
        f"{kind} at {count}" + (f" ({shared[kind]} not told apart from another)" if shared[kind] else "")
        for kind, count in counts.most_common()
    ]
    first = summary["observers"][0]
    parts += [f"{first} at none"] if first not in counts else []
    lines = [f"{side}, {len(points)} points, least {summary['objective']} error ({_where(summary)}): {', '.join(parts)}."]
    spans = []
    for kind in summary["observers"]:
        ratios = [ratio for point in points if (ratio := point["kinds"][kind]["ratio"]) is not None]
        if ratios:
            missed = f" and none at {len(points) - len(ratios)} points" if len(ratios) < len(points) else ""
            spans.append(f"{kind} {min(ratios):.3g} to {max(ratios):.3g}{missed}")
    return [*lines, f"{side}, times the best one's error: {', '.join(spans)}."]


def _tables(config: Config, summary: JsonObject) -> list[ResultTable]:
    points, kinds = summary["points"], summary["observers"]
    tables = []
    if len(points) == 1:
        for side, result in points[0]["sides"].items():
            rows = [
                [kind, *(numbers[key] for key in ("error", "worst", *_RATIO)),
                 ", ".join(f"{key} = {value:.4g}" for key, value in numbers["gains"].items())]
                for kind, numbers in result["kinds"].items()
            ]  # fmt: skip
            columns = ["observer", error_label(summary), "worst run", "times the best", "from", "to", "gains"]
            tables.append(ResultTable(f"{side}, {_where(summary)}", columns, rows))
        return tables
    axes = summary["axes"]
    for side in points[0]["sides"]:
        rows = []
        for point in points:
            result = point["sides"][side]
            ratios = ["–" if (numbers := result["kinds"][kind])["ratio"] is None else _ratio(numbers) for kind in kinds]
            values, tied = (point["values"][path] for path in axes), ", ".join(result["not_told_apart"])
            rows.append([*values, result["best"] or "none", tied, *ratios])
        columns = [*(axis_label(config, path) for path in axes), "best", "not told apart", *kinds]
        tables.append(ResultTable(f"{side}: times the best one's error (95 % interval), {_where(summary)}", columns, rows))
    return tables
