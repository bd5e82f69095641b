"""A whole study, from config to frame: the function behind `jaxbl sweep`."""

import dataclasses
import functools
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import pandas as pd
import pyarrow as pa
from pyarrow.parquet import filters_to_expression

from jaxbl.cluster import Scheduler, connect
from jaxbl.config import Config, ConfigSource, read_config
from jaxbl.errors import InputError
from jaxbl.files import MANIFEST, lock_folder, to_path
from jaxbl.workers import Progress

from .bundles import ClusterRun
from .engine import Engine, SweepEstimate
from .metrics import find_metric
from .programs import Backend
from .run import MemoryStore, StudyRun, join_store
from .status import Status, status
from .store import Store, load_config

if TYPE_CHECKING:
    import xarray
    from pyarrow.dataset import Dataset


_RELEASE_SECONDS = 60.0
"""Longest time until workers, also those of a client that was lost, have ended their jobs and released the folder."""
_MAX_GRID_NUMBERS = 2e8
"""Largest number of values of a dataset that is mostly empty: 1.6 GB."""


@dataclasses.dataclass(frozen=True, eq=False)
class StudyResult:
    """Points of a study with their metrics.

    Attributes:
        config: the study.
        source: the rows: the store of a folder, or a frame in memory.
        cost: seconds of compilation and of computing, and number of lanes, that this call took.
        fallback_reasons: what the fused loop does not support, of groups that the scan computed in its place.
        damaged: a sentence for each damaged part that this call moved to `damaged/` and computed anew.
    """

    config: Config
    source: Store | pd.DataFrame
    cost: dict[str, float] = dataclasses.field(default_factory=dict)
    fallback_reasons: tuple[str, ...] = ()
    damaged: tuple[str, ...] = ()

    @functools.cached_property
    def frame(self) -> pd.DataFrame:
        """A row for each point and seed: axis paths, `seed`, metrics (columns and units: docs/reference.md)."""
        return self.read()

    @property
    def columns(self) -> list[str]:
        """Names of all columns."""
        return self.source.columns() if isinstance(self.source, Store) else list(self.source.columns)

    def is_finished(self, rows: int) -> bool:
        """True if a number of rows is all that the study has."""
        if not isinstance(self.source, Store):
            return True
        manifest = self.source.manifest
        # a refined study has its number of rows only at the end
        return rows >= manifest["rows"] and (manifest["finished"] or self.config.sweep.refine is None)

    @property
    def runs(self) -> int:
        """Number of rows of the finished study."""
        return self.source.manifest["rows"] if isinstance(self.source, Store) else len(self.source)

    def batches(self, columns: Iterable[str] | None = None, filters: Sequence[Any] | None = None) -> Iterator[pd.DataFrame]:
        """Yield the rows part by part: only one part is in memory at a time.

        Args:
            columns: names of columns; left out, all.
            filters: conditions on the rows, as for `pandas.read_parquet`: tuples such as `("encoders.noise", "<", 1e-3)`
                that must all hold, or lists of such tuples, of which one must hold.

        Raises:
            InputError: a part is damaged, or not of this study.
        """
        names = self.columns if columns is None else list(dict.fromkeys(columns))
        groups: Any = filters or []
        conditions = [condition for group in groups for condition in (group if isinstance(group, list) else [group])]
        needed = list(dict.fromkeys([*names, *(path for path, *_ in conditions)]))
        for frame in self.source.batches(needed) if isinstance(self.source, Store) else [self.source]:
            if filters:
                table = pa.Table.from_pandas(frame.loc[:, needed], preserve_index=False)
                frame = table.filter(filters_to_expression(groups)).to_pandas()
            yield frame.loc[:, names]

    def read(self, columns: Iterable[str] | None = None, filters: Sequence[Any] | None = None) -> pd.DataFrame:
        """Read some columns or rows of the frame; the other ones are not held in memory.

        Arguments and errors are those of :meth:`batches`.
        """
        if columns is None and filters is None and not isinstance(self.source, Store):
            return self.source
        return pd.concat(self.batches(columns, filters), ignore_index=True)

    def dataset(self, *, check: bool = True) -> "Dataset":
        """The rows as a dataset of pyarrow, which reads columns, rows by predicates, or batches on request.

        pyarrow compares each page that it reads with its checksum.

        Args:
            check: compare each file with its checksum first (about a second a GB); otherwise only the header of each part is
                read, and damage to a file's index of its rows may pass.

        Raises:
            InputError: a part is damaged, or not of this study.
        """
        if isinstance(self.source, Store):
            return self.source.dataset(check)
        from pyarrow import dataset

        return cast("Dataset", dataset.dataset(pa.Table.from_pandas(self.source, preserve_index=False)))

    def to_xarray(self) -> "xarray.Dataset":
        """The frame as a dataset over the axes and `seed` (zipped axes share one dimension); needs xarray.

        For a refined study it has all axis values that occur, and NaN at points that were not simulated (`converged` and
        `finite` are then 1, 0 or NaN).

        Raises:
            ValueError: the study has no grid, as its design is quasi-random, or it is refined and its grid is too large.
        """
        import xarray

        if self.config.sweep.design != "grid":
            raise ValueError(f"a {self.config.sweep.design} design has no grid; use the frame")
        dims: dict[str, list[str]] = {}
        for axis in self.config.axes:
            dims.setdefault(axis.zip or axis.path, []).append(axis.path)
        zipped = {dim: paths for dim, paths in dims.items() if paths != [dim]}
        frame = self.frame.copy(deep=False)
        for dim, paths in zipped.items():
            frame[dim] = frame.groupby(paths, sort=False).ngroup()
        if self.config.sweep.refine is not None:
            size = math.prod(len(frame[dim].unique()) for dim in [*dims, "seed"]) * len(frame.columns)
            if size > _MAX_GRID_NUMBERS:
                raise ValueError(f"the whole grid would have {size:.2g} numbers, most of them NaN; use the frame")
            frame = frame.astype(dict.fromkeys(frame.select_dtypes(bool).columns, float))
        dataset = frame.set_index([*dims, "seed"]).to_xarray()
        for dim, paths in zipped.items():
            first = {other: 0 for other in dataset.dims if other != dim}
            dataset = dataset.assign_coords({path: dataset[path].isel(first, drop=True) for path in paths}).drop_vars(dim)
        for name in dataset.data_vars:
            metric = find_metric(str(name))
            dataset[name].attrs = {"units": metric.unit, "long_name": metric.doc}
        assert isinstance(dataset, xarray.Dataset)
        return dataset


