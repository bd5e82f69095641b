"""Exported C: bit for bit the traced step, on this machine's compilers at all levels, and near the replay in JAX."""

import functools
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import own_drive
import pytest
from native import COMPILERS, STRICT, UNCONTRACTED, Native, draw_samples, run_program, to_integers
from small_study import small_study
from strict import Strict
from structured_text import FunctionBlock

import jaxbl
from jaxbl.chain import replay
from jaxbl.config import read_config
from jaxbl.drive.parameters import as_arrays
from jaxbl.errors import InputError
from jaxbl.exports.chain import build_observer_chain
from jaxbl.exports.targets import TARGETS
from jaxbl.observer import OBSERVERS

GAINS = {
    "lambda": 4.0, "alpha": 9.0, "bandwidth": 150.0, "damping": 0.8, "position_noise": 1e-4, "disturbance_noise": 100.0,
    "time_constant": 0.004, "lipschitz": 50.0,
}  # fmt: skip


def study(kind="super_twisting", **tables):
    observer = {"kind": kind, "motor": GAINS, "load": GAINS} | tables.pop("observer", {})
    return small_study(identifier={"start": 0.1}, observer=observer, **tables)


def export_native(tmp_path, data, precision="double", **flags):
    jaxbl.export(data, tmp_path, precision=precision, name="drive")
    return Native(tmp_path, **flags)


@pytest.fixture(scope="module")
def exported_code(tmp_path_factory):
    """Folder of the code of a kind of observer in a precision, and the code compiled without optimisation."""

    @functools.cache
    def export_once(precision, kind="super_twisting"):
        folder = tmp_path_factory.mktemp("code")
        return folder, export_native(folder, study(kind), precision, flags=("-O0", *UNCONTRACTED))

    return export_once


def run_native(native, inputs):
    native.start(inputs[0, 1:])
    return native.run(inputs)


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("level", ["-O0", "-O1", "-O2", "-O3"])
@pytest.mark.parametrize("precision", ["double", "float"])
def test_all_compilers_and_levels_give_the_same_bits(exported_code, compiler, level, precision):
    inputs, (folder, plain) = draw_samples(3000, 2), exported_code(precision)
    first = run_native(plain, inputs)
    result = run_native(Native(folder, compiler=compiler, flags=(level, *UNCONTRACTED)), inputs)
    assert np.isfinite(result).all()
    assert (to_integers(result) == to_integers(first)).all()


def run_strict(data, precision, inputs):
    dtype = np.dtype(np.float32 if precision == "float" else np.float64)
    block = Strict(build_observer_chain(read_config(data), "drive", dtype))
    state, rows = block.start(inputs[0, 1:].astype(dtype)), []
    for row in inputs.astype(dtype):
        state, out = block.step(state, list(row) if precision == "float" else row.tolist())
        rows.append([dtype.type(x) for x in out])
    return np.array(rows, dtype)


@pytest.mark.program("gcc")
@pytest.mark.parametrize("kind", OBSERVERS)
@pytest.mark.parametrize("precision", ["double", "float"])
def test_every_kind_is_the_traced_step_bit_for_bit(exported_code, kind, precision):
    inputs = draw_samples(400, 2)
    _, native = exported_code(precision, kind)
    assert native.size == native.summary["state_bytes"]
    actual, expected = run_native(native, inputs), run_strict(study(kind), precision, inputs)
    assert (to_integers(actual) == to_integers(expected)).all()


@pytest.mark.program("gcc")
def test_many_steps_are_the_traced_step_bit_for_bit(exported_code, repeats):
    inputs = draw_samples(repeats(20_000, 1_000_000), 2)
    _, native = exported_code("double")
    assert (to_integers(run_native(native, inputs)) == to_integers(run_strict(study(), "double", inputs))).all()


CONTROLLERS = {
    "cascade": {"side": "load", "position_gain": 8.0, "speed_gain": 0.5, "integral_time": 0.1, "torque_limit": 0.3,
                "torque_rate": 50.0, "speed_limit": 3.0, "gap_compensation": 0.01, "friction_feedforward": 0.02},
    "state_feedback": {"motor_position": 3.0, "motor_velocity": 0.5, "load_velocity": 0.2},
    "knowing": {"kind": "cascade", "position_gain": 8.0, "speed_gain": 0.5, "gap_compensation": 0.01, "gap_from": "twist",
                "effects_feedforward": 0.9},
}  # fmt: skip


