"""Certificates in a drive's units: what is proven and asked for, what is refused, and those of tuned gains."""

import dataclasses
import functools
import json
import math
import re

import jax
import numpy as np
import pytest
from differentiation_bound import least_worst_error
from small_study import rigid_study

import jaxbl
from jaxbl.config import read_config
from jaxbl.errors import InputError, NoResult
from jaxbl.gains import adversary, certificate
from jaxbl.gains.certificate import certify
from jaxbl.gains.tune import tune
from jaxbl.report.results import write_report
from jaxbl.report.tune import certificate_lines, certificate_tables

GAINS = 2.2, 9.2
BOUNDS = {"noise": 5e-5, "f_plus": 5.0, "period": 1e-3, "velocity_error": 0.1, "runs": 1}


@pytest.fixture(autouse=True, scope="module")
def _proofs_once(compiled_once):
    """Searches of this file prove and explore the same gains again and again. A thousand runs show what is said of them."""
    results = {}

    def explore_once(system):
        key = system, jax.config.jax_enable_x64
        if key not in results:
            results[key] = explore_errors(system)
        return results[key]

    explore_errors = adversary.explore_errors
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(certificate, "prove", functools.cache(certificate.prove))
        patch.setattr(adversary, "explore_errors", explore_once)
        patch.setattr(adversary, "_LANES", 1 << 10)
        yield


@pytest.fixture(scope="module")
def certified_gains():
    return certify(*GAINS, **BOUNDS)


def test_bounds_lie_between_what_is_found_and_little_more(certified_gains):
    worst = certified_gains["search"]["worst"]
    assert certified_gains["certified"] and certified_gains["why_none"] is None
    assert (
        worst < certified_gains["final_accuracy"] < certified_gains["accuracy"] <= 1.0501 * certified_gains["final_accuracy"]
    )
    assert certified_gains["search"]["ratio"] == pytest.approx(certified_gains["final_accuracy"] / worst)
    assert certified_gains["search"]["ratio"] < 1.1
    assert certified_gains["search"]["reaching_time"] <= certified_gains["reaching_time"]
    assert certified_gains["final_accuracy"] > least_worst_error(5e-5, 5.0, 1e-3)
    assert certified_gains["assumptions"] == {"discretisation": "implicit", "position_error": 5e-5} | {
        name: BOUNDS[name] for name in ("noise", "f_plus", "period", "velocity_error")
    }


@pytest.mark.parametrize("discretisation", ["implicit", "explicit"])
def test_other_units_of_time_and_angle_change_nothing(discretisation):
    second, rad = 4.0, 0.25
    arguments = {"discretisation": discretisation, "acceleration": 2.0}
    first = certify(*GAINS, **BOUNDS | arguments)
    lambda_, alpha = GAINS[0] * math.sqrt(rad) / second, GAINS[1] * rad / second**2
    bounds = {
        "noise": 5e-5 * rad, "f_plus": 5.0 * rad / second**2, "period": 1e-3 * second, "velocity_error": 0.1 * rad / second,
        "acceleration": 2.0 * rad / second**2, "runs": 1,
    }  # fmt: skip
    other = certify(lambda_, alpha, **bounds, discretisation=discretisation)
    assert other["reaching_time"] == pytest.approx(first["reaching_time"] * second)
    for name in ("accuracy", "final_accuracy", "resolution"):
        assert other[name] == pytest.approx(first[name] * rad / second)
    assert ("acceleration" in first["assumptions"]) == (discretisation == "explicit")


def test_worse_assumptions_prove_less(certified_gains):
    for name, value in (("noise", 1e-4), ("f_plus", 6.0)):
        assert certify(*GAINS, **BOUNDS | {name: value})["final_accuracy"] > 1.05 * certified_gains["final_accuracy"]
    slower = certify(*GAINS, **BOUNDS | {"velocity_error": 0.3})
    assert slower["reaching_time"] > 1.5 * certified_gains["reaching_time"]
    assert slower["final_accuracy"] == pytest.approx(certified_gains["final_accuracy"], rel=0.02)


def test_limits_are_met_or_not(certified_gains):
    final, time = certified_gains["final_accuracy"], certified_gains["reaching_time"]
    loose = certify(*GAINS, **BOUNDS, accuracy=1.5 * final, reaching_time=time)
    assert loose["accuracy"] == 1.5 * final
    # a wider bound holds earlier
    assert loose["reaching_time"] < time
    assert loose["limits"] == {
        "accuracy": {"asked": 1.5 * final, "met": True},
        "reaching_time": {"asked": time, "met": True},
    }
    strict = certify(*GAINS, **BOUNDS, accuracy=0.9 * final, reaching_time=0.5 * time)
    assert strict["accuracy"] == pytest.approx(certified_gains["accuracy"])
    assert not any(limit["met"] for limit in strict["limits"].values())


