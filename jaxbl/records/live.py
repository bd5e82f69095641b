"""Rows that arrive one at a time: a text file that grows, or datagrams.

Columns and `[log]` table are those of a whole log. Unfit rows are counted and left out, as nobody can correct them any more.
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
from jaxbl.validation import check_file

from .channels import decode_words, to_si
from .files import MAX_LINE_BYTES, LogFile, TextFormat, detect_text_format, has_cells, name_file_in_errors
from .libraries import ColumnName, Columns
from .table import POSITION_CHANNELS, LogTable, PositionTable, SpeedTable, TimeTable, TorqueTable
from .time_stamps import GAP_PERIODS, SECONDS_PER_UNIT

Block = tuple[Sequence[ColumnName], np.ndarray]
"""Names of columns, and numbers, shape (rows, columns)."""
MALFORMED, UNREADABLE, DISORDERED = "malformed datagrams or lines", "rows without a number", "rows late or repeated"
LOST, GAPS, RESTARTS = "lost samples interpolated", "gaps in time", "restarts of the clock"
"""Faults that are counted."""
_READ_BYTES = 1 << 18
"""Bytes of a file that are read at once."""
_FILE_POLL_SECONDS = 0.02
"""Interval at which a file is read."""
_BUFFER_BYTES = 1 << 22
"""Bytes of datagrams that the system is asked to buffer; it may buffer fewer."""
_SOCKET_TIMEOUT = 0.1
"""Seconds after which the receiving thread checks whether its socket is to be closed."""
_RESTART_SECONDS = 1.0
"""Seconds by which time goes back after a restart of the sender; datagrams overtake one another by less."""
_PERIOD_ROWS, _PERIOD_STRIDE, _PERIOD_TOLERANCE = 256, 8, 0.02
"""Rows from which the sampling period is found, rows in each interval between two of them, and relative tolerance."""
_TEXT_BYTES = bytes(range(32, 127)) + b"\t\r\n"
"""Bytes of text; a datagram with other ones holds binary numbers."""


class Rows(NamedTuple):
    """Samples one sampling period apart.

    Attributes:
        time: stamp of the first one, s.
        torque: N m (N), shape (samples,).
        positions: of motor and load, rad (m), shape (samples,) each.
        starts_segment: True if they do not continue the previous rows.
    """

    time: float
    torque: np.ndarray
    positions: dict[str, np.ndarray]
    starts_segment: bool


class Source(Protocol):
    """A source of rows.

    Attributes:
        name: for messages.
        counts: fault -> number of rows, lines or datagrams that were left out.
        fault: end of a sentence on the last line or datagram that could not be read; "" if there is none.
    """

    name: str
    counts: Counter[str]
    fault: str

    def poll(self, seconds: float) -> Block | None:
        """Wait at most `seconds` for rows.

        Returns:
            Names of the columns, and numbers (rows, columns), NaN for a cell without one; None if nothing has come.

        Raises:
            InputError: no row can be used.
        """
        ...

    def close(self) -> None:
        """Release the file or the address."""
        ...


def _stream_channels(table: LogTable) -> dict[str, TimeTable | TorqueTable | PositionTable | SpeedTable]:
    """Return the tables of the channels of a stream; without `t` if the rows have no stamps."""
    clock = table.t or TimeTable()
    channels = {"t": clock} if clock.period is None else {}
    return channels | {"u": table.u or TorqueTable()} | dict(map(table.position_source, POSITION_CHANNELS.values()))


def stream_columns(table: LogTable) -> list[ColumnName]:
    """Return the columns that are read from a stream, in the order of rows without a header.

    Time, input, motor and load position come first, then columns to be subtracted, then those of `where`.
    """
    channels = _stream_channels(table)
    columns = [channel_table.column_or(channel) for channel, channel_table in channels.items()]
    columns += [end.minus for end in channels.values() if isinstance(end, PositionTable) and end.minus is not None]
    return list(dict.fromkeys([*columns, *(table.where or {})]))


def check_stream_table(table: LogTable, name: str) -> None:
    """Refuse keys of `[log]` that need the whole log.

    Raises:
        InputError: names the key; it begins with `name`, the file of the table.
    """
    if table.absent:
        raise InputError(f"{name}: [log] absent: {', '.join(table.absent)}; a stream needs u, theta_e and theta_s")
    channels = _stream_channels(table)
    keys = [f"{channel}.{key}" for channel in channels for key in ("skew", "drift") if getattr(channels[channel], key, None)]
    keys += [key for key in ("start", "stop", "resample") if getattr(table, key) is not None]
    # a sampled torque is known only with the next sample
    keys += ["hold"] if table.hold == "sampled" else []
    keys += [f"where.{key}" for key, required in (table.where or {}).items() if isinstance(required, str)]
    if keys:
        raise InputError(f"{name}: [log] {keys[0]} is for whole logs; remove it to read rows that arrive one at a time")


class _ChannelReader:
    """Converts rows of columns to SI units; it remembers the turns of wrapped positions, and the integrals of speeds."""

    def __init__(self, table: LogTable, name: str, columns: Sequence[ColumnName]):
        self._table, self._channels = table, _stream_channels(table)
        file = LogFile(Path(name), Columns(dict.fromkeys(columns, ())))
        keys = {channel_table.column_or(channel): channel for channel, channel_table in self._channels.items()}
        self._indices = {
            column: list(columns).index(file.find_column(column, keys.get(column, ""))) for column in stream_columns(table)
        }
        self._previous: dict[str, float] = {}
        self._row = 0

    def convert(self, values: np.ndarray) -> tuple[np.ndarray, int]:
        """Convert values (rows, columns).

        Returns:
            Samples: stamps (s), torque, motor and load position, shape (4, samples). Number of rows that were unreadable.
        """
        # the same as pandas' comparison of a column with a number, true or false
        for column, required in (self._table.where or {}).items():
            values = values[values[:, self._indices[column]] == required]
        clock = self._table.t or TimeTable()
        if clock.period is not None:
            stamps = (self._row + np.arange(len(values))) * clock.period
            self._row += len(values)
        else:
            stamps = values[:, self._indices[clock.column_or("t")]] * SECONDS_PER_UNIT[clock.unit]
        torque_table = self._table.u or TorqueTable()
        torque = to_si(torque_table, decode_words(torque_table, values[:, self._indices[torque_table.column_or("u")]]))
        signals = [stamps, torque]
        for name in POSITION_CHANNELS.values():
            channel, position_table = self._table.position_source(name)
            numbers = decode_words(position_table, values[:, self._indices[position_table.column_or(channel)]])
            if isinstance(position_table, PositionTable) and position_table.minus is not None:
                numbers = numbers - decode_words(position_table, values[:, self._indices[position_table.minus]])
            signals.append(numbers)
        samples = np.stack(signals)
        samples = samples[:, np.isfinite(samples).all(axis=0)]
        for i, name in enumerate(POSITION_CHANNELS.values(), 2):
            samples[i] = self._read_position(name, samples[i], samples[0])
        return samples, len(values) - samples.shape[1]

    def _read_position(self, name: str, values: np.ndarray, stamps: np.ndarray) -> np.ndarray:
        if not len(values):
            return values
        _, table = self._table.position_source(name)
        if isinstance(table, SpeedTable):
            speed = to_si(table, values)
            speeds = np.append(self._previous.get(f"{name} speed", float(speed[0])), speed)
            times = np.append(self._previous.get(f"{name} time", float(stamps[0])), stamps)
            # over a gap, too, as if the speed had changed linearly
            steps = np.diff(times) * 0.5 * (speeds[1:] + speeds[:-1])
            position = self._previous.get(name, 0.0) + np.cumsum(steps)
            self._previous |= {name: position[-1], f"{name} speed": speed[-1], f"{name} time": stamps[-1]}
            return position
        if table.wrap is not None:
            values = np.unwrap(np.append(self._previous.get(name, float(values[0])), values), period=table.wrap)[1:]
            self._previous[name] = values[-1]
        return to_si(table, values)


class Stream:
    """Rows of a source in SI units, one sampling period apart.

    Up to two lost samples in a row are interpolated, as in a log: positions linearly, while the input is held. After a
    longer gap a new segment starts.

    Args:
        source: of the rows.
        table: says how its columns are read.
        period: expected sampling period, s.
    """

    def __init__(self, source: Source, table: LogTable, period: float):
        self.source, self.counts = source, source.counts
        self._table, self._period = table, period
        self._reader: _ChannelReader | None = None
        self._columns: list[ColumnName] = []
        self._last = np.empty((4, 0))
        self._first_stamps: list[float] = []
        self._is_period_checked = False

    def poll(self, seconds: float) -> list[Rows]:
        """Return the rows that arrive within `seconds`.

        Raises:
            InputError: a column is missing, or samples come at another period.
        """
        block = self.source.poll(seconds)
        if block is None:
            return []
        columns, values = block
        if self._reader is None or list(columns) != self._columns:
            self._reader, self._columns = _ChannelReader(self._table, self.source.name, columns), list(columns)
        samples, unreadable = self._reader.convert(values)
        self._count(UNREADABLE, unreadable)
        self._check_period(samples[0])
        return self._split_rows(samples)

    def _count(self, fault: str, number: int) -> None:
        if number:
            self.counts[fault] += number

    def _check_period(self, stamps: np.ndarray) -> None:
        """Compare the period of the first rows with the expected one."""
        if self._is_period_checked:
            return
        self._first_stamps += stamps.tolist()
        if len(self._first_stamps) < _PERIOD_ROWS:
            return
        self._is_period_checked, times = True, np.array(self._first_stamps)
        measured = float(np.median(times[_PERIOD_STRIDE:] - times[:-_PERIOD_STRIDE])) / _PERIOD_STRIDE
        if not math.isclose(measured, self._period, rel_tol=_PERIOD_TOLERANCE):
            raise period_error(self.source.name, measured, self._period)
        if np.mean(np.diff(times) == 0.0) > 0.5:
            raise InputError(
                f"{self.source.name}: most rows have the time stamp of the row before; stamps should be finer than the "
                "sampling period, or [log] t = { period = ... } says that there are none"
            )

    def _split_rows(self, samples: np.ndarray) -> list[Rows]:
        """Leave out rows that are late or repeated, and split the others at gaps and at restarts of the clock."""
        stamps = samples[0]
        latest = np.maximum.accumulate(np.concatenate([[-np.inf], self._last[0], stamps]))[-len(stamps) - 1 : -1]
        is_restart = latest - stamps > _RESTART_SECONDS
        if is_restart.any():
            restart = int(np.argmax(is_restart))
            rows = self._split_rows(samples[:, :restart])
            self._count(RESTARTS, 1)
            self._last = samples[:, :0]
            return [*rows, *self._split_rows(samples[:, restart:])]
        is_later = stamps > latest
        self._count(DISORDERED, int(np.count_nonzero(~is_later)))
        if not is_later.any():
            return []
        # from the last sample, which was returned already, lost ones are interpolated
        samples, returned = np.concatenate([self._last, samples[:, is_later]], axis=1), self._last.shape[1]
        self._last = samples[:, -1:]
        starts = np.flatnonzero(np.diff(samples[0]) > GAP_PERIODS * self._period) + 1
        self._count(GAPS, len(starts))
        rows = []
        for piece in np.split(samples, starts, axis=1):
            if piece.shape[1] > returned:
                rows.append(self._interpolate_lost(piece, returned))
            returned = 0
        return rows

    def _interpolate_lost(self, samples: np.ndarray, returned: int) -> Rows:
        """Return rows without a gap, with lost samples interpolated; stamps may jitter by less than half a period.

        The first of the samples was `returned` already (1), or a segment starts with it (0).
        """
        stamps, torque, *positions = samples
        steps = np.maximum(np.round(np.diff(stamps) / self._period), 1.0)
        received = np.concatenate([[0.0], np.cumsum(steps)])
        numbers = np.arange(received[-1] + 1.0)
        self._count(LOST, len(numbers) - len(received))
        if len(numbers) > len(received):
            torque = torque[np.searchsorted(received, numbers, side="right") - 1]
            positions = [np.interp(numbers, received, values) for values in positions]
        sides = {side: values[returned:] for side, values in zip(POSITION_CHANNELS, positions, strict=True)}
        return Rows(float(stamps[0]) + returned * self._period, torque[returned:], sides, not returned)


def period_error(name: str, measured: float, period: float) -> InputError:
    """Return the error to be raised if samples come at another period (s) than the model's."""
    return InputError(
        f"{name}: samples are {1e3 * measured:.6g} ms apart, [run] sample_period of the model is {1e3 * period:.6g} ms; "
        "they should be equal, as observer gains hold for one period"
    )


