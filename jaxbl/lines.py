"""Lines for a terminal: tables of 80 columns, and command lines of this jaxbl as a shell in this folder takes them."""

import shlex
import shutil
import sys
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

COLUMNS = 80
"""Of a terminal."""


class Step(NamedTuple):
    """A command line, and the question that it answers, in a sentence."""

    command: str
    answers: str


def table(rows: Iterable[Sequence[str]], *, numbers: bool = False) -> list[str]:
    """Cells in columns, the header first. Columns for which a line has no room follow below, beside the first one again.

    Args:
        rows: cells, equally many in each row.
        numbers: whether all columns but the first are numbers, which end below one another.
    """
    columns = list(zip(*rows, strict=True))
    widths = [max(map(len, column)) for column in columns]
    lines: list[str] = []
    first, rest = 0, list(range(1, len(columns)))
    while rest:
        shown, used = [first], widths[first]
        while rest and (len(shown) == 1 or used + 2 + widths[rest[0]] <= COLUMNS):
            used += 2 + widths[rest[0]]
            shown.append(rest.pop(0))
        for cells in zip(*(columns[i] for i in shown), strict=True):
            padded = (
                cell.rjust(widths[i]) if numbers and i != first else cell.ljust(widths[i])
                for i, cell in zip(shown, cells, strict=True)
            )
            lines.append("  ".join(padded).rstrip())
    return lines


def described(rows: Iterable[Sequence[str]]) -> list[str]:
    """Cells in columns, of which the last is a text that goes on below itself; below the others where they are long."""
    *columns, texts = zip(*rows, strict=True)
    widths = [max(map(len, column)) + 2 for column in columns]
    indent = " " * (sum(widths) if sum(widths) <= COLUMNS // 2 else 4)
    lines = []
    for *cells, text in zip(*columns, texts, strict=True):
        begin = "".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True))
        if len(begin) > len(indent) or not text:
            lines.append(begin.rstrip())
            begin = indent
        # a word that is longer than a line, such as a path, stays whole
        lines += textwrap.wrap(
            text, COLUMNS, initial_indent=begin, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
        )
    return lines


def lines_of(steps: Sequence[Step]) -> list[str]:
    """Steps as lines for the terminal; none where there are no steps. Command lines are never broken."""
    lines = ["Next:"] if steps else []
    for one in steps:
        lines += [f"  {one.command}", *textwrap.wrap(f"    {one.answers}", COLUMNS, subsequent_indent="    ")]
    return lines


def program() -> str:
    """How a shell in this folder finds this jaxbl: by its name, or else by its path, as after `make demo`."""
    own, known = Path(sys.executable).with_name("jaxbl"), shutil.which("jaxbl")
    if own.is_file() and not (known and own.samefile(known)):
        return shlex.quote(str(own.relative_to(Path.cwd()) if own.is_relative_to(Path.cwd()) else own))
    return "jaxbl" if known else f"{shlex.quote(sys.executable)} -m jaxbl"


def command_line(*words: object) -> str:
    """A command line of this jaxbl."""
    return f"{program()} {shlex.join(map(str, words))}"
