"""Exported structured text: parsed and run, it is the traced step bit for bit."""

import numpy as np
import pytest
from native import draw_samples, to_integers
from structured_text import FunctionBlock
from test_c import export_native, run_native, run_strict, study

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


@pytest.mark.program("gcc")
@pytest.mark.parametrize("kind", ["super_twisting", "dirty_derivative"])
def test_in_float_many_turns_away_it_is_the_code_in_c(tmp_path, kind, repeats):
    """And as good as near zero: the velocity is that of the same motion there."""
    random = np.random.default_rng(46)
    for case in range(repeats(2, 20)):
        data, time = study(kind), 1e-3 * np.arange(300)
        data["drive"]["gear_ratio"] = ratio = float(random.choice([0.5, 5.0, random.uniform(1.0, 300.0)]))
        motor = random.uniform(20.0, 90.0) * np.sin(random.uniform(5.0, 20.0) * time)
        near = np.stack([0.1 * np.sin(3.0 * time), motor, motor / ratio], axis=1)
        away = near + float(random.choice([-1.0, 1.0]) * 10.0 ** random.uniform(3.0, 7.0)) * np.array(
            [0.0, 1.0, 1.0 / ratio]
        )
        jaxbl.export(data, tmp_path / f"st_{case}", "st", precision="float", name="drive")
        text = (tmp_path / f"st_{case}" / "drive.st").read_text()
        near_rows, rows = (
            [block(input=u, motor_position=y, load_position=z) for u, y, z in inputs]
            for inputs, block in ((near, FunctionBlock(text)), (away, FunctionBlock(text)))
        )
        native = export_native(tmp_path / f"c_{case}", data, "float")
        native.dtype = np.dtype(float)
        assert (np.array([list(row.values()) for row in rows], float) == run_native(native, away)).all()
        for side in ("motor", "load"):
            name = f"{side}_velocity_estimate"
            there, here = (np.array([row[name] for row in found[50:]], float) for found in (rows, near_rows))
            np.testing.assert_allclose(there, here, atol=2e-3 * np.ptp(here))


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
