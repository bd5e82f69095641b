"""JSON schema of a study, by which editors complete and check its keys as they are typed."""

from collections.abc import Iterator
from typing import Any

from .study import Config

_LIMITS = {"gt": "exclusiveMinimum", "ge": "minimum", "lt": "exclusiveMaximum", "le": "maximum"}
"""What pydantic leaves as it is on keys that may be left out."""


def build_schema() -> dict[str, Any]:
    """The schema of a TOML study (draft 7), with units and meanings of its keys.

    A table may get its other keys from a file that the study includes, and commands on logs need less than others, so that
    keys are asked for only in arrays of tables, which are not merged.
    """
    found = Config.model_json_schema(by_alias=True)
    tables = found.pop("$defs")
    whole = _whole(found, tables)
    found = _plain(found, whole=False)
    definitions = {name: _plain(table, whole=name in whole) for name, table in sorted(tables.items())}
    about = {"$schema": "http://json-schema.org/draft-07/schema#", "title": "Study of jaxbl"}
    return about | found | {"$defs": definitions}


def _whole(found: dict[str, Any], tables: dict[str, Any]) -> set[str]:
    """Names of tables that occur in arrays alone."""
    merged: set[str] = set()
    waiting = list(_names(found))
    while waiting:
        name = waiting.pop()
        if name not in merged:
            merged.add(name)
            waiting += _names(tables[name])
    return set(tables) - merged


def _names(node: Any) -> Iterator[str]:
    """Tables that a part of a schema refers to, but for what is in arrays."""
    if isinstance(node, list):
        for one in node:
            yield from _names(one)
    elif isinstance(node, dict):
        if "$ref" in node:
            yield node["$ref"].rpartition("/")[2]
        for key, one in node.items():
            if key not in ("items", "discriminator"):
                yield from _names(one)


def _plain(node: Any, *, whole: bool) -> Any:
    """A part of a schema as TOML has it, which knows no null, with units in the descriptions."""
    if isinstance(node, list):
        return [_plain(one, whole=whole) for one in node]
    if not isinstance(node, dict):
        return node
    node = dict(node)
    # keys of a table may have any of these names
    properties = node.pop("properties", None)
    for key in ("title", "discriminator", *(("default",) if node.get("default", "") is None else ())):
        node.pop(key, None)
    if not whole:
        node.pop("required", None)
    if unit := node.pop("unit", None):
        node["description"] = f"{node.get('description', '')} ({unit})".strip()
    for key in ("anyOf", "oneOf"):
        if key in node:
            kept = [one for one in node.pop(key) if one != {"type": "null"}]
            # without a kind a table may be any that has its keys
            node |= {"anyOf": kept} if len(kept) > 1 else {"allOf": kept}
    found = {_LIMITS.get(key, key): _plain(one, whole=whole or key == "items") for key, one in node.items()}
    if "$ref" in found and len(found) > 1:
        found["allOf"] = [{"$ref": found.pop("$ref")}]
    if properties is not None:
        found["properties"] = {key: _plain(one, whole=whole) for key, one in properties.items()}
    return found