class _TextSource:
    """Rows of text in the format of the first ones; attributes are those of a :class:`Source`."""

    def __init__(self, name: str):
        self.name, self.counts, self.fault = name, Counter[str](), ""
        self._format: TextFormat | None = None
        self._header = ""

    def _parse_rows(self, text_format: TextFormat, lines: list[str]) -> np.ndarray:
        """Parse lines into numbers, shape (rows, columns). Repeated headers are left out, malformed lines are counted."""
        rows = [line for line in lines if line != self._header]
        values = text_format.parse_numbers(rows)
        if len(values) < len(rows):
            self.counts[MALFORMED] += len(rows) - len(values)
            self.fault = f"; a line should have {text_format.count} cells"
        return values


class FollowedFile(_TextSource):
    """Rows of a text file, from its beginning on, and those that are written to it later.

    Raises:
        InputError: it cannot be read, or is no text.
    """

    def __init__(self, path: Path):
        super().__init__(str(path))
        self._path = path
        self._incomplete_line, self._lines = b"", list[str]()
        with name_file_in_errors(path, "name a text file"):
            check_file(path)
            self._file = path.open("rb")

    def poll(self, seconds: float) -> Block | None:
        end = time.monotonic() + seconds
        while not (block := self._read()) and (remaining := end - time.monotonic()) > 0.0:
            time.sleep(min(_FILE_POLL_SECONDS, remaining))
        if not block:
            return None
        if b"\0" in block and self._format is None:
            raise InputError(f"{self.name}: is no text: only text files are followed; leave --follow out")
        *lines, self._incomplete_line = (self._incomplete_line + block).split(b"\n")
        if len(self._incomplete_line) > MAX_LINE_BYTES:
            raise InputError(f"{self.name}: has a line of more than {MAX_LINE_BYTES / 1e6:.0f} MB; it should have one a row")
        self._lines += [line.decode("utf-8-sig", errors="replace").strip("\r") for line in lines]
        rows = list(filter(has_cells, self._lines))
        if self._format is None:
            # the header and a row: the decimal sign shows only in a row
            if len(rows) < 2:
                return None
            with name_file_in_errors(self.name):
                self._format = detect_text_format(rows)
            self._header = rows[0] if self._format.names is not None else ""
        self._lines = []
        return self._format.names or range(self._format.count), self._parse_rows(self._format, rows)

    def _read(self) -> bytes:
        block = self._file.read(_READ_BYTES)
        if not block:
            try:
                current = self._path.stat()
            except OSError:
                return b""
            opened = os.fstat(self._file.fileno())
            if current.st_ino != opened.st_ino or current.st_size < self._file.tell():
                # cut off, or replaced by another file, which may have vanished again
                with suppress(FileNotFoundError):
                    file = self._path.open("rb")
                    self._file.close()
                    self._file, self._incomplete_line = file, b""
                    block = self._file.read(_READ_BYTES)
        return block

    def close(self) -> None:
        self._file.close()


