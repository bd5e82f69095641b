"""What a diagnosis says: sentences and figures for every verdict."""

import copy
import dataclasses

import numpy as np
import pytest
from hidden.outcomes import FIRST_LINE
from passed import PASSED

from jaxbl.diagnosis.residuals import Residual
from jaxbl.report.diagnose import _over_time, _verdict, diagnosis_lines
from jaxbl.report.figures import save

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
    "verdict": "explained",
    "findings": [
        {
            "effect": "load.coulomb_friction",
            "confidence": 0.93,
            "share": 0.12,
            "z": 21.0,
            "parameters": {"torque": {"value": 0.274, "standard_error": 0.0021, "unit": "N m"}},
            "alternatives": [{"effect": "load.stribeck_friction", "confidence": 0.07}],
        }
    ],
    "where": {"motor": {"sentence": "motor side: nothing beyond noise"}, "load": {"sentence": "load side, here"}},
    "rest": {"load.drift": {"evidence": -3.0, "share": 0.001}, "load.time": {"evidence": None, "share": 0.0}},
    "explained_share": 0.83,
    "contradictions": [],
    "parameters": {"drive.motor_inertia": {"value": 0.01, "nominal": 0.02}},
    "warnings": [],
    "notes": ["A note."],
    "gap": {
        "holdout": {"file": "/logs/other.csv", "separate": True, "from": 0.0, "to": 5.0, "window": 0.5},
        "units": UNITS,
        "holdout_rmse_before": ERRORS,
        "holdout_rmse_after": scale_errors(0.011),
        "noise_floor": scale_errors(0.01),
        "free_run": {"before": ERRORS, "after": scale_errors(0.02)},
        "expected": {
            name: {"noise": 0.01 * value, "open": 0.0, "least": 0.0, "limit": 0.012 * value}
            for name, value in ERRORS.items()
            if not name.startswith("velocity")
        },
        "test": PASSED,
        "controls": {
            "wrong": {"effect": "load.stribeck_friction", "rmse": scale_errors(0.3), "z": 12.3},
        },
    },
}


def test_logs_that_contradict_each_other_are_named_first():
    logs = [
        {"log": "slow.csv", "value": 2.3e-5, "standard_error": 5e-6},
        {"log": "fast.csv", "value": 1.68e-4, "standard_error": 5e-6},
    ]
    lines = diagnosis_lines(
        change_summary(
            contradictions=[{"parameter": "drive.motor_inertia", "unit": "kg m²", "logs": logs}], warnings=["A warning."]
        )
    )
    assert lines[0] == (
        "The logs contradict each other: drive.motor_inertia is 2.3e-05 ± 5e-06 kg m² by slow.csv and 0.000168 ± 5e-06 "
        "kg m² by fast.csv. One model cannot hold for both: was the load, the controller (a feedforward that u does not "
        "contain) or a unit another one?"
    )
    assert lines[1] == "A warning."


def change_summary(**keys):
    return copy.deepcopy(SUMMARY) | keys


def test_the_headline_has_verdict_numbers_and_gap():
    lines = diagnosis_lines(SUMMARY)
    assert lines[0] == (
        "Explained: the model lacks load.coulomb_friction; with it, no more is left on data not used for the fit than noise "
        "and the uncertainty of the model's numbers account for."
    )
    assert lines[1] == "load.coulomb_friction (confidence 0.93): torque = 0.274 ± 0.0021 N m; 12 % of the driving torque."
    assert lines[2] == "  Not ruled out by this log: load.stribeck_friction (0.07)."
    assert lines[3].startswith(
        "On other.csv, over windows of 0.5 s, rms (noise; most that a complete model leaves): theta_e 0.1 -> 0.0011 rad "
        "(0.001; 0.0012), theta_s "
    )
    assert lines[4].startswith("In one free run: theta_e 0.1 -> 0.002 rad;")
    assert (
        "Control: the best model with another effect (load.stribeck_friction) leaves 0.006 rad in theta_s in place of "
        "0.00022; it is 12.3 standard errors worse."
    ) in lines
    assert lines[-1] == "A note."


