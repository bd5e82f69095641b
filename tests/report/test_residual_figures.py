"""Figures of residual torques: drawn for every equation, with the sentence, whatever is found."""

import numpy as np
import pytest

from jaxbl.diagnosis.coordinates import CoordinateValues
from jaxbl.diagnosis.localise import locate
from jaxbl.diagnosis.residuals import Residual
from jaxbl.diagnosis.sentences import sentence_of
from jaxbl.report.diagnose import draw_residual
from jaxbl.report.drawing import save


def make_residual(name, torque, time):
    noise = 0.05 * np.random.default_rng(0).standard_normal(len(time))
    count = len(time)
    residual = Residual(name, time, torque + noise, np.full(count, 0.05), np.ones(2), 100.0)
    values = {
        "direction": CoordinateValues((np.cos(time) > 0.0).astype(int), classes=("backward", "forward")),
        "speed": CoordinateValues(3.0 * np.cos(time), "rad/s", symbol="ω"),
        "position": CoordinateValues(3.0 * np.sin(time), "rad", symbol="θe"),
        "time": CoordinateValues(time, "s", symbol="t"),
    }
    return residual, values


@pytest.mark.parametrize("unit", ["N m", "N"])
def test_every_equation_is_drawn_with_what_was_found(tmp_path, unit):
    time = 5e-3 * np.arange(8000)
    torque = {"motor": -0.1 * np.sign(np.cos(time)) + 0.1 * np.sin(2.0 * np.pi * 11.0 * time), "load": np.zeros(8000)}
    pairs = {name: make_residual(name, side_torque, time) for name, side_torque in torque.items()}
    residuals = {name: [residual] for name, (residual, _) in pairs.items()}
    coordinates = {name: [values] for name, (_, values) in pairs.items()}
    result = {name: locate(residuals[name], coordinates[name]) for name in pairs}
    drawings = [draw_residual(residuals[name], coordinates[name], result[name], unit) for name in pairs]
    assert [drawing.name for drawing in drawings] == ["residual_motor", "residual_load"]
    above, below = drawings
    assert above.caption.lower().startswith(sentence_of(result["motor"], unit).lower())
    assert "nothing beyond noise" in below.caption
    assert above.panels[0].y.label.endswith(f"({unit})")
    assert above.panels[0].x.label == "speed ω (rad/s)"
    for drawing in drawings:
        assert save(drawing, tmp_path / f"{drawing.name}.png").stat().st_size > 10_000
        assert drawing.caption.endswith(".")
