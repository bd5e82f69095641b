"""What may be said of the numbers of a model."""

from types import SimpleNamespace

import pytest

from jaxbl.diagnosis.fitted_model import special_case
from jaxbl.drive import make_effect


@pytest.mark.parametrize(("error", "apart"), [(0.02, True), (0.2, False)])
def test_an_effect_may_be_its_special_case_where_the_number_that_parts_them_is_open(error, apart):
    name = "motor.presliding_friction"
    fitted = SimpleNamespace(
        experiment=SimpleNamespace(effects=(make_effect(name, torque=0.1, length=0.1),)),
        errors=lambda: {f"effects.{name}.torque": 1e-3, f"effects.{name}.length": error},
    )
    assert special_case(fitted, name) == (None if apart else "motor.coulomb_friction")  # type: ignore[arg-type]
