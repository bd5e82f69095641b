"""Which results lie in a folder, and how they are explored: the one place that knows their files."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from jaxbl.errors import InputError
from jaxbl.files import MANIFEST, ResultFolder, to_path
from jaxbl.report.page import PAGE
from jaxbl.sweeps.store import STUDY

from .folder import Source
from .log import log_source
from .study import comparison_source, study_source


def open_source(folder: str | Path) -> Source:
    """The results in a folder of `jaxbl sweep`, `simulate`, `identify`, `diagnose`, `watch`, `tune`, `verify` or `compare`.

    Raises:
        InputError: it holds none, or they are damaged.
    """
    where = to_path(folder)
    results = ResultFolder.read(where)
    entries = {} if results is None else results.entries
    files = [where / name for name in _KINDS if any(name in entry["files"] for entry in entries.values())]
    files += [where / STUDY] * ("sweep" in entries)
    if not files:
        raise InputError(f"{folder}: is missing, or holds no results; give a folder that {_COMMANDS} wrote")
    # of several commands that wrote into one folder the last one counts
    newest = max(files, key=lambda file: file.stat().st_mtime) if len(files) > 1 else files[0]
    if newest.name == STUDY:
        return study_source(where)
    # what its page says
    card = next((entries[name] for name in (newest.name, PAGE) if "title" in entries.get(name, {})), {})
    return _KINDS[newest.name](newest, card.get("title", ""), card.get("sentences", []))


def _stage_source(command: str, names: tuple[str, ...], file: Path, _: str, sentences: list[str]) -> Source:
    """The first stage of a command that is there, with the answer and a word on how the others are opened."""
    folder = file.parent / command
    stages = sorted(place.parent.name for place in folder.glob(f"*/{MANIFEST}"))
    first = next((name for name in names if name in stages), None)
    if first is None:
        raise InputError(f"{folder}: holds no runs; run the command that wrote it again")
    sentences = [*sentences[:1], f"Shown: {first}."]
    if other_stages := [name for name in stages if name != first]:
        sentences.append(f"Others: {', '.join(other_stages)}; such as jaxbl explore {folder / other_stages[0]}.")
    return study_source(folder / first, sentences)


_KINDS: dict[str, Callable[[Path, str, list[str]], Source]] = {
    "diagnosis.json": log_source,
    "identification.json": log_source,
    "summary.json": log_source,
    "watch.json": log_source,
    "tuning.json": partial(_stage_source, "tune", ("wide", "coarse")),
    "verdict.json": partial(_stage_source, "verify", ("sampled", "drive")),
    "comparison.json": comparison_source,
}
"""By the file that each command leaves at last: what is explored, given title and sentences of its page."""
_COMMANDS = "'jaxbl sweep', 'simulate', 'identify', 'diagnose', 'watch', 'tune', 'verify' or 'compare'"
