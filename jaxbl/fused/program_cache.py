"""Compiled programs on disk that are found without tracing.

JAX keeps compiled code, too, but finds it by the traced program, and to trace one takes longer than it runs. Here the key is
the structure of the arguments (classes, static numbers, shapes and types of arrays), the text of the whole package, the
versions of the packages that it needs, and the processor. Programs that need classes of other packages, whose text is not
known, are not stored.
"""

import dataclasses
import functools
import hashlib
import os
import pickle
import platform
import shutil
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import FunctionType
from typing import Any

import equinox as eqx
import jax

from jaxbl.workers import PROGRAMS_VARIABLE, make_private_folder

_DEPENDENCIES = "equinox", "jax", "jaxlib", "llvmlite", "numpy"
_UNUSED_DAYS = 30.0
"""Days after which programs of another version of the package are deleted, if nothing has used them."""


class UnknownArgument(Exception):
    """An argument whose meaning is not known by its text."""


def cache_folder() -> Path | None:
    """The folder for programs that :data:`PROGRAMS_VARIABLE` names; None if programs are not stored.

    Whoever sets the variable must not change the package while it runs, as tests do.
    """
    name = os.environ.get(PROGRAMS_VARIABLE)
    return _make_folder(name) if name else None


@functools.cache
def _make_folder(name: str) -> Path | None:
    """The folder of this version; None if others could write to it. Old versions are deleted."""
    # what is in them is run
    programs = make_private_folder(Path(name))
    folder = programs and make_private_folder(programs / _version_hash())
    if folder is None:
        return None
    try:
        os.utime(folder)
        for other in folder.parent.iterdir():
            if time.time() - other.stat().st_mtime > 86400.0 * _UNUSED_DAYS:
                shutil.rmtree(other, ignore_errors=True)
    except OSError:
        return None
    return folder


@functools.cache
def _version_hash() -> str:
    """Hash of the package's text, of the packages that it needs, of the processor, and of JAX's flags."""
    digest = hashlib.sha256(sys.version.encode())
    package = Path(__file__).parents[1]
    for file in sorted(package.rglob("*.py")):
        digest.update(str(file.relative_to(package)).encode() + file.read_bytes())
    for name in _DEPENDENCIES:
        with suppress(PackageNotFoundError):
            digest.update(f"{name} {version(name)}".encode())
    flags = {name: flag for name, flag in os.environ.items() if name.startswith(("JAX_", "XLA_")) and "CACHE" not in name}
    digest.update(f"{platform.machine()} {jax.default_backend()} {sorted(flags.items())}".encode())
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        digest.update("".join(sorted({line for line in lines if line.startswith(("flags", "Features", "model"))})).encode())
    return digest.hexdigest()[:16]


def program_key(name: str, *arguments: Any) -> str | None:
    """The key of a program with these arguments; None if programs are not stored, or an argument is unknown."""
    return None if cache_folder() is None else hash_program(name, *arguments)


def hash_program(name: str, *arguments: Any) -> str | None:
    """The same key, whether programs are stored or not."""
    try:
        text = f"{name} {len(jax.local_devices())} {jax.config.read('jax_enable_x64')} {_describe(arguments)}"
    except UnknownArgument:
        return None
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def load(key: str | None) -> Any:
    """Load the program of a key; None if there is none, or it cannot be read."""
    folder = cache_folder()
    if key is None or folder is None:
        return None
    with suppress(Exception):  # of any kind: written by another version, half a file, another machine's
        return pickle.loads((folder / key).read_bytes())
    return None


def save(key: str | None, program: Any) -> None:
    """Store what can be pickled under a key; without a message where that is not possible."""
    folder = cache_folder()
    if key is None or folder is None:
        return
    with suppress(Exception):  # a full disk, or no pickle: the program is made anew next time
        draft = folder / f"{key}.{os.getpid()}"
        draft.write_bytes(pickle.dumps(program))
        draft.replace(folder / key)


def _describe(argument: Any) -> str:
    """An argument as text, without the numbers in its arrays."""
    if argument is None or isinstance(argument, bool | int | float | str | bytes):
        return repr(argument)
    if eqx.is_array(argument) or isinstance(argument, jax.ShapeDtypeStruct):
        return f"{argument.dtype}{argument.shape}{getattr(argument, 'weak_type', False)}"
    if isinstance(argument, Mapping):
        return "{" + ",".join(f"{key!r}:{_describe(member)}" for key, member in sorted(argument.items())) + "}"
    if isinstance(argument, FunctionType):
        if argument.__closure__ is not None:
            raise UnknownArgument(argument.__qualname__)
        return _full_name(argument)
    if isinstance(argument, tuple | list):
        prefix = "" if type(argument) in (tuple, list) else _full_name(type(argument))
        return f"{prefix}({','.join(map(_describe, argument))})"
    if dataclasses.is_dataclass(argument) and not isinstance(argument, type):
        fields = (f"{field.name}={_describe(getattr(argument, field.name))}" for field in dataclasses.fields(argument))
        return f"{_full_name(type(argument))}({','.join(fields)})"
    raise UnknownArgument(str(type(argument)))


def _full_name(definition: Any) -> str:
    """Module and name of a class or function of this package."""
    if definition.__module__.partition(".")[0] != __name__.partition(".")[0]:
        raise UnknownArgument(f"{definition.__module__}.{definition.__qualname__}")
    return f"{definition.__module__}.{definition.__qualname__}"
