"""Figures of residual torques: drawn for every equation, with the sentence, whatever is found."""

import numpy as np
import pytest
from panel_parts import names_of, part_named, texts_of

from jaxbl.diagnosis.coordinates import CoordinateValues
from jaxbl.diagnosis.localise import locate
from jaxbl.diagnosis.observer_residual import Observed
from jaxbl.diagnosis.residuals import Residual
from jaxbl.diagnosis.sentences import sentence_of
from jaxbl.report.drawing import save
from jaxbl.report.residuals import draw_residuals


def make_residual(name, torque, time):
    noise = 0.05 * np.random.default_rng(0).standard_normal(len(time))
    count = len(time)
    residual = Residual(name, time, torque + noise, np.full(count, 0.05), np.ones(1), 100.0)
    values = {
        "direction": CoordinateValues((np.cos(time) > 0.0).astype(int), classes=("backward", "forward")),
        "speed": CoordinateValues(3.0 * np.cos(time), "rad/s", symbol="ω"),
        "position": CoordinateValues(3.0 * np.sin(time), "rad", symbol="θe"),
        "time": CoordinateValues(time, "s", symbol="t"),
    }
    return residual, values


def test_observers_that_converge_are_drawn_thin(tmp_path):
    time = 5e-3 * np.arange(4000)
    torque = {name: -0.1 * np.sign(np.cos(time)) for name in ("motor", "load")}
    pairs = {name: make_residual(name, side_torque, time) for name, side_torque in torque.items()}
    residuals, coordinates = ({name: [pair[i]] for name, pair in pairs.items()} for i in range(2))
    result = {name: locate(residuals[name], coordinates[name]) for name in pairs}
    observed = {name: [Observed(pair[0], 0, 0.5 * (name == "load"))] for name, pair in pairs.items()}
    drawing = draw_residuals(residuals, coordinates, result, observed=observed)[0]
    above, below = map(names_of, drawing.panels)
    assert above[:2] == below == ["± 2 noise", "missing"] and len(above) == 3
    assert above[2].startswith("by its observer (noise 0.0") and "super-twisting" in drawing.caption
    assert part_named(drawing.panels[0], "by its").width < part_named(drawing.panels[0], "missing").width
    assert save(drawing, tmp_path / "over_time.png").stat().st_size > 10_000


@pytest.mark.parametrize("unit", ["N m", "N"])
def test_every_equation_is_drawn_with_what_was_found(tmp_path, unit):
    time = 5e-3 * np.arange(8000)
    torque = {"motor": -0.1 * np.sign(np.cos(time)) + 0.1 * np.sin(2.0 * np.pi * 11.0 * time), "load": np.zeros(8000)}
    pairs = {name: make_residual(name, side_torque, time) for name, side_torque in torque.items()}
    residuals = {name: [residual] for name, (residual, _) in pairs.items()}
    coordinates = {name: [values] for name, (_, values) in pairs.items()}
    result = {name: locate(residuals[name], coordinates[name]) for name in pairs}
    drawings = {drawing.name: drawing for drawing in draw_residuals(residuals, coordinates, result, unit)}
    assert list(drawings) == ["residual_torque", "residual_motor", "residual_load", "residual_spectrum"]
    above, below = drawings["residual_torque"].panels
    assert sentence_of(result["motor"], unit) == " ".join(above.title.split())
    assert "nothing beyond noise" in below.title
    assert above.y.label.endswith(f"({unit})")
    assert drawings["residual_motor"].panels[0].x.label == "speed ω (rad/s)"
    assert any(text.startswith("11 Hz") for text in texts_of(drawings["residual_spectrum"].panels[0]))
    for drawing in drawings.values():
        assert save(drawing, tmp_path / f"{drawing.name}.png").stat().st_size > 10_000
        assert drawing.caption.endswith(".")
