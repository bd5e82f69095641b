"""The engine as functions: the page that shows them, beside SciPy and differences; and what they refuse."""

import contextlib
import dataclasses
import io
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import own_drive
import pytest
from markdown_blocks import read_blocks
from scipy.integrate import solve_ivp

import jaxbl
from jaxbl.control import CONTROLLERS
from jaxbl.drive import DRIVES
from jaxbl.sweeps.engine import Engine

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def page():
    """The names that the page's blocks define."""
    names, printed = {"__name__": "page"}, ""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        for block in read_blocks(ROOT / "docs" / "functions.md"):
            if block.language == "python":
                with contextlib.redirect_stdout(io.StringIO()) as output:
                    exec(compile(block.text, "functions.md", "exec"), names)
                printed = output.getvalue()
            elif block.language == "output":
                assert block.text == printed
    yield names
    CONTROLLERS._members.pop("spring")
    DRIVES._members.pop("three_inertia")


def integrate(derivative, state, steps, period=1e-3):
    """States at the samples, by SciPy at tight tolerance; `derivative(k, state)` holds the input of sample k."""
    states = [state]
    for k in range(steps - 1):
        solution = solve_ivp(
            lambda _, y, k=k: derivative(k, y), (0.0, period), states[-1], rtol=1e-10, atol=1e-13, method="DOP853"
        )
        states.append(solution.y[:, -1])
    return np.array(states)


def dead_zone(twist, stiffness, half_gap):
    return stiffness * (twist - np.clip(twist, -half_gap, half_gap))


def test_observers_on_a_record_see_what_they_saw(page):
    # a record begins at its first reading, a run at the true position
    again, before = (page[name].load.velocity_estimate[500:] for name in ("again", "signals"))
    np.testing.assert_allclose(again, before, rtol=1e-12)


def test_grid_is_that_of_a_sweep(page):
    study = jaxbl.read_config(ROOT / "sweeps" / "geared_axis.toml").to_dict()
    study["run"]["duration"] = 2.0
    study["sweep"]["seeds"], study["sweep"]["metrics"] = 3, ["velocity_rmse"]
    study["axes"] = [{"path": "transmission.half_gap", "start": 0.0, "stop": 0.1, "num": 6}]
    config = jaxbl.read_config(study)
    engine = Engine(config, backend="fused")
    frame = engine.run(engine.chunk(0))
    grid = page["grid"]
    assert repr(grid) == "Grid(transmission.half_gap: 6, seed: 3; 3 metrics)"
    found = grid.to_frame().reset_index().sort_values(["seed", "transmission.half_gap"])
    for column in ("motor.velocity_rmse", "load.velocity_rmse"):
        np.testing.assert_array_equal(found[column], frame[column])


def test_closed_loop_against_scipy(page):
    drive, closed = page["slow"].drive, page["closed"]
    torque = np.asarray(closed.input)
    friction = float(page["slow"].effects[0].torque)

    def derivative(k, y):
        theta_m, theta_l, v_m, v_l = y
        c = dead_zone(theta_m - drive.gear_ratio * theta_l, 60.0, 0.05)
        driving = drive.gear_ratio * c
        # the load rests until the gear's torque exceeds dry friction, and turns one way from then on
        dry = np.clip(driving, -friction, friction) if v_l <= 1e-9 else friction
        return [v_m, v_l, (torque[k] - drive.motor_viscous * v_m - c) / drive.motor_inertia,
                (driving - drive.load_viscous * v_l - dry) / drive.load_inertia]  # fmt: skip

    states = integrate(derivative, np.zeros(4), 1000)
    np.testing.assert_allclose(closed.motor.true.position[:1000], states[:, 0], atol=2e-4 * np.ptp(states[:, 0]))
    np.testing.assert_allclose(closed.load.true.position[:1000], states[:, 1], atol=2e-4 * np.ptp(states[:, 1]))
    # the law itself: proportional, one sample later
    expected = 20.0 * (1.0 - closed.motor.velocity_estimate[:-1])
    np.testing.assert_allclose(torque[1:], expected, rtol=1e-12)


