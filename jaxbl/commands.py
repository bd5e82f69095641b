"""Command lines of this jaxbl as a shell in this folder takes them, for whoever is told to type one."""

import shlex
import shutil
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

COLUMNS = 80
"""Of a terminal."""


class Step(NamedTuple):
    """A command line, and the question that it answers, in a sentence."""

    command: str
    answers: str


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
