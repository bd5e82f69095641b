"""A whole study, from config to frame: the function behind `jaxbl sweep`."""

import dataclasses
import functools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import pandas as pd
import pyarrow as pa
from pyarrow.parquet import filters_to_expression

from jaxbl.cluster import Scheduler, connect
from jaxbl.config import Config, read_config
from jaxbl.errors import InputError
from jaxbl.files import lock_folder, remove_drafts, remove_if_empty_on_error, to_path
from jaxbl.workers import Progress

from .bundles import ClusterRun, submit_chunks
from .engine import Engine, SweepEstimate
from .metrics import find_metric
from .programs import Backend
from .run import Run, join_store, open_or_create_store
from .status import Status, status
from .store import Store, load_config

if TYPE_CHECKING:
    import xarray
    from pyarrow.dataset import Dataset


_LET_GO = 60.0
"""Seconds in which workers end what they have begun, and let go of the folder: also those of a client that was lost."""
_MOST_NUMBERS = 2e8
"""Of a dataset that is mostly empty: 1.6 GB."""


@dataclasses.dataclass(frozen=True)
class StudyResult:
    """Points of a study with their metrics.

    Attributes:
        config: the study.
        cost: seconds of compilation and of computing, and lanes computed in this call.
        source: where the rows are: a folder, or memory.
        scanned: what the fused loop did not know of groups that this call scanned in its place.
        damaged: parts that this call found damaged, kept aside and computed anew.
    """

    config: Config
    source: Store | pd.DataFrame
    cost: dict[str, float] = dataclasses.field(default_factory=dict)
    fallback_reasons: tuple[str, ...] = ()
    damaged: tuple[str, ...] = ()

    @functools.cached_property
    def frame(self) -> pd.DataFrame:
        """One row a point and seed: axis paths, `seed`, metrics (columns and units: docs/reference.md)."""
        return self.read()

    @property
    def columns(self) -> list[str]:
        """Names of all columns."""
        return self.source.columns() if isinstance(self.source, Store) else list(self.source.columns)

    def is_finished(self, rows: int) -> bool:
        """Whether so many rows are all that the study has."""
        if not isinstance(self.source, Store):
            return True
        manifest = self.source.manifest
        # a refined study knows at the end how many it has
        return rows >= manifest["rows"] and (manifest["finished"] or self.config.sweep.refine is None)

    @property
    def runs(self) -> int:
        """Number of rows that the study has; of an unfinished one, that it will have."""
        return self.source.manifest["rows"] if isinstance(self.source, Store) else len(self.source)

    def batches(self, columns: Iterable[str] | None = None, filters: Sequence[Any] | None = None) -> Iterator[pd.DataFrame]:
        """Rows part by part, in the memory of one part; all columns, or some.

        Args:
            columns: names; left out, all.
            filters: which rows, as of `pandas.read_parquet`: tuples such as `("encoders.noise", "<", 1e-3)` that all
                have to hold, or lists of such, of which one has to.

        Raises:
            InputError: a part is damaged, or not of this study.
        """
        names = self.columns if columns is None else list(dict.fromkeys(columns))
        given: Any = filters or []
        conditions = [one for group in given for one in (group if isinstance(group, list) else [group])]
        needed = list(dict.fromkeys([*names, *(condition[0] for condition in conditions)]))
        source = self.source.batches(needed) if isinstance(self.source, Store) else [self.source]
        for frame in source:
            if filters:
                found = pa.Table.from_pandas(frame.loc[:, needed], preserve_index=False)
                frame = found.filter(filters_to_expression(given)).to_pandas()
            yield frame.loc[:, names]

    def read(self, columns: Iterable[str] | None = None, filters: Sequence[Any] | None = None) -> pd.DataFrame:
        """Some columns or rows of the frame, read for this call: a large study need not fit into memory whole. Arguments and
        errors are those of :meth:`batches`."""
        if columns is None and filters is None and not isinstance(self.source, Store):
            return self.source
        return pd.concat(self.batches(columns, filters), ignore_index=True)

    def dataset(self, *, check: bool = True) -> "Dataset":
        """The rows as a dataset of pyarrow, which reads what is asked of it: columns, rows by predicates, batches.

        pyarrow compares each page that it reads with its checksum.

        Args:
            check: compare each file with its checksum in the manifest first (about a second a GB); otherwise only what each
                part says of itself is looked at, and damage to a file's index of its rows may pass.

        Raises:
            InputError: a part is damaged, or not of this study.
        """
        if isinstance(self.source, Store):
            return self.source.dataset(check)
        from pyarrow import dataset

        return cast("Dataset", dataset.dataset(pa.Table.from_pandas(self.source, preserve_index=False)))

    def to_xarray(self) -> "xarray.Dataset":
        """The frame as a dataset over the axes and `seed` (zipped axes share one dimension); needs xarray.

        Of a refined study it has every value of an axis that occurs, and NaN where no point was simulated (`converged` and
        `finite` are then 1, 0 or NaN).

        Raises:
            ValueError: a quasi-random design, which has no grid; a refined study with too large a one.
        """
        import xarray

        if self.config.sweep.design != "grid":
            raise ValueError(f"a {self.config.sweep.design} design has no grid; use the frame")
        along: dict[str, list[str]] = {}
        for axis in self.config.axes:
            along.setdefault(axis.zip or axis.path, []).append(axis.path)
        zipped = {dim: paths for dim, paths in along.items() if paths != [dim]}
        frame = self.frame.copy(deep=False)
        for dim, paths in zipped.items():
            frame[dim] = frame.groupby(paths, sort=False).ngroup()
        if self.config.sweep.refine is not None:
            size = math.prod(len(frame[dim].unique()) for dim in [*along, "seed"]) * len(frame.columns)
            if size > _MOST_NUMBERS:
                raise ValueError(f"the whole grid would have {size:.2g} numbers, most of them NaN; use the frame")
            frame = frame.astype(dict.fromkeys(frame.select_dtypes(bool).columns, float))
        dataset = frame.set_index([*along, "seed"]).to_xarray()
        for dim, paths in zipped.items():
            first = {other: 0 for other in dataset.dims if other != dim}
            dataset = dataset.assign_coords({path: dataset[path].isel(first, drop=True) for path in paths}).drop_vars(dim)
        for name in dataset.data_vars:
            about = find_metric(str(name))
            dataset[name].attrs = {"units": about.unit, "long_name": about.doc}
        assert isinstance(dataset, xarray.Dataset)
        return dataset


