"""A transmission law, an input and a metric of an installed package, or registered in a process: simulated, swept,
identified online, documented."""

import json
import os
from pathlib import Path

import pytest
from command_server import run_python
from plugin import install_package

ROOT = Path(__file__).parents[1]
SOURCE = '''
from typing import ClassVar

import jax.numpy as jnp

from jaxbl.drive.excitation import AbstractExcitation
from jaxbl.drive.parameters import Scalar, parameter
from jaxbl.drive.transmission import AbstractTransmission
from jaxbl.sweeps.metrics import Rms, RunMetric


class CubicShaft(AbstractTransmission):
    """Flexible shaft that hardens: C = K z + K_3 z^3."""

    name = "cubic_shaft"
    errors: ClassVar = {"stiffness_error": "stiffness", "cubic_error": "cubic"}
    half_gap: ClassVar[float] = 0.0
    stiffness: Scalar = parameter("N m/rad", "stiffness K", above=0.0)
    cubic: Scalar = parameter("N m/rad³", "hardening K_3", minimum=0.0)

    def torque(self, deflection):
        return self.stiffness * deflection + self.cubic * deflection**3

    def regressors(self, z):
        return z, z**3

    def from_theta(self, theta):
        return {"stiffness": theta[0], "cubic": theta[1]}

    def truth(self):
        return {"stiffness": self.stiffness, "cubic": self.cubic}


class Triangle(AbstractExcitation):
    """Triangle wave between -amplitude and amplitude."""

    name = "triangle"
    amplitude: Scalar = parameter("N m", "amplitude")
    frequency: Scalar = parameter("Hz", "frequency", above=0.0)

    def __call__(self, time):
        turns = self.frequency * time
        return self.amplitude * (4.0 * jnp.abs(turns - jnp.floor(turns + 0.5)) - 1.0)


class VelocityPeak(RunMetric):
    """The state is the largest error so far."""

    name = "velocity_peak"
    unit = "rad/s"
    label = "velocity error, peak"
    doc = "largest velocity error in the last quarter"

    def init(self, zero):
        return zero

    def update(self, carry, sample):
        return jnp.maximum(carry, sample.inside * jnp.abs(sample.velocity_error))

    def result(self, carry, end):
        return carry


AccelerationSize = Rms.of(
    "acceleration_size", "rad/s²", "acceleration, rms", "rms acceleration", signal=lambda _, at: at.true.acceleration
)
'''
SCRIPT = """
import json, runpy
import jaxbl

study = json.loads(open("study.json").read())
trial = jaxbl.run(study)
swept = jaxbl.sweep(study | {"axes": [{"path": "transmission.cubic", "values": [20.0, 40.0]}]})
error = (trial.trace["motor.velocity"] - trial.trace["motor.velocity_estimate"]).abs()
page = runpy.run_path(PAGE)["page"]()
print(json.dumps({
    "input": list(trial.trace["u"][:3]),
    "identified": trial.summary["identified"],
    "peak": [trial.summary["metrics"]["motor.velocity_peak"], error[-len(error) // 4:].max()],
    "size": [
        trial.summary["metrics"]["motor.acceleration_size"],
        (trial.trace["motor.acceleration"][-len(error) // 4:] ** 2).mean() ** 0.5,
    ],
    "swept": swept.frame[["motor.velocity_peak", "motor.cubic_error", "motor.stiffness_error"]].to_dict("list"),
    "page": [line for line in page.splitlines() if "cubic" in line or "triangle" in line or "velocity_peak" in line],
}))
"""
STUDY = {
    "drive": {"kind": "two_inertia", "motor_inertia": 0.05, "motor_viscous": 0.15, "load_inertia": 7.0,
              "load_viscous": 16.0, "gear_ratio": 5.0},
    "transmission": {"law": "cubic_shaft", "stiffness": 1.0, "cubic": 30.0},
    "excitation": {"kind": "triangle", "amplitude": 0.4, "frequency": 0.4},
    "observer": {"motor": {"lambda": 8.0, "alpha": 30.0}, "load": {"lambda": 1.0, "alpha": 1.0}},
    "run": {"duration": 10.0, "substeps": 2},
}  # fmt: skip


