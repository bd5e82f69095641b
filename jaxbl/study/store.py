"""A study's folder: resolved config, manifest, one Parquet file per chunk; restart, and no overwriting of other studies."""

import hashlib
import json
import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow.parquet as pq

from jaxbl.errors import InputError

from .config import Config, read_config
from .engine import Layout

FORMAT = 1


def identity(config: Config) -> str:
    """Hash of everything that decides the numbers (title, figures and chunk size do not)."""
    data = config.resolved()
    data.pop("title", None)
    data.pop("notes", None)
    data.pop("figures", None)
    data["sweep"].pop("chunk", None)
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write a file so that it is either there whole or not at all."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    draft.write_bytes(content.encode() if isinstance(content, str) else content)
    draft.replace(path)


def make_folder(path: Path) -> None:
    """Make a folder that can be written to. Raises `InputError` where that is not possible."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / f".probe.{os.getpid()}"
        probe.touch()
        probe.unlink()
    except FileExistsError:
        raise InputError(f"{path}: is a file; --out should name a folder") from None
    except NotADirectoryError:
        raise InputError(f"{path}: lies under a file; --out should name a folder") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written to ({error.strerror}); choose another folder with --out") from None


class Store:
    """The folder of one study."""

    def __init__(self, folder: Path, manifest: dict[str, Any]):
        self.folder = folder
        self.manifest = manifest

    @classmethod
    def create(cls, folder: Path, config: Config, layout: Layout, parts: int, rows: int) -> "Store":
        """Open the folder for this study, or take up the one that is there.

        Raises:
            InputError: the folder holds another study or other files, or cannot be written to.
        """
        make_folder(folder)
        path = folder / "manifest.json"
        if path.exists():
            store = cls.open(folder)
            if store.manifest["identity"] != identity(config):
                raise InputError(f"{folder}: holds another study ({store.title()}); choose another folder with --out")
        else:
            if any(folder.iterdir()):
                raise InputError(f"{folder}: is not empty and holds no study; choose another folder with --out")
            manifest = {
                "format": FORMAT,
                "identity": identity(config),
                "layout": {"seeds": layout.seeds, "points": layout.points},
                "parts": parts,
                "rows": rows,
                "finished": False,
                "versions": {name: version(name) for name in ("jaxbl", "jax", "equinox", "numpy")},
                "machine": {"system": platform.system(), "processor": platform.machine(), "cores": os.cpu_count()},
            }
            store = cls(folder, manifest)
            (folder / "points").mkdir(exist_ok=True)
        write_atomic(folder / "study.toml", config.to_toml())
        store.update()
        return store

    @classmethod
    def open(cls, folder: Path) -> "Store":
        """Open a study that is there. Raises `InputError` where there is none."""
        path = folder / "manifest.json"
        try:
            manifest = json.loads(path.read_text())
        except (FileNotFoundError, NotADirectoryError):
            raise InputError(f"{folder}: holds no study (no manifest.json); run 'jaxbl sweep' first") from None
        except ValueError as error:
            raise InputError(f"{path}: is damaged ({error}); remove the folder and run the sweep again") from None
        if manifest.get("format") != FORMAT:
            raise InputError(f"{path}: has format {manifest.get('format')}; this version reads {FORMAT}")
        return cls(folder, manifest)

    def title(self) -> str:
        return self.config().title or self.manifest["identity"]

    def config(self) -> Config:
        return read_config(self.folder / "study.toml")

    @property
    def layout(self) -> Layout:
        return Layout(**self.manifest["layout"])

    def update(self, **values: Any) -> None:
        """Set entries of the manifest."""
        self.manifest |= values
        write_atomic(self.folder / "manifest.json", json.dumps(self.manifest, indent=2))

    def part(self, index: int) -> Path:
        return self.folder / "points" / f"part-{index:05d}.parquet"

    def has(self, index: int) -> bool:
        """Whether a chunk is there and whole."""
        path = self.part(index)
        if not path.exists():
            return False
        try:
            return pq.read_metadata(path).num_rows > 0
        except (OSError, ValueError):
            return False

    def write(self, index: int, frame: pd.DataFrame) -> None:
        draft = self.part(index).with_suffix(".draft")
        frame.to_parquet(draft, index=False)
        draft.replace(self.part(index))

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
        parts = self.parts()
        return pd.concat([pd.read_parquet(part, columns=columns) for part in parts], ignore_index=True)
