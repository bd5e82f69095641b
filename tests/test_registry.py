"""Classes of installed packages: found by name, and left out with one line where something is wrong with them."""

import abc
import sys

import pytest
from plugin import install_package

from jaxbl.registry import Registry, check_subclass, check_text

SOURCE = """
import test_registry

class Good(test_registry.Base):
    name = "good"
    def answer(self): return 1

class Renamed(Good):
    name = "other"

class Half(test_registry.Base):
    name = "half"

class Markup(Good):
    name = "<b>"

number = 3
"""


class Base(abc.ABC):
    name = "base"

    @abc.abstractmethod
    def answer(self):
        raise NotImplementedError


def registry():
    table = Registry("jaxbl.tests", lambda name, cls: check_subclass(name, cls, Base))

    @table.add
    class BuiltIn(Base):
        name = "built_in"

    return table, BuiltIn


@pytest.fixture
def install(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "test_registry", sys.modules[__name__])
    yield lambda **entries: install_package(tmp_path, "some_addon", SOURCE, {"jaxbl.tests": entries})
    sys.modules.pop("some_addon", None)


def test_built_in_classes_come_first_and_entry_points_after_them(install, caplog):
    install(good="Good")
    table, built_in = registry()
    assert list(table) == ["built_in", "good"]
    assert table["built_in"] is built_in
    assert table["good"].__module__ == "some_addon"
    assert len(table) == 2 and "nothing" not in table
    assert not caplog.records


@pytest.mark.parametrize(
    ("name", "member", "fault"),
    [
        ("gone", "Missing", "AttributeError: module 'some_addon' has no attribute 'Missing'"),
        ("gone", "number", "TypeError: should be a class derived from Base"),
        ("half", "Half", "TypeError: should define answer"),
        ("gone", "Renamed", "TypeError: its name should be 'gone' as in the entry point, not 'other'"),
        ("built_in", "Good", "ValueError: the name is taken"),
        ("<b>", "Markup", "ValueError: its name should be a lower-case word of letters, digits and _"),
    ],
)
def test_a_wrong_entry_is_left_out_with_one_line(install, caplog, name, member, fault):
    install(**{name: member})
    table, built_in = registry()
    assert dict(table) == {"built_in": built_in}
    assert caplog.messages == [f"warning: jaxbl.tests: '{name}' (some_addon:{member}) is left out: {fault}"]
    assert list(table) == ["built_in"] and len(caplog.messages) == 1  # said once


@pytest.mark.parametrize("statement", ["import nothing_of_this_name", "syntax error", "raise SystemExit(3)"])
def test_an_entry_that_cannot_be_imported_is_left_out(tmp_path, monkeypatch, caplog, statement):
    monkeypatch.syspath_prepend(tmp_path)
    install_package(tmp_path, "broken_addon", statement, {"jaxbl.tests": {"one": "One"}})
    table, _ = registry()
    assert "one" not in table
    assert len(caplog.messages) == 1 and "\n" not in caplog.messages[0]


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (None, "unit should be text"),
        ("N$m", "unit should be one line without control characters and without $, not 'N$m'"),
        ("a\nb", "unit should be one line without control characters and without $, not 'a\\nb'"),
        ("\u202e", "unit should be one line without control characters and without $, not '\\u202e'"),
    ],
)
def test_texts_that_figures_cannot_show_are_refused(text, fault):
    with pytest.raises((TypeError, ValueError)) as error:
        check_text("unit", text)
    assert str(error.value) == fault
    check_text("unit", "√rad/s <b> {0} %s")
