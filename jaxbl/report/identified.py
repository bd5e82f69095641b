"""What `jaxbl identify` leaves to be read: numbers with intervals, and what the log shows of motion, torque and gap.

The figures on motion and torque are the analogues of Figs. 18 to 28 of the paper. Where a log is long they show the few
cycles with the largest motion in full, and the whole of it in outline.
"""

import dataclasses
import json
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure

from jaxbl.drive.effects import AbstractEffect
from jaxbl.drive.plant import Plant
from jaxbl.identification.identify import Identification
from jaxbl.identification.logs import unit_on
from jaxbl.identification.search import NOISE_ALONE
from jaxbl.records import POSITION_CHANNELS
from jaxbl.simulate import Experiment

from .maps import SIDES, Drawn
from .page import TableOf, html
from .reports import drafted, save_all, write_model
from .style import COLOURS, style, with_unit

Array = np.ndarray

_POINTS = 2400
"""Points of a line; longer signals are drawn by the least and largest of each of as many bins."""
_CLOUD = 4000
"""Points of a cloud; of more than these the density is drawn."""
_LINES = 30_000
"""Points of a limit cycle that is drawn as a line; of a longer one the density is drawn."""
_CYCLES = 2.5
"""Cycles of motion that are shown in full."""
_SETTLING = 0.1
"""Share of the record that is left to the observers to converge: shown, but out of rms values and scales."""
_COLOUR = {"motor": COLOURS[0], "load": COLOURS[1]}
_MODEL, _MEASURED, _GAP, _FAINT = COLOURS[6], COLOURS[2], "#F3E3A1", "#8C8C8C"
_GROWING, _FALLING = COLOURS[2], COLOURS[3]
_DENSITY = ListedColormap(mpl.colormaps["Greys"](np.linspace(0.25, 0.75, 64)))
_ABOVE: Any = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.1, "columnspacing": 1.2}


def write_identification_report(found: Identification, folder: Path) -> list[str]:
    """Write `identification.json`, `model.toml`, `trace.parquet`, figures and report into a folder that exists.

    They are put there together when all are drawn. Returns the lines for the terminal.
    """
    return drafted(folder, "identification.json", lambda draft: _write(found, draft))


def _write(found: Identification, folder: Path) -> list[str]:
    pictures = save_all(draw_identification(found), folder)
    found.trace.to_parquet(folder / "trace.parquet", index=False)
    text = write_model(found.model, folder, replays=found.replays)
    lead, remarks = _headline(found.summary), _remarks(found.summary)
    tables = [_parameter_table(found.summary)]
    if "regression" in found.summary["method"]:
        tables.append(_regression_table(found.summary["method"]["regression"]))
    if found.summary["method"]["recursive"]:
        tables.append(_recursive_table(found))
    title = found.config.title or f"Identification from {found.record.path.name}"
    (folder / "report.html").write_text(html(title, lead, remarks, pictures, tables, text), encoding="utf-8")
    content = json.dumps(found.summary, indent=1, ensure_ascii=False)
    (folder / "identification.json").write_text(content, encoding="utf-8")
    return [*lead, *remarks]


def identification_lines(summary: dict[str, Any]) -> list[str]:
    """What the terminal says of an `identification.json`."""
    return [*_headline(summary), *_remarks(summary)]


def _headline(summary: dict[str, Any]) -> list[str]:
    lines = []
    for path, one in summary["parameters"].items():
        low, high = one["interval"]
        if None in (one["value"], one["standard_error"], low, high):
            lines.append(f"{path}: this log leaves it open.")
            continue
        unit = f" {one['unit']}" if one.get("unit") else ""
        lines.append(f"{path} = {one['value']:.5g} ± {one['standard_error']:.2g}{unit}, 95 %: {low:.5g} to {high:.5g}.")
    return lines


