"""The result of a command, as data: a verdict, one sentence, at most four figures, and the rest by rank.

Terminal (:func:`format_result`), `--json` and page show the same object; its texts are made once.
"""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from .lines import NextStep

VERDICTS = {"good": "✓", "doubtful": "!", "failed": "✗", "no answer": "?"}
"""Words of a verdict, and the symbol of each."""
CARD_WIDTH, CARD_LINES = 100, 8
"""Characters a line, and lines, that a result has on the terminal, with the next command and the page to open."""

_wrap = partial(textwrap.wrap, width=CARD_WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


class KeyFigure(NamedTuple):
    """A number with its unit, and what it is, in few words."""

    value: str
    meaning: str


class ResultTable(NamedTuple):
    """A table of a page: heading, column names, rows of cells."""

    heading: str
    columns: Sequence[str]
    rows: Sequence[Sequence[object]]


@dataclass(frozen=True)
class Result:
    """The result of a command.

    Attributes:
        title: of the page.
        verdict: one of `VERDICTS`.
        headline: the answer, one sentence.
        key_figures: at most four.
        remarks: sentences that may change what the reader does next, the most important one first.
        details: sentences that do not.
        tables: of the page.
        next_steps: commands to go on with.
    """

    title: str
    verdict: str
    headline: str
    key_figures: Sequence[KeyFigure] = ()
    remarks: Sequence[str] = ()
    details: Sequence[str] = ()
    tables: Sequence[ResultTable] = ()
    next_steps: Sequence[NextStep] = ()

    @property
    def sentences(self) -> list[str]:
        """All that is said, in the order of rank."""
        figures = (f"{meaning}: {value}" for value, meaning in self.key_figures)
        return [self.headline, *figures, *self.remarks, *self.details]


def format_result(result: Result, pages: Sequence[str]) -> list[str]:
    """Return the card of a result for the terminal: figures and remarks as far as there is room, next command, pages."""
    lines = _wrap(f"{VERDICTS[result.verdict]} {result.verdict.capitalize()}: {result.headline}")
    ends = [*(f"Next: {step.command}" for step in result.next_steps[:1]), *pages]
    width = max((len(value) for value, _ in result.key_figures), default=0)
    texts = [f"{value.rjust(width + 2)}  {meaning}" for value, meaning in result.key_figures]
    for text in [*texts, *result.remarks]:
        wrapped = _wrap(text)
        if len(lines) + len(wrapped) + len(ends) > CARD_LINES:
            break
        lines += wrapped
    return lines + ends
