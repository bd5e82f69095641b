"""What `jaxbl tune` with `tune.observers` leaves to be read: how many times the best observer's error each kind has."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator

from jaxbl.config import Config, numeric_paths
from jaxbl.files import write_atomic, write_json
from jaxbl.gains.observer_choice import TIME_CONSTANT, ObserverChoice, runs_are_equal
from jaxbl.json_types import JsonObject
from jaxbl.lines import Lines
from jaxbl.sweeps.metrics import SIDE_METRICS

from .figures import COLOURS, MISSING, SIDE_COLOURS, Drawn, style, subplots, with_unit
from .maps import axis_label, cell_edges, fit_axes
from .page import PageTable, write_report

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
    if len(_varied(choice.config, summary, sides[0])) == 1:
        return [_lines(choice.config, summary, side) for side in sides]
    return [_map(choice.config, summary, side) for side in sides]


def _error(summary: JsonObject) -> str:
    about = SIDE_METRICS[f"{summary['objective']}_rmse"]
    return with_unit(about.label, about.unit)


def _ordered(found: JsonObject) -> list[tuple[str, JsonObject]]:
    """Kinds with a ratio, best first."""
    return [(kind, one) for kind, one in found.items() if one["ratio"] is not None]


def _bars(summary: JsonObject, sides: Sequence[str]) -> Drawn:
    """Ratios with their intervals, a panel for each side."""
    count = len(summary["observers"])
    figure, axes = subplots(5.4 * len(sides), 1.3 + 0.34 * count, 1, len(sides), beside=True)
    for ax, side in zip(axes, sides, strict=True):
        found = summary["points"][0]["sides"][side]["kinds"]
        shown = _ordered(found)
        highest = max((one["high"] for _, one in shown), default=1.0)
        for i, (_, one) in enumerate(shown):
            away = [[one["ratio"] - one["low"]], [one["high"] - one["ratio"]]]
            ax.errorbar(one["ratio"], i, xerr=away, fmt="o", ms=6, capsize=3, color=SIDE_COLOURS[side])
            text = "best" if i == 0 else _ratio(one)
            ax.annotate(f"  {text}", (one["high"], i), va="center", fontsize=9, xytext=(4, 0), textcoords="offset points")
        for i in range(len(shown), count):
            ax.annotate("diverged, or too slow", (0.02, i), xycoords=("axes fraction", "data"), va="center", color="#555555")
        ax.axvline(1.0, color="black", lw=0.8)
        ax.set(xscale="log", xlim=(0.9, 1.2 * (2.0 + highest) ** 1.5), title=side, xlabel="times the best one's error")
        ax.xaxis.set_major_locator(LogLocator(numticks=5))
        ax.xaxis.set_major_formatter("{x:g}")
        ax.set_yticks(range(count), list(found))
        ax.set_ylim(count - 0.5, -0.5)
        ax.grid(axis="y", visible=False)
    caption = (
        f"{_error(summary)} of each kind over the best one's, {_where(summary)}: geometric mean over noise seeds, with its "
        "95 % interval where they differ."
    )
    return Drawn("observers", figure, caption)


def _ratio(one: JsonObject) -> str:
    """The ratio, with its interval if runs differ; more digits where it would read as one."""
    ratio, low, high = (f"{x:.{3 if abs(x - 1.0) > 0.005 else 6}g}" for x in (one["ratio"], one["low"], one["high"]))
    return ratio if runs_are_equal(one) else f"{ratio} ({low} to {high})"


def _varied(config: Config, summary: JsonObject, side: str) -> dict[str, list[Any]]:
    """Values of the axes that have several, in their order; of axes that advance together, those of the side's own, or of
    the first."""
    together: dict[str, list[str]] = {}
    for axis in config.tune.axes if config.tune is not None else ():
        together.setdefault(axis.zip or axis.path, []).append(axis.path)
    paths = [min(some, key=lambda path: f".{side}_" not in path) for some in together.values()]
    columns = {path: list(dict.fromkeys(one["values"][path] for one in summary["points"])) for path in paths}
    return {path: values for path, values in columns.items() if len(values) > 1}


def _place(ax: Axes, which: str, values: Sequence[Any]) -> np.ndarray:
    """Set up an axis for values. Returns where each of them is: on a logarithmic scale where they grow by factors."""
    numbers = all(isinstance(value, int | float) for value in values)
    spread = numbers and min(values) > 0.0 and max(values) / min(values) > 20.0
    if spread:
        getattr(ax, f"set_{which}scale")("log")
        return np.asarray(values, float)
    axis = ax.xaxis if which == "x" else ax.yaxis
    axis.set_ticks(range(len(values)), [f"{value:.4g}" if numbers else str(value) for value in values])
    return np.arange(len(values), dtype=float)


def _lines(config: Config, summary: JsonObject, side: str) -> Drawn:
    """Errors over the one axis that has several values."""
    ((path, values),) = _varied(config, summary, side).items()
    figure, (ax,) = subplots(8.4, 4.6, beside=True)
    xs = _place(ax, "x", values)
    for i, kind in enumerate(summary["observers"]):
        errors = [point["sides"][side]["kinds"][kind]["error"] for point in summary["points"]]
        look: JsonObject = {"color": COLOURS[i % len(COLOURS)], "ls": ("-", "--", ":")[i // len(COLOURS) % 3]}
        ax.plot(xs, [np.nan if one is None else one for one in errors], "o", ms=4, label=kind, **look)
    ax.set(yscale="log", xlabel=axis_label(config, path), ylabel=f"{side}: {_error(summary)}", title=side)
    figure.legend(handles=ax.get_legend_handles_labels()[0], loc="outside right center")
    return Drawn(f"observers_{side}", figure, f"{side}: error of each kind, tuned at each point, {_where(summary)}.")


def _two_digits(value: float) -> str:
    """A number that is read at a glance."""
    return f"{float(f'{value:.2g}'):g}" if value < 1e5 else f"{value:.0e}"


_SHORT_LIMIT = 3
"""Letters of a kind on a map."""


def short_names(kinds: Sequence[str]) -> dict[str, str]:
    """Few letters for each kind: the initials of its words, with a number in full; more letters where two are the same."""
    found: dict[str, str] = {}
    for kind in kinds:
        words = kind.split("_")
        initials = "".join(word if word.isdigit() else word[0].upper() for word in words)
        name = initials if initials not in found.values() else f"{words[0][:_SHORT_LIMIT].capitalize()}"
        while name in found.values():
            name += "'"
        found[kind] = name
    return found


def _map(config: Config, summary: JsonObject, side: str) -> Drawn:
    """The best kind at each point; a panel for each value of further axes."""
    varied, short = _varied(config, summary, side), short_names(summary["observers"])
    (x, xs), (y, ys) = list(varied.items())[-1:-3:-1]
    further = {path: values for path, values in varied.items() if path not in (x, y)}
    panels = list(product(*further.values()))
    reference = summary["observers"][0]
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    size = max(0.95 * len(xs), 2.6) * columns + 1.6, max(0.72 * len(ys), 1.6) * rows + 1.8
    figure, axes = subplots(*size, rows, columns, beside=True, sharex=True, sharey=True)
    colours = dict(zip(summary["observers"], _KIND_COLOURS * 5, strict=False))
    points = {tuple(one["values"][path] for path in (*further, y, x)): one["sides"][side] for one in summary["points"]}
    won: dict[str, int] = {}
    tied = False
    for i, (ax, panel) in enumerate(zip(axes, panels, strict=False)):
        ax.grid(False)
        at = _place(ax, "x", xs), _place(ax, "y", ys)
        edges = [cell_edges(one, getattr(ax, f"get_{which}scale")() == "log") for which, one in zip("xy", at, strict=True)]
        colour = np.empty((len(ys), len(xs), 3))
        for (j, v), (k, u) in product(enumerate(ys), enumerate(xs)):
            found = points[*panel, v, u]
            best = found["best"]
            colour[j, k] = to_rgb(MISSING if best is None else colours[best])
            if best is None:
                continue
            won[best] = won.get(best, 0) + 1
            tied |= bool(found["not_told_apart"])
            other = found["kinds"][reference]["ratio"]
            text = short[best] + ("=" if found["not_told_apart"] else "")
            if best != reference:
                text += f"\n{short[reference]} {'–' if other is None else f'×{_two_digits(other)}'}"
            dark = colour[j, k] @ (0.299, 0.587, 0.114) < 0.5
            ax.text(at[0][k], at[1][j], text, ha="center", va="center", fontsize=9, color="white" if dark else "black")
        ax.pcolormesh(*edges, colour, edgecolors="white", lw=0.8, rasterized=True)
        fit_axes(ax, edges)
        ax.set_title(", ".join(f"{p} = {v:g} {numeric_paths(config)[p].unit}" if not isinstance(v, str) else f"{p} = {v}"
                               for p, v in zip(further, panel, strict=True)), fontsize=9)  # fmt: skip
        if i + columns >= len(panels):
            ax.set_xlabel(axis_label(config, x))
        if not i % columns:
            ax.set_ylabel(axis_label(config, y))
    for ax in axes[len(panels) :]:
        ax.set_visible(False)
    handles: list[Any] = [
        Patch(color=colours[kind], label=f"{short[kind]}: {kind}") for kind in summary["observers"] if kind in won
    ]
    if set(won) - {reference}:
        handles.append(Line2D([], [], ls="", label=f"{short[reference]} ×: error of {reference} over the best one's"))
    if tied:
        handles.append(Line2D([], [], ls="", label="=: another kind may be as good"))
    figure.suptitle(f"{side}: observer with the least {summary['objective']} error", fontsize=11)
    figure.legend(handles=handles, loc="outside lower center", ncols=max(int(size[0] / 2.7), 1))
    caption = (
        f"{side}: the kind with the least {_error(summary)} at each point, {_where(summary)}, and below it how many times "
        f"that error {reference} has (–: diverged). An equals sign: another kind's error may be as small (95 % interval)."
    )
    return Drawn(f"observers_{side}", figure, caption)


def write_choice_report(choice: ObserverChoice, folder: Path) -> Lines:
    """Write `tuning.json`, of a single point `gains.toml`, figures and report into a folder that exists. Returns lines for
    the terminal."""
    summary = choice.summary
    if (gains := observer_toml(summary)) is not None:
        write_atomic(folder / "gains.toml", gains)
    write_json(folder / "tuning.json", summary, allow_nan=False)
    title, config = choice.config.title or "Observers", choice.config.to_toml()
    lead = choice_headline(summary)
    return write_report(
        folder, title, lead, draw_choice(choice), _tables(choice.config, summary), config, summary["remarks"]
    )


def observer_toml(summary: JsonObject) -> str | None:
    """The kind that is best on both sides together, with its gains, as TOML that a study can `include`; None where several
    points were compared, or no kind converges on both sides."""
    kind = summary.get("for_both_sides")
    if kind is None:
        return None
    sides = {side: one["kinds"][kind] for side, one in summary["points"][0]["sides"].items()}
    title = " ".join(summary["title"].split())
    lines = [
        f"# Observer chosen by 'jaxbl tune'{f' for: {title}' if title else ''}",
        f"# Objective: {summary['objective_metric']}, among {', '.join(summary['observers'])}.",
        *(f"# {side}: {one['ratio']:.3g} times the error of the best kind there." for side, one in sides.items()),
        '# To use it, put include = "gains.toml" at the top of a study and leave its own [observer] out.',
        "",
    ]
    data: JsonObject = {"observer": {"kind": kind}}
    for side, one in sides.items():
        data["observer"][side] = {key: value for key, value in one["gains"].items() if key != TIME_CONSTANT}
    constants = {side: one["gains"][TIME_CONSTANT] for side, one in sides.items() if TIME_CONSTANT in one["gains"]}
    if constants:
        data["equivalent_control"] = {"time_constant": constants.get("motor")}
        if len(constants) > 1:
            both = ", ".join(f"{side}: {value:.3g} s" for side, value in constants.items())
            lines[-1:] = [f"# A study has one equivalent_control.time_constant; the best of each side: {both}.", ""]
    return "\n".join(lines) + tomli_w.dumps(data)


def _where(summary: JsonObject) -> str:
    """Which runs were compared."""
    held = summary["holdout"]
    first, last = held["seeds"]
    other = "the study's excitation, other noise" if held["same_excitation"] else f"held out: {held['excitation']['kind']}"
    return f"{other}, {last - first + 1} seeds"


def choice_headline(summary: JsonObject) -> Lines:
    """Which kind is best, and by how much, in sentences."""
    points = summary["points"]
    unit = SIDE_METRICS[f"{summary['objective']}_rmse"].unit
    if len(points) == 1:
        lines = [_said(side, found, summary, unit) for side, found in points[0]["sides"].items()]
        if (both := summary["for_both_sides"]) is not None:
            times = ", ".join(f"{side} {one['kinds'][both]['ratio']:.3g}" for side, one in points[0]["sides"].items())
            lines.append(f"For both sides {both} is chosen (gains.toml): times the best one's error, {times}.")
        return lines
    return [line for side in points[0]["sides"] for line in _said_of_map(side, summary)]


def _said(side: str, found: JsonObject, summary: JsonObject, unit: str) -> str:
    shown = _ordered(found["kinds"])
    lost = [kind for kind, one in found["kinds"].items() if one["ratio"] is None]
    if not shown:
        return f"{side}: all kinds diverged or were too slow."
    (best, one), others = shown[0], shown[1:]
    equal = found["not_told_apart"]
    lead = (
        f"{side}: {best} and {', '.join(equal)} are the best and cannot be told apart"
        if equal
        else f"{side}: {best} is the best of {len(found['kinds'])}"
    )
    parts = [f"{kind} {_ratio(one)}" for kind, one in others]
    rest = f" Times as much with: {', '.join(parts)}." if parts else ""
    bad = f" Diverged, or too slow: {', '.join(lost)}." if lost else ""
    return f"{lead}: {summary['objective']} error {one['error']:.3g} {unit} rms with {best} ({_where(summary)}).{rest}{bad}"


def _said_of_map(side: str, summary: JsonObject) -> Lines:
    points = [one["sides"][side] for one in summary["points"]]
    alone, shared = {}, {}
    for found in points:
        if found["best"] is not None:
            into = shared if found["not_told_apart"] else alone
            into[found["best"]] = into.get(found["best"], 0) + 1
    order = sorted({*alone, *shared}, key=lambda kind: -(alone.get(kind, 0) + shared.get(kind, 0)))
    parts = [
        f"{kind} at {alone.get(kind, 0) + shared.get(kind, 0)}"
        + (f" ({shared[kind]} not told apart from another)" if shared.get(kind) else "")
        for kind in order
    ]
    first = summary["observers"][0]
    parts += [f"{first} at none"] if first not in order else []
    lines = [f"{side}, {len(points)} points, least {summary['objective']} error ({_where(summary)}): {', '.join(parts)}."]
    spans = []
    for kind in summary["observers"]:
        ratios = [found["kinds"][kind]["ratio"] for found in points if found["kinds"][kind]["ratio"] is not None]
        if ratios:
            missed = f" and none at {len(points) - len(ratios)} points" if len(ratios) < len(points) else ""
            spans.append(f"{kind} {min(ratios):.3g} to {max(ratios):.3g}{missed}")
    return [*lines, f"{side}, times the best one's error: {', '.join(spans)}."]


def _tables(config: Config, summary: JsonObject) -> list[PageTable]:
    points, kinds = summary["points"], summary["observers"]
    tables = []
    if len(points) == 1:
        for side, found in points[0]["sides"].items():
            rows = [
                [kind, one["error"], one["worst"], *(one[key] for key in ("ratio", "low", "high")),
                 ", ".join(f"{key} = {value:.4g}" for key, value in one["gains"].items())]
                for kind, one in found["kinds"].items()
            ]  # fmt: skip
            columns = ["observer", _error(summary), "worst run", "times the best", "from", "to", "gains"]
            tables.append(PageTable(f"{side}, {_where(summary)}", columns, rows))
        return tables
    axes = summary["axes"]
    for side in points[0]["sides"]:
        rows = []
        for point in points:
            found = point["sides"][side]
            best = found["best"] or "none"
            tied = ", ".join(found["not_told_apart"])
            cells = ["–" if (one := found["kinds"][kind])["ratio"] is None else _ratio(one) for kind in kinds]
            rows.append([*(point["values"][path] for path in axes), best, tied, *cells])
        columns = [*(axis_label(config, path) for path in axes), "best", "not told apart", *kinds]
        tables.append(PageTable(f"{side}: times the best one's error (95 % interval), {_where(summary)}", columns, rows))
    return tables
