"""Rows that arrive one at a time: a text file that grows, or datagrams.

Columns and `[log]` table are those of a whole log. Unfit rows are counted and left out, as nobody can correct them any more.
"""

import math
import os
import re
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

import numpy as np

from jaxbl.errors import InputError, shorten
from jaxbl.validation import LARGEST, open_regular_file

from .channels import decode_words, to_si
from .files import MAX_LINE_BYTES, LogFile, TextFormat, detect_text_format, has_cells, name_file_in_errors
from .libraries import ColumnName, Columns
from .table import POSITION_CHANNELS, ChannelTable, LogTable, PositionTable, SpeedTable, TimeTable, TorqueTable
from .time_stamps import GAP_PERIODS, SECONDS_PER_UNIT

Block = tuple[Sequence[ColumnName], np.ndarray]
"""Names of columns, and numbers, shape (rows, columns)."""
MALFORMED, UNREADABLE, DISORDERED = "malformed datagrams or lines", "rows without a number", "rows late or repeated"
TOO_FAST = "datagrams that came faster than they could be taken in"
LOST, GAPS, RESTARTS = "lost samples interpolated", "gaps in time", "restarts of the clock"
OUTLIERS, OTHER_PERIOD = "rows far from both neighbours", "rows at another period"
OTHER_FILES, OTHER_COLUMNS = "files that cannot be followed", "rows without a column that is needed"
"""Faults that are counted."""
_READ_BYTES = 1 << 18
"""Bytes of a file that are read at once."""
_FILE_POLL_SECONDS = 0.02
"""Interval at which a file is read."""
_BUFFER_BYTES = 1 << 22
"""Bytes of datagrams that the system is asked to buffer; it may buffer fewer."""
_WAITING_BYTES = 1 << 28
"""Bytes of datagrams that may wait to be taken in: a minute of 10 kHz."""
_SOCKET_TIMEOUT = 0.1
"""Seconds after which the receiving thread checks whether its socket is to be closed."""
_RESTART_SECONDS = 1.0
"""Seconds by which time goes back after a restart of the sender; datagrams overtake one another by less."""
_PERIOD_ROWS, _PERIOD_STRIDE, _PERIOD_TOLERANCE = 256, 8, 0.02
"""Rows from which the sampling period is found, rows in each interval between two of them, and relative tolerance."""
_OUTLIER_STEPS, _USUAL_STEPS = 100.0, 0.9
"""Steps to and from an outlier, over the step of which this share is smaller: no drive turns around within a sample so."""
_RECENT_ROWS = 256
"""Rows before those that arrive, which say what steps are usual."""
_BATCH_ROWS = 2048
"""Rows from which on no more are taken at once: what comes in a burst leaves time to hear that the watch is to end."""
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


def _stream_signals(table: LogTable) -> dict[str, ChannelTable]:
    """Return the tables of input, motor and load position by channel."""
    return {"u": table.u or TorqueTable()} | dict(map(table.position_source, POSITION_CHANNELS.values()))


def stream_columns(table: LogTable) -> list[ColumnName]:
    """Return the columns that are read from a stream, in the order of rows without a header.

    Time, input, motor and load position come first, then columns to be subtracted, then those of `where`.
    """
    clock, signals = table.t or TimeTable(), _stream_signals(table)
    columns = [clock.column_or("t")] if clock.period is None else []
    columns += [source.column_or(channel) for channel, source in signals.items()]
    columns += [end.minus for end in signals.values() if isinstance(end, PositionTable) and end.minus is not None]
    return list(dict.fromkeys([*columns, *(table.where or {})]))


