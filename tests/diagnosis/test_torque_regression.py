"""Effects that the missing torque shows by itself."""

import jax
import numpy as np
import pytest
from hidden_log import FRICTION, nominal_study, simulate_multisine_log

from jaxbl.diagnosis.choice import new_search
from jaxbl.diagnosis.diagnosis_task import read_diagnosis_task
from jaxbl.diagnosis.setup import set_up
from jaxbl.diagnosis.torque_regression import _proposals, _replaced


def propose_effects(folder, *effects):
    simulate_multisine_log(effects).write(folder / "axis.csv")
    task = read_diagnosis_task(folder / "axis.csv", nominal_study())
    with jax.enable_x64(True):
        setup = set_up(task)
        search = new_search(setup)
        theta = np.zeros(len(setup.own))
        nominal = search.refit({}, theta, search.linear({}, theta).choose(()))
        return _proposals(search, nominal, setup.lacking, setup.fitted)


def test_the_effect_that_takes_most_of_the_missing_torque_is_proposed_with_its_number(tmp_path):
    first, *further = propose_effects(tmp_path, "friction")
    names = [first.name, *(proposal.name for proposal in further)]
    # friction that falls with speed, or bends, contains it
    assert "motor.coulomb_friction" in names[:3] and first.gain > 0.7
    coulomb = next(proposal for proposal in (first, *further) if proposal.name == "motor.coulomb_friction")
    assert coulomb.numbers["torque"] == pytest.approx(FRICTION["torque"], rel=0.1)
    assert all(proposal.gain > 0.03 for proposal in further)


def test_nothing_is_proposed_where_nothing_is_missing(tmp_path):
    assert propose_effects(tmp_path) == []


def test_an_effect_takes_the_place_of_its_special_case():
    assert _replaced("motor.coulomb_friction", "motor.presliding_friction")
    assert _replaced("motor.stribeck_friction", "motor.presliding_friction")
    assert not _replaced("load.coulomb_friction", "motor.presliding_friction")
    assert not _replaced("motor.constant_torque", "motor.presliding_friction")
