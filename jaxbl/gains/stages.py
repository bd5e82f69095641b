"""A command that runs several studies, one after the other: their folder, backend, progress and cost."""

import copy
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import pandas as pd

from jaxbl.chain import NamedArrays
from jaxbl.cluster import Cluster, Scheduler, connect
from jaxbl.config import Config, TuneTable
from jaxbl.errors import InputError
from jaxbl.files import ResultFolder, lock_folder, make_folder, to_jsonable, to_path
from jaxbl.json_types import JsonObject
from jaxbl.sweeps import parts
from jaxbl.sweeps.programs import Backend, check_backend, share_programs
from jaxbl.sweeps.store import claim_study, study_head
from jaxbl.sweeps.sweep import StudyResult, sweep
from jaxbl.workers import Progress, announce

from .pilot import list_axes


@dataclasses.dataclass(frozen=True)
class GainChoice:
    """Gains chosen for a study.

    Attributes:
        config: the study.
        summary: plain data, as in `tuning.json`.
        cost: seconds of compilation and of computing, and lanes computed in this call.
        fallback_reasons: why runs of this call were scanned although the fused backend was asked for.
    """

    config: Config
    summary: JsonObject
    cost: dict[str, float]
    fallback_reasons: tuple[str, ...]


@contextmanager
def open_stages(
    config: Config, command: str, out: str | Path | None, scheduler: Scheduler, **options: Any
) -> "Iterator[Stages]":
    """Open stages in a folder, lock it against other processes, and connect to the cluster if there is one.

    `options` are arguments of :class:`Stages`.

    Raises:
        InputError: as of :class:`Stages`; or another process writes into the folder, or there is no such cluster.
    """
    with ExitStack() as stack:
        if out is not None:
            stack.enter_context(lock_folder(to_path(out)))
        stack.enter_context(share_programs())
        yield Stages(config, command, out, cluster=stack.enter_context(connect(scheduler)), **options)


def set_keys(tables: JsonObject, values: JsonObject) -> JsonObject:
    """Set dotted keys in a copy of a config's tables; None removes a key."""
    data = copy.deepcopy(tables)
    for path, value in values.items():
        *names, key = path.split(".")
        table = data
        for name in names:
            table = table.setdefault(name, {})
        if value is None:
            table.pop(key, None)
        else:
            table[key] = to_jsonable(value)
    return data


