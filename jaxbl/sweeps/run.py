"""A study's chunks, one after the other or on a cluster, those that are stored already left out."""

import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from jaxbl.errors import InputError
from jaxbl.files import FolderInUse, lock_folder
from jaxbl.workers import Progress

from .engine import Chunk, Engine
from .refine import refine_boundary
from .store import Store, claim_folder

_PREPARED = 60.0
"""Seconds to wait for another process that prepares the folder."""


def open_or_create_store(
    folder: Path, engine: Engine, *, require_backend: bool, overwrite: bool = False
) -> tuple[Engine, Store]:
    """Open the store of an engine's study in a locked folder (:func:`jaxbl.files.lock_folder`), or create it.

    Returns an engine with the store's layout and backend as well: chunks keep the shape that they had when the store was
    created, on any machine.

    Args:
        folder: study's folder, locked by this process.
        engine: engine that this machine would use.
        require_backend: refuse a store of another backend than the engine's.
        overwrite: remove the results of other studies from the folder.

    Raises:
        InputError: the folder holds another study, or a store of another backend.
    """
    config = engine.config
    claim_folder(folder, config, overwrite=overwrite)
    store = Store.create(folder, config, engine.layout, engine.backend, len(engine), engine.rows)
    engine = _engine_for(store, engine, require_backend)
    if engine.points.refinement is not None:
        store.count_parts()
    elif store.manifest["parts"] != len(engine):
        # the manifest was lost, and begun anew for other chunks
        store.update_manifest(parts=len(engine))
    return engine, store


def _engine_for(store: Store, engine: Engine, require_backend: bool) -> Engine:
    if require_backend and store.backend != engine.backend and not store.manifest["finished"]:
        raise InputError(
            f"{store.folder}: was begun with --backend {store.backend}; go on with that, or choose another folder with --out"
        )
    if (store.layout, store.backend) == (engine.layout, engine.backend):
        return engine
    return Engine(engine.config, store.layout, engine.devices, store.backend, require_backend)


@contextmanager
def join_store(folder: Path, engine: Engine, *, require_backend: bool) -> Iterator[tuple[Engine, Store]]:
    """A folder into which other processes may write parts of the same study, begun by whichever is first: the engine for it,
    and its store, which leaves the manifest alone. Raises as :func:`open_or_create_store`."""
    latest = time.monotonic() + _PREPARED
    while True:
        with suppress(FolderInUse), lock_folder(folder):
            open_or_create_store(folder, engine, require_backend=require_backend)
        with ExitStack() as held:
            try:
                held.enter_context(lock_folder(folder, shared=True))
            except FolderInUse:
                # another one prepares it, or has it for itself
                if time.monotonic() > latest:
                    raise
            else:
                claim_folder(folder, engine.config, alone=False)
                store = Store.open(folder, keeps_manifest=False)
                yield _engine_for(store, engine, require_backend), store
                return
        time.sleep(0.1)


class RunTotals(NamedTuple):
    """What was computed: lanes, seconds of compilation and of computing, what the fused loop did not know, damaged parts."""

    lanes: int = 0
    compile_seconds: float = 0.0
    run_seconds: float = 0.0
    fallback_reasons: tuple[str, ...] = ()
    damaged: tuple[str, ...] = ()

    def __add__(self, other: Any) -> "RunTotals":
        sums = (self.lanes + other.lanes, self.compile_seconds + other.compile_seconds, self.run_seconds + other.run_seconds)
        return RunTotals(
            *sums, tuple(dict.fromkeys(self.fallback_reasons + other.fallback_reasons)), self.damaged + other.damaged
        )


