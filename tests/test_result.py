"""What a command found, on a terminal: eight lines of a hundred characters, whatever is in them."""

import pytest
from hypothesis import given, strategies as st

from jaxbl.lines import NextStep
from jaxbl.result import CARD_LINES, CARD_WIDTH, VERDICTS, KeyFigure, Result, format_result

WORDS = st.text("abc_.", min_size=1, max_size=15)
SENTENCES = st.lists(WORDS, min_size=1, max_size=20).map(" ".join)
FIGURES = st.lists(st.builds(KeyFigure, WORDS, st.lists(WORDS, min_size=1, max_size=4).map(" ".join)), max_size=4)


@given(st.sampled_from([*VERDICTS]), SENTENCES.map(lambda text: text[:120]), FIGURES, st.lists(SENTENCES, max_size=9))
def test_the_card_has_eight_lines_and_keeps_the_order_of_rank(verdict, headline, figures, remarks):
    remarks = [f"{i}: {remark}" for i, remark in enumerate(remarks)]
    result = Result("title", verdict, headline, figures, remarks)
    lines = format_result(result, ["folder/report.html"])
    assert len(lines) <= CARD_LINES and all(len(line) <= CARD_WIDTH for line in lines)
    assert lines[0].startswith(f"{VERDICTS[verdict]} {verdict.capitalize()}: ") and lines[-1] == "folder/report.html"
    words = " ".join(" ".join(lines[:-1]).split())
    assert all(value in words and meaning in words for value, meaning in figures)
    shown = [f"{i}: " in words for i in range(len(remarks))]
    assert shown == sorted(shown, reverse=True)


def test_a_command_stays_whole_and_only_the_first_is_shown():
    steps = [NextStep(f"jaxbl sweep {'folder/' * 30}study.toml", "A question?"), NextStep("jaxbl explore x", "Another?")]
    lines = format_result(Result("title", "good", "It works.", next_steps=steps), [])
    assert lines == ["✓ Good: It works.", f"Next: {steps[0].command}"]


@pytest.mark.parametrize("count", [0, 4])
def test_sentences_are_all_that_is_said_in_the_order_of_rank(count):
    result = Result("title", "good", "Answer.", [KeyFigure("1 m", "length")] * count, ["remark"], ["detail"])
    assert result.sentences == ["Answer.", *["length: 1 m"] * count, "remark", "detail"]
