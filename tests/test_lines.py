"""What a terminal shows: tables of 80 columns, whatever is in them."""

import pytest
from hypothesis import given, strategies as st

from jaxbl.lines import TERMINAL_WIDTH, format_descriptions

WORDS = st.text("abc_.", min_size=1, max_size=30)
TEXTS = st.lists(WORDS, min_size=1, max_size=30).map(" ".join)


def row_lists(*cells):
    return st.lists(st.tuples(*cells), min_size=1, max_size=5)


@given(row_lists(WORDS, WORDS, TEXTS))
def test_texts_go_on_below_themselves_within_80_columns(rows):
    lines = format_descriptions(rows)
    assert all(len(line) <= TERMINAL_WIDTH for line in lines)
    assert " ".join(lines).split() == " ".join(" ".join(row) for row in rows).split()


@pytest.mark.parametrize("name", ["x" * 20, "x" * 50])
def test_a_long_name_has_its_text_below_it(name):
    lines = format_descriptions([(name, "of a plugin, and told at length " * 3), ("y", "")])
    assert (lines[0] == name) == (len(name) > 40)
    assert lines[-1] == "y"