def sweep(
    study: ConfigSource,
    out: str | Path | None = None,
    *,
    progress: Progress | None = None,
    devices: list[Any] | None = None,
    overwrite: bool = False,
    backend: Backend | None = None,
    scheduler: Scheduler = None,
) -> StudyResult:
    """Run all points of a study.

    Args:
        study: TOML file, mapping or config.
        out: folder for the results; a study that was interrupted there is continued, and one that is finished is only
            read. Without a folder nothing is written.
        progress: called with finished and total lanes after each chunk; the total of a refined study grows.
        devices: JAX devices to use; left out, all local ones.
        overwrite: remove the results of another study from `out`.
        backend: `fused` or `scan`; left out, the faster one here. A study that is continued keeps its backend.
        scheduler: Dask cluster whose workers compute and write into `out`, which they must see: an address, a scheduler's
            file, `local:N` for N processes of this machine, or a `distributed.Client`; left out, this process computes.

    Raises:
        InputError: the config is wrong, the folder holds something else or another process writes into it, a part is of
            another study, the backend cannot run the study, or no cluster answers.
        NoResult: the disk is full, or the cluster is lost; parts that were written are whole.
    """
    engine = Engine(read_config(study), devices=devices, backend=backend)
    if out is None and scheduler is not None:
        raise InputError("--scheduler: its workers write into a folder; name it with --out")
    folder = None if out is None else to_path(out)
    if backend == "fused" and not (folder and (folder / MANIFEST).exists()):
        # a backend that cannot run the study is refused before anything is written
        engine.compile_all()
    if folder is None:
        memory = MemoryStore()
        StudyRun(engine, memory, progress).compute_all()
        return _make_result(engine, memory.frame())
    with connect(scheduler) as cluster:
        with lock_folder(folder, wait=0.0 if cluster is None else _RELEASE_SECONDS):
            store = Store.create(folder, engine, overwrite=overwrite)
            store.list_indices()
            if cluster is None:
                run = StudyRun(engine, store, progress)
                run.compute_all()
                run.mark_finished()
        if cluster is not None:
            run = ClusterRun(cluster, engine, store, progress)
            with lock_folder(folder, shared=True):
                run.compute_all()
            # this removes drafts of workers that were lost, too
            with lock_folder(folder, wait=_RELEASE_SECONDS):
                run.mark_finished()
    return _make_result(engine, store, store.damaged)