@pytest.mark.program("gcc")
@pytest.mark.parametrize("kind", CONTROLLERS)
def test_observer_and_controller_are_one_function(tmp_path, kind):
    """Given the readings and targets of a simulated loop, the code asks for the torques of that loop."""
    loop = {"controller": {"kind": kind} | CONTROLLERS[kind],
            "reference": {"kind": "moves", "distance": 0.3, "duration": 0.2},
            "excitation": {"kind": "sine", "amplitude": 0.0, "frequency": 1.0}}  # fmt: skip
    loop["effects"] = [
        {"kind": "motor.cogging", "amplitude": 0.02, "harmonic": 6.0}, {"kind": "load.coulomb_friction", "torque": 0.05},
    ]  # fmt: skip
    data = study("extended_state", **loop)
    signals = jaxbl.simulate(jaxbl.experiment(data))
    inputs = np.stack([signals.input, signals.motor.measured, signals.load.measured, *signals.target], axis=1)
    native = export_native(tmp_path, data)
    # where the simulated observers start
    native.start([signals.motor.true.position[0], signals.load.true.position[0]])
    outputs = native.run(inputs)
    names = [output["name"] for output in native.summary["outputs"]]
    assert [port["name"] for port in native.summary["inputs"]][3:] == [
        "target_position", "target_velocity", "target_acceleration"
    ]  # fmt: skip
    torque = outputs[:, names.index("controller_torque")]
    assert np.ptp(torque) > 0.2
    np.testing.assert_allclose(torque[:-1], signals.input[1:], rtol=1e-9, atol=1e-9)
    # in structured text as well
    jaxbl.export(data, tmp_path / "st", "st", name="drive")
    block, ports = FunctionBlock((tmp_path / "st" / "drive.st").read_text()), native.summary["inputs"]
    native.start(inputs[0, 1:3])
    torque = native.run(inputs)[:, names.index("controller_torque")]
    found = [block(**{port["name"]: x for port, x in zip(ports, row, strict=True)}) for row in inputs[:100]]
    np.testing.assert_array_equal([row["controller_torque"] for row in found], torque[:100])

    folder = tmp_path / "again"
    jaxbl.export(data, folder, name="drive")
    run_program("gcc", *STRICT, *UNCONTRACTED, "-O2", "drive.c", "drive_filter.c", "-lm", "-o", "filter", cwd=folder)
    columns = "t,u,theta_e,theta_s,target_position,target_velocity,target_acceleration"
    rows = np.column_stack([signals.time, inputs])
    np.savetxt(folder / "log.csv", rows, fmt="%.17g", delimiter=",", header=columns, comments="")
    run_program(folder / "filter", "log.csv", "found.csv", cwd=folder)
    found = np.genfromtxt(folder / "found.csv", delimiter=",", names=True)
    assert (found["controller_torque"] == torque).all()


@pytest.mark.program("gcc")
@pytest.mark.parametrize("kind", ["cascade", "state_feedback"])
def test_a_controller_in_float_is_as_good_many_turns_away(tmp_path, kind):
    loop = {"controller": {"kind": kind, "side": "load"} | CONTROLLERS[kind],
            "reference": {"kind": "moves", "distance": 0.3, "duration": 0.2},
            "excitation": {"kind": "sine", "amplitude": 0.0, "frequency": 1.0}}  # fmt: skip
    data = study("extended_state", **loop)
    signals = jaxbl.simulate(jaxbl.experiment(data))
    inputs = np.stack([signals.input, signals.motor.measured, signals.load.measured, *signals.target], axis=1)
    # the load turns 10 000 times; the motor turns with it
    turn = 2.0 * np.pi * 1e4 * np.array([0.0, data["drive"]["gear_ratio"], 1.0, 1.0, 0.0, 0.0])
    native = export_native(tmp_path, data, "float")
    native.dtype = np.dtype(float)
    place = [output["name"] for output in native.summary["outputs"]].index("controller_torque")
    near, away = (run_native(native, inputs + shift)[:, place] for shift in (0.0, turn))
    np.testing.assert_allclose(away, near, atol=2e-3 * np.ptp(near))


