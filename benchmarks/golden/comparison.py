"""Compare the results of two sides, file by file: keys, names and numbers of JSON and TOML, tables, and text."""

import json
import math
import re
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

MEASURED = {"checksum", "seconds", "jaxbl"}
"""Keys and columns that differ from run to run, or follow from others; that they are there is compared."""
_WORDS = 4
"""A string of as many words is a sentence: it may be reworded. Shorter ones are names, units and verdicts."""


class Difference(NamedTuple):
    """One difference.

    Attributes:
        file: below the folder of the golden.
        place: key path with `[]` for any index, column, or line; "" for the whole file.
        what: how the sides differ there, in a few words.
        relative: of numbers, by how much, relative to the larger of both.
        is_sentence: the sides say the same thing in other words, perhaps: that alone is no move.
    """

    file: str
    place: str
    text: str
    relative: float = 0.0
    is_sentence: bool = False

    def __str__(self) -> str:
        return f"{': '.join(filter(None, (self.file, self.place)))}: {self.text}"

    @property
    def address(self) -> str:
        """File and place, as the list of expected differences names it."""
        return f"{self.file}: {self.place}" if self.place else self.file


def compare_folders(base: Path, tree: Path, tolerance: float) -> list[Difference]:
    """Compare all files of two folders; numbers may differ by `tolerance`, relative to the larger of both."""
    files = {
        folder: {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()} for folder in (base, tree)
    }
    differences = [Difference(file, "", "is gone") for file in files[base] - files[tree]]
    differences += [Difference(file, "", "is new") for file in files[tree] - files[base]]
    for file in files[base] & files[tree]:
        differences += compare_files(file, base / file, tree / file, tolerance)
    return sorted(differences)


def compare_files(file: str, base: Path, tree: Path, tolerance: float) -> list[Difference]:
    """Compare two files by what their names say they hold."""
    if base.read_bytes() == tree.read_bytes():
        return []
    suffix = base.suffix
    if suffix == ".parquet":
        return compare_tables(file, pd.read_parquet(base), pd.read_parquet(tree), tolerance)
    if suffix == ".csv":
        return compare_tables(file, pd.read_csv(base), pd.read_csv(tree), tolerance)
    texts = base.read_text(encoding="utf-8"), tree.read_text(encoding="utf-8")
    if suffix in (".json", ".toml"):
        read = read_json if suffix == ".json" else tomllib.loads
        try:
            values = [read(text) for text in texts]
        except ValueError as error:
            return [Difference(file, "", f"cannot be read ({error})")]
        return gather(file, compare_values(*values, tolerance))
    return [compare_text(file, *texts)]


def read_json(text: str) -> Any:
    """Read one JSON value, or one a line."""
    try:
        return json.loads(text)
    except ValueError:
        return [json.loads(line) for line in text.splitlines()]


class _Place(NamedTuple):
    """A difference of two values: where, how, and as in :class:`Difference`."""

    path: str
    text: str
    relative: float = 0.0
    is_sentence: bool = False


def compare_values(base: Any, tree: Any, tolerance: float, path: str = "") -> Iterator[_Place]:
    """Compare two values of JSON; indices of lists are left out of the paths."""
    if isinstance(base, dict) and isinstance(tree, dict):
        for key in base.keys() | tree.keys():
            inner = f"{path}.{key}" if path else str(key)
            if key not in tree:
                yield _Place(inner, "key is gone")
            elif key not in base:
                yield _Place(inner, f"key is new ({tree[key]!r})")
            elif key not in MEASURED:
                yield from compare_values(base[key], tree[key], tolerance, inner)
    elif isinstance(base, list) and isinstance(tree, list):
        if len(base) != len(tree):
            sentences = all(is_sentence(text) for text in [*base, *tree])
            yield _Place(path, f"{len(base)} elements -> {len(tree)}", is_sentence=sentences)
        for base_element, tree_element in zip(base, tree, strict=False):
            yield from compare_values(base_element, tree_element, tolerance, f"{path}[]")
    elif is_number(base) and is_number(tree) and not (isinstance(base, int) and isinstance(tree, int)):
        relative = relative_difference(base, tree)
        if relative > tolerance:
            yield _Place(path, f"{base!r} -> {tree!r}", relative)
    elif type(base) is not type(tree) or base != tree:
        yield _Place(path, f"{base!r} -> {tree!r}", is_sentence=is_sentence(base) and is_sentence(tree))


