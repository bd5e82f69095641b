"""Tables of a torque without a name: they show a torque that is there, and nothing where nothing is."""

import jax
import numpy as np
import pytest
from hidden_log import nominal_study, simulate_direct_drive, simulate_study
from small_study import rigid_study
from trace_segment import make_segment

from jaxbl.config import prepare, read_config
from jaxbl.diagnosis.diagnosis_summary import extended_study
from jaxbl.diagnosis.diagnosis_task import read_diagnosis_task
from jaxbl.diagnosis.reference_log import ReferenceLog
from jaxbl.diagnosis.residuals import residual_torques
from jaxbl.diagnosis.setup import set_up
from jaxbl.diagnosis.torque_tables import _fit_tables, tabulate

SETTINGS = {"run.duration": 8.0, "run.substeps": 5}
OBSERVER = {"motor": {"lambda": 20.0, "alpha": 400.0}}
WAVE = {"kind": "motor.cogging", "amplitude": 0.05, "harmonic": 3.0, "phase": 0.4}
DRAG = {"kind": "motor.quadratic_drag", "drag": 0.004}


def study(*effects):
    excitation = {"kind": "multisine", "amplitude": 1.0, "frequency": 0.5}
    return rigid_study(SETTINGS, excitation=excitation, observer=OBSERVER, effects=list(effects))


def find_tables(*effects):
    """Return the tables of what a model without these effects lacks on a run with them."""
    segment = make_segment(simulate_study(study(*effects)))
    experiment = prepare(read_config(study()))
    lacking = residual_torques(experiment, [segment])["motor"]
    log = ReferenceLog([segment], {"motor": 20.0})
    return {table.over: table for table in _fit_tables(log, lacking, "motor", rotary=True)}


def test_a_torque_over_position_is_found_with_its_error():
    found_tables = find_tables(WAVE)
    assert set(found_tables) in ({"position"}, {"turn"})
    (table,) = found_tables.values()
    truth = 0.05 * np.sin(3.0 * table.points + 0.4)
    # points at the ends of the travel are hardly visited
    inner = slice(2, -2)
    np.testing.assert_allclose(table.torques[inner], truth[inner], atol=0.012)
    assert np.median(table.errors[inner]) < 0.006


def test_a_torque_over_speed_is_found():
    found_tables = find_tables(DRAG)
    assert set(found_tables) == {"speed"}
    table = found_tables["speed"]
    np.testing.assert_allclose(table.torques[1:-1], (0.004 * table.points * np.abs(table.points))[1:-1], atol=0.01)


def test_nothing_is_tabulated_where_nothing_is_missing():
    assert find_tables() == {}


def test_a_model_with_tables_predicts_better_and_runs_as_a_study(tmp_path):
    """The torque is that of the bench's own simulator, which shares nothing with the package."""
    t = 2e-3 * np.arange(2000)
    torque = 0.3 * sum(np.sin(2.0 * np.pi * 0.5 * k * t + k**2) for k in range(1, 7))
    simulate_direct_drive(torque, [WAVE], 3e-5, 1).write(tmp_path / "axis.csv")
    task = read_diagnosis_task(tmp_path / "axis.csv", nominal_study())
    with jax.enable_x64(True):
        setup = set_up(task)
        compared = setup.fitted.compare(setup.nominal)
        tabulation = tabulate(setup.fitted, setup.nominal, compared, setup.lacking, setup.sliding)
    assert tabulation is not None and tabulation.z > 2.0
    for name in ("theta_e", "torque_motor"):
        assert tabulation.compared.errors[name] < 0.6 * compared.errors[name]
    longer = extended_study(task, {}, {}, tabulation.effects())
    (effect,) = longer.effects
    assert effect.kind == "motor.tabulated" and len(effect.positions) == len(effect.position_torques)
    assert read_config(longer.to_dict()).build().effects[0].positions == pytest.approx(effect.positions)
