"""A study's folder: resolved config, manifest, and one Parquet file for each chunk. Other studies are never overwritten."""

import hashlib
import json
import os
import platform
import shutil
import tempfile
import tomllib
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import jax
import numpy as np
import pandas as pd

from jaxbl.chain import NamedArrays
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
from .parts import Damaged, PartHeader
from .programs import Backend, Layout

if TYPE_CHECKING:
    from pyarrow.dataset import Dataset

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
    asked = {} if command == "simulate" else {command: identity(config, command)}
    return claim_folder(folder, study_subject(config), overwrite=overwrite, identities=asked, recover=_recover_study)


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
        with suppress(Damaged, FileNotFoundError):
            study, layout, backend, _ = parts.read_part(path, ())[0]
            subject = Subject("study", study["title"] or "untitled", study["single_run"])
            entry = {"identity": study["identity"], "layout": layout, "backend": backend, "files": {}, "folders": FOLDERS}
            return ResultFolder(folder, subject, {"sweep": entry})
    return None


@contextmanager
def _report_damage(part: Path) -> Iterator[None]:
    """Raise `InputError` with a remedy if a part that is read inside is damaged."""
    try:
        yield
    except Damaged as damage:
        raise InputError(
            f"{part}: is damaged ({damage}); run 'jaxbl sweep' again, which moves it to damaged/ and computes it anew"
        ) from None


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
    def create(
        cls, results: ResultFolder, config: Config, layout: Layout, backend: Backend, chunks: int, rows: int
    ) -> "Store":
        """Open the store in a claimed folder (:func:`claim_study`), or create it.

        Args:
            results: claimed folder.
            config: the study.
            layout: seeds and points of a chunk, if no part exists.
            backend: backend of all chunks, if no part exists.
            chunks: number of chunks.
            rows: number of rows of all chunks.
        """
        folder = results.path
        before = results.entries.get("sweep", {})
        text = config.to_toml()
        results.entries["sweep"] = {
            "layout": layout._asdict(),
            "backend": backend,
            "parts": chunks,
            "rows": rows,
            "finished": False,
            "versions": {name: version(name) for name in ("jaxbl", "jax", "equinox", "llvmlite", "numpy")},
            "machine": {"system": platform.system(), "processor": platform.machine(), "cores": os.cpu_count()},
            **before,
            **study_head(config),
            "files": {STUDY: checksum(text.encode())},
            "folders": FOLDERS,
        }
        # the manifest first: it reserves the folder for this study
        results.write_manifest()
        if not is_remote(folder):
            (folder / "points").mkdir(exist_ok=True)
        write_atomic(folder / STUDY, text)
        return cls(results)

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

    def has_part(self, index: int) -> bool:
        """True if the part of a chunk is stored and whole; a damaged one is moved to `damaged/`.

        Raises:
            InputError: the part is of another study.
        """
        path = self.part_path(index)
        try:
            self._check_header(path, parts.read_part(path, ())[0], index)
        except FileNotFoundError:
            return False
        except Damaged as damage:
            self._move_to_damaged(path, str(damage))
            return False
        return True

    def _check_header(self, path: Path, header: PartHeader, index: int) -> None:
        """Check that a part is of this study and of this chunk. Raises `InputError` or `Damaged`."""
        if any(header.study.get(name) != self.manifest[name] for name in ("identity", "single_run")):
            raise InputError(
                f"{path}: is of another study ('{header.study.get('title') or 'untitled'}', other numbers); move it away, "
                "and run 'jaxbl sweep' again, which computes this part"
            )
        if header.chunk != index or header.layout != self.manifest["layout"]:
            raise Damaged(f"is part {header.chunk} of this study")

    def _move_to_damaged(self, path: Path, damage: str) -> None:
        """Move a damaged file to `damaged/`, under a name that is free there."""
        folder = self.folder / "damaged"
        names = (path.name if i == 0 else f"{path.name}.{i}" for i in count())
        target = next(folder / name for name in names if not (folder / name).exists())
        move_file(path, target)
        self.damaged.append(f"{path.relative_to(self.folder)} {damage}; it is kept as {target.relative_to(self.folder)}")

    def write_part(self, index: int, frame: pd.DataFrame) -> None:
        """Write the rows of a chunk. The store itself does not change, so that this may run in another thread."""
        head = {name: self.manifest[name] for name in ("identity", "single_run", "title")}
        parts.write_part(self.part_path(index), frame, PartHeader(head, self.manifest["layout"], self.backend, index))

    def list_part_files(self) -> list[Path]:
        """All files among the parts, whole or damaged, in the order of their indices."""
        # names with six digits come after those with five
        return sorted(list_paths(self.folder / "points", "part-*.parquet"), key=lambda path: (len(path.name), path.name))

    def read_part(self, index: int, labels: NamedArrays, columns: list[str]) -> pd.DataFrame | None:
        """Read columns of a chunk; None if the part cannot be read, or has other rows than `labels` (columns by name)."""
        try:
            _, frame = parts.read_part(self.part_path(index), [*labels, *columns])
        except (Damaged, OSError):
            return None
        same_rows = all(np.array_equal(frame[name].to_numpy(), column) for name, column in labels.items())
        return frame if same_rows else None

    def raise_totals(self, parts: int, rows: int) -> None:
        """Set the numbers of parts and rows of a refined study if they have grown."""
        if rows > self.manifest["rows"]:
            self.update_manifest(parts=parts, rows=rows)

    def restore_part_count(self) -> None:
        """Raise the number of parts in the manifest to that of the files, its only record if the manifest was lost."""
        part_count = max(self._split_files()[0], default=-1) + 1
        if part_count > self.manifest["parts"]:
            self.update_manifest(parts=part_count)

    def set_final_totals(self, parts: int, rows: int) -> None:
        """Set the numbers of parts and rows of a refined study that is computed, and remove parts beyond them."""
        if (self.manifest["parts"], self.manifest["rows"]) != (parts, rows):
            self.update_manifest(parts=parts, rows=rows)
        for index, path in self._split_files()[0].items():
            if index >= parts:
                path.unlink()

    def _split_files(self) -> tuple[dict[int, Path], list[Path]]:
        """The files among the parts: those named as parts, by index, and all others."""
        indexed: dict[int, Path] = {}
        foreign = []
        for path in self.list_part_files():
            number = path.stem.removeprefix("part-")
            if number.isdecimal() and path == self.part_path(int(number)):
                indexed[int(number)] = path
            else:
                foreign.append(path)
        return indexed, foreign

    def checked_parts(self) -> dict[int, Path]:
        """Files of the stored parts by index. Raises `InputError` if a file among them is not a part of this study."""
        indexed, foreign = self._split_files()
        for path in [*foreign, *(path for index, path in indexed.items() if index >= self.manifest["parts"])]:
            raise InputError(f"{path}: is no part of this study, which has {self.manifest['parts']}; move it away")
        return indexed

    def _parts_to_read(self) -> dict[int, Path]:
        """The :meth:`checked_parts`. Raises `InputError` if no part is stored."""
        indexed = self.checked_parts()
        if not indexed:
            raise InputError(f"{self.folder}: holds no points yet; wait for the sweep that runs in it, or run 'jaxbl sweep'")
        return indexed

    def columns(self) -> list[str]:
        """Names of the columns."""
        return list(next(self.batches()).columns)

    def batches(self, columns: list[str] | None = None) -> Iterator[pd.DataFrame]:
        """Yield the rows of the stored parts, part by part; all columns, or only those named.

        Each file is compared with its checksum when it is read first, and each page whenever it is read.

        Raises:
            InputError: a part is damaged, or not of this study.
        """
        for index, part in self._parts_to_read().items():
            with _report_damage(part):
                header, frame = parts.read_part(self._local_copy(part), columns, check=index not in self._checked)
                self._check_header(part, header, index)
            self._checked.add(index)
            yield frame

    def dataset(self, check: bool) -> "Dataset":
        """The rows of the stored parts as a dataset of pyarrow, which compares each page that it reads with its checksum.

        Args:
            check: first compare each file with its checksum; otherwise only headers are read.

        Raises:
            InputError: a part is damaged, or not of this study.
        """
        from pyarrow import dataset

        indexed = self._parts_to_read()
        for index, part in indexed.items():
            with _report_damage(part):
                self._check_header(part, parts.read_part(part, (), check=check)[0], index)
        file_format = dataset.ParquetFileFormat(
            default_fragment_scan_options=dataset.ParquetFragmentScanOptions(page_checksum_verification=True)
        )
        paths: Any = [*indexed.values()]
        file_system = paths[0].fs if is_remote(paths[0]) else None
        names = [str(path.path if file_system else path) for path in paths]
        return cast("Dataset", dataset.dataset(names, format=file_format, filesystem=file_system))

    def _local_copy(self, part: Path) -> Path:
        """Path of a part on this machine; a part in an object store is copied here once, since a report reads it often."""
        if not is_remote(part):
            return part
        if self._copy_folder is None:
            self._copy_folder = Path(tempfile.mkdtemp())
            weakref.finalize(self, shutil.rmtree, self._copy_folder, ignore_errors=True)
        copy = self._copy_folder / part.name
        if not copy.exists():
            copy.write_bytes(part.read_bytes())
        return copy

    def verify(self) -> int:
        """Read all stored parts, move damaged ones to `damaged/`, and return the number of whole ones.

        Raises:
            InputError: a part is of another study, or has an index that this study does not have.
        """
        whole_parts = sum(map(self.has_part, self._parts_to_read()))
        if self.damaged:
            self.manifest["finished"] = False
        self.update_manifest()
        return whole_parts
