"""From operations to text: what the languages have in common."""

import abc
import re
import textwrap
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from itertools import chain, count
from typing import Any

import numpy as np

from jaxbl.errors import escape_unprintable

from .block import Port, Program
from .lowering import (
    Choice,
    Constant,
    Operation,
    Repeat,
    Routine,
    Statement,
    Value,
    Variable,
    drop_unread,
    find_constants,
    name_constants,
)


class Writer(abc.ABC):
    """Writes the routines of a program as lines. A statement does one operation, so that compilers that contract only within
    statements contract nothing."""

    marks: tuple[str, str]
    """Those between which a comment stands."""
    assignment: str
    """The sign between a variable and its new value."""
    choice: str
    """Lines that begin a choice, with a place for its condition."""
    otherwise: str
    """Lines that begin the other branch of a choice."""
    end_choice: str
    end_repeat: str

    def __init__(self, program: Program):
        self.program = program
        self.lines: list[str] = []
        self._depth = 0
        self._source = ""
        self._names: dict[Variable, str] = {}
        block = program.block
        self._used = {quantity.name.lower() for quantity in (*block.start_inputs, *block.inputs, *block.outputs)}
        self._numbers = count(1)
        constants = [*find_constants(program.start), *find_constants(program.step)]
        self.constants = name_constants(dict.fromkeys(constants), block.study_numbers)

    # what a language says

    @abc.abstractmethod
    def literal(self, constant: Constant) -> str:
        """Write a number."""

    @abc.abstractmethod
    def declare(self, out: Variable, text: str | None) -> None:
        """Declare a variable that changes later, with its first value if there is one."""

    @abc.abstractmethod
    def write_operation(self, operation: Operation) -> None:
        """Write one operation."""

    @abc.abstractmethod
    def begin_repeat(self, times: int) -> None:
        """Begin a loop."""

    # what they have in common

    def add_lines(self, *texts: str) -> None:
        """Add texts of one or more lines at the present depth."""
        for text in texts:
            self.lines += textwrap.indent(text, "    " * self._depth).split("\n")

    def define(self, out: Variable, text: str) -> None:
        """Define a variable that does not change."""
        self.declare(out, text)

    def assign(self, name: str, text: str) -> None:
        """Change a variable."""
        self.add_lines(f"{name} {self.assignment} {text};")

    def text(self, value: Value) -> str:
        """Write a value in an expression."""
        if isinstance(value, Constant):
            return self.constants.get(value) or self.literal(value)
        return self.name(value)

    def name(self, variable: Variable) -> str:
        """Return the name of a variable in the code."""
        if variable not in self._names:
            self._names[variable] = variable.name or self.make_unique(f"v{next(self._numbers)}")
        return self._names[variable]

    def give_name(self, variable: Variable, name: str) -> None:
        """Give a variable a name."""
        self._names[variable] = self.make_unique(name)

    def make_unique(self, name: str) -> str:
        """Make a name that is not used yet, also if large and small letters count as the same."""
        taken = self._used | {constant_name.lower() for constant_name in self.constants.values()}
        numbered_names = (f"{name}_{i}" for i in count(2))
        unused_name = next(candidate for candidate in chain([name], numbered_names) if candidate.lower() not in taken)
        self._used.add(unused_name.lower())
        return unused_name

    def write_statements(self, statements: Sequence[Statement]) -> None:
        """Write statements, with a comment where they come from another file."""
        for statement in statements:
            file = statement.source.partition(":")[0]
            if file and file != self._source:
                self._source = file
                self.add_lines(write_comment(self.marks, _shorten_source(statement.source)))
            if isinstance(statement, Operation):
                self.write_operation(statement)
            elif isinstance(statement, Repeat):
                self._write_repeat(statement)
            else:
                self._write_choice(statement)

    def _write_repeat(self, loop: Repeat) -> None:
        for variable, start in zip(loop.carried, loop.start, strict=True):
            self.declare(variable, self.text(start))
        self.begin_repeat(loop.times)
        self._depth += 1
        self.write_statements(loop.body.statements)
        self._assign_together(loop.carried, loop.body.results)
        self._depth -= 1
        self.add_lines(self.end_repeat)

    def _assign_together(self, variables: Sequence[Variable], results: Sequence[Value]) -> None:
        """Assign results to variables, all at once: a variable that is read after its assignment is copied first."""
        texts, assigned = [], set()
        for variable, value in zip(variables, results, strict=True):
            if value in assigned and isinstance(value, Variable):
                old_value = Variable(value.dtype)
                self.define(old_value, self.text(value))
                value = old_value
            texts.append(self.text(value))
            assigned.add(variable)
        for variable, text, value in zip(variables, texts, results, strict=True):
            if value is not variable:
                self.assign(self.name(variable), text)

    def _write_choice(self, choice: Choice) -> None:
        yes, no = choice.bodies
        short = not no.statements
        for variable, value in zip(choice.outs, no.results, strict=True):
            self.declare(variable, self.text(value) if short else None)
        self.add_lines(self.choice % self.text(choice.condition))
        for body in choice.bodies:
            self._depth += 1
            self.write_statements(body.statements)
            for variable, value in zip(choice.outs, body.results, strict=True):
                self.assign(self.name(variable), self.text(value))
            self._depth -= 1
            if short:
                break
            if body is yes:
                self.add_lines(self.otherwise)
        self.add_lines(self.end_choice)


