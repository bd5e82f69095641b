"""Rows that arrive one by one: a text file that grows, or datagrams. The same columns and `[log]` table as of a log that
is read whole; a row that is unfit is counted and left out, as nobody can mend it any more.
"""

import math
import os
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, Protocol
from urllib.parse import urlsplit

import numpy as np

from jaxbl.errors import InputError, shorten
from jaxbl.validation import check_file, explain_missing_file

from .channels import to_si, to_signed
from .files import LogFile, TextFormat, detect_text_format, log_suffixes
from .table import POSITION_CHANNELS, LogTable, PositionTable, SpeedTable, TimeTable, TorqueTable
from .time_stamps import GAP_PERIODS, SECONDS_PER_UNIT

MALFORMED, UNREADABLE, DISORDERED = "malformed datagrams or lines", "rows without a number", "rows late or repeated"
LOST, GAPS, RESTARTS = "lost samples interpolated", "gaps in time", "restarts of the clock"
"""What is counted."""
_HEAD = 1 << 18
"""Bytes from which the form of a file's rows is seen, and that are read at once."""
_LONGEST_LINE = 1 << 20
_LOOK = 0.02
"""Seconds between looks at a file."""
_RECEIVED = 1 << 22
"""Bytes of datagrams that the system is asked to keep; it may keep fewer."""
_ASKED = 0.1
"""Seconds between looks whether a socket is to be closed."""
_BACK = 1.0
"""Seconds that time goes back where the sender has begun starts_segment; datagrams overtake one another by less."""
_JUDGED, _APART, _TOLERANCE = 256, 8, 0.02
"""Rows by which the sampling period is judged, over how many of them each interval goes, and its relative tolerance."""
_PLAIN = bytes(range(32, 127)) + b"\t\r\n"
"""Bytes of text; those of binary numbers are others."""


class Rows(NamedTuple):
    """Samples one sampling period apart.

    Attributes:
        time: of the first one, s by the stamps.
        torque: N m (N), shape (samples,).
        positions: of motor and load, rad (m), shape (samples,) each.
        starts_segment: whether they do not continue the rows before.
    """

    time: float
    torque: np.ndarray
    positions: dict[str, np.ndarray]
    starts_segment: bool


class Source(Protocol):
    """Where rows come from.

    Attributes:
        name: for messages.
        counts: of what was left out, by what it was.
        fault: the last line or datagram that could not be read, and why, as the rest of a sentence; "" for none.
    """

    name: str
    counts: Counter[str]
    fault: str

    def poll(self, seconds: float) -> tuple[Sequence[str | int], np.ndarray] | None:
        """Wait so long for rows: names of the columns, and numbers (rows, columns), NaN where there is none; None if
        nothing has come. InputError where no row can be used."""
        ...

    def close(self) -> None:
        """Give the file or the address back."""
        ...


def stream_columns(table: LogTable) -> list[str | int]:
    """Columns that are read from a stream, in the order of rows without a header: time, input, motor and load position,
    then those to be subtracted and those of `where`."""
    time = table.t or TimeTable()
    found: list[str | int] = [] if time.period is not None else [time.column_or("t")]
    found.append((table.u or TorqueTable()).column_or("u"))
    ends = [table.position_source(name) for name in POSITION_CHANNELS.values()]
    found += [one.column_or(channel) for channel, one in ends]
    found += [one.minus for _, one in ends if isinstance(one, PositionTable) and one.minus is not None]
    return list(dict.fromkeys([*found, *(table.where or {})]))


def _channel_keys(table: LogTable) -> dict[str | int, str]:
    """Column -> the key of `[log]` that can name another one."""
    ends = [table.position_source(name) for name in POSITION_CHANNELS.values()]
    pairs = [("t", table.t or TimeTable()), ("u", table.u or TorqueTable()), *ends]
    return {one.column_or(name): name for name, one in pairs}