def sweep(
    study: str | Path | Mapping[str, Any] | Config,
    out: str | Path | None = None,
    *,
    progress: Progress | None = None,
    devices: list[Any] | None = None,
    overwrite: bool = False,
    backend: Backend | None = None,
    verify_store: bool = False,
    scheduler: Scheduler = None,
) -> StudyResult:
    """Run all points of a study.

    Args:
        study: TOML file, mapping or config.
        out: folder to keep the results in, chunk by chunk; a study that was interrupted there goes on where it stopped,
            one that is finished is only read. Without it nothing is written.
        progress: called with finished and total lanes after each chunk; the total of a refined study grows.
        devices: JAX devices to use; left out, all local ones.
        overwrite: remove the results of another study from `out`.
        backend: `fused` or `scan`; left out, the faster one here. A study that goes on keeps to that of its first chunks.
        verify_store: read each part that is there first, column by column; otherwise only files are compared with their
            checksums.
        scheduler: Dask cluster whose workers compute, and write into `out`, which they have to see: an address,
            a scheduler's file, `local:N` for N processes of this machine, or a `distributed.Client`; left out, this process.

    Raises:
        InputError: wrong config, a folder that holds something else or that another process writes into, a part of another
            study, a backend that cannot run the study, or no such cluster.
        NoResult: nothing can be written any more, as the disk is full, or the cluster is lost; what was written is whole.
    """
    config = read_config(study)
    engine = Engine(config, devices=devices, backend=backend, require_backend=backend is not None)
    if out is None:
        if scheduler is not None:
            raise InputError("--scheduler: its workers write into a folder; name it with --out")
        if backend == "fused":
            engine.compile_all()
        run = Run(engine, None, progress)
        run.all()
        return _result(run, run.frame())
    folder = to_path(out)
    if backend == "fused" and not (folder / "manifest.json").exists():
        # refused, if it is, before anything is written
        engine.compile_all()
    with remove_if_empty_on_error(folder), connect(scheduler) as cluster:
        with lock_folder(folder, wait=0.0 if cluster is None else _LET_GO):
            engine, store = open_or_create_store(folder, engine, require_backend=backend is not None, overwrite=overwrite)
            store.refuse_foreign_files()
            if verify_store:
                store.verify()
            run = Run(engine, store, progress) if cluster is None else ClusterRun(cluster, engine, store, progress)
            if cluster is None:
                run.all()
                run.finish()
        if cluster is not None:
            with lock_folder(folder, shared=True):
                run.all()
            with lock_folder(folder, wait=_LET_GO):
                # of workers that were lost
                remove_drafts(folder)
                run.finish()
    return _result(run, store)


