"""The comparison of the bench of real machines: one yardstick for all tools, and rivals that find what is there."""

import sys

import numpy as np
import pytest
from measured import COULOMB, INERTIA, VISCOUS, simulate_log
from real.derivatives import parts_of, terms_of, torque_error
from real.mujoco_sysid import sysid
from real.rivals import stepwise
from real_machines import _margin
from small_study import rigid_study

from jaxbl import read_config, read_record

CUTOFF = 30.0


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "log.csv"
    simulate_log(count=8000, noise=1e-5)[["t", "u", "theta_e"]].to_csv(path, index=False)
    return read_record(path)


def mass_study(inertia=INERTIA, effects=()):
    return read_config(rigid_study({"drive.motor_inertia": inertia, "drive.motor_viscous": VISCOUS}, effects=[*effects]))


FRICTION = {"kind": "motor.coulomb_friction", "torque": COULOMB}


def test_the_true_model_leaves_nothing_and_one_factor_on_all_changes_nothing(record):
    parts = parts_of(record, ("motor",), CUTOFF)
    left = torque_error(mass_study(effects=[FRICTION]), record, parts)
    without = torque_error(mass_study(), record, parts)
    assert np.std(left) < 0.1 * COULOMB < 0.9 * np.std(without)
    gain = {"kind": "actuator.gain_error", "relative": 0.6}
    # the same machine in units that are 1.6 times as small
    other = mass_study(1.6 * INERTIA, [gain, {"kind": "motor.viscous_friction", "viscous": 0.6 * VISCOUS}])
    np.testing.assert_allclose(torque_error(other, record, parts), without, rtol=1e-6, atol=1e-9)
    assert _margin(left, without) > 5.0 > -5.0 > _margin(without, left)


def test_the_regression_adds_dry_friction_to_the_nominal_terms_first(record):
    parts = parts_of(record, ("motor",), CUTOFF)
    motion = [part.kinematics for part in parts]
    spans = max(np.abs(k.velocity["motor"]).max() for k in motion), max(np.ptp(k.position["motor"]) for k in motion)
    terms = terms_of(parts, mass_study(), False, tuple(map(float, spans)))
    result = stepwise(terms, terms)
    assert result.names[:3] == ["inertia", "viscous", "Coulomb"]
    assert result.factors["Coulomb"][0] == pytest.approx(COULOMB, rel=0.05)
    assert result.factors["inertia"][0] == pytest.approx(INERTIA, rel=0.02)


def test_without_mujoco_its_column_says_so(record, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    parts = parts_of(record, ("motor",), CUTOFF)
    assert sysid(parts, parts, mass_study(), linear=False).note == "mujoco[sysid] is not installed"
