"""The TOML study: what is valid, what the messages about the rest say, and what it builds."""

import math
import re
import tomllib

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings
from small_study import ALPHA, LAMBDA, listed_axis, rigid_study, small_study, spaced_axis

from jaxbl import run, tune, verify
from jaxbl.config import numeric_paths, precision, prepare, read_config, with_values
from jaxbl.drive import EFFECTS, EXCITATIONS, TRANSMISSIONS, config_key, get_leaf, leaf_paths, parameters
from jaxbl.drive.plant import DRIVES
from jaxbl.errors import InputError
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.sweep import sweep

# the config of the design, all of its tables
EXAMPLE = """
title = "Motor observer gains, three noise levels"
[drive]
kind = "two_inertia"
motor_inertia = 0.05
motor_viscous = 0.15
load_inertia = 7.0
load_viscous = 16.0
gear_ratio = 5.0
[transmission]
law = "sigmoid_backlash"
stiffness = 1.0
dead_zone = 0.02
slope = 20.0
[[effects]]
kind = "motor.coulomb_friction"
torque = 0.02
[excitation]
kind = "sine"
amplitude = 0.1
frequency = 0.16
[encoders]
noise = 1e-4
motor_resolution = 0.0
load_resolution = 0.0
[observer]
discretisation = "implicit"
motor = { lambda = 4.0, alpha = 9.0 }
load = { lambda = 0.5, alpha = 0.2 }
[equivalent_control]
time_constant = 0.01
[identifier]
start = 2.0
regressor_filter = "matched"
forgetting = 1.0
[run]
duration = 20.0
sample_period = 1e-3
substeps = 10
precision = "float64"
[sweep]
seeds = 4
[uncertainty]
relative = 0.02
exact = ["drive.gear_ratio"]
[log]
hold = "zoh"
initial_state = "unknown"
[[axes]]
path = "observer.motor.alpha"
start = 2.0
stop = 40.0
num = 64
scale = "log"
[[axes]]
path = "observer.motor.lambda"
values = [1.0, 2.0]
[[axes]]
path = "encoders.noise"
values = [1e-5, 1e-4]
[[figures]]
kind = "heatmap"
x = "observer.motor.alpha"
y = "observer.motor.lambda"
value = "motor.velocity_rmse"
facet = "encoders.noise"
overlays = ["davila_fridman", "seeber_horn", "exact"]
"""

# a value in range for every parameter that has no default
NUMBERS = {
    "amplitude": 0.1,
    "frequency": 0.3,
    "start_frequency": 0.1,
    "stop_frequency": 2.0,
    "relative": 0.05,
    "delay": 0.01,
}

# effects by kind with every parameter given
TABLES = {
    name: {"kind": name}
    | {
        config_key(f.name): NUMBERS.get(f.name, 0.2)
        for f, _ in parameters(EFFECTS[name])
        if f.default != () and f.name != "turn"
    }
    for name in EFFECTS
}


def test_the_example_of_the_design_is_valid_and_comes_back_from_toml(tmp_path):
    (tmp_path / "a.toml").write_text(EXAMPLE)
    config = read_config(tmp_path / "a.toml")
    assert config.observer.motor.lambda_ == 4.0
    assert config.effects[0].torque == 0.02
    (tmp_path / "b.toml").write_text(config.to_toml())
    second = read_config(tmp_path / "b.toml")
    assert second.to_dict() == config.to_dict()
    # defaults are filled in
    assert tomllib.loads(config.to_toml())["run"]["position_tolerance"] == 1e-3


def test_byte_order_mark(tmp_path):
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbf" + EXAMPLE.encode())
    assert read_config(tmp_path / "a.toml").sweep.seeds == 4


