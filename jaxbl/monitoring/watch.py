"""The function behind `jaxbl watch`: gap, stiffness and friction of a drive over time, from a log or a stream, and an alarm
when the gap has grown beyond a stated size.
"""

import itertools
import math
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import pandas as pd
from scipy.special import stdtrit

from jaxbl.chain import Experiment
from jaxbl.config import Config, ConfigSource, prepare, read_model
from jaxbl.errors import InputError
from jaxbl.estimation.logs import on_record, read_logs
from jaxbl.files import to_jsonable
from jaxbl.json_types import JsonObject
from jaxbl.quantity import Quantity
from jaxbl.records import POSITION_CHANNELS, Record
from jaxbl.records.live import (
    Datagrams,
    FollowedFile,
    Rows,
    Stream,
    check_stream_table,
    period_error,
    stream_columns,
)
from jaxbl.units import on_a_line
from jaxbl.workers import check_cost, limit_blas_threads

from .live_chain import LiveChain
from .window import BLOCKS, SETTLING, SideNumbers, Window

SURE = 0.999
"""Probability at which the gap has to be beyond the limit."""
_BOUND = float(stdtrit(BLOCKS - 1, SURE))
"""Standard errors of a jackknife between a value and its one-sided bound."""
INTERVAL = float(stdtrit(BLOCKS - 1, 0.975))
"""Standard errors between a value and each end of its 95 % interval."""
_WIDEST = 0.25
"""Half width of the 95 % interval of a gap that counts as determined, over the gap or, where that is larger, the model's."""
_TOLERANCE = 0.02
"""Relative difference of a log's sampling period from the model's that gains do not notice."""
_SAMPLE_BYTES = 1000.0
"""Bytes of a sample of the window: its columns, and those of the regression by both sides."""
_POLL = 0.1
"""Seconds for which rows are collected before they are processed: the latency of a stream, with the time that takes."""
BLIND_WINDOWS = 10.0
"""Windows without a number after which a watch is blind, where nothing else is stated."""
_QUIET = 10.0
"""Seconds between remarks on a stream from which nothing comes, or from which rows are left out."""
_LAW_UNITS = {"half_gap": "rad", "stiffness": "N m/rad"}
"""Numbers of the law, which are taken from the side that determines them best, and their units on the motor's side."""
_FRICTION_UNITS = {"coulomb": "N m", "viscous": "N m s/rad"}
"""Numbers of each side itself, and their units."""

Values = JsonObject
"""What is known at a time; keys are the columns of `watch.csv`."""


@dataclass(frozen=True)
class WatchTask:
    """A study, and the log or stream that is watched.

    Attributes:
        config: the study.
        name: of the log or stream.
        record: the log; None of a stream.
        experiment: the study at the period of the rows, in float64.
        alarm_gap: half gap beyond which there is an alarm, rad (m); None for none.
        window: seconds that each value is from.
        interval: seconds between values.
        blind: seconds without a number after which the watch says that it does not see.
    """

    config: Config
    name: str
    record: Record | None
    experiment: Experiment
    alarm_gap: float | None
    window: float
    interval: float
    blind: float

    @property
    def period(self) -> float:
        """Period of the rows, s."""
        return float(self.experiment.run.sample_period)

    @cached_property
    def law_numbers(self) -> list[str]:
        """Names of the numbers of the law."""
        assert self.experiment.transmission is not None
        return [name for name in _LAW_UNITS if name in self.experiment.transmission.truth()]

    @cached_property
    def columns(self) -> list[str]:
        """The columns of `watch.csv`."""
        law = self.law_numbers
        columns = ["t", "side", *(f"{name}{end}" for name in law for end in ("", "_from", "_to"))]
        columns += [*(["half_gap_least"] if "half_gap" in law else []), "alarm", "contradiction", "blind"]
        by_side = itertools.product(self.experiment.sides, [*law, *_FRICTION_UNITS], ("", "_error"))
        return [*columns, *(f"{side}.{name}{end}" for side, name, end in by_side)]

    @cached_property
    def units(self) -> dict[str, dict[str, str]]:
        """Units of the numbers, by side and name."""

        def find_units(side: str, units: dict[str, str]) -> dict[str, str]:
            is_linear = self.config.log.position_source(POSITION_CHANNELS[side])[1].si_unit == "m"
            return {name: on_a_line(unit) if is_linear else unit for name, unit in units.items()}

        law = find_units("motor", _LAW_UNITS)
        return {side: law | find_units(side, _FRICTION_UNITS) for side in POSITION_CHANNELS}


@dataclass(frozen=True)
class Watch:
    """The result of a watch.

    Attributes:
        task: the study and what was watched.
        summary: as in `watch.json`.
        values: one row a time, as in `watch.csv`.
    """

    task: WatchTask
    summary: JsonObject
    values: pd.DataFrame