class Run:
    """Chunk after chunk of a study.

    Args:
        engine: computes them.
        store: keeps them; left out, memory.
        progress: hears finished and total lanes.
        indices: of the chunks to be computed, in their order; left out, all.

    Attributes:
        elsewhere: what workers have computed.
    """

    def __init__(
        self, engine: Engine, store: Store | None, progress: Progress | None = None, indices: Sequence[int] | None = None
    ):
        self.engine, self.progress = engine, progress
        self.elsewhere = RunTotals()
        self._lanes = 0
        self._store, self._indices = store, indices
        self._frames: dict[int, pd.DataFrame] = {}
        self._done = self._next = 0
        self._chunks, self._total = len(engine), engine.rows

    @property
    def work(self) -> RunTotals:
        """What was computed, here and by workers."""
        engine, damaged = self.engine, () if self._store is None else tuple(self._store.damaged)
        own = RunTotals(self._lanes, engine.compile_seconds, engine.run_seconds, tuple(engine.fallback_reasons), damaged)
        return own + self.elsewhere

    @property
    def kept(self) -> Store:
        """The store."""
        assert self._store is not None
        return self._store

    def frame(self) -> pd.DataFrame:
        """All rows of a run without a store."""
        return pd.concat([self._frames[index] for index in sorted(self._frames)], ignore_index=True)

    def all(self) -> None:
        """Run the whole study, or the chunks that were asked for."""
        if self.engine.points.refinement is None:
            if self._indices is not None:
                self._chunks, self._total = len(self._indices), sum(map(self.engine.count_lanes, self._indices))
            self.ensure(map(self.engine.chunk, self.engine.chunk_order() if self._indices is None else self._indices))
            return
        for group in range(len(self.engine.points.groups)):
            self._refine(group)
        if self._store is not None:
            self._store.set_final_totals(self._chunks, self._total)

    def finish(self) -> None:
        """Say in the manifest that all is there."""
        work = self.work
        if work.lanes or not self.kept.manifest["finished"]:
            self.kept.update_manifest(finished=True, seconds={"compile": work.compile_seconds, "run": work.run_seconds})

    def _refine(self, group: int) -> None:
        """The coarse grid of a group, and what its boundaries need."""
        assert self.engine.points.refinement is not None
        _, grid, criterion = self.engine.points.refinement
        columns, seeds = list(criterion.columns), self.engine.config.sweep.seeds
        expected = self.engine.points.coarse_size

        def evaluate(points: np.ndarray) -> np.ndarray:
            nonlocal expected
            # the coarse grid is counted from the start
            self._total += (len(points) - expected) * seeds
            self._chunks += self.engine.count_chunks(len(points)) - self.engine.count_chunks(expected)
            expected = 0
            if self._store is not None:
                self._store.raise_totals(self._chunks, self._total)
            chunks = self.engine.split_points(group, points, self._next)
            self._next += len(chunks)
            self.ensure(chunks)
            values = np.empty((seeds, len(points), len(columns)))
            row = column = 0
            for chunk in chunks:
                shape = (len(chunk.seeds), len(chunk.points), len(columns))
                found = self._read(chunk, columns)[columns].to_numpy(float).reshape(shape)
                values[row : row + shape[0], column : column + shape[1]] = found
                column += shape[1]
                if column == len(points):
                    row, column = row + shape[0], 0
            return values.swapaxes(0, 1)

        refine_boundary(grid, evaluate, criterion.disagree)

    def ensure(self, chunks: Iterable[Chunk]) -> None:
        """Have chunks computed that are not there; one is written while the next one is computed. What was computed is
        written also where an interrupt ends this."""
        written: tuple[Chunk, Future[str]] | None = None
        with ThreadPoolExecutor(1) as writer:
            for chunk in chunks:
                if self.is_there(chunk):
                    self.count(chunk)
                    continue
                frame = self.engine.run(chunk)
                self._lanes += len(frame)
                if self._store is None:
                    self._frames[chunk.index] = frame
                    self.count(chunk)
                    continue
                before, written = written, (chunk, writer.submit(self._store.write_part, chunk.index, frame))
                # frames are large: one waits at most
                self._keep(before)
            self._keep(written)

    def _keep(self, written: tuple[Chunk, Future[str]] | None) -> None:
        """Count a part that is being written, once it is."""
        if written is not None:
            chunk, checksum = written
            self.kept.add_checksums({chunk.index: checksum.result()})
            self.count(chunk)

    def is_there(self, chunk: Chunk) -> bool:
        """Whether a chunk is stored whole; of a refined study, also whether it has the points that are due."""
        if self._store is None or not self._store.has_part(chunk.index):
            return False
        return self.engine.points.refinement is None or self._stored(chunk, []) is not None

    def _stored(self, chunk: Chunk, columns: list[str]) -> pd.DataFrame | None:
        return self.kept.read_part(chunk.index, self.engine.row_labels(chunk), columns)

    def _read(self, chunk: Chunk, columns: list[str]) -> pd.DataFrame:
        """Some columns of a chunk that is there."""
        if self._store is None:
            return self._frames[chunk.index]
        frame = self._stored(chunk, columns)
        if frame is None:
            raise InputError(
                f"{self._store.part_path(chunk.index)}: was changed by another process; run the same command again"
            )
        return frame

    def count(self, chunk: Chunk) -> None:
        """Say that a chunk is there."""
        self._done += len(chunk.seeds) * len(chunk.points)
        self.tell()

    def tell(self, parts: int = 0) -> None:
        """Tell progress what is done, also by the number of parts that exist."""
        if self.progress:
            there = parts * self._total // max(self._chunks, 1)
            self.progress(min(max(self._done, there), self._total), self._total)
