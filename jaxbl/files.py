"""Files and folders that commands write: files appear whole or not at all, JSON has a checksum, and folders are locked."""

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
from .json_types import JsonObject

if TYPE_CHECKING:
    import pandas as pd

LOG_RESULTS = ("inspection.json", "identification.json", "diagnosis.json", "watch.json")
"""Files that `inspect`, `identify`, `diagnose` and `watch` write into a folder; each names the log of the results."""


def to_path(name: str | Path) -> Path:
    """Return a folder by its name: a path, or the address of an object store (`s3://bucket/folder`), which has the methods
    of a path that are needed here.

    Raises:
        InputError: a package for such addresses is missing.
    """
    if "://" not in str(name):
        return Path(name)
    try:
        from upath import UPath

        # other processes write there, too, so that listings may not be cached
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
    """True if a path is in an object store, where files are always whole, and there are no folders and no locks."""
    return not isinstance(path, Path)


def to_jsonable(value: Any) -> Any:
    """Return a value that JSON can hold: arrays become lists, and numbers that are not finite become None.

    Example:
        >>> to_jsonable({"gap": np.array([0.1, np.nan])})
        {'gap': [0.1, None]}
    """
    if isinstance(value, Mapping):
        return {str(key): to_jsonable(member) for key, member in value.items()}
    if isinstance(value, list | tuple):
        return [to_jsonable(member) for member in value]
    # imported here, since the command line starts without NumPy
    import numpy as np

    array = np.asarray(value)
    if array.ndim:
        return [to_jsonable(member) for member in array.tolist()]
    scalar = array.item()
    return None if isinstance(scalar, float) and not math.isfinite(scalar) else scalar


_BEGIN_ANEW = "begin anew with --overwrite, or choose another folder with --out"


def checksum(content: bytes) -> str:
    """Return the checksum of some bytes, 32 hexadecimal digits."""
    return hashlib.blake2b(content, digest_size=16).hexdigest()


def read_json(path: Path) -> JsonObject:
    """Read a JSON object that a command wrote, and check it against its checksum, which is left out.

    Raises:
        InputError: the file is damaged, or not one of jaxbl's.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path}: is damaged ({error}); {_BEGIN_ANEW}") from None
    if not isinstance(data, dict):
        raise InputError(f"{path}: is not one of jaxbl's files; choose another folder with --out")
    if "checksum" in data and data.pop("checksum") != _json_checksum(data):
        raise InputError(f"{path}: is damaged (does not agree with its checksum); {_BEGIN_ANEW}")
    return data


def json_with_checksum(data: JsonObject) -> str:
    """Return an object as JSON text, with a checksum of all its other keys."""
    # the checksum is of the keys and numbers as they are read again
    as_read: JsonObject = json.loads(json.dumps(data))
    return json.dumps(as_read | {"checksum": _json_checksum(as_read)}, indent=1, ensure_ascii=False)


def _json_checksum(data: JsonObject) -> str:
    return checksum(json.dumps(data, sort_keys=True).encode())


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write a file so that it exists either whole or not at all. Raises as :func:`open_draft`."""
    with open_draft(path) as draft:
        # file names in the text may have bytes that are no UTF-8; they are escaped as JSON escapes them
        draft.write_bytes(content.encode(errors="backslashreplace") if isinstance(content, str) else content)


def write_json(path: Path, data: Any, *, allow_nan: bool = True) -> None:
    """Write data as JSON text without a checksum. Raises as :func:`open_draft`."""
    write_atomic(path, json.dumps(data, indent=2, ensure_ascii=False, allow_nan=allow_nan))


def create_file(path: Path, content: str) -> bool:
    """Write a file that does not exist yet. Returns False if another process was first. Raises as :func:`open_draft`.

    In an object store a conditional put decides which process is first. Some stores ignore the condition: of two processes
    that write at the same time, the later one wins there. On a file system the folder is locked (:func:`lock_folder`).
    """
    if not is_remote(path):
        write_atomic(path, content)
        return True
    with catch_write_errors(path):
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
    """Write a Parquet file so that it exists either whole or not at all. Raises as :func:`open_draft`."""
    with open_draft(path) as draft:
        frame.to_parquet(draft, index=False)


def list_paths(folder: Path, pattern: str) -> list[Path]:
    """List the files and folders in a folder whose names match a pattern, sorted; none if the folder does not exist."""
    try:
        return sorted(folder.glob(pattern))
    except FileNotFoundError:
        return []