class Datagrams(_TextSource):
    """Rows in UDP datagrams: lines of text, or binary numbers (float64, little-endian), one row after the other.

    Args:
        address: `udp://HOST:PORT` to listen at.
        fields: names of the columns of rows without a header.

    Raises:
        InputError: there is no such address, or nothing can be received there.
    """

    def __init__(self, address: str, fields: Sequence[ColumnName]):
        super().__init__(address)
        self._fields = list(fields)
        self._has_numbered_fields = any(isinstance(field, int) for field in fields)
        host, port = _parse_address(address)
        try:
            family, kind, protocol, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, kind, protocol)
            try:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
                self._socket.bind(place)
            except OSError:
                self._socket.close()
                raise
        except OSError as error:
            raise InputError(
                f"{address}: cannot listen there: {error.strerror or error}; name an address of this machine"
            ) from None
        self.port = self._socket.getsockname()[1]
        # Linux may buffer only some hundred datagrams, fewer than come at 10 kHz while values are computed
        self._received, self._closing = deque[bytes](), threading.Event()
        self._receiver = threading.Thread(target=self._receive, name="jaxbl-datagrams", daemon=True)
        self._receiver.start()

    def _receive(self) -> None:
        self._socket.settimeout(_SOCKET_TIMEOUT)
        while not self._closing.is_set():
            # nothing has come, or an error that concerns a single datagram
            with suppress(OSError):
                self._received.append(self._socket.recv(1 << 16))

    def poll(self, seconds: float) -> Block | None:
        time.sleep(seconds)
        datagrams = [self._received.popleft() for _ in range(len(self._received))]
        parts, lines = list[np.ndarray](), list[str]()
        for datagram in datagrams:
            # lines of many datagrams are parsed at once: singly it takes too long at 10 kHz
            if datagram.translate(None, _TEXT_BYTES):
                parts += [self._parse_text(lines), self._parse_bytes(datagram)]
                lines = []
            else:
                lines += datagram.decode().splitlines()
        parts = [part for part in (*parts, self._parse_text(lines)) if len(part)]
        columns = self._column_names()
        # rows that came before the format was known may have other columns
        parts = [part for part in parts if part.shape[1] == len(columns)]
        return (columns, np.concatenate(parts)) if parts else None

    def _column_names(self) -> Sequence[ColumnName]:
        if self._format is not None and self._format.names is not None:
            return self._format.names
        return range(self._count_columns()) if self._has_numbered_fields else self._fields

    def _count_columns(self) -> int:
        """Return the number of columns; before the format is known, the least number of a row without a header."""
        if self._format is not None:
            return self._format.count
        return max([*(field + 1 for field in self._fields if isinstance(field, int)), len(self._fields)])

    def _parse_bytes(self, datagram: bytes) -> np.ndarray:
        width = self._count_columns()
        if len(datagram) % (8 * width):
            self._count_malformed(f"{len(datagram)} bytes; rows of {width} float64 have a multiple of {8 * width}")
            return np.empty((0, width))
        return np.frombuffer(datagram, "<f8").reshape(-1, width)

    def _parse_text(self, lines: list[str]) -> np.ndarray:
        """Parse lines into numbers, shape (rows, columns). Lines before the first one in a fit format are malformed."""
        lines = list(filter(has_cells, lines))
        while lines and self._format is None and not self._detect_format(lines):
            lines = lines[1:]
        return np.empty((0, 0)) if self._format is None else self._parse_rows(self._format, lines)

    def _detect_format(self, lines: list[str]) -> bool:
        """Detect the format from the first of some lines; False if that line is malformed."""
        try:
            text_format = detect_text_format(lines)
        except InputError as error:
            return self._count_malformed(str(error))
        width = self._count_columns()
        if text_format.names is not None:
            missing = [field for field in self._fields if isinstance(field, str) and field not in text_format.names]
            if missing:
                return self._count_malformed(f"no column {missing[0]!r} in {lines[0]!r}")
            self._header = lines[0]
        elif text_format.count < width or (text_format.count > width and not self._has_numbered_fields):
            fields = "" if self._has_numbered_fields else f": {', '.join(map(str, self._fields))}"
            return self._count_malformed(f"{text_format.count} cells in {lines[0]!r}; there should be {width}{fields}")
        self._format = text_format
        return True

    def _count_malformed(self, fault: str) -> bool:
        self.counts[MALFORMED] += 1
        self.fault = f"; the last: {shorten(fault, 200)}"
        return False

    def close(self) -> None:
        self._closing.set()
        self._receiver.join()
        self._socket.close()


def _parse_address(address: str) -> tuple[str, int]:
    error = InputError(f"{address}: should be udp://HOST:PORT, as udp://127.0.0.1:9870")
    try:
        parts = urlsplit(address)
        host, port = parts.hostname, parts.port
    except ValueError:
        raise error from None
    if parts.scheme != "udp" or not host or port is None or parts.path.strip("/") or parts.query:
        raise error
    return host, port
