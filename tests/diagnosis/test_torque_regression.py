"""Effects that the missing torque shows by itself."""

import jax
import numpy as np
import pytest
from hidden_log import FRICTION, nominal_study, simulate_multisine_log

from jaxbl.diagnosis.candidates import replaces, variants_of
from jaxbl.diagnosis.choice import Choice
from jaxbl.diagnosis.diagnosis_task import read_diagnosis_task
from jaxbl.diagnosis.setup import set_up


def regress(folder, *effects):
    simulate_multisine_log(effects).write(folder / "axis.csv")
    task = read_diagnosis_task(folder / "axis.csv", nominal_study())
    with jax.enable_x64(True):
        search = Choice(set_up(task)).search
        nominal = search.fits.fit({}, np.zeros(len(search.fits.prior)))
        linear = search.fits.given
        regression = search._regress(linear, nominal, variants_of(search.fits.nominal, search.lacking, linear.scales))
        return regression.propose(), regression.propose_together()


def test_the_effect_that_takes_most_of_the_missing_torque_is_proposed_with_its_number(tmp_path):
    (first, *further), together = regress(tmp_path, "friction")
    names = [first.name, *(proposal.name for proposal in further)]
    # friction that falls with speed, or bends, contains it
    assert "motor.coulomb_friction" in names[:3] and first.share > 0.7
    coulomb = next(proposal for proposal in (first, *further) if proposal.name == "motor.coulomb_friction")
    assert coulomb.numbers["torque"] == pytest.approx(FRICTION["torque"], rel=0.1)
    # the simple one is proposed together with others, and nothing else is
    assert list(together) == ["motor.coulomb_friction"]


def test_nothing_is_proposed_where_nothing_is_missing(tmp_path):
    proposed, together = regress(tmp_path)
    assert all(proposal.share < 0.02 for proposal in proposed) and together == {}


def test_an_effect_takes_the_place_of_its_special_case():
    assert replaces("motor.presliding_friction", "motor.coulomb_friction")
    assert replaces("motor.presliding_friction", "motor.stribeck_friction")
    assert not replaces("motor.presliding_friction", "load.coulomb_friction")
    assert not replaces("motor.presliding_friction", "motor.constant_torque")
