"""Tables of classes and functions by name: those of this package, and those that installed packages add by entry points."""

import dataclasses
import logging
import multiprocessing
import re
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import entry_points
from typing import Any, TypeVar

Class = TypeVar("Class", bound=type)


class Registry(Mapping[str, Any]):
    """A mapping from names to classes or functions.

    Entry points are loaded once: when all names are asked for, or a name that is not of this package. An entry that cannot
    be imported, or that `check` refuses, is left out with one warning line (logger `jaxbl`), so that a broken add-on never
    ends a command.

    Args:
        group: entry-point group, e.g. `jaxbl.transmissions`.
        check: called with the name and the object of each entry; raises an exception that says what is wrong with it.
    """

    def __init__(self, group: str, check: Callable[[str, Any], None]):
        self.group = group
        self._check = check
        self._members: dict[str, Any] = {}
        self._own: set[str] = set()
        self._loaded = False

    def add(self, cls: Class) -> Class:
        """Add a class of this package under its `name`; a decorator."""
        self._members[cls.name] = cls  # type: ignore[attr-defined]
        return cls

    def register(self, name: str, cls: type) -> None:
        """Add a class of this process, or put it in the place of an earlier one of this process.

        Raises:
            TypeError, ValueError: what is wrong with it, or the name is that of another part.
        """
        if name in self._load_all() and name not in self._own:
            raise ValueError(f"the name '{name}' is taken")
        self._check(name, cls)
        self._own.add(name)
        self._members[name] = cls

    def __getitem__(self, name: str) -> Any:
        return self._members[name] if name in self._members else self._load_all()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._load_all())

    def __len__(self) -> int:
        return len(self._load_all())

    def _load_all(self) -> dict[str, Any]:
        if not self._loaded:
            self._loaded = True
            for entry_point in entry_points(group=self.group):
                try:
                    if entry_point.name in self._members:
                        raise ValueError("the name is taken")
                    member = entry_point.load()
                    self._check(entry_point.name, member)
                    self._members[entry_point.name] = member
                except (Exception, SystemExit) as error:
                    # one line a command: worker processes load the same entries again
                    if multiprocessing.parent_process() is None:
                        text = " ".join(f"{type(error).__name__}: {error}".split())
                        logging.getLogger("jaxbl").warning(
                            f"warning: {self.group}: '{entry_point.name}' ({entry_point.value}) is left out: {text}"
                        )
        return self._members


def check_text(subject: str, text: Any) -> None:
    """Check a text that figures and pages show: one line, and nothing that figures take for mathematics.

    Raises:
        TypeError: it is no text.
        ValueError: it has a control character, or a dollar sign.
    """
    if not isinstance(text, str):
        raise TypeError(f"{subject} should be text")
    if not text.isprintable() or "$" in text:
        raise ValueError(f"{subject} should be one line without control characters and without $, not {text!r}")


def check_subclass(name: str, cls: Any, base: type) -> None:
    """Check that an entry point named `name` gives a class that can be used in place of `base`.

    Raises:
        TypeError: it is no class, not derived from `base`, lacks a method or number, or has another name.
        ValueError: the name is no lower-case word.
    """
    if not (isinstance(cls, type) and issubclass(cls, base)):
        raise TypeError(f"should be a class derived from {base.__name__}")
    if missing := {*getattr(cls, "__abstractmethods__", ()), *getattr(cls, "__abstractvars__", ())}:
        raise TypeError(f"should define {', '.join(sorted(missing))}")
    if (class_name := getattr(cls, "name", None)) != name:
        raise TypeError(f"its name should be '{name}' as in the entry point, not {class_name!r}")
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise ValueError("its name should be a lower-case word of letters, digits and _")


def check_module(name: str, cls: Any, base: type) -> None:
    """Check as :func:`check_subclass` does, and that every number of the class is declared, as its config table needs it."""
    check_subclass(name, cls, base)
    for field in dataclasses.fields(cls):
        if "parameter" not in field.metadata:
            raise TypeError(f"{field.name} should be declared by parameter(...) or option(...)")
        check_text(f"{field.name}: unit", field.metadata["parameter"].unit)
        check_text(f"{field.name}: description", field.metadata["parameter"].doc)
