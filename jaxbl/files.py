"""Folders that commands write results into: locked, whole or not at all, and with a manifest that has the checksum of each
file and says what the results are about."""

import errno
import functools
import json
import math
import os
import shutil
import signal
import socket
import stat
import threading
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from .errors import InputError, NoResult
from .json_types import JsonObject

MANIFEST = "manifest.json"
FORMAT = 5
"""Format of the manifest; it is raised when older versions cannot read a new one."""


def to_path(name: str | Path) -> Path:
    """Return a folder by its name: a path, or the address of an object store (`s3://bucket/folder`), which has the methods
    of a path that are needed here. Raises `InputError` if it is no address, or a package for it is missing."""
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


def find_shipped_study(name: str) -> Path:
    """Find a study that comes with the package; in a clone it lies beside the package. Raises `InputError` if it is lost."""
    package = Path(__file__).parent
    places = package / "studies" / name, package.parent / "sweeps" / name
    for file in places:
        if file.is_file():
            return file
    raise InputError(f"{places[0]}: no such file; install jaxbl anew, it comes with it")


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


class DamagedFile(InputError):
    """A file is not what was written.

    Args:
        path: of the file.
        reason: what is wrong with it.
        remedy: how it is mended.
    """

    def __init__(
        self,
        path: Path,
        reason: str,
        remedy: str = "begin anew with --overwrite, or choose another folder with --out",
    ):
        super().__init__(f"{path}: is damaged ({reason}); {remedy}")
        self.reason, self._arguments = reason, (path, reason, remedy)

    def __reduce__(self) -> Any:
        # it may come from another process
        return DamagedFile, self._arguments


def checksum(*pieces: bytes | memoryview) -> str:
    """Return the CRC-32 of some bytes, 8 hexadecimal digits: it detects damage, not forgery."""
    return f"{functools.reduce(lambda crc, piece: zlib.crc32(piece, crc), pieces, 0):08x}"


def read_json(path: Path) -> JsonObject:
    """Read a JSON object that :func:`json_with_checksum` made, without its checksum. Raises `DamagedFile` if it cannot be
    read, or does not agree with its checksum."""
    try:
        data = json.loads(path.read_bytes())
        if data.pop("checksum") == _json_checksum(data):
            return data
        reason = "does not agree with its checksum"
    except FileNotFoundError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        reason = str(error) if isinstance(error, OSError | ValueError) else "has no checksum"
    raise DamagedFile(path, reason)


def json_with_checksum(data: JsonObject) -> str:
    """Return an object as JSON text, with a checksum of all its other keys."""
    # the checksum is of the keys and numbers as they are read again
    as_read: JsonObject = json.loads(json.dumps(data))
    return json.dumps(as_read | {"checksum": _json_checksum(as_read)}, indent=1, ensure_ascii=False)


def _json_checksum(data: JsonObject) -> str:
    return checksum(json.dumps(data, sort_keys=True).encode())


_DRAFT = ".draft."
"""The names of all files and folders that a killed process may leave behind begin so."""


def write_atomic(path: Path, content: str | bytes | bytearray) -> None:
    """Write a file so that it exists either whole or not at all. Raises as :func:`catch_write_errors`."""
    # file names in the text may have bytes that are no UTF-8; they are escaped as JSON escapes them
    data = content.encode(errors="backslashreplace") if isinstance(content, str) else content
    draft = path.with_name(f"{_DRAFT}{os.getpid()}.{path.name}")
    with catch_write_errors(path):
        if is_remote(path):
            path.write_bytes(data)
            return
        try:
            draft.write_bytes(data)
            draft.replace(path)
        finally:
            with suppress(OSError):
                draft.unlink()


def write_json(path: Path, data: Any) -> None:
    """Write data as JSON text. Raises as :func:`write_atomic`."""
    write_atomic(path, json.dumps(data, indent=2, ensure_ascii=False))


def list_paths(folder: Path, pattern: str) -> list[Path]:
    """List the files and folders in a folder whose names match a pattern, sorted; none if the folder does not exist."""
    try:
        return sorted(folder.glob(pattern))
    except FileNotFoundError:
        return []


def remove(path: Path) -> None:
    """Remove a file, or a folder with its contents, if it exists."""
    if path.is_symlink() or not path.is_dir():
        path.unlink(missing_ok=True)
    elif isinstance(path, Path):
        shutil.rmtree(path)
    else:
        path.rmdir(recursive=True)


def move_file(path: Path, target: Path) -> None:
    """Move a file into a folder of the same disk, which is made, or into an object store."""
    if is_remote(target):
        target.write_bytes(path.read_bytes())
        path.unlink()
    else:
        target.parent.mkdir(exist_ok=True)
        if target.is_dir():
            remove(target)
        path.replace(target)


