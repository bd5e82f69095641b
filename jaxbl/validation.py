"""Checks of what users write: files, sizes of data, strict tables. Each error is one line that says what is wrong."""

import difflib
import os
import re
import stat
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, BinaryIO

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from .errors import InputError, shorten

_KEY_LENGTH = 200
"""Most characters of a key: file names have at most 255."""
_TEXT_LENGTH = 10_000
"""Most characters of a text: remarks fill a page, not a book."""
_NESTING_DEPTH = 16
"""Most levels of tables and arrays: a study needs five."""
_VALUE_COUNT = 300_000
"""Most values of a study, which take some seconds to read. Longer axes have start, stop and num; inputs, a recorded file."""
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff]")
"""Control characters but for those of white space, and half characters."""
_LISTED_FILES = 5
"""Most files that a message names."""
_SMALLEST, LARGEST = 1e-30, 1e30
"""The least number that may be a divisor, and the largest magnitude of any number: float32 ends at 1e-38 and 1e38, and no
drive has quantities near that in SI units."""


def check_file(path: Path, size_limit: int | None = None) -> None:
    """Refuse a file without an end (a pipe, a device) or of more than `size_limit` bytes, before anything is read.

    Raises:
        InputError: it is a pipe or a device, or too large. The message is without the path.
        OSError: there is no such file.
    """
    status = path.stat()
    _check_end(status)
    if size_limit is not None and status.st_size > size_limit:
        raise InputError(f"has {status.st_size / 1e6:.0f} MB; it should have at most {size_limit / 1e6:.0f} MB")


def _check_end(status: os.stat_result) -> None:
    if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
        raise InputError("is a pipe or a device; a file is needed")


def open_regular_file(path: Path) -> BinaryIO:
    """Open a file for reading, without waiting for whoever writes into a pipe that has taken its place.

    Raises:
        InputError: it is a pipe or a device. The message is without the path.
        OSError: it cannot be opened, or is a folder.
    """
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    try:
        _check_end(os.fstat(descriptor))
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def _check_not_tiny(number: float) -> float:
    if 0.0 < number < _SMALLEST:
        raise table_error(f"should be at least {_SMALLEST:g}, not {number:g}")
    return number


Positive = Annotated[float, AfterValidator(_check_not_tiny)]
"""Type of a key that has to be above 0, since it is a divisor."""


def check_sizes(data: Any) -> None:
    """Refuse data from a text file (or passed in its place) that are too large for tables and terminals.

    Raises:
        InputError: nested too deep, too many values, a number of impossible size, a long name or text, or control
            characters in it. The message names the key.
    """
    for count, _ in enumerate(_check_members("", data, 0), 1):
        if count > _VALUE_COUNT:
            raise InputError(
                f"holds more than {_VALUE_COUNT} values; give axes by start, stop and num, inputs as a recorded file"
            )


def _check_members(key: str, value: Any, depth: int) -> Iterator[None]:
    """Check a value, then its members and theirs if it is a table or an array; yield before each."""
    yield
    if not isinstance(value, dict | list | tuple):
        if fault := _find_fault(value):
            raise InputError(f"{shorten(key, _KEY_LENGTH)}: {fault}")
        return
    if depth == _NESTING_DEPTH:
        raise InputError(
            f"{shorten(key, _KEY_LENGTH)}: tables or arrays within one another; at most {_NESTING_DEPTH} are possible"
        )
    is_table = isinstance(value, dict)
    for name, member in value.items() if is_table else enumerate(value):
        member_key = f"{key}[{name}]"
        if is_table:
            member_key = f"{key}.{name}" if key else str(name)
            if fault := _find_fault(str(name), _KEY_LENGTH):
                raise InputError(f"{shorten(member_key, _KEY_LENGTH)}: a key {fault}")
        yield from _check_members(member_key, member, depth + 1)


def _find_fault(value: Any, text_length: int = _TEXT_LENGTH) -> str:
    """Say what is wrong with a single value; "" if nothing is."""
    if isinstance(value, str):
        if len(value) > text_length:
            return f"should have at most {text_length} characters, not {len(value)}"
        if control := _CONTROL.search(value):
            return f"should have no control characters such as {control[0]!r}"
    elif isinstance(value, float):
        if LARGEST < abs(value) < float("inf"):
            return f"should be at most {LARGEST:g} in magnitude, not {value:g}"
    elif isinstance(value, int) and not -(2**63) <= value < 2**63:
        return f"should be a number of 64 bits, not {shorten(hex(value), 40)}"
    return ""


