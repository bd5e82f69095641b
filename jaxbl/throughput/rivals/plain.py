"""The chain in NumPy, a loop over time in Python: with lane arrays, or one lane whose plant SciPy solves, or whose observers
are OpenSMC's."""

# of the extra `bench`, which need not be there
# pyright: reportMissingImports=false

from collections.abc import Callable
from typing import Any

import numpy as np

from ..workload import Workload, constants, figures_of

Plant = Callable[[np.ndarray, float], np.ndarray]
"""From motor and load position and velocity, and a torque, to the next sample's."""


class Plain:
    """One workload as a loop over NumPy arrays of lanes.

    Args:
        workload: of one lane where `solver` or `library` is given.
        solver: method of SciPy's `solve_ivp` that takes the plant from sample to sample.
        library: observers are OpenSMC's.
        chosen: indices of the lanes to run; left out, all.
    """

    def __init__(
        self,
        workload: Workload,
        solver: str | None = None,
        library: bool = False,
        chosen: np.ndarray | slice = slice(None),
    ):
        self._workload, self._solver, self._library = workload, solver, library
        self._torque, self._noise = workload.inputs()
        self._values = {path: column[chosen] for path, column in workload.values().items()}

    def __call__(self) -> dict[str, np.ndarray]:
        w, c, dtype = self._workload, constants(), self._workload.dtype
        c = {name: dtype.type(value) for name, value in c.items()}
        h, ratio = c["period"], c["gear_ratio"]
        motor_alpha, motor_lambda, load_alpha, load_lambda, dead_zone, noise = self._values.values()
        zero = np.zeros_like(noise)
        plant = self._moreau(c, dead_zone) if self._solver is None else self._solved(c, float(dead_zone[0]))
        observer = _OpenSMC if self._library else _Euler
        motor = observer(motor_lambda, motor_alpha, h, zero - c["motor_error"])
        load = observer(load_lambda, load_alpha, h, zero)
        state = np.stack([zero] * 4)
        motor_control = load_control = twist = bend = zero
        sums = np.zeros((9, len(noise)))
        for i in range(w.steps):
            u, (motor_unit, load_unit) = self._torque[i], self._noise[i]
            motor_read, load_read = state[0] + noise * motor_unit, state[2] + noise / ratio * load_unit
            motor_off, load_off = state[1] - motor.velocity, state[3] - load.velocity
            state = plant(state, u)
            motor_now = motor.step(motor_read, (u - c["motor_viscous"] * motor.velocity) / c["motor_inertia"])
            load_now = load.step(load_read, -c["load_viscous"] * load.velocity / c["load_inertia"])
            motor_control = motor_control + c["share"] * (motor_now - motor_control)
            load_control = load_control + c["share"] * (load_now - load_control)
            z = motor_read - ratio * load_read
            if i >= w.start:
                motor_torque = -c["motor_inertia"] * motor_control
                load_torque = c["load_inertia"] / ratio * load_control
                sums[0] += twist * twist
                sums[1] += twist * bend
                sums[2] += bend * bend
                sums[3] += twist * motor_torque
                sums[4] += bend * motor_torque
                sums[5] += twist * load_torque
                sums[6] += bend * load_torque
            if i >= w.window:
                sums[7] += motor_off * motor_off
                sums[8] += load_off * load_off
            twist = twist + c["share"] * (z - twist)
            bend = bend + c["share"] * (-4.0 * np.tanh(0.5 * c["slope"] * z) - bend)
        return figures_of(w, list(sums))

    @staticmethod
    def _moreau(c: dict[str, Any], dead_zone: np.ndarray) -> Plant:
        h, half, gap = c["period"], 0.5 * c["period"], 4.0 * dead_zone

        def step(state: np.ndarray, torque: float) -> np.ndarray:
            motor, motor_rate, load, load_rate = state
            motor, load = motor + half * motor_rate, load + half * load_rate
            z = motor - c["gear_ratio"] * load
            through = c["stiffness"] * (z - gap * np.tanh(0.5 * c["slope"] * z))
            mass, drag = c["motor_inertia"] / h, 0.5 * c["motor_viscous"]
            motor_rate = ((mass - drag) * motor_rate + torque - through) / (mass + drag)
            mass, drag = c["load_inertia"] / h, 0.5 * c["load_viscous"]
            load_rate = ((mass - drag) * load_rate + c["gear_ratio"] * through) / (mass + drag)
            return np.stack([motor + half * motor_rate, motor_rate, load + half * load_rate, load_rate])

        return step

    def _solved(self, c: dict[str, Any], dead_zone: float) -> Plant:
        from scipy.integrate import solve_ivp

        method = self._solver or "RK45"
        ratio, gap, slope = float(c["gear_ratio"]), 4.0 * dead_zone, 0.5 * float(c["slope"])

        def rates(t: float, x: np.ndarray, torque: float) -> list[float]:
            z = x[0] - ratio * x[2]
            through = c["stiffness"] * (z - gap * np.tanh(slope * z))
            motor = (torque - through - c["motor_viscous"] * x[1]) / c["motor_inertia"]
            return [x[1], motor, x[3], (ratio * through - c["load_viscous"] * x[3]) / c["load_inertia"]]

        def step(state: np.ndarray, torque: float) -> np.ndarray:
            span = (0.0, float(c["period"]))
            found = solve_ivp(rates, span, state[:, 0], method, args=(torque,), rtol=1e-6, atol=1e-9)
            return found.y[:, -1:]

        return step


class _Euler:
    """Explicit super-twisting (7)-(8) of one side."""

    def __init__(self, lambda_: np.ndarray, alpha: np.ndarray, period: float, velocity: np.ndarray):
        self.lambda_, self.alpha, self.period = lambda_, alpha, period
        self.position, self.velocity = np.zeros_like(velocity), velocity

    def step(self, reading: np.ndarray, nominal: np.ndarray) -> np.ndarray:
        """Take in a reading; the equivalent control."""
        error = reading - self.position
        switch = np.sign(error)
        control = self.alpha * switch
        self.position = self.position + self.period * (self.velocity + self.lambda_ * switch * np.sqrt(np.abs(error)))
        self.velocity = self.velocity + self.period * (nominal + control)
        return control


class _OpenSMC:
    """OpenSMC's Levant differentiator of first order: a super-twisting observer without a model, which is added."""

    def __init__(self, lambda_: np.ndarray, alpha: np.ndarray, period: float, velocity: np.ndarray):
        from opensmc.estimators.levant import LevantDifferentiator

        # its gains are lambdas[0] sqrt(L) and lambdas[1] L
        gains = [float(lambda_[0]), float(alpha[0])]
        self._estimator = LevantDifferentiator(order=1, L=1.0, lambdas=gains, dt=float(period))
        self._estimator._z = np.array([0.0, velocity[0]])
        self.alpha, self.period = float(alpha[0]), float(period)

    @property
    def velocity(self) -> np.ndarray:
        return self._estimator._z[1:]

    def step(self, reading: np.ndarray, nominal: np.ndarray) -> np.ndarray:
        error = reading - self._estimator._z[:1]
        self._estimator.estimate(0.0, None, None, y=float(reading[0]))
        self._estimator._z[1] += self.period * nominal[0]
        return self.alpha * np.sign(error)