def test_ten_thousand_drives_are_single_drives(page):
    gaps, speeds = np.linspace(0.0, 0.1, 10_000), page["speeds"]
    for i in (0, 4321, 9999):
        np.testing.assert_allclose(speeds[i], page["final_speed"](gaps[i]), rtol=1e-9)


def test_gradient_through_a_linear_observer_to_eight_digits(page):
    error = jax.jit(page["velocity_error"])
    # five-point differences
    step = 0.5
    points = [error(300.0 + k * step) for k in (-2, -1, 1, 2)]
    difference = (points[0] - 8.0 * points[1] + 8.0 * points[2] - points[3]) / (12.0 * step)
    np.testing.assert_allclose(page["slope"], difference, rtol=1e-8)


def test_own_observer_beside_its_recursion(page):
    measured = np.asarray(jaxbl.simulate(page["own"]).motor.measured)
    speed, last, expected = 0.0, 0.0, []
    for reading in measured:
        speed += 0.2 * ((reading - last) / 1e-3 - speed)
        last = reading
        expected.append(speed)
    np.testing.assert_allclose(page["estimate"], expected, rtol=1e-9, atol=1e-12)


def test_own_plant_against_scipy(page):
    def derivative(k, y):
        before, behind = 50.0 * (y[0] - y[1]), dead_zone(y[1] - y[2], 30.0, 0.02)
        return [*y[3:], (np.sin(5.0 * k * 1e-3) - before - 0.02 * y[3]) / 0.01,
                (before - behind - 0.05 * y[4]) / 0.02, (behind - 0.1 * y[5]) / 0.05]  # fmt: skip

    states, motion = integrate(derivative, np.zeros(6), 2000), page["motion"]
    for side, column in (("motor", 0), ("load", 2)):
        true = motion.side(side).true
        np.testing.assert_allclose(true.position, states[:, column], atol=1e-6)
        np.testing.assert_allclose(true.velocity, states[:, column + 3], atol=1e-4)


def test_own_plant_in_the_fused_loop_and_the_scan(page):
    values = {"drive.half_gap": np.linspace(0.0, 0.05, 4)}
    by_scan = jaxbl.sweep_arrays(page["arm"], values, names=("velocity_rmse",), backend="scan")
    for column in by_scan.metrics:
        np.testing.assert_allclose(page["gaps"][column], by_scan[column], rtol=1e-9)


def test_own_plant_in_a_study_against_scipy(page):
    """Motion, and the torque errors of a side on which no law of the package acts."""
    trace, metrics = page["arm_run"].trace, page["arm_run"].summary["metrics"]

    def derivative(k, y):
        before, behind = 50.0 * (y[0] - y[1]), dead_zone(y[1] - y[2], 30.0, 0.02)
        return [*y[3:], (trace["u"][k] - before - 0.02 * y[3]) / 0.01,
                (before - behind - 0.05 * y[4]) / 0.02, (behind - 0.1 * y[5]) / 0.05]  # fmt: skip

    states = integrate(derivative, np.zeros(6), 2000)
    np.testing.assert_allclose(trace["u"], np.sin(1.6 * np.pi * trace["t"]), atol=1e-12)
    np.testing.assert_allclose(trace["motor.position"], states[:, 0], atol=1e-6)
    np.testing.assert_allclose(trace["load.position"], states[:, 2], atol=1e-6)
    torques = {"motor": 50.0 * (states[:, 0] - states[:, 1]), "load": dead_zone(states[:, 1] - states[:, 2], 30.0, 0.02)}
    for side, torque in torques.items():
        # the simulated one is the mean from a sample to the next, but for the change of friction in it
        error = (0.5 * (torque[:-1] + torque[1:]) - trace[f"{side}.torque_estimate"][:-1])[1500:]
        np.testing.assert_allclose(metrics[f"{side}.torque_rmse"], np.sqrt(np.mean(np.square(error))), rtol=0.02)