A = ALPHA
BAD = {
    "unknown table": (small_study(drives={}), "unknown key 'drives'; did you mean 'drive'?"),
    "unknown key": (
        small_study({"drive.motor_inertai": 1.0}),
        "drive: unknown key 'motor_inertai'; did you mean 'motor_inertia'?",
    ),
    "unknown gain": (
        small_study({"observer.motor.lambda_": 1.0}),
        "observer.motor: unknown key 'lambda_'; did you mean 'lambda'?",
    ),
    "unknown key, none near": (small_study({"log.zzz": 1}), "log: unknown key 'zzz'; valid: kind, hold, initial_state"),
    "line break in a key": (small_study({"drive.a\nb": 1}), r"drive: unknown key 'a\nb'"),
    "line break in a tag": (
        small_study({"drive.kind": "a\nb"}),
        r"drive.kind: unknown kind 'a\nb'; valid: two_inertia, rigid",
    ),
    "key of another law": (small_study({"transmission.half_gap": 0.1}), "transmission: unknown key 'half_gap'"),
    "missing table": (small_study({"drive": None}), "drive: this key is missing"),
    "missing key": (small_study({"observer.motor.alpha": None}), "observer.motor.alpha: this key is missing"),
    "missing kind": (small_study({"excitation.kind": None}), "excitation: the key 'kind' is missing"),
    "unknown law": (small_study({"transmission.law": "sigmoid"}), "unknown law 'sigmoid'; did you mean 'sigmoid_backlash'?"),
    "unknown effect": (small_study(effects=[{"kind": "load.coulumb_friction"}]), "did you mean 'load.coulomb_friction'?"),
    "effect's key": (small_study(effects=[{"kind": "actuator.lag", "time": 1.0}]), "effects[0]: unknown key 'time'"),
    "effect's range": (
        small_study(effects=[TABLES["motor.cogging"], TABLES["actuator.lag"] | {"time_constant": 0.0}]),
        "effects[1].time_constant: should be greater than 0, not 0.0",
    ),
    "effects as a table": (small_study(effects=TABLES["actuator.lag"]), "effects: should be an array, not {"),
    "text for a number": (
        small_study({"drive.motor_inertia": "0.05"}),
        "motor_inertia: should be a valid number, not '0.05'",
    ),
    "truth for a number": (small_study({"drive.motor_inertia": True}), "motor_inertia: should be a valid number, not True"),
    "number for a table": (small_study(run=3), "run: should be a table, not 3"),
    "number for a text": (small_study(title=3), "title: should be a valid string, not 3"),
    "text for an array": (small_study(notes="a"), "notes: should be an array, not 'a'"),
    "part of a step": (small_study({"run.substeps": 2.5}), "run.substeps: should be a valid integer, not 2.5"),
    "nan": (small_study({"encoders.noise": float("nan")}), "encoders.noise: should be a finite number, not nan"),
    "inf": (small_study({"encoders.noise": float("inf")}), "encoders.noise: should be a finite number, not inf"),
    "endless integer": (
        small_study({"drive.motor_inertia": 10**400}),
        "should be a number of 64 bits, not 0x1b4ec7",
    ),
    "negative inertia": (
        small_study({"drive.motor_inertia": -1.0}),
        "drive.motor_inertia: should be greater than 0, not -1.0",
    ),
    "negative noise": (
        small_study({"encoders.noise": -1e-4}),
        "encoders.noise: should be greater than or equal to 0, not -0.0001",
    ),
    "forgetting": (small_study({"identifier.forgetting": 1.1}), "forgetting: should be less than or equal to 1, not 1.1"),
    "choice": (small_study({"run.precision": "float16"}), "run.precision: should be 'float64' or 'float32', not 'float16'"),
    "period over duration": (small_study({"run.sample_period": 0.5}), "sample_period 0.5 s is longer than duration 0.2 s"),
    "few samples": (small_study({"run.duration": 5e-3}), "holds only 5 samples of 0.001 s; at least 8 are needed"),
    "too many samples": (small_study({"run.duration": 1e9}), "holds more than 2e+09 samples of 0.001 s"),
    "rigid with transmission": (
        rigid_study(transmission={"law": "linear_shaft", "stiffness": 1.0}),
        "[transmission] has no meaning on a rigid drive; remove it, or use drive.kind = 'two_inertia'",
    ),
    "rigid with load observer": (
        rigid_study({"observer.load": {"lambda": 1.0, "alpha": 1.0}}),
        "observer.load has no meaning",
    ),
    "rigid with damping in a gear": (
        rigid_study(effects=[{"kind": "transmission.damping", "damping": 1.0}]),
        "effects[0]: transmission.damping has no meaning on a rigid drive",
    ),
    "rigid with load effect": (
        rigid_study(effects=[TABLES["load.inertia"]]),
        "effects[0]: load.inertia has no meaning on a rigid drive; it should be 'motor.inertia'",
    ),
    "no transmission": (small_study({"transmission": None}), "[transmission] is missing"),
    "no load observer": (small_study({"observer.load": None}), "observer.load is missing"),
    "exact path": (small_study({"uncertainty.exact": ["drive.gear_rati"]}), "nearest valid path: 'drive.gear_ratio'"),
    "start >= stop": (
        small_study(axes=[spaced_axis(A, 3.0, 2.0, 4)]),
        "axes[0]: axis observer.motor.alpha: start 3.0 should be less",
    ),
    "log through zero": (small_study(axes=[spaced_axis(A, 0.0, 2.0, 4)]), "a log scale needs start > 0, not 0.0"),
    "no values": (small_study(axes=[listed_axis(A)]), "axis observer.motor.alpha is empty"),
    "neither": (small_study(axes=[{"path": A, "num": 4}]), "should have values, or start and stop"),
    "both": (small_study(axes=[listed_axis(A, 1.0, num=4)]), "has both values and start/stop/num"),
    "one of two ends": (small_study(axes=[spaced_axis(A, 1.0, 2.0, 1)]), "num = 1 cannot span start ... stop"),
    "value twice": (small_study(axes=[listed_axis(A, 1, 1.0)]), "lists a value twice"),
    "truth among values": (
        small_study(axes=[listed_axis(A, True)]),
        "axes[0].values[0]: should be a valid number, not True",
    ),
    "values of no kind": (
        small_study(axes=[listed_axis(A, [1.0])]),
        "axes[0].values[0]: should be a valid number, not [1.0]",
    ),
    "two axes on one path": (
        small_study(axes=[listed_axis(A, 1.0), listed_axis(A, 2.0)]),
        "axes[1]: path 'observer.motor.alpha' has an axis",
    ),
    "unknown path": (
        small_study(axes=[listed_axis("observer.motor.alfa", 1.0)]),
        "axes[0]: unknown path 'observer.motor.alfa'; nearest valid path: 'observer.motor.alpha'",
    ),
    "path of a table": (
        small_study(axes=[listed_axis("observer.motor", 1.0)]),
        "nearest valid path: 'observer.motor.alpha'",
    ),
    "path of a choice": (small_study(axes=[listed_axis("drive.kind", "rigid")]), "axes[0]: unknown path 'drive.kind'"),
    "path of two effects": (
        small_study(effects=[TABLES["actuator.lag"]] * 2, axes=[listed_axis("effects.actuator.lag.time_constant", 1.0)]),
        "unknown path 'effects.actuator.lag.time_constant'; nearest valid path: 'effects.1.time_constant'",
    ),
    "axis out of range": (
        small_study(axes=[spaced_axis(A, -3.0, 2.0, 4, "linear")]),
        "axes[0]: observer.motor.alpha: should be greater",
    ),
    "axis value out of range": (
        small_study(axes=[listed_axis(A, 2.0, -1.0)]),
        "should be greater than or equal to 0, not -1.0",
    ),
    "words on a numeric axis": (
        small_study(axes=[listed_axis(A, "a")]),
        "observer.motor.alpha: should be a valid number, not 'a'",
    ),
    "parts of a step": (
        small_study(axes=[spaced_axis("run.substeps", 1, 4, 3, "linear")]),
        "run.substeps: should be a valid integer, not 2.5",
    ),
    "num missing": (small_study(axes=[spaced_axis(A, 1.0, 2.0)]), "axes[0]: num is missing for 'observer.motor.alpha'"),
    "endless grid": (
        small_study(
            axes=[spaced_axis(f"observer.{p}", 1.0, 2.0, 10**5) for p in ("motor.alpha", "motor.lambda", "load.alpha")]
        ),
        "axes: 1e+15 runs are more than 1e+10",
    ),
    "zip of unequal length": (
        small_study(axes=[listed_axis(A, 1.0, 2.0, zip="g"), listed_axis(LAMBDA, 1.0, zip="g")]),
        "'observer.motor.lambda' has 1 values, the others zipped as 'g' have 2",
    ),
    "zip alone": (
        small_study(axes=[listed_axis(A, 1.0), listed_axis(LAMBDA, 1.0, zip=A)]),
        "zip = 'observer.motor.alpha' should stand on two axes",
    ),
    "zipped point twice": (
        small_study(axes=[listed_axis(A, 1.0, 1.0, zip="g"), listed_axis(LAMBDA, 2.0, 2.0, zip="g")]),
        "the axes zipped as 'g' list a point twice",
    ),
    "points of a grid": (small_study(sweep={"points": 4}), "sweep.points belongs to design"),
    "design without points": (
        small_study(sweep={"design": "sobol"}, axes=[spaced_axis(A, 1.0, 2.0)]),
        "sweep.points is missing",
    ),
    "design without range": (
        small_study(sweep={"design": "sobol", "points": 4}, axes=[listed_axis(A, 1.0)]),
        "sweep.design: 'sobol' needs",
    ),
    "design over structure": (
        small_study(sweep={"design": "sobol", "points": 4}, axes=[spaced_axis("run.duration", 1.0, 2.0)]),
        "'run.duration' is fixed at compile time; list its values",
    ),
    "design with zip": (
        small_study(sweep={"design": "sobol", "points": 4}, axes=[spaced_axis(A, 1.0, 2.0, zip="g")]),
        "is sampled quasi-randomly and cannot be zipped",
    ),
    "heatmap without y": (
        small_study(figures=[{"kind": "heatmap", "x": A, "value": "finite"}]),
        "figures[0]: a heatmap needs y",
    ),
    "line with y": (
        small_study(figures=[{"kind": "line", "x": A, "y": LAMBDA, "value": "finite"}]),
        "a line has no y; use series",
    ),
    "heatmap with series": (
        small_study(figures=[{"kind": "heatmap", "x": A, "y": LAMBDA, "series": "a", "value": "finite"}]),
        "a heatmap has no series; use facet",
    ),
    "axis used twice": (
        small_study(figures=[{"kind": "heatmap", "x": A, "y": A, "value": "finite"}]),
        "observer.motor.alpha is used twice",
    ),
    "overlays over two observers": (
        small_study(
            figures=[{"kind": "heatmap", "x": A, "y": "observer.load.lambda", "value": "finite", "overlays": ["exact"]}]
        ),
        "overlays need a map over alpha and lambda of one observer",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_config_gets_one_line_that_says_where_and_what(case):
    data, message = BAD[case]
    with pytest.raises(InputError) as error:
        Points(read_config(data))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


FILES = {
    "missing": (None, "no such file"),
    "binary": (b"\xff\xfe\x00", "is not text in UTF-8"),
    "no TOML": (b"[drive\nkind=1", "not valid TOML: Expected ']' at the end of a table declaration (at line 1, column 7)"),
    "wrong key": (b"[drvie]", "unknown key 'drvie'; did you mean 'drive'?"),
}


@pytest.mark.parametrize("case", FILES)
def test_bad_file_is_named(tmp_path, case):
    content, message = FILES[case]
    path = tmp_path / "study.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError) as error:
        read_config(path)
    assert str(error.value).startswith(f"{path}: ")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_folder_instead_of_a_file(tmp_path):
    with pytest.raises(InputError, match="is a folder; a TOML file is needed"):
        read_config(tmp_path)


# ---------------------------------------------------------------- recorded excitation


def read_recorded_input(path, **keys):
    return read_config(small_study(excitation={"kind": "recorded", "file": str(path), **keys}))


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_recorded_excitation_is_found_beside_the_config_and_starts_at_zero(tmp_path, suffix):
    frame = pd.DataFrame({"time": [5.0, 5.1, 5.2], "torque": [1.0, 2.0, 3.0]})
    (tmp_path / "sub").mkdir()
    file = tmp_path / "sub" / f"drive{suffix}"
    frame.to_csv(file) if suffix == ".csv" else frame.to_parquet(file)
    names = {"time_column": "time", "torque_column": "torque", "gain": 0.5}
    config = read_config(small_study(excitation={"kind": "recorded", "file": f"sub/drive{suffix}", **names}))
    (tmp_path / "study.toml").write_text(config.to_toml())
    excitation = read_config(tmp_path / "study.toml").build().excitation
    np.testing.assert_allclose(excitation.times, [0.0, 0.1, 0.2], atol=1e-12)
    np.testing.assert_array_equal(excitation.torques, [1.0, 2.0, 3.0])
    assert excitation.gain == 0.5


RECORDS = {
    "missing": (None, {}, "no such file"),
    "empty": ("", {}, "is empty"),
    "no rows": ("t,u\n", {}, "has a header and no rows"),
    "no column": ("t,torqe\n0,1\n", {"torque_column": "torque"}, "no column 'torque'; did you mean 'torqe'?"),
    "text": ("t,u\n0,1\n1,abc\n", {}, "column 'u', data row 2 is 'abc'; it should be a finite number"),
    "gap": ("t,u\n0,1\n1,\n", {}, "column 'u', data row 2 is empty or not a number"),
    "time stands": ("t,u\n0,1\n1,1\n1,2\n", {}, "column 't', data row 3: times should increase"),
}


@pytest.mark.parametrize("case", RECORDS)
def test_bad_record_is_named_with_column_and_row(tmp_path, case):
    content, keys, message = RECORDS[case]
    path = tmp_path / "record.csv"
    if content is not None:
        path.write_text(content)
    with pytest.raises(InputError) as error:
        read_recorded_input(path, **keys).build()
    assert str(error.value).startswith(f"{path}: ")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_binary_file_is_no_parquet(tmp_path):
    (tmp_path / "record.parquet").write_bytes(b"nothing")
    with pytest.raises(InputError, match="has a header and no rows"):
        read_recorded_input(tmp_path / "record.parquet").build()


# ---------------------------------------------------------------- generated tables


def parameter_table(section, tag, name, module):
    """A table with every parameter of a module given."""
    numbers = {}
    for field, parameter in parameters(module):
        default = field.default if isinstance(field.default, int | float | str) else NUMBERS.get(field.name, 0.2)
        numbers[config_key(field.name)] = default
        assert parameter.doc
    return {tag: name, **numbers}


@pytest.mark.parametrize(
    ("section", "tag", "name", "module"),
    [("drive", "kind", name, module) for name, module in DRIVES.items()]
    + [("transmission", "law", name, module) for name, module in TRANSMISSIONS.items()]
    + [("excitation", "kind", name, module) for name, module in EXCITATIONS.items() if name != "recorded"],
)
def test_every_module_has_the_table_of_its_parameters(section, tag, name, module):
    numbers = parameter_table(section, tag, name, module)
    data = (rigid_study if name == "rigid" else small_study)(**{section: numbers})
    config = read_config(data)
    part = getattr(config.build(), section)
    assert type(part) is module
    for field, _ in parameters(module):
        assert getattr(part, field.name) == numbers[config_key(field.name)]
        parameter = parameters_by_name(module)[field.name]
        if parameter.above is not None or parameter.minimum is not None:
            bad_number = parameter.above if parameter.above is not None else parameter.minimum - 1
            with pytest.raises(InputError, match=f"{section}.{config_key(field.name)}: should be"):
                read_config(data | {section: numbers | {config_key(field.name): bad_number}})


def parameters_by_name(module):
    return {field.name: parameter for field, parameter in parameters(module)}


@pytest.mark.parametrize("name", TABLES)
def test_every_effect_is_built_with_its_numbers_and_its_name(name):
    config = read_config(small_study(effects=[TABLES[name]]))
    (effect,) = config.build().effects
    assert isinstance(effect, EFFECTS[name])
    assert effect.name == name
    for key, value in TABLES[name].items():
        if key != "kind":
            assert getattr(effect, key) == value
            new = 0.5 * value if key == "delay" else 0.7
            changed_config = with_values(config, {f"effects.{name}.{key}": new})
            assert getattr(changed_config.build().effects[0], key) == new


TABULATED = {"kind": "motor.tabulated", "positions": [0.0, 1.0], "position_torques": [0.1, 0.2], "turn": True}


def test_a_table_of_torques_is_built_and_no_axis_goes_over_it():
    config = read_config(small_study(effects=[TABULATED]))
    (effect,) = config.build().effects
    assert effect.positions == (0.0, 1.0) and effect.position_torques == (0.1, 0.2) and effect.turn and effect.speeds == ()
    assert not any("tabulated" in path for path in (*numeric_paths(config), *leaf_paths(config.build())))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": [0.0]}, "position_torques has 2 numbers; it should have one for each of 1 positions"),
        ({"positions": [1.0, 1.0]}, "positions should increase"),
        ({"speeds": [1.0]}, "speed_torques has 0 numbers; it should have one for each of 1 speeds"),
    ],
)
def test_a_wrong_table_of_torques_is_refused(change, message):
    with pytest.raises(InputError, match=re.escape(f"effects[0]: motor.tabulated: {message}")):
        read_config(small_study(effects=[TABULATED | change]))


