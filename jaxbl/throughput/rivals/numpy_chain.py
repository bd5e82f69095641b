"""The chain as a loop over time in NumPy, with arrays of lanes: the reference of all others."""

from collections.abc import Callable
from typing import Any

import numpy as np

from ..workload import Metrics, Workload, chain_constants, metrics_from_sums


def constants_as(kind: Callable[[float], Any]) -> tuple[Any, ...]:
    """The chain's constants as `kind`, and 0, 1/2 and 4: a literal would make float64 of float32."""
    return tuple(kind(value) for value in (*chain_constants().values(), 0.0, 0.5, 4.0))


class NumpyChain:
    """One workload as a loop over time; `lanes` are the indices of those to run, left out: all."""

    def __init__(self, workload: Workload, lanes: np.ndarray | slice = slice(None)):
        self._workload = workload
        torque, noise = workload.inputs()
        self._inputs = [torque, *noise.T]
        self._values = [column[lanes] for column in workload.values().values()]

    def __call__(self) -> Metrics:
        constants = constants_as(self._workload.dtype.type)
        return metrics_from_sums(self._workload, _run_chain(self._workload, self._inputs, constants, self._values))


def _run_chain(workload: Workload, inputs: Any, c: Any, values: Any) -> list[np.ndarray]:
    """From inputs, constants and the lanes' values to their nine sums."""
    torque, motor_noise, load_noise = inputs
    motor_alpha, motor_lambda, load_alpha, load_lambda, dead_zone, noise = values
    h, motor_inertia, motor_viscous, load_inertia, load_viscous, ratio = c[:6]
    stiffness, slope, share, miss, zero, half, four = c[6:]
    gap, load_noise_level, bow, load_share = four * dead_zone, noise / ratio, half * slope, load_inertia / ratio
    motor_mass, motor_drag = motor_inertia / h, half * motor_viscous
    load_mass, load_drag = load_inertia / h, half * load_viscous
    kicks = motor_mass - motor_drag, motor_mass + motor_drag, load_mass - load_drag, load_mass + load_drag
    of_plant = half * h, ratio, stiffness, bow, *kicks
    motor = motor_rate = load = load_rate = motor_seen = load_seen = load_guess = zero * noise
    motor_control = load_control = twist = bend = motor
    motor_guess = motor - miss
    sums = [np.zeros(len(noise)) for _ in range(9)]
    for i in range(workload.steps):
        u = torque[i]
        motor_read, load_read = motor + noise * motor_noise[i], load + load_noise_level * load_noise[i]
        if i >= workload.window:
            motor_off, load_off = motor_rate - motor_guess, load_rate - load_guess
            sums[7] += motor_off * motor_off
            sums[8] += load_off * load_off
        motor, motor_rate, load, load_rate = _move(motor, motor_rate, load, load_rate, u, gap, of_plant)
        nominal = (u - motor_viscous * motor_guess) / motor_inertia
        motor_seen, motor_guess, now = _observe(motor_seen, motor_guess, motor_read, nominal, motor_alpha, motor_lambda, h)
        motor_control = motor_control + share * (now - motor_control)
        nominal = -load_viscous * load_guess / load_inertia
        load_seen, load_guess, now = _observe(load_seen, load_guess, load_read, nominal, load_alpha, load_lambda, h)
        load_control = load_control + share * (now - load_control)
        if i >= workload.start:
            motor_torque, load_torque = -motor_inertia * motor_control, load_share * load_control
            sums[0] += twist * twist
            sums[1] += twist * bend
            sums[2] += bend * bend
            sums[3] += twist * motor_torque
            sums[4] += bend * motor_torque
            sums[5] += twist * load_torque
            sums[6] += bend * load_torque
        z = motor_read - ratio * load_read
        twist = twist + share * (z - twist)
        bend = bend - share * (four * np.tanh(bow * z) + bend)
    return sums


def _move(motor, motor_rate, load, load_rate, torque, gap, of_plant):
    """One step of the plant: drift, kick, drift."""
    half, ratio, stiffness, bow, motor_less, motor_more, load_less, load_more = of_plant
    motor, load = motor + half * motor_rate, load + half * load_rate
    z = motor - ratio * load
    through = stiffness * (z - gap * np.tanh(bow * z))
    motor_rate = (motor_less * motor_rate + torque - through) / motor_more
    load_rate = (load_less * load_rate + ratio * through) / load_more
    return motor + half * motor_rate, motor_rate, load + half * load_rate, load_rate


def _observe(position, velocity, reading, nominal, alpha, lambda_, h):
    """One step of an explicit observer (7)-(8): position and velocity for the next sample, and the equivalent control."""
    error = reading - position
    switch = np.sign(error)
    control = alpha * switch
    return position + h * (velocity + lambda_ * switch * np.sqrt(abs(error))), velocity + h * (nominal + control), control