def test_parts_of_an_installed_package_are_used_everywhere(tmp_path):
    parts = {"transmissions": {"cubic_shaft": "CubicShaft"}, "excitations": {"triangle": "Triangle"}}
    parts["metrics"] = {
        "velocity_peak": "VelocityPeak",
        "acceleration_size": "AccelerationSize",
        "broken": "Nothing",
    }
    install_package(tmp_path, "more_parts", SOURCE, {f"jaxbl.{group}": entries for group, entries in parts.items()})
    (tmp_path / "study.json").write_text(json.dumps(STUDY))
    script = SCRIPT.replace("PAGE", repr(str(ROOT / "docs" / "generate.py")))
    result = run_python("-c", script, cwd=tmp_path, PYTHONPATH=os.pathsep.join([str(tmp_path), str(ROOT)]))
    assert result.returncode == 0, result.stderr
    # what is wrong is left out with one line, and ends nothing
    assert [line for line in result.stderr.splitlines() if "warning" in line] == [
        "warning: jaxbl.metrics: 'broken' (more_parts:Nothing) is left out: "
        "AttributeError: module 'more_parts' has no attribute 'Nothing'"
    ]
    content = json.loads(result.stdout)
    assert content["input"] == pytest.approx([-0.4, -0.39936, -0.39872])
    for name, true in (("stiffness", 1.0), ("cubic", 30.0)):
        assert content["identified"][name]["true"] == true
        assert content["identified"][name]["motor"] == pytest.approx(true, rel=0.2)
    assert content["peak"][0] == pytest.approx(content["peak"][1])
    assert content["size"][0] == pytest.approx(content["size"][1])
    assert content["swept"]["motor.velocity_peak"][0] != content["swept"]["motor.velocity_peak"][1]
    assert max(map(abs, content["swept"]["motor.cubic_error"])) < 0.2
    text = "\n".join(content["page"])
    assert '`[transmission]` with `law = "cubic_shaft"`' in text and '`[excitation]` with `kind = "triangle"`' in text
    assert "| `side.velocity_peak` | rad/s | largest velocity error in the last quarter |" in text
    assert "| `side.cubic_error` |  | relative error of the identified cubic |" in text


REGISTERED = """
import json
import jaxbl
from jaxbl.control import AbstractController, ControllerState
from jaxbl.sweeps.engine import Engine

study = json.loads(open("study.json").read())
usual = study | {"transmission": {"law": "linear_shaft", "stiffness": 1.0}, "run": {"duration": 1.0, "substeps": 2}}
usual["excitation"] = {"kind": "sine", "amplitude": 0.4, "frequency": 0.4}
before = sorted(jaxbl.run(usual).summary["metrics"])


class Spring(AbstractController):
    name = "spring"
    gain: Scalar = parameter("N m/rad", "gain")

    def start(self, measured):
        return ControllerState(0.0 * measured["motor"])

    def step(self, state, feedback, target, drive, period):
        return ControllerState(self.gain * (target.position - feedback.measured["motor"]))


for part in (CubicShaft, Triangle, VelocityPeak, AccelerationSize, Spring):
    jaxbl.register(part)


@jaxbl.register
class Triangle(Triangle):
    def __call__(self, time):
        return 2.0 * super().__call__(time)


study |= {"controller": {"kind": "spring", "gain": 0.1}, "reference": {"kind": "ramp", "speed": 0.1}}
config = jaxbl.read_config(study | {"axes": [{"path": "transmission.cubic", "values": [20.0, 40.0]}]})
frames = {}
for backend in ("fused", "scan"):
    engine = Engine(config, backend=backend)
    frames[backend] = engine.run(engine.chunk(0))[["motor.velocity_peak", "motor.cubic_error"]].values.tolist()
trace = jaxbl.run(study).trace
faults = []
for fault in (study | {"excitation": {"kind": "triangle", "amplitude": 0.4}}, study | {"controller": {"kind": "springs"}}):
    try:
        jaxbl.read_config(fault)
    except jaxbl.InputError as error:
        faults.append(str(error))
wrong = int, type("Sine", (Triangle,), {"name": "sine"}), type("Half", (AbstractController,), {"name": "half"})
for part in (*wrong, type("Nameless", (AbstractController,), {})):
    try:
        jaxbl.register(part)
    except jaxbl.InputError as error:
        faults.append(str(error))
print(json.dumps({
    "before": before, "after": sorted(jaxbl.run(usual).summary["metrics"]), "frames": frames, "faults": faults,
    "input": (trace["u"] - 0.1 * (trace["reference"] - trace["theta_e"]).shift(1, fill_value=0.0))[:3].tolist(),
}))
"""


def test_parts_are_registered_at_any_time(tmp_path):
    """After the config's tables were made, after a run, and once more in the place of an earlier one."""
    (tmp_path / "study.json").write_text(json.dumps(STUDY))
    result = run_python("-c", SOURCE + REGISTERED, cwd=tmp_path, PYTHONPATH=str(ROOT))
    assert result.returncode == 0, result.stderr
    content = json.loads(result.stdout)
    # errors of a law are metrics where it is the law
    added = {"acceleration_size", "velocity_peak"}
    assert set(content["after"]) - set(content["before"]) == {
        f"{side}.{name}" for side in ("motor", "load") for name in added
    }
    assert content["input"] == pytest.approx([-0.8, -0.79872, -0.79744])
    assert content["frames"]["fused"][0] != content["frames"]["fused"][1]
    for fused, scanned in zip(*content["frames"].values(), strict=True):
        assert fused == pytest.approx(scanned, rel=1e-9)
    assert content["faults"] == [
        "config: excitation.frequency: this key is missing",
        "config: controller.kind: unknown kind 'springs'; did you mean 'spring'?",
        "register: <class 'int'> should be a class of a drive, input, law, effect, observer, controller, reference or "
        "metric",
        "register: Sine: the name 'sine' is taken",
        "register: Half: should define start, step",
        "register: Nameless: type object 'Nameless' has no attribute 'name'",
    ]