def test_the_observers_residual_is_given_where_they_converge():
    assert not any("observers" in line for line in diagnosis_lines(SUMMARY))
    clear = {"converged": True, "rms": 2.1, "noise": 0.2, "correlation": 0.987}
    noisy = {"converged": True, "rms": 0.021, "noise": 0.02, "correlation": 0.3}
    diverged = {"converged": False, "rms": None, "noise": None, "correlation": None}

    def observer_lines(**observed):
        where = {side: SUMMARY["where"][side] | {"observed": residual} for side, residual in observed.items()}
        return [line for line in diagnosis_lines(change_summary(where=where)) if "observers" in line]

    assert observer_lines(motor=noisy, load=clear) == [
        "By the observers' equivalent control: motor side, no more than its noise (0.02 N m rms); load side, 2.1 N m rms "
        "(its noise 0.2), correlation 0.99 with the smoother's."
    ]
    assert observer_lines(motor=diverged, load=clear)[0].startswith(
        "By the observers' equivalent control: load side, 2.1 N m rms"
    )
    assert observer_lines(motor=diverged) == []


def test_other_verdicts_say_what_is_left():
    assert diagnosis_lines(change_summary(verdict="no_discrepancy", findings=[]))[0].startswith("No discrepancy: ")
    remaining_effects = {"load.drift": {"evidence": 30.0, "share": 0.01}}
    lines = diagnosis_lines(change_summary(verdict="unknown_effect", findings=[], rest=remaining_effects))
    assert lines[0].startswith("Unknown: no known effect explains what is missing: motor side")
    assert any(line.startswith("Remaining: a drifting friction on the load side (1 % of") for line in lines)
    gap = SUMMARY["gap"] | {"free_run": {"why_not": "it is chaotic"}}
    assert "No free run is compared: it is chaotic." in diagnosis_lines(change_summary(gap=gap))


def test_numbers_that_are_further_off_come_first():
    """In the words that the bench asks for; what else is found stays."""
    off = SUMMARY | {"numbers_off": True}
    assert diagnosis_lines(off | {"findings": [], "verdict": "no_discrepancy"})[0].startswith(FIRST_LINE)
    assert diagnosis_lines(off)[0].endswith(diagnosis_lines(SUMMARY)[0])


def test_a_part_that_is_explained_is_said_with_its_share_and_the_reason():
    def part_lines(share=0.83, **test):
        gap = SUMMARY["gap"] | {"test": SUMMARY["gap"]["test"] | test}
        where = {"load": {"sentence": "load side, there"}}
        return diagnosis_lines(change_summary(verdict="unknown_effect", where_after=where, gap=gap, explained_share=share))

    partial_start = (
        "Partly explained: the model lacks load.coulomb_friction; with it, {} of the missing torque is explained on data "
    )
    known_end = "not used for the fit. The rest is none of the known effects: load side, there."
    first, _, _, second, *_ = part_lines(failed=["theta_e"])
    assert first == partial_start.format("83 %") + known_end
    assert second == (
        "More is left than noise, the uncertainty of the numbers and torques too small to be named account for (1 % test): "
        "theta_e 0.0011 rad (at most 0.0012)."
    )
    assert part_lines(share=0.9987, remainder=True)[0] == partial_start.format("99.9 %") + known_end
    assert part_lines(share=-0.2, remainder=True)[0] == partial_start.format("none") + known_end
    first, _, _, second, *_ = part_lines(far={"drive.motor_inertia": -25.0})
    assert first == partial_start.format("83 %") + "not used for the fit, but not in a way that can be right."
    assert second.startswith("drive.motor_inertia had to change by -50%, 25 times its [uncertainty]: findings and it may")
    assert part_lines(worse=True)[0].startswith("Contradicted: by the log the model lacks load.coulomb_friction; data not")
    gap = SUMMARY["gap"] | {"test": SUMMARY["gap"]["test"] | {"failed": ["theta_e"]}}
    motor_line = diagnosis_lines(change_summary(verdict="unknown_effect", gap=gap, backlash=None))[0]
    assert "83 % of the squared prediction error of the motor beyond noise is explained on data" in motor_line
    assert part_lines(little=True)[3].startswith("The effects take away less than half of the torque that is missing")