def _remarks(summary: dict[str, Any]) -> list[str]:
    lines = []
    for refusal in summary["refused"]:
        shares = ", ".join(f"{path} {share:+.2f}" for path, share in refusal["direction"].items())
        lines.append(f"Refused: {shares}: {refusal['why']}.")
    if summary["held"]:
        lines.append(f"Held at the nominal value, on which the others depend: {', '.join(summary['held'])}.")
    for side, residual in summary["residual"].items():
        ratio = residual["rms"] / residual["noise"]
        told = "the model leaves nothing but noise" if ratio < NOISE_ALONE else "the model does not explain all of it"
        size = f"{residual['rms']:.2g} {residual['unit']} rms"
        lines.append(f"{side}: positions are met to {size}, {ratio:.3g} times the noise; {told}.")
    fit = summary["method"]["trajectory"]
    lines.append(
        f"{fit['windows']} windows of {fit['window']:.3g} s with free initial states; {fit['starts_agreeing']} of "
        f"{fit['starts']} starts agree."
    )
    if not fit["converged"]:
        lines.append("The fit stopped before it met its tolerance.")
    if summary["torque"]:
        lines.append(f"Torques by the model are off by {_shares(summary['torque'])}.")
    for side, one in summary.get("gains", {}).items():
        lines.append(
            f"{side} observer: lambda = {one['lambda_']:.3g}, alpha = {one['alpha']:.3g}, chosen on the log for "
            f"f⁺ = {one['f_plus']:.3g}; its velocity differs from the smoothed one by {one['velocity_error']:.2g} rms."
        )
    if "holdout" in summary:
        lines += _on_holdout(summary["holdout"])
    return [*lines, *summary["notes"]]


def _shares(torque: dict[str, Any]) -> str:
    return ", ".join(f"{_share(one)} ({name})" for name, one in torque.items())


def _share(one: dict[str, Any], which: str = "") -> str:
    """A torque error as a share of the driving torque, or by itself where nothing drives."""
    relative = one[f"{which}relative"]
    return f"{one[f'{which}rms']:.2g} {one['unit']} rms" if relative is None else f"{100.0 * relative:.2g} %"


def _on_holdout(holdout: dict[str, Any]) -> list[str]:
    name = Path(holdout["file"]).name
    lines = [
        f"On {name}, {side}: positions over {holdout['window']:.3g} s are met to {one['rms']:.2g} {one['unit']} rms, "
        f"{one['rms'] / one['noise']:.3g} times the noise; by the nominal numbers to {one['nominal_rms']:.2g}."
        for side, one in holdout["position"].items()
    ]
    if holdout["torque"]:
        before = ", ".join(_share(one, "nominal_") for one in holdout["torque"].values())
        lines.append(f"On {name} torques are off by {_shares(holdout['torque'])}; by the nominal numbers by {before}.")
    return lines


