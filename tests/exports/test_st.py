"""Exported structured text: parsed and run, it is the traced step bit for bit."""

import numpy as np
import pytest
from native import draw_samples, to_integers
from structured_text import FunctionBlock
from test_c import run_strict, study

import jaxbl
from jaxbl.observer import OBSERVERS


# kinds of numbers are told apart by the writer alone, kinds of observers in single precision by the tests of C
@pytest.mark.parametrize(
    ("kind", "precision"), [*((kind, "double") for kind in OBSERVERS), ("super_twisting", "float"), ("kalman", "float")]
)
def test_every_kind_is_the_traced_step_bit_for_bit(tmp_path, kind, precision):
    jaxbl.export(study(kind), tmp_path, "st", precision=precision, name="drive")
    block = FunctionBlock((tmp_path / "drive.st").read_text())
    assert block.name.text == b"drive"
    inputs = draw_samples(150, 2)
    rows = [list(block(input=u, motor_position=y, load_position=z).values()) for u, y, z in inputs]
    expected = run_strict(study(kind), precision, inputs)
    assert (to_integers(np.array(rows, expected.dtype)) == to_integers(expected)).all()
    again = block(input=inputs[0, 0], motor_position=inputs[0, 1], load_position=inputs[0, 2], restart=True)
    assert list(again.values()) == rows[0]


@pytest.mark.parametrize(
    "wrong",
    [
        ("END_IF;", ""),
        ("LREAL#0.0001", "REAL#0.0001"),
        ("LREAL#0.001;", "0.001;"),
        ("restart OR", "samples OR"),
        ("ABS(", "FABS("),
    ],
)
def test_what_is_no_structured_text_is_refused(tmp_path, wrong):
    """The check itself can fail."""
    jaxbl.export(study(), tmp_path, "st", name="drive")
    text = (tmp_path / "drive.st").read_text()
    assert wrong[0] in text
    with pytest.raises((AssertionError, KeyError)):
        FunctionBlock(text.replace(*wrong, 1))(input=0.0, motor_position=0.0, load_position=0.0)
