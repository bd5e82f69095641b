"""Files and folders that commands write: whole or not at all, as JSON that any program reads."""

import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import InputError

if TYPE_CHECKING:
    import pandas as pd

LOG_RESULTS = ("inspection.json", "identification.json", "diagnosis.json")
"""What `inspect`, `identify` and `diagnose` write into a folder; each names the log that the results are of."""


def plain(value: Any) -> Any:
    """A value that JSON can hold: arrays and tables of numbers become lists, what is not finite becomes None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    value = np.asarray(value)
    if value.ndim:
        return [plain(item) for item in value.tolist()]
    value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_json(path: Path) -> dict[str, Any]:
    """An object from a file of ours."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path}: is damaged ({error}); remove it, or choose another folder with --out") from None
    if not isinstance(data, dict):
        raise InputError(f"{path}: is not one of jaxbl's files; choose another folder with --out")
    return data


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write a file so that it is either there whole or not at all."""
    draft = _draft(path)
    draft.write_bytes(content.encode() if isinstance(content, str) else content)
    draft.replace(path)


def write_table(path: Path, frame: "pd.DataFrame") -> None:
    """Write a Parquet file so that it is either there whole or not at all."""
    draft = _draft(path)
    frame.to_parquet(draft, index=False)
    draft.replace(path)


def _draft(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}")


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


def claim_log_folder(folder: Path, log: Path, *, overwrite: bool) -> None:
    """Make the folder for the results of a log.

    Raises:
        InputError: it holds other files, or (unless `overwrite`) the results of another log, or cannot be written to.
    """
    make_folder(folder)
    found = [folder / name for name in LOG_RESULTS if (folder / name).exists()]
    if not found and any(folder.iterdir()):
        raise InputError(f"{folder}: is not empty and holds no results of a log; choose another folder with --out")
    for file in found:
        other = log_named_in(file)
        if other != str(log.resolve()) and not overwrite:
            name = other or "an unreadable one"
            raise InputError(f"{folder}: holds results of another log ({name}); choose another with --out, or --overwrite")


def log_named_in(file: Path) -> str | None:
    """The log that the results in a file are of; None where the file is damaged."""
    try:
        return str(read_json(file)["file"])
    except (InputError, KeyError):
        return None


def results_of(
    task: Any, file: Path, run: Callable[[Any], Any], write: Callable[[Any, Path], object], *, overwrite: bool
) -> dict[str, Any]:
    """Do a task on a log, write its results into the folder of `file`, and return their summary. Where an earlier call left
    the summary of the same task in `file`, that is read instead.

    Raises:
        InputError: as :func:`claim_log_folder`, or as the task does.
    """
    claim_log_folder(file.parent, task.record.path, overwrite=overwrite)
    with suppress(OSError, InputError):
        found = read_json(file)
        if found.get("identity") == task.identity and _is_newest(file):
            return found
    with removed_if_empty(file.parent):
        done = run(task)
        write(done, file.parent)
    return done.summary


def _is_newest(summary: Path) -> bool:
    """Whether the report beside a summary is its own: it is written before, that of another command in this folder later."""
    with suppress(OSError):
        return (summary.parent / "report.html").stat().st_mtime_ns <= summary.stat().st_mtime_ns
    return False


@contextmanager
def removed_if_empty(folder: Path) -> Iterator[None]:
    """Remove a folder that is still empty when something goes wrong."""
    try:
        yield
    except BaseException:
        # suppressed: it is not empty
        with suppress(OSError):
            folder.rmdir()
        raise
