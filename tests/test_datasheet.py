"""A first study from a data sheet: units, what is written, and that the commands run it."""

import itertools
import json
import math
import re
import tomllib
from pathlib import Path

import pandas as pd
import pytest

from jaxbl import open_study, read_config, run
from jaxbl.cli import setup
from jaxbl.datasheet import KINDS, Answer, compare_observers, items_by_name, write_first_study
from jaxbl.errors import InputError
from jaxbl.gains.gain_search import usual_rule

QUESTIONS = {kind: {item.name: item for item in about.items} for kind, about in KINDS.items()}
GEARED_QUESTIONS = QUESTIONS["geared"]


@pytest.fixture(autouse=True)
def _no_comparison(monkeypatch):
    """Leave out the comparison of observers, which takes longer than all else and has a test of its own."""
    monkeypatch.setattr("jaxbl.cli.setup.compare_observers", lambda kind, text, _: ("No comparison.", text))


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("motor_inertia", "0.48 kg cm2", 4.8e-5),
        ("motor_inertia", "480gcm²", 4.8e-5),
        ("motor_inertia", "4.8e-5 kg m^2", 4.8e-5),
        ("backlash", "0", 0.0),
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
    assert GEARED_QUESTIONS[name].read(text).value == pytest.approx(value, rel=1e-14)


@pytest.mark.parametrize(
    ("kind", "name", "text", "value"),
    [
        ("screw", "lead", "10 mm", 200.0 * math.pi),  # rad of the motor for 1 m
        ("screw", "stiffness", "120 N/µm", 1.2e8),
        ("screw", "mass", "60kg", 60.0),
        ("screw", "load_encoder", "100 nm", 1e-7),
        ("screw", "load_viscous", "3 N/(m/min)", 180.0),
        ("linear", "force", "0.2 kN", 200.0),
        ("linear", "speed", "120 m/min", 2.0),
        ("screw", "load_encoder", "none", 0.0),
    ],
)
def test_numbers_of_linear_axes_become_si(kind, name, text, value):
    assert QUESTIONS[kind][name].read(text).value == pytest.approx(value, rel=1e-14)


def test_examples_and_defaults_can_be_read():
    items = [item for _, item in itertools.chain.from_iterable(items_by_name().values())]
    assert len(items) == sum(len(kind.items) for kind in KINDS.values())
    for item in items:
        assert item.read(item.example).value > 0.0
        # what is assumed is said
        assert not item.default or item.default_answer().text.startswith("not given")
        assert not item.default or (item.default in item.default_answer().text) == (item.default_answer().value > 0.0)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("motor_inertia", "heavy", "--motor-inertia 'heavy': should be a number and its unit, such as '0.48 kg cm²'"),
        ("torque", "1 MN m", "--torque '1 MN m': the unit 'MN m' is not known here; known: N m, mN m, N cm, N mm"),
        ("speed", "3000", "--speed '3000': has no unit; such as '3000 rpm'; units: rad/s, rpm, deg/s"),
        (
            "torque",
            "1,3 N m",
            "--torque '1,3 N m': should be a number and its unit, with a decimal point, such as '1.3 N m'",
        ),
        ("speed", "3000 km/h", "--speed '3000 km/h': the unit 'km/h' is not known here; known: rad/s, rpm, deg/s"),
        ("torque", "-1 N m", "--torque '-1 N m': should be more than 0 N m, such as '1.3 N m'"),
        ("backlash", "-1 arcmin", "--backlash '-1 arcmin': should be at least 0 rad, such as '3 arcmin'"),
        ("motor_encoder", "0 counts", "--motor-encoder '0 counts': should be at least 0 rad, such as '17 bit'"),
        ("gear_ratio", "50 teeth", "--gear-ratio '50 teeth': the unit 'teeth' is not known here; known: none"),
        ("load_encoder", "no", "--load-encoder 'no': should be a number and its unit, such as '20 bit', or 'none'"),
    ],
)
def test_what_is_no_such_number_is_said(name, text, message):
    with pytest.raises(InputError) as error:
        GEARED_QUESTIONS[name].read(text)
    assert str(error.value) == message


