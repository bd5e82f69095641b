"""The chain as a loop over time in Python: with lane arrays of NumPy, or one lane in Python's own numbers, whose plant SciPy
solves, or whose observers are OpenSMC's. The same functions of numbers are what numba compiles (`compiled`)."""

# of the extra `bench`, which need not be there
# pyright: reportMissingImports=false

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ..workload import Metrics, Workload, chain_constants, metrics_from_sums

_ARRAY_FUNCTIONS = np.tanh, np.sqrt, np.sign
_NUMBER_FUNCTIONS = math.tanh, math.sqrt, lambda x: (x > 0.0) - (x < 0.0)


def constants_as(kind: Callable[[float], Any]) -> tuple[Any, ...]:
    """The chain's constants as `kind`, and 0, 1/2 and 4: a literal would make float64 of numba's float32."""
    return tuple(kind(value) for value in (*chain_constants().values(), 0.0, 0.5, 4.0))


class PythonChain:
    """One workload as a loop over time.

    Args:
        workload: of one lane where `scalar` is asked for.
        scalar: in Python's own in place of arrays of lanes.
        solver: method of SciPy's `solve_ivp` that takes the plant from sample to sample; needs `scalar`.
        uses_opensmc: observers are OpenSMC's; needs `scalar`.
        lanes: indices of the lanes to run; left out, all.
    """

    def __init__(
        self,
        workload: Workload,
        scalar: bool = False,
        solver: str | None = None,
        uses_opensmc: bool = False,
        lanes: np.ndarray | slice = slice(None),
    ):
        self._workload, self._solver, self._uses_opensmc = workload, solver, uses_opensmc
        torque, noise = workload.inputs()
        self._scalar = scalar
        self._inputs = [x.tolist() if scalar else x for x in (torque, *noise.T)]
        values = [column[lanes] for column in workload.values().values()]
        self._values: list[Any] = [column.item() for column in values] if scalar else values
        self._constants = constants_as(float if scalar else workload.dtype.type)

    def __call__(self) -> Metrics:
        workload, (tanh, sqrt, sign) = self._workload, _NUMBER_FUNCTIONS if self._scalar else _ARRAY_FUNCTIONS
        plant = moreau_step(tanh) if self._solver is None else _scipy_step(self._solver)
        motor = load = super_twisting_step(sqrt, sign)
        if self._uses_opensmc:
            motor, load = _OpenSmcObserver(sign).observe, _OpenSmcObserver(sign).observe
        run = chain_loop(tanh, plant, motor, load)
        total = 0.0 if self._scalar else np.zeros(len(self._values[0]))
        sums = run(workload.steps, workload.start, workload.window, *self._inputs, self._constants, *self._values, total)
        return metrics_from_sums(workload, [np.atleast_1d(column) for column in sums])


def chain_loop(tanh: Callable, plant: Callable, observe_motor: Callable, observe_load: Callable) -> Callable:
    """From inputs, constants and a lane's values to its nine sums, which begin with `total`."""

    def run(
        steps, start, window, torque, motor_noise, load_noise, c,
        motor_alpha, motor_lambda, load_alpha, load_lambda, dead_zone, noise, total,
    ):  # fmt: skip
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
        s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = total
        for i in range(steps):
            u = torque[i]
            motor_read, load_read = motor + noise * motor_noise[i], load + load_noise_level * load_noise[i]
            if i >= window:
                motor_off, load_off = motor_rate - motor_guess, load_rate - load_guess
                s7 = s7 + motor_off * motor_off
                s8 = s8 + load_off * load_off
            motor, motor_rate, load, load_rate = plant(motor, motor_rate, load, load_rate, u, gap, of_plant)
            nominal = (u - motor_viscous * motor_guess) / motor_inertia
            motor_seen, motor_guess, now = observe_motor(
                motor_seen, motor_guess, motor_read, nominal, motor_alpha, motor_lambda, h
            )
            motor_control = motor_control + share * (now - motor_control)
            nominal = -load_viscous * load_guess / load_inertia
            load_seen, load_guess, now = observe_load(load_seen, load_guess, load_read, nominal, load_alpha, load_lambda, h)
            load_control = load_control + share * (now - load_control)
            if i >= start:
                motor_torque, load_torque = -motor_inertia * motor_control, load_share * load_control
                s0 = s0 + twist * twist
                s1 = s1 + twist * bend
                s2 = s2 + bend * bend
                s3 = s3 + twist * motor_torque
                s4 = s4 + bend * motor_torque
                s5 = s5 + twist * load_torque
                s6 = s6 + bend * load_torque
            z = motor_read - ratio * load_read
            twist = twist + share * (z - twist)
            bend = bend - share * (four * tanh(bow * z) + bend)
        return s0, s1, s2, s3, s4, s5, s6, s7, s8

    return run