def remove(path: Path) -> None:
    """Remove a file, or a folder with its contents, if it exists."""
    if not path.is_dir():
        path.unlink(missing_ok=True)
    elif isinstance(path, Path):
        shutil.rmtree(path)
    else:
        path.rmdir(recursive=True)


def rename_file(path: Path, target: Path) -> None:
    """Give a file another name in the same folder or store."""
    if is_remote(path):
        target.write_bytes(path.read_bytes())
        path.unlink()
    else:
        path.replace(target)


@contextmanager
def catch_write_errors(path: Path) -> Iterator[None]:
    """Turn errors of writing into a file or folder, inside the `with` block, into one line.

    Raises:
        NoResult: the disk is full, access is denied, or the disk fails.
    """
    try:
        yield
    except OSError as error:
        raise NoResult(
            f"{path}: cannot be written ({error.strerror or error}); what was written before is whole, and the same command "
            "goes on from there when that is mended"
        ) from None


@contextmanager
def open_draft(path: Path) -> Iterator[Path]:
    """Yield the path of a draft, which takes the place of `path` when the `with` block ends. Raises as
    :func:`catch_write_errors`."""
    if is_remote(path):
        with TemporaryDirectory() as folder, catch_write_errors(path):
            yield Path(folder) / path.name
            path.write_bytes((Path(folder) / path.name).read_bytes())
        return
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with catch_write_errors(path):
            yield draft
            draft.replace(path)
    finally:
        with suppress(OSError):
            draft.unlink()


LOCK_NAME = ".lock"
_DRAFT_NAME = re.compile(r"\.((probe|.+\.(json|toml|parquet|html|png))\.\d+|draft\..+)")
"""Names of files and folders that a killed process may leave behind."""


class FolderInUse(InputError):
    """Another process is writing into the folder."""


@contextmanager
def lock_folder(folder: Path, *, shared: bool = False, wait: float = 0.0) -> Iterator[None]:
    """Make a folder, and keep other processes from writing into it inside the `with` block.

    The system frees the lock of a process that dies, and on a network file system that of a machine that is lost. On a file
    system without locks, and in an object store, nothing is locked.

    Args:
        folder: made if it does not exist.
        shared: let other processes write that share it, too.
        wait: seconds to wait for another process that has locked it.

    Raises:
        FolderInUse: another process is writing into it.
        InputError: the folder cannot be written to.
    """
    make_folder(folder)
    if is_remote(folder):
        yield
        return
    path = folder / LOCK_NAME
    deadline = time.monotonic() + wait
    while (file := _acquire_lock(path, shared)) is None and time.monotonic() < deadline:
        time.sleep(0.05)
    if file is None:
        raise FolderInUse(
            f"{folder}: {lock_holder(folder) or 'another process'} is writing into it; wait until it has ended, or choose "
            "another folder with --out"
        )
    try:
        yield
    finally:
        with suppress(OSError):
            # the file stays while other processes share the lock
            if not shared or _try_lock(file, shared=False):
                path.unlink()
        file.close()


def lock_holder(folder: Path) -> str:
    """The process that has locked a folder, with its host and since when; "" if it is not locked."""
    if is_remote(folder):
        return ""
    with suppress(OSError), (folder / LOCK_NAME).open("r+") as file:
        return "" if _try_lock(file, shared=False) else file.read()
    return ""


def _acquire_lock(path: Path, shared: bool) -> Any:
    """Return the open file of a lock that this process now holds; None if another process holds it."""
    while True:
        file = path.open("a+")
        if not _try_lock(file, shared):
            file.close()
            return None
        # the process that held the lock may have removed the file meanwhile
        with suppress(FileNotFoundError):
            if os.fstat(file.fileno()).st_ino == path.stat().st_ino:
                file.truncate(0)
                file.write(f"process {os.getpid()} on {socket.gethostname()} (since {time.strftime('%Y-%m-%d %H:%M:%S')})")
                file.flush()
                return file
        file.close()


def _try_lock(file: Any, shared: bool) -> bool:
    """Lock an open file. Returns True if that was possible, or if the file system has no locks."""
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
    """Remove the drafts that killed processes have left in a result folder."""
    for draft in [] if is_remote(folder) else folder.rglob(".*"):
        if _DRAFT_NAME.fullmatch(draft.name):
            remove(draft)


def is_empty(folder: Path) -> bool:
    """True if a folder contains at most a lock."""
    return all(path.name == LOCK_NAME for path in list_paths(folder, "*"))