def watch(
    source: str | Path,
    model: ConfigSource,
    *,
    alarm_gap: float | None = None,
    window: float = 10.0,
    interval: float = 1.0,
    blind: float | None = None,
    follow: bool = False,
    on_values: Callable[[Values], None] | None = None,
    ended: Callable[[], bool] | None = None,
) -> Watch:
    """Watch gap, stiffness and friction of a drive over a log or a stream.

    Args:
        source: a log of any kind that can be read; with `follow` a text file that grows; or `udp://HOST:PORT`.
        model: study with the drive's numbers, observers with their gains, and `[log]`; `[excitation]` may be missing.
        alarm_gap: half gap (`transmission.half_gap`, rad on the motor side; m on a linear axis) beyond which there is an
            alarm.
        window: seconds that each value is from.
        interval: seconds between values.
        blind: seconds without a number, of rows or for want of rows, after which the watch says that it does not see; ten
            windows if left out.
        follow: whether to wait for more rows at the end of a text file.
        on_values: called with each row of values as it comes.
        ended: called several times a second; a stream that is followed ends when it returns True.

    Raises:
        InputError: unfit study, log or option, or rows that come at another period than the model's.
    """
    task = read_watch_task(source, model, alarm_gap=alarm_gap, window=window, interval=interval, blind=blind, follow=follow)
    return run_watch(task, on_values=on_values, ended=ended)


def read_watch_task(
    source: str | Path,
    model: ConfigSource,
    *,
    alarm_gap: float | None = None,
    window: float = 10.0,
    interval: float = 1.0,
    blind: float | None = None,
    follow: bool = False,
) -> WatchTask:
    """Read study and log; arguments as of :func:`watch`.

    Raises:
        InputError: as :func:`watch`.
    """
    for name, number in (("alarm_gap", alarm_gap), ("window", window), ("every", interval), ("blind", blind)):
        if number is not None and not 0.0 < number < math.inf:
            raise InputError(f"{name.replace('_', '-')} is {number:g}; it should be positive")
    config, missing = read_model(model)
    of = str(model) if isinstance(model, str | Path) else "config"
    if config.drive.kind != "two_inertia":
        raise InputError(f"{of}: drive.kind {config.drive.kind} has no gap to watch; it should be two_inertia")
    for side in ("observer.motor", "observer.load"):
        if side in missing:
            raise InputError(
                f"{of}: [{side}] has no gains; jaxbl tune chooses some, and the model.toml of jaxbl identify has those that "
                "it chose on its log"
            )
    if config.build().identifier is None:
        raise InputError(f"{of}: the study has no identifier, which finds the gap; give it a [transmission]")
    address = str(source)
    live = follow or "://" in address
    record = None
    if live:
        check_stream_table(config.log, address)
    else:
        record = read_logs(config, source)
        if "load" not in record.positions:
            raise InputError(f"{source}: has no load position (theta_s); the gap is watched by both encoders")
        if not math.isclose(record.sample_period, config.run.sample_period, rel_tol=_TOLERANCE):
            raise period_error(address, record.sample_period, config.run.sample_period)
    with jax.enable_x64(True):
        experiment = prepare(config.with_keys("run", precision="float64")) if record is None else on_record(config, record)
    law, period = experiment.transmission, float(experiment.run.sample_period)
    assert law is not None
    if alarm_gap is not None and "half_gap" not in law.truth():
        raise InputError(f"{of}: transmission.law {law.name} has no gap for --alarm-gap; dead_zone has one")
    shortest_window = 5.0 * SETTLING * max(float(experiment.equivalent_control.time_constant), period)
    if window < shortest_window:
        raise InputError(
            f"window is {window:g} s; with this low-pass ([equivalent_control] time_constant) and sampling period it should "
            f"be at least {shortest_window:g} s"
        )
    if interval < period:
        raise InputError(f"every is {interval:g} s; it should be at least the sampling period, {period:g} s")
    check_cost(f"a window of {window:g} s", _SAMPLE_BYTES * window / period, "window should be shorter")
    if record is not None and (longest := record.time[-1] - record.time[0]) < window:
        raise InputError(f"{source}: has {longest:.4g} s, window is {window:g} s; it should be shorter than the log")
    blind = BLIND_WINDOWS * window if blind is None else blind
    return WatchTask(config, address, record, experiment, alarm_gap, window, interval, blind)