SHEET = {
    "--motor-inertia": "0.48 kg cm²", "--torque": "1.3 N m", "--speed": "3000 rpm", "--gear-ratio": "50",
    "--stiffness": "12 N m/arcmin", "--backlash": "3 arcmin", "--load-inertia": "0.4 kg m²",
}  # fmt: skip
WORDS = [word for pair in SHEET.items() for word in pair]


def test_a_study_is_written_beside_what_was_given_and_nothing_overwritten(call, tmp_path):
    code, lines, errors = call("init", "axis.toml", *WORDS, "--motor-friction", "15 mN m", "--title", 'my "axis"')
    assert (code, errors) == (0, []) and lines[0].startswith("✓ Good: axis.toml is a study with comments.")
    text = (tmp_path / "axis.toml").read_text()
    assert "half_gap = 0.0218166 # rad on the motor's shaft, given: 3 arcmin at the output, end to end" in text
    study = read_config(tmp_path / "axis.toml")
    assert study.title == 'my "axis"' and study.drive.motor_inertia == pytest.approx(4.8e-5)
    # both at the output on the sheet: an angle there is 50 of the motor's, and a torque a fiftieth
    assert study.transmission.half_gap == pytest.approx(50.0 * math.radians(1.5 / 60.0), rel=1e-5)
    assert study.transmission.stiffness == pytest.approx(12.0 / math.radians(1.0 / 60.0) / 2500.0, rel=1e-5)
    kinds = {effect.kind: effect for effect in study.effects}
    assert list(kinds) == ["motor.coulomb_friction", "transmission.damping"]
    # 3 % of critical damping: the oscillation of both inertias on the shaft
    reduced = 1.0 / (1.0 / 4.8e-5 + 2500.0 / 0.4)
    damping = 2.0 * 0.03 * math.sqrt(study.transmission.stiffness * reduced)
    assert kinds["transmission.damping"].damping == pytest.approx(damping, rel=1e-4)
    # nobody has ideal encoders
    assert study.encoders.motor_resolution == pytest.approx(2.0 * math.pi / 2**17, rel=1e-5)
    with pytest.raises(InputError, match=r"^axis.toml: is there already; init needs a new name$"):
        call("init", "axis.toml", *WORDS)
    assert (tmp_path / "axis.toml").read_text() == text


def test_without_a_terminal_what_is_missing_is_said_in_one_line(call, tmp_path):
    with pytest.raises(InputError) as error:
        call("init", "axis.toml", *WORDS[2:-4])
    assert str(error.value) == (
        "init: numbers are missing, here with examples: --motor-inertia '0.48 kg cm²', --backlash '3 arcmin', "
        "--load-inertia '0.4 kg m²'; on a terminal init asks for them; another kind of drive: --kind screw, direct, linear"
    )
    assert list(tmp_path.iterdir()) == []


def test_on_a_terminal_numbers_are_asked_for_again_until_they_are_some(monkeypatch, capsys):
    monkeypatch.setattr(setup, "can_ask_user", lambda: True)
    questions = []
    answers = iter(["light", "0.5 kg cm²", ""])

    def answer_prompt(text, default, err):
        questions.append((text, default))
        return next(answers) or default

    monkeypatch.setattr("typer.prompt", answer_prompt)
    assert setup._ask_number(GEARED_QUESTIONS["motor_inertia"]).value == pytest.approx(5e-5)
    assert setup._ask_number(GEARED_QUESTIONS["sample_period"]).text == "not given: 1 ms is assumed"
    assert questions[0] == questions[1] and questions[2][1] == "1 ms"
    assert "should be a number and its unit" in capsys.readouterr().err


def test_a_gear_without_backlash_is_a_shaft(call, tmp_path):
    assert call("init", "axis.toml", *WORDS, "--backlash", "0 arcmin", "--sample-period", "10 ms")[0] == 0
    assert read_config(tmp_path / "axis.toml").transmission.law == "linear_shaft"


