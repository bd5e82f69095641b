"""The function behind `jaxbl watch`: gap, stiffness and friction of a drive over time, from a log or a stream, and an alarm
when the gap has grown beyond a stated size.
"""

import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import pandas as pd
from scipy.special import stdtrit

from jaxbl.config import Config, prepare, read_model
from jaxbl.errors import InputError
from jaxbl.files import to_jsonable
from jaxbl.identification.logs import on_record, read_logs
from jaxbl.records import POSITION_CHANNELS, Record
from jaxbl.records.live import (
    Datagrams,
    FollowedFile,
    Rows,
    Source,
    Stream,
    check_stream_table,
    period_error,
    stream_columns,
)
from jaxbl.simulate import Experiment
from jaxbl.units import on_a_line
from jaxbl.workers import limit_blas_threads

from .live_chain import LiveChain
from .window import PARTS, SETTLING, Found, Number, Window

SURE = 0.999
"""Probability at which the gap has to be beyond the limit."""
_BOUND = float(stdtrit(PARTS - 1, SURE))
"""Standard errors of a jackknife between a value and its one-sided bound."""
INTERVAL = float(stdtrit(PARTS - 1, 0.975))
"""Standard errors between a value and each end of its 95 % interval."""
_WIDEST = 0.25
"""Half width of the 95 % interval of a gap that counts as determined, over the gap or, where that is larger, the model's."""
_TOLERANCE = 0.02
"""Relative difference of a log's sampling period from the model's that gains do not notice."""
_POLL = 0.1
"""Seconds for which rows are collected before they are processed: the latency of a stream, with the time that takes."""
_QUIET = 10.0
"""Seconds between remarks on a stream from which nothing comes, or from which rows are left out."""

Values = dict[str, Any]
"""What is known at a time; keys are the columns of `watch.csv`."""


@dataclasses.dataclass(frozen=True)
class WatchTask:
    """A study, and the log or stream that is watched.

    Attributes:
        config: the study.
        name: of the log or stream.
        record: the log; None of a stream.
        experiment: the study at the period of the rows, in float64.
        alarm_gap: half gap beyond which there is an alarm, rad (m); None for none.
        window: seconds that each value is from.
        every: seconds between values.
        units: of the numbers, by side and name.
    """

    config: Config
    name: str
    record: Record | None
    experiment: Experiment
    alarm_gap: float | None
    window: float
    every: float
    units: dict[str, dict[str, str]]


@dataclasses.dataclass(frozen=True)
class Watch:
    """What was seen of a drive.

    Attributes:
        task: the study and what was watched.
        summary: as in `watch.json`.
        values: one row a time, as in `watch.csv`.
    """

    task: WatchTask
    summary: dict[str, Any]
    values: pd.DataFrame


