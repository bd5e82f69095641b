"""A whole study, from config to frame: the function behind `jaxbl sweep`."""

import dataclasses
import functools
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from jaxbl.config import Config, read_config
from jaxbl.errors import InputError
from jaxbl.files import locked, removed_if_empty
from jaxbl.workers import Progress

from .engine import Chunk, Engine, SweepEstimate
from .metrics import metric_of
from .programs import Backend
from .refine import refine
from .store import Store, claim

if TYPE_CHECKING:
    import xarray


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
    scanned: tuple[str, ...] = ()
    damaged: tuple[str, ...] = ()

    @functools.cached_property
    def frame(self) -> pd.DataFrame:
        """One row a point and seed: axis paths, `seed`, metrics (columns and units: docs/reference.md)."""
        return self.read()

    @property
    def columns(self) -> list[str]:
        """Names of all columns."""
        return self.source.columns() if isinstance(self.source, Store) else list(self.source.columns)

    def read(self, columns: Iterable[str] | None = None) -> pd.DataFrame:
        """Some columns of the frame, read for this call: a large study need not fit into memory whole."""
        names = None if columns is None else list(dict.fromkeys(columns))
        if isinstance(self.source, Store):
            return self.source.read(names)
        return self.source if names is None else self.source.loc[:, names]

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
            about = metric_of(str(name))
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

    Raises:
        InputError: wrong config, a folder that holds something else or that another process writes into, a part of another
            study, or a backend that cannot run the study.
        NoResult: nothing can be written any more, as the disk is full; what was written is whole.
    """
    config = read_config(study)
    engine = Engine(config, devices=devices, backend=backend, insist=backend is not None)
    if out is None:
        if backend == "fused":
            engine.check()
        run = _Run(engine, None, progress)
        run.all()
        return run.result(pd.concat(run.frames, ignore_index=True))
    folder = Path(out)
    if backend == "fused" and not (folder / "manifest.json").exists():
        # refused, if it is, before anything is written
        engine.check()
    with removed_if_empty(folder), locked(folder):
        claim(folder, config, overwrite=overwrite)
        engine, store = _taken_up(folder, engine, insist=backend is not None)
        store.refuse_others()
        if verify_store:
            store.verify()
        run = _Run(engine, store, progress)
        run.all()
        if run.computed or not store.manifest["finished"]:
            store.update(finished=True, seconds={"compile": engine.compile_seconds, "run": engine.run_seconds})
    return run.result(store)


def _taken_up(folder: Path, engine: Engine, *, insist: bool) -> tuple[Engine, Store]:
    """The store in a claimed folder, begun or gone on with, and the engine for it: chunks stay what they were when it was
    begun, on whatever machine. `insist`: the engine's backend was asked for."""
    config = engine.config
    store = Store.create(folder, config, engine.layout, engine.backend, len(engine), engine.rows)
    if insist and store.backend != engine.backend and not store.manifest["finished"]:
        raise InputError(
            f"{folder}: was begun with --backend {store.backend}; go on with that, or choose another folder with --out"
        )
    if (store.layout, store.backend) != (engine.layout, engine.backend):
        engine = Engine(config, store.layout, engine.devices, store.backend, insist)
    if engine.points.refinement is not None:
        store.count_parts()
    elif store.manifest["parts"] != len(engine):
        # the manifest was lost, and begun anew for other chunks
        store.update(parts=len(engine))
    return engine, store


class _Run:
    """Chunk after chunk of a study, those that are stored already left out."""

    def __init__(self, engine: Engine, store: Store | None, progress: Progress | None):
        self.engine, self.store, self.progress = engine, store, progress
        self.frames: list[pd.DataFrame] = []
        self.computed = self.done = 0
        self.chunks, self.total = len(engine), engine.rows
        self._next = 0

    def all(self) -> None:
        """Run the whole study."""
        if self.engine.points.refinement is None:
            for chunk in self.engine.chunks():
                self._take(chunk)
            return
        for group in range(len(self.engine.points.groups)):
            self._refine(group)
        if self.store is not None:
            self.store.trim(self.chunks, self.total)

    def result(self, source: Store | pd.DataFrame) -> StudyResult:
        """What the run leaves."""
        engine = self.engine
        cost = {"compile_seconds": engine.compile_seconds, "run_seconds": engine.run_seconds, "lanes": self.computed}
        damaged = () if self.store is None else tuple(self.store.damaged)
        return StudyResult(engine.config, source, cost, tuple(engine.scanned), damaged)

    def _refine(self, group: int) -> None:
        """The coarse grid of a group, and what its boundaries need."""
        assert self.engine.points.refinement is not None
        _, grid, criterion = self.engine.points.refinement
        columns, seeds = list(criterion.columns), self.engine.config.sweep.seeds
        expected = self.engine.points.coarse_lanes

        def evaluate(points: np.ndarray) -> np.ndarray:
            nonlocal expected
            # the coarse grid is counted from the start
            self.total += (len(points) - expected) * seeds
            self.chunks += self.engine.chunks_for(len(points)) - self.engine.chunks_for(expected)
            expected = 0
            if self.store is not None:
                self.store.grow(self.chunks, self.total)
            values = np.empty((seeds, len(points), len(columns)))
            row = column = 0
            for chunk in self.engine.split(group, points, self._next):
                shape = (len(chunk.seeds), len(chunk.points), len(columns))
                found = self._take(chunk, columns)[columns].to_numpy(float).reshape(shape)
                values[row : row + shape[0], column : column + shape[1]] = found
                column += shape[1]
                if column == len(points):
                    row, column = row + shape[0], 0
            return values.swapaxes(0, 1)

        refine(grid, evaluate, criterion.differ)

    def _take(self, chunk: Chunk, columns: list[str] | None = None) -> pd.DataFrame:
        """Compute a chunk, or read some columns of it where it is stored; with no columns, nothing is read."""
        frame = None
        if self.store is not None and self.store.has(chunk.index):
            frame = (
                pd.DataFrame() if columns is None else self.store.read_part(chunk.index, self.engine.labels(chunk), columns)
            )
        if frame is None:
            frame = self.engine.run(chunk)
            self.computed += len(frame)
            if self.store is None:
                self.frames.append(frame)
            else:
                self.store.write(chunk.index, frame)
        self._next = chunk.index + 1
        self.done += len(chunk.seeds) * len(chunk.points)
        if self.progress:
            self.progress(self.done, self.total)
        return frame


def load(folder: str | Path) -> StudyResult:
    """Read a study's folder. Raises `InputError` where there is none."""
    store = Store.open(Path(folder))
    return StudyResult(read_config(store.folder / "study.toml"), store)


def repair(folder: str | Path) -> tuple[int, Store]:
    """Check a study's folder: damaged parts are kept aside, and a manifest that is lost or damaged is written anew.

    Returns how many parts are whole, and the store. What is missing then, :func:`sweep` computes.

    Raises:
        InputError: no study is there, its `study.toml` is damaged, or a part is of another one.
    """
    folder = Path(folder)
    if not (folder / "study.toml").exists():
        raise InputError(f"{folder}: holds no study (no study.toml); run 'jaxbl sweep STUDY.toml --out {folder}'")
    config = read_config(folder / "study.toml")
    with locked(folder):
        claim(folder, config)
        _, store = _taken_up(folder, Engine(config), insist=False)
        return store.verify(), store


def dry_run(study: str | Path | Mapping[str, Any] | Config, *, backend: Backend | None = None) -> SweepEstimate:
    """What a study will cost, from a compilation and a short calibration run; of a refined one, its coarse grid."""
    return Engine(read_config(study), backend=backend, insist=backend is not None).estimate()
