"""Files and folders that commands write: whole or not at all, as JSON that any program reads."""

import errno
import hashlib
import json
import math
import os
import re
import shutil
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from .errors import InputError, NoResult

if TYPE_CHECKING:
    import pandas as pd

LOG_RESULTS = ("inspection.json", "identification.json", "diagnosis.json", "watch.json")
"""What `inspect`, `identify`, `diagnose` and `watch` write into a folder; each names the log that the results are of."""


def place(name: str | Path) -> Path:
    """A folder by its name: a path, or the address of an object store (`s3://bucket/folder`), which has those of a path's
    methods that are needed here.

    Raises:
        InputError: a package for such addresses is missing.
    """
    if "://" not in str(name):
        return Path(name)
    try:
        from upath import UPath

        # other processes write there, too
        return UPath(name, use_listings_cache=False)  # pyright: ignore[reportReturnType]
    except ImportError as error:
        raise InputError(
            f"{name}: needs another package ({error}); pip install 'jaxbl[distributed]', s3fs for s3://"
        ) from None
    except ValueError as error:
        raise InputError(
            f"{name}: is no place for results ({error}); it should be a folder, or s3://BUCKET/FOLDER"
        ) from None


def is_remote(path: Path) -> bool:
    """Whether a path is in an object store: files there are always whole, there are no folders, and no locks."""
    return not isinstance(path, Path)


def plain(value: Any) -> Any:
    """A value that JSON can hold: arrays and tables of numbers become lists, what is not finite becomes None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    # the command line needs this module before it needs NumPy
    import numpy as np

    value = np.asarray(value)
    if value.ndim:
        return [plain(item) for item in value.tolist()]
    value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


_ANEW = "begin anew with --overwrite, or choose another folder with --out"


def checksum(content: bytes) -> str:
    """Of some bytes: 32 hexadecimal digits."""
    return hashlib.blake2b(content, digest_size=16).hexdigest()


def read_json(path: Path) -> dict[str, Any]:
    """An object from a file of ours without its checksum, which it agrees with if it has one."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path}: is damaged ({error}); {_ANEW}") from None
    if not isinstance(data, dict):
        raise InputError(f"{path}: is not one of jaxbl's files; choose another folder with --out")
    if "checksum" in data and data.pop("checksum") != _checksum_of(data):
        raise InputError(f"{path}: is damaged (does not agree with its checksum); {_ANEW}")
    return data


def json_text(data: Mapping[str, Any]) -> str:
    """An object as JSON with a checksum of all else in it."""
    # keys and numbers as they are read again
    plain_data: dict[str, Any] = json.loads(json.dumps(data))
    return json.dumps(plain_data | {"checksum": _checksum_of(plain_data)}, indent=1, ensure_ascii=False)


def _checksum_of(data: Mapping[str, Any]) -> str:
    return checksum(json.dumps(data, sort_keys=True).encode())


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write a file so that it is either there whole or not at all. Raises as :func:`written`."""
    with written(path) as draft:
        # names of files may hold bytes that are no UTF-8: JSON's own way of writing them
        draft.write_bytes(content.encode(errors="backslashreplace") if isinstance(content, str) else content)


def begin_file(path: Path, content: str) -> bool:
    """Write a file that is not there yet; returns False where another process was first. Raises as :func:`written`.

    An object store decides that by a put on condition, if it has one. Some ignore the condition: of two processes that write
    at the same time, the later one is first then. The system's files are ours (:func:`locked`).
    """
    if not is_remote(path):
        write_atomic(path, content)
        return True
    with writing(path):
        if path.exists():
            return False
        try:
            path.fs.pipe_file(path.path, content.encode(), mode="create")  # pyright: ignore[reportAttributeAccessIssue]
        except FileExistsError:
            return False
        except NotImplementedError:
            path.write_bytes(content.encode())
        return path.read_bytes() == content.encode()


def write_table(path: Path, frame: "pd.DataFrame") -> None:
    """Write a Parquet file so that it is either there whole or not at all. Raises as :func:`written`."""
    with written(path) as draft:
        frame.to_parquet(draft, index=False)


def listed(folder: Path, pattern: str) -> list[Path]:
    """Files and folders in a folder by a pattern of their names, sorted; none where it is not there."""
    try:
        return sorted(folder.glob(pattern))
    except FileNotFoundError:
        return []


def remove(path: Path) -> None:
    """Remove a file, or a folder with all that is in it; there may be none."""
    if not path.is_dir():
        path.unlink(missing_ok=True)
    elif isinstance(path, Path):
        shutil.rmtree(path)
    else:
        path.rmdir(recursive=True)


def move(path: Path, target: Path) -> None:
    """Give a file another name in the same folder or store."""
    if is_remote(path):
        target.write_bytes(path.read_bytes())
        path.unlink()
    else:
        path.replace(target)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Around what is written into a file or folder: one line if the system cannot.

    Raises:
        NoResult: there is no room for it, it may not be written, or the disk fails.
    """
    try:
        yield
    except OSError as error:
        raise NoResult(
            f"{path}: cannot be written ({error.strerror or error}); what was written before is whole, and the same command "
            "goes on from there when that is mended"
        ) from None


@contextmanager
def written(path: Path) -> Iterator[Path]:
    """A draft to be written, which takes the file's place once it is whole. Raises as :func:`writing`."""
    if is_remote(path):
        with TemporaryDirectory() as folder, writing(path):
            yield Path(folder) / path.name
            path.write_bytes((Path(folder) / path.name).read_bytes())
        return
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with writing(path):
            yield draft
            draft.replace(path)
    finally:
        with suppress(OSError):
            draft.unlink()


LOCK = ".lock"
_DRAFT = re.compile(r"\.((probe|.+\.(json|toml|parquet|html|png))\.\d+|draft\..+)")
"""Names of files and folders that a process leaves where it is killed while it writes."""


