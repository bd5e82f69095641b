"""Which results lie in a folder, and how they are explored: the one place that knows their files."""

from collections.abc import Callable
from pathlib import Path

from jaxbl.errors import InputError
from jaxbl.files import MANIFEST, ResultFolder, read_result, to_path
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
    listed = {} if results is None else {name for entry in results.entries.values() for name in entry["files"]}
    files = [where / name for name in _KINDS if name in listed]
    swept = [where / STUDY] if results is not None and "sweep" in results.entries else []
    if not files + swept:
        raise InputError(f"{folder}: is missing, or holds no results; give a folder that {_COMMANDS} wrote")
    # of several commands that wrote into one folder the last one counts
    newest = max(files + swept, key=lambda file: file.stat().st_mtime) if files else where / STUDY
    return _KINDS[newest.name](newest) if newest in files else study_source(where)


def _tuning_source(file: Path) -> Source:
    """The maps of the search for gains, the widest first."""
    gains = read_result(file)["gains"].items()
    chosen = [f"{side}: λ = {pair['lambda']:.4g} √rad/s, α = {pair['alpha']:.4g} rad/s²" for side, pair in gains]
    return _stage_source(file.parent / "tune", ("wide", "coarse"), f"The search for gains chose, {'; '.join(chosen)}.")


def _verdict_source(file: Path) -> Source:
    """The runs by which conditions were judged, those of the sampled observers first."""
    count = read_result(file)["counterexamples_in_all"]
    answer = f"In {count} cases an observer failed although a gain condition held."
    return _stage_source(file.parent / "verify", ("sampled", "drive"), answer)


def _stage_source(folder: Path, names: tuple[str, ...], answer: str) -> Source:
    """The first stage that is there, and a word on how the others are opened."""
    stages = sorted(place.parent.name for place in folder.glob(f"*/{MANIFEST}"))
    first = next((name for name in names if name in stages), None)
    if first is None:
        raise InputError(f"{folder}: holds no runs; run the command that wrote it again")
    sentences = [answer, f"Shown: {first}."]
    if other_stages := [name for name in stages if name != first]:
        sentences.append(f"Others: {', '.join(other_stages)}; such as jaxbl explore {folder / other_stages[0]}.")
    return study_source(folder / first, sentences)


_KINDS: dict[str, Callable[[Path], Source]] = {
    "diagnosis.json": log_source,
    "identification.json": log_source,
    "summary.json": log_source,
    "watch.json": log_source,
    "tuning.json": _tuning_source,
    "verdict.json": _verdict_source,
    "comparison.json": comparison_source,
}
"""By the file that each command leaves at last."""
_COMMANDS = "'jaxbl sweep', 'simulate', 'identify', 'diagnose', 'watch', 'tune', 'verify' or 'compare'"
