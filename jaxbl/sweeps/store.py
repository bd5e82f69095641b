"""A study's folder: resolved config, manifest, and one Parquet file for each chunk. Other studies are never overwritten."""

import hashlib
import json
import os
import platform
import shutil
import tempfile
import tomllib
import weakref
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import jax
import numpy as np
import pandas as pd

from jaxbl.config import Config, read_config
from jaxbl.errors import InputError
from jaxbl.files import (
    MANIFEST,
    DamagedFile,
    ResultFolder,
    Subject,
    checksum,
    claim_folder,
    is_remote,
    list_paths,
    move_file,
    write_atomic,
)
from jaxbl.json_types import JsonObject

from . import parts
from .parts import PartHeader
from .programs import Backend, Layout

if TYPE_CHECKING:
    from pyarrow.dataset import Dataset

    from .engine import Engine

STUDY, FOLDERS = "study.toml", ("points", "damaged")
"""Names in a study's folder: of its config, and of the folders with its parts."""
_IGNORED_KEYS = {
    # keys of the config that decide none of the numbers of a command
    "simulate": ("axes", "sweep", "verify", "tune"),
    "sweep": ("verify", "tune"),
    "verify": ("tune",),
    "tune": ("axes", "verify"),
}


def identity(config: Config, command: str = "sweep") -> str:
    """Hash of everything that decides the numbers that a command finds for a study.

    Title, notes, figures, chunk size, and tables and keys that only other commands read decide nothing.
    """
    data = config.to_dict()
    data["sweep"].pop("chunk", None)
    if data["sweep"].pop("metrics", None) is not None and command == "sweep":
        data["sweep"]["metrics"] = config.sweep.requested_metrics
    for key in ("title", "notes", "figures", "identify", *_IGNORED_KEYS[command]):
        data.pop(key, None)
    for key in ("q", "marks"):
        # conditions are judged and marks drawn anew each time
        data.get("verify", {}).pop(key, None)
    _name_by_content(data["excitation"], config.excitation)
    _name_by_content(data.get("reference"), config.reference)
    if config.tune is not None and "holdout" in data.get("tune", {}):
        _name_by_content(data["tune"]["holdout"], config.tune.holdout)
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def _name_by_content(data: Any, signal: Any) -> None:
    """Replace the file name of a recorded signal by a hash of its samples, since the file's path decides no number."""
    if signal is not None and signal.kind == "recorded":
        arrays = (leaf.tobytes() for leaf in jax.tree.leaves(signal.build()) if isinstance(leaf, np.ndarray))
        data["file"] = hashlib.sha256(b"".join(arrays)).hexdigest()


def study_subject(config: Config) -> Subject:
    """Return the subject of commands on a study: all that compute with the numbers of one study may share a folder."""
    return Subject("study", config.title or "untitled", identity(config, "simulate"))


def study_head(config: Config, command: str = "sweep") -> JsonObject:
    """Return the entries by which parts name their study: identities for a command and a single run, title."""
    return {"identity": identity(config, command), "single_run": identity(config, "simulate"), "title": config.title}


def claim_study(folder: Path, config: Config, command: str = "sweep", *, overwrite: bool = False) -> ResultFolder:
    """Claim a locked folder for a command on a study (:func:`jaxbl.files.claim_folder`)."""
    asked = command, identity(config, command)
    return claim_folder(folder, study_subject(config), overwrite=overwrite, asked=asked, recover=_recover_study)


def load_config(folder: Path) -> Config:
    """Read the study of a folder. Raises `InputError` if it is damaged."""
    results = None
    # a damaged manifest says nothing of it
    with suppress(InputError):
        results = ResultFolder.read(folder)
    path = folder / STUDY if results is None else results.check_file(STUDY)
    # included files are merged into it, so that it can be read from its text
    return read_config(tomllib.loads(path.read_text()) if is_remote(path) else path)


def _recover_study(folder: Path) -> ResultFolder | None:
    """Return the folder of a study whose manifest is lost or damaged, by its first whole part; None without one."""
    for path in list_paths(folder / "points", "part-*.parquet"):
        with suppress(DamagedFile, FileNotFoundError):
            study, layout, backend, _ = parts.read_part(path, ())[0]
            subject = Subject("study", study["title"] or "untitled", study["single_run"])
            entry = study | {"layout": layout, "backend": backend, "finished": False, "files": {}, "folders": FOLDERS}
            return ResultFolder(folder, subject, {"sweep": entry})
    return None