def check_stream_table(table: LogTable, name: str) -> None:
    """Refuse keys of `[log]` that need the whole log.

    Raises:
        InputError: names the key; it begins with `name`, the file of the table.
    """
    if table.absent:
        raise InputError(f"{name}: [log] absent: {', '.join(table.absent)}; a stream needs u, theta_e and theta_s")
    signals = _stream_signals(table)
    keys = [f"{channel}.{key}" for channel in signals for key in ("skew", "drift") if getattr(signals[channel], key, None)]
    keys += [key for key in ("start", "stop", "resample") if getattr(table, key) is not None]
    # a sampled torque is known only with the next sample
    keys += ["hold"] if table.hold == "sampled" else []
    keys += [f"where.{key}" for key, required in (table.where or {}).items() if isinstance(required, str)]
    if keys:
        raise InputError(f"{name}: [log] {keys[0]} is for whole logs; remove it to read rows that arrive one at a time")


class Stream:
    """Rows of a source in SI units, one sampling period apart.

    Up to two lost samples in a row are interpolated, as in a log: positions linearly, while the input is held. After a
    longer gap a new segment starts. Turns of wrapped positions and integrals of speeds go on from block to block.

    Args:
        source: of the rows.
        table: says how its columns are read.
        period: expected sampling period, s.
    """

    def __init__(self, source: "Source", table: LogTable, period: float):
        self.source, self.counts = source, source.counts
        self._table, self._period = table, period
        self._clock, self._signals = table.t or TimeTable(), _stream_signals(table)
        self._columns: Sequence[ColumnName] = ()
        self._is_period_right: bool | None = None

    def poll(self, seconds: float) -> list[Rows]:
        """Return the rows that arrive within `seconds`.

        Raises:
            InputError: a column is missing, or samples come at another period, from the beginning on.
        """
        block = self.source.poll(seconds)
        if block is None:
            return []
        columns, values = block
        # another file begins anew, with the same names, too
        if columns is not self._columns and not self._read_columns(columns):
            self._count(OTHER_COLUMNS, len(values))
            return []
        before = self._recent[:, -1:]
        samples = self._convert(before, self._leave_out_outliers(self._decode(values)))
        self._check_period(samples[0])
        return self._split_rows(samples)

    def _read_columns(self, columns: Sequence[ColumnName]) -> bool:
        """Read other columns from now on; False if there are columns that have been read, and one of these is missing."""
        file = LogFile(Path(self.source.name), Columns(dict.fromkeys(columns, ())))
        keys = {source.column_or(channel): channel for channel, source in [("t", self._clock), *self._signals.items()]}
        try:
            self._indices = {
                column: list(columns).index(file.find_column(column, keys.get(column, "")))
                for column in stream_columns(self._table)
            }
        except InputError as error:
            if not self._columns:
                raise
            self.source.fault = f"; {shorten(str(error), 200)}"
            return False
        # another sender may have another clock, period and zero
        self._recent = self._held = self._last = np.empty((4, 0))
        self._ends, self._row = np.zeros(3), 0
        self._first_stamps: list[float] = []
        self._columns = columns
        return True

    def _decode(self, values: np.ndarray) -> np.ndarray:
        """Return stamps (s), torque, motor and load as they were sent, shape (4, samples), of rows that can be read."""
        # the same as pandas' comparison of a column with a number, true or false
        for column, required in (self._table.where or {}).items():
            values = values[values[:, self._indices[column]] == required]
        columns = {column: values[:, index] for column, index in self._indices.items()}
        if self._clock.period is not None:
            stamps = (self._row + np.arange(len(values))) * self._clock.period
            self._row += len(values)
        else:
            stamps = columns[self._clock.column_or("t")] * SECONDS_PER_UNIT[self._clock.unit]
        signals, is_readable = [stamps], np.abs(stamps) * np.finfo(float).eps < 0.5 * self._period
        for channel, table in self._signals.items():
            numbers = decode_words(table, columns[table.column_or(channel)])
            if (minus := getattr(table, "minus", None)) is not None:
                numbers = numbers - decode_words(table, columns[minus])
            elif wrap := getattr(table, "wrap", None):
                is_readable &= np.abs(numbers) <= 2.0 * wrap
            signals.append(numbers)
        samples = np.stack(signals)
        samples = samples[:, is_readable & (np.abs(samples) <= LARGEST).all(axis=0)]
        self._count(UNREADABLE, len(values) - samples.shape[1])
        return samples

    def _convert(self, before: np.ndarray, samples: np.ndarray) -> np.ndarray:
        """Convert decoded samples, shape (4, samples), to SI units, with the turns that they belong to.

        `before` is the sample before them, if there is one, shape (4, 0 or 1).
        """
        from scipy.integrate import cumulative_trapezoid

        if not samples.shape[1]:
            return samples
        numbers, earlier, signals = np.concatenate([before, samples], axis=1), before.shape[1], [samples[0]]
        for i, (table, values) in enumerate(zip(self._signals.values(), numbers[1:], strict=True)):
            if isinstance(table, SpeedTable):
                # over a gap, too, as if the speed had changed linearly
                values = cumulative_trapezoid(to_si(table, values), numbers[0], initial=0.0)
            elif wrap := getattr(table, "wrap", None):
                values = np.unwrap(values, period=wrap)
            values = (values + (self._ends[i] - values[0] if earlier else 0.0))[earlier:]
            self._ends[i] = values[-1]
            signals.append(values if isinstance(table, SpeedTable) else to_si(table, values))
        return np.stack(signals)

    def _count(self, fault: str, number: int) -> None:
        if number:
            self.counts[fault] += int(number)

    def _leave_out_outliers(self, samples: np.ndarray) -> np.ndarray:
        """Leave out single rows far from both neighbours, which would move the observers or the clock for long.

        A row at the end that is far from the one before is held until the next one has come.
        """
        recent = self._recent.shape[1]
        samples, self._held = np.concatenate([self._recent, self._held, samples], axis=1), samples[:, :0]
        is_new = np.arange(samples.shape[1]) >= recent
        if samples.shape[1] > 2:
            steps = np.diff(samples)
            for i, table in enumerate(self._signals.values(), 1):
                # the shorter way
                if wrap := getattr(table, "wrap", None):
                    steps[i] = (steps[i] + 0.5 * wrap) % wrap - 0.5 * wrap
            sizes = np.abs(steps)
            usual = np.quantile(sizes, _USUAL_STEPS, axis=1)
            # at standstill: a count
            least = np.where(sizes > 0.0, sizes, np.inf).min(axis=1)
            limits = _OUTLIER_STEPS * np.where(usual > 0.0, usual, least)
            limits[0] = max(_RESTART_SECONDS, GAP_PERIODS * self._period)
            is_far = sizes > limits[:, None]
            goes_back = is_far[:, :-1] & is_far[:, 1:] & (steps[:, :-1] * steps[:, 1:] < 0.0)
            # the first row has one neighbour
            is_outlier = np.vstack([is_far[:, 0] & ~is_far[:, 1], goes_back.T, is_far[:, 0] & False]).any(axis=1) & is_new
            if is_far[:, -1].any() and not is_outlier[-2]:
                self._held, is_new[-1] = samples[:, -1:], False
            self._count(OUTLIERS, is_outlier.sum())
            is_new &= ~is_outlier
        new = samples[:, is_new]
        self._recent = np.concatenate([self._recent, new], axis=1)[:, -_RECENT_ROWS:]
        return new

    def _check_period(self, stamps: np.ndarray) -> None:
        """Compare the period of the first rows with the expected one."""
        if len(self._first_stamps) >= _PERIOD_ROWS:
            return
        self._first_stamps += stamps.tolist()
        if len(self._first_stamps) < _PERIOD_ROWS:
            return
        times, fault = np.array(self._first_stamps), None
        measured = float(np.median(times[_PERIOD_STRIDE:] - times[:-_PERIOD_STRIDE])) / _PERIOD_STRIDE
        if not math.isclose(measured, self._period, rel_tol=_PERIOD_TOLERANCE):
            fault = period_error(self.source.name, measured, self._period)
        elif np.mean(np.diff(times) == 0.0) > 0.5:
            fault = InputError(
                f"{self.source.name}: most rows have the time stamp of the row before; stamps should be finer than the "
                "sampling period, or [log] t = { period = ... } says that there are none"
            )
        if fault is not None:
            if self._is_period_right is None:
                raise fault
            self.source.fault = f"; {fault}"
        self._is_period_right = fault is None

    def _split_rows(self, samples: np.ndarray) -> list[Rows]:
        """Leave out rows that are late or repeated, and split the others at gaps and at restarts of the clock."""
        stamps = samples[0]
        if self._is_period_right is False and len(self._first_stamps) >= _PERIOD_ROWS:
            self._count(OTHER_PERIOD, len(stamps))
            return []
        latest = np.maximum.accumulate(np.concatenate([[-np.inf], self._last[0], stamps]))[-len(stamps) - 1 : -1]
        is_restart = latest - stamps > _RESTART_SECONDS
        if is_restart.any():
            restart = np.argmax(is_restart)
            rows = self._split_rows(samples[:, :restart])
            self._count(RESTARTS, 1)
            self._last, self._first_stamps = samples[:, :0], []
            self._check_period(stamps[restart:])
            return [*rows, *self._split_rows(samples[:, restart:])]
        is_later = stamps > latest
        self._count(DISORDERED, int(np.count_nonzero(~is_later)))
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
        received = np.cumsum(np.append(0.0, steps))
        numbers = np.arange(received[-1] + 1.0)
        self._count(LOST, len(numbers) - len(received))
        torque = torque[np.searchsorted(received, numbers, side="right") - 1]
        positions = [np.interp(numbers, received, values)[returned:] for values in positions]
        sides = dict(zip(POSITION_CHANNELS, positions, strict=True))
        return Rows(float(stamps[0]) + returned * self._period, torque[returned:], sides, not returned)


