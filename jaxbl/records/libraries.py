"""Logs that need a library of the extra `logs`: MDF4, TDMS, MCAP, ROS bags. A column is loaded when it is used."""

# the libraries are optional, and have no annotations
# pyright: reportMissingImports=false

import json
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxbl.errors import InputError

ColumnName = str | int
"""Name of a column, or its number, counted from 0."""
Selection = Collection[ColumnName]
"""Columns that will be used."""


class Columns(dict[ColumnName, Any]):
    """Columns of a file by name: arrays or :class:`Column`.

    Attributes:
        units: units that the file itself gives, by column; `jaxbl inspect --write` puts them into `[log]`.
        notes: remarks on how it was read, in sentences.
        unread: reason -> names of what was not read for it.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.units: dict[ColumnName, str] = {}
        self.notes: list[str] = []
        self.unread = defaultdict[str, list[str]](list)

    def describe_unread(self) -> list[str]:
        """Return a sentence on each kind of what was not read."""
        return [f"Not read: {', '.join(names[:20])}: {reason}." for reason, names in self.unread.items() if names]


@dataclass
class Column:
    """Values of a column that are loaded when they are used.

    Attributes:
        load: function without arguments that returns the values, shape (rows,).
        rows: number of values.
    """

    load: Callable[[], Any]
    rows: int

    def __len__(self) -> int:
        return self.rows

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return np.asarray(self.load(), dtype=dtype)


def read_at(times: np.ndarray, own_times: np.ndarray, values: Any) -> np.ndarray:
    """Return values at the times of a log, interpolated from times of their own; NaN, no value, outside of these."""
    if np.array_equal(own_times, times, equal_nan=True):
        return np.asarray(values)
    values = np.asarray(values, float)
    is_finite = np.isfinite(own_times) & np.isfinite(values)
    return np.interp(times, own_times[is_finite], values[is_finite], left=np.nan, right=np.nan)


def _import_library(name: str, kind: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise InputError(f"is {kind}, which needs the package {name.split('.')[0]}: pip install 'jaxbl[logs]'") from None


def read_tdms(path: Path, _: Selection) -> Columns:
    """Read channels of a TDMS file by name, by `group/channel` if a name occurs twice; `t` from their increment, s."""
    library = _import_library("nptdms", "TDMS")
    channels = [channel for group in library.TdmsFile.read_metadata(path).groups() for channel in group.channels()]
    names = [channel.name for channel in channels]

    def load_channel(group: str, name: str) -> np.ndarray:
        with library.TdmsFile.open(path) as file:
            return file[group][name][:]

    columns = Columns()
    for channel in channels:
        name = channel.name if names.count(channel.name) == 1 else f"{channel.group_name}/{channel.name}"
        columns[name] = Column(partial(load_channel, channel.group_name, channel.name), len(channel))
    timed_channel = next((channel for channel in channels if "wf_increment" in channel.properties), None)
    if timed_channel is not None and "t" not in columns:
        properties, rows = timed_channel.properties, len(timed_channel)
        start, step = properties.get("wf_start_offset", 0.0), properties["wf_increment"]
        columns["t"] = Column(lambda: start + step * np.arange(rows), rows)
    return columns


def read_mdf(path: Path, _: Selection) -> Columns:
    """Read channels of an MDF file by name; `t` are the times of the group with the most samples, s.

    Channels of other groups, which have their own times, are interpolated to these.
    """
    file = _import_library("asammdf", "MDF").MDF(path)
    groups = range(len(file.groups))
    longest = max(groups, key=lambda i: file.groups[i].channel_group.cycles_nr)
    times = np.asarray(file.get_master(longest))

    def load_channel(name: str, group: int, index: int) -> np.ndarray:
        signal = file.get(name, group=group, index=index)
        return read_at(times, signal.timestamps, signal.samples)

    columns = Columns(t=Column(lambda: times, len(times)))
    for name, places in file.channels_db.items():
        group, index = max(places, key=lambda place: file.groups[place[0]].channel_group.cycles_nr)
        if index != file.masters_db.get(group) and name != "t":
            columns[name] = Column(partial(load_channel, name, group, index), len(times))
    return columns


_MAX_LIST_LENGTH = 64
"""Elements of a list in a message that become columns: robots have fewer joints, and pictures more bytes."""

_FIRST_MESSAGES = 100
"""Messages of a topic whose names are listed before any of it is selected: several publishers may write to it."""


_Messages = Iterator[tuple[int, Any]]
"""Messages of a topic in the order of time: time of recording in ns, the decoded message."""


def name_members(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Make an object of JSON of its members. Raises InputError where two have one name."""
    members = dict[str, Any]()
    for name, value in pairs:
        if name in members:
            raise InputError(f"two members of an object are called '{name}'; names should differ")
        members[name] = value
    return members