def check_stream_table(table: LogTable, name: str) -> None:
    """Refuse what a stream cannot have: it takes the whole log.

    Raises:
        InputError: the key of `[log]`.
    """
    if table.absent:
        raise InputError(f"{name}: [log] absent: {', '.join(table.absent)}; a stream needs u, theta_e and theta_s")
    ends = [(key, *table.position_source(key)) for key in POSITION_CHANNELS.values()]
    channels = [("u", table.u or TorqueTable()), *((channel, one) for _, channel, one in ends)]
    open_ = [f"{channel}.{key}" for channel, one in channels for key in ("skew", "drift") if getattr(one, key, None)]
    open_ += [key for key in ("start", "stop", "resample") if getattr(table, key) is not None]
    open_ += [f"where.{key}" for key, value in (table.where or {}).items() if isinstance(value, str)]
    if open_:
        raise InputError(f"{name}: [log] {open_[0]} is for whole logs; leave it out for rows that arrive one by one")


class _ChannelReader:
    """Columns become channels in SI units, row by row; remembers turns of wrapped positions, and integrals of speeds."""

    def __init__(self, table: LogTable, name: str, columns: Sequence[str | int]):
        self._table, self._count = table, len(columns)
        file = LogFile(Path(name), dict.fromkeys(columns, ()))
        keys = _channel_keys(table)
        self._at = {one: list(columns).index(file.find_column(one, keys.get(one, ""))) for one in stream_columns(table)}
        self._before: dict[str, float] = {}
        self._row = 0

    def take(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray], int]:
        """Times (s), torque, positions, and how many rows were unreadable; values are (rows, columns)."""
        table = self._table
        # the same as pandas' comparison of a column with a number, true or false
        for column, value in (table.where or {}).items():
            values = values[values[:, self._at[column]] == value]
        clock = table.t or TimeTable()
        if clock.period is not None:
            stamps = (self._row + np.arange(len(values))) * clock.period
            self._row += len(values)
        else:
            stamps = values[:, self._at[clock.column_or("t")]] * SECONDS_PER_UNIT[clock.unit]
        torque_table = table.u or TorqueTable()
        torque = to_si(torque_table, self._words(values, torque_table.column_or("u"), torque_table.signed_bits))
        raw, ends = {}, {}
        for side, name in POSITION_CHANNELS.items():
            channel, one = table.position_source(name)
            ends[side] = one
            raw[side] = self._words(values, one.column_or(channel), one.signed_bits)
            if isinstance(one, PositionTable) and one.minus is not None:
                raw[side] = raw[side] - self._words(values, one.minus, one.signed_bits)
        fit = np.isfinite(stamps) & np.isfinite(torque)
        for one in raw.values():
            fit &= np.isfinite(one)
        stamps = stamps[fit]
        positions = {side: self._position(side, ends[side], raw[side][fit], stamps) for side in raw}
        return stamps, torque[fit], positions, int(len(fit) - fit.sum())

    def _words(self, values: np.ndarray, column: str | int, bits: int | None) -> np.ndarray:
        numbers = values[:, self._at[column]]
        return numbers if bits is None else to_signed(numbers, bits)

    def _position(self, side: str, table: PositionTable | SpeedTable, values: np.ndarray, stamps: np.ndarray) -> np.ndarray:
        if not len(values):
            return values
        if isinstance(table, SpeedTable):
            speed = to_si(table, values)
            speeds = np.append(self._before.get(f"{side} speed", float(speed[0])), speed)
            times = np.append(self._before.get(f"{side} time", float(stamps[0])), stamps)
            # over a gap, too, as if the speed had gone straight from one end to the other
            steps = np.diff(times) * 0.5 * (speeds[1:] + speeds[:-1])
            position = self._before.get(side, 0.0) + np.cumsum(steps)
            self._before |= {side: position[-1], f"{side} speed": speed[-1], f"{side} time": stamps[-1]}
            return position
        if table.wrap is not None:
            values = np.unwrap(np.append(self._before.get(side, float(values[0])), values), period=table.wrap)[1:]
            self._before[side] = values[-1]
        return to_si(table, values)


