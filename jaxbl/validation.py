"""What users write, checked: strict tables, and one line that says what is wrong."""

import difflib
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from pydantic_core import PydanticCustomError


def nearest(word: str, words: Any) -> str:
    """A hint that names the nearest valid word, or all of them where none is near."""
    words = list(words)
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
