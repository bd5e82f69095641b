"""Models for MuJoCo: the same accelerations as the plant's, the same free runs, and nothing left out in silence."""

import json
import xml.etree.ElementTree as ET

import jax
import jax.numpy as jnp
import mjcf as bench
import mujoco
import numpy as np
import pytest
from effect_values import ENCODERS, VALUES
from small_study import rigid_study, small_study

import jaxbl
from jaxbl.config import read_config
from jaxbl.drive import as_arrays
from jaxbl.drive.effects import CoulombFriction, SideEffect
from jaxbl.drive.transmission import LinearShaft, SigmoidBacklash
from jaxbl.errors import InputError
from jaxbl.exports.mjcf import write_mjcf
from jaxbl.exports.mujoco_parts import ActuatorParts, MujocoParts, SideParts, exactly, unsaid
from jaxbl.exports.to_mujoco import to_mujoco

SHAFT = {"law": "linear_shaft", "stiffness": 1.0}
GAP = {"law": "dead_zone", "stiffness": 1.0, "half_gap": 0.1}
TABLE = {"positions": [-1.0, 0.0, 2.0], "position_torques": [0.5, -0.2, 1.0]}
EFFECT_CASES = [
    ({"kind": name, **{key: list(n) if isinstance(n, tuple) else n for key, n in numbers.items()}}, SHAFT, ())
    for name, numbers in VALUES.items()
    # its bristles are relaxed at first
    if not name.endswith("stribeck_friction")
]
EFFECT_CASES += [
    ({"kind": "motor.tabulated", **TABLE}, SHAFT, ()),
    ({"kind": "load.asymmetric_friction", "viscous_difference": 0.0, "torque_difference": -0.3}, SHAFT, ()),
    ({"kind": "load.gravity", "torque": -0.5, "phase": 0.4}, SHAFT, ()),
    ({"kind": "load.gravity", "torque": 0.5, "phase": 0.4}, SHAFT, ("load",)),
    ({"kind": "load.flexibility", "inertia": 0.08, "frequency": 1.5, "damping_ratio": 0.1}, SHAFT, ("motor", "load")),
    ({"kind": "load.inertia", "inertia": 1.0}, GAP, ()),
    ({"kind": "transmission.hardening", "cubic_stiffness": 20.0}, GAP, ()),
    ({"kind": "transmission.damping", "damping": 0.1}, GAP, ()),
    ({"kind": "transmission.backlash", "half_gap": 0.05}, small_study()["transmission"], ()),
]


REGULAR_SEEDS = {"gap, damping, flexible load, delay": 1}
"""Seeds of drives whose motion is not chaotic, where it is not 0, by kinds."""


def study(*effects, **tables):
    """A study of 1 ms samples with these effects."""
    return read_config(small_study(effects=list(effects), **tables))


def compile_model(config, linear=()):
    """The model at the study's initial state, and what it has of the study."""
    text, _, notes = write_mjcf(config, linear=linear)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    return model, data, notes


def name_case(case):
    """A test's name."""
    effect, law, linear = case
    return "-".join((effect["kind"], law["law"], *linear))