def _make_result(engine: Engine, source: Store | pd.DataFrame, damaged: Iterable[str] = ()) -> StudyResult:
    return StudyResult(engine.config, source, engine.cost, tuple(engine.fallback_reasons), tuple(damaged))


def share(
    study: ConfigSource,
    out: str | Path,
    portion: tuple[int, int],
    *,
    progress: Progress | None = None,
    devices: list[Any] | None = None,
    backend: Backend | None = None,
) -> Status:
    """Compute one of several shares of a study's chunks, except chunks that are stored.

    Other processes may compute other shares into the same folder at the same time. Once all chunks are stored,
    :func:`sweep` only reads them.

    Args:
        study: as for :func:`sweep`.
        out: as for :func:`sweep`.
        portion: (i, n) computes the i-th of n shares, i = 1 ... n.
        progress: as for :func:`sweep`.
        devices: as for :func:`sweep`.
        backend: as for :func:`sweep`.

    Raises:
        InputError: as for :func:`sweep`; or the study is refined, so that its points depend on one another.
        NoResult: the disk is full.
    """
    folder, engine = to_path(out), Engine(read_config(study), devices=devices, backend=backend)
    _check_independent(engine, "--share")
    number, count = portion
    with join_store(folder, engine) as store:
        StudyRun(engine, store, progress).compute_share(engine.chunk_order()[number - 1 :: count])
    return status(folder)


def submit(
    study: ConfigSource,
    out: str | Path,
    scheduler: Scheduler,
    *,
    devices: list[Any] | None = None,
    backend: Backend | None = None,
) -> Status:
    """Hand a study's chunks to a cluster without waiting for them. Arguments are as for :func:`sweep`.

    :func:`status` returns the progress; a later :func:`sweep` reads stored chunks and computes missing ones.

    Raises:
        InputError: as for :func:`sweep`; or the study is refined, so that its points depend on one another, or the cluster
            would end with this process.
    """
    folder, engine = to_path(out), Engine(read_config(study), devices=devices, backend=backend)
    _check_independent(engine, "--detach")
    with connect(scheduler) as cluster:
        if cluster is None or cluster.local:
            raise InputError("--detach: needs the --scheduler of a cluster that stays when this command has ended")
        with join_store(folder, engine) as store:
            ClusterRun(cluster, engine, store).submit_missing()
    return status(folder)


def _check_independent(engine: Engine, option: str) -> None:
    if engine.points.refinement is not None:
        raise InputError(f"{option}: sweep.refine makes points depend on one another; leave {option} out, or sweep.refine")


def open_study(folder: str | Path) -> StudyResult:
    """Open a study's folder, finished or not; its rows are read on first use.

    Raises:
        InputError: the folder holds no study.
    """
    store = Store.open(to_path(folder))
    return StudyResult(load_config(store.folder), store)


def repair(folder: str | Path) -> tuple[int, Store]:
    """Check a study's folder: damaged parts are moved to `damaged/`, and a lost or damaged manifest is written anew.

    A later :func:`sweep` computes the missing parts.

    Returns:
        The number of whole parts, and the store.

    Raises:
        InputError: the folder holds no study, its `study.toml` is damaged, or a part is of another study.
    """
    folder = to_path(folder)
    if not (folder / "study.toml").exists():
        raise InputError(f"{folder}: holds no study (no study.toml); run 'jaxbl sweep STUDY.toml --out {folder}'")
    config = load_config(folder)
    with lock_folder(folder):
        store = Store.create(folder, Engine(config))
        return store.verify(), store


def dry_run(study: ConfigSource, *, backend: Backend | None = None) -> SweepEstimate:
    """Estimate time and memory of a study by a compilation and short runs; for a refined study, of its coarse grid."""
    return Engine(read_config(study), backend=backend).estimate()