@contextmanager
def catch_write_errors(path: Path) -> Iterator[None]:
    """Turn errors of writing into a file or folder, inside the `with` block, into a `NoResult`: the disk is full, access
    is denied, or the disk fails."""
    try:
        yield
    except OSError as error:
        raise NoResult(
            f"{path}: cannot be written ({error.strerror or error}); what was written before is whole, and the same command "
            "goes on from there when that is mended"
        ) from None


@contextmanager
def hold_interrupts() -> Iterator[None]:
    """Let an interrupt (Ctrl+C) wait until the `with` block ends: it leaves all of what is done there."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting: list[Any] = []
    before = signal.signal(signal.SIGINT, lambda *interrupt: waiting.append(interrupt))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if waiting and callable(before):
            before(*waiting[0])


_LOCK_NAME = ".lock"
held_folders: list[Path] = []
"""Folders that this process has locked: an interrupt has something to tidy up."""


class FolderInUse(InputError):
    """Another process is writing into the folder."""


@contextmanager
def lock_folder(folder: Path, *, shared: bool = False, wait: float = 0.0) -> Iterator[None]:
    """Make a folder, remove what killed processes left there, and keep other processes from writing into it inside the
    `with` block; a folder that is empty then is removed.

    The system frees the lock of a process that dies, and on a network file system that of a machine that is lost. On a file
    system without locks, and in an object store, nothing is locked.

    Args:
        folder: made if it does not exist.
        shared: let other processes write that share it, too; nothing is removed, as it may be theirs.
        wait: seconds to wait for another process that has locked it.

    Raises:
        FolderInUse: another process is writing into it.
        InputError: the folder cannot be written to.
    """
    if is_remote(folder):
        make_folder(folder)
        yield
        return
    deadline, file = time.monotonic() + wait, None
    held_folders.append(folder)
    try:
        while True:
            with hold_interrupts():
                file = _acquire_lock(folder, shared)
            if file is not None:
                break
            if time.monotonic() >= deadline:
                raise FolderInUse(
                    f"{folder}: {lock_holder(folder) or 'another process'} is writing into it; wait until it has ended, or "
                    "choose another folder with --out"
                )
            time.sleep(0.05)
        if not shared:
            _remove_drafts(folder)
        yield
    finally:
        with hold_interrupts(), suppress(OSError):
            held_folders.remove(folder)
            if file is not None:
                with file:
                    # the file stays while other processes share the lock
                    if not shared or _try_lock(file, shared=False):
                        _remove_drafts(folder)
                        # Windows keeps a file that is open
                        if os.name == "nt":
                            file.close()
                        (folder / _LOCK_NAME).unlink(missing_ok=True)
            # the system refuses to remove a folder that is not empty
            folder.rmdir()


def lock_holder(folder: Path) -> str:
    """The process that has locked a folder, with its host and since when; "" if it is not locked."""
    if not is_remote(folder):
        with suppress(OSError), _open_lock(folder, os.O_RDWR) as file:
            return "" if _try_lock(file, shared=False) else file.read()
    return ""


def _open_lock(folder: Path, flags: int) -> Any:
    """Open the file of a lock, which may not be a link: it is written to. Raises `OSError` where it is none of ours."""
    flags |= getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    file = os.fdopen(os.open(folder / _LOCK_NAME, flags, 0o666), "r+", encoding="utf-8")
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(errno.ELOOP, "is no regular file")
    return file


def _acquire_lock(folder: Path, shared: bool) -> Any:
    """Return the open file of a lock that this process now holds; None if another process holds it."""
    while True:
        make_folder(folder)
        path = folder / _LOCK_NAME
        try:
            file = _open_lock(folder, os.O_RDWR | os.O_CREAT)
        except FileNotFoundError:
            continue  # another process has just removed the folder
        except OSError as error:
            raise InputError(
                f"{path}: is no lock of jaxbl ({error.strerror}); remove it, or choose another folder"
            ) from None
        if not _try_lock(file, shared):
            file.close()
            return None
        # the process that held the lock may have removed the file meanwhile
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), path.lstat()):
                file.truncate(0)
                file.write(f"process {os.getpid()} on {socket.gethostname()} (since {time.strftime('%Y-%m-%d %H:%M:%S')})")
                file.flush()
                return file
        file.close()


_BYTES = 1 << 30, 1 << 10
"""Where Windows locks a file, far from its text, and how many bytes: a shared lock takes one of them."""


def _try_lock(file: Any, shared: bool) -> bool:
    """Lock an open file. Returns True if that was possible, or if the file system has no locks."""
    try:
        import fcntl
    except ImportError:  # Windows
        return _try_lock_bytes(file, shared)
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK):
            raise
    return True


def _try_lock_bytes(file: Any, shared: bool) -> bool:
    import msvcrt

    start, count = _BYTES
    place, length = (start + os.getpid() % count, 1) if shared else (start, count)
    os.lseek(file.fileno(), place, os.SEEK_SET)
    try:
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, length)  # pyright: ignore[reportAttributeAccessIssue]
    except OSError:
        return False
    finally:
        os.lseek(file.fileno(), 0, os.SEEK_SET)
    return True


def _remove_drafts(folder: Path) -> None:
    """Remove the drafts that killed processes have left in a folder that is locked."""
    for place in ("", "points", "verify", "tune"):
        for draft in list_paths(folder / place, f"{_DRAFT}*"):
            remove(draft)


@contextmanager
def catch_store_errors(path: Path, action: str) -> Iterator[None]:
    """Turn any error of an object store, inside the `with` block, into an `InputError`: the path cannot be read, say."""
    try:
        yield
    except Exception as error:  # each store has exceptions of its own
        if not is_remote(path):
            raise
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(f"{path}: cannot be {action} ({reason}); name another folder, or mend the access to it") from None


def make_folder(path: Path, remedy: str = "choose another folder with --out") -> None:
    """Make a folder, which may exist, and check that it can be written to. Raises `InputError`, which ends with the remedy,
    if that is not possible."""
    probe = path / f"{_DRAFT}{os.getpid()}"
    if is_remote(path):
        with catch_store_errors(path, "written to"):
            probe.write_bytes(b"")
            probe.unlink()
        return
    try:
        # Parquet's library takes names in UTF-8 alone
        str(path).encode()
        path.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except UnicodeEncodeError:
        raise InputError(f"{path}: is no name in UTF-8; --out should name another folder") from None
    except FileExistsError:
        raise InputError(f"{path}: is a file; --out should name a folder") from None
    except NotADirectoryError:
        raise InputError(f"{path}: lies under a file; --out should name a folder") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written to ({error.strerror}); {remedy}") from None


class Subject(NamedTuple):
    """The subject of results in a folder; commands on one subject may share it.

    Attributes:
        kind: "study", "log" or such.
        name: for messages.
        identity: by which it is known again.
    """

    kind: str
    name: str = ""
    identity: str = ""


def log_subject(log: Path) -> Subject:
    """Return the subject of commands on a log."""
    return Subject("log", str(log.resolve()), str(log.resolve()))


@dataclass
class ResultFolder:
    """A folder of results with its manifest, `manifest.json`.

    Attributes:
        path: the folder.
        subject: what the results are about.
        entries: what the manifest says of each result, by the result's name: `identity` of what was asked for, checksums of
            its `files`, and what else the command keeps. A result that has `folders` checks what is in them itself.
    """

    path: Path
    subject: Subject
    entries: JsonObject = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> "ResultFolder | None":
        """Read the manifest of a folder; None if it has none. Raises `InputError` if it is damaged, or of another format."""
        with catch_store_errors(path, "read"):
            if not (path / MANIFEST).exists():
                return None
        data = read_json(path / MANIFEST)
        paths = map(PurePath, _list_names(data.get("results", {})))
        if any(file.is_absolute() or ".." in file.parts for file in paths):
            raise DamagedFile(path / MANIFEST, "names files in other folders")
        if data.get("format") != FORMAT:
            raise InputError(
                f"{path / MANIFEST}: has format {data.get('format')}; this version reads {FORMAT}; read it with the jaxbl "
                "that wrote it, or make the results anew in another folder"
            )
        return cls(path, Subject(*data["subject"]), data["results"])

    def write_manifest(self) -> None:
        """Write the manifest. Raises as :func:`write_atomic`."""
        data = {"format": FORMAT, "subject": self.subject, "results": self.entries}
        write_atomic(self.path / MANIFEST, json_with_checksum(data))

    def is_whole(self, result: str, identity: str) -> bool:
        """Return True if a result is there, is what was asked for, and none of its files has changed."""
        entry = self.entries.get(result, {})
        return entry.get("identity") == identity and all(
            file_checksum(self.path / name) == expected for name, expected in entry["files"].items()
        )

    def check_file(self, name: str) -> Path:
        """Return the path of a result's file that is what was written. Raises `InputError` otherwise."""
        expected = [entry["files"][name] for entry in self.entries.values() if name in entry["files"]]
        if file_checksum(self.path / name) not in expected:
            raise InputError(f"{self.path / name}: is missing, damaged or edited; run the command that wrote it again")
        return self.path / name

    @contextmanager
    def write_files(self, result: str, **entry: Any) -> Iterator[Path]:
        """Yield an empty folder; what is written there appears in this one when the `with` block ends, with the manifest,
        and takes the place of the files of an earlier result of that name. Raises as :func:`write_atomic`."""
        place = None if is_remote(self.path) else self.path
        with catch_write_errors(self.path), TemporaryDirectory(prefix=_DRAFT, dir=place) as name:
            draft = Path(name)
            yield draft
            files = {file.relative_to(draft).as_posix(): file_checksum(file) for file in draft.rglob("*") if file.is_file()}
            with hold_interrupts():
                before = self.entries.get(result, {}).get("files", {})
                # the folder is this subject's before there is anything else in it
                self.write_manifest()
                self.entries[result] = entry | {"files": files}
                listed = {file for other in self.entries.values() for file in other["files"]}
                for file in before.keys() - listed:
                    remove(self.path / file)
                for file in files:
                    move_file(draft / file, self.path / file)
                self.write_manifest()


