"""How far a study is, by the parts that exist."""

import dataclasses
from pathlib import Path

import numpy as np

from jaxbl.files import list_paths, lock_holder, to_path

from .store import Store

_RECENT = 600.0
"""Seconds before the last part whose parts say how fast it goes."""


@dataclasses.dataclass(frozen=True)
class Status:
    """How far a study is.

    Attributes:
        folder: of the study; its `title`.
        parts: that exist, of `parts_in_all`, of which a refined study knows its last only at the end.
        runs: in all of them.
        finished: whether a command has seen that all are there.
        damaged: files that were kept aside.
        held_by: process that writes into the folder, its host and since when; one of them where several do.
        parts_per_second: rate of the last ten minutes that had parts; 0 where fewer than two say.
    """

    folder: Path
    title: str
    parts: int
    parts_in_all: int
    runs: int
    finished: bool
    damaged: int
    held_by: str
    parts_per_second: float

    @property
    def complete(self) -> bool:
        """Whether all parts exist."""
        return self.parts >= self.parts_in_all

    @property
    def remaining(self) -> float | None:
        """Seconds that the missing parts take at this rate, if they are computed now; None where that is not known."""
        if self.complete:
            return 0.0
        return (self.parts_in_all - self.parts) / self.parts_per_second if self.parts_per_second else None


def status(folder: str | Path) -> Status:
    """How far the study in a folder is. Raises `InputError` where there is none."""
    folder = to_path(folder)
    store = Store.open(folder)
    times = np.sort([path.stat().st_mtime for path in store.list_part_files()])
    recent = times[times > times[-1] - _RECENT] if len(times) else times
    span = recent[-1] - recent[0] if len(recent) > 1 else 0.0
    return Status(
        folder=folder,
        title=store.manifest["title"] or "untitled",
        parts=len(times),
        parts_in_all=store.manifest["parts"],
        runs=store.manifest["rows"],
        finished=store.manifest["finished"],
        damaged=len(list_paths(folder / "damaged", "*")),
        held_by=lock_holder(folder),
        parts_per_second=float((len(recent) - 1) / span) if span > 0.0 else 0.0,
    )


def list_statuses(folder: str | Path) -> list[Status]:
    """How far the study in a folder is, and those that `verify` and `tune` run for it. Raises `InputError` where there is
    none."""
    folder = to_path(folder)
    found = (list_paths(folder, f"{command}/*/manifest.json") for command in ("verify", "tune"))
    stages = [path.parent for paths in found for path in paths]
    own = [folder] if (folder / "manifest.json").exists() or not stages else []
    return [status(one) for one in [*own, *stages]]