@pytest.mark.parametrize("case", EFFECT_CASES, ids=name_case)
def test_accelerations_are_those_of_the_plant(case):
    effect, law, linear = case
    if effect["kind"] == "actuator.delay":
        effect = effect | {"delay": 0.004}
    config = study(effect, transmission=law)
    model, data, notes = compile_model(config, linear)
    (fidelity, text) = notes[f"effects.{effect['kind']}"]
    assert text
    plant = as_arrays(config.build().plant, jnp.float64)
    twist, load, speed, rate, inputs = (np.random.default_rng(0).uniform(-1.0, 1.0, (20, 5)) * [0.5, 2.0, 1.0, 1.0, 0.4]).T
    # a twist of some half gaps, outward motion: a gap's flanks do not pull
    rate = abs(rate) * np.sign(twist)
    positions, velocities = ({"motor": 5.0 * y + x, "load": y} for x, y in ((twist, load), (rate, speed)))

    def accelerate(position, velocity, u):
        states, torque = plant.actuate(tuple(effect.settled(u) for effect in plant.effects), u, 1e-4)
        return [
            (total - plant.drive.viscous(side) * velocity[side] - level * jnp.sign(velocity[side])) / plant.inertia(side)
            for side, (total, level) in plant.side_torques(position, velocity, states, torque, 0.0).items()
        ]

    errors = []
    expected_rows = np.transpose(jax.vmap(accelerate)(positions, velocities, inputs))
    for i, (u, expected) in enumerate(zip(inputs, expected_rows, strict=True)):
        position, velocity = ({side: column[i] for side, column in columns.items()} for columns in (positions, velocities))
        mujoco.mj_resetData(model, data)
        for side in ("motor", "load"):
            data.joint(side).qpos[0], data.joint(side).qvel[0] = position[side], velocity[side]
        for joint in range(2, model.njnt):
            data.qvel[joint] = -velocity["load"]
        data.ctrl[0] = u
        if model.actuator_actadr[0] >= 0:
            data.act[model.actuator_actadr[0]] = u
        if model.actuator_delay[0]:
            mujoco.mj_initCtrlHistory(model, data, 0, None, np.full(model.actuator_history[0][0], u))
        mujoco.mj_forward(model, data)
        accelerations = [data.joint(side).qacc[0] for side in ("motor", "load")]
        errors.append(np.abs((np.array(accelerations) - expected) / (1.0 + np.abs(expected))))
    if fidelity != "not said":
        # weak constraints take 1e-4 of what acts beside them
        assert np.max(errors) < (1e-9 if fidelity == notes["transmission"].fidelity == "exactly" else 2e-3)


@pytest.mark.parametrize("kind", bench.KINDS)
def test_free_runs_are_those_of_the_study(kind):
    # one drive over 4 s reaches what the exporter has of its kind; benchmarks/mjcf.py has fifty over ten
    data = bench.draw_study(kind, REGULAR_SEEDS.get(kind, 0))
    config = read_config(data | {"run": data["run"] | {"duration": 4.0}})
    inputs, expected = bench.simulate(config)
    assert bench.model_difference(kind, config, inputs, expected) < (0.03 if kind == bench.COARSE else 0.01)


def test_smooth_gap_by_chords_is_as_near_as_said():
    law = SigmoidBacklash(2.0, 0.03, 40.0)
    parts = MujocoParts({"motor": SideParts(1.0), "load": SideParts(1.0)}, 1.0, 1e-4)
    _, text = to_mujoco(law, parts)
    z = np.linspace(-1.0, 1.0, 4001)
    springs = sum(spring.linear * (z - np.clip(z, spring.low, spring.high)) for spring in parts.springs)
    error = np.max(np.abs(springs - law.torque(jnp.asarray(z))))
    part = float(text.split(" N m off")[0].split()[-1])
    assert 0.5 * part < error < 1.05 * part
    assert part < 1e-3 * 4.0 * 0.03 * 2.0


def test_every_part_is_listed_with_its_path(tmp_path):
    effects = [
        {"kind": "motor.cogging", "amplitude": 0.1, "harmonic": 6.0},
        {"kind": "transmission.hysteresis", "torque": 0.1, "length": 0.1},
        {"kind": "load.coulomb_friction", "torque": 0.1},
        {"kind": "encoder.offset", **ENCODERS["encoder.offset"]},
    ]
    config = study(*effects, title="rough -- new")
    export = jaxbl.export(config, tmp_path / "out", "mjcf")
    export_json = json.loads((tmp_path / "out" / "export.json").read_text())
    assert export.summary.items() <= export_json.items()
    model_text, step, notes = write_mjcf(config)
    groups = {fidelity: set(export_json[fidelity]) for fidelity in ("exactly", "approximated", "not said")}
    assert groups["exactly"] == {"drive", "effects.motor.cogging", "initial"}
    assert groups["approximated"] == {"transmission", "effects.load.coulomb_friction"}
    missing = {"effects.transmission.hysteresis", "effects.encoder.offset", "excitation", "encoders", "observer"}
    assert groups["not said"] == missing
    assert set(notes) == set().union(*groups.values())
    assert export_json["time_step"] == step
    text = (export.folder / "model.xml").read_text(encoding="utf-8")
    assert text == model_text
    assert "drive.motor_inertia = 0.05 kg m²" in text
    assert "effects.motor.cogging: amplitude = 0.1 N m, harmonic = 6 1/turn" in text
    assert all(f"Not in this model: {path}: " in text for path in missing)
    model = mujoco.MjModel.from_xml_path(str(export.folder / "model.xml"))
    assert [model.sensor(i).name for i in range(model.nsensor)][-2:] == ["twist", "motor_torque"]
    assert model.opt.timestep == step


