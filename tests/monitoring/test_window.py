"""Numbers of a window: against what rows were made of, and against a least-squares fit by SciPy."""

import jax.numpy as jnp
import numpy as np
import pytest
from growing import HALF_GAP, STIFFNESS, axis
from scipy.optimize import least_squares
from scipy.signal import lfilter
from small_study import small_study

from jaxbl.chain import replay
from jaxbl.config import prepare, read_config
from jaxbl.monitoring.live_chain import BLOCKS, LiveChain
from jaxbl.monitoring.window import Window

PERIOD, CONSTANT, RATIO = 1e-3, 0.01, 5.0
LOAD = {"coulomb": 0.4, "viscous": 15.0}
MOTOR = {"coulomb": 0.3, "viscous": 0.2}
ZERO, PUSH = 0.013, 0.25


def prepare_window(data):
    return prepare(read_config(data))


def filter_late(values):
    """The low-pass as SciPy has it, one sample later."""
    share = -np.expm1(-PERIOD / CONSTANT)
    return np.concatenate([[0.0], lfilter([share], [1.0, share - 1.0], values)[:-1]])


def hinge_torque(twist, stiffness, half_gap, zero):
    z = twist - zero
    return stiffness * (z - np.clip(z, -half_gap, half_gap))


def simulate_motion(count):
    """Twist and positions: the twist goes through the gap some times a second, the sides turn more slowly."""
    time = np.arange(count) * PERIOD
    twist = 0.17 * np.sin(2 * np.pi * 0.9 * time) + 0.05 * np.sin(2 * np.pi * 2.3 * time + 0.4)
    load = 0.7 * np.sin(2 * np.pi * 0.31 * time) + 0.3 * np.sin(2 * np.pi * 0.74 * time + 1.0)
    return time, twist, RATIO * load + twist, load


def damping_torque(twist, damping, half_gap, zero):
    in_contact = np.abs(twist - zero) > half_gap
    return damping * in_contact * np.gradient(twist, PERIOD, edge_order=2)


def observer_rows(count=10_000, half_gap=HALF_GAP, noise=0.0, seed=0, damping=0.0):
    """Rows of observers without an error, for a drive with known numbers; its model knows half of the friction."""
    time, twist, motor, load = simulate_motion(count)
    speeds = {"motor": np.gradient(motor, time, edge_order=2), "load": np.gradient(load, time, edge_order=2)}
    draws = np.random.default_rng(seed)
    rows = {"twist": twist, "motor.position": motor, "load.position": load}
    for side, friction, nominal, gain in (("motor", MOTOR, 0.15, 1.0), ("load", LOAD, 16.0, -1.0 / RATIO)):
        extra = friction["coulomb"] * np.sign(speeds[side]) + (friction["viscous"] - nominal) * speeds[side]
        torque = hinge_torque(twist, STIFFNESS, half_gap, ZERO) + damping_torque(twist, damping, half_gap, ZERO)
        torque += gain * extra + (PUSH if side == "motor" else 0.0)
        rows[f"{side}.torque"] = filter_late(torque) + noise * draws.standard_normal(count)
    return rows


def fill_window(rows, data=None, seconds=10.0):
    window = Window(prepare_window(data or axis()), seconds)
    window.add(rows, restarts=True)
    return window


@pytest.mark.parametrize(
    ("half_gap", "damping"), [(0.5 * HALF_GAP, 0.0), (HALF_GAP, 0.0), (1.5 * HALF_GAP, 0.0), (HALF_GAP, 0.5)]
)
def test_the_numbers_that_rows_were_made_of(half_gap, damping):
    """Also where the model's half gap is another one, with an offset of the twist, friction, a constant torque, and damping
    of the gear that the model lacks."""
    estimate = fill_window(observer_rows(half_gap=half_gap, damping=damping)).estimate()
    for side, friction in (("motor", MOTOR), ("load", LOAD)):
        numbers = estimate[side].numbers
        assert numbers["half_gap"].value == pytest.approx(half_gap, rel=1e-4)
        assert numbers["stiffness"].value == pytest.approx(STIFFNESS, rel=1e-4)
        assert numbers["coulomb"].value == pytest.approx(friction["coulomb"], rel=5e-3)
        assert numbers["viscous"].value == pytest.approx(friction["viscous"], rel=5e-3)
        assert estimate[side].zero == pytest.approx(ZERO, abs=1e-5)
        assert set(numbers) == {"half_gap", "stiffness", "coulomb", "viscous"}


