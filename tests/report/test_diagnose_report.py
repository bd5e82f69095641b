"""What a diagnosis says: sentences and figures for every verdict."""

import copy
import dataclasses

import numpy as np
import pytest
from hidden.outcomes import FIRST_LINE
from panel_parts import names_of
from passed import PASSED

from jaxbl.diagnosis.residuals import Residual
from jaxbl.report.diagnose import _over_time, describe as describe_diagnosis
from jaxbl.report.drawing import save
from jaxbl.result import KeyFigure

ERRORS = {
    "theta_e": 0.1,
    "theta_s": 0.02,
    "velocity_motor": 1.0,
    "velocity_load": 0.2,
    "torque_motor": 0.5,
    "torque_load": 2.0,
}
UNITS = dict(zip(ERRORS, ["rad", "rad", "rad/s", "rad/s", "N m", "N m"], strict=True))


def scale_errors(factor):
    return {name: factor * value for name, value in ERRORS.items()}


SUMMARY = {
    "title": "",
    "file": "log.csv",
    "history": [],
    "verdict": "explained",
    "findings": [
        {
            "effect": "load.coulomb_friction",
            "confidence": 0.93,
            "likely": True,
            "share": 0.12,
            "z": 21.0,
            "parameters": {"torque": {"value": 0.274, "standard_error": 0.0021, "unit": "N m"}},
            "alternatives": [{"effect": "load.stribeck_friction", "confidence": 0.07}],
        }
    ],
    "where": {"motor": {"sentence": "motor side: nothing beyond noise"}, "load": {"sentence": "load side, here"}},
    "explained_share": 0.83,
    "contradictions": [],
    "parameters": {"drive.motor_inertia": {"value": 0.01, "nominal": 0.02, "standard_error": 1e-4, "unit": "kg m²"}},
    "warnings": [],
    "notes": ["A note."],
    "gap": {
        "holdout": {"file": "/logs/other.csv", "separate": True, "from": 0.0, "to": 5.0, "window": 0.5},
        "units": UNITS,
        "holdout_rmse_before": ERRORS,
        "holdout_rmse_after": scale_errors(0.011),
        "noise_floor": scale_errors(0.01),
        "expected": {
            name: {"noise": 0.01 * value, "open": 0.0, "least": 0.0, "limit": 0.012 * value}
            for name, value in ERRORS.items()
            if not name.startswith("velocity")
        },
        "test": PASSED,
    },
}


def test_logs_that_contradict_each_other_are_named_first():
    logs = [
        {"log": "slow.csv", "value": 2.3e-5, "standard_error": 5e-6},
        {"log": "fast.csv", "value": 1.68e-4, "standard_error": 5e-6},
    ]
    contradictions = [{"parameter": "drive.motor_inertia", "unit": "kg m²", "logs": logs}]
    result = describe_diagnosis(change_summary(contradictions=contradictions, warnings=["A warning."]))
    assert result.verdict == "no answer" and result.headline.startswith("The logs contradict each other")
    assert result.remarks[:2] == [
        "By the logs drive.motor_inertia is 2.3e-05 ± 5e-06 kg m² by slow.csv and 0.000168 ± 5e-06 kg m² by fast.csv. Was "
        "the load, the controller (a feedforward that u does not contain) or a unit another one?",
        "A warning.",
    ]


def change_summary(**keys):
    return copy.deepcopy(SUMMARY) | keys


def test_the_card_has_verdict_numbers_and_gap():
    result = describe_diagnosis(SUMMARY)
    assert (result.verdict, result.headline) == (
        "good",
        "The model lacks load.coulomb_friction; with it, it predicts new data as well as noise and the stated uncertainties "
        "allow.",
    )
    assert result.key_figures == [
        ("0.5 → 0.0055 N m", "motor: missing torque: rms error on held-out data (limit 0.006)"),
        ("0.1 → 0.0011 rad", "motor position: rms error on held-out data (limit 0.0012)"),
        ("0.274 ± 0.002 N m", "load.coulomb_friction: torque"),
        ("0.93", "confidence that it is load.coulomb_friction"),
    ]
    assert result.remarks == [
        "load.coulomb_friction (confidence 0.93): torque = 0.274 ± 0.002 N m; 12 % of the driving torque.",
        "Not ruled out by this log in place of load.coulomb_friction: load.stribeck_friction (0.07).",
    ]
    lines = result.details
    assert lines[0] == "On other.csv, the motion is predicted over windows of 0.5 s."
    table = next(table for table in result.tables if table.heading == "Held-out data, rms")
    assert table.rows[0] == ["motor position", "rad", 0.1, 0.0011, 0.001, 0.012 * 0.1]
    assert lines[-1] == "A note."


