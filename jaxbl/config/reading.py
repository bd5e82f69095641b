"""Reading studies: TOML files, what they include, and one line about what is wrong with them."""

import copy
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from jaxbl.drive import DRIVES
from jaxbl.errors import InputError
from jaxbl.json_types import JsonObject
from jaxbl.records import NominalDrive
from jaxbl.records.reader import read_log_table
from jaxbl.records.table import LogTable
from jaxbl.validation import abbreviate, check_file, check_sizes, explain_first_error, explain_missing_file

from .study import Config, numeric_paths, suggest_path

ConfigSource = str | Path | Mapping[str, Any] | Config
"""A study: a TOML file, a mapping, or a config."""

_MOST_BYTES = 8_000_000
"""Of a TOML file: 300 000 numbers of full length, some seconds of reading."""
_MOST_FILES = 100
"""That a study includes, those that these include as well: files that include each other twice are read 2^n times."""
_LONG_KEY = re.compile(r"""(?<![\w"'-])(?:[\w"'-]+[ \t]*\.[ \t]*){50}""")
"""A key of fifty parts, which `tomllib` takes quadratic time for."""


Layers = list[tuple[str, JsonObject]]
"""The files that a study was merged from, each with its keys; those of later ones win."""


def read_config(source: ConfigSource) -> Config:
    """Read and validate a study from a TOML file, a mapping, or a config, whose attributes may have been set since.

    Raises:
        InputError: unreadable file, bad TOML, unknown key, wrong type or range; one line that names file and key.
    """
    return _validate(*_read_with_includes(source))


_MISSING_GAINS = {"lambda": 1.0, "alpha": 1.0}


def read_model(source: ConfigSource, *, may_be_element: bool = False) -> tuple[Config, frozenset[str]]:
    """Read a study that is to be held against a log: `[excitation]` and the observers' gains may be missing.

    `may_be_element`: the log may be that of a transmission alone.

    Returns:
        The study, with something harmless in place of what is missing; and what is: `excitation`, `observer.motor`,
        `observer.load`.

    Raises:
        InputError: as :func:`read_config`.
    """
    name, data, layers = _read_with_includes(source)
    log = data.get("log")
    if isinstance(log, dict) and log.get("kind") == "element" and not (may_be_element and "drive" in data):
        raise InputError(
            f"{name}: log.kind: 'element' is a transmission alone, without the drive whose motion diagnose explains; jaxbl "
            "identify finds its stiffness, gap and friction (from Python: identify_element)"
        )
    missing = set()
    if "excitation" not in data:
        missing.add("excitation")
        data["excitation"] = {"kind": "sine", "amplitude": 0.0, "frequency": 1.0}
    drive, observer = data.get("drive"), data.setdefault("observer", {})
    kind = drive.get("kind") if isinstance(drive, dict) else None
    for side in DRIVES[kind if kind in (*DRIVES,) else "two_inertia"].sides:
        if isinstance(observer, dict) and side not in observer:
            missing.add(f"observer.{side}")
            observer[side] = dict(_MISSING_GAINS)
    config = _validate(name, data, layers)
    if (kind := config.drive.kind) not in ("two_inertia", "rigid"):
        raise InputError(
            f"{name}: drive.kind: logs are held against drives of kind two_inertia or rigid, not {kind}; simulate, sweep, "
            "tune and export take it"
        )
    return config, frozenset(missing)


def _read_with_includes(source: ConfigSource) -> tuple[str, JsonObject, Layers]:
    """Read a study with its included files. Returns its name for messages, the data, and the files."""
    layers: Layers = []
    if isinstance(source, Config):
        return "config", source.to_dict(), layers
    if isinstance(source, Mapping):
        data = dict(source)
        try:
            check_sizes(data)
        except InputError as error:
            raise InputError(f"config: {error}") from None
        return "config", _merge_includes(copy.deepcopy(data), "config", Path(), [], layers), layers
    if not isinstance(source, str | Path):
        raise InputError(
            f"a study should be a TOML file, a mapping or a config, not {type(source).__name__}; an Experiment, whose drive "
            "may be one of your own, is for jaxbl.simulate, metrics, observe and sweep_arrays"
        )
    return str(Path(source)), _file(Path(source), [], layers), layers


def read_log_config(path: Path) -> tuple[LogTable, float | None, NominalDrive | None]:
    """The `[log]` table of a TOML file, the gear ratio and the nominal drive: of a whole study, or nothing but `[log]`.

    Raises:
        InputError: unreadable file, bad TOML, unknown key, wrong type or range; one line that names file and key.
    """
    data = _file(path, [], [])
    if set(data) <= {"title", "notes", "log"}:
        return read_log_table(data.get("log"), str(path)), None, None
    config, _ = read_model(path, may_be_element=True)
    ratio = getattr(config.drive, "gear_ratio", None)
    return config.log, ratio, config.nominal_drive()


