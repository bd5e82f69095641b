"""Computes the chunks of a study on a cluster, in bundles, so that the largest study is some thousands of jobs.

Workers write parts into the study's folder, and leave out the chunks that are stored: a bundle may be computed twice.
"""

import functools
import math
import socket
import time
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

from jaxbl.cluster import Cluster
from jaxbl.errors import InputError
from jaxbl.files import MANIFEST, lock_folder, to_path
from jaxbl.workers import Progress

from .engine import Chunk, Engine
from .programs import Backend, Layout
from .run import StudyRun
from .store import Store, load_config

_BUNDLE_SECONDS = 20.0
"""Time of a bundle: a scheduler spends some 1 ms on one, and the bundle that a lost worker has begun is lost."""
_MAX_BUNDLES = 50_000
"""Bundles of a study: a scheduler holds some 6 kB of each, and is slow above 100 000 (Dask's distributed#3691, #3898)."""
_BUNDLES_PER_WORKER = 4
"""Least number of bundles for each worker, so that the workers end together."""
_DELAY_SECONDS = 30.0
"""Time until a file that another machine has written is seen: a network file system remembers that it was not there."""


Bundle = Sequence[Chunk]
"""Chunks that a worker computes."""


class ClusterRun(StudyRun):
    """A run whose chunks are computed by a cluster's workers.

    Raises, where a :class:`StudyRun` does not:
        InputError: workers do not see the store's folder, or cannot run the study.
        NoResult: the cluster is lost.
    """

    def __init__(self, cluster: Cluster, engine: Engine, store: Store, progress: Progress | None = None):
        super().__init__(engine, store, progress)
        self._cluster = cluster
        study = str(store.folder.absolute()), store.manifest["identity"], engine.require_backend
        self._compute_bundle = partial(compute_bundle, *study)

    def compute_missing(self, chunks: Iterable[Chunk]) -> None:
        self._compute_bundles(self._make_bundles(list(self.missing_chunks(chunks))))

    def submit_missing(self) -> None:
        """Have workers compute all missing chunks, waiting for the first alone: it shows that they can, and how fast."""
        missing = list(self.missing_chunks(map(self.engine.chunk, self.engine.chunk_order())))
        self._compute_bundles([chunk] for chunk in missing[:1])
        self._cluster.submit_jobs(self._compute_bundle, list(self._make_bundles(missing[1:])))

    def _make_bundles(self, chunks: Sequence[Chunk]) -> Iterator[Bundle]:
        """Yield bundles as they are asked for, as small as they may be until it is known how long a chunk takes."""
        first, workers = 0, max(self._cluster.workers, 1)
        while first < len(chunks):
            cost = self.engine.cost
            lane_seconds = cost["run_seconds"] / cost["lanes"] if cost["lanes"] else math.inf
            size = _bundle_size(lane_seconds * chunks[first].lanes, len(chunks), workers)
            yield chunks[first : first + size]
            first += size

    def _compute_bundles(self, bundles: Iterable[Bundle]) -> None:
        """Have workers compute bundles, and count what these cost as the engine's own."""
        for _, bundle, worked in self._cluster.run_jobs(self._compute_bundle, bundles):
            cost, fallback_reasons, damaged, host = worked
            for chunk in bundle:
                _wait_for_part(self.store.part_path(chunk.index), host)
                self.count_chunk(chunk)
            self.engine.cost = {name: amount + cost[name] for name, amount in self.engine.cost.items()}
            self.engine.fallback_reasons |= fallback_reasons
            self.store.damaged += damaged


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


def compute_bundle(
    place: str, identity: str, require_backend: bool, bundle: Bundle
) -> tuple[dict[str, float], dict[str, None], list[str], str]:
    """Compute the chunks of a bundle that are not stored; called on a worker.

    Args:
        place: folder of the study.
        identity: of the study in its manifest.
        require_backend: refuse a study that the fused loop cannot run.
        bundle: the chunks.

    Returns:
        The engine's `cost` of this bundle and `fallback_reasons`, the store's `damaged`, and the worker's host.
    """
    folder, host = to_path(place), socket.gethostname()
    if not (folder / MANIFEST).exists():
        raise InputError(f"{folder}: is not seen by worker {host}; --out should name a folder that all machines share")
    with lock_folder(folder, shared=True, wait=_DELAY_SECONDS):
        store = Store.open(folder)
        if store.manifest["identity"] != identity:
            raise InputError(f"{folder}: holds another study by now; begin again with another --out")
        engine = _cached_engine(place, identity, store.layout, store.backend, require_backend)
        engine.cost = dict.fromkeys(engine.cost, 0)
        StudyRun(engine, store).compute_missing(bundle)
    return engine.cost, dict(engine.fallback_reasons), store.damaged, host


@functools.lru_cache(maxsize=2)
def _cached_engine(folder: str, identity: str, layout: Layout, backend: Backend, require_backend: bool) -> Engine:
    """The engine of a study; the next bundle of the study gets the same one, with its compiled programs."""
    engine = Engine(load_config(to_path(folder)), layout, backend=backend)
    engine.require_backend = require_backend
    return engine