SCREW = {
    "motor_inertia": "1.2 kg cm²", "motor_friction": "0.1 N m", "torque": "1.3 N m", "speed": "3000 rpm", "lead": "10 mm",
    "stiffness": "120 N/um", "backlash": "20 um", "mass": "60 kg", "load_viscous": "200 N s/m", "motor_encoder": "17 bit",
    "load_encoder": "none",
}  # fmt: skip
DIRECT = {
    "motor_inertia": "0.05 kg m²", "motor_friction": "0.2 N m", "torque": "10 N m", "speed": "300 rpm",
    "motor_encoder": "20 bit",
}  # fmt: skip
LINEAR = {"mass": "8 kg", "motor_friction": "6 N", "force": "200 N", "speed": "2 m/s", "motor_encoder": "100 nm"}
NO_STUDY = "these numbers make no study; look at their units"
# so that a run is short
SHORT_RUN = {"frequency": "20 Hz"}


def option_words(kind, numbers):
    return [
        "--kind",
        kind,
        *itertools.chain.from_iterable((f"--{name.replace('_', '-')}", text) for name, text in numbers.items()),
    ]


def read_answers(kind, numbers):
    return {
        name: item.read(numbers[name]) if name in numbers else item.default_answer()
        for name, item in QUESTIONS[kind].items()
    }


def test_a_screw_moves_as_the_turning_drive_that_it_is_at_the_motor():
    """Without a gear, its load has the inertia m / N², N in rad/m, and so has the rest of it."""
    ratio, screw = 200.0 * math.pi, read_answers("screw", SCREW | SHORT_RUN)
    at_motor = {
        "gear_ratio": 1.0, "stiffness": 1.2e8 / ratio**2, "backlash": 2e-5 * ratio, "load_inertia": 60.0 / ratio**2,
        "load_viscous": 200.0 / ratio**2, "load_encoder": 0.0,
    }  # fmt: skip
    turning = {name: screw[name] for name in QUESTIONS["geared"] if name in screw}
    turning |= {name: Answer(value, "given: by hand") for name, value in at_motor.items()}
    text, _ = write_first_study(KINDS["screw"], screw, "")
    # a gap that rattles makes much of the sixth digit of a number
    no_gap = {"backlash": Answer(0.0, "given: 0")}
    result, other = (
        write_first_study(KINDS[kind], answers | no_gap, "")[1] for kind, answers in (("screw", screw), ("geared", turning))
    )
    assert result["motor"]["f_plus"] == pytest.approx(other["motor"]["f_plus"], rel=1e-3)
    assert result["load"]["f_plus"] * ratio == pytest.approx(other["load"]["f_plus"], rel=1e-3)
    for line in (
        "load_inertia = 60.0 # kg, given: 60 kg",
        "load_viscous = 200.0 # N s/m, given: 200 N s/m",
        "gear_ratio = 628.319 # rad of the motor for 1 m of the carriage, given: 10 mm a turn",
        "stiffness = 303.964 # N m/rad on the motor's shaft, given: 120 N/um at the carriage, divided by 628.319²",
        "half_gap = 0.00628319 # rad on the motor's shaft, given: 20 um at the carriage, end to end; half of it times "
        "628.319",
        "load_resolution = 0.0 # m a count, 0 is ideal, given: none",
    ):
        assert f"\n{line}\n" in text
    notes = tomllib.loads(text)["notes"]
    assert notes[0].startswith("The load moves along a line") and notes[1].startswith(
        "This drive has no encoder on its load"
    )


@pytest.mark.parametrize(
    ("kind", "numbers", "rated_name", "lines"),
    [
        (
            "direct",
            DIRECT,
            "torque",
            ("motor_inertia = 0.05 # kg m², given: 0.05 kg m²", "torque = 0.2 # N m, given: 0.2 N m"),
        ),
        (
            "linear",
            LINEAR,
            "force",
            (
                "motor_inertia = 8.0 # kg, given: 8 kg",
                "motor_viscous = 0.0 # N s/m, not given",
                "torque = 6.0 # N, given: 6 N",
                "motor_resolution = 1e-07 # m a count, 0 is ideal, given: 100 nm",
            ),
        ),
    ],
)
def test_a_drive_without_a_gear_is_one_inertia(kind, numbers, rated_name, lines, call, tmp_path):
    code, output, _ = call("init", "axis.toml", *option_words(kind, numbers | SHORT_RUN))
    assert (
        code == 0 and ("m/s² (motor)." in "".join(output[:2])) == (kind == "linear") and "(load)" not in "".join(output[:2])
    )
    text = (tmp_path / "axis.toml").read_text()
    assert all(f"\n{line}\n" in text for line in lines)
    assert not any(unit in text.partition("[drive]")[2] for unit in ("rad", "N m", "kg m²")) or kind == "direct"
    study = read_config(tmp_path / "axis.toml")
    assert study.drive.kind == "rigid" and study.transmission is None and study.observer.load is None
    assert bool(study.notes) == (kind == "linear")
    # friction disturbs it, and an inertia that is 10 % less moves a ninth faster
    friction, rated = float(study.effects[0].torque), read_answers(kind, numbers | SHORT_RUN)[rated_name].value
    bound = study.observer.motor.alpha / usual_rule(1.0)[1] * study.drive.motor_inertia
    assert 1.1 * friction < bound < (rated + 10.0 * friction) / 9.0
    lambda_, alpha = usual_rule(bound / study.drive.motor_inertia)
    assert (study.observer.motor.lambda_, study.observer.motor.alpha) == pytest.approx((lambda_, alpha), rel=6e-3)
    assert call("simulate", "axis.toml")[0] == 0