def period_error(name: str, measured: float, period: float) -> InputError:
    """Return the error to be raised if samples come at another period (s) than the model's."""
    return InputError(
        f"{name}: samples are {1e3 * measured:.6g} ms apart, [run] sample_period of the model is {1e3 * period:.6g} ms; "
        "they should be equal, as observer gains hold for one period"
    )


class Source:
    """A source of rows of text, in the format of the first ones or of a later header.

    Args:
        name: for messages.
        fields: columns that are needed.
        columns: of rows before there is a header; none where the first rows have to tell them.

    Attributes:
        name: for messages.
        counts: fault -> number of rows, lines or datagrams that were left out.
        fault: end of a sentence on the last line or datagram that could not be read; "" if there is none.
    """

    _format_lines = 1
    """Lines that the format is detected from, at least."""

    def __init__(self, name: str, fields: Sequence[ColumnName], columns: Sequence[ColumnName] = ()):
        self.name, self.counts, self.fault = name, Counter[str](), ""
        self._needed = [field for field in fields if isinstance(field, str)]
        self._columns, self._header = columns, ""
        self._format: TextFormat | None = None
        self._blocks = deque[tuple[Sequence[ColumnName], list[list[float]]]]()

    def poll(self, seconds: float) -> Block | None:
        """Wait at most `seconds` for rows.

        Returns:
            Names of the columns, a list of its own for each header, and numbers (rows, columns), NaN for a cell without one;
            None if nothing has come.

        Raises:
            InputError: no row can be used.
        """
        if not self._blocks:
            self._receive(seconds)
        if not self._blocks:
            return None
        columns, rows = self._blocks.popleft()
        return columns, np.array(rows)

    def _receive(self, seconds: float) -> None:
        """Wait at most `seconds` for rows, and add them."""
        raise NotImplementedError

    def close(self) -> None:
        """Release the file or the address."""

    def _parse_lines(self, lines: deque[str]) -> None:
        """Take lines, none of them blank, and add their rows; too few lines to show the format are left.

        Repeated headers are left out, malformed lines are counted. A header of other columns begins another format.
        """
        while lines and (self._format is not None or len(lines) >= self._format_lines):
            try:
                text_format = self._format or self._set_format(detect_text_format([*lines]), lines[0])
            except InputError as error:
                if not self._columns:
                    raise InputError(f"{self.name}: {error}") from None
                self._count(MALFORMED, f"the last: {error}")
                lines.popleft()
                continue
            if (line := lines.popleft()) == self._header:
                continue
            row = text_format.parse_row(line)
            if (row is None or all(map(math.isnan, row))) and (header := self._find_header(line)) is not None:
                self._set_format(header._replace(decimal=text_format.decimal), line)
            elif row is None:
                self._count(MALFORMED, f"a line should have {text_format.count} cells")
            else:
                self._add_rows([row])

    def _find_header(self, line: str) -> TextFormat | None:
        """Return the format that a line begins which names all columns that are needed."""
        with suppress(InputError):
            text_format = detect_text_format([line])
            if text_format.names is not None and self._needed and {*self._needed} <= {*text_format.names}:
                return text_format
        return None

    def _set_format(self, text_format: TextFormat, line: str) -> TextFormat:
        """Read as of `line` in another format. A file that was cut off may go on without a header.

        Raises:
            InputError: the format does not have the columns that are needed.
        """
        if text_format.names is not None:
            self._columns, self._header = text_format.names, line
        elif text_format.count != len(self._columns):
            self._columns, self._header = range(text_format.count), ""
        self._format = text_format
        return text_format

    def _add_rows(self, rows: list[list[float]]) -> None:
        last_columns, last_rows = self._blocks[-1] if self._blocks else ((), [])
        if last_columns is not self._columns or len(last_rows) >= _BATCH_ROWS:
            self._blocks.append((self._columns, []))
        self._blocks[-1][1].extend(rows)

    def _count(self, fault: str, text: str) -> None:
        self.counts[fault] += 1
        self.fault = f"; {shorten(text, 200)}"


