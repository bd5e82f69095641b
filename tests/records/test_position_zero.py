"""Positions of two logs that count from different zeros, found by the torque that repeats with the turn."""

import numpy as np
import pytest

from jaxbl.records import TurningLog, find_zero_shift


def simulate_turning_log(
    seed: int, zero: float, cogging: float = 2e-3, gear: bool = False, turns: float = 3.0, gravity: float = 0.0
) -> TurningLog:
    """A motor that turns to and fro; cogging of 5 and 10 a turn, and gravity, read from a zero of its own."""
    random, period = np.random.default_rng(seed), 1e-3
    time = np.arange(8000) * period
    swing = 2.0 * np.pi * turns
    # a torque is held from the sample on: it is that of half a period later
    angle = 2.0 * np.pi * 0.25 * (time + 0.5 * period) + seed
    position = swing * np.sin(angle)
    speed = np.gradient(position, period)
    torque = 4e-5 * np.gradient(speed, period) + 1e-4 * speed + 0.015 * np.sign(speed) + 5e-4
    read = swing * np.sin(angle - 2.0 * np.pi * 0.25 * 0.5 * period) - zero + 1e-4 * random.standard_normal(len(time))
    # the shaft winds up by what is transmitted, and cogging is not
    load = read - 1e-2 * torque if gear else None
    torque += cogging * np.sin(10.0 * position + 0.4) + 0.5 * cogging * np.sin(5.0 * position)
    torque += gravity * np.sin(position)
    torque += 1e-3 * random.standard_normal(len(time))
    return TurningLog(torque, read, load, [slice(0, 4000), slice(4000, 8000)], period)


@pytest.mark.parametrize("gear", [False, True])
def test_the_difference_of_the_zeros_is_found(gear: bool):
    shift = find_zero_shift(simulate_turning_log(1, 0.0, gear=gear), simulate_turning_log(2, 0.4, gear=gear))
    assert shift is not None and shift.waves == (5, 10)
    assert abs(shift.value - 0.4) < 4.0 * shift.error < 0.04


def test_a_small_part_of_a_period_is_found():
    # 4 % of a period of the faster wave, a third of the steps in which shifts are compared
    shift = find_zero_shift(simulate_turning_log(1, 0.0), simulate_turning_log(2, 0.025))
    assert shift is not None and abs(shift.value - 0.025) < 4.0 * shift.error < 0.02


def test_the_first_fifth_of_a_log_is_enough_to_turn_it():
    short = simulate_turning_log(2, 0.4)._replace(segments=[slice(0, 1600)])
    shift = find_zero_shift(simulate_turning_log(1, 0.0), short)
    assert shift is not None and abs(shift.value - 0.4) < 4.0 * shift.error < 0.04


def test_less_than_a_turn_is_enough_for_fast_waves():
    shift = find_zero_shift(simulate_turning_log(1, 0.0, turns=0.3), simulate_turning_log(2, 0.4, turns=0.3))
    assert shift is not None and abs(shift.value - 0.4) < 4.0 * shift.error < 0.04


def simulate_torque_step(zero: float, torque: float, cogging: float = 2e-3) -> TurningLog:
    """A motor under a constant torque; cogging of 7 a turn makes its speed ripple."""
    period, speed, position = 2e-3, torque / 1e-3, 0.0
    positions = np.empty(4000)
    for i in range(len(positions)):
        positions[i] = position
        for _ in range(10):
            position += 0.05 * period * speed
            speed += 0.1 * period * (torque - 1e-3 * speed + cogging * np.sin(7.0 * position)) / 1e-4
            position += 0.05 * period * speed
    counts = np.round((positions - zero) * 16384 / (2.0 * np.pi))
    return TurningLog(np.full(4000, torque), counts * 2.0 * np.pi / 16384, None, [slice(0, 4000)], period)


def test_the_difference_of_the_zeros_is_found_under_constant_torques():
    shift = find_zero_shift(simulate_torque_step(0.0, 0.02), simulate_torque_step(0.3, 0.025))
    assert shift is not None and 7 in shift.waves
    # a hundredth of a period of the wave: its ripple of the speed is fitted along
    assert shift.value == pytest.approx(0.3, abs=0.015)
    assert find_zero_shift(simulate_torque_step(0.0, 0.02, 0.0), simulate_torque_step(0.3, 0.025, 0.0)) is None


def test_the_smallest_of_equal_places_is_taken():
    # 5 and 10 a turn repeat every 72 degrees
    shift = find_zero_shift(simulate_turning_log(1, 0.0), simulate_turning_log(2, 3.0))
    assert shift is not None
    assert abs(shift.value - (3.0 - 2.0 * 2.0 * np.pi / 5.0)) < 4.0 * shift.error


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (simulate_turning_log(1, 0.3), simulate_turning_log(2, 0.3)),
        (simulate_turning_log(1, 0.0, cogging=0.0), simulate_turning_log(2, 0.4, cogging=0.0)),
        (simulate_turning_log(1, 0.0), simulate_turning_log(2, 0.4, cogging=0.0)),
        (simulate_turning_log(1, 0.0, turns=0.01), simulate_turning_log(2, 0.4, turns=0.01)),
    ],
    ids=["one zero", "no cogging", "cogging in one alone", "less than two periods of the waves"],
)
def test_nothing_is_turned_without_need(first: TurningLog, second: TurningLog):
    assert find_zero_shift(first, second) is None


@pytest.mark.parametrize("turns", [(0.25, 0.15), (0.4, 0.15), (0.25, 0.2)])
def test_gravity_over_part_of_a_turn_is_no_wave(turns: tuple[float, float]):
    logs = [simulate_turning_log(i, 0.0, cogging=0.0, turns=part, gravity=0.05) for i, part in enumerate(turns, 1)]
    assert find_zero_shift(*logs) is None


def test_a_log_that_stands_still_is_not_turned():
    still = simulate_turning_log(2, 0.4)._replace(motor=np.full(8000, 0.4))
    assert find_zero_shift(simulate_turning_log(1, 0.0), still) is None


def test_a_machine_without_a_drive_shows_no_torques_over_the_turn():
    first, second = (simulate_turning_log(seed, zero)._replace(torque=np.zeros(8000)) for seed, zero in ((1, 0.0), (2, 0.4)))
    assert find_zero_shift(first, second) is None