def test_other_verdicts_say_what_is_left():
    result = describe_diagnosis(change_summary(verdict="no_discrepancy", findings=[]))
    assert result.verdict == "good" and result.headline.startswith("Nothing is missing: ")
    result = describe_diagnosis(change_summary(verdict="unknown_effect", findings=[]))
    assert (result.verdict, result.headline) == (
        "no answer", "Something is missing that none of the known effects explains."
    )  # fmt: skip
    assert result.remarks == ["What is left: motor side: nothing beyond noise; load side, here."]


def test_numbers_that_are_further_off_come_first():
    """In the words that the bench asks for; what else is found stays."""
    off = SUMMARY | {"numbers_off": True}
    assert describe_diagnosis(off | {"findings": [], "verdict": "no_discrepancy"}).headline.startswith(FIRST_LINE)
    assert describe_diagnosis(off).headline.endswith(describe_diagnosis(SUMMARY).headline)
    inertia = {"value": 0.06, "standard_error": 0.001, "unit": "kg m²", "nominal": 0.03}
    viscous = inertia | {"unit": "N m s/rad", "nominal": 0.0}
    numbers = {
        "drive.motor_viscous": viscous,
        "drive.motor_inertia": inertia,
        "drive.load_inertia": inertia | {"nominal": 0.05},
    }
    result = describe_diagnosis(off | {"findings": [], "verdict": "no_discrepancy", "parameters": numbers})
    assert result.key_figures[-1] == ("0.0600 ± 0.0010 kg m²", "drive.motor_inertia, 0.03 in the model: furthest off")


def test_an_effect_that_may_as_well_be_something_unknown_is_there_perhaps():
    (sure,) = SUMMARY["findings"]
    unsure = sure | {"effect": "motor.cogging", "confidence": 0.01, "likely": False, "holdout_z": -2.24, "alternatives": []}
    tied = sure | {
        "effect": "load.gravity",
        "confidence": 0.5,
        "alternatives": [{"effect": "motor.cogging", "confidence": 0.5}],
    }
    result = describe_diagnosis(change_summary(findings=[unsure, sure | {"holdout_z": 9.42}, tied]))
    names = "The model lacks load.coulomb_friction, load.gravity and perhaps motor.cogging; with them,"
    assert result.headline.startswith(names)
    # the least certain of those that are likely stands at the head
    assert result.key_figures[-1] == KeyFigure("0.50", "confidence that it is load.gravity")
    said = {line.split(" ")[0]: line.partition("; held-out data ")[2] for line in result.remarks}
    assert said["load.coulomb_friction"] == "are predicted better with it, by 9.4 standard errors."
    assert said["motor.cogging"] == "are predicted worse with it, by 2.2 standard errors." and not said["load.gravity"]


def test_a_part_that_is_explained_is_said_with_its_share_and_the_reason():
    def describe_part(share=0.83, **test):
        gap = SUMMARY["gap"] | {"test": SUMMARY["gap"]["test"] | test}
        where = {"load": {"sentence": "load side, there"}}
        summary = change_summary(verdict="unknown_effect", where_after=where, gap=gap, explained_share=share)
        return describe_diagnosis(summary)

    partial = "The model lacks load.coulomb_friction, but that is not all: on held-out data {} of the missing torque is "
    partial += "explained."
    result = describe_part(failed=["theta_e"])
    assert (result.verdict, result.headline) == ("doubtful", partial.format("83 %"))
    assert result.remarks[0] == "What is left: load side, there."
    assert (
        "More is left than noise, the uncertainty of the numbers and torques too small to be named account for (1 % test): "
        "theta_e 0.0011 rad (at most 0.0012)."
    ) in result.remarks
    assert describe_part(share=0.9987, remainder=True).headline == partial.format("99.9 %")
    assert describe_part(share=-0.2, remainder=True).headline == partial.format("none")
    remarks = describe_part(far={"drive.motor_inertia": -25.0}).remarks
    far = "drive.motor_inertia had to change to 0.5 times its nominal value, 25 times its [uncertainty]; this number"
    assert any(line.startswith(far) for line in remarks)
    worse = describe_part(worse=True)
    assert worse.verdict == "failed" and worse.headline.endswith("but it predicts the held-out data worse with it.")
    gap = SUMMARY["gap"] | {"test": SUMMARY["gap"]["test"] | {"failed": ["theta_e"]}}
    motor_line = describe_diagnosis(change_summary(verdict="unknown_effect", gap=gap, backlash=None)).headline
    assert motor_line.endswith("on held-out data 83 % of the motor's squared prediction error beyond noise is explained.")
    assert any(
        line.startswith("The effects take away less than half of the torque") for line in describe_part(little=True).remarks
    )