def moreau_step(tanh: Callable) -> Callable:
    """One step of the plant: drift, kick, drift."""

    def step(motor, motor_rate, load, load_rate, torque, gap, of_plant):
        half, ratio, stiffness, bow, motor_less, motor_more, load_less, load_more = of_plant
        motor, load = motor + half * motor_rate, load + half * load_rate
        z = motor - ratio * load
        through = stiffness * (z - gap * tanh(bow * z))
        motor_rate = (motor_less * motor_rate + torque - through) / motor_more
        load_rate = (load_less * load_rate + ratio * through) / load_more
        return motor + half * motor_rate, motor_rate, load + half * load_rate, load_rate

    return step


def super_twisting_step(sqrt: Callable, sign: Callable) -> Callable:
    """One step of an explicit observer (7)-(8): position and velocity for the next sample, and the equivalent control."""

    def observe(position, velocity, reading, nominal, alpha, lambda_, h):
        error = reading - position
        switch = sign(error)
        control = alpha * switch
        return position + h * (velocity + lambda_ * switch * sqrt(abs(error))), velocity + h * (nominal + control), control

    return observe


def _scipy_step(method: str) -> Callable:
    """The plant from sample to sample by SciPy."""
    from scipy.integrate import solve_ivp

    c = chain_constants()

    def rates(t: float, x: np.ndarray, torque: float, gap: float) -> list[float]:
        motor, motor_rate, load, load_rate = x.tolist()
        z = motor - c["gear_ratio"] * load
        through = c["stiffness"] * (z - gap * math.tanh(0.5 * c["slope"] * z))
        faster = (torque - through - c["motor_viscous"] * motor_rate) / c["motor_inertia"]
        load_faster = (c["gear_ratio"] * through - c["load_viscous"] * load_rate) / c["load_inertia"]
        return [motor_rate, faster, load_rate, load_faster]

    def step(motor, motor_rate, load, load_rate, torque, gap, of_plant):
        start = motor, motor_rate, load, load_rate
        solution = solve_ivp(rates, (0.0, c["period"]), start, method, args=(torque, gap), rtol=1e-6, atol=1e-9)
        return solution.y[:, -1].tolist()

    return step


class _OpenSmcObserver:
    """OpenSMC's Levant differentiator of first order: a super-twisting observer without a model, which is added."""

    def __init__(self, sign: Callable):
        self._sign, self._estimator = sign, None

    def observe(self, position_estimate, velocity_estimate, reading, nominal, alpha, lambda_, h):
        if self._estimator is None:
            from opensmc.estimators.levant import LevantDifferentiator

            # its gains are lambdas[0] sqrt(L) and lambdas[1] L
            self._estimator = LevantDifferentiator(order=1, L=1.0, lambdas=[lambda_, alpha], dt=h)
            self._estimator._z = np.array([position_estimate, velocity_estimate])
        self._estimator.estimate(0.0, None, None, y=reading)
        self._estimator._z[1] += h * nominal
        position, velocity = self._estimator._z.tolist()
        return position, velocity, alpha * self._sign(reading - position_estimate)