@pytest.mark.parametrize(
    "data", [small_study(effects=[TABLES["motor.cogging"], *[TABLES["load.gravity"]] * 2]), rigid_study()]
)
def test_leaves_of_the_experiment_have_the_paths_of_the_config(data):
    config = read_config(data)
    experiment = config.build()
    numbers, leaves = numeric_paths(config), leaf_paths(experiment)
    if data["drive"]["kind"] == "rigid":  # what one inertia has no use for
        leaves = {path: leaf for path, leaf in leaves.items() if "load" not in path}
    assert set(leaves) <= set(numbers)
    for path, leaf in leaves.items():
        assert numbers[path].unit == leaf.unit
        assert numbers[path].doc
        changed_config = with_values(config, {path: 0.625})
        assert get_leaf(changed_config.build(), path) == 0.625, path
    structural = {
        "encoders.missed",
        "observer.discretisation",
        "observer.kind",
        "run.duration",
        "run.sample_period",
        "run.substeps",
    }
    absent = {"encoders.load_noise", "identifier.regressor_filter"} if experiment.identifier else set()
    assert set(numbers) - set(leaves) == structural | absent


def test_with_values_names_the_nearest_path_and_takes_whole_numbers():
    config = read_config(small_study())
    assert with_values(config, {"run.substeps": 4.0}).run.substeps == 4
    assert with_values(config, {"encoders.load_noise": 1e-5}).build().encoders.load_noise == 1e-5
    assert config.run.substeps == 1
    with pytest.raises(InputError, match=r"unknown path 'motor\.alpha'; nearest valid path: 'observer\.motor\.alpha'"):
        with_values(config, {"motor.alpha": 1.0})


