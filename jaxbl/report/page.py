"""A plain HTML page in one file: headline, remarks, figures, tables, config."""

import base64
from html import escape
from pathlib import Path
from typing import NamedTuple

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; margin: 2rem auto; max-width: 72rem; padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: 0.2rem; } h2 { font-size: 1.2rem; margin-top: 2rem; }
.lead { font-size: 1.1rem; } figure { margin: 1rem 0 1.5rem; } figcaption { color: #555; font-size: 0.95rem; }
img { max-width: 100%; height: auto; } table { border-collapse: collapse; font-size: 0.95rem; }
th, td { padding: 0.25rem 0.8rem; border-bottom: 1px solid #ddd; text-align: left; }
td.number { text-align: right; font-variant-numeric: tabular-nums; }
pre { background: #f5f5f5; padding: 1rem; overflow-x: auto; font-size: 0.85rem; }
"""


class TableOf(NamedTuple):
    """A table of a report: heading, column names, rows of cells."""

    heading: str
    columns: list[str]
    rows: list[list[object]]


class Picture(NamedTuple):
    """A figure file and its caption."""

    path: Path
    caption: str


def html(
    title: str, lead: list[str], remarks: list[str], pictures: list[Picture], tables: list[TableOf], config: str
) -> str:
    """The whole page; figures are embedded, so that the file can be passed on by itself."""
    parts = [f"<h1>{escape(title)}</h1>", *(f'<p class="lead">{escape(line)}</p>' for line in lead)]
    if remarks:
        parts += ["<h2>Remarks</h2><ul>", *(f"<li>{escape(line)}</li>" for line in remarks), "</ul>"]
    if pictures:
        parts.append("<h2>Figures</h2>")
        for picture in pictures:
            data = base64.b64encode(picture.path.read_bytes()).decode()
            caption = escape(picture.caption)
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
    if isinstance(value, bool) or value is None or isinstance(value, str):
        text = {True: "yes", False: "no", None: "–"}.get(value, value) if not isinstance(value, str) else value
        return f"<td>{escape(str(text))}</td>"
    return f'<td class="number">{value:.4g}</td>'
