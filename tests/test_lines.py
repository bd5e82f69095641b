"""What a terminal shows: tables of 80 columns, whatever is in them."""

import pytest
from hypothesis import given, strategies as st

from jaxbl.lines import TERMINAL_WIDTH, format_descriptions, percent

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


@given(st.floats(1e-6, 50.0))
def test_shares_have_no_exponent_where_there_is_a_percent(share):
    text = percent(share)
    assert float(text.removesuffix(" %")) == pytest.approx(100.0 * share, rel=0.06)
    assert "e" not in text or share < 1e-5


def test_all_of_it_is_100_percent():
    assert [percent(share) for share in (0.996, 1.0, 0.0123, 12.3)] == ["100 %", "100 %", "1.2 %", "1230 %"]
