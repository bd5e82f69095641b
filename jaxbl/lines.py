"""Text for a terminal: tables of 80 columns, and command lines that the user's shell takes as they are printed."""

import shlex
import shutil
import sys
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

TERMINAL_WIDTH = 80
"""Characters a line."""


Lines = list[str]
"""Lines of text, for a terminal or a page."""


DOUBT = "Doubtful: "
"""What sentences begin with that put all others in doubt: a unit, a sign or a factor of a log may be wrong."""


def doubts_among(lines: Iterable[str]) -> Lines:
    """Return the sentences that put all others in doubt."""
    return [line for line in lines if line.startswith(DOUBT)]


def percent(share: float) -> str:
    """Return a share in text, of two digits up to 10 %."""
    return f"{100.0 * share:.2g} %" if abs(share) < 0.095 else f"{100.0 * share:.0f} %"


class NextStep(NamedTuple):
    """A command line that a user may go on with, and the question that it answers: keys of `next` in `--json`."""

    command: str
    answers: str


def format_descriptions(rows: Iterable[Sequence[str]]) -> list[str]:
    """Align cells in columns, of which the last is a text that is wrapped. It begins on a line of its own where the cells
    before it are long."""
    *columns, texts = zip(*rows, strict=True)
    widths = [max(map(len, column)) + 2 for column in columns]
    indent = " " * (sum(widths) if sum(widths) <= TERMINAL_WIDTH // 2 else 4)
    lines = []
    for *cells, text in zip(*columns, texts, strict=True):
        begin = "".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True))
        if len(begin) > len(indent) or not text:
            lines.append(begin.rstrip())
            begin = indent
        # a word that is longer than a line, such as a path, stays whole
        lines += textwrap.wrap(
            text,
            TERMINAL_WIDTH,
            initial_indent=begin,
            subsequent_indent=indent,
            break_long_words=False,
            break_on_hyphens=False,
        )
    return lines


def format_duration(seconds: float) -> str:
    """Write a duration in s, min or h."""
    if seconds < 100.0:
        return f"{seconds:.1f} s"
    if seconds < 6000.0:
        return f"{seconds / 60.0:.0f} min"
    return f"{seconds / 3600.0:.1f} h"


def program_name() -> str:
    """The word that starts this jaxbl from a shell in this folder: its name if that finds it, else its path."""
    installed, on_path = Path(sys.executable).with_name("jaxbl"), shutil.which("jaxbl")
    if installed.is_file() and not (on_path and installed.samefile(on_path)):
        return shlex.quote(str(installed.relative_to(Path.cwd()) if installed.is_relative_to(Path.cwd()) else installed))
    return "jaxbl" if on_path else f"{shlex.quote(sys.executable)} -m jaxbl"


def command_line(*words: object) -> str:
    """Return a command line of this jaxbl, its words quoted for a shell."""
    return f"{program_name()} {shlex.join(map(str, words))}"
