"""The chain in numba: lanes in blocks that LLVM turns into vectors."""

# of the extra `bench`, which need not be there
# pyright: reportMissingImports=false

from collections.abc import Callable
from functools import cache

import numpy as np

from ..workload import Metrics, Workload, metrics_from_sums
from .numpy_chain import step_constants

BLOCK_LANES = 64
"""Lanes of a block: several registers of the widest vectors, and a state that stays in the first cache."""


class NumbaChain:
    """One workload."""

    def __init__(self, workload: Workload, threads: int):
        self._workload, self._threads = workload, threads
        self._function = compile_block_loop(workload.precision)
        torque, noise = workload.inputs()
        self._inputs = [np.ascontiguousarray(column) for column in (torque, *noise.T)]
        padded = -(-workload.lanes // BLOCK_LANES) * BLOCK_LANES
        self._values = np.stack([np.resize(column, padded) for column in workload.values().values()])
        self._constants = step_constants(workload.dtype.type)

    def __call__(self) -> Metrics:
        import numba

        workload = self._workload
        numba.set_num_threads(min(self._threads, numba.config.NUMBA_NUM_THREADS))  # pyright: ignore
        sums = self._function(workload.steps, workload.start, workload.window, *self._inputs, self._constants, self._values)
        return metrics_from_sums(workload, list(sums[:, : workload.lanes]))


@cache
def compile_block_loop(precision: str) -> Callable[..., np.ndarray]:
    """Compile the loop over all blocks; a later call has it."""
    from numba import njit, prange

    tanh = _compile_tanh(precision)
    n = BLOCK_LANES

    @njit(parallel=True, error_model="numpy", fastmath={"contract"})
    def run(steps, start, window, torque, motor_noise, load_noise, c, values):  # pragma: no cover
        lanes = values.shape[1]
        out = np.zeros((9, lanes))
        h, half, ratio, stiffness, bow, motor_keep, motor_gain, load_keep, load_gain = c[:9]
        motor_viscous, motor_inverse, load_friction, miss, share, motor_inertia, load_share, zero, unity, four = c[9:]
        for block in prange(lanes // n):
            # one buffer: of its parts the compiler knows that they do not overlap
            s = np.zeros((27, n), values.dtype)
            block_lanes = slice(block * n, (block + 1) * n)
            s[:6], s[13] = values[:, block_lanes], -miss
            for i in range(steps):
                u, motor_unit, load_unit = torque[i], motor_noise[i], load_noise[i] / ratio
                counts, inside = (unity if i >= start else zero), (unity if i >= window else zero)
                for j in range(n):
                    motor, motor_rate, load, load_rate = s[6, j], s[7, j], s[8, j], s[9, j]
                    motor_guess, load_guess = s[13, j], s[14, j]
                    motor_read, load_read = motor + s[5, j] * motor_unit, load + s[5, j] * load_unit
                    motor_off, load_off = motor_rate - motor_guess, load_rate - load_guess
                    s[25, j] += inside * motor_off * motor_off
                    s[26, j] += inside * load_off * load_off
                    motor, load = motor + half * motor_rate, load + half * load_rate
                    z = motor - ratio * load
                    through = stiffness * (z - four * s[4, j] * tanh(bow * z))
                    motor_rate = motor_keep * motor_rate + motor_gain * (u - through)
                    load_rate = load_keep * load_rate + load_gain * (ratio * through)
                    s[6, j], s[7, j] = motor + half * motor_rate, motor_rate
                    s[8, j], s[9, j] = load + half * load_rate, load_rate
                    motor_miss, load_miss = motor_read - s[11, j], load_read - s[12, j]
                    motor_sign = (unity if motor_miss > zero else zero) - (unity if motor_miss < zero else zero)
                    load_sign = (unity if load_miss > zero else zero) - (unity if load_miss < zero else zero)
                    motor_now, load_now = s[0, j] * motor_sign, s[2, j] * load_sign
                    s[11, j] += h * (motor_guess + s[1, j] * motor_sign * np.sqrt(abs(motor_miss)))
                    s[12, j] += h * (load_guess + s[3, j] * load_sign * np.sqrt(abs(load_miss)))
                    s[13, j] = motor_guess + h * ((u - motor_viscous * motor_guess) * motor_inverse + motor_now)
                    s[14, j] = load_guess + h * (load_now - load_friction * load_guess)
                    s[15, j] += share * (motor_now - s[15, j])
                    s[16, j] += share * (load_now - s[16, j])
                    motor_torque, load_torque = -motor_inertia * s[15, j], load_share * s[16, j]
                    twist, bend = s[17, j], s[10, j]
                    first, second = counts * twist, counts * bend
                    s[18, j] += first * twist
                    s[19, j] += first * bend
                    s[20, j] += second * bend
                    s[21, j] += first * motor_torque
                    s[22, j] += second * motor_torque
                    s[23, j] += first * load_torque
                    s[24, j] += second * load_torque
                    z = motor_read - ratio * load_read
                    s[17, j] = twist + share * (z - twist)
                    s[10, j] = bend - share * (four * tanh(bow * z) + bend)
                if i % 512 == 511 or i == steps - 1:
                    out[:, block_lanes] += s[18:]
                    s[18:] = zero
        return out

    return run


def _compile_tanh(precision: str) -> Callable[[float], float]:
    """tanh by rational functions, without calls, so that it can be computed in vectors."""
    from numba import njit

    t = np.dtype(precision).type
    if precision == "float32":
        edge = t(7.90531110763549805)
        p0, p1, p2, p3 = t(-2.76076847742355e-16), t(2.00018790482477e-13), t(-8.60467152213735e-11), t(5.12229709037114e-08)
        p4, p5, p6 = t(1.48572235717979e-05), t(6.37261928875436e-04), t(4.89352455891786e-03)
        q0, q1, q2, q3 = t(1.19825839466702e-06), t(1.18534705686654e-04), t(2.26843463243900e-03), t(4.89352518554385e-03)

        @njit(inline="always")
        def single(x):  # pragma: no cover
            x = min(max(x, -edge), edge)
            z = x * x
            up = (((((p0 * z + p1) * z + p2) * z + p3) * z + p4) * z + p5) * z + p6
            return x * up / (((q0 * z + q1) * z + q2) * z + q3)

        return single

    @njit(inline="always")
    def double(x):  # pragma: no cover
        a = min(abs(x), 22.0)
        z = a * a
        up = (-9.64399179425052238628e-1 * z - 9.92877231001918586564e1) * z - 1.61468768441708447952e3
        down = ((z + 1.12811678491632931402e2) * z + 2.23548839060100448583e3) * z + 4.84406305325125486048e3
        near = a + a * z * up / down
        y = 2.0 * a
        n = np.floor(y * 1.4426950408889634 + 0.5)
        r = (y - n * 6.93145751953125e-1) - n * 1.42860682030941723212e-6
        s = r * r
        up = r * ((1.26177193074810590878e-4 * s + 3.02994407707441961300e-2) * s + 9.99999999999999999910e-1)
        down = ((3.00198505138664455042e-6 * s + 2.52448340349684104192e-3) * s + 2.27265548208155028766e-1) * s + 2.0
        power = 1.0
        for bit in (32.0, 16.0, 8.0, 4.0, 2.0, 1.0):
            # a power by its binary digits: there is no vector form of ldexp
            power = power * 2.0**bit if n >= bit else power
            n = n - bit if n >= bit else n
        far = 1.0 - 2.0 / ((1.0 + 2.0 * up / (down - up)) * power + 1.0)
        value = near if a < 0.625 else far
        return value if x >= 0.0 else -value

    return double
