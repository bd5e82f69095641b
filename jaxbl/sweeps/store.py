"""A study's folder: resolved config, manifest, and one Parquet file for each chunk. Other studies are never overwritten."""

import hashlib
import json
import os
import platform
import shutil
import tempfile
import time
import tomllib
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pandas as pd

from jaxbl.chain import NamedArrays
from jaxbl.config import Config, read_config
from jaxbl.errors import InputError
from jaxbl.files import (
    LOG_RESULTS,
    FolderInUse,
    create_file,
    has_file,
    is_empty,
    is_remote,
    json_with_checksum,
    list_paths,
    make_folder,
    read_json,
    read_log_path,
    remove,
    remove_drafts,
    rename_file,
    write_atomic,
)
from jaxbl.json_types import JsonObject

from . import parts
from .parts import Damaged, PartHeader
from .programs import Backend, Layout

if TYPE_CHECKING:
    from pyarrow.dataset import Dataset

FORMAT = 4
"""Format of the manifest; it is raised when older versions cannot read a new one."""

_COMMANDS = {
    # command: the marker file that names its study; its other results; keys of the config that decide none of its numbers
    "simulate": ("summary.json", ("trace.parquet",), ("axes", "sweep", "verify", "tune")),
    "sweep": ("manifest.json", ("study.toml", "points", "laws.json", "damaged"), ("verify", "tune")),
    "verify": ("verify/manifest.json", ("verdict.json", "counterexamples.parquet", "verify"), ("tune",)),
    "tune": ("tune/manifest.json", ("gains.toml", "tuning.json", "tune"), ("axes", "verify")),
}
_COMMON_RESULTS = "figures", "report.html"
_SAVE_INTERVAL = 10.0
"""Least time between two writes of the manifest while chunks are computed, s; parts have headers, so that none is lost."""


def identity(config: Config, command: str = "sweep") -> str:
    """Hash of everything that decides the numbers that a command finds for a study.

    Title, notes, figures, chunk size, and tables and keys that only other commands read decide nothing.
    """
    data = config.to_dict()
    data["sweep"].pop("chunk", None)
    if data["sweep"].pop("metrics", None) is not None and command == "sweep":
        data["sweep"]["metrics"] = config.sweep.requested_metrics
    for key in ("title", "notes", "figures", "identify", *_COMMANDS[command][2]):
        data.pop(key, None)
    for key in ("q", "marks"):
        # conditions are judged and marks drawn anew each time
        data.get("verify", {}).pop(key, None)
    _name_by_content(data["excitation"], config.excitation)
    if config.tune is not None and "holdout" in data.get("tune", {}):
        _name_by_content(data["tune"]["holdout"], config.tune.holdout)
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def _name_by_content(data: JsonObject, excitation: Any) -> None:
    """Replace the file name of a recorded input by a hash of its samples, since the file's path decides no number."""
    if excitation.kind == "recorded":
        record = excitation.build()
        data["file"] = hashlib.sha256(record.times.tobytes() + record.torques.tobytes()).hexdigest()


def manifest_head(config: Config, command: str) -> JsonObject:
    """The first entries of a command's manifest: identity of the study for it and for a single run, and title."""
    return {"identity": identity(config, command), "single_run": identity(config, "simulate"), "title": config.title}


def claim_folder(
    folder: Path, config: Config, command: str = "sweep", *, overwrite: bool = False, exclusive: bool = True
) -> None:
    """Check that a command may write its results for a study into a folder, and make the folder.

    All commands of one study may share a folder.

    Args:
        folder: folder of the results.
        config: the study.
        command: command that writes.
        overwrite: remove the results of other studies from the folder.
        exclusive: no other process writes there, so that drafts of killed processes are removed.

    Raises:
        InputError: the folder holds another study or other files, or cannot be written to.
    """
    make_folder(folder)
    heads, own_is_damaged = {}, False
    for marker_command, (marker, _, _) in _COMMANDS.items():
        if (folder / marker).exists():
            try:
                heads[marker_command] = read_json(folder / marker)
            except InputError:
                if marker_command == command != "sweep" and not overwrite:
                    # the stages of the command are studies, which have headers (:class:`jaxbl.gains.stages.Stages`)
                    own_is_damaged = True
                    continue
                header = _read_first_header(folder) if marker_command == "sweep" else None
                if header is None and not overwrite:
                    raise
                heads[marker_command] = {} if header is None else header.study
        elif marker_command == "sweep" and (header := _read_first_header(folder)) is not None:
            heads[marker_command] = header.study
    # an empty head is that of a damaged marker, which belongs to a study
    if any(head and "single_run" not in head for head in heads.values()):
        raise InputError(f"{folder}: holds files that are not of a study; choose another folder with --out")
    matches = [head.get("single_run") == identity(config, "simulate") for head in heads.values()]
    if command != "simulate" and command in heads:
        matches.append(heads[command].get("identity") == identity(config, command))
    if all(matches) and (heads or own_is_damaged or is_empty(folder)):
        if exclusive:
            remove_drafts(folder)
        return
    if not heads:
        for file in (folder / name for name in LOG_RESULTS if (folder / name).exists()):
            log = read_log_path(file)
            log = f"see {file.name}" if log is None else f"'{Path(log).name}'"
            raise InputError(f"{folder}: holds the results of a log ({log}); choose another folder with --out")
        raise InputError(f"{folder}: is not empty and holds no study; choose another folder with --out")
    if not overwrite:
        title = next((head["title"] for head in heads.values() if head.get("title")), "untitled")
        raise InputError(
            f"{folder}: holds another study ('{title}', other numbers); choose another folder with --out, or --overwrite"
        )
    results = [name for marker, outputs, _ in _COMMANDS.values() for name in (marker, *outputs)]
    for name in (*results, *_COMMON_RESULTS):
        remove(folder / name)