# ---------------------------------------------------------------- anything else

ANY_VALUE = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=5),
    st.sampled_from(["grid", "sobol", "rigid", "linear_shaft", "float32", "motor.inertia", A, "log", "line", "finite"]),
    st.lists(st.floats(), max_size=3),
    st.dictionaries(st.sampled_from(["kind", "path", "values", "alpha", "x", "y\n"]), st.floats() | st.text(max_size=3)),
)
COMPLETE_STUDY = read_config(tomllib.loads(EXAMPLE)).to_dict()


def list_keys(data, prefix=()):
    """Every key and index of a nested config."""
    for key, value in data.items() if isinstance(data, dict) else enumerate(data):
        yield (*prefix, key)
        if isinstance(value, dict | list):
            yield from list_keys(value, (*prefix, key))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.lists(
        st.tuples(st.sampled_from(list(list_keys(COMPLETE_STUDY))), ANY_VALUE, st.none() | st.text(max_size=3)),
        min_size=1,
        max_size=3,
    )
)
def test_any_mutation_is_valid_or_an_input_error_of_one_line(mutations):
    data = read_config(COMPLETE_STUDY).to_dict()
    for place, junk, new_key in mutations:
        target = data
        for key in place[:-1]:
            try:
                target = target[key]
            except (KeyError, IndexError, TypeError):
                break
        else:
            if isinstance(target, dict):
                target[place[-1] if new_key is None else new_key] = junk
            elif isinstance(target, list) and place[-1] in range(len(target)):
                target[place[-1]] = junk
    try:
        config = read_config(data)
        Points(config)
    except InputError as error:
        message = str(error)
    else:
        message = ""
        assert read_config(tomllib.loads(config.to_toml())).to_dict() == config.to_dict()
    assert message.isprintable()


