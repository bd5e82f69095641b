"""The chain as a loop over time in NumPy, with arrays of lanes: the reference of all others."""

from collections.abc import Callable
from typing import Any

import numpy as np

from ..workload import Metrics, Workload, chain_constants, metrics_from_sums


def step_constants(kind: Callable[[float], Any]) -> tuple[Any, ...]:
    """The constants of a step, and 0, 1 and 4, in the order in which loops unpack them.

    They are made `kind`: a literal would make float64 of float32.
    """
    chain = list(chain_constants().values())
    h, motor_inertia, motor_viscous, load_inertia, load_viscous, ratio = chain[:6]
    stiffness, slope, share, velocity_error = chain[6:]
    motor_mass, motor_drag, load_mass, load_drag = motor_inertia / h, motor_viscous / 2, load_inertia / h, load_viscous / 2
    motor_gain, load_gain = 1.0 / (motor_mass + motor_drag), 1.0 / (load_mass + load_drag)
    motor_keep, load_keep = motor_gain * (motor_mass - motor_drag), load_gain * (load_mass - load_drag)
    of_plant = h / 2, ratio, stiffness, slope / 2, motor_keep, motor_gain, load_keep, load_gain
    of_observers = motor_viscous, 1.0 / motor_inertia, load_viscous / load_inertia, velocity_error
    return tuple(map(kind, (h, *of_plant, *of_observers, share, motor_inertia, load_inertia / ratio, 0.0, 1.0, 4.0)))


class NumpyChain:
    """One workload as a loop over time; `lanes` are the indices of those to run, left out: all."""

    def __init__(self, workload: Workload, lanes: np.ndarray | slice = slice(None)):
        self._workload = workload
        torque, noise = workload.inputs()
        self._inputs = [torque, *noise.T]
        self._values = [column[lanes] for column in workload.values().values()]

    def __call__(self) -> Metrics:
        constants = step_constants(self._workload.dtype.type)
        return metrics_from_sums(self._workload, _run_chain(self._workload, self._inputs, constants, self._values))


def _run_chain(workload: Workload, inputs: Any, constants: Any, values: Any) -> list[np.ndarray]:
    """From inputs, constants and the lanes' values to their nine sums."""
    torque, motor_noise, load_noise = inputs
    motor_alpha, motor_lambda, load_alpha, load_lambda, dead_zone, noise = values
    h, half, ratio, stiffness, bow, motor_keep, motor_gain, load_keep, load_gain = constants[:9]
    motor_viscous, motor_inverse, load_friction, miss, share, motor_inertia, load_share, zero, _, four = constants[9:]
    gap, load_noise_level = four * dead_zone, noise / ratio
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
        # plant: drift, kick, drift
        motor, load = motor + half * motor_rate, load + half * load_rate
        z = motor - ratio * load
        through = stiffness * (z - gap * np.tanh(bow * z))
        motor_rate = motor_keep * motor_rate + motor_gain * (u - through)
        load_rate = load_keep * load_rate + load_gain * (ratio * through)
        motor, load = motor + half * motor_rate, load + half * load_rate
        nominal = (u - motor_viscous * motor_guess) * motor_inverse
        motor_seen, motor_guess, now = _observe(motor_seen, motor_guess, motor_read, nominal, motor_alpha, motor_lambda, h)
        motor_control = motor_control + share * (now - motor_control)
        nominal = -load_friction * load_guess
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


def _observe(position, velocity, reading, nominal, alpha, lambda_, h):
    """One step of an explicit observer (7)-(8): position and velocity for the next sample, and the equivalent control."""
    error = reading - position
    switch = np.sign(error)
    control = alpha * switch
    return position + h * (velocity + lambda_ * switch * np.sqrt(abs(error))), velocity + h * (nominal + control), control
