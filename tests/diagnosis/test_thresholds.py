"""What decides stands in one place: no number in a comparison elsewhere, and a change of one changes what is said."""

import ast
import dataclasses
from pathlib import Path

import pytest

import jaxbl.diagnosis
from jaxbl.diagnosis.effect_search import Gain
from jaxbl.diagnosis.thresholds import LIMITS, Thresholds, use_thresholds

FOLDER = Path(jaxbl.diagnosis.__file__).parent
COUNTS = {-1, 0, 1, 2}
"""Numbers that count or part signs, and decide nothing by their size."""


def numbers_in_comparisons(source):
    return [
        f"line {comparison.lineno}: {number.value}"
        for comparison in ast.walk(ast.parse(source))
        if isinstance(comparison, ast.Compare)
        for side in (comparison.left, *comparison.comparators)
        for number in ast.walk(side)
        if isinstance(number, ast.Constant) and isinstance(number.value, int | float) and number.value not in COUNTS
    ]


def test_a_number_in_a_comparison_is_found():
    assert numbers_in_comparisons("if x > 3.5 * y: ...") == ["line 1: 3.5"]
    assert numbers_in_comparisons("if x > 0 or len(y) < 2: ...") == []


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_no_number_stands_in_a_comparison(path):
    assert numbers_in_comparisons(path.read_text(encoding="utf-8")) == []


def test_there_are_few_of_them_each_with_its_unit_and_reason():
    fields = dataclasses.fields(Thresholds)
    assert len(fields) <= 15
    for field in fields:
        about = field.metadata["parameter"]
        assert about.unit and len(about.doc.split()) > 5


def test_a_threshold_can_be_changed_for_a_while():
    before = LIMITS.sure
    with use_thresholds(sure=2.6):
        assert LIMITS.sure == 2.6
    assert LIMITS.sure == before
    with pytest.raises(ZeroDivisionError), use_thresholds(sure=2.6):
        1 / 0  # noqa: B018
    assert LIMITS.sure == before
    with pytest.raises(TypeError), use_thresholds(surely=1.0):
        pass
    with pytest.raises(dataclasses.FrozenInstanceError):
        LIMITS.sure = 3.0  # type: ignore[misc]


@pytest.mark.parametrize(
    ("gain", "accepted"), [(Gain(0.1, 2.1, 2.0), True), (Gain(-0.1, 9.0, 2.0), False), (Gain(90.0, 1.9, 2.0), False)]
)
def test_nats_and_blocks_both_have_to_pay(gain, accepted):
    assert gain.is_accepted is accepted
