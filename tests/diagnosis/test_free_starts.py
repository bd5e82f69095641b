"""The best initial states of windows, and what they leave, are those of the fit's own search."""

import dataclasses

import jax
import numpy as np
import pytest
from hidden_log import record_study
from small_study import multisine_study

from jaxbl.chain import with_effects
from jaxbl.config import prepare, read_config
from jaxbl.diagnosis.free_starts import best_runs, count_seen
from jaxbl.diagnosis.neutral_effects import with_torques
from jaxbl.drive import make_effect
from jaxbl.drive.parameters import as_arrays, set_leaves
from jaxbl.estimation.segments import segments_of, windows_of
from jaxbl.estimation.trajectory import eliminate_starts

STUDY = multisine_study(
    2.0,
    transmission={"law": "dead_zone", "stiffness": 60.0, "half_gap": 0.02},
    effects=[{"kind": "load.coulomb_friction", "torque": 2.0}, {"kind": "actuator.delay", "delay": 2e-3}],
)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    record = record_study(STUDY, tmp_path_factory.mktemp("log"))
    model = as_arrays(prepare(read_config(STUDY)), float)
    return with_torques(set_leaves(model, {"drive.load_inertia": model.drive.load_inertia * 1.1})), record


@pytest.mark.parametrize("from_rest", [False, True])
def test_runs_are_those_of_the_fit(log, from_rest):
    (model, _), record = log
    windows = windows_of(segments_of(record, model.sides), model, 250, from_rest)
    actual, seen = best_runs(model, windows, 8, from_rest, np.arange(8)), count_seen(250)
    first = dataclasses.replace(
        windows,
        torque=windows.torque[:, :seen],
        measured={side: readings[:, :seen] for side, readings in windows.measured.items()},
        finer=windows.finer[:, :seen],
    )
    expected = eliminate_starts(model, first, 8, from_rest)
    assert actual.residual.shape == (8, 250, 2) and seen == 50
    assert np.sqrt(np.mean(np.square(expected.residual))) > 1.05
    assert actual.residual[:, :seen] == pytest.approx(np.asarray(expected.residual), rel=1e-5, abs=1e-5)
    for actual_start, expected_start in zip(jax.tree.leaves(actual.states), jax.tree.leaves(expected.start), strict=True):
        assert actual_start[:, 0] == pytest.approx(np.asarray(expected_start), rel=1e-4, abs=1e-6)


def test_noise_of_the_state_that_is_fitted_is_foretold(tmp_path):
    """Scatter of errors beyond the first fifth, over logs that differ in their noise alone; two inertias and a shaft."""
    study = multisine_study(1.0, transmission={"law": "linear_shaft", "stiffness": 60.0})
    model, _ = with_torques(as_arrays(prepare(read_config(study)), float))
    segments = segments_of(record_study(study, tmp_path), model.sides)
    windows = windows_of(segments, model, 250)
    random, runs, every_window = np.random.default_rng(2), [], np.arange(len(windows.time))
    for _ in range(20):
        measured = {
            side: np.asarray(readings) + float(windows.noise[side]) * random.standard_normal(readings.shape)
            for side, readings in windows.measured.items()
        }
        runs.append(best_runs(model, dataclasses.replace(windows, measured=measured), 8, False, every_window))
    foretold = np.stack([run.residual[:, count_seen(250) :] for run in runs])
    scatter = np.sqrt(np.mean(np.var(foretold, axis=0, ddof=1), axis=(0, 1)))
    np.testing.assert_allclose(scatter, np.hypot(1.0, runs[0].noise), rtol=0.1)
    assert (runs[0].noise > 0.3).all()


@pytest.mark.parametrize("from_rest", [False, True])
def test_a_state_that_follows_from_the_motion_is_free_only_where_a_log_begins(log, from_rest):
    (model, _), record = log
    swinging = make_effect("load.flexibility", inertia=0.5, frequency=3.0)
    model = with_effects(model, (*model.effects, as_arrays(swinging, float)))
    windows = windows_of(segments_of(record, model.sides, from_rest), model, 250, from_rest)
    runs = best_runs(model, windows, 4, from_rest, np.arange(len(windows.time)))
    for have, start in zip(runs.states.effects[-1], windows.start.effects[-1], strict=True):
        moved = np.asarray(have)[:, 0] != np.asarray(start)
        assert not moved[1:].any() and moved[0] == (not from_rest)