def read_mcap(path: Path, selection: Selection) -> Columns:
    """Read an MCAP file with messages in JSON or of ROS 2; columns are those of :func:`read_bag`."""
    library = _import_library("mcap.reader", "MCAP")
    with path.open("rb") as file:
        summary = library.make_reader(file, validate_crcs=True).get_summary()
    if summary is None or summary.statistics is None:
        raise InputError("has no summary at its end: it was not closed; 'mcap recover' mends it")
    types: dict[int, Any] = {}
    counts, other_topics = Counter[str](), list[str]()
    for number, channel in summary.channels.items():
        schema = summary.schemas.get(channel.schema_id)
        if channel.message_encoding == "json" or (channel.message_encoding == "cdr" and schema is not None):
            counts[channel.topic] += summary.statistics.channel_message_counts.get(number, 0)
        else:
            other_topics.append(f"{channel.topic} ({channel.message_encoding})")

    def iterate_messages(topic: str) -> _Messages:
        with path.open("rb") as file:
            for schema, channel, message in library.make_reader(file, validate_crcs=True).iter_messages(topics=[topic]):
                if channel.message_encoding == "json":
                    yield message.log_time, json.loads(message.data, object_pairs_hook=name_members)
                else:
                    if schema.id not in types:
                        types[schema.id] = _message_types(schema)
                    yield message.log_time, types[schema.id].deserialize_cdr(message.data, schema.name)

    columns = _recording_columns(counts, iterate_messages, selection)
    columns.unread["messages in other formats than JSON and ROS 2"] = other_topics
    return columns


def _message_types(schema: Any) -> Any:
    """Return the type store that decodes the messages of a schema."""
    library = _import_library("rosbags.typesys", "MCAP with messages of ROS 2")
    store = library.get_typestore(library.Stores.EMPTY)
    text = schema.data.decode()
    store.register(
        library.get_types_from_msg(text, schema.name) if schema.encoding == "ros2msg" else library.get_types_from_idl(text)
    )
    return store


def read_bag(path: Path, selection: Selection) -> Columns:
    """Read numbers in the messages of a ROS bag by topic and field, as `/joint_states.position[arm]`; `t` is their time, s.

    A time is the stamp in the message's header, or the time of recording if there is none. Among the topics of the
    `selection` the one with the most messages gives the times; the others are interpolated to them.
    """
    library = _import_library("rosbags.highlevel", "a ROS bag")
    with library.AnyReader([path]) as reader:
        counts = Counter[str]()
        for connection in reader.connections:
            counts[connection.topic] += connection.msgcount

    def iterate_messages(topic: str) -> _Messages:
        with library.AnyReader([path]) as reader:
            connections = [connection for connection in reader.connections if connection.topic == topic]
            for connection, time, message in reader.messages(connections=connections):
                yield time, reader.deserialize(message, connection.msgtype)

    return _recording_columns(counts, iterate_messages, selection)