def test_inertia_effects_must_leave_some():
    with pytest.raises(InputError, match=r"motor.inertia leaves a total inertia of .* on the motor"):
        read_config(rigid_study(effects=[{"kind": "motor.inertia", "inertia": -1e3}]))


def test_a_delay_lasts_no_longer_than_what_is_kept():
    delay = [{"kind": "actuator.delay", "delay": 0.0161}]
    with pytest.raises(InputError, match=r"effects\[0\]: actuator.delay: delay: 0.0161 s .* at most 0.016 s"):
        read_config(rigid_study({"run.sample_period": 1e-3}, effects=delay))


def write_files(folder, **texts):
    """TOML files by name; `base` has the rigid drive without gains."""
    data = rigid_study({"observer": None})
    for name, text in {"base": tomli_w.dumps(data), **texts}.items():
        path = folder / f"{name}.toml"
        path.parent.mkdir(exist_ok=True, parents=True)
        path.write_text(text)
    return folder


def test_included_tables_are_merged_key_by_key(tmp_path):
    write_files(
        tmp_path,
        gains="[observer.motor]\nlambda = 1.0\nalpha = 2.0\n[run]\nduration = 0.3\n",
        later="[observer.motor]\nalpha = 3.0\n",
        main='include = ["base.toml", "gains.toml", "later.toml"]\n[observer.motor]\nvelocity_error = 0.25\n',
    )
    config = read_config(tmp_path / "main.toml")
    observer = config.observer.motor
    assert (observer.lambda_, observer.alpha, observer.velocity_error) == (1.0, 3.0, 0.25)
    assert (config.run.duration, config.run.substeps) == (0.3, 1)
    assert "include" not in config.to_dict() and "include" not in config.to_toml()
    (tmp_path / "resolved.toml").write_text(config.to_toml())
    assert read_config(tmp_path / "resolved.toml").to_dict() == config.to_dict()


