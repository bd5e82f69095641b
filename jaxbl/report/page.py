"""The files of a report: one HTML page that holds everything, figures, and the results of a log, whole or not at all.

The page needs nothing from elsewhere, and runs no script but its own (`shared.js`, `page.js`): a policy in its head
forbids both.
"""

import base64
import hashlib
import json
import platform
import shlex
import sys
from collections.abc import Sequence
from html import escape
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import tomli_w

from jaxbl.files import catch_write_errors, json_with_checksum, write_atomic
from jaxbl.json_types import JsonObject
from jaxbl.lines import Lines, NextStep

from .figures import Drawn, save
from .picture import Picture, picture

if TYPE_CHECKING:
    from jaxbl.config import Config
    from jaxbl.diagnosis.diagnose import Diagnosis
    from jaxbl.estimation.element import ElementIdentification
    from jaxbl.estimation.identify import Identification


class PageTable(NamedTuple):
    """A table of a report: heading, column names, rows of cells."""

    heading: str
    columns: Sequence[str]
    rows: Sequence[Sequence[object]]


def number_line(path: str, number: JsonObject, condition: str = "") -> str:
    """A number that was found, in a sentence: value, standard error, unit, interval, and on what condition that holds."""
    low, high = number["interval"]
    unit = f" {number['unit']}" if number.get("unit") else ""
    reach = "for noise alone" if low is None else f"95 %: {low:.5g} to {high:.5g}{condition}"
    return f"{path} = {number['value']:.5g} ± {number['standard_error']:.2g}{unit}, {reach}."


NUMBER_COLUMNS = ["path", "value", "standard error", "95 % from", "to"]


def number_row(path: str, number: JsonObject) -> list[object]:
    """Cells of a number that was found, below `NUMBER_COLUMNS`."""
    return [path, number["value"], number["standard_error"], *number["interval"]]


def write_report(
    folder: Path,
    title: str,
    lead: Sequence[str],
    drawn: Sequence[Drawn],
    tables: Sequence[PageTable],
    config: "Config | str",
    remarks: Sequence[str] = (),
    steps: Sequence[NextStep] = (),
) -> Lines:
    """Write figures into `figures/`, and `report.html` with what was found (`lead`), remarks, and what to try next.

    A study's own title takes the place of `title`. Returns lead and remarks, the lines for the terminal.
    """
    if not isinstance(config, str):
        title, config = config.title or title, config.to_toml()
    save_all(drawn, folder)
    page = html(title, lead, remarks, [(figure.name, picture(figure)) for figure in drawn], tables, config, steps)
    write_atomic(folder / "report.html", page)
    return [*lead, *remarks]


def save_all(drawn: Sequence[Drawn], folder: Path) -> list[tuple[Path, str]]:
    """Write figures into the folder's `figures/`. Returns their files and captions."""
    with catch_write_errors(folder):
        return [(save(figure, folder / "figures" / f"{name}.png"), caption) for name, figure, caption in drawn]


def write_results(
    result: "Identification | Diagnosis | ElementIdentification",
    folder: Path,
    name: str,
    title: str,
    lead: Sequence[str],
    drawn: Sequence[Drawn],
    tables: Sequence[PageTable],
    remarks: Sequence[str],
    steps: Sequence[NextStep] = (),
    model: str = "",
) -> Lines:
    """Write the summary (`name`.json), `model.toml`, `trace.parquet`, figures and report into a folder that exists.

    The files appear there once all are written, the summary last: it says that the results are complete. Returns the lines
    for the terminal.
    """
    with catch_write_errors(folder), TemporaryDirectory(dir=folder, prefix=".draft.") as place:
        draft = Path(place)
        result.trace.to_parquet(draft / "trace.parquet", index=False)
        # that of a transmission alone is given
        model = model or format_model(result, draft / "trace.parquet")  # pyright: ignore[reportArgumentType]
        (draft / "model.toml").write_text(model, encoding="utf-8")
        lines = write_report(draft, title, lead, drawn, tables, model, remarks, steps)
        write_atomic(draft / f"{name}.json", json_with_checksum(result.summary))
        for file in sorted(draft.rglob("*"), key=lambda file: file.name == f"{name}.json"):
            if file.is_file():
                target = folder / file.relative_to(draft)
                target.parent.mkdir(exist_ok=True)
                file.replace(target)
    return lines