def test_the_best_observer_stands_behind_the_study_with_its_error():
    text, pilot_metrics = write_first_study(KINDS["direct"], read_answers("direct", DIRECT | SHORT_RUN), "")
    sentence, longer_text = compare_observers(KINDS["direct"], text, pilot_metrics)
    errors = {name: float(error) for name, error in re.findall(r"(\w+) ([\d.e-]+)(?=[;.])", sentence.partition(": ")[2])}
    assert list(errors) == ["super_twisting", "differentiator_3", "kalman"]
    before, comment = longer_text.split(f"\n# {sentence}\n")
    assert before == text
    study = tomllib.loads(longer_text)
    other = tomllib.loads("\n".join(line[2:] for line in comment.splitlines()[1:]))
    best = min(errors, key=errors.__getitem__)
    assert other["observer"]["kind"] == best != "super_twisting"
    achieved = []
    for tables in (other, {}):
        drives = [{"effects": [*study["effects"], {"kind": "motor.inertia", "inertia": off * 0.05}]} for off in (-0.1, 0.1)]
        achieved.append(max(run(study | tables | drive).summary["metrics"]["motor.velocity_rmse"] for drive in drives))
    for name, error in zip((best, "super_twisting"), achieved, strict=True):
        assert error == pytest.approx(errors[name], rel=0.3)
    # the study's own gains stay where they are better
    pilot_metrics["motor"]["expected"]["largest_velocity"] = 1e-9
    _, longer_text = compare_observers(KINDS["direct"], text, pilot_metrics)
    assert "In place of" not in longer_text


def test_the_usual_rule_in_a_study_is_that_of_tune():
    text, _ = write_first_study(KINDS["linear"], read_answers("linear", LINEAR | SHORT_RUN), "")
    lambda_, alpha = usual_rule(1.0)
    assert f"usual rule, lambda = {lambda_:g} sqrt(f+) and alpha = {alpha:g} f+;" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--kind", "belt"], "--kind 'belt': should be one of geared, screw, direct, linear; see jaxbl init"),
        (
            [*option_words("direct", DIRECT), "--gear-ratio", "5", "--mass", "1 kg"],
            "--gear-ratio, --mass: --kind direct has no such option; it has: --motor-inertia, --motor-viscous, ",
        ),
        (
            option_words("direct", DIRECT | SHORT_RUN | {"motor_friction": "20 N m"}),
            f"{NO_STUDY}: the motor does not move: --torque ",
        ),
        (
            option_words("linear", LINEAR | SHORT_RUN | {"motor_friction": "400 N"}),
            f"{NO_STUDY}: the motor does not move: --force ",
        ),
        (
            option_words("screw", SCREW | SHORT_RUN | {"backlash": "1 m"}),
            f"{NO_STUDY}: the load does not move: --backlash should be",
        ),
        (
            option_words("screw", SCREW | {"lead": "1e-7 mm"}),
            f"{NO_STUDY}: drive.gear_ratio: should be less than or equal to 1",
        ),
        (["--lead", "10 mm"], "--lead: --kind geared has no such option; it has: --motor-inertia, "),
        (
            option_words("linear", LINEAR | {"motor_friction": "0 N"}),
            "--motor-friction '0 N': should be more than 0 N, such as '6 N'",
        ),
        (option_words("screw", SCREW | {"lead": "0 mm"}), "--lead '0 mm': should be more than 0 m, such as '10 mm'"),
        (
            option_words("screw", SCREW | {"mass": "60 kg m²"}),
            "--mass '60 kg m²': the unit 'kg m²' is not known here; known: kg, g, t",
        ),
        (
            ["--kind", "linear"],
            "init: numbers are missing, here with examples: --mass '8 kg', --motor-friction '6 N', ",
        ),
    ],
)
def test_what_no_such_drive_has_is_said_and_nothing_written(arguments, message, call, tmp_path):
    with pytest.raises(InputError) as error:
        call("init", "axis.toml", *arguments)
    assert str(error.value).startswith(message)
    assert list(tmp_path.iterdir()) == []


