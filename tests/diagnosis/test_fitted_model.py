"""What may be said of the numbers of a model."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jaxbl.diagnosis.refit import FittedModel
from jaxbl.drive import make_effect

FRICTION, DRAG, WAVE = "motor.presliding_friction", "motor.quadratic_drag", "motor.cogging"


@pytest.fixture
def fitted():
    """Friction, and a drag that is all but a viscous friction."""
    shares = {FRICTION: 0.5, DRAG: 0.1, WAVE: 0.02}
    effects = (
        make_effect(FRICTION, torque=0.1, length=0.1),
        make_effect(DRAG, drag=0.01),
        make_effect(WAVE, amplitude=0.02, harmonic=7.0, phase=0.0),
    )
    paths = "drive.motor_viscous", f"effects.{DRAG}.drag", f"effects.{WAVE}.amplitude"
    any_model: Any = SimpleNamespace
    return FittedModel(
        names=(FRICTION, DRAG, WAVE), experiment=any_model(effects=effects),
        free=tuple(any_model(path=path) for path in paths), theta=np.zeros(3), covariance=np.eye(3),
        white=np.eye(3), inflation=np.array([50.0, 50.0, 1.0]),
        end=any_model(linear=any_model(torque_share=lambda effect: shares[effect.name])),
    )  # fmt: skip


def test_what_another_number_makes_up_for_is_not_an_effects_own_torque(fitted):
    assert fitted.own_share(DRAG) == pytest.approx(0.1 / np.sqrt(50.0))
    assert fitted.own_share(WAVE) == pytest.approx(0.02)


def test_laws_of_friction_may_miss_a_part_of_it(fitted):
    assert fitted.missed_share(WAVE) == pytest.approx(0.05 * 0.5)
    # its own law is not what is missed
    assert fitted.missed_share(FRICTION) == 0.0