def test_numbers_of_an_own_plant_are_checked(page):
    study = page["arm_study"]
    for drive, message in [
        ({"half_gap": -1.0}, "drive.half_gap: should be greater than or equal to 0, not -1.0"),
        ({"halfgap": 0.0}, "drive: unknown key 'halfgap'; did you mean 'half_gap'"),
    ]:
        with pytest.raises(jaxbl.InputError, match=message):
            jaxbl.read_config(study | {"drive": study["drive"] | drive})
    for table, message in [
        ({"observer": {"motor": {"lambda": 1.0, "alpha": 1.0}}}, "observer.load is missing: a three_inertia drive has"),
        ({"effects": [{"kind": "transmission.damping", "damping": 1.0}]}, "has no meaning on a three_inertia drive"),
    ]:
        with pytest.raises(jaxbl.InputError, match=message):
            jaxbl.read_config(study | table)


def test_logs_and_mujoco_refuse_an_own_plant_in_one_line(page, tmp_path):
    study = page["arm_study"]
    message = "drive.kind: logs are held against drives of kind two_inertia or rigid, not three_inertia"
    for command in (jaxbl.identify, jaxbl.diagnose):
        with pytest.raises(jaxbl.InputError, match=message) as caught:
            command("log.csv", study)
        assert "\n" not in str(caught.value)
    with pytest.raises(jaxbl.InputError, match="a MuJoCo model has one or two inertias, unlike three_inertia"):
        jaxbl.export(study, tmp_path, "mjcf")


def test_sides_of_any_name():
    """Each of three encoders has noise, an observer, metrics and tuned gains; the fused loop is the scan."""
    with own_drive.registered():
        study = own_drive.STUDY
        traces = [jaxbl.run(study, seed=1, backend=backend).trace for backend in ("fused", "scan")]
        assert "theta_middle" in traces[0]
        for column in traces[0]:
            np.testing.assert_allclose(traces[0][column], traces[1][column], atol=1e-7 * max(1.0, np.ptp(traces[1][column])))
        noise = {side: traces[0][f"theta_{end}"] - traces[0][f"{side}.position"]
                 for side, end in (("motor", "e"), ("middle", "middle"), ("load", "s"))}  # fmt: skip
        for values in noise.values():
            np.testing.assert_allclose(np.std(values), 1e-5, rtol=0.15)
        assert abs(np.corrcoef([*noise.values()]) - np.eye(3)).max() < 0.15

        frame = jaxbl.sweep(study | {"axes": [{"path": "observer.middle.alpha", "values": [20.0, 60.0]}]}).frame
        assert frame["middle.velocity_rmse"].nunique() == 2 and frame["load.velocity_rmse"].nunique() == 1
        gains = jaxbl.tune(study | {"tune": {"num": 3, "refine": 0}}).summary["gains"]
        assert set(gains) == set(own_drive.SIDES)
        with pytest.raises(jaxbl.InputError, match="observer: unknown key 'midle'; did you mean 'middle'"):
            jaxbl.read_config(study | {"observer": study["observer"] | {"midle": {"lambda": 1.0, "alpha": 1.0}}})

    class MotorAlone(own_drive.ThreeSides):
        name, sides, hidden = "motor_alone", ("motor",), ("middle", "load")

    with own_drive.registered(MotorAlone):
        alone = own_drive.STUDY | {"drive": {"kind": "motor_alone"} | own_drive.NUMBERS}
        with pytest.raises(jaxbl.InputError, match="observer: unknown key 'middle'"):
            jaxbl.read_config(alone)
        alone["observer"] = {"motor": own_drive.STUDY["observer"]["motor"]}
        np.testing.assert_allclose(jaxbl.run(alone).trace["motor.position"], traces[0]["motor.position"], rtol=1e-12)


def test_an_own_plant_needs_a_motor():
    class Headless(own_drive.ThreeSides):
        name, sides = "headless", ("middle", "load")

    with pytest.raises(jaxbl.InputError, match="register: Headless: its sides should have 'motor'"):
        jaxbl.register(Headless)