def test_on_a_terminal_the_kind_is_asked_for_first(call, tmp_path, monkeypatch):
    monkeypatch.setattr(setup, "can_ask_user", lambda: True)
    examples = {item.question: item.example for item in KINDS["linear"].items}
    questions = []
    answers = iter(["gearless", "Linear", "8 kg"])

    def prompt(text, default, err):
        questions.append(text)
        return next(answers, default or examples.get(text.partition(", such as")[0]))

    monkeypatch.setattr("typer.prompt", prompt)
    code, lines, errors = call("init", "axis.toml", "--frequency", "20 Hz")
    assert code == 0 and lines[0].startswith("✓ Good: axis.toml is a study")
    assert questions[0] == questions[1] and questions[0] == "kind of this drive"
    assert [text.partition(",")[0] for text in questions[2:]] == [
        item.question.partition(",")[0] for item in KINDS["linear"].items[:-1]
    ]
    assert errors[0] == "Kinds of drives:" and all(len(line) <= 80 for line in (*errors[:5], *questions))
    assert errors[5].startswith("  --kind 'gearless': should be one of geared")
    assert read_config(tmp_path / "axis.toml").drive.motor_inertia == 8.0


# drives without a gear are simulated above
@pytest.mark.parametrize(
    ("kind", "commands"), [("geared", ("simulate", "sweep")), ("screw", ("simulate", "tune")), ("linear", ("tune",))]
)
def test_simulate_sweep_and_tune_run_what_is_written(kind, commands, call):
    numbers = {"screw": option_words("screw", SCREW), "linear": option_words("linear", LINEAR)}.get(kind, WORDS)
    sheet = dict(itertools.pairwise(numbers))
    noise = {"linear": "20 nm"}.get(kind, "5 arcsec")
    code, lines, _ = call("init", "axis.toml", *numbers, "--frequency", "5 Hz", "--encoder-noise", noise, "--json")
    assert code == 0
    # as they are proposed
    steps = json.loads("\n".join(lines))["next"]
    printed = {words[1]: words[1:] for step in steps for words in [step["command"].split()]}
    assert list(printed) == ["simulate", "sweep", "tune"]
    for command in commands:
        code, lines, _ = call(*printed[command])
        assert code == 0 and lines[-1].endswith("/report.html")
    if "simulate" in commands:
        metrics = json.loads(Path("results/axis_run/summary.json").read_text())["metrics"]
        assert metrics["motor.converged"] and metrics["load.converged"]
        trace, speed = pd.read_parquet("results/axis_run/trace.parquet"), KINDS[kind].items[4].read(sheet["--speed"]).value
        assert trace["motor.velocity"].abs().max() <= 1.02 * speed
        assert trace["u"].abs().max() <= KINDS[kind].items[3].read(sheet["--torque"]).value
        (expected,) = re.findall(r"^# Expect about (\S+) rad/s of velocity error", Path("axis.toml").read_text(), re.M)
        assert 1 / 1.5 < metrics["motor.velocity_rmse"] / float(expected) < 1.5
    if "sweep" in commands:
        shares = open_study("results/axis_map").frame["motor.converged"].mean()
        assert 0.05 < shares < 0.95
    if "tune" in commands:
        observer = tomllib.loads(Path("results/axis_gains/gains.toml").read_text())["observer"]
        assert observer["motor"]["alpha"] > 0.0 and ("load" in observer) == KINDS[kind].law