def run_watch(
    task: WatchTask,
    *,
    on_values: Callable[[Values], None] | None = None,
    on_remark: Callable[[str], None] | None = None,
    ended: Callable[[], bool] | None = None,
) -> Watch:
    """Do what :func:`read_watch_task` read; `on_remark` is told that a stream is open, of rows left out, and
    where nothing comes.

    Raises:
        InputError: as :func:`watch`.
    """
    with jax.enable_x64(True), limit_blas_threads():
        watcher = Watcher(task, on_values or (lambda values: None))
        counts: Mapping[str, int] = {}
        if (record := task.record) is None:
            counts = _watch_stream(watcher, task, ended or (lambda: False), on_remark or (lambda text: None))
        else:
            assert record.torque is not None
            for part in record.segments:
                positions = {side: values[part] for side, values in record.positions.items()}
                watcher.take(Rows(float(record.time[part.start]), record.torque[part], positions, True))
    values = pd.DataFrame(watcher.values, columns=task.columns)
    return Watch(task, to_jsonable(_summarise(task, watcher, values, counts)), values)


def _watch_stream(
    watcher: "Watcher", task: WatchTask, has_ended: Callable[[], bool], remark: Callable[[str], None]
) -> Mapping[str, int]:
    """Take in rows as they come. Returns what was left out: its kind -> its number."""
    watcher.chain.compile()
    columns = stream_columns(task.config.log)
    source = Datagrams(task.name, columns) if "://" in task.name else FollowedFile(Path(task.name), columns)
    stream = Stream(source, task.config.log, task.period)
    last_rows = last_remark = time.monotonic()
    counts_before: dict[str, int] = {}
    with closing(source):
        remark(f"watching {task.name}; Ctrl+C ends it")
        while not has_ended():
            rows = stream.poll(_POLL)
            now = time.monotonic()
            if rows:
                last_rows = now
            if now - last_remark >= _QUIET:
                if now - last_rows >= _QUIET:
                    remark(f"{source.name}: nothing that can be read has come for {now - last_rows:.0f} s")
                    last_remark = now
                if source.counts != counts_before:
                    remark(f"{source.name}: {describe_counts(source.counts)}{source.fault}")
                    last_remark, counts_before = now, dict(source.counts)
            for part in rows:
                watcher.take(part)
            watcher.check_sight()
    return source.counts


def describe_counts(counts: Mapping[str, int]) -> str:
    """Say in words what was left out of a stream."""
    return ", ".join(f"{number} {kind}" for kind, number in counts.items())


class Watcher:
    """Takes rows, and makes values every so many seconds.

    Args:
        task: what is watched.
        on_values: called with each row of values.

    Attributes:
        values: all rows of values.
        samples: how many were taken in.
        start: time of the first one, s by the stamps; None before it.
        longest_blindness: s without a number, by the rows that came, or by the clock if none did; 0 up to what was stated.
    """

    def __init__(self, task: WatchTask, on_values: Callable[[Values], None]):
        self._task, self._on_values = task, on_values
        self.chain, self._window = LiveChain(task.experiment), Window(task.experiment, task.window)
        self.values: list[Values] = []
        self.samples = 0
        self.start: float | None = None
        self._due = task.interval
        self._last_time = self.longest_blindness = 0.0
        self._samples_seen, self._clock_seen = 0, time.monotonic()
        self._clock_said = -math.inf

    def take(self, rows: Rows) -> None:
        """Take in rows, and make the values that are due within them."""
        if self.start is None:
            self.start = rows.time
        first, restarts, count = rows.time - self.start, rows.starts_segment, len(rows.torque)
        if first < self._last_time:
            # the sender's clock was set back: values are due by the new one
            self._due = self._following_due(first)
        done = 0
        while done < count:
            # the row at which values are due, those of a gap in time once; half a period of slack: times are rounded
            rows_until_due = math.ceil((self._due - first) / self._task.period - 0.5) + 1
            end = min(max(rows_until_due, done + 1), count)
            part = slice(done, end)
            estimates = self.chain.take(rows.torque[part], {side: x[part] for side, x in rows.positions.items()}, restarts)
            self._window.add(estimates, restarts)
            self.samples += end - done
            done, restarts = end, False
            now = self._last_time = first + (end - 1) * self._task.period
            if now >= self._due - 0.5 * self._task.period:
                self._due = self._following_due(now)
                if (windows := self._window.estimate()) is not None:
                    self._add_values(now, windows)

    def _following_due(self, now: float) -> float:
        interval = self._task.interval
        return interval * (math.floor((now + 0.5 * self._task.period) / interval) + 1)

    def check_sight(self) -> None:
        """Add a row without numbers where none has been found for longer than stated, as often as that has passed again."""
        now = time.monotonic()
        blind = max(now - self._clock_seen, (self.samples - self._samples_seen) * self._task.period)
        if blind > self._task.blind and now - self._clock_said > self._task.blind:
            self._clock_said = now
            self._add_values(self._last_time, {}, blind)

    def _add_values(self, now: float, windows: dict[str, SideNumbers], blind: float = 0.0) -> None:
        values: Values = dict.fromkeys(self._task.columns, math.nan) | {"t": now, "side": ""}
        values |= {"alarm": False, "contradiction": False, "blind": False}
        for side, window in windows.items():
            for name in [*self._task.law_numbers, *_FRICTION_UNITS]:
                number = window.numbers[name]
                values |= {f"{side}.{name}": number.value, f"{side}.{name}_error": number.standard_error}
        values |= self._judge_gap(windows)
        if values["side"]:
            self._samples_seen, self._clock_seen = self.samples, time.monotonic()
        blind = max(blind, (self.samples - self._samples_seen) * self._task.period)
        if blind > self._task.blind:
            self.longest_blindness, values["blind"] = max(self.longest_blindness, blind), True
        self.values.append(values)
        self._on_values(values)

    def _judge_gap(self, windows: dict[str, SideNumbers]) -> Values:
        """Choose the side that determines gap or stiffness best, and decide on the alarm."""
        task, name = self._task, self._task.law_numbers[0]
        law = task.experiment.transmission
        assert law is not None
        nominal = float(getattr(law, name))
        numbers_by_side = {
            side: window.numbers
            for side, window in windows.items()
            if INTERVAL * window.numbers[name].standard_error <= _WIDEST * max(window.numbers[name].value, nominal)
        }
        if not numbers_by_side:
            return {}
        side = min(numbers_by_side, key=lambda side: numbers_by_side[side][name].standard_error)
        values: Values = {"side": side}
        for key in task.law_numbers:
            number = numbers_by_side[side][key]
            reach = INTERVAL * number.standard_error
            values |= {key: number.value, f"{key}_from": number.value - reach, f"{key}_to": number.value + reach}
        differing = [
            key
            for first, second in itertools.combinations(numbers_by_side.values(), 2)
            for key in task.law_numbers
            if _surely_differ(first[key], second[key])
        ]
        values["contradiction"] = bool(differing)
        if name == "half_gap":
            # where the gaps differ one of them is wrong: the smaller one counts
            counted = numbers_by_side.values() if name in differing else [numbers_by_side[side]]
            bound = min(numbers[name].value - _BOUND * numbers[name].standard_error for numbers in counted)
            values |= {"half_gap_least": bound, "alarm": task.alarm_gap is not None and bound > task.alarm_gap}
        return values