class FollowedFile(Source):
    """Rows of a text file, from its beginning on, and those that are written to it later.

    Args:
        path: the file; another one may take its place, with columns of its own.
        fields: columns that are needed; a later header counts if it has them.

    Raises:
        InputError: it cannot be read, or is no text.
    """

    _format_lines = 2
    """A header and a row: the decimal sign shows only in a row."""

    def __init__(self, path: Path, fields: Sequence[ColumnName] = ()):
        super().__init__(str(path), fields)
        self._path = path
        self._incomplete_line, self._lines = b"", deque[str]()
        self._is_too_long = False
        self._unfit_file = 0
        with name_file_in_errors(path, "name a text file"):
            self._file = open_regular_file(path)

    def _receive(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while not (block := self._read()) and (remaining := end - time.monotonic()) > 0.0:
            time.sleep(min(_FILE_POLL_SECONDS, remaining))
        if b"\0" in block and not self._columns:
            raise InputError(f"{self.name}: is no text: only text files are followed; leave --follow out")
        # lone carriage returns end lines, too; the last line may be incomplete
        *lines, self._incomplete_line = re.split(rb"\r\n|\r|\n", self._incomplete_line + block)
        if len(self._incomplete_line) > MAX_LINE_BYTES:
            self._incomplete_line, self._is_too_long = b"", True
        if lines and self._is_too_long:
            self._is_too_long = False
            self._count(MALFORMED, f"the last: a line of more than {MAX_LINE_BYTES / 1e6:.0f} MB; there should be one a row")
            lines = lines[1:]
        texts = (line.decode("utf-8-sig", errors="replace") for line in lines)
        self._lines += filter(has_cells, texts)
        self._parse_lines(self._lines)

    def _read(self) -> bytes:
        block = self._file.read(_READ_BYTES)
        if not block:
            try:
                current = self._path.stat()
            except OSError:
                return b""
            opened = os.fstat(self._file.fileno())
            is_cut_off = current.st_size < self._file.tell()
            if (current.st_ino != opened.st_ino or is_cut_off) and current.st_ino != self._unfit_file:
                # cut off, or replaced by another file, which may have vanished again
                try:
                    file = open_regular_file(self._path)
                except FileNotFoundError:
                    return b""
                except (OSError, InputError) as error:
                    self._unfit_file = current.st_ino
                    self._count(OTHER_FILES, f"{self.name}: {error}")
                    return b""
                self._file.close()
                self._file, self._incomplete_line, self._format = file, b"", None
                block = self._file.read(_READ_BYTES)
        return block

    def close(self) -> None:
        self._file.close()


class Datagrams(Source):
    """Rows in UDP datagrams: lines of text, or binary numbers (float64, little-endian), one row after the other.

    Args:
        address: `udp://HOST:PORT` to listen at.
        fields: names of the columns of rows without a header.

    Raises:
        InputError: there is no such address, or nothing can be received there.
    """

    def __init__(self, address: str, fields: Sequence[ColumnName]):
        # numbered columns may be any of more
        numbers = [field for field in fields if isinstance(field, int)]
        super().__init__(address, fields, range(max(*numbers, len(fields) - 1) + 1) if numbers else fields)
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
        self._received_bytes = self._taken_bytes = 0
        self._receiver = threading.Thread(target=self._buffer, name="jaxbl-datagrams", daemon=True)
        self._receiver.start()

    def _buffer(self) -> None:
        self._socket.settimeout(_SOCKET_TIMEOUT)
        while not self._closing.is_set():
            # nothing has come, or an error that concerns a single datagram
            with suppress(OSError):
                datagram = self._socket.recv(1 << 16)
                if self._received_bytes - self._taken_bytes > _WAITING_BYTES:
                    self.counts[TOO_FAST] += 1
                    continue
                self._received_bytes += len(datagram)
                self._received.append(datagram)

    def _receive(self, seconds: float) -> None:
        if len(self._received) < _BATCH_ROWS:
            time.sleep(seconds)
        for datagram in [self._received.popleft() for _ in range(min(len(self._received), _BATCH_ROWS))]:
            self._taken_bytes += len(datagram)
            row_bytes = 8 * len(self._columns)
            if not datagram.translate(None, _TEXT_BYTES):
                self._parse_lines(deque(filter(has_cells, datagram.decode().splitlines())))
            elif len(datagram) % row_bytes:
                text = f"{len(datagram)} bytes; rows of {len(self._columns)} float64 have a multiple of {row_bytes}"
                self._count(MALFORMED, f"the last: {text}")
            else:
                self._add_rows(np.frombuffer(datagram, "<f8").reshape(-1, len(self._columns)).tolist())

    def _set_format(self, text_format: TextFormat, line: str) -> TextFormat:
        width, is_numbered = len(self._columns), isinstance(self._columns, range)
        if text_format.names is not None:
            missing = [field for field in self._needed if field not in text_format.names]
            if missing:
                raise InputError(f"no column {missing[0]!r} in {line!r}")
        elif text_format.count < width or (text_format.count > width and not is_numbered):
            names = "" if is_numbered else f": {', '.join(map(str, self._columns))}"
            raise InputError(f"{text_format.count} cells in {line!r}; there should be {width}{names}")
        return super()._set_format(text_format, line)

    def close(self) -> None:
        self._closing.set()
        self._receiver.join()
        self._socket.close()


def _parse_address(address: str) -> tuple[str, int]:
    # for a port that is no number, or an unfinished address
    with suppress(ValueError):
        parts = urlsplit(address)
        host, port = parts.hostname, parts.port
        if parts.scheme == "udp" and host and port is not None and not (parts.path.strip("/") or parts.query):
            return host, port
    raise InputError(f"{address}: should be udp://HOST:PORT, as udp://127.0.0.1:9870")