def watch(
    source: str | Path,
    model: str | Path | Mapping[str, Any] | Config,
    *,
    alarm_gap: float | None = None,
    window: float = 10.0,
    every: float = 1.0,
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
        every: seconds between values.
        follow: whether to wait for more rows at the end of a text file.
        on_values: called with each row of values as it comes.
        ended: called several times a second; a stream that is followed ends when it returns True.

    Raises:
        InputError: unfit study, log or option, or rows that come at another period than the model's.
    """
    task = read_watch_task(source, model, alarm_gap=alarm_gap, window=window, every=every, follow=follow)
    return run_watch(task, on_values=on_values, ended=ended)


def read_watch_task(
    source: str | Path,
    model: str | Path | Mapping[str, Any] | Config,
    *,
    alarm_gap: float | None = None,
    window: float = 10.0,
    every: float = 1.0,
    follow: bool = False,
) -> WatchTask:
    """Read study and log; arguments as of :func:`watch`.

    Raises:
        InputError: as :func:`watch`.
    """
    for name, number in (("alarm_gap", alarm_gap), ("window", window), ("every", every)):
        if number is not None and not 0.0 < number < math.inf:
            raise InputError(f"{name.replace('_', '-')} is {number:g}; it should be positive")
    config, missing = read_model(model)
    of = str(model) if isinstance(model, str | Path) else "config"
    if config.drive.kind != "two_inertia":
        raise InputError(f"{of}: drive.kind {config.drive.kind} has no gap to watch; it should be two_inertia")
    if lacking := [one for one in ("observer.motor", "observer.load") if one in missing]:
        raise InputError(
            f"{of}: [{lacking[0]}] has no gains; jaxbl tune chooses some, and the model.toml of jaxbl identify has those "
            "that it chose on its log"
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
        if record is None:
            double = config.model_copy(update={"run": config.run.model_copy(update={"precision": "float64"})})
            experiment = prepare(double)
        else:
            experiment = on_record(config, record)
    law, period = experiment.transmission, float(experiment.run.sample_period)
    assert law is not None
    if alarm_gap is not None and "half_gap" not in law.truth():
        raise InputError(f"{of}: transmission.law {law.name} has no gap for --alarm-gap; dead_zone has one")
    least = 5.0 * SETTLING * max(float(experiment.equivalent_control.time_constant), period)
    if window < least:
        raise InputError(
            f"window is {window:g} s; with this low-pass ([equivalent_control] time_constant) and sampling period it should "
            f"be at least {least:g} s"
        )
    if every < period:
        raise InputError(f"every is {every:g} s; it should be at least the sampling period, {period:g} s")
    if record is not None and (longest := record.time[-1] - record.time[0]) < window:
        raise InputError(f"{source}: has {longest:.4g} s, window is {window:g} s; it should be shorter than the log")
    return WatchTask(config, address, record, experiment, alarm_gap, window, every, _units(config, record))


def _units(config: Config, record: Record | None) -> dict[str, dict[str, str]]:
    units = {"half_gap": "rad", "stiffness": "N m/rad", "coulomb": "N m", "viscous": "N m s/rad"}
    found = {}
    for side, channel in POSITION_CHANNELS.items():
        if record is not None:
            found[side] = {name: record.unit_of(side, unit) for name, unit in units.items()}
        else:
            line = config.log.position(channel)[1].si_unit == "m"
            found[side] = {name: on_a_line(unit) if line else unit for name, unit in units.items()}
    # gap and stiffness are those of the motor's side
    return {side: own | {name: found["motor"][name] for name in ("half_gap", "stiffness")} for side, own in found.items()}


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
        if task.record is not None:
            for rows in _of_record(task.record):
                watcher.take(rows)
            notes = [*task.record.warnings, *task.record.notes]
        else:
            watcher.chain.compile()
            stream, notes = _stream(task), []
            remark = on_remark or (lambda text: None)
            try:
                remark(f"watching {task.name}; Ctrl+C ends it")
                for rows in _of_stream(stream, ended or (lambda: False), remark):
                    watcher.take(rows)
            finally:
                stream.source.close()
            counts = stream.counts
    values = pd.DataFrame(watcher.values, columns=watcher.columns)
    return Watch(task, to_jsonable(_summary(task, watcher, counts, notes)), values)


def _of_record(record: Record) -> Iterator[Rows]:
    assert record.torque is not None
    for part in record.segments:
        positions = {side: values[part] for side, values in record.positions.items()}
        yield Rows(float(record.time[part.start]), record.torque[part], positions, True)


def _stream(task: WatchTask) -> Stream:
    source: Source = (
        Datagrams(task.name, stream_columns(task.config.log)) if "://" in task.name else FollowedFile(Path(task.name))
    )
    return Stream(source, task.config.log, float(task.experiment.run.sample_period))


def _of_stream(stream: Stream, ended: Callable[[], bool], remark: Callable[[str], None]) -> Iterator[Rows]:
    heard = said = time.monotonic()
    before: dict[str, int] = {}
    while not ended():
        found = stream.poll(_POLL)
        now = time.monotonic()
        if found:
            heard = now
        if now - said >= _QUIET:
            if now - heard >= _QUIET:
                remark(f"{stream.source.name}: nothing that can be read has come for {now - heard:.0f} s")
                said = now
            if stream.counts != before:
                remark(f"{stream.source.name}: {counted(stream.counts)}{stream.source.fault}")
                said, before = now, dict(stream.counts)
        yield from found


def counted(counts: Mapping[str, int]) -> str:
    """What was left out of a stream, in words."""
    return ", ".join(f"{number} {what}" for what, number in counts.items())


def _names(experiment: Experiment) -> tuple[list[str], list[str]]:
    """Numbers of each side, and those of them that the side which determines them best gives."""
    assert experiment.transmission is not None
    law = [name for name in ("half_gap", "stiffness") if name in experiment.transmission.truth()]
    return [*law, "coulomb", "viscous"], law


def columns_of(task: WatchTask) -> list[str]:
    """Names of the values of a watch: the columns of `watch.csv`."""
    names, law = _names(task.experiment)
    found = ["t", "side", *(f"{name}{end}" for name in law for end in ("", "_from", "_to"))]
    found += [*(["half_gap_least"] if "half_gap" in law else []), "alarm", "contradiction"]
    by_side = itertools.product(task.experiment.sides, names, ("", "_error"))
    return [*found, *(f"{side}.{name}{end}" for side, name, end in by_side)]


class Watcher:
    """Takes rows, and makes values every so many seconds.

    Args:
        task: what is watched.
        on_values: called with each row of values.

    Attributes:
        values: all rows of values.
        columns: their names.
        samples: how many were taken in.
        start: time of the first one, s by the stamps; None before it.
    """

    def __init__(self, task: WatchTask, on_values: Callable[[Values], None]):
        self._task, self._on_values = task, on_values
        experiment = task.experiment
        self._period = float(experiment.run.sample_period)
        self.chain, self._window = LiveChain(experiment), Window(experiment, task.window)
        self._names, self._chosen = _names(experiment)
        self.columns = columns_of(task)
        self.values: list[Values] = []
        self.samples = 0
        self.start: float | None = None
        self._due = task.every

    def take(self, rows: Rows) -> None:
        """Take in rows, and make the values that are due within them."""
        if self.start is None:
            self.start = rows.time
        first, anew, count = rows.time - self.start, rows.anew, len(rows.torque)
        done = 0
        while done < count:
            # the row at which values are due, those of a gap in time once; half a period of slack: times are rounded
            left = math.ceil((self._due - first) / self._period - 0.5) + 1
            end = min(max(left, done + 1), count)
            part = slice(done, end)
            given = self.chain.take(rows.torque[part], {side: x[part] for side, x in rows.positions.items()}, anew)
            self._window.add(given, anew)
            self.samples += end - done
            done, anew = end, False
            now = first + (end - 1) * self._period
            if now >= self._due - 0.5 * self._period:
                every = self._task.every
                self._due = every * (math.floor((now + 0.5 * self._period) / every) + 1)
                if self._window.full:
                    self._say(now)

    def _say(self, now: float) -> None:
        values = dict.fromkeys(self.columns, math.nan) | {"t": now, "side": "", "alarm": False, "contradiction": False}
        found = self._window.estimate()
        for side, one in found.items():
            for name in self._names:
                number = one.numbers[name]
                values |= {f"{side}.{name}": number.value, f"{side}.{name}_error": number.error}
        values |= self._judged(found)
        self.values.append(values)
        self._on_values(values)

    def _judged(self, found: dict[str, Found]) -> Values:
        """The side that determines gap or stiffness best, its numbers, and whether the gap is beyond the limit."""
        task, name = self._task, self._chosen[0]
        law = task.experiment.transmission
        assert law is not None
        nominal = float(law.half_gap if name == "half_gap" else law.stiffness)
        known = {
            side: one.numbers
            for side, one in found.items()
            if INTERVAL * one.numbers[name].error <= _WIDEST * max(one.numbers[name].value, nominal)
        }
        if not known:
            return {}
        side = min(known, key=lambda side: known[side][name].error)
        values: Values = {"side": side}
        for key in self._chosen:
            number = known[side][key]
            ends = (number.value + sign * INTERVAL * number.error for sign in (-1.0, 1.0))
            values |= dict(zip((key, f"{key}_from", f"{key}_to"), (number.value, *ends), strict=True))
        bounds = {side: numbers[name].value - _BOUND * numbers[name].error for side, numbers in known.items()}
        apart = [key for key in self._chosen if len(known) == 2 and _apart(*(numbers[key] for numbers in known.values()))]
        values["contradiction"] = bool(apart)
        # where the gaps differ one of them is wrong: the smaller one counts
        bound = min(bounds.values()) if name in apart else bounds[side]
        if name == "half_gap":
            values |= {"half_gap_least": bound, "alarm": task.alarm_gap is not None and bound > task.alarm_gap}
        return values


def _apart(one: Number, other: Number) -> bool:
    """Whether two numbers surely differ."""
    return abs(one.value - other.value) > _BOUND * math.hypot(one.error, other.error)


def _summary(task: WatchTask, watcher: Watcher, counts: Mapping[str, int], notes: list[str]) -> dict[str, Any]:
    known = [one for one in watcher.values if one["side"]]
    raised = [one for one in known if one["alarm"]]

    def said(values: Values) -> Values:
        return {name: value for name, value in values.items() if not (isinstance(value, float) and math.isnan(value))}

    return {
        "title": task.config.title,
        "file": str(Path(task.name).resolve()) if "://" not in task.name else task.name,
        "samples": watcher.samples,
        "sample_period": float(task.experiment.run.sample_period),
        "start": (0.0 if watcher.start is None else watcher.start) + (0.0 if task.record is None else task.record.start),
        "window": task.window,
        "every": task.every,
        "alarm_gap": task.alarm_gap,
        "alarm": said(raised[0]) if raised else None,
        "alarms": len(raised),
        "values": len(watcher.values),
        "determined": len(known),
        "contradictions": sum(one["contradiction"] for one in known),
        "first": said(known[0]) if known else None,
        "last": said(known[-1]) if known else None,
        "units": task.units,
        "left_out": dict(counts),
        "notes": notes,
    }


def value_line(values: Values, task: WatchTask) -> str:
    """Values as a line for the terminal."""
    line = f"{values['t']:8.1f} s  "
    side, units = values["side"], task.units["motor"]
    if not side:
        return line + "not determined: too little motion, or too few ways through the gap"
    parts = []
    for name, label in (("half_gap", "half gap"), ("stiffness", "K")):
        if name in values:
            half = values[f"{name}_to"] - values[name]
            parts.append(f"{label} {values[name]:.4g}±{half:.1g} {units[name]}")
    sides = [one for one in task.experiment.sides if f"{one}.coulomb" in values]
    # a side that moves along a line has its friction in N
    friction = "/".join(f"{values[f'{one}.coulomb']:.2g}" for one in sides)
    parts.append(f"friction {friction} {'/'.join(dict.fromkeys(task.units[one]['coulomb'] for one in sides))}")
    return line + "  ".join(parts) + ("  ALARM" if values["alarm"] else "")
