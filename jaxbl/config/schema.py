"""JSON schema of a study, by which editors complete and check its keys as they are typed."""

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
    writer = _TomlSchema(schema.pop("$defs"))
    head = {"$schema": "http://json-schema.org/draft-07/schema#", "title": "Study of jaxbl"}
    return head | writer.convert(schema, is_complete=False) | {"$defs": dict(sorted(writer.definitions.items()))}


class _TomlSchema:
    """A schema of pydantic's as TOML has it, which knows no null, with units in the descriptions.

    Attributes:
        definitions: of the tables that were met, by name. Keys are asked for in those that occur in arrays alone.
    """

    def __init__(self, tables: JsonObject):
        self._tables, self._merged = tables, set()
        self.definitions: JsonObject = {}

    def _define_table(self, name: str, is_complete: bool) -> None:
        """Define a table, anew if it has occurred in arrays alone until now."""
        if name in self._merged or (is_complete and name in self.definitions):
            return
        if not is_complete:
            self._merged.add(name)
        self.definitions[name] = self.convert(self._tables[name], is_complete=is_complete)

    def convert(self, node: Any, *, is_complete: bool) -> Any:
        """Convert a part of a schema; `is_complete` where no file that a study includes has further keys."""
        if isinstance(node, list):
            return [self.convert(child, is_complete=is_complete) for child in node]
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
            _LIMITS.get(key, key): self.convert(child, is_complete=is_complete or key == "items")
            for key, child in node.items()
        }
        if "$ref" in result:
            self._define_table(result["$ref"].rpartition("/")[2], is_complete)
            if len(result) > 1:
                result["allOf"] = [{"$ref": result.pop("$ref")}]
        if properties is not None:
            result["properties"] = {key: self.convert(child, is_complete=is_complete) for key, child in properties.items()}
        return result