def test_keys_of_the_including_file_win_and_tables_of_another_kind_replace(tmp_path):
    write_files(
        tmp_path,
        main='include = "base.toml"\n[observer.motor]\nlambda = 1.0\nalpha = 2.0\n'
        '[excitation]\nkind = "prbs"\namplitude = 0.3\nhold = 0.01\n[run]\nduration = 0.4\n',
        same='include = "main.toml"\n[excitation]\namplitude = 0.5\n',
    )
    config = read_config(tmp_path / "main.toml")
    assert config.run.duration == 0.4
    assert (config.excitation.kind, config.excitation.hold) == ("prbs", 0.01)
    # a file may include one that includes
    config = read_config(tmp_path / "same.toml")
    assert (config.excitation.kind, config.excitation.amplitude, config.excitation.hold) == ("prbs", 0.5, 0.01)


def test_files_of_an_included_file_are_relative_to_it(tmp_path, monkeypatch):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "log.csv").write_text("t,u\n0,0\n1,1\n")
    recorded = 'kind = "recorded"\nfile = "log.csv"\n'
    write_files(
        tmp_path,
        **{"parts/input": f"[excitation]\n{recorded}[tune.holdout]\n{recorded}"},
        main='include = ["base.toml", "parts/input.toml"]\n[observer.motor]\nlambda = 1.0\nalpha = 2.0\n',
    )
    config = read_config(tmp_path / "main.toml")
    for excitation in (config.excitation, config.tune.holdout):
        assert excitation.file == str(tmp_path / "parts" / "log.csv")
    # of a mapping: relative to the working directory
    monkeypatch.chdir(tmp_path)
    inputs = {"include": ["base.toml", "parts/input.toml"], "observer": {"motor": {"lambda": 1.0, "alpha": 2.0}}}
    assert read_config(inputs).excitation.file == str(tmp_path / "parts" / "log.csv")
    assert inputs["include"] == ["base.toml", "parts/input.toml"]