@pytest.mark.parametrize(("f_plus", "period"), [(14.08, 1e-4), (2.6, 5e-4)])
def test_the_final_accuracy_itself_can_be_asked_for(f_plus, period):
    """In units of f⁺ T it may come out below the last bound by rounding; no bound is then as small."""
    gains = 2.5 * math.sqrt(f_plus), 3.0 * f_plus
    bounds = {"noise": 0.5 * f_plus * period**2, "f_plus": f_plus, "period": period, "velocity_error": 2.0 * f_plus * period}
    free = certify(*gains, **bounds, runs=1)
    second = certify(*gains, **bounds, runs=1, accuracy=free["final_accuracy"])
    assert second["accuracy"] == free["final_accuracy"]
    assert second["limits"]["accuracy"]["met"]
    assert second["reaching_time"] >= free["reaching_time"] > 0.0
    curve = free["curve"]
    assert np.interp(second["reaching_time"], curve["time"], curve["bound"]) == second["accuracy"]


@pytest.mark.parametrize("change", [1.0, 1.00004, 0.99996])
def test_what_is_printed_is_proven(certified_gains, change):
    """Bounds are rounded up, and what they assume is rounded down."""
    scaled = ("accuracy", "final_accuracy", "reaching_time")
    certificate_data = certified_gains | {name: change * certified_gains[name] for name in scaled}
    arguments = {
        name: change * certified_gains["assumptions"][name]
        for name in ("noise", "f_plus", "velocity_error", "position_error")
    }
    certificate_data["assumptions"] = certified_gains["assumptions"] | arguments
    summary = {"certificates": {"motor": certificate_data}, "passed_over": {"motor": 0}}
    line = next(certificate_lines(summary))
    accuracy, time, final, end, noise, f_plus, period, velocity, position = map(
        float, re.findall(r"[\d.]+(?:e-\d+)?(?= |\.$)", line)
    )
    assert period == certified_gains["assumptions"]["period"]
    for value, printed in (
        (certificate_data["accuracy"], accuracy),
        (certificate_data["reaching_time"], time),
        (certificate_data["final_accuracy"], final),
        (certificate_data["curve"]["time"][-1], end),
    ):
        assert value * (1.0 - 1e-12) <= printed <= 1.001 * value
    printed_bounds = {"noise": noise, "f_plus": f_plus, "velocity_error": velocity, "position_error": position}
    for name, printed in printed_bounds.items():
        assert arguments[name] * (1.0 + 1e-12) >= printed >= 0.999 * arguments[name]
    (table,) = certificate_tables(summary)
    assert table.heading == "What the certificates assume"


@pytest.mark.parametrize(
    ("gains", "message"), [((2.2, 4.9), "does not exceed f⁺ = 5 rad/s²"), ((0.9, 9.2), "the exact condition fails")]
)
def test_gains_of_which_nothing_can_be_proven(gains, message):
    with pytest.raises(NoResult, match=message):
        certify(*gains, **BOUNDS)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"noise": -1e-5}, "noise: a certificate needs a finite number >= 0, not -1e-05"),
        ({"velocity_error": math.nan}, "velocity_error: .* not nan"),
        ({"position_error": math.inf}, "position_error: .* not inf"),
        ({"f_plus": 0.0}, "f_plus: a certificate needs a finite number > 0, not 0.0"),
        ({"period": 0.0}, "period: .* > 0"),
        ({"accuracy": math.nan}, "accuracy: a certificate needs a finite number > 0, not nan"),
        ({"discretisation": "exact"}, "discretisation: 'exact' is unknown; it should be one of implicit, explicit"),
    ],
)
def test_bad_numbers_are_told(changes, message):
    with pytest.raises(InputError, match=message):
        certify(*GAINS, **BOUNDS | changes)


def test_a_bound_that_runs_exceed_is_refused(monkeypatch):
    prove = certificate.prove

    def prove_too_little(*arguments):
        proof = prove(*arguments)
        return proof._replace(bounds=0.9 * proof.bounds)

    monkeypatch.setattr(certificate, "prove", prove_too_little)
    certificate_data = certify(*GAINS, **BOUNDS)
    assert not certificate_data["certified"]
    assert certificate_data["search"]["violations"] > 0
    assert certificate_data["why_none"].startswith("refused: ")


def test_single_precision_of_the_caller_does_not_matter(certified_gains):
    with jax.enable_x64(False):
        assert certify(*GAINS, **BOUNDS) == certified_gains


TABLE = {"num": 3, "refine": 0, "alpha_ratio": {"start": 1.2, "stop": 10.0}, "lambda_ratio": {"start": 0.8, "stop": 6.0}}


def study(**certificate_table):
    changes = {"observer.motor.velocity_error": 0.1, "run.velocity_tolerance": 0.05, "run.position_tolerance": 0.01,
               "encoders.noise": 1e-5, "encoders.motor_resolution": 2e-5, "run.duration": 0.2}  # fmt: skip
    torque = [{"kind": "motor.constant_torque", "torque": 0.05}]
    return rigid_study(changes, effects=torque, tune=TABLE | {"certificate": {"runs": 1, "motor": certificate_table}})


@pytest.fixture(scope="module")
def tuned_study():
    return tune(study())


