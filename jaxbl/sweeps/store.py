"""A study's folder: resolved config, manifest, one Parquet file per chunk; restart, and no overwriting of other studies."""

import hashlib
import json
import os
import platform
import shutil
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq

from jaxbl.config import Config
from jaxbl.errors import InputError
from jaxbl.files import LOG_RESULTS, log_named_in, make_folder, read_json, write_atomic, write_table

from .programs import Backend, Layout

FORMAT = 2
"""Of the manifest: raised where older versions could not read it."""

_COMMANDS = {
    # command: its marker, which says whose the folder is; what it leaves; keys of the config that decide none of its numbers
    "simulate": ("summary.json", ("trace.parquet",), ("axes", "sweep", "verify", "tune")),
    "sweep": ("manifest.json", ("study.toml", "points", "laws.json"), ("verify", "tune")),
    "verify": ("verify/manifest.json", ("verdict.json", "counterexamples.parquet", "verify"), ("tune",)),
    "tune": ("tune/manifest.json", ("gains.toml", "tuning.json", "tune"), ("axes", "verify")),
}
_COMMON = "figures", "report.html"


def identity(config: Config, command: str = "sweep") -> str:
    """Hash of everything that decides the numbers that a command finds for a study.

    Title, notes, figures, chunk size and tables that only other commands read decide nothing.
    """
    data = config.resolved()
    data["sweep"].pop("chunk", None)
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


def claim(folder: Path, config: Config, command: str = "sweep", *, overwrite: bool = False) -> None:
    """Make sure that a command may write its results for a study into a folder; make the folder.

    All commands of one study may share one folder. With `overwrite`, results of other studies are removed from it first.

    Raises:
        InputError: the folder holds another study or other files, or cannot be written to.
    """
    make_folder(folder)
    found = {}
    for other, (marker, _, _) in _COMMANDS.items():
        if (folder / marker).exists():
            try:
                found[other] = read_json(folder / marker)
            except InputError:
                if not overwrite:
                    raise
                found[other] = {}
    # a damaged file of ours is read as an empty one above
    if any(data and "single_run" not in data for data in found.values()):
        raise InputError(f"{folder}: holds files that are not of a study; choose another folder with --out")
    same = [data.get("single_run") == identity(config, "simulate") for data in found.values()]
    if command != "simulate" and command in found:
        same.append(found[command].get("identity") == identity(config, command))
    if all(same) and (found or not any(folder.iterdir())):
        return
    if not found:
        for file in (folder / name for name in LOG_RESULTS if (folder / name).exists()):
            log = log_named_in(file)
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
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


class Store:
    """The folder of one study."""

    def __init__(self, folder: Path, manifest: dict[str, Any]):
        self.folder = folder
        self.manifest = manifest

    @classmethod
    def create(cls, folder: Path, config: Config, layout: Layout, backend: Backend, parts: int, rows: int) -> "Store":
        """Open a folder that this study may have (:func:`claim`), or take up the one that is there."""
        if (folder / "manifest.json").exists():
            store = cls.open(folder)
        else:
            manifest = {
                "format": FORMAT,
                **manifest_head(config, "sweep"),
                "layout": layout._asdict(),
                "backend": backend,
                "parts": parts,
                "rows": rows,
                "finished": False,
                "versions": {name: version(name) for name in ("jaxbl", "jax", "equinox", "llvmlite", "numpy")},
                "machine": {"system": platform.system(), "processor": platform.machine(), "cores": os.cpu_count()},
            }
            store = cls(folder, manifest)
        # the manifest first: it is what makes the folder this study's
        store.update()
        (folder / "points").mkdir(exist_ok=True)
        write_atomic(folder / "study.toml", config.to_toml())
        return store

    @classmethod
    def open(cls, folder: Path) -> "Store":
        """Open a study that is there. Raises `InputError` where there is none."""
        path = folder / "manifest.json"
        if not path.exists():
            raise InputError(f"{folder}: holds no study (no manifest.json); run 'jaxbl sweep' first")
        manifest = read_json(path)
        if manifest.get("format") != FORMAT:
            raise InputError(f"{path}: has format {manifest.get('format')}; this version reads {FORMAT}")
        return cls(folder, manifest)

    @property
    def layout(self) -> Layout:
        return Layout(**self.manifest["layout"])

    @property
    def backend(self) -> Backend:
        """That of all chunks, but for groups that the fused loop cannot run; those of former versions were scanned."""
        return self.manifest.get("backend", "scan")

    def update(self, **values: Any) -> None:
        """Set entries of the manifest."""
        self.manifest |= values
        write_atomic(self.folder / "manifest.json", json.dumps(self.manifest, indent=2))

    def part(self, index: int) -> Path:
        return self.folder / "points" / f"part-{index:05d}.parquet"

    def has(self, index: int) -> bool:
        """Whether a chunk is there and whole."""
        try:
            return pq.read_metadata(self.part(index)).num_rows > 0
        except (OSError, ValueError):
            return False

    def write(self, index: int, frame: pd.DataFrame) -> None:
        write_table(self.part(index), frame)

    def read_part(self, index: int, labels: dict[str, np.ndarray], columns: list[str]) -> pd.DataFrame | None:
        """Some columns of a chunk, or None where it is damaged or holds other rows than those of `labels`."""
        try:
            frame = pd.read_parquet(self.part(index), columns=[*labels, *columns])
        except (OSError, ValueError):
            return None
        same = all(np.array_equal(frame[name].to_numpy(), values) for name, values in labels.items())
        return frame if same else None

    def grow(self, parts: int, rows: int) -> None:
        """Say how many chunks and rows a refined study has as far as is known."""
        if rows > self.manifest["rows"]:
            self.update(parts=parts, rows=rows)

    def trim(self, parts: int, rows: int) -> None:
        """Say how many chunks and rows a refined study has in the end, and remove what lies beyond."""
        if (self.manifest["parts"], self.manifest["rows"]) != (parts, rows):
            self.update(parts=parts, rows=rows)
        for path in self.parts():
            if int(path.stem.removeprefix("part-")) >= parts:
                path.unlink()

    def parts(self) -> list[Path]:
        """Files of the chunks that are there. Raises `InputError` where there is none."""
        parts = sorted((self.folder / "points").glob("part-*.parquet"))
        if not parts:
            raise InputError(f"{self.folder}: holds no points yet; run 'jaxbl sweep' to the end")
        return parts

    def columns(self) -> list[str]:
        """Names of the columns."""
        return pq.read_schema(self.parts()[0]).names

    def read(self, columns: list[str] | None = None) -> pd.DataFrame:
        """Rows of all chunks that are there; all columns, or some."""
        frames = []
        for part in self.parts():
            try:
                frames.append(pd.read_parquet(part, columns=columns))
            except (OSError, ValueError):
                raise InputError(f"{part}: is damaged; run 'jaxbl sweep' again, which computes it anew") from None
        return pd.concat(frames, ignore_index=True)
