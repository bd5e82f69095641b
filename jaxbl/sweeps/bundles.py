"""Computes the chunks of a study on a cluster, in bundles, so that the largest study is some thousands of jobs.

Workers write parts into the study's folder, and leave out the chunks that are stored: a bundle may be computed twice.
"""

import functools
import math
import socket
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from jaxbl.cluster import Cluster
from jaxbl.errors import InputError
from jaxbl.files import MANIFEST, lock_folder, to_path
from jaxbl.workers import Progress

from .engine import Chunk, Engine
from .programs import Backend, Layout
from .run import RunTotals, StudyRun
from .store import Store, load_config

_BUNDLE_SECONDS = 20.0
"""Time of a bundle: a scheduler spends some 1 ms on one, and the bundle that a lost worker has begun is lost."""
_MAX_BUNDLES = 50_000
"""Bundles of a study: a scheduler holds some 6 kB of each, and is slow above 100 000 (Dask's distributed#3691, #3898)."""
_BUNDLES_PER_WORKER = 4
"""Least number of bundles for each worker, so that the workers end together."""
_POLL_SECONDS = 2.0
"""Time between two counts of the stored parts."""
_DELAY_SECONDS = 30.0
"""Time until a file that another machine has written is seen: a network file system remembers that it was not there."""


class Bundle(NamedTuple):
    """Chunks that a worker computes.

    Attributes:
        folder: folder of the study.
        identity: identity of the study in its manifest.
        require_backend: refuse a study that the fused loop cannot run.
        chunks: the chunks.
    """

    folder: str
    identity: str
    require_backend: bool
    chunks: tuple[Chunk, ...]


class ClusterRun(StudyRun):
    """A run whose chunks are computed by a cluster's workers.

    Raises, where a :class:`StudyRun` does not:
        InputError: workers do not see the store's folder, or cannot run the study.
        NoResult: the cluster is lost.
    """

    def __init__(self, cluster: Cluster, engine: Engine, store: Store, progress: Progress | None = None):
        super().__init__(engine, store, progress)
        self._cluster = cluster
        self._next_poll = time.monotonic() + _POLL_SECONDS

    def compute_missing(self, chunks: Iterable[Chunk]) -> None:
        self._compute_bundles(self._compute_first(chunks, max(self._cluster.workers, 1)))

    def submit_missing(self) -> None:
        """Have workers compute all missing chunks, waiting for the first alone."""
        bundles = self._compute_first(map(self.engine.chunk, self.engine.chunk_order()), 1)
        self._cluster.submit_jobs(compute_bundle, list(bundles))

    def _compute_first(self, chunks: Iterable[Chunk], count: int) -> Iterator[Bundle]:
        """Have so many of the missing chunks computed, which shows how long a chunk takes, and bundle the other ones."""
        missing, before = list(self.missing_chunks(chunks)), self.totals.run_seconds
        first, following = missing[:count], missing[count:]
        self._compute_bundles(self._make_bundles(first, 1))
        seconds, workers = (self.totals.run_seconds - before) / count, max(self._cluster.workers, 1)
        return self._make_bundles(following, _bundle_size(seconds, len(following), workers))

    def _make_bundles(self, chunks: Sequence[Chunk], size: int) -> Iterator[Bundle]:
        """Make bundles of `size` chunks each."""
        study = str(self.store.folder.absolute()), self.store.manifest["identity"], self.engine.require_backend
        for first in range(0, len(chunks), size):
            yield Bundle(*study, tuple(chunks[first : first + size]))

    def _compute_bundles(self, bundles: Iterable[Bundle]) -> None:
        """Have workers compute bundles."""
        for _, bundle, (totals, host) in self._cluster.run_jobs(compute_bundle, bundles, self._poll_parts):
            for chunk in bundle.chunks:
                _wait_for_part(self.store.part_path(chunk.index), host)
                self.count_chunk(chunk)
            self.worker_totals += totals

    def _poll_parts(self) -> None:
        """Report progress by the number of stored parts, since a bundle takes long."""
        if time.monotonic() > self._next_poll:
            start = time.monotonic()
            self.report_progress(len(self.store.list_part_files()))
            # a list of 300 000 files takes seconds
            self._next_poll = time.monotonic() + max(_POLL_SECONDS, 10.0 * (time.monotonic() - start))


def _bundle_size(seconds: float, chunks: int, workers: int) -> int:
    """Number of chunks of a bundle, if a chunk takes so many seconds and so many chunks are missing."""
    by_time = int(_BUNDLE_SECONDS / max(seconds, 1e-3))
    by_worker = math.ceil(chunks / (workers * _BUNDLES_PER_WORKER))
    return max(min(by_time, by_worker), math.ceil(chunks / _MAX_BUNDLES), 1)


def _wait_for_part(part: Path, host: str) -> None:
    """Wait until a part that a worker has written is seen here. Raises `InputError` if it is not."""
    deadline = time.monotonic() + _DELAY_SECONDS
    while not part.exists():
        if time.monotonic() > deadline:
            raise InputError(
                f"{part}: was written by worker {host}, and is not seen here; --out should name a folder that all machines "
                "share"
            )
        time.sleep(0.2)


def compute_bundle(bundle: Bundle) -> tuple[RunTotals, str]:
    """Compute the chunks of a bundle that are not stored; called on a worker. Returns totals, and the worker's host."""
    folder, host = to_path(bundle.folder), socket.gethostname()
    if not (folder / MANIFEST).exists():
        raise InputError(f"{folder}: is not seen by worker {host}; --out should name a folder that all machines share")
    with lock_folder(folder, shared=True, wait=_DELAY_SECONDS):
        store = Store.open(folder)
        if store.manifest["identity"] != bundle.identity:
            raise InputError(f"{folder}: holds another study by now; begin again with another --out")
        engine = _cached_engine(bundle.folder, bundle.identity, store.layout, store.backend, bundle.require_backend)
        engine.compile_seconds = engine.run_seconds = 0.0
        run = StudyRun(engine, store)
        run.compute_missing(bundle.chunks)
    return run.totals, host


@functools.lru_cache(maxsize=2)
def _cached_engine(folder: str, identity: str, layout: Layout, backend: Backend, require_backend: bool) -> Engine:
    """The engine of a study; the next bundle of the study gets the same one, with its compiled programs."""
    return Engine(load_config(to_path(folder)), layout, backend=backend, require_backend=require_backend)