def _list_names(entries: JsonObject) -> list[str]:
    """List the files and folders of all results."""
    return [name for entry in entries.values() for name in (*entry["files"], *entry.get("folders", ()))]


def file_checksum(path: Path) -> str:
    """Return the checksum of a file; "" if it cannot be read."""
    try:
        return checksum(path.read_bytes())
    except OSError:
        return ""


def recover_log(folder: Path) -> ResultFolder | None:
    """Return the folder of a log whose manifest is lost or damaged, by a summary that names the log; None without one.
    All in it is made anew."""
    for file in list_paths(folder, "*.json"):
        with suppress(OSError, ValueError, KeyError, TypeError, RecursionError):
            return ResultFolder(folder, log_subject(Path(json.loads(file.read_bytes())["file"])))
    return None


def claim_folder(
    folder: Path,
    subject: Subject,
    *,
    overwrite: bool = False,
    asked: tuple[str, str] = ("", ""),
    recover: Callable[[Path], ResultFolder | None] = recover_log,
) -> ResultFolder:
    """Check that results may be written into a folder, which is locked (:func:`lock_folder`).

    Args:
        folder: folder of the results.
        subject: what they are about.
        overwrite: remove results of another subject.
        asked: name and identity of a result; another one of this name is not written over, either.
        recover: finds out what a folder holds whose manifest is lost or damaged.

    Raises:
        InputError: the folder holds other results or other files, or its manifest is damaged.
    """
    results = fault = None
    try:
        results = ResultFolder.read(folder)
    except InputError as error:
        fault = error
    results = results or recover(folder)
    if results is None:
        if fault and not (overwrite and isinstance(fault, DamagedFile)):
            raise fault
        if not fault and any(path.name != _LOCK_NAME for path in list_paths(folder, "*")):
            raise InputError(
                f"{folder}: is not empty and holds no results with a {MANIFEST} (an earlier jaxbl wrote none there); choose "
                "another folder with --out, where they are made anew"
            )
        results = ResultFolder(folder, subject)
    elif results.subject._replace(name=subject.name) == subject and (
        results.entries.get(asked[0], {}).get("identity") in (None, asked[1])
    ):
        return results
    elif not overwrite:
        kind = f"another {subject.kind}" if results.subject.kind == subject.kind else f"a {results.subject.kind}"
        option = "--static" if subject.kind == "page" else "--out"
        remedy = f"choose another folder with {option}{', or --overwrite' if subject.kind in ('study', 'log') else ''}"
        raise InputError(f"{folder}: holds results of {kind} ({results.subject.name or 'untitled'}); {remedy}")
    for name in _list_names(results.entries):
        remove(folder / name)
    remove(folder / MANIFEST)
    return ResultFolder(folder, subject)


@contextmanager
def open_results(folder: Path, subject: Subject, **options: Any) -> Iterator[ResultFolder]:
    """Lock a folder for results (:func:`lock_folder`) and claim it (:func:`claim_folder`, with its options)."""
    with lock_folder(folder):
        yield claim_folder(folder, subject, **options)


def check_result(file: Path) -> Path:
    """Return the path of a result's file that is what was written. Raises `InputError` if it is not."""
    results = ResultFolder.read(file.parent)
    if results is None:
        raise InputError(f"{file.parent}: holds no results of this version (no {MANIFEST}); run the command that makes them")
    return results.check_file(file.name)


def read_result(file: Path) -> JsonObject:
    """Read a JSON file of a result. Raises as :func:`check_result`."""
    return json.loads(check_result(file).read_bytes())


def run_or_read(
    task: Any, file: Path, run: Callable[[Any], Any], write: Callable[[Any, ResultFolder], object], *, overwrite: bool
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
        InputError: as :func:`claim_folder`, or as the task does.
    """
    with open_results(file.parent, log_subject(task.record.path), overwrite=overwrite) as results:
        if results.is_whole(file.name, task.identity):
            return read_result(file)
        result = run(task)
        write(result, results)
    return result.summary
