"""The single run: its trace reads as a measured log, and its summary says what the paper leaves out and where it misses."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from small_study import listed_axis, rigid_study, small_study

from jaxbl.config import read_config, with_values
from jaxbl.errors import InputError
from jaxbl.fused import Unsupported
from jaxbl.sweeps.trial import run

SWEEPS = Path(__file__).parents[2] / "sweeps"
SIDE = (
    "position",
    "velocity",
    "acceleration",
    "position_estimate",
    "velocity_estimate",
    "equivalent_control",
    "torque_estimate",
)


@pytest.fixture(scope="module")
def table1():
    """The paper's Table 1, seven of its twenty seconds."""
    return run(with_values(read_config(SWEEPS / "paper_table1.toml"), {"run.duration": 7.0}), every=10)


def test_trace_has_a_log_first_then_truth_estimates_and_identified_numbers(table1):
    trace = table1.trace
    identified = ("stiffness", "dead_zone", "half_gap")
    sides = [f"{side}.{name}" for side in ("motor", "load") for name in SIDE]
    sides += [f"{side}.{name}" for side in ("motor", "load") for name in identified]
    assert list(trace.columns) == ["t", "u", "theta_e", "theta_s", "z", "torque", *sides]
    np.testing.assert_allclose(trace["t"], np.arange(7000) * 1e-3, atol=1e-12)
    np.testing.assert_allclose(trace["u"], 0.08 * np.sin(2 * np.pi * 0.16 * trace["t"]), atol=1e-12)
    # without noise the log is the truth
    np.testing.assert_array_equal(trace["theta_e"], trace["motor.position"])
    np.testing.assert_allclose(trace["z"], trace["theta_e"] - 5.0 * trace["theta_s"], atol=1e-12)
    law = trace["z"] - 0.08 * np.tanh(10.0 * trace["z"])
    np.testing.assert_allclose(trace["torque"], law, atol=1e-12)


def test_summary_of_table_1_names_what_it_misses(table1):
    summary = table1.summary
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    assert {"title", "seed", "metrics", "identified", "conditions", "remarks"} <= set(summary)
    remarks = summary["remarks"]
    assert any("gives neither the amplitude and frequency of the input, nor j_0" in line for line in remarks)
    unmet = [
        line
        for line in remarks
        if line.startswith("motor: lambda = 0.005 is too small at") and "Davila-Fridman (32)" in line
    ]
    # sqrt(2 alpha) / lambda = 380 at the least, however small f_plus
    assert float(unmet[0].split("factor of ")[1].split(";")[0].rstrip(".")) > 379
    assert any("torques |C| up to 0.09 N m" in line and line.startswith("motor: alpha = 1.8") for line in remarks)
    for side, gains in (("motor", (0.005, 1.8)), ("load", (0.004, 0.08))):
        conditions = summary["conditions"][side]
        assert (conditions["lambda"], conditions["alpha"]) == gains
        assert not conditions["holds"]["davila_fridman"]
        assert (
            conditions["least_lambda"]["davila_fridman"] is None
            or conditions["least_lambda"]["davila_fridman"] > 50 * gains[0]
        )


@pytest.mark.parametrize("law", ["sigmoid_backlash", "dead_zone", "linear_shaft"])
def test_every_dead_zone_comes_with_its_half_gap(law):
    laws = {
        "sigmoid_backlash": ({"stiffness": 1.0, "dead_zone": 0.02, "slope": 20.0}, {"stiffness", "dead_zone", "half_gap"}),
        "dead_zone": ({"stiffness": 1.0, "half_gap": 0.08}, {"stiffness", "half_gap"}),
        "linear_shaft": ({"stiffness": 1.0}, {"stiffness"}),
    }
    numbers, names = laws[law]
    trial = run(small_study(transmission={"law": law, **numbers}))
    assert set(trial.summary["identified"]) == names
    for name, result in trial.summary["identified"].items():
        assert result["true"] == numbers.get(name, 0.08)
        for side in ("motor", "load"):
            last = trial.trace[f"{side}.{name}"].iloc[-1]
            assert result[side] == (None if np.isnan(last) else last)


def test_rigid_run():
    trial = run(rigid_study(effects=[{"kind": "motor.constant_torque", "torque": 0.05}]))
    assert list(trial.trace.columns) == ["t", "u", "theta_e", "torque", *(f"motor.{name}" for name in SIDE)]
    np.testing.assert_allclose(trial.trace["torque"], 0.05, atol=2e-3)
    assert trial.summary["identified"] == {}
    assert list(trial.summary["conditions"]) == ["motor"]


def test_decimated_trace_is_a_part_of_the_whole_with_the_same_metrics():
    full_trial, part = run(rigid_study({"run.duration": 0.203})), run(rigid_study({"run.duration": 0.203}), every=7)
    assert len(part.trace) == 29
    pd.testing.assert_frame_equal(part.trace, full_trial.trace[::7].reset_index(drop=True), rtol=1e-9)
    assert part.summary["metrics"].keys() == full_trial.summary["metrics"].keys()
    with pytest.raises(InputError, match="every: should be between 1 and the number of samples 203, not 204"):
        run(rigid_study({"run.duration": 0.203}), every=204)


def test_seed_and_precision():
    first, second = (run(rigid_study(), seed=seed).trace["theta_e"] for seed in (0, 1))
    assert 0.5e-4 < (first - second).std() < 2.5e-4
    # the same noise in both precisions
    single = run(rigid_study({"run.precision": "float32"})).trace["theta_e"]
    np.testing.assert_allclose(single, first, atol=1e-6)


def test_a_diverged_run_says_so():
    trial = run(rigid_study(effects=[{"kind": "motor.viscous_friction", "viscous": 1e4}]))
    assert trial.summary["metrics"]["finite"] is False
    assert trial.summary["metrics"]["motor.velocity_rmse"] is None
    assert trial.summary["remarks"][-1].startswith("The run diverged")


def test_axes_are_not_used():
    config = read_config(rigid_study(axes=[listed_axis("observer.motor.alpha", 1.0, 2.0)]))
    assert run(config).summary["conditions"]["motor"]["alpha"] == 9.0


def test_decimation_thins_the_trace_and_nothing_else():
    study = small_study({"run.duration": 2.0})
    full, thin = (run(study, every=number) for number in (1, 1999))
    assert len(thin.trace) < 5
    assert thin.summary["remarks"] == full.summary["remarks"]
    for name, result in full.summary["identified"].items():
        assert thin.summary["identified"][name] == pytest.approx(result, rel=1e-9)


def test_backends(monkeypatch):
    """Both give the same; one that is asked for is not replaced."""
    study = rigid_study({"run.duration": 0.1})
    trials = [run(study, backend=backend) for backend in ("fused", "scan")]
    pd.testing.assert_frame_equal(trials[0].trace, trials[1].trace, rtol=1e-9)

    def raise_unsupported(*_):
        raise Unsupported("a step of its own")

    monkeypatch.setattr("jaxbl.fused.single_run.record_run", raise_unsupported)
    with pytest.raises(
        InputError, match=r"backend: the fused loop does not support a step of its own; use 'scan', or leave it out"
    ):
        run(study, backend="fused")
    pd.testing.assert_frame_equal(run(study).trace, trials[1].trace)
