"""Effects that the missing torque shows by itself, and how two models are compared block by block."""

import jax
import numpy as np
import pytest
from hidden_log import FRICTION, logged, model

from jaxbl.diagnosis.diagnose import new_search
from jaxbl.diagnosis.diagnosis_task import read_diagnosis_task
from jaxbl.diagnosis.proof import _standard_errors
from jaxbl.diagnosis.setup import set_up
from jaxbl.diagnosis.torque_regression import _proposals, _replaced


def proposals(folder, *effects):
    logged(effects).write(folder / "axis.csv")
    task = read_diagnosis_task(folder / "axis.csv", model())
    with jax.enable_x64(True):
        setup = set_up(task)
        search = new_search(setup)
        theta = np.zeros(len(setup.own))
        nominal = search.refit({}, theta, search.linear({}, theta).choose(()))
        return _proposals(search, nominal, setup.lacking, setup.fitted)


def test_the_effect_that_takes_most_of_the_missing_torque_is_proposed_with_its_number(tmp_path):
    first, *others = proposals(tmp_path, "friction")
    names = [first.name, *(one.name for one in others)]
    # friction that falls with speed, or bends, contains it
    assert "motor.coulomb_friction" in names[:3] and first.gain > 0.7
    coulomb = next(one for one in (first, *others) if one.name == "motor.coulomb_friction")
    assert coulomb.numbers["torque"] == pytest.approx(FRICTION["torque"], rel=0.1)
    assert all(one.gain > 0.03 for one in others)


def test_nothing_is_proposed_where_nothing_is_missing(tmp_path):
    assert proposals(tmp_path) == []


def test_an_effect_takes_the_place_of_its_special_case():
    assert _replaced("motor.coulomb_friction", "motor.presliding_friction")
    assert _replaced("motor.stribeck_friction", "motor.presliding_friction")
    assert not _replaced("load.coulomb_friction", "motor.presliding_friction")
    assert not _replaced("motor.constant_torque", "motor.presliding_friction")


def test_blocks_in_which_both_models_err_by_less_than_noise_count_for_nothing():
    """A drive that stands still for a while: one model leaves exactly nothing there, the other a tenth of the noise."""
    moving = np.linspace(20.0, 60.0, 13)
    control, better = np.append(moving, np.zeros(3)), np.append(0.25 * moving, np.full(3, 0.01))
    assert _standard_errors(control, better) > 5.0
    assert _standard_errors(better, control) < -5.0
    # few blocks have nearly all of the errors
    few = np.append(np.full(15, 4.0), 1e6)
    assert _standard_errors(few, few / 3.0) > 5.0
    assert _standard_errors(np.full(16, np.inf), moving[:1].repeat(16)) == np.inf