class Store:
    """The folder of a study: its parts are the truth, and its entry in the manifest is made anew from them if it is lost.

    Attributes:
        results: the folder with its manifest.
        folder: path of the folder.
        manifest: entry of the study in the manifest.
        damaged: a sentence for each damaged part that was moved to `damaged/`.
    """

    def __init__(self, results: ResultFolder):
        self.results, self.folder = results, results.path
        self.manifest: JsonObject = results.entries["sweep"]
        self.damaged: list[str] = []
        self._checked: set[int] = set()
        self._copy_folder: Path | None = None

    @classmethod
    def create(cls, folder: Path, engine: "Engine", *, overwrite: bool = False) -> "Store":
        """Create the store of an engine's study in a locked folder (:func:`jaxbl.files.lock_folder`), or open it.

        The engine gets the layout and backend of a store that exists: chunks keep the shape that they had when the store was
        created, on any machine. With `overwrite`, results of other studies are removed from the folder.

        Raises:
            InputError: the folder holds another study, or a store of another backend than the engine requires.
        """
        config = engine.config
        results = claim_study(folder, config, overwrite=overwrite)
        before, text = results.entries.get("sweep", {}), config.to_toml()
        if before:
            cls(results).set_layout_of(engine)
        results.entries["sweep"] = {
            "layout": engine.layout._asdict(),
            "backend": engine.backend,
            "parts": len(engine),
            "rows": engine.rows,
            "finished": False,
            "versions": {name: version(name) for name in ("jaxbl", "jax", "equinox", "llvmlite", "numpy")},
            "machine": {"system": platform.system(), "processor": platform.machine(), "cores": os.cpu_count()},
            **before,
            **study_head(config),
            "files": {STUDY: checksum(text.encode())},
            "folders": FOLDERS,
        }
        store = cls(results)
        if engine.points.refinement is not None:
            # the files are the only record of how many parts there were if the manifest was lost
            last = max(store.list_part_files().values(), default=-1)
            store.manifest["parts"] = max(store.manifest["parts"], last + 1)
        # the manifest first: it reserves the folder for this study
        results.write_manifest()
        if not is_remote(folder):
            (folder / "points").mkdir(exist_ok=True)
        write_atomic(folder / STUDY, text)
        return store

    @classmethod
    def open(cls, folder: Path) -> "Store":
        """Open the store in a folder. Raises `InputError` if there is none."""
        try:
            results = ResultFolder.read(folder)
            lost = "has lost its"
        except DamagedFile:
            results, lost = None, "has a damaged"
        if results is not None and "sweep" in results.entries:
            return cls(results)
        if _recover_study(folder) is not None:
            raise InputError(f"{folder}: {lost} {MANIFEST}; 'jaxbl repair {folder}' writes it anew from the parts")
        raise InputError(f"{folder}: holds no study (no {MANIFEST} of a sweep); run 'jaxbl sweep' first")

    def set_layout_of(self, engine: "Engine") -> None:
        """Have an engine compute chunks of the store's layout by its backend. Raises `InputError` if it requires another."""
        if engine.require_backend and self.backend != engine.backend and not self.manifest["finished"]:
            raise InputError(
                f"{self.folder}: was begun with --backend {self.backend}; go on with that, or choose another folder with "
                "--out"
            )
        engine.use_layout(self.layout, self.backend)

    @property
    def layout(self) -> Layout:
        return Layout(**self.manifest["layout"])

    @property
    def backend(self) -> Backend:
        """Backend of all chunks, except in groups that the fused loop does not support."""
        return self.manifest["backend"]

    def update_manifest(self, **entries: Any) -> None:
        """Set entries of the study in the manifest and write it."""
        self.manifest.update(entries)
        self.results.write_manifest()

    def part_path(self, index: int) -> Path:
        return self.folder / "points" / f"part-{index:05d}.parquet"

    def list_part_files(self) -> dict[Path, int]:
        """All files among the parts, whole or damaged, with their indices by their names; -1 if no part has that name."""
        indices = {}
        for path in list_paths(self.folder / "points", "part-*.parquet"):
            number = path.stem.removeprefix("part-")
            is_part = number.isdecimal() and path == self.part_path(int(number))
            indices[path] = int(number) if is_part else -1
        return indices

    def list_indices(self) -> list[int]:
        """Indices of the stored parts. Raises `InputError` if a file among them is not a part of this study."""
        indices = self.list_part_files()
        for path, index in indices.items():
            if not 0 <= index < self.manifest["parts"]:
                raise InputError(f"{path}: is no part of this study, which has {self.manifest['parts']}; move it away")
        return sorted(indices.values())

    def write_part(self, index: int, frame: pd.DataFrame) -> None:
        """Write the rows of a chunk. The store itself does not change, so that this may run in another thread."""
        head = {name: self.manifest[name] for name in ("identity", "single_run", "title")}
        parts.write_part(self.part_path(index), frame, PartHeader(head, self.manifest["layout"], self.backend, index))

    def read_part(self, index: int, columns: Sequence[str]) -> pd.DataFrame | None:
        """Read columns of a chunk; None if its part is not stored. A damaged one is moved to `damaged/`. Raises `InputError`
        if the part is of another study."""
        path, folder = self.part_path(index), self.folder / "damaged"
        try:
            return self._read(index, columns)
        except FileNotFoundError:
            return None
        except DamagedFile as damage:
            names = (f"{path.name}.{i}" if i else path.name for i in count())
            target = next(folder / name for name in names if not (folder / name).exists())
            move_file(path, target)
            self.damaged.append(f"points/{path.name} {damage.reason}; it is kept as damaged/{target.name}")
            return None

    def _read(
        self, index: int, columns: Sequence[str] | None, *, check: bool = True, copy: Path | None = None
    ) -> pd.DataFrame:
        """Read columns of a chunk from its file or a copy. Raises `InputError` if it is of another study, else as
        `parts.read_part`."""
        part = self.part_path(index)
        header, frame = parts.read_part(copy or part, columns, check=check)
        if header.study.get("identity") != self.manifest["identity"]:
            title = header.study.get("title") or "untitled"
            raise InputError(
                f"{part}: is of another study ('{title}', other numbers); move it away, and run 'jaxbl "
                "sweep' again, which computes this part"
            )
        if header.chunk != index or header.layout != self.manifest["layout"]:
            raise DamagedFile(part, f"is part {header.chunk} of this study", parts.RECOMPUTE)
        return frame

    def set_totals(self, parts: int, rows: int, *, final: bool = False) -> None:
        """Set the numbers of parts and rows of a refined study that have grown or are final; remove parts beyond these."""
        if final or rows > self.manifest["rows"]:
            self.update_manifest(parts=parts, rows=rows)
        if final:
            for path, index in self.list_part_files().items():
                if index >= parts:
                    path.unlink()

    def columns(self) -> list[str]:
        """Names of the columns."""
        return list(next(self.batches()).columns)

    def batches(self, columns: list[str] | None = None) -> Iterator[pd.DataFrame]:
        """Yield the rows of the stored parts, part by part; all columns, or only those named.

        Each file is compared with its checksum when it is read first, and each page whenever it is read. Raises
        `InputError` if a part is damaged, or not of this study."""
        for index in self._indices_to_read():
            frame = self._read(index, columns, check=index not in self._checked, copy=self._local_copy(index))
            self._checked.add(index)
            yield frame

    def _indices_to_read(self) -> list[int]:
        """The :meth:`list_indices`. Raises `InputError` if no part is stored."""
        indices = self.list_indices()
        if not indices:
            raise InputError(f"{self.folder}: holds no points yet; wait for the sweep that runs in it, or run 'jaxbl sweep'")
        return indices

    def dataset(self, check: bool) -> "Dataset":
        """The rows of the stored parts as a dataset of pyarrow, which compares each page that it reads with its checksum.

        With `check`, each file is first compared with its checksum; otherwise only headers are read. Raises as
        :meth:`batches`."""
        from pyarrow import dataset

        indices = self._indices_to_read()
        for index in indices:
            self._read(index, (), check=check)
        file_format = dataset.ParquetFileFormat(
            default_fragment_scan_options=dataset.ParquetFragmentScanOptions(page_checksum_verification=True)
        )
        paths: Any = [*map(self.part_path, indices)]
        file_system = paths[0].fs if is_remote(paths[0]) else None
        names = [str(path.path if file_system else path) for path in paths]
        return cast("Dataset", dataset.dataset(names, format=file_format, filesystem=file_system))

    def _local_copy(self, index: int) -> Path:
        """Path of a part on this machine; a part in an object store is copied here once, since a report reads it often."""
        part = self.part_path(index)
        if not is_remote(part):
            return part
        if self._copy_folder is None:
            self._copy_folder = Path(tempfile.mkdtemp())
            weakref.finalize(self, shutil.rmtree, self._copy_folder, ignore_errors=True)
        copy = self._copy_folder / part.name
        if not copy.exists():
            copy.write_bytes(parts.read_checked(part))
        return copy

    def verify(self) -> int:
        """Read all stored parts, move damaged ones to `damaged/`, and return the number of whole ones. Raises `InputError`
        if a part is of another study, or has an index that this study does not have."""
        whole_parts = sum(self.read_part(index, ()) is not None for index in self._indices_to_read())
        if self.damaged:
            self.update_manifest(finished=False)
        return whole_parts