class Stream:
    """Rows of a source in SI units, one sampling period apart.

    Up to two samples in a row that are lost are interpolated, as in a log: positions linearly, the input held. After a
    longer gap rows begin starts_segment.

    Args:
        source: of rows.
        table: how its columns are read.
        period: that samples should have, s.
    """

    def __init__(self, source: Source, table: LogTable, period: float):
        self.source, self.counts = source, source.counts
        self._table, self._period = table, period
        self._channels: _ChannelReader | None = None
        self._columns: list[str | int] = []
        self._last: tuple[float, float, dict[str, float]] | None = None
        self._first: list[float] = []
        self._judged = False

    def poll(self, seconds: float) -> list[Rows]:
        """What has come within so many seconds.

        Raises:
            InputError: a column is missing, or samples come at another period.
        """
        found = self.source.poll(seconds)
        if found is None:
            return []
        columns, values = found
        if self._channels is None or list(columns) != self._columns:
            self._channels, self._columns = _ChannelReader(self._table, self.source.name, columns), list(columns)
        stamps, torque, positions, unreadable = self._channels.take(values)
        self._count(UNREADABLE, unreadable)
        self._judge(stamps)
        return self._in_order(stamps, torque, positions)

    def _count(self, what: str, number: int) -> None:
        if number:
            self.counts[what] += number

    def _judge(self, stamps: np.ndarray) -> None:
        """Compare the period of the first rows with what it should be."""
        if self._judged:
            return
        self._first += stamps.tolist()
        if len(self._first) < _JUDGED:
            return
        self._judged, times = True, np.array(self._first)
        found = float(np.median(times[_APART:] - times[:-_APART])) / _APART
        if not math.isclose(found, self._period, rel_tol=_TOLERANCE):
            raise period_error(self.source.name, found, self._period)
        if np.mean(np.diff(times) == 0.0) > 0.5:
            raise InputError(
                f"{self.source.name}: most stamps are that of the row before; they should be finer than the sampling "
                "period, or [log] t = { period = ... } says that there are none"
            )

    def _in_order(self, stamps: np.ndarray, torque: np.ndarray, positions: dict[str, np.ndarray]) -> list[Rows]:
        if not len(stamps):
            return []
        latest = np.maximum.accumulate(np.concatenate([[-np.inf if self._last is None else self._last[0]], stamps]))
        back = latest[:-1] - stamps > _BACK
        if back.any():
            # a clock that was set back: rows from there on begin starts_segment
            at = int(np.argmax(back))
            before, after = (
                (stamps[p], torque[p], {s: x[p] for s, x in positions.items()}) for p in (slice(at), slice(at, None))
            )
            found = self._in_order(*before)
            self._count(RESTARTS, 1)
            self._last = None
            return [*found, *self._in_order(*after)]
        fit = stamps > latest[:-1]
        self._count(DISORDERED, int(len(fit) - fit.sum()))
        stamps, torque = stamps[fit], torque[fit]
        positions = {side: values[fit] for side, values in positions.items()}
        if not len(stamps):
            return []
        starts = np.flatnonzero(np.diff(stamps) > GAP_PERIODS * self._period) + 1
        self._count(GAPS, len(starts))
        starts_segment = self._last is None
        if self._last is not None and stamps[0] - self._last[0] > GAP_PERIODS * self._period:
            self._count(GAPS, 1)
            self._last, starts_segment = None, True
        found = []
        for first, end in zip([0, *starts], [*starts, len(stamps)], strict=True):
            part = slice(first, end)
            found.append(self._even(stamps[part], torque[part], {s: x[part] for s, x in positions.items()}, starts_segment))
            self._last, starts_segment = None, True
        self._last = float(stamps[-1]), float(torque[-1]), {side: float(values[-1]) for side, values in positions.items()}
        return found

    def _even(self, stamps: np.ndarray, torque: np.ndarray, positions: dict[str, np.ndarray], starts_segment: bool) -> Rows:
        """Rows without a gap, lost ones put in; stamps may jitter by less than half a period."""
        before = self._last
        if before is not None:
            stamps, torque = np.concatenate([[before[0]], stamps]), np.concatenate([[before[1]], torque])
            positions = {side: np.concatenate([[before[2][side]], values]) for side, values in positions.items()}
        steps = np.maximum(np.round(np.diff(stamps) / self._period), 1.0)
        at = np.concatenate([[0.0], np.cumsum(steps)])
        every = np.arange(at[-1] + 1.0)
        self._count(LOST, len(every) - len(at))
        if len(every) > len(at):
            torque = torque[np.searchsorted(at, every, side="right") - 1]
            positions = {side: np.interp(every, at, values) for side, values in positions.items()}
        own = slice(0 if before is None else 1, None)
        first = float(stamps[0]) + (0.0 if before is None else self._period)
        return Rows(first, torque[own], {side: values[own] for side, values in positions.items()}, starts_segment)