@pytest.mark.parametrize("names", [True, False])
def test_what_is_not_tested_is_said_with_what_to_record(names):
    untested = {"load.coulomb_friction": {"torque": 0.01, "on_log": 0.3}} if names else {}
    reach = {"theta_e": {"log": 3.0, "proof": 0.1}, "torque_motor": {"log": 2.0, "proof": 0.2}}
    gap = SUMMARY["gap"] | {"test": SUMMARY["gap"]["test"] | {"untested": untested}, "range": reach}
    findings = SUMMARY["findings"] if names else []
    line, *_ = diagnosis_lines(change_summary(verdict="not_tested", findings=findings, gap=gap))
    found, why = (
        (
            "by the log the model lacks load.coulomb_friction",
            "a model without it would pass, too; load.coulomb_friction is 0.01",
        )
        if names
        else ("the log shows nothing that the model lacks", "even a complete model may leave as much as moves there")
    )
    assert line.startswith(f"Not tested: {found}; data not used for the fit cannot show it ({why}")
    assert line.endswith("reaches as far: motor position 3 rad (there 0.1), motor torque 2 N m (there 0.2).")


def test_of_a_torque_that_fails_at_several_bandwidths_the_clearest_is_said():
    slow = {
        f"torque_motor below {f} Hz": {"before": 0.2, "after": 0.03, "noise": 1e-3, "limit": limit}
        for f, limit in ((9, 0.01), (18, 0.02))
    }
    gap = SUMMARY["gap"] | {"slow_torques": slow}
    gap["test"] = gap["test"] | {"failed": ["torque_motor below 18 Hz", "torque_motor below 9 Hz"]}
    diagnosis_line = diagnosis_lines(change_summary(verdict="unknown_effect", gap=gap))[3]
    assert diagnosis_line.endswith("(1 % test): torque_motor below 9 Hz 0.03 N m (at most 0.01).")
    # of a model that diverges nothing is finite
    slow["torque_motor below 18 Hz"]["after"] = None
    assert "torque_motor below 18 Hz" in diagnosis_lines(change_summary(verdict="unknown_effect", gap=gap))[3]


@pytest.mark.parametrize(("relative", "doubtful"), [(-0.98, True), (0.14, False)])
def test_a_torque_that_is_far_off_comes_first(relative, doubtful):
    finding = SUMMARY["findings"][0] | {"parameters": {"relative": {"value": relative, "standard_error": 0.01, "unit": ""}}}
    first = diagnosis_lines(change_summary(findings=[finding]))[0]
    assert first.startswith("Doubtful: the torque would be 0.02 times what u says: a unit,") is doubtful


@pytest.mark.parametrize("findings", [SUMMARY["findings"], []], ids=["some", "none"])
def test_the_verdict_is_drawn(findings, tmp_path):
    drawing = _verdict(change_summary(findings=findings, verdict="explained" if findings else "no_discrepancy"))
    left, right = drawing.figure.axes
    assert left.get_xlabel() == "rms error on held-out data over noise" and left.get_xscale() == "log"
    assert left.get_yticklabels()[0].get_text() == "motor position\n0.1 → 0.0011 rad"
    texts = [text.get_text().strip() for text in right.texts]
    expected = ["load.coulomb_friction: 0.93", "or load.stribeck_friction: 0.07"] if findings else ["no effect named"]
    assert texts == expected
    assert save(drawing.figure, tmp_path / "gap.png").stat().st_size > 10_000


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
        return Residual("motor", time[rows], torque[rows], np.full(len(time[rows]), 0.02), np.ones(1), 100.0)

    before = 0.3 * np.sign(np.sin(5.0 * time)) + noise
    parts = [(slice(0, 1500), False), (slice(1500, 2000), True)]
    pairs = {"motor": [(make_residual(before, rows), make_residual(noise, rows), held) for rows, held in parts]}
    record = _Named(unit_of=lambda path, unit: unit, path=tmp_path / "axis.csv")
    gap = {"holdout": {"separate": False}}
    part = _Part(record, record, pairs, {"motor": _Named(bandwidth=30.0)}, {"gap": gap})
    drawing = _over_time(part)  # type: ignore[arg-type]
    (ax,) = drawing.figure.axes
    assert ax.get_ylabel() == "motor:\nmissing torque (N m)"
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["before", "after", "± 2 noise", "held out"]
    assert save(drawing.figure, tmp_path / "before_after.png").stat().st_size > 10_000
