"""Progress of a study, by the parts that are stored."""

import dataclasses
from pathlib import Path

import numpy as np

from jaxbl.files import MANIFEST, list_paths, lock_holder, to_path

from .store import Store

_RATE_SECONDS = 600.0
"""Time before the last part over which the rate is measured."""


@dataclasses.dataclass(frozen=True)
class Status:
    """Progress of a study.

    Attributes:
        folder: folder of the study.
        title: title of the study.
        parts: number of stored parts.
        parts_in_all: number of parts that the study will have; it grows while a refined study runs.
        runs: number of runs of all these parts.
        finished: True if a command has checked that all parts are stored.
        damaged: number of damaged files in `damaged/`.
        held_by: a process that writes into the folder, with its host and start; empty if there is none.
        parts_per_second: rate over ten minutes before the last part; 0 with fewer than two parts.
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
        """True if all parts are stored."""
        return self.parts >= self.parts_in_all

    @property
    def remaining_seconds(self) -> float | None:
        """Seconds that the missing parts take at this rate; None if the rate is not known."""
        if self.complete:
            return 0.0
        return (self.parts_in_all - self.parts) / self.parts_per_second if self.parts_per_second else None


def status(folder: str | Path) -> Status:
    """Return the progress of the study in a folder. Raises `InputError` if there is none."""
    folder = to_path(folder)
    store = Store.open(folder)
    times = np.array([path.stat().st_mtime for path in store.list_part_files()])
    recent = times[times > times.max(initial=0.0) - _RATE_SECONDS]
    span = float(np.ptp(recent)) if len(recent) else 0.0
    return Status(
        folder=folder,
        title=store.manifest["title"] or "untitled",
        parts=len(times),
        parts_in_all=store.manifest["parts"],
        runs=store.manifest["rows"],
        finished=store.manifest["finished"],
        damaged=len(list_paths(folder / "damaged", "*")),
        held_by=lock_holder(folder),
        parts_per_second=(len(recent) - 1) / span if span else 0.0,
    )


def list_statuses(folder: str | Path) -> list[Status]:
    """Return the progress of the study in a folder, and of the stages that `verify` and `tune` run for it. Raises
    `InputError` if the folder holds no study."""
    folder = to_path(folder)
    studies = [path.parent for command in ("verify", "tune") for path in list_paths(folder, f"{command}/*/{MANIFEST}")]
    # the folder of verify or tune has no points of its own
    if (folder / "points").exists() or not studies:
        studies.insert(0, folder)
    return [status(study) for study in studies]