def period_error(name: str, found: float, period: float) -> InputError:
    """What to raise where samples come at another period (s) than the model's."""
    return InputError(
        f"{name}: samples are {1e3 * found:.6g} ms apart, [run] sample_period of the model is {1e3 * period:.6g} ms; they "
        "should be the same, as gains of observers are for one period"
    )


class FollowedFile:
    """Rows of a text file, from its beginning on, and those that are written to it later.

    Raises:
        InputError: it cannot be read, or is no text.
    """

    def __init__(self, path: Path):
        self.name, self.counts, self.fault = str(path), Counter[str](), ""
        self._path, self._form, self._header = path, None, ""
        self._rest, self._lines = b"", list[str]()
        try:
            check_file(path)
            self._file = path.open("rb")
        except FileNotFoundError:
            raise InputError(f"{path}: {explain_missing_file(path, log_suffixes())}") from None
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror or error}; name a text file") from None

    def poll(self, seconds: float) -> tuple[Sequence[str | int], np.ndarray] | None:
        end = time.monotonic() + seconds
        while not (read := self._read()) and (left := end - time.monotonic()) > 0.0:
            time.sleep(min(_LOOK, left))
        if not read:
            return None
        if b"\0" in read and self._form is None:
            raise InputError(f"{self.name}: is no text: only text files are followed; leave --follow out")
        *lines, self._rest = (self._rest + read).split(b"\n")
        if len(self._rest) > _LONGEST_LINE:
            raise InputError(f"{self.name}: has a line of more than {_LONGEST_LINE / 1e6:.0f} MB; it should have one a row")
        self._lines += [line.decode("utf-8-sig", errors="replace").strip("\r") for line in lines]
        said = [line for line in self._lines if line.strip() and not line.lstrip().startswith("#")]
        if self._form is None:
            # the header and a row; what a comma means shows only in a row
            if len(said) < 2:
                return None
            try:
                self._form = detect_text_format(said)
            except InputError as error:
                raise InputError(f"{self.name}: {error}") from None
            self._header = said[0] if self._form.names is not None else ""
        self._lines = []
        rows = [line for line in said if line != self._header]
        values = self._form.parse_numbers(rows)
        if len(values) < len(rows):
            self.counts[MALFORMED] += len(rows) - len(values)
            self.fault = f"; a line should have {self._form.count} cells"
        return self._form.names or range(self._form.count), values

    def _read(self) -> bytes:
        read = self._file.read(_HEAD)
        if not read:
            try:
                now = self._path.stat()
            except OSError:
                return b""
            own = os.fstat(self._file.fileno())
            if now.st_ino != own.st_ino or now.st_size < self._file.tell():
                # cut off, or another file in its place, which may be gone again
                with suppress(FileNotFoundError):
                    file = self._path.open("rb")
                    self._file.close()
                    self._file, self._rest = file, b""
                    read = self._file.read(_HEAD)
        return read

    def close(self) -> None:
        self._file.close()