@contextmanager
def catch_store_errors(path: Path, action: str) -> Iterator[None]:
    """Turn any error of an object store, inside the `with` block, into an `InputError` of one line.

    `action` completes the sentence "... cannot be ...", e.g. "read".
    """
    try:
        yield
    except Exception as error:  # each store has exceptions of its own
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(f"{path}: cannot be {action} ({reason}); name another folder, or mend the access to it") from None


def has_file(folder: Path, name: str) -> bool:
    """True if a file is in a folder. Raises `InputError` if an object store cannot be read."""
    if is_remote(folder):
        with catch_store_errors(folder, "read"):
            return (folder / name).exists()
    return (folder / name).exists()


def make_folder(path: Path, remedy: str = "", option: str = "--out") -> None:
    """Make a folder, and check that it can be written to.

    Args:
        path: the folder, which may exist.
        remedy: the end of the message; left out, it says to choose another folder with `option`.
        option: the command-line option that names the folder.

    Raises:
        InputError: it cannot be made, or not be written to.
    """
    if is_remote(path):
        with catch_store_errors(path, "written to"):
            (path / ".probe").write_bytes(b"")
            (path / ".probe").unlink()
        return
    try:
        # Parquet's library takes names in UTF-8 alone
        str(path).encode()
        path.mkdir(parents=True, exist_ok=True)
        probe = path / f".probe.{os.getpid()}"
        probe.touch()
        probe.unlink()
    except UnicodeEncodeError:
        raise InputError(f"{path}: is no name in UTF-8; {option} should name another folder") from None
    except FileExistsError:
        raise InputError(f"{path}: is a file; {option} should name a folder") from None
    except NotADirectoryError:
        raise InputError(f"{path}: lies under a file; {option} should name a folder") from None
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written to ({error.strerror}); {remedy or f'choose another folder with {option}'}"
        ) from None


def claim_log_folder(folder: Path, log: Path, *, overwrite: bool) -> None:
    """Make the folder for the results of a log.

    Raises:
        InputError: it holds other files, or (unless `overwrite`) results of another log, or it cannot be written to.
    """
    make_folder(folder)
    results = [folder / name for name in LOG_RESULTS if (folder / name).exists()]
    if not results and not is_empty(folder):
        raise InputError(f"{folder}: is not empty and holds no results of a log; choose another folder with --out")
    for file in results:
        log_path = read_log_path(file)
        if log_path != str(log.resolve()) and not overwrite:
            name = log_path or "an unreadable one"
            raise InputError(f"{folder}: holds results of another log ({name}); choose another with --out, or --overwrite")
    if results:
        remove_drafts(folder)


def read_log_path(file: Path) -> str | None:
    """Read from a result file the path of its log; None if that cannot be read. The other keys may be damaged."""
    try:
        return str(json.loads(file.read_text(encoding="utf-8"))["file"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def run_or_read(
    task: Any, file: Path, run: Callable[[Any], Any], write: Callable[[Any, Path], object], *, overwrite: bool
) -> JsonObject:
    """Do a task on a log and write its results, unless an earlier call wrote the results of the same task.

    Args:
        task: has the `record` of the log, and an `identity` by which a summary of the same task is recognised.
        file: the summary; other results are written into its folder.
        run: does the task and returns its results, which have a `summary`.
        write: writes the results into a folder.
        overwrite: replace results of another log.

    Returns:
        The summary, of this call or as the earlier one wrote it.

    Raises:
        InputError: as :func:`claim_log_folder`, or as the task does.
    """
    folder = file.parent
    with remove_if_empty_on_error(folder), lock_folder(folder):
        claim_log_folder(folder, task.record.path, overwrite=overwrite)
        with suppress(OSError, InputError):
            summary = read_json(file)
            # a report belongs to it that is older, as another command in the folder writes later
            is_reported = (folder / "report.html").stat().st_mtime_ns <= file.stat().st_mtime_ns
            if is_reported and summary.get("identity") == task.identity:
                return summary
        result = run(task)
        write(result, folder)
    return result.summary


@contextmanager
def remove_if_empty_on_error(folder: Path) -> Iterator[None]:
    """Remove a folder that is still empty if the `with` block raises."""
    try:
        yield
    except BaseException:
        # the system refuses to remove a folder that is not empty
        with suppress(OSError):
            if not is_remote(folder):
                folder.rmdir()
        raise
