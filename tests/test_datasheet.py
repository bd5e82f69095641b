"""A first study from a data sheet: units, what is written, and that the commands run it."""

import math
import tomllib

import pytest

from jaxbl import read_config
from jaxbl.cli import setup
from jaxbl.datasheet import ITEMS
from jaxbl.errors import InputError

BY_NAME = {item.name: item for item in ITEMS}


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("motor_inertia", "0.48 kg cm2", 4.8e-5),
        ("motor_inertia", "480gcm²", 4.8e-5),
        ("motor_inertia", "4.8e-5", 4.8e-5),
        ("motor_viscous", "2 mN·m/krpm", 2e-3 / (1000.0 * 2.0 * math.pi / 60.0)),
        ("torque", "1.3Nm", 1.3),
        ("speed", "3000 1/min", 100.0 * math.pi),
        ("gear_ratio", "50:1", 50.0),
        ("stiffness", "12 Nm/arcmin", 12.0 * 60.0 * 180.0 / math.pi),
        ("backlash", "3′", math.radians(3.0 / 60.0)),
        ("motor_encoder", "17 bits", 2.0 * math.pi / 131072),
        ("motor_encoder", "1024 lines", 2.0 * math.pi / 4096),
        ("motor_encoder", "4096 counts", 2.0 * math.pi / 4096),
        ("sample_period", "4 kHz", 0.25e-3),
        ("sample_period", "250 µs", 0.25e-3),
        ("encoder_noise", "5 arcsec", math.radians(5.0 / 3600.0)),
    ],
)
def test_numbers_become_si(name, text, value):
    assert BY_NAME[name].read(text).value == pytest.approx(value, rel=1e-14)


def test_examples_and_defaults_can_be_read():
    for item in ITEMS:
        assert item.read(item.example).value > 0.0
        assert not item.default or item.left_out().text == "not given"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("motor_inertia", "heavy", "--motor-inertia 'heavy': should be a number and its unit, such as '0.48 kg cm²'"),
        ("speed", "3000 km/h", "--speed '3000 km/h': the unit 'km/h' is not known here; known: rad/s, rpm, deg/s"),
        ("torque", "-1 N m", "--torque '-1 N m': should be more than 0 N m, such as '1.3 N m'"),
        ("backlash", "-1 arcmin", "--backlash '-1 arcmin': should be at least 0 rad, such as '3 arcmin'"),
        ("motor_encoder", "0 counts", "--motor-encoder '0 counts': should be at least 0 rad, such as '17 bit'"),
        ("gear_ratio", "50 teeth", "--gear-ratio '50 teeth': the unit 'teeth' is not known here; known: none"),
    ],
)
def test_what_is_no_such_number_is_said(name, text, message):
    with pytest.raises(InputError) as error:
        BY_NAME[name].read(text)
    assert str(error.value) == message


SHEET = {
    "--motor-inertia": "0.48 kg cm²", "--torque": "1.3 N m", "--speed": "3000 rpm", "--gear-ratio": "50",
    "--stiffness": "12 N m/arcmin", "--backlash": "3 arcmin", "--load-inertia": "0.4 kg m²",
}  # fmt: skip
WORDS = [word for pair in SHEET.items() for word in pair]


def test_a_study_is_written_beside_what_was_given_and_nothing_overwritten(call, tmp_path):
    code, lines, errors = call("init", "axis.toml", *WORDS, "--motor-friction", "15 mN m", "--title", 'my "axis"')
    assert (code, errors) == (0, []) and lines[0].startswith("axis.toml: a study with comments.")
    text = (tmp_path / "axis.toml").read_text()
    assert "half_gap = 0.0218166 # rad on the motor's shaft, given: 3 arcmin at the output, end to end" in text
    study = read_config(tmp_path / "axis.toml")
    assert study.title == 'my "axis"' and study.drive.motor_inertia == pytest.approx(4.8e-5)
    # both at the output on the sheet: an angle there is 50 of the motor's, and a torque a fiftieth
    assert study.transmission.half_gap == pytest.approx(50.0 * math.radians(1.5 / 60.0), rel=1e-5)
    assert study.transmission.stiffness == pytest.approx(12.0 / math.radians(1.0 / 60.0) / 2500.0, rel=1e-5)
    assert [effect.kind for effect in study.effects] == ["motor.coulomb_friction"]
    with pytest.raises(InputError, match=r"^axis.toml: is there already; init needs a new name$"):
        call("init", "axis.toml", *WORDS)
    assert (tmp_path / "axis.toml").read_text() == text


def test_without_a_terminal_what_is_missing_is_said_in_one_line(call, tmp_path):
    with pytest.raises(InputError) as error:
        call("init", "axis.toml", *WORDS[2:-4])
    assert str(error.value) == (
        "init: these numbers are missing, here with examples: --motor-inertia '0.48 kg cm²', --backlash '3 arcmin', "
        "--load-inertia '0.4 kg m²'; on a terminal they are asked for"
    )
    assert list(tmp_path.iterdir()) == []


def test_on_a_terminal_numbers_are_asked_for_again_until_they_are_some(monkeypatch, capsys):
    monkeypatch.setattr(setup, "answers", lambda: True)
    asked = []
    answers = iter(["light", "0.5 kg cm²", ""])

    def prompt(text, default, err):
        asked.append((text, default))
        return next(answers) or default

    monkeypatch.setattr("typer.prompt", prompt)
    assert setup._asked(BY_NAME["motor_inertia"]).value == pytest.approx(5e-5)
    assert setup._asked(BY_NAME["sample_period"]).text == "not given"
    assert asked[0] == asked[1] and asked[2][1] == "1 ms"
    assert "should be a number and its unit" in capsys.readouterr().err


def test_a_gear_without_backlash_is_a_shaft(call, tmp_path):
    assert call("init", "axis.toml", *WORDS, "--backlash", "0 arcmin", "--sample-period", "10 ms")[0] == 0
    assert read_config(tmp_path / "axis.toml").transmission.law == "linear_shaft"


@pytest.mark.slow
def test_simulate_sweep_and_tune_run_what_is_written(call, tmp_path):
    assert call("init", "axis.toml", *WORDS, "--frequency", "5 Hz", "--encoder-noise", "5 arcsec")[0] == 0
    for command in ("simulate", "sweep", "tune"):
        code, lines, _ = call(command, "axis.toml", "--out", command)
        assert code == 0 and lines[-1] == f"{command}/report.html"
    found = tomllib.loads((tmp_path / "tune" / "gains.toml").read_text())["observer"]
    assert found["motor"]["alpha"] > 0.0 and found["load"]["lambda"] > 0.0
