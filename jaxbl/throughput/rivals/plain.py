"""The chain as a loop over time in Python: with lane arrays of NumPy, or one lane in Python's own numbers, whose plant SciPy
solves, or whose observers are OpenSMC's."""

# of the extra `bench`, which need not be there
# pyright: reportMissingImports=false

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..workload import Workload, constants, identified_figures

State = Sequence[Any]
"""Motor and load position and velocity."""
Plant = Callable[[State, Any], State]
"""From a state and a torque to the next sample's."""


class Functions(NamedTuple):
    """Of numbers, or of arrays of them."""

    tanh: Callable[[Any], Any]
    sqrt: Callable[[Any], Any]
    sign: Callable[[Any], Any]


_ARRAYS = Functions(np.tanh, np.sqrt, np.sign)
_NUMBERS = Functions(math.tanh, math.sqrt, lambda x: (x > 0.0) - (x < 0.0))


class Plain:
    """One workload as a loop over time.

    Args:
        workload: of one lane where `numbers` is asked for.
        numbers: in Python's own in place of arrays of lanes.
        solver: method of SciPy's `solve_ivp` that takes the plant from sample to sample; needs `numbers`.
        library: observers are OpenSMC's; needs `numbers`.
        chosen: indices of the lanes to run; left out, all.
    """

    def __init__(
        self,
        workload: Workload,
        numbers: bool = False,
        solver: str | None = None,
        library: bool = False,
        chosen: np.ndarray | slice = slice(None),
    ):
        self._workload, self._solver, self._library = workload, solver, library
        torque, noise = workload.inputs()
        self._f = _NUMBERS if numbers else _ARRAYS
        self._torque, self._noise = (torque.tolist(), noise.tolist()) if numbers else (torque, noise)
        values = [column[chosen] for column in workload.values().values()]
        self._values: list[Any] = [column.item() for column in values] if numbers else values
        kind = float if numbers else workload.dtype.type
        self._c = {name: kind(value) for name, value in constants().items()}

    def __call__(self) -> dict[str, np.ndarray]:
        w, c = self._workload, self._c
        h, ratio, tanh = c["period"], c["gear_ratio"], self._f.tanh
        motor_alpha, motor_lambda, load_alpha, load_lambda, dead_zone, noise = self._values
        zero = 0.0 * noise
        plant = self._moreau(dead_zone) if self._solver is None else self._solved(dead_zone)
        observer = _OpenSMC if self._library else _Euler
        motor = observer(motor_lambda, motor_alpha, h, zero - c["motor_error"], self._f)
        load = observer(load_lambda, load_alpha, h, zero, self._f)
        state = [zero] * 4
        motor_control = load_control = twist = bend = zero
        sums = [zero if self._f is _NUMBERS else zero.astype(np.float64) for _ in range(9)]
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
            bend = bend + c["share"] * (-4.0 * tanh(0.5 * c["slope"] * z) - bend)
        return identified_figures(w, [np.atleast_1d(column) for column in sums])

    def _moreau(self, dead_zone: Any) -> Plant:
        c, tanh = self._c, self._f.tanh
        h, half, gap = c["period"], 0.5 * c["period"], 4.0 * dead_zone

        def step(state: State, torque: Any) -> State:
            motor, motor_rate, load, load_rate = state
            motor, load = motor + half * motor_rate, load + half * load_rate
            z = motor - c["gear_ratio"] * load
            through = c["stiffness"] * (z - gap * tanh(0.5 * c["slope"] * z))
            mass, drag = c["motor_inertia"] / h, 0.5 * c["motor_viscous"]
            motor_rate = ((mass - drag) * motor_rate + torque - through) / (mass + drag)
            mass, drag = c["load_inertia"] / h, 0.5 * c["load_viscous"]
            load_rate = ((mass - drag) * load_rate + c["gear_ratio"] * through) / (mass + drag)
            return motor + half * motor_rate, motor_rate, load + half * load_rate, load_rate

        return step

    def _solved(self, dead_zone: float) -> Plant:
        from scipy.integrate import solve_ivp

        c, method = self._c, self._solver or "RK45"
        ratio, gap, slope = c["gear_ratio"], 4.0 * dead_zone, 0.5 * c["slope"]

        def rates(t: float, x: np.ndarray, torque: float) -> list[float]:
            motor, motor_rate, load, load_rate = x.tolist()
            z = motor - ratio * load
            through = c["stiffness"] * (z - gap * math.tanh(slope * z))
            faster = (torque - through - c["motor_viscous"] * motor_rate) / c["motor_inertia"]
            return [motor_rate, faster, load_rate, (ratio * through - c["load_viscous"] * load_rate) / c["load_inertia"]]

        def step(state: State, torque: float) -> State:
            found = solve_ivp(rates, (0.0, c["period"]), state, method, args=(torque,), rtol=1e-6, atol=1e-9)
            return found.y[:, -1].tolist()

        return step


class _Euler:
    """Explicit super-twisting (7)-(8) of one side."""

    def __init__(self, lambda_: Any, alpha: Any, period: Any, velocity: Any, functions: Functions):
        self.lambda_, self.alpha, self.period = lambda_, alpha, period
        self.sqrt, self.sign = functions.sqrt, functions.sign
        self.position, self.velocity = 0.0 * velocity, velocity

    def step(self, reading: Any, nominal: Any) -> Any:
        """Take in a reading; the equivalent control."""
        error = reading - self.position
        switch = self.sign(error)
        control = self.alpha * switch
        self.position = self.position + self.period * (self.velocity + self.lambda_ * switch * self.sqrt(abs(error)))
        self.velocity = self.velocity + self.period * (nominal + control)
        return control


class _OpenSMC:
    """OpenSMC's Levant differentiator of first order: a super-twisting observer without a model, which is added."""

    def __init__(self, lambda_: float, alpha: float, period: float, velocity: float, functions: Functions):
        from opensmc.estimators.levant import LevantDifferentiator

        # its gains are lambdas[0] sqrt(L) and lambdas[1] L
        self._estimator = LevantDifferentiator(order=1, L=1.0, lambdas=[lambda_, alpha], dt=period)
        self._estimator._z = np.array([0.0, velocity])
        self.alpha, self.period, self.sign = alpha, period, functions.sign

    @property
    def velocity(self) -> float:
        return float(self._estimator._z[1])

    def step(self, reading: float, nominal: float) -> float:
        error = reading - float(self._estimator._z[0])
        self._estimator.estimate(0.0, None, None, y=reading)
        self._estimator._z[1] += self.period * nominal
        return self.alpha * self.sign(error)