def _shorten_source(source: str) -> str:
    """Shorten the name of a source function by what Python adds to it."""
    return re.sub(r"\.<(locals|dictcomp|genexpr|lambda)>", "", source)


def find_unread_names(routine: Routine, quantities: Sequence[Port]) -> list[str]:
    """Find the names of quantities that a routine does not read."""
    read = {variable.name for variable in drop_unread(routine)[1]}
    return [quantity.name for quantity in quantities if quantity.name not in read]


def write_shortest(value: Any) -> str:
    """Write the shortest decimal number that is read as this number again, in its own precision."""
    text = repr(float(value)) if np.asarray(value).dtype == np.float64 else str(np.float32(value))
    return text if any(mark in text for mark in ".en") else f"{text}.0"


_LETTERS = str.maketrans(
    {"²": "^2", "³": "^3", "√": "sqrt ", "·": " ", "°": "deg", "–": "-", "—": "-", "±": "+-", "ρ": "rho", "\\": "/"}
)
"""What stands for letters that not every compiler reads, and for the one that joins lines."""
_COMMENT_MARKS = "*/", "/*", "(*", "*)", "??"
"""Pairs of letters that begin or end a comment; two question marks begin a trigraph of C."""


def separate(text: str, *pairs: str) -> str:
    """Write text of any origin as one printable line, with a blank within each of these pairs of letters."""
    pattern = "|".join(f"{re.escape(first)}(?={re.escape(second)})" for first, second in pairs)
    return re.sub(pattern, r"\g<0> ", escape_unprintable(text))


def write_comment(marks: tuple[str, str], *lines: str) -> str:
    """Write a comment between its marks. No line of it ends the comment, or is joined with the next one."""
    begin, end = marks
    plain_lines = (line.translate(_LETTERS).encode("ascii", "replace").decode() for line in lines)
    texts = (f"   {separate(line, *_COMMENT_MARKS)}".rstrip() for line in plain_lines)
    return f"{begin}{chr(10).join(texts)[2:]} {end}"


def add_element(parent: ET.Element, tag: str, **attributes: Any) -> ET.Element:
    """Add an XML element with attributes: texts, a number, or several numbers."""
    element = ET.SubElement(parent, tag)
    set_attributes(element, **attributes)
    return element


def set_attributes(element: ET.Element, **attributes: Any) -> None:
    """Set attributes of an XML element: texts, a number, or several numbers."""
    for name, value in attributes.items():
        numbers = value if isinstance(value, Sequence) else [value]
        element.set(name, value if isinstance(value, str) else format_numbers(*numbers))


def format_numbers(*values: Any) -> str:
    """Write numbers with all their digits, with spaces between them."""
    return " ".join(repr(float(value) + 0.0).removesuffix(".0") for value in values)
