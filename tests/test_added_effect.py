"""The example of docs/effects.md as written: installed as a package, then used by every command."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from command_server import run_command, run_python
from hidden_log import nominal_study, simulate_direct_drive
from small_study import rigid_study

ROOT = Path(__file__).parents[1]
NAME = "motor.hysteretic_friction"
TORQUE, LENGTH = 0.06, 0.2


@pytest.fixture(scope="module")
def installed_effect(tmp_path_factory):
    """Environment of processes that have the page's package of an effect."""
    text = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")
    folder, site = tmp_path_factory.mktemp("package"), tmp_path_factory.mktemp("site")
    for name, content in re.findall(r"```(?:python|toml)\n# (\S+)\n(.*?)```", text, re.S):
        (folder / name).write_text(content, encoding="utf-8")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
    subprocess.run([*pip, "--no-build-isolation", "--target", site, folder], check=True)
    return {"PYTHONPATH": os.pathsep.join([str(site), str(ROOT)])}


def jaxbl(environment, *arguments):
    """Run a command in a process of its own."""
    result = run_command(*arguments, cwd=ROOT, **environment)
    assert result.returncode == 0, result.stderr
    assert "warning" not in result.stderr
    return result.stdout


def study_block():
    text = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```toml\n(\[\[effects\]\].*?)```", text, re.S)
    return block


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Two logs of a machine that has such friction, by the bench's simulator, which shares nothing with the package."""
    folder = tmp_path_factory.mktemp("logs")
    t = 2e-3 * np.arange(1500)
    hidden = [{"kind": "unknown.hysteresis", "side": "motor", "torque": TORQUE, "length": LENGTH}]
    for seed, name in enumerate(("log.csv", "other.csv")):
        random = np.random.default_rng(seed)
        rates, phases = 0.5 * np.arange(1, 7), random.uniform(-np.pi, np.pi, 6)
        torque = 0.3 * np.sum(np.sin(2.0 * np.pi * rates[:, None] * t + phases[:, None]), axis=0)
        simulate_direct_drive(torque, hidden, 3e-5, seed).write(folder / name)
    return folder / "log.csv", folder / "other.csv"


def test_it_is_simulated_and_swept_over(installed_effect, tmp_path):
    study = tmp_path / "study.toml"
    study.write_text(tomli_w.dumps(rigid_study()) + study_block(), encoding="utf-8")
    jaxbl(installed_effect, "simulate", study, "--out", tmp_path / "run")
    jaxbl(installed_effect, "sweep", study, "--out", tmp_path / "sweep")
    assert (tmp_path / "run" / "report.html").exists()
    assert f"effects.{NAME}.torque" in (tmp_path / "sweep" / "report.html").read_text(encoding="utf-8")


def test_its_numbers_are_identified(installed_effect, logs, tmp_path):
    model = nominal_study(effects=[{"kind": NAME, "torque": 0.04, "length": 0.15}], identify={"starts": 1})
    (tmp_path / "model.toml").write_text(tomli_w.dumps(model), encoding="utf-8")
    jaxbl(installed_effect, "identify", logs[0], "--model", tmp_path / "model.toml", "--out", tmp_path / "found")
    parameters = json.loads((tmp_path / "found" / "identification.json").read_text(encoding="utf-8"))["parameters"]
    assert parameters[f"effects.{NAME}.torque"]["value"] == pytest.approx(TORQUE, rel=0.02)
    assert parameters[f"effects.{NAME}.length"]["value"] == pytest.approx(LENGTH, rel=0.05)


def test_it_is_named_where_it_is_missing(installed_effect, logs, tmp_path):
    log, other = logs
    (tmp_path / "model.toml").write_text(tomli_w.dumps(nominal_study()), encoding="utf-8")
    out = tmp_path / "found"
    jaxbl(installed_effect, "diagnose", log, "--model", tmp_path / "model.toml", "--holdout", other, "--out", out)
    content = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    assert content["verdict"] == "explained"
    (finding,) = content["findings"]
    assert finding["effect"] == NAME and finding["confidence"] > 0.99
    assert finding["parameters"]["torque"]["value"] == pytest.approx(TORQUE, rel=0.02)
    assert finding["parameters"]["length"]["value"] == pytest.approx(LENGTH, rel=0.05)
    assert NAME in (out / "model.toml").read_text(encoding="utf-8")


def test_the_reference_lists_it(installed_effect):
    code = "import docs.generate as g; print(g.page())"
    result = run_python("-c", code, cwd=ROOT, **installed_effect)
    assert result.returncode == 0, result.stderr
    assert f"| `{NAME}` | Friction that builds up over a sliding length" in result.stdout
