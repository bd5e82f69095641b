"""Reading a measured log into evenly spaced SI channels, and telling what is wrong with it."""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import ValidationError

from jaxbl.errors import InputError

from . import quality
from .files import Columns, read_columns
from .gearing import UNLIKE, Gearing, gearing, seen
from .quality import SHORTEST, Array, Dynamics, Sampling, Slices
from .table import POSITION_CHANNELS, LogTable, PositionTable, TimeTable, TorqueTable, describe, nearest


@dataclass(frozen=True)
class Findings:
    """What the log says about itself.

    Attributes:
        sampling: of the time stamps.
        channels: channel -> its figures; channels are u, theta_e, theta_s, transmitted, as far as they were recorded.
        gearing: motor against load motion; None with one encoder, or too little motion.
        dynamics: rough rigid-drive regression of the torque; None without torque, or too little motion.
    """

    sampling: Sampling
    channels: dict[str, quality.Channel]
    gearing: Gearing | None
    dynamics: Dynamics | None


@dataclass(frozen=True)
class Record:
    """A measured log in SI units, evenly spaced within each segment.

    Attributes:
        path: the file.
        time: s from the first sample, shape (samples,).
        sample_period: s.
        torque: input at the motor shaft, held from each sample to the next, N m (N on a linear axis), shape (samples,); None
            if it was not recorded.
        positions: "motor" and "load", as far as they were recorded -> rad (m on a linear axis), shape (samples,).
        transmitted: measured transmitted torque, N m (N), shape (samples,), or None.
        closed_loop: whether a controller chose the input from the positions; None if not known.
        start: time of the first sample by the stamps of the log, s.
        segments: contiguous parts; between them the log has gaps.
        notes: what was done to the log, and what is odd about it, in sentences.
        findings: figures on its quality.
        intervals: between the raw stamps that were kept, s, shape (raw samples - 1,).
    """

    path: Path
    time: Array
    sample_period: float
    torque: Array | None
    positions: dict[str, Array]
    transmitted: Array | None
    closed_loop: bool | None
    start: float
    segments: tuple[slice, ...]
    notes: tuple[str, ...]
    findings: Findings
    intervals: Array


def read_log_table(log: LogTable | Mapping[str, Any] | None, name: str = "") -> LogTable:
    """Validate a `[log]` table.

    Args:
        log: the table, a mapping, or None for defaults.
        name: how messages call the file that it is from.

    Raises:
        InputError: unknown key, wrong type or range; one line that names the key.
    """
    if isinstance(log, LogTable):
        return log
    try:
        return LogTable.model_validate({} if log is None else dict(log))
    except ValidationError as error:
        location = ["log", *error.errors()[0]["loc"]]
        text = describe(error, location)[1]
        raise InputError(f"{name}: {text}" if name else text) from None


def read_record(
    path: str | Path,
    log: LogTable | Mapping[str, Any] | None = None,
    *,
    gear_ratio: float | None = None,
    gear_tolerance: float = 0.0,
) -> Record:
    """Read a measured log.

    Columns become SI units as the `[log]` table says; uneven stamps are resampled to their median period, positions by cubic
    splines, torques so that their integral over time is kept. Gaps part the log into segments.

    Args:
        path: CSV or other text, Parquet, MATLAB (.mat up to 7.3), or JSON file.
        log: the `[log]` table of a study, or its keys; left out: columns t, u, theta_e, theta_s in s, N m, rad, rad.
        gear_ratio: expected ratio of motor over load motion, which the log is checked against.
        gear_tolerance: relative deviation of the ratio up to which the log is read nevertheless, with a note.

    Raises:
        InputError: the file or a column is missing or unfit, or the log contradicts what is said of it; one line.
    """
    path = Path(path)
    table = read_log_table(log)
    columns = read_columns(path)
    return _Reader(columns, table, gear_ratio, gear_tolerance).record()


class _Raw(NamedTuple):
    """A channel before it is put on the grid: SI values at the kept rows, and what is to be known about it."""

    values: Array
    unit: str
    saturated: float
    skew: float | str
    held: bool