def _file(path: Path, chain: list[Path], layers: Layers) -> JsonObject:
    """A TOML file with what it includes; `chain` are the files that led here, `layers` gets those that were read. Files that
    it names become absolute."""
    data = _load(path)
    tune = data.get("tune")
    for table in (data.get("excitation"), data.get("reference"), tune.get("holdout") if isinstance(tune, dict) else None):
        if isinstance(table, dict) and isinstance(table.get("file"), str):
            table["file"] = str((path.parent / table["file"]).resolve())
    return _merge_includes(data, str(path), path.parent, [*chain, path.resolve()], layers)


def _load(path: Path) -> JsonObject:
    """A TOML file as it stands."""
    try:
        check_file(path, _MOST_BYTES)
        text = path.read_text(encoding="utf-8-sig")
        if long := _LONG_KEY.search(text):
            raise InputError(
                f"line {text.count(chr(10), 0, long.start()) + 1}: a key of more than 50 parts; none has as many"
            )
        data = tomllib.loads(text)
        check_sizes(data)
        return data
    except FileNotFoundError:
        fault = explain_missing_file(path, [".toml"])
    except IsADirectoryError:
        fault = "is a folder; a TOML file is needed"
    except UnicodeDecodeError:
        fault = "is not text in UTF-8; a TOML file is needed"
    except OSError as error:
        fault = f"cannot be read: {error.strerror}; mend the access to it"
    except RecursionError:
        fault = "tables or arrays are nested too deep; a study needs five within one another"
    except InputError as error:
        fault = str(error)
    # numbers of thousands of digits are a ValueError of another kind
    except ValueError as error:
        fault = f"not valid TOML: {error}"
    raise InputError(f"{path}: {fault}")


def _merge_includes(data: JsonObject, name: str, folder: Path, chain: list[Path], layers: Layers) -> JsonObject:
    """Merge the data over the files that it includes (relative to `folder`)."""
    files = data.pop("include", [])
    files = [files] if isinstance(files, str) else files
    if not isinstance(files, list) or not all(isinstance(file, str) for file in files):
        raise InputError(f"{name}: include: should be a file name or an array of them, not {abbreviate(files)}")
    merged: JsonObject = {}
    for file in files:
        path = folder / file
        if len(layers) + len(chain) > _MOST_FILES:
            raise InputError(
                f"{name}: include: more than {_MOST_FILES} files, with those that they include; fewer are needed"
            )
        try:
            path.stat()
        except OSError as error:
            reason = explain_missing_file(path, [".toml"]) if isinstance(error, FileNotFoundError) else error.strerror
            raise InputError(f"{name}: include: {path}: {reason}") from None
        if path.resolve() in chain:
            raise InputError(f"{name}: include: {path} includes this file in turn; files should not include one another")
        _merge(merged, _file(path, chain, layers))
    layers.append((name, data))
    _merge(merged, data)
    return merged


def _merge(into: JsonObject, data: JsonObject) -> None:
    """Put the keys of `data` over those of `into`."""
    for name, value in data.items():
        old = into.get(name)
        # a table of another kind is another table
        if (
            isinstance(old, dict)
            and isinstance(value, dict)
            and all(tag not in old or value.get(tag, old[tag]) == old[tag] for tag in ("kind", "law"))
        ):
            _merge(old, value)
        else:
            into[name] = value


def _validate(name: str, data: JsonObject, layers: Layers) -> Config:
    try:
        return Config.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        location = _hold(first["loc"], data)
        if first["type"] == "missing":
            location.append(first["loc"][-1])
        key, text = explain_first_error(error, location)
        # the file that the key, or as much of it as there is, came from
        held = _hold(key, data)
        name = next((file for file, layer in reversed(layers) if _hold(held, layer) == held), name)
        raise InputError(f"{name}: {text}" if name else text) from None


def _hold(key: Sequence[str | int], table: Any) -> list[str | int]:
    """The parts of a key that a table holds, one within the other; of pydantic's keys, not the names of unions' members,
    which are the kind or law of a table."""
    held = []
    for part in key:
        if isinstance(table, Mapping) and part in (table.get("kind"), table.get("law")):
            continue
        if part in table if isinstance(table, Mapping) else isinstance(part, int):
            held.append(part)
            table = table[part]
    return held


def with_values(config: Config, values: Mapping[str, Any]) -> Config:
    """A copy of the config with other values at some dotted paths.

    Raises:
        InputError: a path that does not exist (the nearest valid one is named), or a value out of range.
    """
    data = config.to_dict()
    paths = numeric_paths(config)
    for path, value in values.items():
        if path not in paths:
            raise InputError(f"unknown path '{path}'; {suggest_path(path, paths)}")
        if path.startswith("effects."):
            kind, _, key = path.removeprefix("effects.").rpartition(".")
            kinds = [effect.kind for effect in config.effects]
            target = data["effects"][int(kind) if kind.isdigit() else kinds.index(kind)]
        else:
            *tables, key = path.split(".")
            target = data
            for table in tables:
                target = target.setdefault(table, {})
        if type(target.get(key)) is int and isinstance(value, float) and value.is_integer():
            value = int(value)  # a whole number from start, stop and num
        target[key] = value
    return _validate("", data, [])