def test_waves_over_whole_angles_are_not_for_float(tmp_path):
    reference = {"kind": "sine", "amplitude": 1.0, "frequency": 1.0}
    data = study("extended_state", controller=CONTROLLERS["knowing"], reference=reference)
    with pytest.raises(jaxbl.InputError, match=r"precision: .*effects_feedforward takes waves at whole angles"):
        jaxbl.export(data, tmp_path / "out", precision="float")


@pytest.mark.program("gcc")
@pytest.mark.parametrize("precision", ["double", "float"])
def test_a_standstill_leaves_the_last_numbers(tmp_path, precision):
    data = study() | {"identifier": {"forgetting": 0.99}}
    inputs = draw_samples(4000, 2)
    # held under load: the torque that friction takes over is none of the law's
    inputs[2000:] = inputs[2000] * [20.0, 1.0, 1.0] + 1e-5 * np.random.default_rng(3).standard_normal((2000, 3))
    native = export_native(tmp_path, data, precision)
    outputs = run_native(native, inputs)
    assert (to_integers(outputs[-1]) == to_integers(run_strict(data, precision, inputs)[-1])).all()
    columns = dict(zip((output["name"] for output in native.summary["outputs"]), outputs.T, strict=True))
    for side in ("motor", "load"):
        assert columns[f"{side}_identified"][[1999, -1]].all()
        before, *after = columns[f"{side}_stiffness"][[1999, 2500, -1]]
        np.testing.assert_allclose(after, before, rtol=0.3)


def draw_faults(inputs, random):
    """Samples with readings and inputs that are not finite, alone and in a row, the first one perhaps among them."""
    faulty = inputs.copy()
    for _ in range(random.integers(1, 5)):
        first, column = random.integers(0, len(inputs) - 50), random.integers(0, inputs.shape[1])
        faulty[first * (random.random() > 0.2) :][: random.integers(1, 20), column] = random.choice(
            [np.nan, np.inf, -np.inf]
        )
    return faulty


@pytest.mark.program("gcc")
@pytest.mark.parametrize("precision", ["double", "float"])
@pytest.mark.parametrize("kind", ["super_twisting", "kalman", "differentiator_3", "dirty_derivative"])
def test_a_reading_that_is_not_finite_is_a_missed_one(exported_code, kind, precision, repeats):
    (_, native), random = exported_code(precision, kind), np.random.default_rng(46)
    inputs = draw_samples(400, 2)
    names = [output["name"] for output in native.summary["outputs"]]
    usual = dict(zip(names, run_native(native, inputs).T, strict=True))
    assert not usual["motor_missed"].any() and not usual["load_missed_samples"].any()
    for _ in range(repeats(3, 50)):
        faulty = draw_faults(inputs, random)
        outputs = run_native(native, faulty)
        assert np.isfinite(outputs).all()
        assert (to_integers(outputs) == to_integers(run_strict(study(kind), precision, faulty))).all()
        columns = dict(zip(names, outputs.T, strict=True))
        for i, side in enumerate(("motor", "load"), 1):
            missed = ~np.isfinite(faulty[:, [0, i]]).all(axis=1)
            assert (columns[f"{side}_missed"] == missed).all()
            assert (columns[f"{side}_missed_samples"] == np.cumsum(missed)).all()
            held = columns[f"{side}_torque_estimate"]
            assert (held[1:] == held[:-1])[missed[1:]].all()
            # before the first missed sample nothing differs
            clean = np.cumsum(~np.isfinite(faulty).all(axis=1)) == 0
            assert (columns[f"{side}_velocity_estimate"] == usual[f"{side}_velocity_estimate"])[clean].all()


@pytest.mark.program("gcc")
def test_the_example_filter_takes_rows_that_are_not_finite(tmp_path):
    jaxbl.export(study(), tmp_path, name="drive", precision="float")
    run_program("gcc", *STRICT, "-O2", "drive.c", "drive_filter.c", "-lm", "-o", "filter", cwd=tmp_path)
    rows = "0,0,nan,0\n0.001,0,0,inf\n0.002,0,0,0\n"
    lines = run_program("./filter", cwd=tmp_path, input=f"t,u,theta_e,theta_s\n{rows}").stdout.splitlines()
    names = lines[0].split(",")
    table = [dict(zip(names, line.split(","), strict=True)) for line in lines[1:]]
    assert [row["motor_missed"] for row in table] == ["1", "0", "0"]
    assert [row["load_missed_samples"] for row in table] == ["0", "1", "1"]
    assert not any("nan" in line or "inf" in line for line in lines)


