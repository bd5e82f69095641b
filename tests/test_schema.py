"""The JSON schema of a study: takes every study that there is, refuses what is wrong, and says units and meanings."""

import json
import tomllib
from pathlib import Path

import jsonschema
import pytest
from small_study import ALPHA, listed_axis, rigid_study, small_study

from jaxbl.config import Config
from jaxbl.config.schema import build_schema
from jaxbl.drive.effects import EFFECTS

STUDIES = sorted((Path(__file__).parents[1] / "sweeps").glob("*.toml"))


@pytest.fixture(scope="module")
def schema_errors():
    """Faults of a study, by the schema."""
    jsonschema.Draft7Validator.check_schema(build_schema())
    validator = jsonschema.Draft7Validator(build_schema())
    return lambda data: [error.message for error in validator.iter_errors(data)]


@pytest.mark.parametrize("file", STUDIES, ids=lambda file: file.stem)
def test_it_takes_every_study(file, schema_errors):
    assert schema_errors(tomllib.loads(file.read_text(encoding="utf-8"))) == []


def test_it_takes_what_a_part_may_have(schema_errors):
    """An included file has the other keys; a column's name alone stands for a table."""
    for part in ({}, {"include": "a.toml", "drive": {"motor_inertia": 0.1}}, {"log": {"theta_e": "x", "u": 3}}):
        assert schema_errors(part) == []
    assert schema_errors(Config.model_validate(small_study(axes=[listed_axis(ALPHA, 1.0)])).to_dict()) == []


@pytest.mark.parametrize(
    "wrong",
    [
        {"runs": {}},
        rigid_study({"run.durations": 1.0}),
        rigid_study({"drive.motor_inertia": 0.0}),
        rigid_study({"drive.motor_inertia": "0.1"}),
        rigid_study({"excitation.kind": "sinus"}),
        rigid_study({"encoders.load_noise": -1.0}),
        rigid_study(effects=[{"kind": "motor.coulomb_friction"}]),
        rigid_study(effects=[{"kind": "motor.coulomb_friction", "torque": 1.0, "level": 2.0}]),
        rigid_study(axes=[{"values": [1.0]}]),
        {"log": {"theta_e": {"unit": "kg"}}},
        {"tune": {"compare": [{"name": "a", "motor": {"lambda": 1.0}}]}},
    ],
    ids=str,
)
def test_it_refuses_what_is_wrong(wrong, schema_errors):
    assert len(schema_errors(wrong)) >= 1


def test_it_says_units_and_meanings_and_knows_every_effect():
    schema = build_schema()
    text = json.dumps(schema)
    assert all(f'"const": "{kind}"' in text for kind in EFFECTS)
    assert '"null"' not in text
    assert schema["$defs"]["TwoInertia"]["properties"]["motor_inertia"]["description"] == "motor inertia J_e (kg m²)"
    for name, table in schema["$defs"].items():
        for key, description in table.get("properties", {}).items():
            assert "const" in description or "description" in description or "$ref" in description, f"{name}.{key}"


def test_the_command_prints_or_writes_it_and_overwrites_nothing(call, tmp_path):
    code, lines, _ = call("schema")
    assert code == 0 and json.loads("\n".join(lines)) == build_schema()
    assert call("schema", "--out", "jaxbl.json")[:2] == (0, [])
    assert json.loads((tmp_path / "jaxbl.json").read_text(encoding="utf-8")) == build_schema()
    with pytest.raises(ValueError, match=r"^jaxbl\.json: is there already; --out needs a new name$"):
        call("schema", "--out", "jaxbl.json")