def _recording_columns(
    counts: dict[str, int], iterate_messages: Callable[[str], _Messages], selection: Selection
) -> Columns:
    """Return the columns of a recording. All messages of the selected topics are read, of others the first ones.

    `counts` are the numbers of messages by topic; `iterate_messages` yields the messages of a topic.
    """
    loaded_values: dict[ColumnName, np.ndarray] = {}
    times: dict[str, np.ndarray] = {}

    def load_topic(topic: str, names: list[ColumnName]) -> dict[str, None]:
        """Load the times and some columns of a topic; return the names of all its columns."""
        stamps, recording_times, rows, field_names = array("q"), array("q"), array("d"), dict[str, None]()
        for time, message in iterate_messages(topic):
            numbers = dict(_find_numbers(message, topic, {}))
            field_names |= dict.fromkeys(numbers)
            stamps.append(_find_stamp(message))
            recording_times.append(time)
            rows.extend(float(numbers.get(str(name), np.nan)) for name in names)
        # a clock may begin at 0; headers that are not filled in are all 0
        has_stamps = len(stamps) > 1 and all(stamps[1:])
        times[topic] = np.frombuffer(stamps if has_stamps else recording_times, dtype=np.int64)
        values = np.frombuffer(rows, dtype=float).reshape(len(stamps), len(names))
        loaded_values.update(zip(names, values.T, strict=True))
        return field_names

    places: dict[str, str] = {}
    selected_topics = list[str]()
    for topic in filter(counts.get, counts):
        names = [name for name in selection if str(name).startswith(f"{topic}.")]
        if names:
            selected_topics.append(topic)
            field_names = load_topic(topic, names)
        else:
            messages = islice(iterate_messages(topic), _FIRST_MESSAGES)
            field_names = [name for _, message in messages for name, _ in _find_numbers(message, topic, {})]
        places |= dict.fromkeys(field_names, topic)
    if not places:
        raise InputError("holds no messages with numbers; a log needs them")
    main = max(selected_topics or places.values(), key=lambda topic: counts[topic])

    def load_seconds(topic: str) -> np.ndarray:
        for needed_topic in {main, topic} - {*times}:
            load_topic(needed_topic, [])
        return 1e-9 * (times[topic] - times[main][0])

    def load_column(topic: str, name: str) -> np.ndarray:
        if name not in loaded_values:
            load_topic(topic, [name])
        values = loaded_values[name]
        return values if topic == main else read_at(load_seconds(main), load_seconds(topic), values)

    count = counts[main]
    columns = Columns(t=Column(lambda: load_seconds(main), count))
    for name, topic in places.items():
        columns[name] = Column(partial(load_column, topic, name), count)
    if interpolated_topics := sorted({*selected_topics} - {main}):
        columns.notes.append(
            f"{', '.join(interpolated_topics)} is interpolated to the times of {main}, which has the most messages."
        )
    return columns


def _list_members(message: Any) -> dict[str, Any]:
    return message if isinstance(message, dict) else getattr(message, "__dict__", {})


def _find_numbers(message: Any, name: str, labels: dict[int, list[str]]) -> Iterator[tuple[str, Any]]:
    """Yield the numbers in a message by name, as `pose.position.x` or `position[0]`; `position[arm]` beside a list of names.

    `labels` are such lists of what the message is in, by their length.
    """
    if isinstance(message, bool | int | float | np.number):
        yield name, message
    elif isinstance(message, list | tuple | np.ndarray):
        keys = labels.get(len(message), range(len(message)))
        for key, member in zip(keys, message, strict=True) if len(message) <= _MAX_LIST_LENGTH else ():
            yield from _find_numbers(member, f"{name}[{key}]", labels)
    else:
        members = _list_members(message)
        lists = [x for x in members.values() if isinstance(x, list) and {str} == {*map(type, x)} and len({*x}) == len(x)]
        labels = labels | {len(x): x for x in lists}
        for key, member in members.items():
            if not key.startswith("__"):
                yield from _find_numbers(member, f"{name}.{key}", labels)


def _find_stamp(message: Any) -> int:
    """Return the stamp of a message, ns; 0 if it has none."""

    def find_member(message: Any, *names: str) -> Any:
        members = _list_members(message)
        return next((members[name] for name in names if name in members), 0)

    stamp = find_member(find_member(message, "header") or message, "stamp", "timestamp")
    if isinstance(stamp, str):
        return pd.Timestamp(stamp).as_unit("ns").value
    seconds = find_member(stamp, "sec", "secs", "seconds")
    return int(seconds) * 1_000_000_000 + int(find_member(stamp, "nanosec", "nsec", "nsecs", "nanos", "nanoseconds"))