GAINS = "[observer.motor]\nlambda = 1.0\nalpha = 2.0\n"
BAD_INCLUDES = {
    "missing": ({"main": 'include = "none.toml"\n'}, "main.toml: include: {0}/none.toml: no such file"),
    "missing, nested": (
        {"main": 'include = "a.toml"\n', "a": 'include = "none.toml"\n'},
        "a.toml: include: {0}/none.toml: no such file",
    ),
    "itself": ({"main": 'include = "main.toml"\n'}, "main.toml: include: {0}/main.toml includes this file in turn"),
    "cycle": (
        {"main": 'include = "a.toml"\n', "a": 'include = "main.toml"\n'},
        "a.toml: include: {0}/main.toml includes this file in turn; files should not include one another",
    ),
    "no name": ({"main": "include = 3\n"}, "main.toml: include: should be a file name or an array of them, not 3"),
    "no names": ({"main": "include = [3]\n"}, "main.toml: include: should be a file name or an array of them, not [3]"),
    "a folder": ({"main": 'include = "."\n'}, "{0}: is a folder; a TOML file is needed"),
    "unknown key": (
        {"main": f'include = ["base.toml", "a.toml"]\n{GAINS}', "a": "[run]\ndurations = 1.0\n"},
        "a.toml: run: unknown key 'durations'; did you mean 'duration'?",
    ),
    "unknown table": (
        {"main": f'include = ["base.toml", "a.toml"]\n{GAINS}', "a": "[runs]\nduration = 1.0\n"},
        "a.toml: unknown key 'runs'; did you mean 'run'?",
    ),
    "value, nested": (
        {
            "main": f'include = "a.toml"\n{GAINS}',
            "a": 'include = ["base.toml", "b.toml"]\n',
            "b": "[run]\nduration = -1.0\n",
        },
        "b.toml: run.duration: should be greater than 0, not -1.0",
    ),
    "value that is overruled by a wrong one": (
        {"main": f'include = ["base.toml", "a.toml"]\n{GAINS}[run]\nduration = -2.0\n', "a": "[run]\nduration = 1.0\n"},
        "main.toml: run.duration: should be greater than 0, not -2.0",
    ),
    "value in an array": (
        {
            "main": f'include = ["base.toml", "a.toml"]\n{GAINS}',
            "a": '[[axes]]\npath = "drive.motor_inertia"\nvalues = []\n',
        },
        "a.toml: axes[0]: axis drive.motor_inertia is empty",
    ),
    "incomplete": (
        {"main": 'include = "base.toml"\n[observer.motor]\nlambda = 1.0\n'},
        "main.toml: observer.motor.alpha: this key is missing",
    ),
    "bad TOML": ({"main": 'include = "a.toml"\n', "a": "a b"}, "a.toml: not valid TOML"),
}


