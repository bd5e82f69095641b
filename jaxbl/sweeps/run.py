"""Computes the chunks of a study that are not stored yet."""

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxbl.errors import InputError
from jaxbl.files import FolderInUse, lock_folder
from jaxbl.workers import Progress

from .engine import Chunk, Engine
from .refine import refine_boundary
from .store import Store, claim_study

_PREPARATION_SECONDS = 60.0
"""Longest wait for another process that prepares the folder."""


@contextmanager
def join_store(folder: Path, engine: Engine) -> Iterator[Store]:
    """Open the store of a study whose parts several processes write; the first of them creates it.

    Raises as :meth:`Store.create`.
    """
    while True:
        # where another process prepares the folder, this one waits
        with suppress(FolderInUse), lock_folder(folder):
            Store.create(folder, engine)
        with lock_folder(folder, shared=True, wait=_PREPARATION_SECONDS):
            # without the entry, the process that prepared the folder has been ended
            if "sweep" in claim_study(folder, engine.config).entries:
                store = Store.open(folder)
                store.set_layout_of(engine)
                yield store
                return


class MemoryStore(dict[int, pd.DataFrame]):
    """Rows of chunks by index, in place of a :class:`jaxbl.sweeps.store.Store`, for a study without a folder."""

    write_part = dict.__setitem__

    def read_part(self, index: int, columns: Sequence[str]) -> pd.DataFrame | None:
        """Return the rows of a chunk, with all columns; None if it is not computed."""
        return self.get(index)

    def set_totals(self, *totals: int, final: bool = False) -> None:
        """Do nothing: no other process reads them."""

    def frame(self) -> pd.DataFrame:
        """Return all rows."""
        return pd.concat([self[index] for index in sorted(self)], ignore_index=True)


class StudyRun:
    """Computes the chunks of a study that are not stored, one after the other.

    Args:
        engine: computes a chunk.
        store: stores the chunks, a :class:`jaxbl.sweeps.store.Store` or a :class:`MemoryStore`.
        progress: called with finished and total lanes.
    """

    def __init__(self, engine: Engine, store: Any, progress: Progress | None = None):
        self.engine, self.store, self.progress = engine, store, progress
        self._done = self._next = 0
        self._chunks, self._total = len(engine), engine.rows

    def compute_share(self, indices: Sequence[int]) -> None:
        """Compute the chunks with some indices, in their order; the progress is of these."""
        self._total = sum(self.engine.chunk(index).lanes for index in indices)
        self.compute_missing(map(self.engine.chunk, indices))

    def compute_all(self) -> None:
        """Compute the whole study."""
        if self.engine.points.refinement is None:
            self.compute_missing(map(self.engine.chunk, self.engine.chunk_order()))
            return
        for group in range(len(self.engine.points.groups)):
            self._refine(group)
        self.store.set_totals(self._chunks, self._total, final=True)

    def mark_finished(self) -> None:
        """Write into the manifest that all parts are stored."""
        cost = self.engine.cost
        if cost["lanes"] or not self.store.manifest["finished"]:
            seconds = {"compile": cost["compile_seconds"], "run": cost["run_seconds"]}
            self.store.update_manifest(finished=True, seconds=seconds)

    def _refine(self, group: int) -> None:
        """Compute the coarse grid of a group, and the points that refine its boundaries."""
        assert self.engine.points.refinement is not None
        _, grid, criterion = self.engine.points.refinement
        columns, sweep = list(criterion.columns), self.engine.config.sweep
        counted = self.engine.points.coarse_size

        def evaluate(points: np.ndarray) -> np.ndarray:
            nonlocal counted
            # the totals count the coarse grid from the start
            self._total += (len(points) - counted) * sweep.seeds
            self._chunks += self.engine.count_chunks(len(points)) - self.engine.count_chunks(counted)
            counted = 0
            self.store.set_totals(self._chunks, self._total)
            chunks = self.engine.split_points(group, points, self._next)
            self._next += len(chunks)
            self.compute_missing(chunks)
            values = np.empty((len(points), sweep.seeds, len(columns)))
            for chunk in chunks:
                frame = self._read_chunk(chunk, *columns)
                if frame is None:
                    raise InputError(
                        f"{self.store.part_path(chunk.index)}: was changed by another process; run the same command again"
                    )
                metrics = frame[columns].to_numpy(float).reshape(*chunk.shape, len(columns))
                lanes = np.ix_(np.searchsorted(points, chunk.points), np.subtract(chunk.seeds, sweep.first_seed))
                values[lanes] = metrics.swapaxes(0, 1)
            return values

        refine_boundary(grid, evaluate, criterion.disagree)

    def compute_missing(self, chunks: Iterable[Chunk]) -> None:
        """Compute the chunks that are not stored; each is written while the next one is computed.

        If an interrupt ends this, the chunks that were computed are written first.
        """
        computed: tuple[Chunk, Future[None]] | None = None
        with ThreadPoolExecutor(1) as writer:
            for chunk in self.missing_chunks(chunks):
                frame = self.engine.run(chunk)
                before, computed = computed, (chunk, writer.submit(self.store.write_part, chunk.index, frame))
                # frames are large: at most one waits to be written
                self._await_part(before)
            self._await_part(computed)

    def _await_part(self, computed: tuple[Chunk, Future[None]] | None) -> None:
        """Wait until the part of a chunk is written, and count the chunk."""
        if computed is not None:
            chunk, end = computed
            end.result()
            self.count_chunk(chunk)

    def missing_chunks(self, chunks: Iterable[Chunk]) -> Iterator[Chunk]:
        """Yield the chunks that are not stored, and count the others as done."""
        for chunk in chunks:
            if self._read_chunk(chunk) is None:
                yield chunk
            else:
                self.count_chunk(chunk)

    def _read_chunk(self, chunk: Chunk, *columns: str) -> pd.DataFrame | None:
        """Read columns of a chunk; None if it is not stored, or if the part of a refined study has other points."""
        labels = {} if self.engine.points.refinement is None else self.engine.row_labels(chunk)
        frame = self.store.read_part(chunk.index, (*labels, *columns))
        if frame is None or any(not np.array_equal(frame[name].to_numpy(), column) for name, column in labels.items()):
            return None
        return frame

    def count_chunk(self, chunk: Chunk) -> None:
        """Count the lanes of a chunk as done, and report progress."""
        self._done += chunk.lanes
        if self.progress:
            self.progress(self._done, self._total)