@pytest.mark.parametrize("explicit", [False, True])
@pytest.mark.parametrize("law", ["sigmoid_backlash", "dead_zone", "linear_shaft", None])
def test_the_code_is_the_replay_of_a_record(tmp_path, law, explicit):
    """Within rounding, which an observer may amplify: XLA joins products with sums."""
    numbers = {"sigmoid_backlash": {"dead_zone": 0.02, "slope": 20.0}, "dead_zone": {"half_gap": 0.05}}
    data = study(observer={"discretisation": "explicit" if explicit else "implicit"})
    if law is None:
        data.pop("transmission"), data.pop("identifier"), data["observer"].pop("load")
        data["drive"] = {"kind": "rigid", "motor_inertia": 0.05, "motor_viscous": 0.15}
    else:
        data["transmission"] = {"law": law, "stiffness": 1.0} | numbers.get(law, {})
    sides = ("motor",) if law is None else ("motor", "load")
    inputs = draw_samples(4000, len(sides))
    native = export_native(tmp_path, data)
    actual = run_native(native, inputs)
    with jax.enable_x64(True):
        experiment = as_arrays(read_config(data).build(), jnp.float64)
        measured = {side: jnp.asarray(inputs[:, 1 + i]) for i, side in enumerate(sides)}

        def select_estimates(state, signals):
            return {f"{s}_torque_estimate": signals.side(s).torque_estimate for s in sides} | {
                f"{s}_velocity_estimate": signals.side(s).velocity_estimate for s in sides
            }

        expected = jax.jit(lambda u, y: replay(experiment, u, y, record=select_estimates)[1])(
            jnp.asarray(inputs[:, 0]), measured
        )
    names = [output["name"] for output in native.summary["outputs"]]
    for name, values in expected.items():
        # a switching term takes the other side where rounding decides
        tolerance = 1e-9 if not explicit else 2e-2
        computed, replayed = actual[:, names.index(name)], np.asarray(values)
        assert np.sqrt(np.mean((computed - replayed) ** 2)) <= tolerance * np.sqrt(np.mean(replayed**2)), name


@pytest.mark.program("gcc")
def test_a_drive_of_ones_own_with_three_encoders(tmp_path):
    with own_drive.registered():
        trace, native = jaxbl.run(own_drive.STUDY).trace, export_native(tmp_path, own_drive.STUDY)
    columns = {f"{side}_position": f"theta_{side}" for side in own_drive.SIDES}
    columns |= {"input": "u", "motor_position": "theta_e", "load_position": "theta_s"}
    inputs = trace[[columns[port["name"]] for port in native.summary["inputs"]]].to_numpy()
    outputs = run_native(native, inputs)
    names = [output["name"] for output in native.summary["outputs"]]
    for side in own_drive.SIDES:
        # the run begins at the true position, the code at the first reading
        expected, actual = trace[f"{side}.velocity_estimate"], outputs[:, names.index(f"{side}_velocity_estimate")]
        np.testing.assert_allclose(actual[500:], expected[500:], atol=1e-3 * np.ptp(expected))


@pytest.mark.program("gcc")
def test_the_example_filter_reads_and_writes_csv(tmp_path):
    jaxbl.export(study(), tmp_path, name="drive")
    run_program("gcc", *STRICT, "-O2", "drive.c", "drive_filter.c", "-lm", "-o", "filter", cwd=tmp_path)
    inputs = draw_samples(200, 2)
    rows = "\n".join(f"{i * 1e-3!r},{','.join(map(repr, row.tolist()))}" for i, row in enumerate(inputs))
    lines = run_program("./filter", cwd=tmp_path, input=f"t,u,theta_e,theta_s\n{rows}\n").stdout.splitlines()
    native = Native(tmp_path)
    result = np.array([[float(x) for x in line.split(",")] for line in lines[1:]])
    assert lines[0].split(",")[1:] == [output["name"] for output in native.summary["outputs"]]
    np.testing.assert_allclose(result[:, 1:], run_native(native, inputs), rtol=1e-12, atol=1e-300)