def _surely_differ(first: Quantity, second: Quantity) -> bool:
    """Return True if two numbers differ by more than their errors explain."""
    return abs(first.value - second.value) > _BOUND * math.hypot(first.standard_error, second.standard_error)


def _summarise(task: WatchTask, watcher: Watcher, values: pd.DataFrame, counts: Mapping[str, int]) -> JsonObject:
    record, determined = task.record, values[values["side"] != ""]
    alarms = determined[determined["alarm"].astype(bool)]

    def list_numbers(rows: Any, i: int) -> Values | None:
        return rows.iloc[i].dropna().to_dict() if len(rows) else None

    return {
        "title": task.config.title,
        "file": str(Path(task.name).resolve()) if "://" not in task.name else task.name,
        "samples": watcher.samples,
        "sample_period": task.period,
        "start": (watcher.start or 0.0) + (0.0 if record is None else record.start),
        "window": task.window,
        "every": task.interval,
        "alarm_gap": task.alarm_gap,
        "alarm": list_numbers(alarms, 0),
        "alarms": len(alarms),
        "values": len(values),
        "determined": len(determined),
        "blind": {"limit": task.blind, "longest": watcher.longest_blindness},
        "contradictions": determined["contradiction"].sum(),
        "first": list_numbers(determined, 0),
        "last": list_numbers(determined, -1),
        "units": task.units,
        "left_out": dict(counts),
        "notes": [] if record is None else [*record.warnings, *record.notes],
    }


def format_values(values: Values, task: WatchTask) -> str:
    """Format values as a line for the terminal."""
    line = f"{values['t']:8.1f} s  "
    side, units = values["side"], task.units["motor"]
    if values["blind"]:
        return line + f"BLIND: no number for more than {task.blind:g} s"
    if not side:
        return line + "not determined: too little motion, or too few ways through the gap"
    parts = []
    for name, label in (("half_gap", "half gap"), ("stiffness", "K")):
        if name in values:
            half = values[f"{name}_to"] - values[name]
            parts.append(f"{label} {values[name]:.4g}±{half:.1g} {units[name]}")
    sides = [side_name for side_name in task.experiment.sides if f"{side_name}.coulomb" in values]
    # a side that moves along a line has its friction in N
    friction = "/".join(f"{values[f'{side_name}.coulomb']:.2g}" for side_name in sides)
    parts.append(f"friction {friction} {'/'.join(dict.fromkeys(task.units[side_name]['coulomb'] for side_name in sides))}")
    return line + "  ".join(parts) + ("  ALARM" if values["alarm"] else "")
