"""Chunks of a study on a cluster: bundles that take a worker long enough, so that a large study is thousands of jobs.

Workers write parts into the study's folder themselves, and leave out what is there: a bundle may be done twice.
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
from jaxbl.files import is_remote, lock_folder, to_path
from jaxbl.workers import Progress

from .engine import Chunk, Engine
from .programs import Backend, Layout
from .run import Run, RunTotals
from .store import Store, load_config

_SECONDS = 20.0
"""Of a bundle: a scheduler spends some 1 ms on one, and what a lost worker has begun is lost."""
_MOST = 50_000
"""Bundles of a study: a scheduler keeps some 6 kB of each, and is slow above 100 000 (Dask's distributed#3691, #3898)."""
_TURNS = 4
"""Bundles that each worker gets at least: they end together then."""
_LOOK = 2.0
"""Seconds between two looks at the parts that exist."""
_SEEN = 30.0
"""Seconds until a part that a worker has written is seen here: network file systems remember what was not there."""


class Bundle(NamedTuple):
    """Chunks for a worker, by their indices, or themselves where they are of a refined study."""

    folder: str
    identity: str
    layout: Layout
    backend: Backend
    require_backend: bool
    chunks: tuple[int | Chunk, ...]


class _BundleResult(NamedTuple):
    """What a worker has done of a bundle: checksums of its parts by index."""

    checksums: dict[int, str]
    work: RunTotals
    host: str


class ClusterRun(Run):
    """A run whose chunks are computed by a cluster's workers.

    Raises, where a :class:`Run` does not:
        InputError: workers do not see the store's folder, or cannot run the study.
        NoResult: the cluster is lost.
    """

    def __init__(self, cluster: Cluster, engine: Engine, store: Store, progress: Progress | None):
        super().__init__(engine, store, progress)
        self._cluster = cluster
        self._next_look = time.monotonic() + _LOOK

    def ensure(self, chunks: Iterable[Chunk]) -> None:
        missing: list[int | Chunk] = []
        for chunk in chunks:
            if self.is_there(chunk):
                self.count(chunk)
            else:
                # the points of all chunks would be 8 GB in a study of 10^9
                missing.append(chunk.index if self.engine.points.refinement is None else chunk)
        # one chunk a worker says how long one takes
        first, before = self._cluster.workers, self.work.run_seconds
        self._wave(missing[:first], 1)
        rest = missing[first:]
        self._wave(rest, _bundle_size((self.work.run_seconds - before) / first, len(rest), self._cluster.workers))

    def _wave(self, chunks: Sequence[int | Chunk], size: int) -> None:
        for part, done in self._cluster.done(compute_bundle, _bundles(self.engine, self.kept, chunks, size), self._look):
            for one in part:
                chunk = self.engine.chunk(one) if isinstance(one, int) else one
                _wait_for(self.kept.part_path(chunk.index), done.host)
                self.count(chunk)
            self.kept.add_checksums(done.checksums)
            self.elsewhere += done.work

    def _look(self) -> None:
        """Tell progress by the parts that exist: bundles take long."""
        if time.monotonic() > self._next_look:
            start = time.monotonic()
            self.tell(len(self.kept.list_part_files()))
            # a list of 300 000 files takes seconds
            self._next_look = time.monotonic() + max(_LOOK, 10.0 * (time.monotonic() - start))


def submit_chunks(cluster: Cluster, engine: Engine, store: Store) -> None:
    """Have all chunks of a study computed that are missing, without waiting for more than the first. Raises as
    :class:`ClusterRun`."""
    missing = [index for index in engine.chunk_order() if not store.has_part(index)]
    seconds = 0.0
    for _, done in cluster.done(compute_bundle, _bundles(engine, store, missing[:1], 1)):
        seconds = done.work.run_seconds
    rest = missing[1:]
    size = _bundle_size(seconds, len(rest), cluster.workers)
    cluster.submit_jobs(compute_bundle, [bundle for _, bundle in _bundles(engine, store, rest, size)])


def _bundle_size(seconds: float, chunks: int, workers: int) -> int:
    """Chunks of a bundle, where one takes so long and so many are left."""
    by_time = int(_SECONDS / max(seconds, 1e-3))
    return max(min(by_time, math.ceil(chunks / (workers * _TURNS))), math.ceil(chunks / _MOST), 1)


def _bundles(
    engine: Engine, store: Store, chunks: Sequence[int | Chunk], size: int
) -> Iterator[tuple[Sequence[int | Chunk], Bundle]]:
    """Chunks, `size` of them at once, with what a worker needs to know."""
    folder = store.folder if is_remote(store.folder) else store.folder.absolute()
    about = str(folder), store.manifest["identity"], store.layout, store.backend, engine.require_backend
    for first in range(0, len(chunks), size):
        part = chunks[first : first + size]
        yield part, Bundle(*about, tuple(part))


def _wait_for(part: Path, host: str) -> None:
    latest = time.monotonic() + _SEEN
    while not part.exists():
        if time.monotonic() > latest:
            raise InputError(
                f"{part}: was written by worker {host}, and is not seen here; --out should name a folder that all machines "
                "share"
            )
        time.sleep(0.2)


def compute_bundle(bundle: Bundle) -> _BundleResult:
    """Compute the chunks of a bundle that are not there, on a worker."""
    folder, host = to_path(bundle.folder), socket.gethostname()
    if not (folder / "manifest.json").exists():
        raise InputError(f"{folder}: is not seen by worker {host}; --out should name a folder that all machines share")
    with lock_folder(folder, shared=True, wait=_SEEN):
        store = Store.open(folder, keeps_manifest=False)
        if store.manifest["identity"] != bundle.identity:
            raise InputError(f"{folder}: holds another study by now; begin again with another --out")
        engine = _engine(*bundle[:-1])
        engine.compile_seconds = engine.run_seconds = 0.0
        run = Run(engine, store)
        run.ensure(engine.chunk(one) if isinstance(one, int) else one for one in bundle.chunks)
    indices = [one if isinstance(one, int) else one.index for one in bundle.chunks]
    return _BundleResult({index: store.manifest["checksums"][str(index)] for index in indices}, run.work, host)


@functools.lru_cache(maxsize=2)
def _engine(folder: str, identity: str, layout: Layout, backend: Backend, require_backend: bool) -> Engine:
    """The engine of a study, with its compiled programs, from one bundle to the next."""
    return Engine(load_config(to_path(folder)), layout, backend=backend, require_backend=require_backend)