@pytest.mark.parametrize("names", [True, False])
def test_what_is_not_tested_is_said_with_what_to_record(names):
    untested = {"load.coulomb_friction": {"torque": 0.01, "on_log": 0.3}} if names else {}
    reach = {"theta_e": {"log": 3.0, "proof": 0.1}, "torque_motor": {"log": 2.0, "proof": 0.2}}
    gap = SUMMARY["gap"] | {"test": SUMMARY["gap"]["test"] | {"untested": untested}, "range": reach}
    findings = SUMMARY["findings"] if names else []
    result = describe_diagnosis(change_summary(verdict="not_tested", findings=findings, gap=gap))
    line, why = result.remarks[0], "Even a complete model may leave as much as moves there. "
    if names:
        why = "The held-out data would pass without it, too (load.coulomb_friction is 0.01"
    found = "By the log the model lacks load.coulomb_friction" if names else "The log shows nothing that the model lacks"
    assert (result.verdict, result.headline) == ("doubtful", f"{found}, but the held-out data cannot test that.")
    assert line.startswith(why)
    assert line.endswith("reaches as far: motor position 3 rad (there 0.1), motor torque 2 N m (there 0.2).")


def test_of_a_torque_that_fails_at_several_bandwidths_the_clearest_is_said():
    slow = {
        f"torque_motor below {f} Hz": {"before": 0.2, "after": 0.03, "noise": 1e-3, "limit": limit}
        for f, limit in ((9, 0.01), (18, 0.02))
    }
    gap = SUMMARY["gap"] | {"slow_torques": slow}
    gap["test"] = gap["test"] | {"failed": ["torque_motor below 18 Hz", "torque_motor below 9 Hz"]}
    remarks = describe_diagnosis(change_summary(verdict="unknown_effect", gap=gap)).remarks
    assert remarks[-1].endswith("(1 % test): torque_motor below 9 Hz 0.03 N m (at most 0.01).")
    # of a model that diverges nothing is finite
    slow["torque_motor below 18 Hz"]["after"] = None
    assert "torque_motor below 18 Hz" in describe_diagnosis(change_summary(verdict="unknown_effect", gap=gap)).remarks[-1]


@pytest.mark.parametrize(("relative", "doubtful"), [(-0.98, True), (0.14, False)])
def test_a_torque_that_is_far_off_comes_first(relative, doubtful):
    finding = SUMMARY["findings"][0] | {"parameters": {"relative": {"value": relative, "standard_error": 0.01, "unit": ""}}}
    result = describe_diagnosis(change_summary(findings=[finding]))
    assert result.headline.startswith("the torque would be 0.02 times what u says: a unit,") is doubtful
    assert result.verdict == ("doubtful" if doubtful else "good")


@dataclasses.dataclass
class _Part:
    record: object
    holdout: object
    pairs: dict
    located: dict
    summary: dict


class _Named:
    def __init__(self, **attributes):
        self.__dict__.update(attributes)


def test_missing_torque_is_drawn_before_and_after(tmp_path):
    time = 2e-3 * np.arange(2000)
    noise = 0.02 * np.random.default_rng(0).standard_normal(2000)

    def make_residual(torque, rows):
        return Residual("motor", time[rows], torque[rows], np.full(len(time[rows]), 0.02), np.ones(2), 100.0)

    before = 0.3 * np.sign(np.sin(5.0 * time)) + noise
    parts = [(slice(0, 1500), False), (slice(1500, 2000), True)]
    pairs = {"motor": [(make_residual(before, rows), make_residual(noise, rows), held) for rows, held in parts]}
    record = _Named(unit_of=lambda path, unit: unit, path=tmp_path / "axis.csv")
    gap = {"holdout": {"separate": False}}
    part = _Part(record, record, pairs, {"motor": _Named(bandwidth=30.0)}, {"gap": gap})
    drawing = _over_time(part)  # type: ignore[arg-type]
    (panel,) = drawing.panels
    assert panel.y.label == "motor:\nmissing torque (N m)"
    assert {*names_of(panel)} == {"before", "after", "± 2 noise", "held out"}
    assert save(drawing, tmp_path / "before_after.png").stat().st_size > 10_000
