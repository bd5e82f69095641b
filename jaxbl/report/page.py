"""The files of a report: a plain HTML page that holds everything, figures, and the results of a log, whole or not at all."""

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

import tomli_w

from jaxbl.files import json_text, write_atomic, writing

from .figures import Drawn, save

if TYPE_CHECKING:
    import pandas as pd

    from jaxbl.diagnosis.diagnose import Diagnosis
    from jaxbl.identification.identify import Identification

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; margin: 2rem auto; max-width: 72rem; padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: 0.2rem; } h2 { font-size: 1.2rem; margin-top: 2rem; }
.lead { font-size: 1.1rem; } figure { margin: 1rem 0 1.5rem; } figcaption { color: #555; font-size: 0.95rem; }
img { max-width: 100%; height: auto; }
table { border-collapse: collapse; font-size: 0.95rem; display: block; overflow-x: auto; }
th, td { padding: 0.25rem 0.8rem; border-bottom: 1px solid #ddd; text-align: left; }
td.number { text-align: right; font-variant-numeric: tabular-nums; }
pre { background: #f5f5f5; padding: 1rem; overflow-x: auto; font-size: 0.85rem; }
"""


class PageTable(NamedTuple):
    """A table of a report: heading, column names, rows of cells."""

    heading: str
    columns: Sequence[str]
    rows: Sequence[Sequence[object]]


def write_report(
    folder: Path,
    title: str,
    lead: Sequence[str],
    drawn: Sequence[Drawn],
    tables: Sequence[PageTable],
    config: str,
    remarks: Sequence[str] = (),
) -> list[str]:
    """Write figures into `figures/`, and `report.html` with what was found (`lead`) and remarks in sentences.

    Returns lead and remarks, the lines for the terminal.
    """
    page = html(title, lead, remarks, save_all(drawn, folder), tables, config)
    write_atomic(folder / "report.html", page)
    return [*lead, *remarks]


def save_all(drawn: Sequence[Drawn], folder: Path) -> list[tuple[Path, str]]:
    """Write figures into the folder's `figures/`. Returns their files and captions."""
    with writing(folder):
        return [(save(one.figure, folder / "figures" / f"{one.name}.png"), one.caption) for one in drawn]


_TITLES = {"identification": "Identification from", "diagnosis": "Diagnosis of"}


def write_log_results(
    found: "Identification | Diagnosis",
    folder: Path,
    name: str,
    lead: Sequence[str],
    drawn: Sequence[Drawn],
    tables: Sequence[PageTable],
    remarks: Sequence[str],
) -> list[str]:
    """Write the summary (`name`.json), `model.toml`, `trace.parquet`, figures and report into a folder that exists.

    The files appear there once all are written, the summary last: it says that the results are complete. Returns the lines
    for the terminal.
    """
    title = found.config.title or f"{_TITLES[name]} {found.record.path.name}"
    return write_results(folder, name, title, found.summary, found.trace, _model_text(found), lead, drawn, tables, remarks)


def write_results(
    folder: Path,
    name: str,
    title: str,
    summary: dict[str, Any],
    trace: "pd.DataFrame",
    model: str,
    lead: Sequence[str],
    drawn: Sequence[Drawn],
    tables: Sequence[PageTable],
    remarks: Sequence[str],
) -> list[str]:
    """As :func:`write_log_results`, of anything that has a summary, a trace and a model in TOML."""
    with writing(folder), TemporaryDirectory(dir=folder, prefix=".draft.") as place:
        draft = Path(place)
        trace.to_parquet(draft / "trace.parquet", index=False)
        (draft / "model.toml").write_text(model, encoding="utf-8")
        lines = write_report(draft, title, lead, drawn, tables, model, remarks)
        (draft / f"{name}.json").write_text(json_text(summary), encoding="utf-8")
        for file in sorted(draft.rglob("*"), key=lambda one: one.name == f"{name}.json"):
            if file.is_file():
                target = folder / file.relative_to(draft)
                target.parent.mkdir(exist_ok=True)
                file.replace(target)
    return lines


def _model_text(found: "Identification | Diagnosis") -> str:
    """The fitted study as TOML; where the log has no gaps, its excitation is the torque of `trace.parquet` beside it."""
    data = found.model.resolved()
    if found.replays:
        data["excitation"] = {"kind": "recorded", "file": "trace.parquet", "time_column": "t", "torque_column": "u"}
    return tomli_w.dumps(data)


def html(
    title: str,
    lead: Sequence[str],
    remarks: Sequence[str],
    pictures: Sequence[tuple[Path, str]],
    tables: Sequence[PageTable],
    config: str,
) -> str:
    """The whole page; figures (files and captions) are embedded, so that the page is one file."""
    parts = [f"<h1>{escape(title)}</h1>", *(f'<p class="lead">{escape(line)}</p>' for line in lead)]
    if remarks:
        parts += ["<h2>Remarks</h2><ul>", *(f"<li>{escape(line)}</li>" for line in remarks), "</ul>"]
    if pictures:
        parts.append("<h2>Figures</h2>")
        for path, caption in pictures:
            data = base64.b64encode(path.read_bytes()).decode()
            caption = escape(caption)
            image = f'<img src="data:image/png;base64,{data}" alt="{caption}">'
            parts.append(f"<figure>{image}<figcaption>{caption}</figcaption></figure>")
    for table in tables:
        head = "".join(f"<th>{escape(column)}</th>" for column in table.columns)
        body = "".join(f"<tr>{''.join(_cell(value) for value in row)}</tr>" for row in table.rows)
        parts.append(f"<h2>{escape(table.heading)}</h2><table><tr>{head}</tr>{body}</table>")
    parts.append(f"<h2>Config</h2><details><summary>study.toml</summary><pre>{escape(config)}</pre></details>")
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{_STYLE}</style></head><body>\n" + "\n".join(parts) + "\n</body></html>\n"
    )


def _cell(value: object) -> str:
    if isinstance(value, bool) or value is None:
        value = {True: "yes", False: "no", None: "–"}[value]
    return f"<td>{escape(value)}</td>" if isinstance(value, str) else f'<td class="number">{value:.4g}</td>'
