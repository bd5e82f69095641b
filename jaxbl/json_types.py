"""The type of what JSON and TOML files hold."""

from typing import Any

JsonObject = dict[str, Any]
"""An object of JSON, or a table of TOML: values by key."""