class Datagrams:
    """Rows in UDP datagrams: lines of text, or binary numbers (float64, little-endian), one row after the other.

    Args:
        address: `udp://HOST:PORT`, where to listen.
        fields: names of the columns of rows without a header.

    Raises:
        InputError: no such address, or nothing can be received there.
    """

    def __init__(self, address: str, fields: Sequence[str | int]):
        self.name, self.counts = address, Counter[str]()
        self.fault = ""
        self._fields = list(fields)
        self._numbered = any(isinstance(one, int) for one in fields)
        self._form: TextFormat | None = None
        self._header = ""
        host, port = _parse_address(address)
        try:
            family, kind, protocol, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, kind, protocol)
            try:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVED)
                self._socket.bind(place)
            except OSError:
                self._socket.close()
                raise
        except OSError as error:
            raise InputError(
                f"{address}: cannot listen there: {error.strerror or error}; name an address of this machine"
            ) from None
        self.port = self._socket.getsockname()[1]
        # Linux may keep as few as some hundred datagrams, less than come at 10 kHz while values are computed
        self._received, self._closed = deque[bytes](), threading.Event()
        self._receiver = threading.Thread(target=self._receive, name="jaxbl-datagrams", daemon=True)
        self._receiver.start()

    def _receive(self) -> None:
        self._socket.settimeout(_ASKED)
        while not self._closed.is_set():
            # nothing has come, or an error that concerns one datagram
            with suppress(OSError):
                self._received.append(self._socket.recv(1 << 16))

    def poll(self, seconds: float) -> tuple[Sequence[str | int], np.ndarray] | None:
        time.sleep(seconds)
        received = [self._received.popleft() for _ in range(len(self._received))]
        parts, lines = list[np.ndarray](), list[str]()
        for one in received:
            # lines of many datagrams are read at once: one by one it takes too long at 10 kHz
            if one.translate(None, _PLAIN):
                parts += [self._of_text(lines), self._of_bytes(one)]
                lines = []
            else:
                lines += one.decode().splitlines()
        parts = [part for part in (*parts, self._of_text(lines)) if len(part)]
        columns = self._columns()
        # what came before the form was known may have other columns
        parts = [part for part in parts if part.shape[1] == len(columns)]
        return (columns, np.concatenate(parts)) if parts else None

    def _columns(self) -> Sequence[str | int]:
        if self._form is not None and self._form.names is not None:
            return self._form.names
        return range(self._width() if self._form is None else self._form.count) if self._numbered else self._fields

    def _width(self) -> int:
        """Columns of a row without a header, at least."""
        return max([*(one + 1 for one in self._fields if isinstance(one, int)), len(self._fields)])

    def _of_bytes(self, datagram: bytes) -> np.ndarray:
        width = self._width() if self._form is None else self._form.count
        if len(datagram) % (8 * width):
            self._unfit(f"{len(datagram)} bytes; rows of {width} float64 have a multiple of {8 * width}")
            return np.empty((0, width))
        return np.frombuffer(datagram, "<f8").reshape(-1, width)

    def _of_text(self, lines: list[str]) -> np.ndarray:
        """Rows of text. Lines of another form are counted; until one has the form that is needed, those before it are."""
        lines = [one for one in lines if one.strip() and not one.lstrip().startswith("#")]
        while lines and self._form is None and not self._begin(lines):
            lines = lines[1:]
        if self._form is None:
            return np.empty((0, 0))
        rows = [one for one in lines if one != self._header]
        values = self._form.parse_numbers(rows)
        if len(values) < len(rows):
            self.counts[MALFORMED] += len(rows) - len(values)
            self.fault = f"; a line should have {self._form.count} cells"
        return values

    def _begin(self, lines: list[str]) -> bool:
        """See from the first of some lines how rows of text are written; False where that is no row."""
        try:
            form = detect_text_format(lines)
        except InputError as error:
            return self._unfit(str(error))
        if form.names is not None:
            missing = [one for one in self._fields if isinstance(one, str) and one not in form.names]
            if missing:
                return self._unfit(f"no column {missing[0]!r} in {lines[0]!r}")
            self._header = lines[0]
        elif form.count < self._width() or (form.count > self._width() and not self._numbered):
            fields = "" if self._numbered else f": {', '.join(map(str, self._fields))}"
            return self._unfit(f"{form.count} cells in {lines[0]!r}; there should be {self._width()}{fields}")
        self._form = form
        return True

    def _unfit(self, why: str) -> bool:
        self.counts[MALFORMED] += 1
        self.fault = f"; the last: {shorten(why, 200)}"
        return False

    def close(self) -> None:
        self._closed.set()
        self._receiver.join()
        self._socket.close()


def _parse_address(address: str) -> tuple[str, int]:
    wrong = InputError(f"{address}: should be udp://HOST:PORT, as udp://127.0.0.1:9870")
    try:
        parts = urlsplit(address)
        host, port = parts.hostname, parts.port
    except ValueError:
        raise wrong from None
    if parts.scheme != "udp" or not host or port is None or parts.path.strip("/") or parts.query:
        raise wrong
    return host, port
