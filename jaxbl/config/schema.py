"""JSON schema of a study, by which editors complete and check its keys as they are typed."""

from collections.abc import Iterator
from typing import Any

from jaxbl.json_types import JsonObject

from .study import Config

_LIMITS = {"gt": "exclusiveMinimum", "ge": "minimum", "lt": "exclusiveMaximum", "le": "maximum"}
"""What pydantic leaves as it is on keys that may be left out."""


def build_schema() -> JsonObject:
    """The schema of a TOML study (draft 7), with units and meanings of its keys.

    A table may get its other keys from a file that the study includes, and commands on logs need less than others, so that
    keys are asked for only in arrays of tables, which are not merged.
    """
    schema = Config.model_json_schema(by_alias=True)
    tables = schema.pop("$defs")
    array_tables = _find_array_tables(schema, tables)
    schema = _to_toml_schema(schema, is_complete=False)
    definitions = {name: _to_toml_schema(table, is_complete=name in array_tables) for name, table in sorted(tables.items())}
    head = {"$schema": "http://json-schema.org/draft-07/schema#", "title": "Study of jaxbl"}
    return head | schema | {"$defs": definitions}


def _find_array_tables(schema: JsonObject, tables: JsonObject) -> set[str]:
    """Names of tables that occur in arrays alone."""
    merged: set[str] = set()
    waiting = list(_find_merged_tables(schema))
    while waiting:
        name = waiting.pop()
        if name not in merged:
            merged.add(name)
            waiting += _find_merged_tables(tables[name])
    return set(tables) - merged


def _find_merged_tables(node: Any) -> Iterator[str]:
    """Tables that a part of a schema refers to, but for what is in arrays."""
    if isinstance(node, list):
        for child in node:
            yield from _find_merged_tables(child)
    elif isinstance(node, dict):
        if "$ref" in node:
            yield node["$ref"].rpartition("/")[2]
        for key, child in node.items():
            if key not in ("items", "discriminator"):
                yield from _find_merged_tables(child)


def _to_toml_schema(node: Any, *, is_complete: bool) -> Any:
    """A part of a schema as TOML has it, which knows no null, with units in the descriptions."""
    if isinstance(node, list):
        return [_to_toml_schema(child, is_complete=is_complete) for child in node]
    if not isinstance(node, dict):
        return node
    node = dict(node)
    # keys of a table may have any of these names
    properties = node.pop("properties", None)
    for key in ("title", "discriminator", *(("default",) if node.get("default", "") is None else ())):
        node.pop(key, None)
    if not is_complete:
        node.pop("required", None)
    if unit := node.pop("unit", None):
        node["description"] = f"{node.get('description', '')} ({unit})".strip()
    for key in ("anyOf", "oneOf"):
        if key in node:
            alternatives = [child for child in node.pop(key) if child != {"type": "null"}]
            # without a kind a table may be any that has its keys
            node |= {"anyOf": alternatives} if len(alternatives) > 1 else {"allOf": alternatives}
    result = {
        _LIMITS.get(key, key): _to_toml_schema(child, is_complete=is_complete or key == "items")
        for key, child in node.items()
    }
    if "$ref" in result and len(result) > 1:
        result["allOf"] = [{"$ref": result.pop("$ref")}]
    if properties is not None:
        result["properties"] = {key: _to_toml_schema(child, is_complete=is_complete) for key, child in properties.items()}
    return result