@pytest.mark.parametrize("case", BAD_INCLUDES)
def test_bad_includes_are_one_line_that_names_the_file(case, tmp_path):
    texts, message = BAD_INCLUDES[case]
    write_files(tmp_path, **texts)
    with pytest.raises(InputError) as error:
        read_config(tmp_path / "main.toml")
    assert message.format(tmp_path) in str(error.value)
    assert str(error.value).startswith(str(tmp_path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda config: setattr(config.observer.motor, "lambda_", -5.0), "observer.motor.lambda: should be greater than or"),
        (lambda config: setattr(config.run, "duration", math.nan), "run.duration: should be a finite number, not nan"),
        (lambda config: setattr(config.run, "sample_period", 100.0), "run: sample_period 100.0 s is longer than duration"),
        (lambda config: setattr(config, "effects", [{"kind": "motor.magic"}]), "effects[0].kind: unknown kind"),
        (lambda config: setattr(config, "drive", "rigid"), "drive: should be a table, not 'rigid'"),
    ],
)
def test_attributes_that_are_set_are_checked_before_a_run(change, message):
    config = read_config(small_study())
    change(config)
    for command in (read_config, run, sweep, tune, verify):
        with pytest.raises(InputError, match=re.escape(f"config: {message}")):
            command(config)


def test_a_copy_with_other_attributes_is_checked():
    config = read_config(small_study())
    longer = read_config(config.model_copy(update={"run": config.run.model_copy(update={"duration": 3.0})}))
    assert longer.run.duration == 3.0
    with pytest.raises(InputError, match=re.escape("config: run.substeps: should be greater than or equal to 1, not 0")):
        run(config.model_copy(update={"run": config.run.model_copy(update={"substeps": 0})}))


@pytest.mark.parametrize("array", [np.array, jnp.array])
def test_arrays_and_numbers_of_numpy_are_taken(array):
    listed = small_study(axes=[listed_axis(LAMBDA, 1.0, 2.0), listed_axis(ALPHA, 3.0)])
    arrays = small_study(axes=[{"path": LAMBDA, "values": array([1.0, 2.0])}, {"path": ALPHA, "values": array([3.0])}])
    assert read_config(arrays) == read_config(listed)
    spaced = {"path": LAMBDA, "start": np.float32(1.0), "stop": np.int64(9), "num": np.int64(3)}
    assert read_config(small_study(axes=[spaced])).axes[0].grid().tolist() == [1.0, 5.0, 9.0]
    with pytest.raises(InputError, match=re.escape("axes[0].values[0]: should be a valid number, not [1.0, 1.0]")):
        read_config(small_study(axes=[{"path": LAMBDA, "values": array([[1.0, 1.0]])}]))


def test_an_experiment_has_the_precision_of_its_study():
    config = read_config(small_study())
    for other in ("float64", "float32"):
        study = config.with_keys("run", precision=other)
        with precision(study):
            assert prepare(study).run.sample_period.dtype == other
    with jax.enable_x64(False), pytest.raises(InputError, match="is float64, and JAX computes in float32 here"):
        prepare(config)


def test_first_seed_shifts_the_noise():
    early, late = (
        sweep(rigid_study(sweep={"seeds": seeds, "first_seed": first})).frame for seeds, first in ((4, 0), (2, 2))
    )
    assert list(late["seed"]) == [2, 3]
    for column in late.columns:
        np.testing.assert_array_equal(late[column], early[column].iloc[2:])
