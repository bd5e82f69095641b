"""Logs that need a library of the extra `logs`: MDF4, TDMS, MCAP, ROS bags. Only columns that are asked for are loaded."""

# the libraries are optional, and have no annotations
# pyright: reportMissingImports=false

import json
from array import array
from collections.abc import Callable, Collection, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxbl.errors import InputError


class Columns(dict[str | int, Any]):
    """Columns of a file by name: arrays or :class:`Column`.

    Attributes:
        units: those that the file itself says, by column; `jaxbl inspect --write` puts them into `[log]`.
        notes: remarks on how it was read, in sentences.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.units: dict[str | int, str] = {}
        self.notes: list[str] = []


class Column:
    """Values of a column that are loaded as they are asked for.

    Attributes:
        load: called without arguments, gives them, shape (rows,).
        rows: how many there are.
    """

    def __init__(self, load: Callable[[], Any], rows: int):
        self.load, self.rows = load, rows

    def __len__(self) -> int:
        return self.rows

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return np.asarray(self.load(), dtype=dtype)


def _import_library(name: str, kind: str, package: str = "") -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise InputError(f"is {kind}, which needs the package {package or name}: pip install 'jaxbl[logs]'") from None


def read_tdms(path: Path) -> dict[str | int, Any]:
    """Channels of a TDMS file by name, by `group/channel` where a name occurs twice; `t` from their increment, s."""
    library = _import_library("nptdms", "TDMS")
    channels = [channel for group in library.TdmsFile.read_metadata(path).groups() for channel in group.channels()]
    names = [channel.name for channel in channels]

    def loaded(group: str, name: str) -> np.ndarray:
        with library.TdmsFile.open(path) as file:
            return file[group][name][:]

    found: dict[str | int, Any] = {}
    for channel in channels:
        name = channel.name if names.count(channel.name) == 1 else f"{channel.group_name}/{channel.name}"
        found[name] = Column(lambda one=channel: loaded(one.group_name, one.name), len(channel))
    timed = next((one.properties | {"rows": len(one)} for one in channels if "wf_increment" in one.properties), None)
    if timed is not None and "t" not in found:
        start, step, rows = timed.get("wf_start_offset", 0.0), timed["wf_increment"], timed["rows"]
        found["t"] = Column(lambda: start + step * np.arange(rows), rows)
    return found


def read_mdf(path: Path) -> dict[str | int, Any]:
    """Channels of an MDF file by name; `t` are the times of the group with the most samples, s.

    Channels of other groups, with times of their own, are interpolated to these.
    """
    file = _import_library("asammdf", "MDF").MDF(path)
    groups = range(len(file.groups))
    longest = max(groups, key=lambda i: file.groups[i].channel_group.cycles_nr)
    times = np.asarray(file.get_master(longest))

    def loaded(name: str, group: int, index: int) -> np.ndarray:
        signal = file.get(name, group=group, index=index)
        same = group == longest or np.array_equal(signal.timestamps, times)
        return signal.samples if same else np.interp(times, signal.timestamps, np.asarray(signal.samples, dtype=float))

    found: dict[str | int, Any] = {"t": Column(lambda: times, len(times))}
    for name, places in file.channels_db.items():
        group, index = max(places, key=lambda place: file.groups[place[0]].channel_group.cycles_nr)
        if index != file.masters_db.get(group) and name != "t":
            found[name] = Column(lambda name=name, group=group, index=index: loaded(name, group, index), len(times))
    return found


_MAX_LIST_LENGTH = 64
"""Entries of a list in a message that become columns: robots have fewer joints, and pictures more bytes."""


class _Recording(NamedTuple):
    """Messages of a recording.

    Attributes:
        counts: topic -> how many.
        messages: of some topics, in the order of time: topic, time of recording in ns, the message decoded.
    """

    counts: dict[str, int]
    messages: Callable[[Collection[str]], Iterator[tuple[str, int, Any]]]


def read_mcap(path: Path, wanted: Collection[str | int] = ()) -> Columns:
    """As :func:`read_bag`, of an MCAP file whose messages are JSON or ROS 2's."""
    library = _import_library("mcap.reader", "MCAP", "mcap")
    with path.open("rb") as file:
        summary = library.make_reader(file).get_summary()
    if summary is None or summary.statistics is None:
        raise InputError("has no summary at its end: it was not closed; 'mcap recover' mends it")
    types: dict[int, Any] = {}
    counts, other = {}, set()
    for number, channel in summary.channels.items():
        schema = summary.schemas.get(channel.schema_id)
        if channel.message_encoding == "json" or (channel.message_encoding == "cdr" and schema is not None):
            counts[channel.topic] = counts.get(channel.topic, 0) + summary.statistics.channel_message_counts.get(number, 0)
        else:
            other.add(f"{channel.topic} ({channel.message_encoding})")

    def messages(topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        with path.open("rb") as file:
            for schema, channel, message in library.make_reader(file).iter_messages(topics=list(topics)):
                if channel.message_encoding == "json":
                    yield channel.topic, message.log_time, json.loads(message.data)
                else:
                    if schema.id not in types:
                        types[schema.id] = _message_types(schema)
                    yield channel.topic, message.log_time, types[schema.id].deserialize_cdr(message.data, schema.name)

    found = _recording_columns(_Recording(counts, messages), wanted)
    if other:
        found.notes.append(f"Messages that are neither JSON nor ROS 2's are not read: {', '.join(sorted(other))}.")
    return found


def _message_types(schema: Any) -> Any:
    """What decodes messages of a schema that a file holds."""
    library = _import_library("rosbags.typesys", "MCAP with messages of ROS 2", "rosbags")
    store = library.get_typestore(library.Stores.EMPTY)
    text = schema.data.decode()
    store.register(
        library.get_types_from_msg(text, schema.name) if schema.encoding == "ros2msg" else library.get_types_from_idl(text)
    )
    return store


def read_bag(path: Path, wanted: Collection[str | int] = ()) -> Columns:
    """Numbers in the messages of a ROS bag by topic and field, as `/joint_states.position[0]`; `t` are their times, s.

    These are the stamps of the messages' headers where they have them, else the times of recording. Of topics that hold
    `wanted` columns the one with the most messages gives the times; others are interpolated to them.
    """
    library = _import_library("rosbags.highlevel", "a ROS bag", "rosbags")
    with library.AnyReader([path]) as reader:
        counts: dict[str, int] = {}
        for one in reader.connections:
            counts[one.topic] = counts.get(one.topic, 0) + one.msgcount

    def messages(topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        with library.AnyReader([path]) as reader:
            asked = [one for one in reader.connections if one.topic in topics]
            for connection, time, data in reader.messages(connections=asked):
                yield connection.topic, time, reader.deserialize(data, connection.msgtype)

    return _recording_columns(_Recording(counts, messages), wanted)


def _recording_columns(source: _Recording, wanted: Collection[str | int]) -> Columns:
    """Columns of a recording, loaded as they are asked for: all that are wanted of a topic at once."""
    fields: dict[str, dict[str, list[str | int]]] = {}
    for topic, count in source.counts.items():
        first = next(source.messages([topic]), None) if count else None
        if first is not None:
            fields[topic] = dict(_find_numbers(first[2], []))
    places = {f"{topic}.{name}": (topic, name) for topic, names in fields.items() for name in names}
    if not places:
        raise InputError("holds no messages with numbers; a log needs them")
    asked = {places[name][0] for name in wanted if name in places} or set(fields)
    main = max((topic for topic in asked if fields[topic]), key=lambda topic: source.counts[topic])
    loaded: dict[str, np.ndarray] = {}
    times: dict[str, np.ndarray] = {}
    found = Columns()

    def load(topic: str, name: str) -> np.ndarray:
        if name not in loaded:
            names = [one for one, place in places.items() if place[0] == topic and (one in wanted or one == name)]
            paths = [fields[topic][places[one][1]] for one in names]
            stamps, recorded, rows = array("q"), array("q"), array("d")
            for _, time, message in source.messages([topic]):
                stamps.append(_header_time(message))
                recorded.append(time)
                rows.extend(float(_number_at(message, path)) for path in paths)
            # a clock may begin at 0; headers that are not filled in are all 0
            filled = len(stamps) > 1 and all(stamps[1:])
            times[topic] = np.frombuffer(stamps if filled else recorded, dtype=np.int64)
            values = np.frombuffer(rows, dtype=float).reshape(-1, len(names)) if names else np.empty((len(stamps), 0))
            loaded.update(dict(zip(names, values.T, strict=True)))
        return loaded.get(name, np.empty(0))

    def seconds(topic: str) -> np.ndarray:
        for one in (main, topic):
            if one not in times:
                load(one, "")
        return 1e-9 * (times[topic] - times[main][0])

    def column(topic: str, name: str) -> np.ndarray:
        values = load(topic, name)
        return values if topic == main else np.interp(seconds(main), seconds(topic), values)

    count = source.counts[main]
    found["t"] = Column(lambda: seconds(main), count)
    for name, (topic, _) in places.items():
        found[name] = Column(lambda topic=topic, name=name: column(topic, name), count)
    apart = sorted({places[name][0] for name in wanted if name in places} - {main})
    if apart:
        found.notes.append(f"{', '.join(apart)} is interpolated to the times of {main}, of which there are most.")
    return found


def _find_numbers(message: Any, path: list[str | int]) -> Iterator[tuple[str, list[str | int]]]:
    """Names of all numbers in a message, as `pose.position.x` or `position[0]`, and the way to each."""
    if isinstance(message, bool | int | float | np.number):
        yield "".join(f"[{one}]" if isinstance(one, int) else f".{one}" for one in path).lstrip("."), path
    elif isinstance(message, list | tuple | np.ndarray):
        for i in range(len(message) if len(message) <= _MAX_LIST_LENGTH else 0):
            yield from _find_numbers(message[i], [*path, i])
    elif not isinstance(message, str | bytes) and message is not None:
        fields = message if isinstance(message, dict) else vars(message)
        for name in fields:
            if not name.startswith("__"):
                yield from _find_numbers(fields[name], [*path, name])


def _number_at(message: Any, path: list[str | int]) -> Any:
    """A number in a message; nan where it has none."""
    try:
        for one in path:
            message = message[one] if isinstance(one, int) or isinstance(message, dict) else getattr(message, one)
    except (IndexError, KeyError, AttributeError):
        return np.nan
    return message


def _header_time(message: Any) -> int:
    """Time in the header of a message, ns; 0 where it has none."""
    seconds = _number_at(message, ["header", "stamp", "sec"])
    rest = _number_at(message, ["header", "stamp", "nanosec"])
    return 0 if np.isnan(seconds) else int(seconds) * 1_000_000_000 + (0 if np.isnan(rest) else int(rest))
