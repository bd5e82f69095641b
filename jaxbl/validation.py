"""What users write, checked: files that have an end, sizes, strict tables, and one line that says what is wrong."""

import difflib
import stat
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from .errors import InputError, shortened

_NAME = 200
"""Characters of a key: file names have at most 255."""
_TEXT = 10_000
"""Characters of a text: remarks fill a page, not a book."""
_DEPTH = 16
"""Tables and arrays within one another: a study needs five."""
_VALUES = 300_000
"""Values of a study, some seconds of reading. More are given as start, stop and num, or by a recorded file."""
_LISTED = 5
"""Files that a message names."""
_LEAST, LARGEST = 1e-30, 1e30
"""The least positive number that may be divided by, and the largest magnitude of any: float32 ends at 1e-38 and 1e38, and no
drive has quantities near that in SI units."""


def check_file(path: Path, most: int | None = None) -> None:
    """Refuse what has no end or is larger than `most` bytes, before anything is read.

    Raises:
        InputError: a pipe or a device, or too large; the message is without the path.
        OSError: it cannot be found.
    """
    found = path.stat()
    if not (stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode)):
        raise InputError("is a pipe or a device; a file is needed")
    if most is not None and found.st_size > most:
        raise InputError(f"has {found.st_size / 1e6:.0f} MB; it should have at most {most / 1e6:.0f} MB")


def _not_tiny(number: float) -> float:
    if 0.0 < number < _LEAST:
        raise wrong(f"should be at least {_LEAST:g}, not {number:g}")
    return number


Positive = Annotated[float, AfterValidator(_not_tiny)]
"""Type of a key that has to be above 0, as it is divided by."""


def check_sizes(data: Any) -> None:
    """Refuse data out of a text file, or given in its place, that are beyond what tables and terminals can take.

    Raises:
        InputError: nested too deep, too many values, a number of no possible size, a long name or text, or control
            characters in it; the message names the key.
    """
    count = 0
    # without recursion: that is what deep data break
    waiting = [iter([("", data)])]
    while waiting:
        entry = next(waiting[-1], None)
        if entry is None:
            waiting.pop()
            continue
        key, value = entry
        count += 1
        if count > _VALUES:
            raise InputError(
                f"holds more than {_VALUES} values; give axes by start, stop and num, inputs as a recorded file"
            )
        if isinstance(value, dict | list | tuple):
            if len(waiting) > _DEPTH:
                raise InputError(
                    f"{shortened(key, _NAME)}: tables or arrays within one another; at most {_DEPTH} are possible"
                )
            waiting.append(_entries(key, value))
        elif fault := _fault(value):
            raise InputError(f"{shortened(key, _NAME)}: {fault}")


def _entries(key: str, value: Any) -> Iterator[tuple[str, Any]]:
    """What a table or an array holds, with the key of each."""
    if not isinstance(value, Mapping):
        yield from ((f"{key}[{i}]", one) for i, one in enumerate(value))
        return
    for name, one in value.items():
        place = f"{key}.{name}" if key else str(name)
        if fault := _fault(str(name), _NAME):
            raise InputError(f"{shortened(place, _NAME)}: a key {fault}")
        yield place, one


def _fault(value: Any, longest: int = _TEXT) -> str:
    """What is wrong with a single value; "" if nothing is."""
    if isinstance(value, str):
        if len(value) > longest:
            return f"should have at most {longest} characters, not {len(value)}"
        if not value.isprintable():
            bad = next(
                (c for c in value if (c < " " and c not in "\t\n\r") or "\x7f" <= c < "\xa0" or "\ud800" <= c < "\ue000"), ""
            )
            return f"should have no control characters such as {bad!r}" if bad else ""
    elif isinstance(value, float):
        if LARGEST < abs(value) < float("inf"):
            return f"should be at most {LARGEST:g} in magnitude, not {value:g}"
    elif isinstance(value, int) and not -(2**63) <= value < 2**63:
        return f"should be a number of 64 bits, not {shortened(hex(value), 40)}"
    return ""


def no_such_file(path: Path, endings: Collection[str]) -> str:
    """What to say of a file that is not there: one beside it whose name is near, or those there are, of some endings."""
    folder = path.parent
    if not folder.is_dir():
        return f"no such file: there is no folder {folder}"
    try:
        names = sorted(one.name for one in folder.iterdir() if one.suffix.lower() in endings and one.is_file())
    except OSError:
        names = []
    stems = {Path(name).stem: name for name in reversed(names)}
    if close := difflib.get_close_matches(path.stem, stems, n=1, cutoff=0.6):
        return f"no such file; did you mean {folder / stems[close[0]]}?"
    if not names:
        where = folder if folder.name else "this folder"
        return f"no such file; {where} has none of its kind"
    return f"no such file; here are {', '.join([*names[:_LISTED], *(['...'] if len(names) > _LISTED else [])])}"


def nearest(word: str, words: Any) -> str:
    """A hint that names the nearest valid word, or all of them where none is near."""
    words = list(words)
    if len(word) > _NAME:
        return f"it should have at most {_NAME} characters"
    close = difflib.get_close_matches(word, words, n=1, cutoff=0.6)
    return f"did you mean '{close[0]}'?" if close else f"valid: {', '.join(words)}"


class StrictTable(BaseModel):
    """A table of the config: strict types, finite numbers, no unknown keys."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, validate_default=False)

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, data: Any) -> Any:
        if isinstance(data, Mapping):
            keys = [field.alias or name for name, field in cls.model_fields.items()]
            for key in data:
                if key not in keys:
                    hint = nearest(str(key), keys)
                    raise PydanticCustomError("unknown_key", "unknown key '{key}'; {hint}", {"key": key, "hint": hint})
        return data


def wrong(message: str) -> PydanticCustomError:
    """What a table's own check raises."""
    return PydanticCustomError("consistency", message)  # type: ignore[arg-type]


Key = tuple[str | int, ...]
"""Where a value lies in a config: keys of tables and positions in arrays."""


def first_error(error: ValidationError, location: list[str | int] | None = None) -> tuple[Key, str]:
    """The first error: the key that is wrong, and one line that says so.

    `location` is the key, where pydantic's own has more in it than keys.
    """
    first = error.errors()[0]
    location = list(first["loc"]) if location is None else location
    key = ""
    for part in location:
        key += f"[{part}]" if isinstance(part, int) else f".{part}" if key else str(part)
    where = f"{key}: " if key else ""
    kind, context, given = first["type"], first.get("ctx", {}), brief(first["input"])
    place = tuple(location)
    if kind == "missing":
        return place, f"{where}this key is missing"
    if kind == "union_tag_invalid":
        tags = [t.strip(" '") for t in context["expected_tags"].split(",")]
        name = context["discriminator"].strip("'")
        return (*place, name), f"{key}.{name}: unknown {name} '{context['tag']}'; {nearest(context['tag'], tags)}"
    if kind == "union_tag_not_found":
        return place, f"{where}the key {context['discriminator']} is missing"
    if kind in ("model_type", "model_attributes_type", "dict_type"):
        return place, f"{where}should be a table, not {given}"
    if kind == "list_type":
        return place, f"{where}should be an array, not {given}"
    message = first["msg"].removeprefix("Input ")
    if kind == "unknown_key":
        return (*place, context["key"]), f"{where}{message}"
    if kind == "consistency":
        return place, f"{where}{message}"
    return place, f"{where}{message}, not {given}"


def brief(given: Any) -> str:
    """A value as messages show it."""
    text = repr(given)
    return text if len(text) <= 80 else f"{text[:77]}..."