def _result(run: Run, source: Store | pd.DataFrame) -> StudyResult:
    """What a run leaves."""
    work = run.work
    cost = {"compile_seconds": work.compile_seconds, "run_seconds": work.run_seconds, "lanes": work.lanes}
    return StudyResult(run.engine.config, source, cost, work.fallback_reasons, work.damaged)


def share(
    study: str | Path | Mapping[str, Any] | Config,
    out: str | Path,
    portion: tuple[int, int],
    *,
    progress: Progress | None = None,
    devices: list[Any] | None = None,
    backend: Backend | None = None,
) -> Status:
    """Compute one of several shares of a study's chunks, apart from chunks that are stored already.

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
        InputError: as for :func:`sweep`; or a refined study, whose points depend on one another.
        NoResult: nothing can be written any more.
    """
    config, folder = read_config(study), to_path(out)
    engine = Engine(config, devices=devices, backend=backend, require_backend=backend is not None)
    _check_independent(engine, "--share")
    number, count = portion
    with (
        remove_if_empty_on_error(folder),
        join_store(folder, engine, require_backend=backend is not None) as (engine, store),
    ):
        run = Run(engine, store, progress, engine.chunk_order()[number - 1 :: count])
        run.all()
    return status(folder)


def submit(
    study: str | Path | Mapping[str, Any] | Config,
    out: str | Path,
    scheduler: Scheduler,
    *,
    devices: list[Any] | None = None,
    backend: Backend | None = None,
) -> Status:
    """Hand a study's chunks to a cluster, and do not wait for them: :func:`status` says how far it is, and :func:`sweep`
    reads what is there and computes what is missing. Arguments are as of :func:`sweep`.

    Raises:
        InputError: as of :func:`sweep`; a refined study, whose points depend on one another, or a cluster that would end
            with this process.
    """
    config, folder = read_config(study), to_path(out)
    engine = Engine(config, devices=devices, backend=backend, require_backend=backend is not None)
    _check_independent(engine, "--detach")
    with remove_if_empty_on_error(folder), connect(scheduler) as cluster:
        if cluster is None or cluster.local:
            raise InputError("--detach: needs the --scheduler of a cluster that stays when this command has ended")
        with join_store(folder, engine, require_backend=backend is not None) as (engine, store):
            submit_chunks(cluster, engine, store)
    return status(folder)


def _check_independent(engine: Engine, option: str) -> None:
    if engine.points.refinement is not None:
        raise InputError(f"{option}: sweep.refine makes points depend on one another; leave {option} out, or sweep.refine")


def open_study(folder: str | Path) -> StudyResult:
    """A study's folder, finished or not: its config, and its rows as a frame, a dataset of pyarrow or of xarray, each read
    on first use. Raises `InputError` where there is none."""
    store = Store.open(to_path(folder))
    return StudyResult(load_config(store.folder), store)


def repair(folder: str | Path) -> tuple[int, Store]:
    """Check a study's folder: damaged parts are kept aside, and a manifest that is lost or damaged is written anew.

    Returns how many parts are whole, and the store. What is missing then, :func:`sweep` computes.

    Raises:
        InputError: no study is there, its `study.toml` is damaged, or a part is of another one.
    """
    folder = to_path(folder)
    if not (folder / "study.toml").exists():
        raise InputError(f"{folder}: holds no study (no study.toml); run 'jaxbl sweep STUDY.toml --out {folder}'")
    config = load_config(folder)
    with lock_folder(folder):
        _, store = open_or_create_store(folder, Engine(config), require_backend=False)
        return store.verify(), store


def dry_run(study: str | Path | Mapping[str, Any] | Config, *, backend: Backend | None = None) -> SweepEstimate:
    """What a study will cost, from a compilation and a short calibration run; of a refined one, its coarse grid."""
    return Engine(read_config(study), backend=backend, require_backend=backend is not None).estimate()