def test_metrics_are_those_of_a_run():
    study = ROOT / "sweeps" / "direct_drive.toml"
    config = jaxbl.read_config(study)
    found = jaxbl.metrics(jaxbl.experiment(config), 3)
    expected = jaxbl.run(config, seed=3, backend="scan").summary["metrics"]
    assert set(found) == set(expected)
    for name, value in expected.items():
        # JSON has null for what is not finite
        assert np.isfinite(found[name]) == (value is not None), name
        if value is not None:
            np.testing.assert_allclose(found[name], value, rtol=1e-9, err_msg=name)


def test_a_record_needs_no_controller(page):
    """What observers see of a closed loop's record is what they saw in the loop; targets may be given sample by sample."""
    servo = jaxbl.with_values(page["servo"], {"run.steps": 300})
    signals = jaxbl.simulate(servo)
    seen = jaxbl.observe(servo, signals.input, {side: signals.side(side).measured for side in ("motor", "load")})
    assert seen.target is None
    np.testing.assert_allclose(seen.load.velocity_estimate, signals.load.velocity_estimate, rtol=1e-9, atol=1e-12)

    state, samples = jaxbl.initial_state(servo), jaxbl.samples(servo)._replace(target=signals.target)
    no_reference = dataclasses.replace(servo, reference=None)
    _, again = jax.lax.scan(lambda state, sample: jaxbl.step(no_reference, state, sample), state, samples)
    np.testing.assert_allclose(again.input, signals.input, rtol=1e-9, atol=1e-12)


def test_own_controller_in_a_study(page):
    trace = page["sprung"].trace
    torque = 0.1 * (0.1 * trace["t"] - trace["theta_e"]).to_numpy()
    usual = jaxbl.run(page["study"] | {"controller": {"kind": "spring", "gain": 0.0}}).trace["u"].to_numpy()
    assert np.abs(torque).max() > 1e-3
    np.testing.assert_allclose((trace["u"].to_numpy() - usual)[1:], torque[:-1], atol=1e-9)


def test_sharding_over_devices_changes_nothing(page):
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("lanes",))
    count = 4 * len(jax.devices())
    gaps = jax.device_put(
        jnp.linspace(0.0, 0.1, count), jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("lanes"))
    )
    speeds = jax.jit(jax.vmap(page["final_speed"]))(gaps)
    np.testing.assert_allclose(speeds, [page["final_speed"](gap) for gap in np.asarray(gaps)], rtol=1e-9)


def test_never_float32_unasked():
    with jax.enable_x64(False):
        with pytest.raises(
            jaxbl.InputError, match=r'add jax\.config\.update\("jax_enable_x64", True\), or ask for precision'
        ):
            jaxbl.experiment(ROOT / "sweeps" / "geared_axis.toml")
        axis = jaxbl.experiment(ROOT / "sweeps" / "geared_axis.toml", precision="float32")
    assert {leaf.dtype for leaf in jax.tree.leaves(axis)} == {np.dtype("float32")}


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda axis: jaxbl.with_values(axis, {"observer.motor.alhpa": 1.0}),
            "unknown path 'observer.motor.alhpa'; nearest valid path: 'observer.motor.alpha'",
        ),
        (
            lambda axis: jaxbl.sweep_arrays(axis, {"run.sample_period": [1e-3]}),
            "'run.sample_period' is no number that may differ between lanes",
        ),
        (lambda axis: jaxbl.metrics(axis, names=("speed",)), "'speed' is no metric"),
        (
            lambda axis: jaxbl.experiment(dataclasses.replace(axis, controller=jaxbl.Cascade(1.0, 1.0))),
            "a controller and the reference that it follows belong together",
        ),
        *[
            (lambda axis, command=command: command("log.csv", axis), "a study should be a TOML file, .*, not Experiment")
            for command in (jaxbl.identify, jaxbl.diagnose)
        ],
    ],
)
def test_wrong_calls_are_told_in_one_line(call, message):
    with pytest.raises(jaxbl.InputError, match=message) as caught:
        call(jaxbl.experiment(ROOT / "sweeps" / "geared_axis.toml"))
    assert "\n" not in str(caught.value)