def explain_missing_file(path: Path, endings: Collection[str]) -> str:
    """Return a message for a file that is not there: it names the file with the nearest name, or all with those endings."""
    folder = path.parent
    if not folder.is_dir():
        return f"no such file: there is no folder {folder}"
    try:
        names = sorted(file.name for file in folder.iterdir() if file.suffix.lower() in endings and file.is_file())
    except OSError:
        names = []
    stems = {Path(name).stem: name for name in reversed(names)}
    if close := difflib.get_close_matches(path.stem, stems, n=1, cutoff=0.6):
        return f"no such file; did you mean {folder / stems[close[0]]}?"
    if not names:
        where = folder if folder.name else "this folder"
        return f"no such file; {where} has none of its kind"
    return f"no such file; here are {', '.join([*names[:_LISTED_FILES], *(['...'] if len(names) > _LISTED_FILES else [])])}"


def suggest_word(word: str, valid: Iterable[str]) -> str:
    """Return a hint: the valid word that is nearest to `word`, or all of them if none is near."""
    valid = list(valid)
    if len(word) > _KEY_LENGTH:
        return f"it should have at most {_KEY_LENGTH} characters"
    close = difflib.get_close_matches(word, valid, n=1, cutoff=0.6)
    return f"did you mean '{close[0]}'?" if close else f"valid: {', '.join(valid)}"


class StrictTable(BaseModel):
    """A table of the config, with strict types, finite numbers and no unknown keys."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, validate_default=False)

    @model_validator(mode="before")
    @classmethod
    def _check_keys(cls, data: Any) -> Any:
        """Refuse unknown keys. Turn arrays into lists, and NumPy's numbers into Python's."""
        if isinstance(data, Mapping):
            data = {key: value.tolist() if hasattr(value, "tolist") else value for key, value in data.items()}
            keys = [*(field.alias or name for name, field in cls.model_fields.items()), *cls.further_keys()]
            for key in data:
                if key not in keys:
                    hint = suggest_word(str(key), keys)
                    raise PydanticCustomError("unknown_key", "unknown key '{key}'; {hint}", {"key": key, "hint": hint})
        return data

    @classmethod
    def further_keys(cls) -> Collection[str]:
        """Keys that a table may have beside its fields."""
        return ()


def table_error(message: str) -> PydanticCustomError:
    """Return the exception that a table's own check raises."""
    return PydanticCustomError("consistency", message)  # type: ignore[arg-type]


Key = tuple[str | int, ...]
"""The place of a value in a config: keys of tables and positions in arrays."""


def explain_first_error(error: ValidationError, location: list[str | int] | None = None) -> tuple[Key, str]:
    """Return the key of the first error, and one line that says what is wrong with it.

    `location` is the key, if pydantic's own location contains more than keys.
    """
    first = error.errors()[0]
    location = list(first["loc"]) if location is None else location
    dotted = ""
    for part in location:
        dotted += f"[{part}]" if isinstance(part, int) else f".{part}" if dotted else str(part)
    prefix = f"{dotted}: " if dotted else ""
    kind, context, value = first["type"], first.get("ctx", {}), abbreviate(first["input"])
    key = tuple(location)
    if kind == "union_tag_invalid":
        tags = [tag.strip(" '") for tag in context["expected_tags"].split(",")]
        name = context["discriminator"].strip("'")
        return (*key, name), f"{dotted}.{name}: unknown {name} '{context['tag']}'; {suggest_word(context['tag'], tags)}"
    message = first["msg"].removeprefix("Input ")
    if kind == "missing":
        message = "this key is missing"
    elif kind == "union_tag_not_found":
        message = f"the key {context['discriminator']} is missing"
    elif kind == "unknown_key":
        key = (*key, context["key"])
    elif kind != "consistency":
        message = f"{_SHOULD_BE.get(kind, message)}, not {value}"
    return key, f"{prefix}{message}"


_SHOULD_BE = {"list_type": "should be an array"} | dict.fromkeys(
    ("model_type", "model_attributes_type", "dict_type"), "should be a table"
)
"""What pydantic says in other words, by the kind of error."""


def abbreviate(value: Any) -> str:
    """Return a value as messages show it."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
