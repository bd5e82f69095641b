"""What `jaxbl identify` and `jaxbl diagnose` write into the folder of a log: all of it, or nothing."""

import json
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import tomli_w

from jaxbl.diagnosis.diagnose import Diagnosis
from jaxbl.identification.identify import Identification

from .figures import Drawn
from .page import PageTable, write_report


def write_log_results(
    found: Identification | Diagnosis,
    folder: Path,
    summary_name: str,
    title: str,
    lead: Sequence[str],
    drawn: Sequence[Drawn],
    tables: Sequence[PageTable],
    remarks: Sequence[str],
) -> list[str]:
    """Write summary, `model.toml`, `trace.parquet`, figures and report into a folder that exists.

    The files appear there once all are written, the summary last: it says that the results are complete. Returns the lines
    for the terminal.
    """
    with TemporaryDirectory(dir=folder, prefix=".draft.") as name:
        draft = Path(name)
        found.trace.to_parquet(draft / "trace.parquet", index=False)
        model = _model_text(found)
        (draft / "model.toml").write_text(model, encoding="utf-8")
        lines = write_report(draft, title, lead, drawn, tables, model, remarks)
        (draft / summary_name).write_text(json.dumps(found.summary, indent=1, ensure_ascii=False), encoding="utf-8")
        for file in sorted(draft.rglob("*"), key=lambda one: one.name == summary_name):
            if file.is_file():
                place = folder / file.relative_to(draft)
                place.parent.mkdir(exist_ok=True)
                file.replace(place)
    return lines


def _model_text(found: Identification | Diagnosis) -> str:
    """The fitted study as TOML; where the log has no gaps, its excitation is the torque of `trace.parquet` beside it."""
    data = found.model.resolved()
    if found.replays:
        data["excitation"] = {"kind": "recorded", "file": "trace.parquet", "time_column": "t", "torque_column": "u"}
    return tomli_w.dumps(data)