def test_the_same_as_a_fit_by_scipy():
    """Least squares of the low-passed torque of a gap, without friction, over stiffness, gap, zero and a constant."""
    rows = observer_rows(noise=0.5)
    time, twist, motor, _ = simulate_motion(10_000)
    window = fill_window(rows)
    numbers = window.estimate()["motor"].numbers
    speed = np.gradient(motor, time, edge_order=2)
    # rows that count: the filter has settled, the motor does not turn, and the velocity has its readings
    selected = np.abs(filter_late(np.sign(speed))) > 0.9
    selected[:100] = selected[-20:] = False

    def residual(x):
        stiffness, half_gap, zero, coulomb, viscous, push, damping = x
        torque = hinge_torque(twist, stiffness, half_gap, zero) + coulomb * np.sign(speed) + (viscous - 0.15) * speed + push
        torque += damping_torque(twist, damping, half_gap, zero)
        return (filter_late(torque) - rows["motor.torque"])[selected]

    fit = least_squares(
        residual, [55.0, 0.07, 0.0, 0.1, 0.1, 0.0, 0.1], x_scale=[60, 0.1, 0.01, 0.1, 0.1, 0.1, 0.1], xtol=1e-14
    )
    for name, value in zip(("stiffness", "half_gap", "_", "coulomb", "viscous"), fit.x, strict=False):
        if name != "_":
            # the constant torque is held at zero a little, velocities are of other readings
            assert numbers[name].value == pytest.approx(value, abs=0.1 * numbers[name].standard_error), name


def test_standard_errors_are_the_scatter():
    values = [fill_window(observer_rows(noise=0.5, seed=seed)).estimate()["motor"].numbers for seed in range(60)]
    for name in ("half_gap", "stiffness", "coulomb", "viscous"):
        scatter = np.std([numbers[name].value for numbers in values], ddof=1)
        stated_error = np.sqrt(np.mean([numbers[name].standard_error ** 2 for numbers in values]))
        # both have errors of a tenth with 60 windows of ten blocks
        assert stated_error == pytest.approx(scatter, rel=0.35), name


def test_what_determines_nothing_gives_nothing():
    rows = observer_rows()
    assert fill_window({name: values[:9000] for name, values in rows.items()}).estimate() is None  # not full
    standstill = {name: np.full_like(values, values[1]) for name, values in rows.items()}
    assert fill_window(standstill).estimate() == {}
    # one flank alone: the gap and the zero of the twist can't be told apart
    flank = rows | {"twist": 0.15 + 0.2 * np.abs(rows["twist"])}
    flank["motor.torque"] = filter_late(hinge_torque(flank["twist"], STIFFNESS, HALF_GAP, 0.0))
    estimate = fill_window(flank).estimate().get("motor")
    assert estimate is None or estimate.numbers["half_gap"].standard_error > HALF_GAP
    infinite = rows | {"motor.torque": np.full(10_000, np.inf)}
    assert "motor" not in fill_window(infinite).estimate()


def test_samples_after_a_break_do_not_count_until_the_observers_have_settled():
    rows = observer_rows(20_000)
    spoilt_rows = {name: values.copy() for name, values in rows.items()}
    for side in ("motor", "load"):
        spoilt_rows[f"{side}.torque"][12_000:12_090] += 100.0
    assert abs(fill_window(spoilt_rows).estimate()["motor"].numbers["stiffness"].value / STIFFNESS - 1.0) > 1e-3
    window = Window(prepare_window(axis()), 10.0)
    window.add({name: values[:12_000] for name, values in spoilt_rows.items()}, restarts=True)
    window.add({name: values[12_000:] for name, values in spoilt_rows.items()}, restarts=True)
    assert window.estimate()["motor"].numbers["stiffness"].value == pytest.approx(STIFFNESS, rel=1e-3)


@pytest.mark.parametrize("data", [axis(), small_study()], ids=["dead_zone", "sigmoid_backlash"])
def test_the_chain_in_pieces_is_the_replay_of_the_whole(data):
    """Pieces have any length, also that of a block and one more."""
    experiment = prepare_window(data)
    count = 5000
    time, _, motor, load = simulate_motion(count)
    noise = np.random.default_rng(1).standard_normal((2, count))
    inputs = {"motor": motor + 1e-4 * noise[0], "load": load + 2e-5 * noise[1]}
    torque = np.sin(5.0 * time)

    def keep(state, signals):
        return {f"{side}.torque": signals.side(side).torque_estimate for side in experiment.sides} | {"twist": signals.twist}

    full_replay = replay(experiment, jnp.asarray(torque), {side: jnp.asarray(x) for side, x in inputs.items()}, record=keep)[
        1
    ]
    ends = np.cumsum([1, BLOCKS[0], BLOCKS[0] + 1, BLOCKS[1], 300, 1])
    chain, result = LiveChain(experiment), []
    for first, end in zip([0, *ends], [*ends, count], strict=True):
        part = slice(first, end)
        result.append(chain.take(torque[part], {side: x[part] for side, x in inputs.items()}, restarts=first == 0))
    for name, values in full_replay.items():
        pieces = np.concatenate([piece[name] for piece in result])
        rms = float(np.sqrt(np.mean(np.asarray(values) ** 2)))
        np.testing.assert_allclose(pieces, values, rtol=0.0, atol=1e-9 * rms, err_msg=name)
    np.testing.assert_array_equal(np.concatenate([piece["load.position"] for piece in result]), inputs["load"])
