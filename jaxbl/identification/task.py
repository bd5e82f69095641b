"""A study and logs as one task, for `identify` and `diagnose` alike."""

import dataclasses
import hashlib
import itertools
import json
from collections.abc import Callable
from importlib.metadata import version

import numpy as np

from jaxbl.config import Config
from jaxbl.records import Record
from jaxbl.workers import Progress


@dataclasses.dataclass(frozen=True)
class LogTask:
    """A study and its log, and what is asked of them: everything that decides the result.

    Attributes:
        config: the study.
        missing: tables that the study does not have (`excitation`, `observer.motor`, `observer.load`).
        record: the log that numbers are fitted to.
        holdout: what they are tried out on, or None.
    """

    config: Config
    missing: frozenset[str]
    record: Record
    holdout: Record | None

    @property
    def identity(self) -> str:
        """Hash of everything that decides the result."""
        text = json.dumps([self.config.resolved(), sorted(self.missing), version("jaxbl")], sort_keys=True)
        total = hashlib.sha256(text.encode())
        for record in (self.record, self.holdout):
            if record is not None:
                total.update(str(record.segments).encode())
                for values in (record.time, record.torque, *record.positions.values(), record.transmitted):
                    total.update(b"" if values is None else np.ascontiguousarray(values).tobytes())
        return total.hexdigest()[:16]


def stage_counter(stages: int, progress: Progress | None) -> Callable[[], None]:
    """A function to be called after each stage, which tells `progress` how many of them are finished."""
    finished = itertools.count(1)

    def done() -> None:
        count = next(finished)
        if progress is not None:
            progress(count, stages)

    return done
