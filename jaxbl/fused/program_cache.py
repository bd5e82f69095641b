"""Compiled programs on disk, found without tracing: by what a function is given, and by all that could change the code.

JAX keeps compiled code, too, but finds it by the traced program, and to trace one takes longer than it runs. Here the key is
the structure of the arguments (classes, static numbers, shapes and types of arrays), the text of the whole package, the
versions of what it stands on, and the processor. Programs that need classes of other
packages, whose text is not known, are not kept.
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

_STANDS_ON = "equinox", "jax", "jaxlib", "lineax", "llvmlite", "numpy", "optimistix"
_OLD = 30.0
"""Days after which programs of another version of the package are deleted, if nothing has used them."""


class UnknownArgument(Exception):
    """An argument whose meaning is not known by its text."""


def cache_folder() -> Path | None:
    """The folder, if programs are kept: as :data:`PROGRAMS_VARIABLE` says. Whoever sets it must not change the package while
    it runs, as tests do."""
    name = os.environ.get(PROGRAMS_VARIABLE)
    return _folder(name) if name else None


@functools.cache
def _folder(name: str) -> Path | None:
    own = Path(name) / _version()
    # what is in them is run
    if not (make_private_folder(own.parent) and make_private_folder(own)):
        return None
    try:
        os.utime(own)
        for other in own.parent.iterdir():
            if time.time() - other.stat().st_mtime > 86400.0 * _OLD:
                shutil.rmtree(other, ignore_errors=True)
    except OSError:
        return None
    return own


@functools.cache
def _version() -> str:
    """Hash of the package's text, of what it stands on, of the processor, and of JAX's flags."""
    found = hashlib.sha256(sys.version.encode())
    package = Path(__file__).parents[1]
    for file in sorted(package.rglob("*.py")):
        found.update(str(file.relative_to(package)).encode() + file.read_bytes())
    for name in _STANDS_ON:
        with suppress(PackageNotFoundError):
            found.update(f"{name} {version(name)}".encode())
    flags = {name: value for name, value in os.environ.items() if name.startswith(("JAX_", "XLA_")) and "CACHE" not in name}
    found.update(f"{platform.machine()} {jax.default_backend()} {sorted(flags.items())}".encode())
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        found.update("".join(sorted({line for line in lines if line.startswith(("flags", "Features", "model"))})).encode())
    return found.hexdigest()[:16]


def program_key(what: str, *given: Any) -> str | None:
    """Name of a program, `what` it is and what it is given; None where none are kept, or its arguments are unknown."""
    return None if cache_folder() is None else hash_program(what, *given)


def hash_program(what: str, *given: Any) -> str | None:
    """As :func:`program_key`, whether programs are kept or not."""
    try:
        text = f"{what} {len(jax.local_devices())} {jax.config.read('jax_enable_x64')} {_described(given)}"
    except UnknownArgument:
        return None
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def load(key: str | None) -> Any:
    """What is kept under a name; None if nothing is, or it cannot be read."""
    folder = cache_folder()
    if key is None or folder is None:
        return None
    with suppress(Exception):  # of any kind: written by another version, half a file, another machine's
        return pickle.loads((folder / key).read_bytes())
    return None


def save(key: str | None, value: Any) -> None:
    """Keep a value that can be pickled; without a word where that is not possible."""
    folder = cache_folder()
    if key is None or folder is None:
        return
    with suppress(Exception):  # a full disk, a value that cannot be pickled: the program is made anew next time
        new = folder / f"{key}.{os.getpid()}"
        new.write_bytes(pickle.dumps(value))
        new.replace(folder / key)


def _described(value: Any) -> str:
    """A value as text: all of it but what arrays hold."""
    if value is None or isinstance(value, bool | int | float | str | bytes):
        return repr(value)
    if eqx.is_array(value) or isinstance(value, jax.ShapeDtypeStruct):
        return f"{value.dtype}{value.shape}{getattr(value, 'weak_type', False)}"
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key!r}:{_described(one)}" for key, one in sorted(value.items())) + "}"
    if isinstance(value, FunctionType):
        if value.__closure__ is not None:
            raise UnknownArgument(value.__qualname__)
        return _named(value)
    if isinstance(value, tuple | list):
        named = "" if type(value) in (tuple, list) else _named(type(value))
        return f"{named}({','.join(map(_described, value))})"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        each = (f"{field.name}={_described(getattr(value, field.name))}" for field in dataclasses.fields(value))
        return f"{_named(type(value))}({','.join(each)})"
    raise UnknownArgument(str(type(value)))


def _named(thing: Any) -> str:
    """Module and name of a class or function of this package."""
    if thing.__module__.partition(".")[0] != __name__.partition(".")[0]:
        raise UnknownArgument(f"{thing.__module__}.{thing.__qualname__}")
    return f"{thing.__module__}.{thing.__qualname__}"
