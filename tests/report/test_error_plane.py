"""The figures of the error in its phase plane."""

import numpy as np
import pytest
from panel_parts import names_of
from small_study import small_study

from jaxbl.report.simulate import error_plane
from jaxbl.sweeps.trial import run


def test_the_majorant_is_drawn_with_its_ratio_and_the_error_stays_inside():
    gains = {"lambda": 6.0, "alpha": 9.0, "velocity_error": 0.5}
    trial = run(small_study({"observer.motor": gains, "encoders.noise": 0.0, "run.duration": 1.0}))
    motor = trial.summary["conditions"]["motor"]
    (drawing,) = error_plane(trial.trace, "motor", motor)
    (panel,) = drawing.panels
    error, majorant = panel.parts
    assert majorant.y[0] == pytest.approx(0.5, rel=0.05)
    assert np.abs(error.x).max() <= np.abs(majorant.x).max()
    ratio = motor["least_lambda"]["davila_fridman"] / motor["lambda"]
    name, majorant_name = names_of(panel)
    assert majorant_name == f"majorant (36)-(37): ratio {ratio:.3g}"
    # what the run shows is no worse than the worst case
    assert name.endswith(f", at most {motor['peak_ratio']:.3g}")
    assert float(name.split()[4]) <= motor["peak_ratio"]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"alpha": 0.01}, "There is no majorant: α is not above f⁺."),
        ({"lambda": 0.0}, "There is no majorant: λ is zero."),
    ],
)
def test_why_there_is_no_majorant_is_said(changes, sentence):
    gains = {"lambda": 6.0, "alpha": 9.0, "velocity_error": 0.5} | changes
    trial = run(small_study({"observer.motor": gains, "run.duration": 1.0}))
    (drawing,) = error_plane(trial.trace, "motor", trial.summary["conditions"]["motor"])
    assert drawing.caption.endswith(sentence) and len(names_of(drawing.panels[0])) == 1


def test_an_error_that_noise_tangles_has_no_figure():
    trial = run(small_study({"encoders.noise": 1e-2, "observer.motor.velocity_error": 0.0, "run.duration": 1.0}))
    assert not [*error_plane(trial.trace, "motor", trial.summary["conditions"]["motor"])]
