"""A study's folder: resolved config, manifest, one Parquet file per chunk; restart, and no overwriting of other studies."""

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

from . import parts
from .parts import Damaged, PartHeader
from .programs import Backend, Layout

if TYPE_CHECKING:
    from pyarrow.dataset import Dataset

FORMAT = 4
"""Of the manifest: raised where older versions could not read it."""

_COMMANDS = {
    # command: its marker, which says whose the folder is; what it leaves; keys of the config that decide none of its numbers
    "simulate": ("summary.json", ("trace.parquet",), ("axes", "sweep", "verify", "tune")),
    "sweep": ("manifest.json", ("study.toml", "points", "laws.json", "damaged"), ("verify", "tune")),
    "verify": ("verify/manifest.json", ("verdict.json", "counterexamples.parquet", "verify"), ("tune",)),
    "tune": ("tune/manifest.json", ("gains.toml", "tuning.json", "tune"), ("axes", "verify")),
}
_COMMON = "figures", "report.html"
_SAVED = 10.0
"""Seconds at least from one time that the manifest is written to the next while chunks are computed: parts know what they
are."""


def identity(config: Config, command: str = "sweep") -> str:
    """Hash of everything that decides the numbers that a command finds for a study.

    Title, notes, figures, chunk size, and tables and keys that only other commands read decide nothing.
    """
    data = config.resolved()
    data["sweep"].pop("chunk", None)
    if data["sweep"].pop("metrics", None) is not None and command == "sweep":
        data["sweep"]["metrics"] = config.sweep.requested_metrics
    for key in ("title", "notes", "figures", "identify", *_COMMANDS[command][2]):
        data.pop(key, None)
    for key in ("q", "marks"):
        # judged and drawn anew each time
        data.get("verify", {}).pop(key, None)
    _name_by_content(data["excitation"], config.excitation)
    if config.tune is not None and "holdout" in data.get("tune", {}):
        _name_by_content(data["tune"]["holdout"], config.tune.holdout)
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def _name_by_content(data: dict[str, Any], excitation: Any) -> None:
    """What was recorded counts, not where it lies."""
    if excitation.kind == "recorded":
        record = excitation.build()
        data["file"] = hashlib.sha256(record.times.tobytes() + record.torques.tobytes()).hexdigest()


def manifest_head(config: Config, command: str) -> dict[str, Any]:
    """What a command's manifest says of its study: its own identity, and that of the study's single run."""
    return {"identity": identity(config, command), "single_run": identity(config, "simulate"), "title": config.title}


def claim_folder(
    folder: Path, config: Config, command: str = "sweep", *, overwrite: bool = False, alone: bool = True
) -> None:
    """Make sure that a command may write its results for a study into a folder; make the folder.

    All commands of one study may share one folder. With `overwrite`, results of other studies are removed from it first;
    what killed processes left half written is removed if no other process writes there (`alone`).

    Raises:
        InputError: the folder holds another study or other files, or cannot be written to.
    """
    make_folder(folder)
    found, unsure = {}, False
    for other, (marker, _, _) in _COMMANDS.items():
        if (folder / marker).exists():
            try:
                found[other] = read_json(folder / marker)
            except InputError:
                if other == command != "sweep" and not overwrite:
                    # its stages are studies, which say whose they are (:class:`jaxbl.gains.stages.Stages`)
                    unsure = True
                    continue
                mark = _read_first_header(folder) if other == "sweep" else None
                if mark is None and not overwrite:
                    raise
                found[other] = {} if mark is None else mark.study
        elif other == "sweep" and (mark := _read_first_header(folder)) is not None:
            found[other] = mark.study
    # a damaged file of ours is read as an empty one above
    if any(data and "single_run" not in data for data in found.values()):
        raise InputError(f"{folder}: holds files that are not of a study; choose another folder with --out")
    same = [data.get("single_run") == identity(config, "simulate") for data in found.values()]
    if command != "simulate" and command in found:
        same.append(found[command].get("identity") == identity(config, command))
    if all(same) and (found or unsure or is_empty(folder)):
        if alone:
            remove_drafts(folder)
        return
    if not found:
        for file in (folder / name for name in LOG_RESULTS if (folder / name).exists()):
            log = read_log_path(file)
            log = f"see {file.name}" if log is None else f"'{Path(log).name}'"
            raise InputError(f"{folder}: holds the results of a log ({log}); choose another folder with --out")
        raise InputError(f"{folder}: is not empty and holds no study; choose another folder with --out")
    if not overwrite:
        title = next((data["title"] for data in found.values() if data.get("title")), "untitled")
        raise InputError(
            f"{folder}: holds another study ('{title}', other numbers); choose another folder with --out, or --overwrite"
        )
    left = [name for marker, outputs, _ in _COMMANDS.values() for name in (marker, *outputs)]
    for path in (folder / name for name in (*left, *_COMMON)):
        remove(path)


