"""What a model is compared with on held-out data, beside a simulation of the package."""

import jax
import numpy as np
import pytest
from hidden_log import record_study
from small_study import multisine_study

from jaxbl.chain import with_effects
from jaxbl.config import prepare, read_config
from jaxbl.diagnosis.reference_log import ReferenceLog
from jaxbl.drive import make_effect
from jaxbl.drive.parameters import as_arrays, set_leaves
from jaxbl.estimation.segments import segments_of

STUDY = multisine_study(
    3.0,
    transmission={"law": "linear_shaft", "stiffness": 60.0},
    effects=[{"kind": "load.coulomb_friction", "torque": 4.0}],
)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return record_study(STUDY, tmp_path_factory.mktemp("log"))


def test_smoothing_leaves_torque_where_friction_jumps_and_little_elsewhere(log):
    with jax.enable_x64(True):
        model = as_arrays(prepare(read_config(STUDY)), float)
        reference_log = ReferenceLog(segments_of(log, model.sides), {"motor": 25.0, "load": 25.0})
        dry = reference_log.rounding(model)
        smooth = reference_log.rounding(set_leaves(model, {"effects.load.coulomb_friction.torque": np.asarray(0.0)}))
        actual = reference_log.compare(model).errors
    assert dry.keys() >= {"torque_motor", "torque_load"}
    assert dry["torque_load"] > 3.0 * smooth["torque_load"]
    # it is in what the true model leaves
    assert dry["torque_load"] < 1.5 * actual["torque_load"]
    with jax.enable_x64(True):
        bending = as_arrays(make_effect("load.presliding_friction", torque=1.0, length=0.01), float)
        assert reference_log.rounding(with_effects(model, (bending,))) == {}


def test_each_part_of_a_log_is_compared_with_a_model_of_its_own(log):
    with jax.enable_x64(True):
        model = as_arrays(prepare(read_config(STUDY)), float)
        reference_log = ReferenceLog(segments_of(log, model.sides), {"motor": 25.0, "load": 25.0})
        path = "effects.load.coulomb_friction.torque"
        models = [set_leaves(model, {path: np.asarray(torque)}) for torque in (4.0, 2.0, 0.0)]
        parts = reference_log.compare(model, models=models)
        wholes = [reference_log.compare(one) for one in models]
    for name, errors in parts.samples.items():
        rows = np.arange(len(errors))
        block = 16 * rows // len(rows)
        expected = np.stack([one.samples[name] for one in wholes])[(block + block // 3) % 3, rows]
        np.testing.assert_allclose(errors, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())
        assert parts.errors[name] == pytest.approx(np.sqrt(np.mean(expected**2)))
    # the torques that are missing are those of the one
    np.testing.assert_array_equal(parts.torques["load"][0].torque, wholes[0].torques["load"][0].torque)
