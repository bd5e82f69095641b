"""Classes and functions by name: those of this package, and those that installed packages add through entry points."""

import dataclasses
import logging
import multiprocessing
import re
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import entry_points
from typing import Any, TypeVar

Added = TypeVar("Added", bound=type)


class Registry(Mapping[str, Any]):
    """Name -> class or function. Entry points are loaded once, when names are first listed or one is not of this package.

    An entry that cannot be imported, or that the check refuses, is left out with one warning line (logger `jaxbl`): a
    broken add-on never ends a command.

    Args:
        group: entry-point group, e.g. `jaxbl.transmissions`.
        check: is given the name and the object of an entry, and raises an exception that says what is wrong with it.
    """

    def __init__(self, group: str, check: Callable[[str, Any], None]):
        self.group = group
        self._check = check
        self._found: dict[str, Any] = {}
        self._loaded = False

    def add(self, cls: Added) -> Added:
        """Add a class of this package under its `name`; a decorator."""
        self._found[cls.name] = cls  # type: ignore[attr-defined]
        return cls

    def __getitem__(self, name: str) -> Any:
        return self._found[name] if name in self._found else self._all()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())

    def _all(self) -> dict[str, Any]:
        if not self._loaded:
            self._loaded = True
            for entry in entry_points(group=self.group):
                try:
                    if entry.name in self._found:
                        raise ValueError("the name is taken")
                    found = entry.load()
                    self._check(entry.name, found)
                    self._found[entry.name] = found
                except (Exception, SystemExit) as error:
                    # one line a command: worker processes load the same entries again
                    if multiprocessing.parent_process() is None:
                        text = " ".join(f"{type(error).__name__}: {error}".split())
                        logging.getLogger("jaxbl").warning(
                            f"warning: {self.group}: '{entry.name}' ({entry.value}) is left out: {text}"
                        )
        return self._found


def check_text(what: str, text: Any) -> None:
    """Check a text that figures and pages show: one line, and nothing that figures take for mathematics.

    Raises:
        TypeError: it is no text.
        ValueError: it has a control character, or a dollar sign.
    """
    if not isinstance(text, str):
        raise TypeError(f"{what} should be text")
    if not text.isprintable() or "$" in text:
        raise ValueError(f"{what} should be one line without control characters and without $, not {text!r}")


def check_subclass(name: str, found: Any, base: type) -> None:
    """Check that an entry is a class that can be used in place of `base`, under the name that it was entered with.

    Raises:
        TypeError: it is no class, not derived from `base`, lacks a method or number, or has another name.
        ValueError: the name is no lower-case word.
    """
    if not (isinstance(found, type) and issubclass(found, base)):
        raise TypeError(f"should be a class derived from {base.__name__}")
    if missing := {*getattr(found, "__abstractmethods__", ()), *getattr(found, "__abstractvars__", ())}:
        raise TypeError(f"should define {', '.join(sorted(missing))}")
    if (own := getattr(found, "name", None)) != name:
        raise TypeError(f"its name should be '{name}' as in the entry point, not {own!r}")
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise ValueError("its name should be a lower-case word of letters, digits and _")


def check_module(name: str, found: Any, base: type) -> None:
    """As :func:`check_subclass`, and that every number of the class is declared, as its config table needs it."""
    check_subclass(name, found, base)
    for field in dataclasses.fields(found):
        if "parameter" not in field.metadata:
            raise TypeError(f"{field.name} should be declared by parameter(...) or option(...)")
        check_text(f"{field.name}: unit", field.metadata["parameter"].unit)
        check_text(f"{field.name}: description", field.metadata["parameter"].doc)