class Busy(InputError):
    """A folder that another process writes into."""


@contextmanager
def locked(folder: Path, *, shared: bool = False, wait: float = 0.0) -> Iterator[None]:
    """Keep other processes from writing into a folder, which is made; with `shared`, those that do not share it.
    Another process that has it is waited for so many seconds.

    The system frees the lock of a process that dies, on a network file system that of a machine that is lost. A file system
    without locks has none.

    Raises:
        Busy: another process writes into it.
        InputError: it cannot be written to.
    """
    make_folder(folder)
    if is_remote(folder):
        yield
        return
    path = folder / LOCK
    latest = time.monotonic() + wait
    while (file := _taken(path, shared)) is None and time.monotonic() < latest:
        time.sleep(0.05)
    if file is None:
        raise Busy(
            f"{folder}: {holder(folder) or 'another process'} is writing into it; wait until it has ended, or choose "
            "another folder with --out"
        )
    try:
        yield
    finally:
        with suppress(OSError):
            # those that share it still have it
            if not shared or _lock(file, shared=False):
                path.unlink()
        file.close()


def holder(folder: Path) -> str:
    """The process that writes into a folder, its host, and since when; empty where none does."""
    if is_remote(folder):
        return ""
    with suppress(OSError), (folder / LOCK).open("r+") as file:
        return "" if _lock(file, shared=False) else file.read()
    return ""


def _taken(path: Path, shared: bool) -> Any:
    """The file of a lock that is ours now; None where another process has it."""
    while True:
        file = path.open("a+")
        if not _lock(file, shared):
            file.close()
            return None
        # who had it may have removed it meanwhile
        with suppress(FileNotFoundError):
            if os.fstat(file.fileno()).st_ino == path.stat().st_ino:
                file.truncate(0)
                file.write(f"process {os.getpid()} on {socket.gethostname()} (since {time.strftime('%Y-%m-%d %H:%M:%S')})")
                file.flush()
                return file
        file.close()


def _lock(file: Any, shared: bool) -> bool:
    """Lock an open file. Returns whether that was possible."""
    import fcntl

    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK):
            raise
    return True


def remove_drafts(folder: Path) -> None:
    """Remove what processes have left in a folder of ours that were killed while they wrote."""
    for draft in [] if is_remote(folder) else folder.rglob(".*"):
        if _DRAFT.fullmatch(draft.name):
            remove(draft)


def is_empty(folder: Path) -> bool:
    """Whether nothing but our lock is in a folder."""
    return all(path.name == LOCK for path in listed(folder, "*"))


@contextmanager
def access(path: Path, how: str) -> Iterator[None]:
    """Around what an object store is asked for. Raises `InputError` where it fails; `how` is what cannot be done then."""
    try:
        yield
    except Exception as error:  # of any kind: each store has its own
        why = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(f"{path}: cannot be {how} ({why}); name another folder, or mend the access to it") from None


def has_file(folder: Path, name: str) -> bool:
    """Whether a file is in a folder. Raises `InputError` where an object store cannot be asked."""
    if is_remote(folder):
        with access(folder, "read"):
            return (folder / name).exists()
    return (folder / name).exists()


def make_folder(path: Path, instead: str = "", option: str = "--out") -> None:
    """Make a folder that can be written to. Raises `InputError` where that is not possible; `option` is what names the
    folder, `instead` what to do where that is not to name another one."""
    if is_remote(path):
        with access(path, "written to"):
            (path / ".probe").write_bytes(b"")
            (path / ".probe").unlink()
        return
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / f".probe.{os.getpid()}"
        probe.touch()
        probe.unlink()
    except FileExistsError:
        raise InputError(f"{path}: is a file; {option} should name a folder") from None
    except NotADirectoryError:
        raise InputError(f"{path}: lies under a file; {option} should name a folder") from None
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written to ({error.strerror}); {instead or f'choose another folder with {option}'}"
        ) from None


def claim_log_folder(folder: Path, log: Path, *, overwrite: bool) -> None:
    """Make the folder for the results of a log.

    Raises:
        InputError: it holds other files, or (unless `overwrite`) the results of another log, or cannot be written to.
    """
    make_folder(folder)
    found = [folder / name for name in LOG_RESULTS if (folder / name).exists()]
    if not found and not is_empty(folder):
        raise InputError(f"{folder}: is not empty and holds no results of a log; choose another folder with --out")
    for file in found:
        other = log_named_in(file)
        if other != str(log.resolve()) and not overwrite:
            name = other or "an unreadable one"
            raise InputError(f"{folder}: holds results of another log ({name}); choose another with --out, or --overwrite")
    if found:
        remove_drafts(folder)


def log_named_in(file: Path) -> str | None:
    """The log that the results in a file are of; None where that cannot be read. The rest may be damaged."""
    try:
        return str(json.loads(file.read_text(encoding="utf-8"))["file"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def results_of(
    task: Any, file: Path, run: Callable[[Any], Any], write: Callable[[Any, Path], object], *, overwrite: bool
) -> dict[str, Any]:
    """Do a task on a log, write its results into the folder of `file`, and return their summary. Where an earlier call left
    the summary of the same task in `file`, that is read instead.

    Raises:
        InputError: as :func:`claim_log_folder`, or as the task does.
    """
    folder = file.parent
    with removed_if_empty(folder), locked(folder):
        claim_log_folder(folder, task.record.path, overwrite=overwrite)
        with suppress(OSError, InputError):
            found = read_json(file)
            if found.get("identity") == task.identity and _is_newest(file):
                return found
        done = run(task)
        write(done, folder)
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
            if not is_remote(folder):
                folder.rmdir()
        raise
