"""Logs that need a library of the extra `logs`: MDF4 and TDMS. Only columns that are asked for are loaded."""

# the libraries are optional, and have no annotations
# pyright: reportMissingImports=false

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from jaxbl.errors import InputError


class Column:
    """Values of a column that are loaded as they are asked for.

    Attributes:
        load: gives them, shape (rows,).
        rows: how many there are.
    """

    def __init__(self, load: Callable[[], Any], rows: int):
        self.load, self.rows = load, rows

    def __len__(self) -> int:
        return self.rows

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return np.asarray(self.load(), dtype=dtype)


def _library(name: str, kind: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise InputError(f"is {kind}, which needs the package {name}: pip install 'jaxbl[logs]'") from None


def read_tdms(path: Path) -> dict[str | int, Any]:
    """Channels of a TDMS file by name, by `group/channel` where a name occurs twice; `t` from their increment, s."""
    library = _library("nptdms", "TDMS")
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
    file = _library("asammdf", "MDF").MDF(path)
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
