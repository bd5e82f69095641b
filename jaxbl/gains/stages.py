"""A command that runs several studies, one after the other: their folder, backend, progress and cost."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import pandas as pd

from jaxbl.cluster import Cluster, Scheduler, connect
from jaxbl.config import Config
from jaxbl.errors import InputError
from jaxbl.files import (
    json_with_checksum,
    lock_folder,
    make_folder,
    read_json,
    remove_if_empty_on_error,
    to_path,
    write_atomic,
)
from jaxbl.sweeps import parts
from jaxbl.sweeps.programs import Backend, check_backend, share_programs
from jaxbl.sweeps.store import claim_folder, manifest_head
from jaxbl.sweeps.sweep import StudyResult, sweep
from jaxbl.workers import Progress


@contextmanager
def stages_in(
    config: Config, command: str, out: str | Path | None, scheduler: Scheduler, **given: Any
) -> "Iterator[Stages]":
    """Stages in a folder that no other process writes into, with a cluster if there is one; `given` as of :class:`Stages`.

    Raises:
        InputError: as of :class:`Stages`; another process writes into the folder, or there is no such cluster.
    """
    with ExitStack() as held:
        if out is not None:
            held.enter_context(remove_if_empty_on_error(to_path(out)))
            held.enter_context(lock_folder(to_path(out)))
        held.enter_context(share_programs())
        yield Stages(config, command, out, cluster=held.enter_context(connect(scheduler)), **given)


class Stages:
    """The studies of `tune` or `verify`, kept in the folder `out`/`command`; without `out` nothing is kept.

    Raises:
        InputError: the folder holds something else, or was begun with another backend: all of it is by one.
    """

    def __init__(
        self,
        config: Config,
        command: str,
        out: str | Path | None = None,
        progress: Progress | None = None,
        devices: list[Any] | None = None,
        overwrite: bool = False,
        backend: Backend | None = None,
        cluster: Cluster | None = None,
    ):
        self.folder: Path | None = None
        self._cluster = cluster
        self.devices = devices
        self.found: dict[str, Any] = {}
        """The manifest that an earlier call left."""
        self.total = 0
        """Lanes of all stages."""
        self.fallback_reasons: dict[str, None] = {}
        """What the fused loop did not know of runs that were scanned in its place."""
        self.cost = {"compile_seconds": 0.0, "run_seconds": 0.0, "lanes": 0.0}
        self._config, self._command, self._progress, self._overwrite = config, command, progress, overwrite
        self._backend: Backend | None = check_backend(backend)
        self._done = 0
        self._unsure = False
        """The manifest is damaged: written anew once a stage has not been refused, as the folder is this study's then."""
        self._kept: dict[str, Any] = {}
        if out is None:
            return
        claim_folder(to_path(out), config, command, overwrite=overwrite)
        self.folder = to_path(out) / command
        if (self.folder / "manifest.json").exists():
            try:
                self.found = read_json(self.folder / "manifest.json")
            except InputError:
                self._unsure = True
                return
            begun = self.found.get("backend")
            if backend not in (None, begun):
                how = f"with --backend {begun}; go on with that" if begun else "without --backend; go on without it"
                raise InputError(f"{out}: was begun {how}, or choose another folder with --out")
            self._backend = check_backend(begun)

    def keep(self, **found: Any) -> None:
        """Write the manifest, which makes the folder this study's, with something that was found before the stages."""
        if self.folder is not None:
            self._kept = found
            if self._unsure:
                return
            make_folder(self.folder)
            manifest = manifest_head(self._config, self._command) | found | {"backend": self._backend}
            write_atomic(self.folder / "manifest.json", json_with_checksum(manifest))

    def place(self, *names: str) -> Path | None:
        """A path in the folder, if there is one."""
        return None if self.folder is None else self.folder.joinpath(*names)

    def table(self, name: str, compute: Callable[[], pd.DataFrame]) -> pd.DataFrame:
        """A table from its file, or computed and kept there; one that is damaged is computed anew.

        Raises:
            InputError: the file is of another study.
        """
        path, head = self.place(name), manifest_head(self._config, self._command)
        if path is None:
            return compute()
        with suppress(FileNotFoundError, parts.Damaged):
            mark, frame = parts.read_part(path)
            if mark.study.get("identity") != head["identity"]:
                raise InputError(f"{path}: is of another study; choose another folder with --out, or --overwrite")
            return frame
        frame = compute()
        if not self._unsure:
            parts.write_part(path, frame, parts.PartHeader(head, {}, "", 0, 0, {}))
        return frame

    def run(self, study: Config | dict[str, Any], name: str) -> StudyResult:
        """Run a stage, or go on with it."""
        before = self._done

        def update(finished: int, _: int) -> None:
            self._done = before + finished
            if self._progress:
                self._progress(self._done, max(self.total, self._done))

        result = sweep(
            study,
            self.place(name),
            progress=update,
            devices=self.devices,
            overwrite=self._overwrite,
            backend=self._backend,
            scheduler=self._cluster,
        )
        if self._unsure:
            self._unsure = False
            self.keep(**self._kept)
        self.fallback_reasons |= dict.fromkeys(result.fallback_reasons)
        self.cost = {key: value + result.cost[key] for key, value in self.cost.items()}
        return result

    def rerun(self, study: Config | dict[str, Any], *names: str) -> pd.DataFrame:
        """Runs besides the stages, by the backend that is faster for them; other ones in their place are removed."""
        return sweep(study, self.place(*names), devices=self.devices, overwrite=True).frame