class _View:
    """A log as the figures need it: what is settled, what is shown in full, and torques that can be compared."""

    def __init__(self, found: Identification):
        self.found, self.trace, self.record = found, found.trace, found.record
        self.time = self.trace["t"].to_numpy()
        self.sides = [side for side in SIDES if f"{side}.velocity" in self.trace]
        self.geared = "twist" in self.trace
        channels = self.record.findings.channels
        self.unit = {side: channels[POSITION_CHANNELS[side]].unit for side in self.sides}
        self.torque_unit = "N" if self.unit["motor"] == "m" else "N m"
        self.experiment: Experiment = found.model.build()
        self.plant: Plant = self.experiment.plant
        # the observers run on the longest part of a log with gaps
        self.observed = max(self.record.segments, key=lambda one: one.stop - one.start)
        self.settled = slice(
            self.observed.start + int(_SETTLING * (self.observed.stop - self.observed.start)), self.observed.stop
        )

    def __getitem__(self, name: str) -> Array:
        return self.trace[name].to_numpy(dtype=float)

    @cached_property
    def detail(self) -> slice:
        """A few cycles where the motion is largest, reversals included; all that is settled where that is hardly more."""
        rows, period = self.settled, self.record.sample_period
        velocity = self["motor.velocity"][rows]
        count = len(velocity)
        away = velocity[np.abs(velocity) > 0.1 * np.max(np.abs(velocity), initial=0.0)]
        reversals = int(np.count_nonzero(np.diff(np.sign(away))))
        length = int(_CYCLES * 2.0 * len(away) / reversals) if reversals > 2 else count // 4
        length = max(length, 200, round(20.0 * float(self.experiment.equivalent_control.time_constant) / period))
        if 1.5 * length > count:
            return self.observed
        sums = [np.concatenate([[0.0], np.cumsum(velocity**power)]) for power in (1, 2)]
        mean, square = ((one[length:] - one[:-length]) / length for one in sums)
        start = rows.start + int(np.argmax(square - mean**2))
        return slice(start, start + length)

    @property
    def whole(self) -> bool:
        """Whether what is shown in full is all there is."""
        return self.detail == self.observed

    @cached_property
    def span(self) -> tuple[float, float]:
        return float(self.time[self.detail][0]), float(self.time[self.detail][-1])

    def low_passed(self, values: Array) -> Array:
        """Values behind the filter that the equivalent control has gone through, so that its lag is the same."""
        from scipy.signal import lfilter

        constant = float(self.experiment.equivalent_control.time_constant)
        filtered, part = np.full(len(values), np.nan), values[self.observed]
        if constant > 0.0 and np.isfinite(part).all():
            share = -np.expm1(-self.record.sample_period / constant)
            part, _ = lfilter([share], [1.0, share - 1.0], part, zi=[(1.0 - share) * part[0]])
        filtered[self.observed] = part
        return filtered

    @cached_property
    def twist(self) -> Array:
        return self.low_passed(self["twist"])

    @cached_property
    def rate(self) -> Array:
        """Rate of the twist by the smoothed velocities."""
        return self["motor.velocity"] - float(self.plant.drive.ratio("load")) * self["load.velocity"]

    @cached_property
    def law(self) -> Array:
        """Torque of the fitted transmission at the measured motion, low-passed like the observed one."""
        return self.low_passed(self["torque"])

    def law_at(self, twist: Array) -> Array:
        """The fitted transmission's curve: without damping and without what goes with the position."""
        effects = tuple(
            one for one in self.plant.effects if type(one).transmission_error is AbstractEffect.transmission_error
        )
        plant = dataclasses.replace(self.plant, effects=effects)
        with jax.enable_x64(True):
            rest = {side: jnp.asarray(0.0) for side in SIDES}
            states = tuple(effect.init() for effect in effects)
            found = jax.vmap(lambda z: plant.transmitted({"motor": z, "load": jnp.zeros_like(z)}, rest, states)[0])(
                jnp.asarray(twist)
            )
        return np.asarray(found)

    def effects(self, side: str) -> Array | None:
        """Torque that the model's effects on a side (for the motor: on the input, too) add to its nominal equation.

        None where it has none.
        """
        name = f"{side}.effects"
        return self.low_passed(self[name]) if name in self.trace else None

    @cached_property
    def torques(self) -> dict[str, Array]:
        """Transmitted torque by each side: its observer's, less what the model's effects on that side take."""
        found = {}
        for side in self.sides:
            effects = self.effects(side)
            share = 0.0 if effects is None else effects / float(self.plant.drive.torque_gain(side))
            found[side] = self[f"{side}.torque_estimate"] + share
        return found

    @cached_property
    def measured(self) -> Array | None:
        """Measured transmitted torque, low-passed like the observed one."""
        return self.low_passed(self["transmitted"]) if "transmitted" in self.trace else None

    def parts(self, rows: slice | None = None) -> Iterator[slice]:
        """Contiguous parts of some rows."""
        for one in self.record.segments:
            part = one if rows is None else slice(max(one.start, rows.start), min(one.stop, rows.stop))
            if part.start < part.stop:
                yield part

    def draw(self, ax: Axes, values: Array, rows: slice | None = None, label: str | None = None, **how: Any) -> None:
        """A signal over time: broken at gaps, and by the extremes of its bins where it is long."""
        total = sum(part.stop - part.start for part in self.parts(rows))
        for part in self.parts(rows):
            at = part.start + _outline(values[part], max(_POINTS * (part.stop - part.start) // total, 8))
            ax.plot(self.time[at], values[at], label=label, **how)
            label = None

    def mark(self, ax: Axes) -> None:
        """Shade what is shown in full."""
        if not self.whole:
            ax.axvspan(*self.span, color=COLOURS[5], alpha=0.25, lw=1.5)

    def rms(self, values: Array) -> float:
        finite = values[self.settled][np.isfinite(values[self.settled])]
        return float(np.sqrt(np.mean(finite**2))) if len(finite) else float("nan")


def _outline(values: Array, points: int) -> Array:
    """Indices whose values draw the same line: all of a short signal; of a long one least and largest of each bin."""
    if len(values) <= 2 * points:
        return np.arange(len(values))
    size = -(-len(values) // (points // 2))
    padded = np.full(-(-len(values) // size) * size, np.nan)
    padded[: len(values)] = values
    bins = padded.reshape(-1, size)
    ends = [
        np.argmin(np.where(np.isnan(bins), np.inf, bins), axis=1),
        np.argmax(np.where(np.isnan(bins), -np.inf, bins), axis=1),
    ]
    at = np.arange(len(bins)) * size + np.sort(ends, axis=0)
    return np.minimum(at.T.ravel(), len(values) - 1)


def _limits(
    *values: Array, share: float = 0.001, room: float = 0.12, shown: Sequence[float] = ()
) -> tuple[float, float] | None:
    """Ends of an axis that a few outliers do not set; what is to be shown lies inside in any case."""
    finite = np.concatenate([one[np.isfinite(one)] for one in values])
    if not len(finite):
        return None
    low, high = np.quantile(finite, [share, 1.0 - share])
    low, high = min((low, *shown)), max((high, *shown))
    margin = room * (high - low) or 1e-12 + 0.1 * abs(high)
    return float(low - margin), float(high + margin)


def draw_identification(found: Identification) -> list[Drawn]:
    """All figures of an identification."""
    view = _View(found)
    with style():
        drawn = [_intervals(found), _residuals(view), _velocities(view)]
        if view.geared:
            drawn += [_torque(view), _hysteresis(view), _limit_cycle(view)]
        else:
            drawn += [_resistance(view), _friction(view)]
        if found.summary["method"]["recursive"]:
            drawn.append(_path(view))
    return drawn


def _with_error(value: float, error: float, unit: str) -> str:
    """A value to the digits that its error leaves, the error, and its share."""
    known = value and error and np.isfinite(error)
    digits = int(np.clip(np.ceil(np.log10(abs(value) / error)) + 1, 1, 9)) if known else 4
    share = f" ({100.0 * error / abs(value):.2g} %)" if known else ""
    return f"{value:.{digits}g} ± {error:.1g}{f' {unit}' if unit else ''}{share}"


def _intervals(found: Identification) -> Drawn:
    fitted = {
        path: one
        for path, one in found.summary["parameters"].items()
        if one.get("nominal") is not None and None not in (one["value"], *one["interval"])
    }
    held = [path for path in found.summary["held"] if path not in fitted]
    names = [*fitted, *held]
    figure = Figure(figsize=(9.0, 1.1 + 0.4 * len(names)), layout="constrained")
    ax = figure.subplots()
    shown = [0.0]
    for i, one in enumerate(fitted.values()):
        size = abs(one["nominal"]) or abs(one["value"]) or 1.0
        low, middle, high = (
            100.0 * (end - one["nominal"]) / size for end in (one["interval"][0], one["value"], one["interval"][1])
        )
        ax.plot([low, high], [i, i], color=COLOURS[0], lw=5.0, alpha=0.45, solid_capstyle="butt")
        ax.plot([low, middle, high], [i] * 3, "|", color=COLOURS[0], ms=11, mew=1.6)
        ax.plot(middle, i, "o", color=COLOURS[0], ms=5)
        shown += [max(low, middle - 100.0), min(high, middle + 100.0)]
        half = 0.5 * abs(one["interval"][1] - one["interval"][0])
        text = _with_error(one["value"], half, one.get("unit", ""))
        ax.annotate(text, (1.01, i), xycoords=("axes fraction", "data"), va="center", fontsize=9)
    for i in range(len(fitted), len(names)):
        ax.plot(0.0, i, "o", mfc="white", mec=_FAINT, ms=6)
        ax.annotate(
            "held: not shown by this log",
            (1.01, i),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=9,
            color="#555555",
        )
    ax.axvline(0.0, color="black", lw=0.8, zorder=0)
    room = 0.06 * (max(shown) - min(shown)) or 1.0
    ax.set_yticks(range(len(names)), names)
    ax.set(
        xlabel="difference from the nominal value (% of it)",
        xlim=(min(shown) - room, max(shown) + room),
        ylim=(len(names) - 0.5, -0.5),
    )
    caption = (
        "Numbers found, as differences from their nominal values (the line at 0), and their 95 % intervals, correlation of "
        "the residuals counted. On the right: value, half width of the interval, and its share of the value."
    )
    return Drawn("intervals", figure, caption)


def _residuals(view: _View) -> Drawn:
    residual = view.found.summary["residual"]
    figure = Figure(figsize=(9.0, 2.0 * len(residual) + 0.7), layout="constrained")
    axes = figure.subplots(len(residual), 1, sharex=True, squeeze=False).ravel()
    for ax, (side, one) in zip(axes, residual.items(), strict=True):
        unit, values = view.unit[side], view[f"{side}.residual"]
        label = f"rms {one['rms']:.2g} {unit}, {one['rms'] / one['noise']:.3g} times the noise"
        view.draw(ax, values, color=_COLOUR[side], lw=0.7, label=label)
        for sign in (-2.0, 2.0):
            ax.axhline(sign * one["noise"], color=_MODEL, lw=0.9, ls="--", label="± 2 noise" if sign > 0.0 else None)
        ax.set_ylabel(f"{side}:\nmeasured − model ({unit})")
        ax.legend(ncols=2, **_ABOVE)
    axes[-1].set_xlabel("time (s)")
    caption = (
        "What the fitted model leaves of the positions, window by window. Noise alone stays between the dashed lines but "
        "for one sample in twenty; swings beyond them that last are something that the model lacks."
    )
    return Drawn("residuals", figure, caption)


def _both(view: _View, columns: int, height: float) -> tuple[Figure, Any]:
    """Rows of axes: what is shown in full above the whole record; one time axis if they are the same."""
    figure = Figure(figsize=(9.0, height), layout="constrained")
    axes = figure.subplots(2, columns, squeeze=False, sharex="col" if view.whole else False, height_ratios=(3, 2))
    for above, below in axes.T:
        if not view.whole:
            above.set_xlim(*view.span)
            above.set_xlabel("time (s)")
            below.set_xlim(view.time[0], view.time[-1])
        view.mark(below)
        below.set_xlabel("time (s)" if view.whole else "time (s), all of the record")
    return figure, axes


def _where(view: _View) -> str:
    if view.whole:
        return ""
    low, high = view.span
    return f" Above: {low:.4g} to {high:.4g} s, where the motion is largest (shaded below)."


def _velocities(view: _View) -> Drawn:
    figure, axes = _both(view, len(view.sides), 4.6)
    for i, side in enumerate(view.sides):
        above, below = axes[:, i]
        smoothed, estimate, unit = view[f"{side}.velocity"], view[f"{side}.velocity_estimate"], f"{view.unit[side]}/s"
        view.draw(above, estimate, view.detail, color=_COLOUR[side], lw=2.6, alpha=0.75, label="observer")
        view.draw(above, smoothed, view.detail, color=_MODEL, lw=0.9, label="smoother")
        above.set_ylabel(f"{side} velocity ({unit})")
        if limits := _limits(smoothed[view.detail], estimate[view.settled] if view.whole else estimate[view.detail]):
            above.set_ylim(*limits)
        above.legend(ncols=2, **_ABOVE)
        error = estimate - smoothed
        share = view.rms(error) / (view.rms(smoothed) or 1.0)
        view.draw(
            below, error, color=_COLOUR[side], lw=0.8, label=f"rms {view.rms(error):.2g} {unit} ({100.0 * share:.2g} %)"
        )
        below.axhline(0.0, color=_FAINT, lw=0.8, zorder=0)
        if limits := _limits(error[view.settled], room=0.4):
            below.set_ylim(*limits)
        below.set_ylabel(f"difference ({unit})")
        below.legend(**_ABOVE)
    caption = (
        "Velocities by the observers, which know only the past, and by the zero-phase smoother, which knows all of the log "
        f"(cf. Figs. 18, 19, 22 and 23). Below: observer − smoother; rms without the first tenth.{_where(view)}"
    )
    return Drawn("velocities", figure, caption)


def _torque(view: _View) -> Drawn:
    figure, axes = _both(view, 1, 5.4)
    above, below = axes[:, 0]
    reference, name = (view.law, "law") if view.measured is None else (view.measured, "measured")
    # the noisier one first, or it hides the other
    for side in sorted(view.sides, key=lambda side: -view.rms(view.torques[side] - reference)):
        values = view.torques[side]
        view.draw(above, values, view.detail, color=_COLOUR[side], lw=2.4, alpha=0.75, label=f"by the {side} side")
        error = values - reference
        label = f"{side} side − {name}, rms {view.rms(error):.2g} {view.torque_unit}"
        view.draw(below, error, color=_COLOUR[side], lw=0.8, alpha=0.8, label=label)
    if view.measured is not None:
        view.draw(above, view.measured, view.detail, color=_MEASURED, lw=1.6, label="measured")
        error = view.law - view.measured
        view.draw(below, error, color=_MODEL, lw=0.8, label=f"law − measured, rms {view.rms(error):.2g} {view.torque_unit}")
    view.draw(above, view.law, view.detail, color=_MODEL, lw=1.0, ls="--", label="fitted law at the measured twist")
    shown = view.settled if view.whole else view.detail
    signals = [*view.torques.values(), view.law, *([] if view.measured is None else [view.measured])]
    if limits := _limits(*(one[shown] for one in signals)):
        above.set_ylim(*limits)
    if limits := _limits(*(one[view.settled] - reference[view.settled] for one in signals), room=0.3):
        below.set_ylim(*limits)
    below.axhline(0.0, color=_FAINT, lw=0.8, zorder=0)
    above.set_ylabel(f"transmitted torque ({view.torque_unit})")
    below.set_ylabel(f"difference ({view.torque_unit})")
    above.legend(ncols=4, **_ABOVE)
    below.legend(ncols=3, **_ABOVE)
    caption = (
        "Transmitted torque: by the equivalent control of each side less the fitted effects on that side, and by the fitted "
        "law at the measured twist, all behind the same low-pass. Where a side parts from the law, the law or that side's "
        f"equation of motion lacks something.{_where(view)}"
    )
    return Drawn("torque", figure, caption)


def _cloud(view: _View, ax: Axes, x: Array, y: Array, limits: tuple[tuple[float, float], tuple[float, float]]) -> None:
    """All settled points of a plane: as points, or as their density where they are many."""
    x, y = x[view.settled], y[view.settled]
    finite = np.isfinite(x) & np.isfinite(y)
    x, y = x[finite], y[finite]
    if len(x) <= _CLOUD:
        ax.plot(x, y, ".", ms=2.0, mew=0.0, color=_FAINT, zorder=1)
        return
    counts, *edges = np.histogram2d(x, y, bins=(280, 190), range=limits)
    shown = np.where(counts > 0.0, counts, np.nan).T
    if np.isfinite(shown).any():
        scale = LogNorm(1.0, max(float(counts.max()), 2.0))
        ax.pcolormesh(*edges, shown, cmap=_DENSITY, norm=scale, rasterized=True, zorder=1)


def _gap(view: _View, ax: Axes) -> None:
    """The fitted gap, shaded, with its edges."""
    if not view.plant.half_gap:
        return
    one = view.found.summary["parameters"].get("transmission.half_gap")
    error = f" ± {1.96 * one['standard_error']:.1g}" if one else ""
    label = f"fitted gap: half width {view.plant.half_gap:.4g}{error} {view.unit['motor']}"
    ax.axvspan(-view.plant.half_gap, view.plant.half_gap, color=_GAP, alpha=0.6, lw=0.0, zorder=0, label=label)
    for sign in (-1.0, 1.0):
        ax.axvline(sign * view.plant.half_gap, color=COLOURS[4], lw=1.0, zorder=0.5)


def _plane_note(view: _View) -> str:
    if view.whole:
        return "The line is all of the record but its first tenth."
    low, high = view.span
    return f"The line is {low:.4g} to {high:.4g} s, where the motion is largest; grey is all but the first tenth."


def _line(view: _View) -> slice:
    return view.settled if view.whole else view.detail


def _mean_over(twist: Array, torque: Array, rows: Array, limits: tuple[float, float]) -> tuple[Array, Array]:
    """Mean torque of some rows in bins of twist; NaN where a bin has too few for it to mean anything."""
    bins = int(np.clip(len(rows) // 15, 24, 80))
    edges = np.linspace(*limits, bins + 1)
    at = np.digitize(twist[rows], edges)
    count = np.bincount(at, minlength=bins + 2)[1 : bins + 1]
    total = np.bincount(at, torque[rows], minlength=bins + 2)[1 : bins + 1]
    mean = np.where(count >= 4, total / np.maximum(count, 1), np.nan)
    return 0.5 * (edges[1:] + edges[:-1]), mean


def _hysteresis(view: _View) -> Drawn:
    panels = [(f"by the {side} side", view.torques[side], _COLOUR[side]) for side in view.sides]
    if view.measured is not None:
        panels.append(("measured", view.measured, _MEASURED))
    across, up = _limits(view.twist[view.settled]), _limits(*(one[view.settled] for _, one, _ in panels))
    figure = Figure(figsize=(9.0, 4.4), layout="constrained")
    axes = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False).ravel()
    rate = view.low_passed(view.rate)
    for ax, (name, torque, colour) in zip(axes, panels, strict=True):
        _gap(view, ax)
        if across and up:
            _cloud(view, ax, view.twist, torque, (across, up))
            ax.set(xlim=across, ylim=up)
            for growing, shade in ((True, _GROWING), (False, _FALLING)):
                rows = np.arange(len(rate))[view.settled]
                rows = rows[((rate[rows] > 0.0) == growing) & np.isfinite(torque[rows])]
                ax.plot(
                    *_mean_over(view.twist, torque, rows, across), color=shade, lw=2.4, alpha=0.9, zorder=3,
                    label=f"mean, twist {'growing' if growing else 'falling'}",
                )  # fmt: skip
            twist = np.linspace(*across, 400)
            ax.plot(twist, view.law_at(twist), color=_MODEL, lw=1.2, ls="--", zorder=4, label="fitted law")
        ax.set_title(name, color=colour, loc="left")
        ax.set_xlabel(f"twist θe − N₀ θs ({view.unit['motor']})")
    axes[0].set_ylabel(f"transmitted torque ({view.torque_unit})")
    figure.legend(*axes[0].get_legend_handles_labels(), ncols=4, loc="outside upper right", columnspacing=1.2)
    caption = (
        "Transmitted torque over the measured twist, both behind the same low-pass (which rounds corners), with the fitted "
        "law (cf. Figs. 26 and 27); grey is all of the record but its first tenth. Where the means of the two directions "
        "part, there is friction or damping that the model lacks, or delay: the observer's own is in it."
    )
    return Drawn("hysteresis", figure, caption)


def _limit_cycle(view: _View) -> Drawn:
    unit, twist = view.unit["motor"], view["twist"]
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    ax = figure.subplots()
    limits = _limits(twist[view.settled]), _limits(view.rate[view.settled])
    _gap(view, ax)
    if limits[0] and limits[1]:
        if view.settled.stop - view.settled.start <= _LINES:
            ax.plot(twist[view.settled], view.rate[view.settled], color=_FAINT, lw=0.6, alpha=0.5, zorder=1)
        else:
            _cloud(view, ax, twist, view.rate, (limits[0], limits[1]))
        ax.set(xlim=limits[0], ylim=limits[1])
    rows = _line(view)
    ax.plot(twist[rows], view.rate[rows], color=COLOURS[3], lw=1.4, zorder=3)
    ax.axhline(0.0, color=_FAINT, lw=0.8, zorder=0.6)
    ax.set(xlabel=f"twist θe − N₀ θs ({unit})", ylabel=f"twist rate by the smoother ({unit}/s)")
    if view.plant.half_gap:
        ax.legend(**_ABOVE)
    caption = (
        "Limit cycle: rate of the twist over the twist (cf. Fig. 28), run through clockwise. "
        + ("Free flight crosses the shaded gap; outside of it the gear is in contact. " if view.plant.half_gap else "")
        + _plane_note(view)
    )
    return Drawn("limit_cycle", figure, caption)


def _resistance(view: _View) -> Drawn:
    """Of a rigid drive: what resists beyond its nominal equation, over time."""
    unit, estimate, effects = view.torque_unit, view["motor.torque_estimate"], view.effects("motor")
    figure, axes = _both(view, 1, 5.0)
    above, below = axes[:, 0]
    view.draw(above, estimate, view.detail, color=_COLOUR["motor"], lw=2.2, alpha=0.75, label="observer")
    fitted = np.zeros(len(estimate)) if effects is None else effects
    view.draw(above, fitted, view.detail, color=_MODEL, lw=1.0, ls="--", label="fitted effects")
    error = estimate - fitted
    view.draw(below, error, color=_COLOUR["motor"], lw=0.8, label=f"rms {view.rms(error):.2g} {unit}")
    below.axhline(0.0, color=_FAINT, lw=0.8, zorder=0)
    if limits := _limits(estimate[_line(view)], fitted[_line(view)]):
        above.set_ylim(*limits)
    if limits := _limits(error[view.settled], room=0.3):
        below.set_ylim(*limits)
    what = "force" if unit == "N" else "torque"
    above.set_ylabel(f"resisting {what} ({unit})")
    below.set_ylabel(f"difference ({unit})")
    above.legend(ncols=2, **_ABOVE)
    below.legend(**_ABOVE)
    caption = (
        f"The {what} beyond inertia and viscous friction, by the equivalent control of the observer and by the fitted "
        f"effects, behind the same low-pass. Below: observer − effects; rms without the first tenth.{_where(view)}"
    )
    return Drawn("resistance", figure, caption)


def _friction(view: _View) -> Drawn:
    """Of a rigid drive: what resists, over velocity."""
    unit, rows = view.torque_unit, view.settled
    estimate, effects = view["motor.torque_estimate"], view.effects("motor")
    velocity = view.low_passed(view["motor.velocity"])
    limits = _limits(velocity[rows]), _limits(estimate[rows])
    what = "force" if unit == "N" else "torque"
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    ax = figure.subplots()
    if limits[0] and limits[1]:
        _cloud(view, ax, velocity, estimate, (limits[0], limits[1]))
        ax.set(xlim=limits[0], ylim=limits[1])
    shown = _line(view)
    ax.plot(velocity[shown], estimate[shown], color=_COLOUR["motor"], lw=0.8, alpha=0.8, zorder=3, label="observer")
    if effects is not None:
        ax.plot(velocity[shown], effects[shown], color=_MODEL, lw=1.2, zorder=4, label="fitted effects")
    ax.set(xlabel=f"velocity by the smoother ({view.unit['motor']}/s)", ylabel=f"resisting {what} ({unit})")
    ax.legend(ncols=2, **_ABOVE)
    caption = (
        f"The {what} beyond inertia and viscous friction over velocity, behind the same low-pass: friction as the log "
        f"shows it, and as fitted. Reversals are slanted by the low-pass. {_plane_note(view)}"
    )
    return Drawn("friction", figure, caption)


_LABELS = {"stiffness": "stiffness K", "dead_zone": "dead zone j₀", "half_gap": "half gap"}
_UNITS = {"stiffness": "N m/rad", "dead_zone": "rad", "half_gap": "rad"}


def _path(view: _View) -> Drawn:
    found = view.found
    known = list(found.summary["method"]["recursive"])
    names = [name for name in known if name != "half_gap" or "dead_zone" not in known]
    figure = Figure(figsize=(9.0, 2.1 * len(names) + 0.5), layout="constrained")
    axes = figure.subplots(len(names), 1, sharex=True, squeeze=False).ravel()
    late = slice((view.observed.start + view.observed.stop) // 2, view.observed.stop)
    for ax, name in zip(axes, names, strict=True):
        ends, lines = [], []
        for side in SIDES:
            values = view[f"{side}.{name}"]
            view.draw(ax, values, view.observed, color=_COLOUR[side], label=f"recursive, {side} side")
            ends.append(values[late])
        fitted = found.summary["parameters"].get(f"transmission.{name}")
        if fitted is not None:
            ax.axhspan(*fitted["interval"], color=_MODEL, alpha=0.15, lw=0.0)
            ax.axhline(fitted["value"], color=_MODEL, lw=1.0, ls="--", label="trajectory fit, 95 %")
            ends.append(np.array(fitted["interval"]))
            lines.append(fitted["value"])
        if limits := _limits(*ends, share=0.02, room=0.25, shown=lines):
            ax.set_ylim(*limits)
        path = f"transmission.{name}"
        ax.set_ylabel(
            with_unit(_LABELS.get(name, name.replace("_", " ")), unit_on(found.record, path, _UNITS.get(name, "")))
        )
        if name == "dead_zone":
            right = ax.secondary_yaxis("right", functions=(lambda j: 4.0 * j, lambda gap: gap / 4.0))
            right.set_ylabel(f"half gap 4 j₀ ({view.unit['motor']})")
    labelled = {label: line for ax in axes for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    axes[0].legend(labelled.values(), labelled.keys(), ncols=3, **_ABOVE)
    axes[-1].set_xlabel("time (s)")
    caption = (
        "The paper's recursive identification (27)-(28) by the equivalent control of both sides, beside the trajectory fit "
        "with its interval. The scale is that of the second half, and holds the fitted line."
    )
    return Drawn("recursive", figure, caption)


_COLUMNS = ["path", "value", "standard error", "95 % from", "to"]


def _rows(parameters: dict[str, Any]) -> list[list[object]]:
    return [[path, one["value"], one["standard_error"], *one["interval"]] for path, one in parameters.items()]


def _parameter_table(summary: dict[str, Any]) -> TableOf:
    parameters = summary["parameters"]
    rows = [
        [*row, one.get("unit", ""), one.get("nominal")]
        for row, one in zip(_rows(parameters), parameters.values(), strict=True)
    ]
    columns = [*_COLUMNS, "unit", "nominal"]
    if any("profile_interval" in one for one in parameters.values()):
        columns += ["by profile from", "to"]
        for row, one in zip(rows, parameters.values(), strict=True):
            row += one.get("profile_interval", [None, None])
    return TableOf("Parameters", columns, rows)


def _regression_table(regression: dict[str, Any]) -> TableOf:
    by = "with the measured transmitted torque" if regression["measured_transmitted_torque"] else "at smoothed motion"
    title = f"Least squares on the equations of motion, {by}, up to {regression['bandwidth']:.3g} Hz"
    return TableOf(title, _COLUMNS, _rows(regression["parameters"]))


def _recursive_table(found: Identification) -> TableOf:
    rows: list[list[object]] = [
        [name, *(sides[side] for side in SIDES)] for name, sides in found.summary["method"]["recursive"].items()
    ]
    return TableOf("Recursive identification, at the end of the log", ["", *(f"by the {side}" for side in SIDES)], rows)