def load_config(folder: Path) -> Config:
    """Read the study of a folder. Raises `InputError` if it is damaged."""
    path = folder / "study.toml"
    # included files are merged into it, so that it can be read from its text
    return read_config(tomllib.loads(path.read_text()) if is_remote(path) else path)


def _read_first_header(folder: Path) -> PartHeader | None:
    """The header of the first readable part in a folder; None without one."""
    for path in list_paths(folder / "points", "part-*.parquet"):
        try:
            return parts.read_header(path)
        except (Damaged, FileNotFoundError):
            continue
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
    """The folder of a study.

    Attributes:
        folder: path of the folder.
        manifest: entries of `manifest.json`; `checksums` has those of whole parts, by index.
        damaged: a sentence for each damaged part that was moved to `damaged/`.
        writes_manifest: True if this process writes the manifest while parts are added; only one does.
    """

    def __init__(self, folder: Path, manifest: JsonObject, *, writes_manifest: bool = True):
        self.folder = folder
        self.writes_manifest = writes_manifest
        self.manifest = manifest
        self.damaged: list[str] = []
        self._copy_folder: Path | None = None
        self._saved_at, self._save_interval = 0.0, _SAVE_INTERVAL

    @classmethod
    def create(cls, folder: Path, config: Config, layout: Layout, backend: Backend, chunks: int, rows: int) -> "Store":
        """Open the store in a claimed folder (:func:`claim_folder`), or create it.

        A manifest that is lost or damaged is written anew from the headers of the parts.

        Args:
            folder: claimed folder.
            config: the study.
            layout: seeds and points of a chunk, if no part exists.
            backend: backend of all chunks, if no part exists.
            chunks: number of chunks.
            rows: number of rows of all chunks.
        """
        store, has_manifest = None, (folder / "manifest.json").exists()
        if has_manifest:
            try:
                store = cls.open(folder)
            except InputError:
                if _read_first_header(folder) is None:
                    raise
        if store is None:
            header = _read_first_header(folder)
            manifest = {
                "format": FORMAT,
                **manifest_head(config, "sweep"),
                "layout": layout._asdict() if header is None else header.layout,
                "backend": backend if header is None else header.backend,
                "parts": chunks,
                "rows": rows,
                "finished": False,
                "versions": {name: version(name) for name in ("jaxbl", "jax", "equinox", "llvmlite", "numpy")},
                "machine": {"system": platform.system(), "processor": platform.machine(), "cores": os.cpu_count()},
                "checksums": {},
            }
            store = cls(folder, manifest)
        # the manifest first: it reserves the folder for this study
        if has_manifest:
            store.update_manifest()
        elif not create_file(folder / "manifest.json", json_with_checksum(store.manifest)):
            raise FolderInUse(f"{folder}: another process began a study there just now; run the same command again")
        if not is_remote(folder):
            (folder / "points").mkdir(exist_ok=True)
        write_atomic(folder / "study.toml", config.to_toml())
        return store

    @classmethod
    def open(cls, folder: Path, *, writes_manifest: bool = True) -> "Store":
        """Open the store in a folder. Raises `InputError` if there is none."""
        path = folder / "manifest.json"
        if not has_file(folder, path.name):
            if _read_first_header(folder) is not None:
                raise InputError(f"{folder}: has lost its manifest.json; 'jaxbl repair {folder}' writes it anew")
            raise InputError(f"{folder}: holds no study (no manifest.json); run 'jaxbl sweep' first")
        try:
            manifest = read_json(path)
        except InputError:
            if _read_first_header(folder) is None:
                raise
            raise InputError(f"{path}: is damaged; 'jaxbl repair {folder}' writes it anew from the parts") from None
        if manifest.get("format") != FORMAT:
            raise InputError(
                f"{path}: has format {manifest.get('format')}; this version reads {FORMAT}; read it with the jaxbl "
                "that wrote it, or sweep anew into another folder"
            )
        return cls(folder, manifest, writes_manifest=writes_manifest)

    @property
    def layout(self) -> Layout:
        return Layout(**self.manifest["layout"])

    @property
    def backend(self) -> Backend:
        """Backend of all chunks, except in groups that the fused loop does not support."""
        return self.manifest["backend"]

    @property
    def _head(self) -> JsonObject:
        return {name: self.manifest[name] for name in ("identity", "single_run")}

    def update_manifest(self, **entries: Any) -> None:
        """Set entries of the manifest and write it."""
        self.manifest |= entries
        start = time.monotonic()
        write_atomic(self.folder / "manifest.json", json_with_checksum(self.manifest))
        self._saved_at = time.monotonic()
        # with very many parts the manifest is long: writing it should take at most 1 % of the time
        self._save_interval = max(_SAVE_INTERVAL, 100.0 * (self._saved_at - start))

    def part_path(self, index: int) -> Path:
        return self.folder / "points" / f"part-{index:05d}.parquet"

    def has_part(self, index: int) -> bool:
        """True if the part of a chunk is stored and whole; a damaged one is moved to `damaged/`.

        Raises:
            InputError: the part is of another study.
        """
        path = self.part_path(index)
        if not path.exists():
            return False
        try:
            self._check_file(path, index)
        except Damaged as damage:
            self._move_to_damaged(path, str(damage))
            return False
        return True

    def _check_file(self, path: Path, index: int) -> None:
        """Check a part's file by its checksum in the manifest, or else by its header and columns.

        Raises:
            Damaged: the file is not what was written.
            InputError: the part is of another study.
        """
        checksum = self.manifest["checksums"].get(str(index))
        if checksum is None:
            header, _ = parts.read_part(path)
            self._check_header(path, header, index)
            self.manifest["checksums"][str(index)] = parts.file_checksum(path)
        elif parts.file_checksum(path) != checksum:
            raise Damaged("does not agree with its checksum in manifest.json")

    def _check_header(self, path: Path, header: PartHeader, index: int) -> None:
        """Check that a part is of this study and of this chunk. Raises `InputError` or `Damaged`."""
        if {name: header.study.get(name) for name in self._head} != self._head:
            raise InputError(
                f"{path}: is of another study ('{header.study.get('title') or 'untitled'}', other numbers); move it away, "
                "and run 'jaxbl sweep' again, which computes this part"
            )
        if header.chunk != index or header.layout != self.manifest["layout"]:
            raise Damaged(f"is part {header.chunk} of this study")

    def _move_to_damaged(self, path: Path, damage: str) -> None:
        """Move a damaged file to `damaged/`, under a name that is free there."""
        folder = self.folder / "damaged"
        if not is_remote(folder):
            folder.mkdir(exist_ok=True)
        names = (path.name if i == 0 else f"{path.name}.{i}" for i in count())
        target = next(folder / name for name in names if not (folder / name).exists())
        rename_file(path, target)
        self.damaged.append(f"{path.relative_to(self.folder)} {damage}; it is kept as {target.relative_to(self.folder)}")

    def write_part(self, index: int, frame: pd.DataFrame) -> str:
        """Write the rows of a chunk, and return the file's checksum for :meth:`add_checksums`.

        The store itself does not change, so that this may run in another thread.
        """
        head = self._head | {"title": self.manifest["title"]}
        path = self.part_path(index)
        parts.write_part(path, frame, PartHeader(head, self.manifest["layout"], self.backend, index, 0, {}))
        return parts.file_checksum(path)

    def add_checksums(self, checksums: dict[int, str]) -> None:
        """Add checksums of written parts, by index, to the manifest; write it from time to time."""
        self.manifest["checksums"] |= {str(index): checksum for index, checksum in checksums.items()}
        if self.writes_manifest and time.monotonic() - self._saved_at > self._save_interval:
            self.update_manifest()

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
                self.manifest["checksums"].pop(str(index), None)

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
        header = _read_first_header(self.folder)
        return list(header.columns) if header is not None else list(next(self.batches()).columns)

    def batches(self, columns: list[str] | None = None) -> Iterator[pd.DataFrame]:
        """Yield the rows of the stored parts, part by part; all columns, or only those named.

        Raises:
            InputError: a part is damaged, or not of this study.
        """
        for index, part in self._parts_to_read().items():
            with _report_damage(part):
                header, frame = parts.read_part(self._local_copy(part), columns)
                self._check_header(part, header, index)
            yield frame

    def dataset(self, check: bool) -> "Dataset":
        """The rows of the stored parts as a dataset of pyarrow, which compares each page that it reads with its checksum.

        Args:
            check: first compare each file with its checksum in the manifest; otherwise only headers are checked.

        Raises:
            InputError: a part is damaged, or not of this study.
        """
        from pyarrow import dataset

        indexed = self._parts_to_read()
        for index, part in indexed.items():
            with _report_damage(part):
                if check:
                    self._check_file(part, index)
                else:
                    self._check_header(part, parts.read_header(part), index)
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
        self.manifest["checksums"] = {}
        whole_parts = sum(map(self.has_part, self._parts_to_read()))
        if self.damaged:
            self.manifest["finished"] = False
        self.update_manifest()
        return whole_parts
