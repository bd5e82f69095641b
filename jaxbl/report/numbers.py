"""Numbers that were found in a log: as key figures, as rows of a table, and as files."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import tomli_w

from jaxbl.files import to_jsonable, write_atomic
from jaxbl.json_types import JsonObject
from jaxbl.lines import DOUBT, doubts_among
from jaxbl.quantity import Quantity, read_quantities
from jaxbl.result import KeyFigure, Result, ResultTable

_FIGURES = 4
"""Numbers at the head of a page; its table has all."""


def number_figures(numbers: Mapping[str, Quantity]) -> list[KeyFigure]:
    """Key figures of numbers by path: those of the transmission first, as they are asked for most."""
    first = sorted(numbers, key=lambda path: not path.startswith("transmission."))[:_FIGURES]
    return [KeyFigure(str(numbers[path]), path) for path in first]


def number_table(heading: str, entries: JsonObject) -> ResultTable:
    """Table of a summary's numbers, with intervals by profile likelihood, and without columns that would be empty."""
    unknown = None, None
    rows = [
        [path, number.value, number.standard_error, *(number.interval or unknown), number.unit, number.nominal,
         *(entries[path].get("profile_interval") or unknown)]
        for path, number in read_quantities(entries).items()
    ]  # fmt: skip
    columns = ["path", "value", "standard error", "95 % from", "to", "unit", "nominal", "by profile from", "to"]
    table = pd.DataFrame(rows, columns=columns).dropna(axis=1, how="all")
    return ResultTable(heading, list(table), to_jsonable(table.to_numpy()))


def lead_with_doubt(result: Result) -> Result:
    """Return a result whose answer is the remark that puts all others in doubt, if there is one."""
    doubts = doubts_among(result.remarks)
    if not doubts:
        return result
    remarks = [result.headline, *(line for line in result.remarks if line != doubts[0])]
    return replace(result, verdict="doubtful", headline=doubts[0].removeprefix(DOUBT), remarks=remarks)


def write(result: Any, folder: Path, model: str = "") -> str:
    """Write `model.toml` and `trace.parquet` of a fit to a log into a folder that exists. Returns the model's TOML."""
    result.trace.to_parquet(folder / "trace.parquet", index=False)
    # that of a transmission alone is given
    model = model or format_model(result, folder / "trace.parquet")
    write_atomic(folder / "model.toml", model)
    return model


def format_model(result: Any, trace: Path) -> str:
    """The study of an `Identification` or a `Diagnosis` as TOML, complete for a run; for want of an excitation with the
    torque of `trace` beside it."""
    from jaxbl.estimation.logs import run_of
    from jaxbl.gains.machine_study import complete_study

    data, record = result.model.to_dict(), result.record
    if result.replays:
        data["run"] |= run_of(result.model, record) | {"duration": float(f"{record.time[-1] + record.sample_period:.9g}")}
        data["excitation"] = {"kind": "recorded", "file": str(trace.resolve()), "time_column": "t", "torque_column": "u"}
    data = complete_study(data, record, result.config)
    if result.replays:
        data["excitation"]["file"] = trace.name
    return tomli_w.dumps(data)