def format_model(result: "Identification | Diagnosis", trace: Path) -> str:
    """The fitted study as TOML, complete for a run; for want of an excitation with the torque of `trace` beside it."""
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


_PARTS = "page.css", "shared.js", "page.js"


def html(
    title: str,
    lead: Sequence[str],
    remarks: Sequence[str],
    pictures: Sequence[tuple[str, Picture]],
    tables: Sequence[PageTable],
    config: str,
    steps: Sequence[NextStep] = (),
) -> str:
    """The whole page. Figures have names; the first line of the lead is the answer."""
    style, *scripts = (files("jaxbl.report").joinpath(name).read_text(encoding="utf-8") for name in _PARTS)
    script = "\n".join(scripts)
    allowed = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{allowed}'"
    parts = [f'<p class="lead{"" if i else " answer"}">{escape(line)}</p>' for i, line in enumerate(lead)]
    if remarks:
        parts += ["<h2>Remarks</h2><ul>", *(f"<li>{escape(line)}</li>" for line in remarks), "</ul>"]
    if steps:
        pairs = (f"<dt>{escape(step.answers)}</dt><dd><pre>{escape(step.command)}</pre></dd>" for step in steps)
        parts += ["<h2>What to try next</h2><dl>", *pairs, "</dl>"]
    if pictures:
        parts += ["<h2>Figures</h2>", *(_figure(name, picture) for name, picture in pictures)]
    parts += map(_table, tables)
    parts.append(f"<h2>Config</h2><details><summary>study.toml</summary><pre>{escape(config)}</pre></details>")
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<title>{escape(title)}</title><style>{style}</style></head>
<body><main><h1>{escape(title)}</h1>
{chr(10).join(parts)}
</main><footer>{escape(_origin())}</footer><script>{script}</script></body></html>
"""


def _figure(name: str, picture: Picture) -> str:
    width, height = picture.size
    # a script of data ends where the next tag of that name begins, whatever it holds
    panels = json.dumps(picture.panels, ensure_ascii=False, separators=(",", ":")).replace("<", "\\u003c")
    image = f'<img src="{picture.source}" alt="{escape(picture.described)}" width="{width}" height="{height}">'
    label = "figure: arrow keys read values, plus and minus zoom, 0 shows the whole"
    return (
        f'<figure data-name="{escape(name)}"><div class="view" tabindex="0" role="group" aria-label="{label}" '
        f'style="width:{width}px">{image}</div><figcaption>{escape(picture.caption)}</figcaption>'
        f'<script type="application/json">{panels}</script></figure>'
    )


def _table(table: PageTable) -> str:
    heading = escape(table.heading)
    head = "".join(f'<th scope="col">{escape(column)}</th>' if column else "<td></td>" for column in table.columns)
    body = "".join(f"<tr>{''.join(_cell(value) for value in row)}</tr>" for row in table.rows)
    return (
        f'<h2>{heading}</h2><div class="scroll" tabindex="0" role="region" aria-label="{heading}">'
        f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def _cell(value: object) -> str:
    if isinstance(value, bool | None):
        value = {True: "yes", False: "no", None: "–"}[value]
    if isinstance(value, str):
        return f"<td>{escape(value)}</td>"
    # counts in full
    text = str(value) if isinstance(value, int | np.integer) else f"{value:.4g}"
    return f'<td class="number" data-value="{value}">{text}</td>'


def _origin() -> str:
    """Say what made the page: versions, and the command, if it was one."""
    versions = ", ".join(f"{name} {version(name)}" for name in ("jaxbl", "jax", "numpy"))
    origin = f"Made by {versions}, Python {platform.python_version()}"
    program = Path(sys.argv[0]).parts
    # `jaxbl`, or `python -m jaxbl`
    if sys.argv[1:] and (program[-1:] == ("jaxbl",) or program[-2:] == ("jaxbl", "__main__.py")):
        return f"{origin}, with: {shlex.join(['jaxbl', *sys.argv[1:]])}"
    return f"{origin}."
