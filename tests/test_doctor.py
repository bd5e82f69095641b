"""What jaxbl doctor says where all is well, and where something is wrong."""

import json

import pytest

from jaxbl import doctor
from jaxbl.sweeps.trial import run


@pytest.fixture(scope="module")
def doctor_findings():
    return doctor.examine()


def test_it_names_versions_devices_and_folders_and_tests_itself(doctor_findings, call, monkeypatch):
    monkeypatch.setattr(doctor, "examine", lambda: doctor_findings)
    code, lines, _ = call("doctor")
    finding_by_name = {finding.name: finding for finding in doctor_findings}
    assert {"jaxbl", "python", "packages", "devices", "cache", "results", "one run", "two backends"} <= set(finding_by_name)
    # tests keep no programs
    assert [finding.name for finding in doctor_findings if not finding.good] == ["cache"]
    assert code == 1 and lines[-1] == "Not in order: cache."
    assert "jax " in finding_by_name["packages"].outcome and all(len(line) <= 80 or "/" in line for line in lines)
    code, lines, _ = call("doctor", "--json")
    data = json.loads("\n".join(lines))
    assert data["exit"] == 1 and len(data["summary"]["findings"]) == len(doctor_findings)


def test_a_wrong_answer_is_found(monkeypatch):
    trial = run(doctor._make_study())
    trace = trial.trace.assign(**{"motor.velocity": 1.00001 * trial.trace["motor.velocity"]})
    monkeypatch.setattr(doctor, "run", lambda study: trial._replace(trace=trace))
    monkeypatch.setattr(doctor, "_test_two_backends", lambda: (0.0, "equal"))
    *_, finding, other, _ = doctor.examine()
    assert not finding.good and finding.outcome.endswith("too far; report it with these lines")
    assert other == ("two backends", "equal", True)