def is_number(value: Any) -> bool:
    """True for a number that is no truth value."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def is_sentence(value: Any) -> bool:
    """True for a string that says something, and does not name it."""
    return isinstance(value, str) and len(value.split()) >= _WORDS


def relative_difference(base: float, tree: float) -> float:
    """Difference over the larger of both; 0 for the same bits or two NaNs, infinity where one alone is finite."""
    if base == tree or (math.isnan(base) and math.isnan(tree)):
        same_sign = math.copysign(1.0, base) == math.copysign(1.0, tree)
        return 0.0 if same_sign or math.isnan(base) else math.ulp(0.0)
    if not (math.isfinite(base) and math.isfinite(tree)):
        return math.inf
    return abs(base - tree) / max(abs(base), abs(tree))


def gather(file: str, places: Iterable[_Place]) -> list[Difference]:
    """One difference for all of one path: how many there are, and the largest of them."""
    by_path: dict[tuple[str, bool], list[_Place]] = {}
    for place in places:
        by_path.setdefault((place.path, place.is_sentence), []).append(place)
    differences = []
    for (path, sentences), group in by_path.items():
        largest = max(group, key=lambda place: place.relative)
        amount = f" (by {largest.relative:.1e} of it)" if largest.relative else ""
        further = f", and {len(group) - 1} more" if len(group) > 1 else ""
        differences.append(Difference(file, path, _shorten(largest.text) + amount + further, largest.relative, sentences))
    return differences


def _shorten(text: str) -> str:
    return text if len(text) <= 200 else f"{text[:197]}..."


def compare_tables(file: str, base: pd.DataFrame, tree: pd.DataFrame, tolerance: float) -> list[Difference]:
    """Compare two tables column by column; without a tolerance, bit by bit, else relative to a column's largest number."""
    differences = [Difference(file, str(name), "column is gone") for name in base.columns.difference(tree.columns)]
    differences += [Difference(file, str(name), "column is new") for name in tree.columns.difference(base.columns)]
    common = [name for name in base.columns if name in tree.columns]
    if common != [name for name in tree.columns if name in base.columns]:
        differences.append(Difference(file, "", "columns are in another order"))
    if len(base) != len(tree):
        return [*differences, Difference(file, "", f"{len(base)} rows -> {len(tree)}")]
    for name in common:
        if name not in MEASURED:
            differences += compare_columns(file, str(name), base[name].to_numpy(), tree[name].to_numpy(), tolerance)
    return differences


def compare_columns(file: str, name: str, base: np.ndarray, tree: np.ndarray, tolerance: float) -> list[Difference]:
    """Compare two columns of one length."""
    if base.dtype != tree.dtype:
        return [Difference(file, name, f"type {base.dtype} -> {tree.dtype}")]
    if base.dtype.kind != "f":
        places = compare_values(base.tolist(), tree.tolist(), tolerance, name)
        return [difference._replace(place=name) for difference in gather(file, places)]
    bits = f"u{base.dtype.itemsize}"
    differs = base.view(bits) != tree.view(bits)
    differs &= ~(np.isnan(base) & np.isnan(tree))
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.abs(base - tree)
        finite = np.abs(np.concatenate([base, tree]))
        largest = float(np.max(finite, initial=0.0, where=np.isfinite(finite)))
        if tolerance:
            differs &= ~(off <= tolerance * largest)
        relative = float(np.max(off[differs], initial=0.0)) / largest if largest else 0.0
    if not differs.any():
        return []
    relative = math.inf if math.isnan(relative) else relative
    description = f"{int(differs.sum())} of {len(base)} numbers, by up to {relative:.1e} of the largest"
    return [Difference(file, name, description, relative)]


_TOKEN = re.compile("[0-9a-f]{16}-[0-9a-f]{16}")
"""The token of an FMU: hashes of its study and of its sources."""

_COMMENTS = {
    ".c": re.compile(r"/\*.*?\*/", re.DOTALL),
    ".st": re.compile(r"\(\*.*?\*\)", re.DOTALL),
    ".xml": re.compile(r"<!--.*?-->| description=\"[^\"]*\"", re.DOTALL),
}
_COMMENTS[".h"] = _COMMENTS[".c"]


def compare_text(file: str, base: str, tree: str) -> Difference:
    """Compare two texts that differ: the first line that does, and whether only comments, or the token of an FMU, do."""
    base_lines, tree_lines = base.splitlines(), tree.splitlines()
    pairs = enumerate(zip(base_lines, tree_lines, strict=False), 1)
    number = next(
        (number for number, (first, second) in pairs if first != second), min(len(base_lines), len(tree_lines)) + 1
    )
    first, second = (lines[number - 1].strip() if number <= len(lines) else "(end)" for lines in (base_lines, tree_lines))
    description = _shorten(f"line {number}: {first!r} -> {second!r}")
    comments = _COMMENTS.get(Path(file).suffix)
    if comments is not None and comments.sub("", base).split() == comments.sub("", tree).split():
        return Difference(file, "comments", description)
    if _TOKEN.sub("", base) == _TOKEN.sub("", tree):
        return Difference(file, "token", description)
    return Difference(file, "", description)
