"""Hashes of what the pictures in `figures/` are drawn from: `python docs/picture_inputs.py NAME ...` writes those of these
pictures, once they are drawn anew by their command and looked at; a test compares all of them."""

import hashlib
import json
import re
import sys
import tomllib
from pathlib import Path

import tomli_w

ROOT = Path(__file__).parents[1]
FIGURES = ROOT / "docs" / "figures"
TABLE = FIGURES / "inputs.toml"


def read_table() -> dict[str, dict[str, str]]:
    """The command, the input files and their hash of each picture, by its name."""
    return tomllib.loads(TABLE.read_text(encoding="utf-8"))


def read_input(file: str) -> str:
    """What decides a picture in a study, a page with studies, or a program: no comments."""
    text = (ROOT / file).read_text(encoding="utf-8")
    if file.endswith(".toml"):
        return json.dumps(tomllib.loads(text), sort_keys=True)
    if file.endswith(".md"):
        return "".join(re.findall(r"```(?:toml|python)\n(.*?)```", text, re.S))
    return "\n".join(line for line in text.splitlines() if line.strip() and not line.strip().startswith("#"))


def hash_inputs(files: str) -> str:
    """The hash of input files."""
    return hashlib.sha256("\n".join(map(read_input, files.split())).encode()).hexdigest()[:16]


if __name__ == "__main__":
    table = read_table()
    for name in sys.argv[1:]:
        table[name]["hash"] = hash_inputs(table[name]["inputs"])
    TABLE.write_text(tomli_w.dumps(table), encoding="utf-8")
