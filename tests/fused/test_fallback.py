"""What a JAX or an LLVM of another version makes unknown is scanned, and one line says so."""

import re
import sys

import jax
import numpy as np
import pytest
from small_study import ALPHA, listed_axis, rigid_study

import jaxbl
from jaxbl import fused
from jaxbl.config import prepare
from jaxbl.fused import jaxprs, llvm, single_plant

NAME = "motor.velocity_rmse"


def rename_parameters(monkeypatch):
    def parameter(eqn, *names):
        return parameters(eqn, *(f"new_{name}" for name in names))

    parameters = jaxprs.equation_parameter
    monkeypatch.setattr(jaxprs, "equation_parameter", parameter)


def refuse_assembly(monkeypatch):
    def parse_assembly(text):
        raise RuntimeError("LLVM IR parsing error\n<string>:3:26: error: expected type")

    monkeypatch.setattr(llvm.binding, "parse_assembly", parse_assembly)


def hide_modules(monkeypatch):
    for name in ("lane_simulator", "single_run", "llvm"):
        monkeypatch.setitem(sys.modules, f"jaxbl.fused.{name}", None)


UNKNOWN = {
    rename_parameters: r"compilation with JAX [\d.]+ \(UnknownForm: \w+ without new_\w+( or new_call_jaxpr)?\)",
    refuse_assembly: r"compilation with JAX [\d.]+ \(RuntimeError: LLVM IR parsing error\)",
    hide_modules: r"compilation with JAX [\d.]+ \(ModuleNotFoundError: import of jaxbl\.fused\.\w+ halted.*\)",
}


def parametrize_changes(*changes):
    """Some of the changes, where a module may be imported in another place; a plant meets all three."""
    return pytest.mark.parametrize("refuse_feature", changes, ids=lambda change: change.__name__, indirect=True)


@pytest.fixture(params=UNKNOWN, ids=lambda change: change.__name__)
def refuse_feature(request, monkeypatch):
    """Return a function that makes the feature fail, and returns the pattern of the reason that is then given."""
    fused.warn_of_scan.cache_clear()
    single_plant._trajectory_loop.cache_clear()
    yield lambda: request.param(monkeypatch) or UNKNOWN[request.param]
    # loops that could not be had are not kept
    single_plant._trajectory_loop.cache_clear()


STUDY = rigid_study({"run.substeps": 2})
SWEEP_STUDY = rigid_study(
    {"run.substeps": 2}, axes=[listed_axis(ALPHA, 5.0, 9.0, 20.0)], sweep={"metrics": ["velocity_rmse"]}
)


@pytest.fixture(scope="module")
def scanned_sweep():
    return jaxbl.sweep(SWEEP_STUDY, backend="scan").frame


@pytest.fixture(scope="module")
def looped_run():
    return jaxbl.run(STUDY, every=7)


@parametrize_changes(rename_parameters, hide_modules)
def test_a_sweep_is_scanned(scanned_sweep, refuse_feature, caplog):
    pattern = refuse_feature()
    result = jaxbl.sweep(SWEEP_STUDY)
    (reason,) = result.fallback_reasons
    np.testing.assert_array_equal(result.frame[NAME], scanned_sweep[NAME])
    assert re.fullmatch(pattern, reason)
    with pytest.raises(
        jaxbl.InputError, match=f"^--backend fused: the fused loop does not support {pattern}; use --backend scan"
    ):
        jaxbl.sweep(SWEEP_STUDY, backend="fused")
    assert not caplog.messages


@parametrize_changes(refuse_assembly, hide_modules)
def test_a_run_is_scanned(looped_run, refuse_feature, caplog):
    pattern = refuse_feature()
    trials = [jaxbl.run(STUDY, every=7) for _ in range(2)]
    for trial in trials:
        assert trial.summary["metrics"][NAME] == pytest.approx(looped_run.summary["metrics"][NAME], rel=1e-6)
        np.testing.assert_allclose(trial.trace["theta_e"], looped_run.trace["theta_e"], rtol=1e-6, atol=1e-9)
    (line,) = caplog.messages
    assert re.fullmatch(fused.SCAN_MESSAGE % pattern, line)


def test_a_plant_is_scanned(refuse_feature, caplog):
    with jax.enable_x64(True):
        experiment = prepare(jaxbl.read_config(STUDY))
        start, torque = experiment.plant.init(experiment.initial), np.ones(50)
        expected, pattern = single_plant.simulate_plant(experiment, start, torque), refuse_feature()
        single_plant._trajectory_loop.cache_clear()
        plants = [single_plant.simulate_plant(experiment, start, torque) for _ in range(2)]
    for path in plants:
        np.testing.assert_allclose(path.position["motor"], expected.position["motor"], rtol=1e-9, atol=1e-12)
    (line,) = caplog.messages
    assert re.fullmatch(fused.SCAN_MESSAGE % pattern, line)
