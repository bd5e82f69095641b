import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from scipy.interpolate import make_interp_spline

import jaxbl
from jaxbl.control import REFERENCES, FunctionReference

NUMBERS = {
    "sine": (0.3, 0.7, 0.1),
    "ramp": (0.4, 0.55),
    "steps": (0.2, 0.25),
    "moves": (0.5, 0.4, 0.2),
    "recorded": (np.arange(12) * 0.2, np.sin(np.arange(12.0) ** 2), 0.3),
}


@pytest.mark.parametrize("name", REFERENCES)
def test_velocity_and_acceleration_are_derivatives(name):
    cls, step = REFERENCES[name], 1e-4
    reference = getattr(cls, "through", cls)(*NUMBERS[name])
    # away from jumps and corners
    times = jnp.arange(0.003, 2.0, 0.01)
    target = jax.vmap(reference.target)(times)
    before, here, after = (jax.vmap(reference.position)(times + k * step) for k in (-1, 0, 1))
    np.testing.assert_allclose(target.position, here, rtol=1e-9)
    np.testing.assert_allclose(target.velocity, (after - before) / (2.0 * step), atol=2e-5)
    np.testing.assert_allclose(target.acceleration, (after - 2.0 * here + before) / step**2, atol=2e-5)


def test_moves_go_there_and_back_smoothly():
    moves = REFERENCES["moves"](0.5, 0.4, 0.2)
    target = jax.vmap(moves.target)(jnp.array([0.0, 0.2, 0.4, 0.55, 0.8, 1.0, 1.15, 1.2]))
    np.testing.assert_allclose(target.position, [0.0, 0.25, 0.5, 0.5, 0.25, 0.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(
        target.velocity, [0.0, 0.5 * 1.875 / 0.4, 0.0, 0.0, -0.5 * 1.875 / 0.4, 0.0, 0.0, 0.0], atol=1e-9
    )


def test_steps_come_at_their_sample():
    steps = REFERENCES["steps"](1.0, 0.1)
    times = jnp.arange(1000) * 1e-3
    np.testing.assert_array_equal(jax.vmap(steps.position)(times), (np.arange(1000) // 100) % 2)


def test_a_plain_function():
    target = FunctionReference(lambda time: time**3).target(jnp.asarray(2.0))
    np.testing.assert_allclose(target, (8.0, 12.0, 12.0))


def test_recorded_positions_are_joined_by_a_spline():
    rng = np.random.default_rng(0)
    times, positions = np.cumsum(rng.uniform(0.01, 0.2, 40)), rng.standard_normal(40)
    target = jax.vmap(REFERENCES["recorded"].through(times, positions, 2.0).target)(jnp.linspace(-1.0, times[-1] + 1.0, 501))
    cubic, inside = make_interp_spline(times, positions), np.linspace(-1.0, times[-1] + 1.0, 501)
    held = np.clip(inside, times[0], times[-1])
    np.testing.assert_allclose(target.position, 2.0 * cubic(held), atol=1e-12)
    moving = (inside > times[0]) & (inside < times[-1])
    for found, order in ((target.velocity, 1), (target.acceleration, 2)):
        np.testing.assert_allclose(found, np.where(moving, 2.0 * cubic(held, nu=order), 0.0), rtol=1e-7, atol=1e-7)


STUDY = {
    "drive": {"kind": "rigid", "motor_inertia": 0.05, "motor_viscous": 0.15},
    "encoders": {"noise": 1e-4},
    "observer": {"kind": "extended_state", "motor": {"bandwidth": 200.0}},
    "controller": {"kind": "cascade", "position_gain": 10.0, "speed_gain": 1.0, "inertia_feedforward": 0.05},
    "reference": {"kind": "moves", "distance": 0.5, "duration": 0.4, "pause": 0.1},
    "run": {"duration": 0.8},
    "axes": [{"path": "controller.position_gain", "values": [5.0, 10.0]}],
}


def test_a_recorded_move_runs_as_the_move_itself(tmp_path):
    """From a file, in the fused loop and in the scan; the file's name decides no number."""
    times = np.arange(901) * 1e-3
    moves = jax.vmap(REFERENCES["moves"](0.5, 0.4, 0.1).position)(jnp.asarray(times))
    frames, folder = {}, tmp_path / "sub"
    folder.mkdir()
    pd.DataFrame({"time": times + 3.0, "x": np.asarray(moves) / 2.0}).to_csv(folder / "move.csv", index=False)
    keys = {"kind": "recorded", "file": "move.csv", "time_column": "time", "position_column": "x", "gain": 2.0}
    study = folder / "study.toml"
    study.write_text(jaxbl.read_config(STUDY | {"reference": keys}).to_toml(), encoding="utf-8")
    axis = {"path": "reference.gain", "values": [1.0, 2.0]}
    for name, source in (("moves", STUDY), ("recorded", {"include": str(study), "axes": [*STUDY["axes"], axis]})):
        for backend in ("fused", "scan"):
            frames[name, backend] = jaxbl.sweep(source, backend=backend).frame
    columns = ["motor.following_rmse", "motor.following_peak", "motor.torque_rms"]
    for backend in ("fused", "scan"):
        recorded = frames["recorded", backend].query("`reference.gain` == 2.0")
        np.testing.assert_allclose(recorded[columns], frames["moves", backend][columns], rtol=1e-4)
    np.testing.assert_allclose(frames["recorded", "fused"][columns], frames["recorded", "scan"][columns], rtol=1e-9)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("t,reference\n0,0\n", "ends after 0 s, and the run only after 0.8 s"),
        ("t,reference\n0,0\n0.1,1\n", "ends after 0.1 s, and the run only after 0.8 s"),
        ("t,reference\n0,0\n0,1\n", "column 't', data row 2: times should increase"),
        ("t,x\n0,0\n0,1\n", "no column 'reference'"),
    ],
)
def test_bad_record_is_one_line(content, message, tmp_path):
    path = tmp_path / "move.csv"
    path.write_text(content)
    with pytest.raises(jaxbl.InputError) as error:
        jaxbl.experiment(STUDY | {"reference": {"kind": "recorded", "file": str(path)}})
    assert str(error.value).startswith(f"{path}: ")
    assert message in str(error.value)
    assert "\n" not in str(error.value)
