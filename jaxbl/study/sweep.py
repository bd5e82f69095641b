"""A whole study, from config to frame: the function behind `jaxbl sweep`."""

import dataclasses
import functools
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from .config import Config, read_config
from .engine import Engine, Estimate, Layout, Progress
from .metrics import describe
from .store import Store, claim

if TYPE_CHECKING:
    import xarray


@dataclasses.dataclass(frozen=True)
class StudyResult:
    """Points of a study with their metrics.

    Attributes:
        config: the study.
        cost: seconds of compilation and of computing, and lanes computed in this call.
        source: where the rows are: a folder, or memory.
    """

    config: Config
    source: Store | pd.DataFrame
    cost: dict[str, float] = dataclasses.field(default_factory=dict)

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

        Raises:
            ValueError: a quasi-random design, which has no grid.
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
        dataset = frame.set_index([*along, "seed"]).to_xarray()
        for dim, paths in zipped.items():
            first = {other: 0 for other in dataset.dims if other != dim}
            dataset = dataset.assign_coords({path: dataset[path].isel(first, drop=True) for path in paths}).drop_vars(dim)
        for name in dataset.data_vars:
            about = describe(str(name))
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
) -> StudyResult:
    """Run all points of a study.

    Args:
        study: TOML file, mapping or config.
        out: folder to keep the results in, chunk by chunk; a study that was interrupted there goes on where it stopped,
            one that is finished is only read. Without it nothing is written.
        progress: called with finished and total lanes after each chunk.
        devices: JAX devices to use; left out, all local ones.
        overwrite: remove the results of another study from `out`.

    Raises:
        InputError: wrong config, or a folder that holds something else.
    """
    config = read_config(study)
    if out is None:
        engine = Engine(config, devices=devices)
        frames = []
        for chunk in engine.chunks():
            frames.append(engine.run(chunk))
            if progress:
                progress(sum(len(frame) for frame in frames), engine.rows)
        return StudyResult(config, pd.concat(frames, ignore_index=True), _cost(engine, engine.rows))
    folder = Path(out)
    engine = Engine(config, devices=devices)
    claim(folder, config, overwrite=overwrite)
    store = Store.create(folder, config, engine.layout, len(engine), engine.rows)
    if store.layout != engine.layout:
        # taken up on another machine: the chunks must stay what they were
        engine = Engine(config, Layout(*store.layout), devices)
    done = computed = 0
    for chunk in engine.chunks():
        seeds, points = engine.contents(chunk)
        if not store.has(chunk.index):
            store.write(chunk.index, engine.run(chunk))
            computed += len(seeds) * len(points)
        done += len(seeds) * len(points)
        if progress:
            progress(done, engine.rows)
    if not store.manifest["finished"]:
        store.update(finished=True, seconds={"compile": engine.compile_seconds, "run": engine.run_seconds})
    return StudyResult(config, store, _cost(engine, computed))


def load(folder: str | Path) -> StudyResult:
    """Read a study's folder. Raises `InputError` where there is none."""
    store = Store.open(Path(folder))
    return StudyResult(store.config(), store)


def dry_run(study: str | Path | Mapping[str, Any] | Config) -> Estimate:
    """What a study will cost, from a compilation and a short calibration run."""
    return Engine(read_config(study)).estimate()


def _cost(engine: Engine, lanes: int) -> dict[str, float]:
    return {"compile_seconds": engine.compile_seconds, "run_seconds": engine.run_seconds, "lanes": lanes}
