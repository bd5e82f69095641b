"""The files of a report: one HTML page that holds everything, figures, and the results of a log, whole or not at all.

The page needs nothing from elsewhere, and runs no script but its own and uPlot: a policy in its head
forbids both.
"""

import base64
import hashlib
import json
import platform
import re
import shlex
import sys
from collections.abc import Sequence
from html import escape
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path

import numpy as np

from jaxbl.files import write_atomic
from jaxbl.result import VERDICTS, Result, ResultTable

from .drawing import Picture, picture
from .panels import Figure

PAGE = "report.html"


def write_page(folder: Path, result: Result, figures: Sequence[Figure], config: str) -> None:
    """Write figures into `figures/`, and `report.html` with the result, the figures and the study's TOML."""
    pictures = [(figure.name, picture(figure, folder / "figures" / f"{figure.name}.png")) for figure in figures]
    write_atomic(folder / PAGE, format_page(result, pictures, config))


_SHORT = 8
"""Rows of a table that may stand above the figures."""
_WIDE = 700
"""Pixels beyond which a figure has the whole width of the page; others stand in two columns."""
_FLAT = 0.4
"""Height over width below which a wide figure stands below the card's text, and is still seen at once, else beside it."""
_PARTS = "vendored/uPlot.css", "page.css", "vendored/uPlot.js", "shared.js", "chart.js", "page.js"


def format_page(result: Result, pictures: Sequence[tuple[str, Picture]], config: str) -> str:
    """The whole page: the card with the first figure, the first table, remarks, figures, tables, and what is folded away."""
    texts = [files("jaxbl.report").joinpath(name).read_text(encoding="utf-8") for name in _PARTS]
    style, script = "\n".join(texts[:2]), "\n".join(texts[2:])
    allowed = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{allowed}'"
    first, *more = [_figure(*named) for named in pictures] or [""]
    # a short table of what was found stands before what is said of it
    above = [table for table in result.tables[:1] if len(table.rows) <= _SHORT]
    parts = [_card(result, first), *map(_table, above), _list(result.remarks)]
    if more:
        parts.append(f'<div class="figures">{"".join(more)}</div>')
    parts += map(_table, result.tables[len(above) :])
    if result.details:
        parts.append(_fold(f"Remarks ({len(result.details)})", _list(result.details)))
    parts.append(_fold("Config", f"<pre>{escape(config)}</pre>"))
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<title>{escape(result.title)}</title><style>{style}</style></head>
<body><main><h1>{escape(result.title)}</h1>
{chr(10).join(filter(None, parts))}
</main><footer>{escape(_origin())}</footer><script>{script}</script></body></html>
"""


def _card(result: Result, figure: str) -> str:
    """The head of the page: verdict, answer, key figures, the commands to go on with, and the first figure."""
    verdict = f'<p class="verdict {result.verdict.split()[0]}">{VERDICTS[result.verdict]} {result.verdict.capitalize()}</p>'
    keys = "".join(f"<div><b>{escape(value)}</b> {escape(meaning)}</div>" for value, meaning in result.key_figures)
    steps = ""
    for i, step in enumerate(result.next_steps):
        # an option goes on in a new line as a whole
        words = re.sub(r"\S+", r"<span>\g<0></span>", escape(step.command))
        steps += f"<dt>{'Or' if i else 'Next'}: {escape(step.answers)}</dt><dd><pre>{words}</pre></dd>"
    texts = [verdict, f'<p class="answer">{escape(result.headline)}</p>', f'<div class="keys">{keys}</div>' if keys else ""]
    return f'<section class="card"><div>{"".join(texts)}{f"<dl>{steps}</dl>" if steps else ""}</div>{figure}</section>'


def _list(sentences: Sequence[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in sentences)}</ul>" if sentences else ""


def _fold(summary: str, content: str) -> str:
    return f"<details><summary>{summary}</summary>{content}</details>"


def _figure(name: str, picture: Picture) -> str:
    width, height = picture.size
    # a script of data ends where the next tag of that name begins, whatever it holds
    panels = json.dumps(picture.panels, ensure_ascii=False, separators=(",", ":")).replace("<", "\\u003c")
    image = f'<img src="{picture.source}" alt="{escape(picture.described)}" width="{width}" height="{height}">'
    label = "figure: arrow keys read values, plus and minus zoom, 0 shows the whole"
    wide = f' class="wide{" flat" if height < _FLAT * width else ""}"' if width > _WIDE else ""
    return (
        f'<figure{wide} data-name="{escape(name)}"><div class="view" tabindex="0" role="group" aria-label="{label}" '
        f'style="width:{width}px">{image}</div><figcaption>{escape(picture.caption)}</figcaption>'
        f'<script type="application/json">{panels}</script></figure>'
    )


def _table(table: ResultTable) -> str:
    heading = escape(table.heading)
    head = "".join(f'<th scope="col">{_breakable(column)}</th>' if column else "<td></td>" for column in table.columns)
    body = "".join(f"<tr>{''.join(_cell(value, _digits(row)) for value in row)}</tr>" for row in table.rows)
    return (
        f'<h2>{heading}</h2><div class="scroll" tabindex="0" role="region" aria-label="{heading}">'
        f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def _breakable(text: str) -> str:
    """A text whose names in code may go on in a new line, so that a table is no wider than the page."""
    return re.sub(r"([._])(?=[a-z])", r"\1<wbr>", escape(text))


def _digits(row: Sequence[object]) -> int:
    """Digits of the numbers of a row: 4, or up to 7 where only these tell them apart, as the ends of a narrow interval."""
    numbers = {value for value in row if isinstance(value, float)}
    return next((n for n in range(4, 7) if len({f"{value:.{n}g}" for value in numbers}) == len(numbers)), 7)


def _cell(value: object, digits: int) -> str:
    if isinstance(value, bool | None):
        value = {True: "yes", False: "no", None: "–"}[value]
    if isinstance(value, str):
        return f"<td>{_breakable(value)}</td>"
    # counts in full
    text = str(value) if isinstance(value, int | np.integer) else f"{value:.{digits}g}"
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