def load_config(folder: Path) -> Config:
    """The study of a folder. Raises `InputError` where it is damaged."""
    path = folder / "study.toml"
    # it stands alone: what it included is in it
    return read_config(tomllib.loads(path.read_text()) if is_remote(path) else path)


def _read_first_header(folder: Path) -> PartHeader | None:
    """What the first whole part in a folder says of itself."""
    for path in list_paths(folder / "points", "part-*.parquet"):
        try:
            return parts.read_header(path)
        except (Damaged, FileNotFoundError):
            continue
    return None


@contextmanager
def _report_damage(part: Path) -> Iterator[None]:
    """Around what reads a part: one line where it is damaged."""
    try:
        yield
    except Damaged as why:
        raise InputError(
            f"{part}: is damaged ({why}); run 'jaxbl sweep' again, which keeps it aside and computes it anew"
        ) from None


class Store:
    """The folder of one study.

    Attributes:
        folder: where it is.
        manifest: what is known of the study as a whole; `checksums` are those of whole parts, by index.
        damaged: parts that were kept aside, and why.
        keeps_manifest: whether it writes the manifest while parts are added; one process does.
    """

    def __init__(self, folder: Path, manifest: dict[str, Any], *, keeps_manifest: bool = True):
        self.folder = folder
        self.keeps_manifest = keeps_manifest
        self.manifest = manifest
        self.damaged: list[str] = []
        self._copies: Path | None = None
        self._saved, self._pause = 0.0, _SAVED

    @classmethod
    def create(cls, folder: Path, config: Config, layout: Layout, backend: Backend, chunks: int, rows: int) -> "Store":
        """Open a folder that this study may have (:func:`claim`), or take up the one that is there; a manifest that is lost
        or damaged is written anew by what the parts say."""
        store, there = None, (folder / "manifest.json").exists()
        if there:
            try:
                store = cls.open(folder)
            except InputError:
                if _read_first_header(folder) is None:
                    raise
        if store is None:
            mark = _read_first_header(folder)
            manifest = {
                "format": FORMAT,
                **manifest_head(config, "sweep"),
                "layout": layout._asdict() if mark is None else mark.layout,
                "backend": backend if mark is None else mark.backend,
                "parts": chunks,
                "rows": rows,
                "finished": False,
                "versions": {name: version(name) for name in ("jaxbl", "jax", "equinox", "llvmlite", "numpy")},
                "machine": {"system": platform.system(), "processor": platform.machine(), "cores": os.cpu_count()},
                "checksums": {},
            }
            store = cls(folder, manifest)
        # the manifest first: it is what makes the folder this study's
        if there:
            store.update()
        elif not create_file(folder / "manifest.json", json_with_checksum(store.manifest)):
            raise FolderInUse(f"{folder}: another process began a study there just now; run the same command again")
        if not is_remote(folder):
            (folder / "points").mkdir(exist_ok=True)
        write_atomic(folder / "study.toml", config.to_toml())
        return store

    @classmethod
    def open(cls, folder: Path, *, keeps_manifest: bool = True) -> "Store":
        """Open a study that is there. Raises `InputError` where there is none."""
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
            raise InputError(f"{path}: is damaged; 'jaxbl repair {folder}' writes it anew by what the parts say") from None
        if manifest.get("format") != FORMAT:
            raise InputError(
                f"{path}: has format {manifest.get('format')}; this version reads {FORMAT}; read it with the jaxbl "
                "that wrote it, or sweep anew into another folder"
            )
        return cls(folder, manifest, keeps_manifest=keeps_manifest)

    @property
    def layout(self) -> Layout:
        return Layout(**self.manifest["layout"])

    @property
    def backend(self) -> Backend:
        """That of all chunks, but for groups that the fused loop cannot run."""
        return self.manifest["backend"]

    @property
    def _head(self) -> dict[str, Any]:
        return {name: self.manifest[name] for name in ("identity", "single_run")}

    def update(self, **values: Any) -> None:
        """Set entries of the manifest."""
        self.manifest |= values
        begun = time.monotonic()
        write_atomic(self.folder / "manifest.json", json_with_checksum(self.manifest))
        self._saved = time.monotonic()
        # of very many parts it is long
        self._pause = max(_SAVED, 100.0 * (self._saved - begun))

    def part(self, index: int) -> Path:
        return self.folder / "points" / f"part-{index:05d}.parquet"

    def has(self, index: int) -> bool:
        """Whether a chunk is there and is what was written; one that is not is kept aside.

        Raises:
            InputError: it is of another study.
        """
        path = self.part(index)
        if not path.exists():
            return False
        try:
            self._check_file(path, index)
        except Damaged as why:
            self._put_aside(path, str(why))
            return False
        return True

    def _check_file(self, path: Path, index: int) -> None:
        """Whether a part's file is what was written, by the manifest or else by itself. Raises `Damaged`, or `InputError`
        where it is of another study."""
        known = self.manifest["checksums"].get(str(index))
        if known is None:
            mark, _ = parts.read_part(path)
            self._check(path, mark, index)
            self.manifest["checksums"][str(index)] = parts.file_checksum(path)
        elif parts.file_checksum(path) != known:
            raise Damaged("does not agree with its checksum in manifest.json")

    def _check(self, path: Path, mark: PartHeader, index: int) -> None:
        """Whether a whole part is the one that belongs here."""
        if {name: mark.study.get(name) for name in self._head} != self._head:
            raise InputError(
                f"{path}: is of another study ('{mark.study.get('title') or 'untitled'}', other numbers); move it away, and "
                "run 'jaxbl sweep' again, which computes this part"
            )
        if mark.chunk != index or mark.layout != self.manifest["layout"]:
            raise Damaged(f"is part {mark.chunk} of this study")

    def _put_aside(self, path: Path, why: str) -> None:
        """Keep a damaged file where it is in nobody's way."""
        folder = self.folder / "damaged"
        if not is_remote(folder):
            folder.mkdir(exist_ok=True)
        names = (path.name if i == 0 else f"{path.name}.{i}" for i in count())
        target = next(folder / name for name in names if not (folder / name).exists())
        rename_file(path, target)
        self.damaged.append(f"{path.relative_to(self.folder)} {why}; it is kept as {target.relative_to(self.folder)}")

    def write(self, index: int, frame: pd.DataFrame) -> str:
        """Write a part; its checksum is to be noted (:meth:`note`). Changes nothing here: it may run in another thread."""
        head = self._head | {"title": self.manifest["title"]}
        parts.write_part(self.part(index), frame, PartHeader(head, self.manifest["layout"], self.backend, index, 0, {}))
        return parts.file_checksum(self.part(index))

    def note(self, checksums: dict[int, str]) -> None:
        """Add parts that were written, by their checksums, to the manifest."""
        self.manifest["checksums"] |= {str(index): value for index, value in checksums.items()}
        # not for each part: a large study's manifest is large
        if self.keeps_manifest and time.monotonic() - self._saved > self._pause:
            self.update()

    def existing(self) -> list[Path]:
        """Files of parts, whole or damaged."""
        # a sixth digit comes after five
        return sorted(list_paths(self.folder / "points", "part-*.parquet"), key=lambda path: (len(path.name), path.name))

    def read_part(self, index: int, labels: dict[str, np.ndarray], columns: list[str]) -> pd.DataFrame | None:
        """Some columns of a chunk, or None where it holds other rows than those of `labels`."""
        try:
            _, frame = parts.read_part(self.part(index), [*labels, *columns])
        except (Damaged, OSError):
            return None
        same = all(np.array_equal(frame[name].to_numpy(), values) for name, values in labels.items())
        return frame if same else None

    def grow(self, parts: int, rows: int) -> None:
        """Say how many chunks and rows a refined study has as far as is known."""
        if rows > self.manifest["rows"]:
            self.update(parts=parts, rows=rows)

    def count_parts(self) -> None:
        """Have as many chunks as there are files, at least: of a refined study only these say how many it has so far, if its
        manifest was lost."""
        there = [index + 1 for index, _ in self._indexed() if index is not None]
        if max(there, default=0) > self.manifest["parts"]:
            self.update(parts=max(there))

    def trim(self, parts: int, rows: int) -> None:
        """Say how many chunks and rows a refined study has in the end, and remove what lies beyond."""
        if (self.manifest["parts"], self.manifest["rows"]) != (parts, rows):
            self.update(parts=parts, rows=rows)
        for index, path in self._indexed():
            if index is not None and index >= parts:
                path.unlink()
                self.manifest["checksums"].pop(str(index), None)

    def _indexed(self) -> Iterator[tuple[int | None, Path]]:
        """Files among the points with the indices that their names say."""
        for path in self.existing():
            number = path.stem.removeprefix("part-")
            yield (int(number) if number.isdecimal() and path == self.part(int(number)) else None), path

    def refuse_others(self) -> None:
        """Raise `InputError` if a file among the points is none of this study."""
        for index, path in self._indexed():
            if index is None or index >= self.manifest["parts"]:
                raise InputError(f"{path}: is no part of this study, which has {self.manifest['parts']}; move it away")

    def parts(self) -> list[Path]:
        """Files of the chunks that are there. Raises `InputError` if there is none, or one that the study does not have."""
        self.refuse_others()
        found = [path for _, path in self._indexed()]
        if not found:
            raise InputError(f"{self.folder}: holds no points yet; wait for the sweep at work in it, or run 'jaxbl sweep'")
        return found

    def columns(self) -> list[str]:
        """Names of the columns."""
        mark = _read_first_header(self.folder)
        return list(mark.columns) if mark is not None else list(next(self.batches()).columns)

    def batches(self, columns: list[str] | None = None) -> Iterator[pd.DataFrame]:
        """Rows of the chunks that are there, one after the other; all columns, or some.

        Raises:
            InputError: a part is damaged, or not of this study.
        """
        for part in self.parts():
            with _report_damage(part):
                mark, frame = parts.read_part(self._near(part), columns)
                self._check(part, mark, int(part.stem.removeprefix("part-")))
            yield frame

    def dataset(self, check: bool) -> "Dataset":
        """Rows of the chunks that are there as a dataset of pyarrow, which reads what is asked of it, and compares each page
        with its checksum. With `check` each file is first compared with that in the manifest, else each part's mark read.

        Raises:
            InputError: a part is damaged, or not of this study.
        """
        from pyarrow import dataset

        found = self.parts()
        for part in found:
            index = int(part.stem.removeprefix("part-"))
            with _report_damage(part):
                if check:
                    self._check_file(part, index)
                else:
                    self._check(part, parts.read_header(part), index)
        form = dataset.ParquetFileFormat(
            default_fragment_scan_options=dataset.ParquetFragmentScanOptions(page_checksum_verification=True)
        )
        remote: Any = found[0]
        system = remote.fs if is_remote(remote) else None
        names = [str(part.path if system else part) for part in cast(Any, found)]
        return cast("Dataset", dataset.dataset(names, format=form, filesystem=system))

    def _near(self, part: Path) -> Path:
        """A part where it is read fast: of an object store, a copy for as long as this lives, as a report reads it often."""
        if not is_remote(part):
            return part
        if self._copies is None:
            self._copies = Path(tempfile.mkdtemp())
            weakref.finalize(self, shutil.rmtree, self._copies, ignore_errors=True)
        copy = self._copies / part.name
        if not copy.exists():
            copy.write_bytes(part.read_bytes())
        return copy

    def verify(self) -> int:
        """Read all parts; those that are damaged are kept aside. Returns how many are whole.

        Raises:
            InputError: a part is of another study, or none that this one has.
        """
        self.manifest["checksums"] = {}
        found = sum(self.has(int(path.stem.removeprefix("part-"))) for path in self.parts())
        if self.damaged:
            self.manifest["finished"] = False
        self.update()
        return found