@dataclasses.dataclass
class Stages:
    """The studies that `tune` or `verify` runs, stored in the folder `out`/`command`; nothing is stored without `out`.

    Attributes:
        table: what the study asks of gains.
        results: the folder `out` with its manifest, or None.
        manifest: entry of the command in the manifest, of an earlier call at first.
        total_lanes: lanes of all stages, for the progress.
        fallback_reasons: why runs were scanned although the fused backend was asked for.
        cost: seconds of compilation and of computing, and lanes computed.

    Raises:
        InputError: the folder holds something else, or was begun with another backend.
    """

    config: Config
    command: str
    out: str | Path | None = None
    progress: Progress | None = None
    devices: list[Any] | None = None
    overwrite: bool = False
    backend: Backend | None = None
    cluster: Cluster | None = None

    def __post_init__(self):
        check_backend(self.backend)
        self.table = self.config.tune or TuneTable()
        self.results: ResultFolder | None = None
        self.manifest: JsonObject = {}
        self.total_lanes = self._finished_lanes = 0
        self.fallback_reasons: dict[str, None] = {}
        self.cost = {"compile_seconds": 0.0, "run_seconds": 0.0, "lanes": 0.0}
        if self.out is None:
            return
        self.results = claim_study(to_path(self.out), self.config, self.command, overwrite=self.overwrite)
        self.manifest = self.results.entries.get(self.command, {})
        if not self.manifest:
            return
        earlier_backend = check_backend(self.manifest.get("backend"))
        if self.backend not in (None, earlier_backend):
            before = f"with --backend {earlier_backend}; go on with that"
            if not earlier_backend:
                before = "without --backend; go on without it"
            raise InputError(f"{self.out}: was begun {before}, or choose another folder with --out")
        self.backend = earlier_backend

    def describe(self) -> JsonObject:
        """Describe the search for `tuning.json`: its title, objective, and first and last seed."""
        first, seeds = self.config.sweep.first_seed, self.config.sweep.seeds
        return {"title": self.config.title, "objective": self.table.objective, "seeds": [first, first + seeds - 1]}

    def describe_holdout(self, seeds: int) -> JsonObject:
        """Describe the held-out runs of :meth:`tables_of` for `tuning.json`."""
        tables = self.tables_of(self.config, "holdout", seeds)
        first = tables["sweep"]["first_seed"]
        return {
            "excitation": tables["excitation"],
            "same_excitation": self.table.holdout is None,
            "seeds": [first, first + seeds - 1],
        }

    def tables_of(self, config: Config, name: str, held_out_seeds: int | None = None) -> JsonObject:
        """Return the tables of a stage's study: those of `config` without its axes and evaluation.

        Held-out runs have so many other seeds, and the excitation `tune.holdout` if there is one.
        """
        data = config.to_dict()
        for key in ("notes", "figures", "tune", "uncertainty", "axes"):
            data.pop(key, None)
        data["title"] = f"{config.title} ({name})" if config.title else name
        data["sweep"] = {key: data["sweep"][key] for key in ("seeds", "first_seed", "chunk") if key in data["sweep"]}
        if held_out_seeds is not None:
            data["sweep"] |= {"seeds": held_out_seeds, "first_seed": config.sweep.first_seed + config.sweep.seeds}
            if self.table.holdout is not None:
                data["excitation"] = self.table.holdout.model_dump(by_alias=True, exclude_none=True)
        return data

    def write_manifest(self, **early_results: Any) -> None:
        """Write the manifest, which claims the folder for this study, with results found before the stages."""
        if self.results is not None:
            make_folder(self.results.path / self.command)
            entry = study_head(self.config, self.command) | early_results | {"backend": self.backend}
            # files of an earlier call stay until others take their place
            entry |= {"files": self.manifest.get("files", {}), "folders": [self.command]}
            self.manifest = self.results.entries[self.command] = entry
            self.results.write_manifest()

    def path_of(self, *names: str) -> Path | None:
        """Return a path in the folder, None without a folder."""
        return None if self.results is None else self.results.path.joinpath(self.command, *names)

    def read_or_compute(self, name: str, compute: Callable[[], pd.DataFrame]) -> pd.DataFrame:
        """Read a table from its file, or compute it and store it there. A damaged table is computed anew.

        Raises:
            InputError: the file is of another study.
        """
        path, manifest = self.path_of(name), study_head(self.config, self.command)
        if path is None:
            return compute()
        with suppress(FileNotFoundError, parts.DamagedFile):
            header, frame = parts.read_part(path)
            if header.study.get("identity") == manifest["identity"]:
                return frame
            if not self.overwrite:
                raise InputError(f"{path}: belongs to another study; choose another folder with --out, or --overwrite")
        frame = compute()
        parts.write_part(path, frame, parts.PartHeader(manifest, {}, "", 0))
        return frame

    def run(self, study: Config | JsonObject, name: str) -> StudyResult:
        """Run a stage, or continue one that was interrupted."""
        lanes_before = self._finished_lanes

        def update(finished: int, _: int) -> None:
            self._finished_lanes = lanes_before + finished
            if self.progress:
                self.progress(self._finished_lanes, max(self.total_lanes, self._finished_lanes))

        result = sweep(
            study,
            self.path_of(name),
            progress=update,
            devices=self.devices,
            overwrite=self.overwrite,
            backend=self.backend,
            scheduler=self.cluster,
        )
        self.fallback_reasons |= dict.fromkeys(result.fallback_reasons)
        self.cost = {key: value + result.cost[key] for key, value in self.cost.items()}
        return result

    def run_trials(self, tables: JsonObject, name: str, trials: pd.DataFrame, metrics: Sequence[str]) -> NamedArrays:
        """Run trials as one stage.

        Args:
            tables: of the stage's study, without axes.
            name: of the stage.
            trials: values by path, a row for each trial; equal ones are run once.
            metrics: columns that are wanted.

        Returns:
            Metrics by name, shape (trials, seeds).
        """
        paths = list(trials)
        study = tables | {"axes": list_axes({"trial": trials.drop_duplicates().to_dict("list")})}
        frame = self.run(study, name).read([*paths, "seed", *metrics])
        runs = trials.assign(row=range(len(trials))).merge(frame, on=paths).sort_values(["row", "seed"])
        return {metric: runs[metric].to_numpy(float).reshape(len(trials), -1) for metric in metrics}

    def repeat_runs(self, tables: JsonObject, rows: pd.DataFrame, *names: str) -> pd.DataFrame:
        """Repeat runs beside the stages, with the fastest backend. They overwrite earlier ones in the same place.

        Nobody knows beforehand how many of these there are: the progress counts the runs of each.

        Args:
            tables: of the study.
            rows: values by path, and `seed` where the study has several, a row for each run.
            *names: of the study, in the folder.

        Returns:
            The rows with their metrics.
        """
        announce(f"repeating runs ({', '.join(names)})")
        points = rows.drop(columns="seed", errors="ignore").drop_duplicates()
        study = tables | {"axes": list_axes({"runs": points.to_dict("list")})}
        frame = sweep(study, self.path_of(*names), progress=self.progress, devices=self.devices, overwrite=True).frame
        runs = rows.merge(frame)
        assert len(runs) == len(rows), "a run was not repeated"
        return runs