class _Reader:
    def __init__(self, columns: Columns, table: LogTable, gear_ratio: float | None, gear_tolerance: float):
        self.columns, self.path, self.table, self.gear_ratio = columns, columns.path, table, gear_ratio
        self.gear_tolerance = gear_tolerance
        self.notes: list[str] = []
        self.rows = np.zeros(0, dtype=int)
        self.total = 0
        self.median = self.gap = 0.0

    def wrong(self, text: str) -> InputError:
        return InputError(f"{self.path}: {text}")

    def record(self) -> Record:
        stamps, start = self.stamps()
        channels = self.channels()
        stamps, channels, parts, sampling, period, first = self.sampled(stamps, channels)
        positions = {name: raw for name, raw in channels.items() if name.startswith("theta")}
        for name, raw in positions.items():
            self.check_motion(name, raw.values)
        step = self.table.resample or period
        regrid = not sampling.even or not math.isclose(step, period, rel_tol=1e-9)
        skews = {name: raw.skew if isinstance(raw.skew, float) else 0.0 for name, raw in channels.items()}
        grid = self.gridded(stamps, channels, parts, step, skews, first, regrid)
        geared = self.gearing_of(grid, step)
        if any(raw.skew == "estimate" for raw in channels.values()):
            skews["theta_s"] = self.estimated_skew(geared, step)
            grid = self.gridded(stamps, channels, parts, step, skews, first, regrid)
            geared = self.gearing_of(grid, step)
        time, values, segments = grid
        if regrid:
            why = "to the period that [log] resample asks for" if self.table.resample else "from uneven stamps"
            self.notes.append(
                f"Resampled {why}: every {1e3 * step:.6g} ms; positions by cubic splines, torques with their integral kept."
            )
        for name, skew in skews.items():
            if skew:
                self.notes.append(f"{name}: moved by its skew of {1e3 * skew:.4g} ms.")
        if len(positions) == 2:
            self.check_gearing(geared, *(values[name] for name in POSITION_CHANNELS.values()))
        side = "theta_e" if "theta_e" in values else "theta_s"
        dynamics = quality.dynamics(time, values["u"], values[side], segments, step) if "u" in values else None
        if dynamics is not None:
            self.check_torque(dynamics, values["u"], values[side], segments)
        # uneven stamps would pass for noise of what moves between them
        source = (time, values, segments) if regrid else (stamps, {n: raw.values for n, raw in channels.items()}, parts)
        figures = {
            name: self.figures(name, raw, parts, None if sampling.even else stamps, source) for name, raw in channels.items()
        }
        if geared is not None:
            geared = replace(geared, flank_times=tuple(t - float(time[0]) for t in geared.flank_times))
            figures["theta_s"] = replace(figures["theta_s"], skew=geared.skew, skew_error=geared.skew_error)
            self.note_skew(geared, step)
            self.note_lost_motion(geared, seen(geared.ratio, figures["theta_e"], figures["theta_s"]))
        if dynamics is not None and dynamics.residual < 0.1 and dynamics.shares[0] > 0.3:
            figures["u"] = replace(figures["u"], skew=dynamics.skew, skew_error=dynamics.skew_error)
        return Record(
            path=self.path,
            time=time - time[0],
            sample_period=step,
            torque=values.get("u"),
            positions={side: values[name] for side, name in POSITION_CHANNELS.items() if name in values},
            transmitted=values.get("transmitted"),
            closed_loop=self.table.closed_loop,
            start=start + float(time[0]),
            segments=segments,
            notes=tuple(self.notes),
            findings=Findings(sampling, figures, geared, dynamics),
            intervals=np.diff(stamps),
        )

    # time stamps

    def stamps(self) -> tuple[Array, float]:
        """Stamps of the kept rows in s from the first one, and the first one; sets `rows`."""
        table = self.table.t or TimeTable()
        if table.period is not None:
            length = max(len(values) for values in self.columns.columns.values())
            stamps = np.arange(length, dtype=float) * table.period
        else:
            stamps = self.columns.numbers("t" if table.column is None else table.column, "t.column")
            stamps = stamps * {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[table.unit]
        self.total = len(stamps)
        if len(stamps) < SHORTEST:
            raise self.wrong(f"has {len(stamps)} rows; a log needs at least {SHORTEST}")
        back = np.diff(stamps) < 0.0
        if back.any():
            row = int(np.argmax(back)) + 1
            raise self.wrong(
                f"column {self.time_name!r}, data row {row + 1}: time goes back from {stamps[row - 1]:.9g} s to "
                f"{stamps[row]:.9g} s; stamps should increase"
            )
        if stamps[0] == stamps[-1]:
            raise self.wrong(f"column {self.time_name!r} is {stamps[0]:g} s in all rows; stamps should increase")
        start = float(stamps[0])
        stamps = stamps - start
        keep = np.ones(len(stamps), dtype=bool)
        for column, value in (self.table.where or {}).items():
            given = self.columns.raw(column)
            keep &= self.same_length(given, len(stamps), column) == value
            if not keep.any():
                found = ", ".join(repr(v.item() if hasattr(v, "item") else v) for v in np.unique(given.astype(object))[:6])
                raise self.wrong(f"[log] where leaves no row: '{column}' is never {value!r}; values: {found}")
        for limit, outside in ((self.table.start, np.less), (self.table.stop, np.greater)):
            if limit is not None:
                keep &= ~outside(stamps, limit)
        self.rows = np.flatnonzero(keep)
        if len(self.rows) < SHORTEST:
            raise self.wrong(
                f"[log] where, start and stop leave {len(self.rows)} of {len(stamps)} rows; at least {SHORTEST} are needed"
            )
        if len(self.rows) < len(stamps):
            self.notes.append(f"{len(self.rows)} of {len(stamps)} rows are read, by [log] where, start and stop.")
        intervals = np.diff(stamps)
        self.median = float(np.median(intervals)) or float(np.mean(intervals))
        # stamps that were rounded to more than a period come in groups
        group = 0.0 if np.median(intervals) else float(np.median(intervals[intervals > 0.0]))
        self.gap = max(quality.GAP * self.median, 2.5 * group)
        if self.median >= 0.5:
            self.notes.append(f"The period is {self.median:g} s: if the stamps are not in s, set [log] t.unit.")
        return stamps[self.rows], start

    @property
    def time_name(self) -> str | int:
        column = None if self.table.t is None else self.table.t.column
        return self.columns.name("t" if column is None else column)

    def same_length(self, values: np.ndarray, length: int, column: str | int) -> np.ndarray:
        if len(values) != length:
            raise self.wrong(
                f"column {column!r} has {len(values)} values and the time {length}; they should be equally many"
            )
        return values

    def sampled(
        self, stamps: Array, channels: dict[str, _Raw]
    ) -> tuple[Array, dict[str, _Raw], Slices, Sampling, float, list[float]]:
        """Parts between gaps; without repeated stamps and parts that are too short."""
        count = len(stamps)
        parts = _parts(stamps, self.gap)
        longest = max(parts, key=_length)
        fits = [quality.even_grid(stamps[p]) for p in parts if _length(p) >= SHORTEST // 2]
        even = bool(fits) and all(fit[0] for fit in fits)
        repeated = 0
        if not even:
            again = np.diff(stamps, prepend=-1.0) == 0.0
            repeated = int(again.sum())
            if repeated:
                row = self.rows[int(np.argmax(again))] + 1
                self.notes.append(
                    f"{repeated} rows have the stamp of the row before and were left out (data row {row} first)."
                )
                stamps, channels = (
                    stamps[~again],
                    {n: raw._replace(values=raw.values[~again]) for n, raw in channels.items()},
                )
                self.rows = self.rows[~again]
                parts = _parts(stamps, self.gap)
                longest = max(parts, key=_length)
        intervals = np.diff(stamps)
        inside = intervals[intervals <= self.gap]
        kept = [p for p in parts if _length(p) >= SHORTEST // 2]
        if sum(map(_length, kept)) < SHORTEST:
            raise self.wrong(
                f"gaps leave no {SHORTEST} samples in a row (the longest part has {_length(longest)}); a log needs them"
            )
        if len(parts) > 1:
            widest = int(np.argmax(intervals))
            left_out = count - repeated - sum(map(_length, kept))
            self.notes.append(
                f"Gaps: {len(parts) - 1}; segments: {len(kept)}; the longest gap is {intervals[widest]:.4g} s, "
                f"after data row {self.rows[widest] + 1}"
                + (f"; {left_out} samples between gaps were left out." if left_out else ".")
            )
        even_fits = [quality.even_grid(stamps[p]) for p in kept]
        if even:
            # rounded stamps may repeat, which no spline takes
            stamps = stamps.copy()
            for p, (_, spacing, begin, _) in zip(kept, even_fits, strict=True):
                stamps[p] = begin + spacing * np.arange(_length(p))
        period = even_fits[int(np.argmax([_length(p) for p in kept]))][1] if even else self.median
        sampling = Sampling(
            samples=count,
            median_period=self.median,
            jitter=float(np.std(inside)) if len(inside) else 0.0,
            longest_interval=float(intervals.max()),
            gaps=len(parts) - 1,
            repeated=repeated,
            even=even,
        )
        return stamps, channels, kept, sampling, period, [fit[2] for fit in even_fits]

    # channels

    def channels(self) -> dict[str, _Raw]:
        """All channels in SI units at the kept rows."""
        found: dict[str, _Raw] = {}
        linear = False
        for name in ("theta_e", "theta_s"):
            if self.is_there(name):
                table = getattr(self.table, name) or PositionTable()
                linear |= table.unit in ("m", "mm") and not found
                found[name] = self.position(name, table)
        if not found:
            raise self.wrong(f"no column 'theta_e' or 'theta_s'; {self.others()}; [log] theta_e can name the motor position")
        torques = {"u": self.table.u or TorqueTable()} if self.is_there("u") else {}
        if self.table.transmitted is not None:
            torques["transmitted"] = self.table.transmitted
        for name, table in torques.items():
            found[name] = self.torque(name, table, linear)
        return found

    def others(self) -> str:
        return f"columns: {', '.join(map(str, self.columns.columns))}"

    def is_there(self, name: str) -> bool:
        """Whether a channel is to be read; a position that nobody mentions may be missing, a misspelt one may not."""
        if name in (self.table.absent or []):
            return False
        if getattr(self.table, name) is not None or name in self.columns.columns:
            return True
        if name == "u":
            names = list(self.columns.columns)
            hint = "the file has no header" if all(isinstance(n, int) for n in names) else nearest("u", map(str, names))
            raise self.wrong(f"no column 'u'; {hint}; [log] u can name it, absent = [\"u\"] says that there is none")
        used = {t.column for t in (self.table.t, self.table.u, self.table.theta_e, self.table.theta_s) if t is not None}
        for other in self.columns.columns:
            near = isinstance(other, str) and other.lower().replace("_", "").replace(" ", "") == name.replace("_", "")
            if near and other not in used:
                raise self.wrong(f"no column '{name}', but '{other}'; [log] {name} = \"{other}\" would read it")
        self.notes.append(f"There is no {name} ({'motor' if name == 'theta_e' else 'load'} position) in this log.")
        return False

    def column(self, name: str, column: str | int, bits: int | None) -> Array:
        """Numbers of a column at all rows, unsigned words made signed."""
        values = self.columns.numbers(column, f"{name}.column")
        self.same_length(values, self.total, column)
        if bits is not None:
            outside = (values != np.round(values)) | (values < -(2.0 ** (bits - 1))) | (values >= 2.0**bits)
            if outside.any():
                row = int(np.argmax(outside))
                raise self.wrong(
                    f"column {column!r}, data row {row + 1}: {values[row]:g} is no word of {bits} bits; "
                    f"see [log] {name}.signed_bits"
                )
            values = np.where(values >= 2.0 ** (bits - 1), values - 2.0**bits, values)
        return values[self.rows]

    def position(self, name: str, table: PositionTable) -> _Raw:
        column = name if table.column is None else table.column
        values = self.column(name, column, table.signed_bits)
        if table.minus is not None:
            values = values - self.column(name, table.minus, table.signed_bits)
        self.check_constant(name, column, values)
        if table.wrap is not None:
            if np.ptp(values) > 1.001 * table.wrap:
                raise self.wrong(
                    f"column {column!r} ranges over {np.ptp(values):g}, more than [log] {name}.wrap = {table.wrap:g}; "
                    "wrap should be the period after which it starts again"
                )
            turned = np.unwrap(values, period=table.wrap)
            count = int(np.count_nonzero(np.abs(np.diff(turned) - np.diff(values)) > 0.5 * table.wrap))
            if count:
                self.notes.append(f"{name}: {count} wrap-arounds undone.")
            values = turned
        else:
            self.check_wrap(name, column, values, table)
        self.check_unit(name, column, values, table)
        unit = "m" if table.unit in ("m", "mm") else "rad"
        one = {
            "rad": 1.0,
            "deg": math.pi / 180.0,
            "turn": 2.0 * math.pi,
            "counts": 2.0 * math.pi / (table.counts_per_turn or 1.0),
            "m": 1.0,
            "mm": 1e-3,
        }[table.unit]
        return _Raw(table.sign * table.factor * one * values + table.offset, unit, 0.0, table.skew, held=False)

    def torque(self, name: str, table: TorqueTable, linear: bool) -> _Raw:
        column = name if table.column is None else table.column
        values = self.column(name, column, table.signed_bits)
        if linear and table.unit == "N m":
            raise self.wrong(f"[log] {name}.unit is N m, but the position is in m; on a linear axis it should be N")
        if table.signed_bits is None:
            self.check_unsigned(name, column, values)
        if name == "u" and np.ptp(values) == 0.0:
            self.notes.append(f"u is {values[0]:g} throughout: the log shows free motion, and no inertia by itself.")
        saturated = 0.0
        if table.saturation is not None:
            if np.abs(values).max() > table.saturation * (1.0 + 1e-9):
                row = int(np.argmax(np.abs(values)))
                raise self.wrong(
                    f"column {column!r}, data row {self.rows[row] + 1}: {values[row]:g} exceeds [log] {name}.saturation = "
                    f"{table.saturation:g}"
                )
            saturated = float(np.mean(np.abs(values) >= table.saturation * (1.0 - 1e-9)))
        factor = 1.0 if table.factor is None else table.factor
        unit = "N" if linear else "N m"
        return _Raw(table.sign * factor * values + table.offset, unit, saturated, table.skew, held=name == "u")

    # onto the grid

    def gridded(
        self,
        stamps: Array,
        channels: dict[str, _Raw],
        parts: Slices,
        step: float,
        skews: dict[str, float],
        first: list[float],
        regrid: bool,
    ) -> tuple[Array, dict[str, Array], tuple[slice, ...]]:
        """Times, values and segments at even spacing.

        Args:
            stamps: s, shape (rows,).
            channels: at these stamps.
            parts: rows between gaps.
            step: period of the grid, s.
            skews: of each channel, s.
            first: time of the first sample of each part, s, where stamps are even.
            regrid: whether values are interpolated even without skew.
        """
        times, values, segments, begin = [], {name: [] for name in channels}, [], 0
        for part, at in zip(parts, first, strict=True):
            if not regrid and not any(skews.values()):
                grid = at + step * np.arange(_length(part), dtype=float)
            else:
                low = max(float(stamps[part][0]) - skew for skew in skews.values())
                if not regrid:
                    # where the channels without skew have their samples
                    low = at + step * math.ceil((low - at) / step - 1e-6)
                high = min(float(stamps[part][-1]) - skew for skew in skews.values())
                count = math.floor((high - low) / step + 1e-6) + 1
                if count < SHORTEST // 2:
                    raise self.wrong(f"the skews of the channels or the period leave {max(count, 0)} samples of a segment")
                grid = low + step * np.arange(count, dtype=float)
            for name, raw in channels.items():
                own = stamps[part] - skews[name]
                if not regrid and not skews[name] and len(grid) == _length(part):
                    values[name].append(raw.values[part])
                elif raw.held:
                    values[name].append(_held(own, raw.values[part], grid, step))
                else:
                    from scipy.interpolate import CubicSpline

                    values[name].append(CubicSpline(own, raw.values[part])(np.clip(grid, own[0], own[-1])))
            times.append(grid)
            segments.append(slice(begin, begin + len(grid)))
            begin += len(grid)
        return np.concatenate(times), {name: np.concatenate(v) for name, v in values.items()}, tuple(segments)

    @property
    def turn(self) -> float | None:
        """Of the load, in SI units."""
        return None if (self.table.theta_s or PositionTable()).unit in ("m", "mm") else 2.0 * math.pi

    def gearing_of(self, grid: tuple[Array, dict[str, Array], tuple[slice, ...]], step: float) -> Gearing | None:
        time, values, segments = grid
        if not {"theta_e", "theta_s"} <= set(values):
            return None
        return gearing(time, values["theta_e"], values["theta_s"], segments, step, expected=self.gear_ratio, turn=self.turn)

    def estimated_skew(self, gearing: Gearing | None, step: float) -> float:
        if gearing is None or gearing.skew is None or gearing.skew_error is None:
            raise self.wrong("theta_s.skew = 'estimate': the motion does not tell a skew; give it in s, or leave it out")
        found = f"{1e3 * gearing.skew:.4g} ± {1e3 * gearing.skew_error:.2g} ms"
        if not gearing.skew_error < 0.5 * step:
            raise self.wrong(
                f"theta_s.skew = 'estimate': found {found}, which is not known to half a period of {1e3 * step:.4g} ms; "
                "give it in s, or leave it out"
            )
        self.notes.append(f"The skew of theta_s was estimated against theta_e: {found}.")
        return gearing.skew

    # what may be wrong

    def check_constant(self, name: str, column: str | int, values: Array) -> None:
        if np.ptp(values) == 0.0:
            raise self.wrong(
                f'column {column!r} ({name}) is {values[0]:g} in all rows; it should move; absent = ["{name}"] leaves it out'
            )

    def check_motion(self, name: str, values: Array) -> None:
        step = quality.resolution(values)
        if step and np.ptp(values) < 3.5 * step:
            raise self.wrong(
                f"{name} moves by {round(np.ptp(values) / step)} steps of its resolution {step:.3g} only: nothing excites "
                "the drive; a log should hold motion"
            )

    def check_wrap(self, name: str, column: str | int, values: Array, table: PositionTable) -> None:
        differences = np.diff(values)
        size = np.abs(differences)
        span = float(np.ptp(values))
        at = np.flatnonzero(size > 0.75 * span)
        if not len(at) or len(at) > 0.1 * len(values):
            return
        usual = float(np.quantile(np.delete(size, at), 0.999)) if len(at) < len(size) else np.inf
        periods = [2.0 * math.pi, 360.0, 1.0, *(2.0**k for k in range(3, 33)), table.counts_per_turn or 360.0]
        # after the jump it goes on as before, seen from one period farther
        around = [p for p in periods if p >= span * 0.999 and (np.abs(size[at] - p) <= 3.0 * usual + 1e-9 * p).all()]
        if around and usual < 0.05 * around[0]:
            raise self.wrong(
                f"column {column!r} ({name}) jumps by about {around[0]:.10g} at {len(at)} rows (data row "
                f"{self.rows[at[0] + 1] + 1} first) and goes on from there: it wraps around; set wrap = {around[0]:.10g} in "
                f"[log] {name}"
            )

    def check_unsigned(self, name: str, column: str | int, values: Array) -> None:
        if values.min() < 0.0 or (values != np.round(values)).any():
            return
        for bits in (8, 16, 32):
            top = 2.0**bits
            empty = not ((values > 0.375 * top) & (values < 0.625 * top)).any()
            if 0.625 * top <= values.max() < top and empty and (values <= 0.375 * top).any():
                raise self.wrong(
                    f"column {column!r} ({name}) holds whole numbers up to {values.max():.0f} and none about "
                    f"{0.5 * top:.0f}: signed words of {bits} bits, logged as unsigned; "
                    f"set signed_bits = {bits} in [log] {name}"
                )

    def check_unit(self, name: str, column: str | int, values: Array, table: PositionTable) -> None:
        if table.factor != 1.0 or table.unit not in ("rad", "deg"):
            return
        step = quality.resolution(values)
        if not step:
            return
        turns = {"rad": 2.0 * math.pi, "deg": 360.0}
        other = "deg" if table.unit == "rad" else "rad"
        long = {"rad": "radians", "deg": "degrees"}
        if _is_encoder(turns[other] / step) and not _is_encoder(turns[table.unit] / step):
            raise self.wrong(
                f"column {column!r} ({name}) has steps of {step:.6g}, a turn of {round(turns[other] / step)} counts in "
                f'{long[other]}: it is not in {long[table.unit]}; set unit = "{other}" in [log] {name}'
            )
        if table.unit == "rad" and math.isclose(step, 1.0, rel_tol=1e-9) and len(np.unique(values)) > 16:
            raise self.wrong(
                f'column {column!r} ({name}) holds whole numbers only: counts, not radians; set unit = "counts" and '
                f"counts_per_turn in [log] {name}"
            )

    def check_gearing(self, found: Gearing | None, motor: Array, load: Array) -> None:
        """Compare the ratio of both motions with the gear ratio that is expected."""
        expected = self.gear_ratio
        if found is not None and expected is not None and found.wide and found.residual < UNLIKE:
            self.check_scale(motor, load, expected)
            self.check_wide_gearing(found, expected)
            return
        if found is None or found.residual >= UNLIKE:
            if expected is not None:
                self.check_scale(motor, load, expected)
            left = "" if found is None else f" ({100 * found.residual:.0f} % of theta_e is not explained by theta_s)"
            self.notes.append(
                f"theta_e and theta_s hardly go together{left}: they may not belong to one drive, or the load hardly moves "
                "beyond the lost motion."
            )
            return
        if expected is None:
            return
        relative = found.ratio / expected
        tolerance = max(0.02, 3.0 * found.residual, 5.0 * found.ratio_error / abs(expected))
        if abs(relative - 1.0) <= tolerance:
            return
        close = self.slips(expected)
        guess, why = min(close, key=lambda pair: abs(relative / pair[0] - 1.0))
        if abs(relative / guess - 1.0) > tolerance:
            why = "gear_ratio, or a unit in [log], is wrong"
        moves = f"theta_e moves {found.ratio:.4g} for each 1 of theta_s, where gear_ratio is {expected:g}"
        if abs(relative - 1.0) <= self.gear_tolerance:
            self.notes.append(f"{moves}: what is missing from the model may do that, or gear_ratio is a little wrong.")
            return
        if found.residual < 0.05:
            raise self.wrong(f"{moves}: {why}")
        self.notes.append(f"{moves}, but they go together only roughly; perhaps {why}.")

    def slips(self, expected: float) -> list[tuple[float, str]]:
        """Usual slips: the factor that each puts on the ratio of both motions, and what is wrong then."""
        units = {name: (getattr(self.table, name) or PositionTable()).unit for name in ("theta_e", "theta_s")}
        degrees, see = 180.0 / math.pi, "; see unit in [log]"
        return [
            (-1.0, "the sign of one of them is wrong; set sign = -1 in [log] theta_e or theta_s"),
            (1.0 / expected**2, "the sides are swapped; exchange the columns in [log] theta_e and theta_s"),
            (-1.0 / expected**2, "the sides are swapped, and one has the wrong sign; see [log] theta_e and theta_s"),
            (degrees, ("theta_s is not in degrees" if units["theta_s"] == "deg" else "theta_e is in degrees") + see),
            (1.0 / degrees, ("theta_e is not in degrees" if units["theta_e"] == "deg" else "theta_s is in degrees") + see),
            (1.0 / expected, "theta_s is already counted at the motor shaft; set factor = 1 / gear_ratio in [log] theta_s"),
        ]

    def check_scale(self, motor: Array, load: Array, expected: float) -> None:
        """Whether both move so differently that a slip of units or sides explains it better than any gap."""

        def apart(ratio: float) -> float:
            """Size of the twist relative to the motion: far below 1 where they go together."""
            moved = max(float(np.std(motor)), abs(ratio) * float(np.std(load)))
            return float(np.std(motor - ratio * load)) / moved if moved else 0.0

        if apart(expected) < 0.8:
            return
        # load and motor may well move against each other, beyond a resonance or in a gap
        slips = [(apart(expected * factor), why) for factor, why in self.slips(expected) if factor > 0.0]
        least, why = min(slips)
        if least < 0.7:
            size = float(np.std(motor)) / (abs(expected) * float(np.std(load)))
            raise self.wrong(f"theta_e moves {size:.3g} times as far as gear_ratio {expected:g} times theta_s: {why}")

    def check_wide_gearing(self, found: Gearing, expected: float) -> None:
        """The same where the twist is as large as the motion, so that the log fits many ratios."""
        unit = "m" if self.turn is None else "rad"
        ranges = (
            f"theta_e - {expected:g} theta_s ranges over {found.twist:.3g} {unit}, theta_e over {found.motion:.3g} {unit}"
        )
        # a load that a motor moves through a gap moves no farther than the motor
        if found.twist > max(3.0 * found.least_twist, 1.5 * found.motion):
            raise self.wrong(
                f"{ranges}: gear_ratio, or a unit in [log], is wrong (with {found.ratio:.3g} in place of {expected:g} it "
                f"would be {found.least_twist:.3g} {unit})"
            )
        against = " They mostly move against each other: perhaps the sign of one of them is wrong."
        self.notes.append(
            f"{ranges}: with a gap or wind-up of that size the log hardly checks gear_ratio."
            + (against if found.ratio * expected < 0.0 else "")
        )

    def check_torque(self, found: Dynamics, torque: Array, position: Array, segments: Slices) -> None:
        """A passive drive takes energy from its input; inertia and friction are positive."""
        work = total = travel = 0.0
        for s in segments:
            steps = np.diff(position[s])
            work += float(torque[s][:-1] @ steps)
            total += float(np.abs(torque[s][:-1]) @ np.abs(steps))
            travel += float(np.abs(steps).sum())
        away = sum(abs(float(position[s][-1] - position[s][0])) for s in segments)
        share = work / total if total else 0.0
        inertia, error = found.values[0], found.errors[0]
        heavy = found.inflation[0] < 10.0 and found.shares[0] > 0.1
        backwards = heavy and inertia < -8.0 * error
        if away > 0.2 * travel:
            # potential energy may pay for the motion
            share = max(share, 0.0)
        if backwards and share < 0.02:
            raise self.wrong(
                "the torque has the wrong sign: the drive accelerates against it"
                + (f" and gives {-100 * share:.0f} % of the work back" if share < -0.02 else "")
                + "; set sign = -1 in [log] u"
            )
        # a wrong sign would take the energy out that went in
        if share < -0.1 or (backwards and share < 0.1):
            # a driven load does that, too
            self.notes.append(
                f"The drive gives {-100 * share:.0f} % of the work back to its input: "
                "the load drives it, or the sign of u is wrong."
                if share < -0.1
                else "The drive seems to accelerate against u: see its sign, unit and column."
            )

    def note_skew(self, found: Gearing, step: float) -> None:
        if found.skew is None or found.skew_error is None:
            return
        if abs(found.skew) > 6.0 * found.skew_error and abs(found.skew) > 0.05 * step:
            which = "late" if found.skew > 0.0 else "early"
            self.notes.append(
                f"theta_s is {1e3 * abs(found.skew):.3g} ± {1e3 * found.skew_error:.2g} ms {which} against theta_e: a skew "
                "of the stamps, or viscous friction of the load winding up the shaft, which look alike."
            )

    def note_lost_motion(self, found: Gearing, noise: float) -> None:
        unit = "m" if self.turn is None else "rad"
        text = found.lost_motion_text(unit)
        if found.flank == "load":
            few, times = len(found.flank_times) == 1, [f"{t:.3g}" for t in found.flank_times[:6]]
            more = ", ..." if len(found.flank_times) > 6 else ""
            low, high = found.lost_motion_range
            self.notes.append(
                f"Lost motion at the motor: {text}, as the load changes sides at {', '.join(times)}{more} s "
                f"while places and directions repeat; {low:.2g} to {high:.2g} {unit} by place."
                + (" With one change, a slipped coupling or lost counts look alike." if few else "")
            )
        elif found.stands_out(noise) and not found.wide:
            changes = f"{found.flank_changes} changes of the flank"
            self.notes.append(f"Lost motion at the motor: {text}, from {changes} by the direction of motion.")

    def figures(
        self,
        name: str,
        raw: _Raw,
        parts: Slices,
        stamps: Array | None,
        source: tuple[Array, dict[str, Array], Slices],
    ) -> quality.Channel:
        """Figures on a channel.

        Args:
            name: of the channel.
            raw: at the rows.
            parts: rows between gaps.
            stamps: of the rows, where they are uneven.
            source: evenly spaced times, values by channel, and segments, that its spectrum is taken of.
        """
        times, by_channel, segments = source
        part = max(segments, key=_length)
        values = by_channel[name][part]
        period = float(times[part][-1] - times[part][0]) / (len(values) - 1)
        every = np.concatenate([raw.values[p] for p in parts])
        step = quality.resolution(every)
        is_position = name.startswith("theta")
        jumps = 0
        if is_position:
            jumps = sum(quality.jumps(raw.values[p], step, None if stamps is None else stamps[p]) for p in parts)
        saturated = raw.saturated or (0.0 if is_position else quality.stays(every, step))
        if jumps:
            self.notes.append(
                f"{name}: {jumps} jump{'s' * (jumps > 1)} that the motion does not explain: "
                "dropped counts or disturbed readings."
            )
        if saturated:
            self.notes.append(f"{name} is saturated in {100 * saturated:.2g} % of the samples.")
        frequency, density = quality.spectrum(values, period)
        noise = math.sqrt(quality.noise_floor(frequency, density) * 0.5 / period)
        fastest = float(np.quantile(np.abs(np.diff(values)), 0.99)) / period
        if raw.unit == "rad" and fastest > 1e4:
            self.notes.append(f"{name} reaches {fastest:.3g} rad/s, {fastest * 30.0 / math.pi:.3g} rpm: check its unit.")
        return quality.Channel(
            unit=raw.unit,
            least=float(every.min()),
            largest=float(every.max()),
            resolution=step,
            noise=noise,
            bandwidth=quality.bandwidth(values, period, slope=is_position) if np.ptp(values) else 0.0,
            saturated=saturated,
            jumps=jumps,
        )


def _length(part: slice) -> int:
    return part.stop - part.start


def _parts(stamps: Array, gap: float) -> list[slice]:
    ends = np.flatnonzero(np.diff(stamps) > gap) + 1
    edges = [0, *ends.tolist(), len(stamps)]
    return [slice(a, b) for a, b in itertools.pairwise(edges)]


def _held(stamps: Array, values: Array, grid: Array, step: float) -> Array:
    """Means, over each period of a grid, of values that are held from each stamp to the next.

    The last value is held for one more period. Means keep the impulse, and with it the velocity that a torque makes.
    """
    edges = np.append(stamps, max(stamps[-1], grid[-1]) + 2.0 * step)
    integral = np.concatenate([[0.0], np.cumsum(values * np.diff(edges))])
    ends = np.append(grid, grid[-1] + step)
    return np.diff(np.interp(ends, edges, integral)) / step


def _is_encoder(counts: float) -> bool:
    """Whether a number of counts a turn is a power of two, as those of absolute and of interpolated encoders are."""
    if not 2.0**6 <= counts <= 2.0**27:
        return False
    power = math.log2(counts)
    return abs(power - round(power)) < 1e-4
