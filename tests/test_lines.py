"""What a terminal shows: tables of 80 columns, whatever is in them."""

import pytest
from hypothesis import given, strategies as st

from jaxbl.lines import TERMINAL_WIDTH, NextStep, format_descriptions, format_steps, format_table

WORDS = st.text("abc_.", min_size=1, max_size=30)
TEXTS = st.lists(WORDS, min_size=1, max_size=30).map(" ".join)


def row_lists(*cells):
    return st.lists(st.tuples(*cells), min_size=1, max_size=5)


@given(st.integers(2, 12).flatmap(lambda count: row_lists(*[WORDS] * count)), st.booleans())
def test_a_table_holds_every_cell_once_within_80_columns(rows, numbers):
    lines = format_table(rows, numbers=numbers)
    assert all(len(line) <= TERMINAL_WIDTH for line in lines)
    # below, the first column is there again
    blocks = [lines[i : i + len(rows)] for i in range(0, len(lines), len(rows))]
    for row, *parts in zip(rows, *blocks, strict=True):
        assert [cell for part in parts for cell in part.split()[1:]] == list(row[1:])
        assert {part.split()[0] for part in parts} == {row[0]}


@given(row_lists(WORDS, WORDS, TEXTS))
def test_texts_go_on_below_themselves_within_80_columns(rows):
    lines = format_descriptions(rows)
    assert all(len(line) <= TERMINAL_WIDTH for line in lines)
    assert " ".join(lines).split() == " ".join(" ".join(row) for row in rows).split()


def test_columns_end_below_one_another():
    assert format_table([("", "a", "long"), ("row", "12", "1")], numbers=True) == ["      a  long", "row  12     1"]
    assert format_table([("", "a", "long"), ("row", "12", "1")]) == ["     a   long", "row  12  1"]
    assert format_table([("name", "a" * 60, "b" * 20)]) == [f"name  {'a' * 60}", f"name  {'b' * 20}"]


@pytest.mark.parametrize("name", ["x" * 20, "x" * 50])
def test_a_long_name_has_its_text_below_it(name):
    lines = format_descriptions([(name, "of a plugin, and told at length " * 3), ("y", "")])
    assert (lines[0] == name) == (len(name) > 40)
    assert lines[-1] == "y"


def test_command_lines_stay_whole():
    long = f"jaxbl sweep {'folder/' * 20}study.toml"
    assert format_steps([NextStep(long, "A question? " * 10)])[1] == f"  {long}"
    assert format_steps([]) == []
