"""From operations to text: what the languages have in common."""

import abc
from collections.abc import Sequence
from itertools import chain, count
from typing import Any

import numpy as np

from .block import Program, Quantity
from .lowering import (
    Choice,
    Constant,
    Operation,
    Repeat,
    Routine,
    Statement,
    Value,
    Variable,
    constants_of,
    named_constants,
    read_by,
)


class Writer(abc.ABC):
    """Writes the routines of a program as lines. A statement does one operation, so that compilers that contract only within
    statements contract nothing."""

    indent = "    "

    def __init__(self, program: Program):
        self.program = program
        self.lines: list[str] = []
        self._depth = 0
        self._source = ""
        self._names: dict[Variable, str] = {}
        block = program.block
        self._used = {one.name.lower() for one in (*block.first, *block.inputs, *block.outputs)}
        self._numbers = count(1)
        every = [one for routine in (program.start, program.step) for one in constants_of(routine)]
        self.constants = named_constants(dict.fromkeys(every), program.block.known)

    # what a language says

    @abc.abstractmethod
    def literal(self, constant: Constant) -> str:
        """A number of the code itself."""

    @abc.abstractmethod
    def remark(self, text: str) -> str:
        """A comment."""

    @abc.abstractmethod
    def define(self, out: Variable, text: str) -> None:
        """A variable that stays what it is."""

    @abc.abstractmethod
    def declare(self, out: Variable, text: str | None) -> None:
        """A variable that is changed later; it begins as something, if that is said."""

    @abc.abstractmethod
    def assign(self, name: str, text: str) -> None:
        """Change a variable."""

    @abc.abstractmethod
    def operation(self, one: Operation) -> None:
        """Write one operation."""

    @abc.abstractmethod
    def begin_repeat(self, times: int) -> None:
        """Begin a loop."""

    @abc.abstractmethod
    def begin_if(self, which: str) -> None:
        """Begin a choice."""

    @abc.abstractmethod
    def begin_else(self) -> None:
        """Begin its other way."""

    @abc.abstractmethod
    def end(self, what: str) -> None:
        """End a "repeat" or an "if"."""

    # what they have in common

    def line(self, text: str = "") -> None:
        """A line at the present depth."""
        self.lines.append(f"{self.indent * self._depth}{text}" if text else "")

    def text(self, value: Value) -> str:
        """A value in an expression."""
        if isinstance(value, Constant):
            return self.constants.get(value) or self.literal(value)
        return self.name(value)

    def name(self, variable: Variable) -> str:
        """A variable's name in the code."""
        if variable not in self._names:
            self._names[variable] = variable.name or self.unique(f"v{next(self._numbers)}")
        return self._names[variable]

    def call(self, variable: Variable, name: str) -> None:
        """Give a variable a name."""
        self._names[variable] = self.unique(name)

    def unique(self, name: str) -> str:
        """A name that nothing else has; no language may tell large letters from small ones."""
        taken = self._used | {one.lower() for one in self.constants.values()}
        found = next(one for one in chain([name], (f"{name}_{i}" for i in count(2))) if one.lower() not in taken)
        self._used.add(found.lower())
        return found

    def statements(self, statements: Sequence[Statement]) -> None:
        """Write statements, with a comment where they come from another file."""
        for one in statements:
            file = one.source.partition(":")[0]
            if file and file != self._source:
                self._source = file
                self.line(self.remark(_place(one.source)))
            if isinstance(one, Operation):
                self.operation(one)
            elif isinstance(one, Repeat):
                self._repeat(one)
            else:
                self._choice(one)

    def _repeat(self, one: Repeat) -> None:
        for variable, start in zip(one.carried, one.start, strict=True):
            self.declare(variable, self.text(start))
        self.begin_repeat(one.times)
        self._depth += 1
        self.statements(one.body)
        self._assigned(one.carried, one.results)
        self._depth -= 1
        self.end("repeat")

    def _assigned(self, to: Sequence[Variable], results: Sequence[Value]) -> None:
        """All at once: one that is read after it has changed is kept first."""
        texts, seen = [], set()
        for variable, value in zip(to, results, strict=True):
            if value in seen and isinstance(value, Variable):
                kept = Variable(value.dtype, -1)
                self.define(kept, self.text(value))
                value = kept
            texts.append(self.text(value))
            seen.add(variable)
        for variable, text, value in zip(to, texts, results, strict=True):
            if value is not variable:
                self.assign(self.name(variable), text)

    def _choice(self, one: Choice) -> None:
        yes, no = one.bodies
        short = not no
        for variable, value in zip(one.outs, one.results[1], strict=True):
            self.declare(variable, self.text(value) if short else None)
        self.begin_if(self.text(one.which))
        for body, results in zip((yes, no), one.results, strict=True):
            self._depth += 1
            self.statements(body)
            for variable, value in zip(one.outs, results, strict=True):
                self.assign(self.name(variable), self.text(value))
            self._depth -= 1
            if short:
                break
            if body is yes:
                self.begin_else()
        self.end("if")


def _place(source: str) -> str:
    """A source without what Python adds."""
    return source.replace("<locals>.", "").replace(".<dictcomp>", "").replace(".<genexpr>", "").replace(".<lambda>", "")


def unread(routine: Routine, quantities: Sequence[Quantity]) -> list[str]:
    """Names of those of some quantities that a routine does not read."""
    read = {variable.name for variable in read_by(routine)}
    return [one.name for one in quantities if one.name not in read]


def shortest(value: Any) -> str:
    """The shortest decimal number that is read as this one again, in its own precision."""
    text = repr(float(value)) if np.asarray(value).dtype == np.float64 else str(np.float32(value))
    return text if any(mark in text for mark in ".en") else f"{text}.0"


_LETTERS = {"²": "^2", "³": "^3", "√": "sqrt ", "·": " ", "°": "deg", "–": "-", "—": "-", "±": "+-", "ρ": "rho"}


def plain_text(text: str) -> str:
    """The text in letters that every compiler reads."""
    for letter, other in _LETTERS.items():
        text = text.replace(letter, other)
    return text.encode("ascii", "replace").decode()