def test_tuned_gains_are_certified_with_the_studys_own_bounds(tmp_path, tuned_study):
    tuned = tuned_study
    certificate_data, gains = tuned.summary["certificates"]["motor"], tuned.summary["gains"]["motor"]
    assert certificate_data["gains"] == {name: gains[name] for name in ("lambda", "alpha")}
    arguments = certificate_data["assumptions"]
    assert arguments["noise"] == pytest.approx(1e-5 + 5.0 * 1e-5)
    assert arguments["f_plus"] == max(tuned.summary["f_plus"]["motor"], tuned.summary["achieved"]["motor"]["f_plus"])
    assert (arguments["velocity_error"], arguments["position_error"], arguments["period"]) == (0.1, arguments["noise"], 1e-3)
    assert certificate_data == certify(gains["lambda"], gains["alpha"], **arguments, runs=1)
    lines = write_report(tuned, tmp_path).remarks
    assert any(line.startswith("motor, promised: a velocity error of at most ") for line in lines)
    assert any("not more than the" in line for line in lines)
    stored = json.loads((tmp_path / "certificate.json").read_text())
    assert stored["sides"] == {"motor": certificate_data}
    # the runs that were certified stay below
    data = study() | {"observer": {"motor": certificate_data["gains"] | {"velocity_error": 0.1}}}
    data["run"]["duration"] = certificate_data["reaching_time"] + 0.5
    run = jaxbl.run(data).trace
    after_reaching = run["t"] >= certificate_data["reaching_time"]
    error = np.abs(run["motor.velocity_estimate"] - run["motor.velocity"])
    assert 0.0 < error[after_reaching].max() <= certificate_data["accuracy"]


def test_a_finished_certificate_is_read_again(tmp_path, tuned_study, monkeypatch):
    tune(study(), tmp_path)
    monkeypatch.setattr(certificate, "certify", None)
    assert tune(study(), tmp_path).summary["certificates"] == tuned_study.summary["certificates"]
    file = tmp_path / "tune" / "certificate.json"
    file.write_text(file.read_text()[:-20])
    monkeypatch.undo()
    assert tune(study(), tmp_path).summary["certificates"] == tuned_study.summary["certificates"]


def test_gains_are_chosen_that_keep_the_limits(tuned_study):
    limit = 0.9 * tuned_study.summary["certificates"]["motor"]["final_accuracy"]
    limited = tune(study(accuracy=limit))
    certificate_data = limited.summary["certificates"]["motor"]
    assert certificate_data["final_accuracy"] <= limit == certificate_data["accuracy"]
    assert limited.summary["passed_over"]["motor"] > 0
    # the best of those that do
    better_candidates = limited.candidates["motor"].query("converged and margin_exact >= 1.1 and margin_alpha >= 1.1")
    better_candidates = better_candidates[better_candidates["error"] < limited.summary["achieved"]["motor"]["velocity_rmse"]]
    assert len(better_candidates) == limited.summary["passed_over"]["motor"]
    for row in better_candidates.to_dict("records"):
        f_plus = max(limited.summary["f_plus"]["motor"], row["f_plus"])
        bounds = certificate_data["assumptions"] | {"f_plus": f_plus, "runs": 1}
        assert certify(row["lambda"], row["alpha"], **bounds)["final_accuracy"] > limit
    lines = [*certificate_lines(limited.summary)]
    assert any(
        f"the gains keep what was asked for; {len(better_candidates)} gains with less error" in line for line in lines
    )


def test_limits_that_no_gains_keep_are_said_to_be_missed(tuned_study):
    tuned = tune(study(accuracy=1e-6))
    assert tuned.summary["gains"] == tuned_study.summary["gains"]
    assert tuned.summary["passed_over"] == {"motor": 0}
    lines = [*certificate_lines(tuned.summary)]
    assert "motor, certificate: what was asked for is not proven: accuracy 1e-06 rad/s." in lines


def test_without_a_proof_there_is_no_file(tmp_path, tuned_study):
    tuned = tune(study(f_plus=1e4))
    write_report(tuned_study, tmp_path)
    assert (tmp_path / "certificate.json").exists()
    lines = write_report(tuned, tmp_path).remarks
    assert any(line.startswith("motor: no certificate: alpha = ") for line in lines)
    assert not (tmp_path / "certificate.json").exists()


def test_what_is_refuted_is_said_first(tmp_path, tuned_study):
    certificate_data = tuned_study.summary["certificates"]["motor"]
    certificate_data = certificate_data | {
        "certified": False,
        "why_none": "refused: 3 of 9",
        "search": certificate_data["search"] | {"violations": 3},
    }
    tuned = dataclasses.replace(tuned_study, summary=tuned_study.summary | {"certificates": {"motor": certificate_data}})
    result = write_report(tuned, tmp_path)
    assert (result.verdict, result.headline) == ("failed", "The search found an error above what was proven.")
    assert result.remarks[0] == "motor: no certificate: refused: 3 of 9."
    assert not (tmp_path / "certificate.json").exists()


def test_a_rigid_drive_has_no_certificate_of_a_load():
    data = study()
    data["tune"]["certificate"]["load"] = {}
    with pytest.raises(InputError, match=r"tune\.certificate\.load has no meaning on a rigid drive; remove it"):
        read_config(data)