def test_code_without_allocation_and_with_no_more_of_libm_than_it_says(tmp_path):
    export = jaxbl.export(study(), tmp_path, name="drive")
    source = (tmp_path / "drive.c").read_text()
    assert set(export.files) >= {"drive.c", "drive.h", "drive_filter.c", "export.json"}
    for word in ("malloc", "pow(", " exp(", "tanh(", " cos(", "fma("):
        assert word not in source
    # gains can be recognised
    assert "observer.motor.alpha" in source
    assert TARGETS.keys() >= {"c", "st", "mjcf"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"target": "rust"}, r"--target rust: should be one of c, st, mjcf"),
        ({"precision": "half"}, r"--precision half: should be one of double, float"),
        ({"name": "For"}, r"--name For: should be small letters"),
        ({"name": "math"}, r"--name math: should be .* no header of C"),
    ],
)
def test_wrong_requests_get_one_line_and_leave_nothing(tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        jaxbl.export(study(), tmp_path / "new", **options)
    assert not (tmp_path / "new").exists()


def test_another_folder_is_not_overwritten(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="is not empty and holds no results"):
        jaxbl.export(study(), tmp_path, name="drive")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.program("gcc")
@pytest.mark.parametrize("ratio", [5.0, 0.5, 256.9, None])
@pytest.mark.parametrize("kind", ["super_twisting", "dirty_derivative", "extended_state"])
def test_in_float_many_turns_away_it_is_as_good_as_near_zero(tmp_path, kind, ratio):
    """Positions that pass through many turns, and a zero that lies far away; the velocity is that of the code in double."""
    data, count = study(kind), 4000
    time = 1e-3 * np.arange(count)
    motor, ratio = 60.0 * np.sin(3.0 * time) + 0.1 * np.sin(40.0 * time), ratio or 1.0
    inputs = np.stack([0.1 * np.sin(3.0 * time), motor, motor / ratio], axis=1)
    data["drive"]["gear_ratio"] = ratio
    if ratio == 1.0:
        data.pop("transmission"), data.pop("identifier"), data["observer"].pop("load")
        data["drive"], inputs = {"kind": "rigid", "motor_inertia": 0.05, "motor_viscous": 0.15}, inputs[:, :2]
    columns = {}
    for precision in ("double", "float"):
        native = export_native(tmp_path / precision, data, precision)
        native.dtype = np.dtype(float)
        names = [output["name"] for output in native.summary["outputs"]]
        for turns in (0, -30_000, 10_000_000):
            away = turns * np.array([0.0, 1.0, 1.0 / ratio])[: inputs.shape[1]]
            columns[precision, turns] = dict(zip(names, run_native(native, inputs + away).T, strict=True))
    sides = ("motor", "load")[: inputs.shape[1] - 1]
    for side, turn in zip(sides, (1.0, 1.0 / ratio), strict=False):
        for quantity, unit in (("velocity", 0.0), ("position", turn)):
            found = {
                (precision, turns): column[f"{side}_{quantity}_estimate"][500:] - turns * unit
                for (precision, turns), column in columns.items()
            }
            errors = {case: np.sqrt(np.mean((values - found["double", 0]) ** 2)) for case, values in found.items()}
            allowed = 3.0 * errors["float", 0] + 1e-6 * np.ptp(found["double", 0])
            assert max(errors["float", turns] for turns in (-30_000, 10_000_000)) < allowed


def test_the_same_study_has_the_same_code_in_each_process(tmp_path):
    # sets of variables have another order in each process
    study = Path(__file__).parents[2] / "sweeps" / "gain_map.toml"
    script = "import sys, jaxbl; jaxbl.export(sys.argv[1], sys.argv[2], precision='float', name='drive')"
    for run in ("first", "second", "third"):
        subprocess.run([sys.executable, "-c", script, study, tmp_path / run], check=True)
    assert len({(tmp_path / run / "drive.c").read_text() for run in ("first", "second", "third")}) == 1