def test_sides_on_a_line_slide():
    numbers = {"amplitude": 0.1, "harmonic": 6.0}
    config = read_config(rigid_study(effects=[{"kind": "motor.cogging", **numbers}]))
    text, _, _ = write_mjcf(config, linear=["motor"])
    (joint,) = ET.fromstring(text).iter("joint")
    assert joint.get("type") == "slide"
    assert "drive.motor_inertia = 0.05 kg -->" in text
    assert "amplitude = 0.1 N," in text
    assert mujoco.MjModel.from_xml_string(text).body("motor").mass[0] == 0.05
    with pytest.raises(InputError, match=r"^linear: the drive has no side 'load'; it should be among motor$"):
        write_mjcf(config, linear=["load"])


def test_options_of_another_target_are_refused(tmp_path):
    for option, value in (("precision", "float"), ("name", "axis")):
        with pytest.raises(InputError, match=rf"^--{option}: --target mjcf has no such option; leave it out$"):
            jaxbl.export(study(), tmp_path / "new", "mjcf", **{option: value})
    with pytest.raises(InputError, match=r"^--linear: --target c has no such option"):
        jaxbl.export(study(), tmp_path / "new", "c", linear=["load"])
    assert not (tmp_path / "new").exists()
    jaxbl.export(study(), tmp_path / "line", "mjcf", linear=["load"])
    assert 'type="slide"' in (tmp_path / "line" / "model.xml").read_text(encoding="utf-8")


def test_starts_as_the_study_does():
    flexible = {"kind": "load.flexibility", "inertia": 0.5, "frequency": 2.0}
    config = study(flexible, initial={"motor_position": 0.5, "load_position": 0.1, "load_velocity": 0.3})
    _, data, _ = compile_model(config)
    np.testing.assert_array_equal(data.qpos, [0.5, 0.1, 0.0])
    np.testing.assert_array_equal(data.qvel, [0.0, 0.3, -0.3])


def test_limits_keep_their_place_in_the_chain():
    chain = ActuatorParts()
    chain.scale(2.0)
    chain.clip(3.0)
    chain.scale(0.5)
    assert (chain.limit, chain.gain) == (1.5, 1.0)
    chain.lag = 0.01
    chain.clip(1.0)
    chain.scale(-4.0)
    chain.clip(5.0)
    assert (chain.limit, chain.torque_limit, chain.gain) == (1.5, 4.0, -4.0)


def test_steps_resolve_gear_and_effects():
    config = study(transmission=GAP | {"stiffness": 400.0}, run={"duration": 0.1, "substeps": 10})
    _, step, _ = write_mjcf(config)
    fastest = np.sqrt(400.0 * (1.0 / 0.05 + 25.0 / 7.0))
    assert step == 1e-3 / np.ceil(max(10.0, 1e-3 * fastest / 0.1))
    quick = {"kind": "actuator.lag", "time_constant": 5e-5}
    assert write_mjcf(study(quick, transmission=SHAFT))[1] == pytest.approx(5e-6)
    assert write_mjcf(study(quick, quick, transmission=SHAFT))[2]["effects.1"].fidelity == "not said"


class UnknownToMujoco(SideEffect):
    """An effect of a package that knows nothing of MuJoCo."""

    kind = "unknown_to_mujoco"


class OwnFriction(CoulombFriction):
    """An effect of another package, with an answer of its own."""

    kind = "own_friction"

    def to_mujoco(self, parts, side):
        parts.sides[side].dry += 2.0 * self.torque
        return exactly(f"friction of the {side}")


def test_classes_of_other_packages_are_asked(monkeypatch):
    parts = MujocoParts({"motor": SideParts(1.0)}, None, 1e-4)
    assert to_mujoco(UnknownToMujoco(side="motor"), parts, "motor").fidelity == "not said"
    assert to_mujoco(OwnFriction(side="motor", torque=0.5), parts, "motor") == ("exactly", "friction of the motor")
    assert parts.sides["motor"].dry == 1.0
    monkeypatch.setattr(LinearShaft, "to_mujoco", lambda law, parts: unsaid("a secret"), raising=False)
    with pytest.raises(InputError, match=r"^transmission\.law: MuJoCo cannot say 'linear_shaft': a secret; another law"):
        write_mjcf(study(transmission=SHAFT))
