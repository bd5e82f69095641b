"""The error of gains that miss the exact condition, under a known disturbance instead of the worst one.

The error system is x1' = x2 - lambda sqrt|x1| sign x1, x2' = d(t) - alpha sign x1 - damping x2. Between two passages through
x1 = 0 it makes a half cycle; a peak V is |x2| at such a passage. Unless said to be exact, what follows is to first order in
the losses of a half cycle (lambda, damping) and, for :func:`peak_law`, in the change of d over one. Derived for this project
(docs/theory_appendix.md), and checked against :func:`simulate_error`, which takes no such approximation.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid, solve_ivp
from scipy.optimize import root

_TOLERANCE = 1e-9
"""Relative tolerance of the simulated half cycles."""
_ZERO_RATIO = 1e-4
"""Peak over the first one, below which the error counts as zero."""
_MOST_HALF_CYCLES = 20_000
_LONGEST_HALF_CYCLE = 1e5
"""Longest half cycle in tau, over 1 / sqrt(alpha); without disturbance it takes 4.4."""
_STARTING_SHARE = 1e-3
"""Share of a pulse's final speed from which on a zero error is simulated."""


class Disturbance(NamedTuple):
    """Disturbance of an error: d (rad/s^2) at evenly spaced times (s), linear between them, and damping of x2 (1/s).

    The arrays have one shape (n,).
    """

    times: np.ndarray
    values: np.ndarray
    damping: float = 0.0

    def share_above(self, alpha: float) -> float:
        """Return the share of the time in which |d| exceeds alpha."""
        return float(np.mean(np.abs(self.values) > alpha))


def peak_law(lambda_: float, alpha: float, disturbance: Disturbance, peak: float) -> np.ndarray:
    """Return the peaks of the error over time under a slow disturbance below alpha.

    Without losses a cycle keeps its area V^3 / (alpha^2 - d^2), so that peaks V follow the disturbance and come back with
    it. Damping shrinks peaks at a third of its rate. lambda shrinks them at a rate k that does not depend on V: in a half
    cycle by exp(-(lambda / 2) pi / sqrt(2 (alpha - d))) (on the side x1 > 0; lambda^2 small beside alpha - d), and a cycle
    takes 4 V alpha / (alpha^2 - d^2). Together V' = V (ln(alpha^2 - d^2))' / 3 - V damping / 3 - k(d), and V reaches zero
    after a finite time.

    Args:
        lambda_: gain, rad^0.5/s.
        alpha: gain, rad/s^2.
        disturbance: what acts on the error.
        peak: peak at the first of the times, rad/s.

    Returns:
        Peaks, rad/s, shape (n,).
    """
    # at |d| = alpha itself there is no half cycle; beside it there is one
    times, values, damping = disturbance
    above, below = (np.maximum(alpha + sign * values, 1e-9 * alpha) for sign in (1.0, -1.0))
    room = above * below
    roots = 1.0 / np.sqrt(2.0 * above) + 1.0 / np.sqrt(2.0 * below)
    rate = 0.125 * np.pi * lambda_ * roots * room / alpha
    shape = np.cbrt(room)
    decay = np.exp(-damping * (times - times[0]) / 3.0)
    lost = cumulative_trapezoid(rate / (shape * decay), times, initial=0.0)
    return shape * decay * np.maximum(peak / shape[0] - lost, 0.0)


def excursion(alpha: float, disturbance: Disturbance) -> float:
    """Return the largest |x2| (rad/s) that pulses of |d| above alpha cause from a zero error; this is exact.

    x1 keeps the sign of d as long as x2 does, so that x2' = |d| - alpha - damping x2 from the beginning of a pulse. Without
    damping x2 is the integral of |d| - alpha over the pulse.
    """
    times, values, damping = disturbance
    steps = np.diff(times)
    effective_steps = steps if damping == 0.0 else -np.expm1(-damping * steps) / damping
    columns = np.stack([np.exp(-damping * steps), effective_steps, values[:-1], values[1:]])
    # no pulse begins before the first sample above alpha
    begin = max(int(np.argmax(np.append(np.abs(values) > alpha, True))) - 1, 0)
    largest, speed, sign = 0.0, 0.0, 1.0
    for remaining_share, step, before, after in columns[:, begin:].T.tolist():
        if speed == 0.0:
            # that of the pulse that may begin here
            sign = math.copysign(1.0, after if abs(after) > alpha else before)
        # the other sign of d pulls back
        speed = max(speed * remaining_share + (sign * 0.5 * (before + after) - alpha) * step, 0.0)
        largest = max(largest, speed)
    return largest


class ErrorPath(NamedTuple):
    """A simulated error.

    Attributes:
        times: of passages through x1 = 0 (s), shape (n,).
        peaks: |x2| there (rad/s), shape (n,).
        largest: largest |x2| at any of them (rad/s); between two of them |x2| is largest at an end while |d| < alpha.
        end_time: time (s) from which on the error counts as zero; `inf` if it does not.
    """

    times: np.ndarray
    peaks: np.ndarray
    largest: float
    end_time: float


def _half_cycle(
    lambda_: float,
    alpha: float,
    disturbance: Callable[[float], Any],
    damping: float,
    start: tuple[float, float, float],
    end: float,
) -> tuple[float, float, float, bool]:
    """Simulate a half cycle. Returns x2 and time at its end, the largest |x2|, and True if x1 has come back to zero.

    `start` is the root of |x1|, x2 and the time, in the sign of x1. In tau, dt = 2 sqrt|x1| d(tau), all slopes are finite.
    """

    def slope(_: float, state: np.ndarray) -> tuple[float, float, float]:
        # NumPy's own numbers take longer one by one
        y, x2, time = state.tolist()
        return x2 - lambda_ * y, 2.0 * y * (disturbance(time) - alpha - damping * x2), 2.0 * y

    def returns(_: float, state: np.ndarray) -> float:
        return state[0]

    def run_ends(_: float, state: np.ndarray) -> float:
        return state[2] - end

    pace = 1.0 / np.sqrt(alpha)
    scale = max(abs(start[1]), start[0] / pace)

    def nears_origin(_: float, state: np.ndarray) -> float:
        # along a ray to the origin a half cycle does not end
        return abs(state[1]) + state[0] / pace - 1e-3 * _ZERO_RATIO * scale

    returns.terminal, returns.direction, run_ends.terminal, nears_origin.terminal = True, -1, True, True  # type: ignore[attr-defined]
    solution = solve_ivp(
        slope,
        (0.0, _LONGEST_HALF_CYCLE * pace),
        start,
        method="DOP853",
        events=(returns, run_ends, nears_origin),
        rtol=_TOLERANCE,
        atol=1e-3 * _TOLERANCE * scale * np.array([pace, 1.0, pace**2]),
        max_step=pace,
    )
    y, x2, time = solution.y[:, -1]
    return x2, time, float(np.abs(solution.y[1]).max()), len(solution.t_events[0]) > 0 or y <= 0.0


def simulate_error(
    lambda_: float, alpha: float, disturbance: Disturbance, *, position_error: float = 0.0, velocity_error: float
) -> ErrorPath:
    """Simulate the error system in continuous time.

    Half cycles by Runge-Kutta of order eight, relative tolerance 1e-9. An error that has fallen to 1e-4 of its first peak
    counts as zero, and stays there until |d| exceeds alpha.

    Args:
        lambda_: gain, rad^0.5/s.
        alpha: gain, rad/s^2.
        disturbance: what acts on the error.
        position_error: x1 at the first sample (rad).
        velocity_error: x2 there (rad/s).
    """
    times, values, damping = disturbance
    time, end = float(times[0]), float(times[-1])
    sign = np.sign(position_error) or np.sign(velocity_error) or 1.0
    y, x2 = float(np.sqrt(abs(position_error))), float(sign * velocity_error)
    scale = max(abs(x2), y * np.sqrt(2.0 * alpha))
    passages, peaks, largest, end_time = [], [], abs(x2), np.inf
    if y == 0.0 and x2 != 0.0:
        passages, peaks = [time], [x2]
    for _ in range(_MOST_HALF_CYCLES):
        if max(abs(x2), y) <= _ZERO_RATIO * scale:
            end_time = min(end_time, time)
            later = np.flatnonzero((times >= time) & (np.abs(values) > alpha))
            if not len(later):
                break
            sign = float(np.sign(values[later[0]]))
            time, x2 = _start_of_pulse(sign * values[later[0] :] - alpha, times[later[0] :])
            y = x2 / max(lambda_, np.sqrt(alpha))
            scale, end_time = max(scale, x2), np.inf
        x2, time, largest_speed, has_passed = _half_cycle(
            lambda_, alpha, lambda t, sign=sign: sign * float(np.interp(t, times, values)), damping, (y, x2, time), end
        )
        largest = max(largest, largest_speed)
        if has_passed:
            passages.append(time)
            peaks.append(abs(x2))
        elif time >= end * (1.0 - 1e-12):
            break
        # without a passage it has ended at the origin
        y, x2, sign = 0.0, -x2 if has_passed else 0.0, -sign
    return ErrorPath(np.array(passages), np.array(peaks), float(largest), float(end_time))


def _start_of_pulse(excess: np.ndarray, times: np.ndarray) -> tuple[float, float]:
    """Return the time, and x2 (rad/s), at which a pulse of |d| - alpha has made a zero error large enough to simulate.

    x2 is the integral of the pulse, whatever x1 is.
    """
    pulse = excess[: int(np.argmax(excess <= 0.0)) or len(excess)]
    speed = cumulative_trapezoid(pulse, times[: len(pulse)], initial=0.0)
    index = int(np.argmax(speed >= _STARTING_SHARE * speed[-1]))
    # a pulse of one sample has no area here
    return float(times[index]), float(speed[index]) or 1e-12 * float(excess[0])


class SineCycle(NamedTuple):
    """Limit cycles under d = amplitude sin(2 pi frequency t), by their peaks V (rad/s).

    Errors near `stable` come to it. `threshold` is the peak of the cycle that parts them from those that go to zero.
    """

    stable: float
    threshold: float


SINE_LIMIT = 16.0 * 2.0**0.5 / np.pi**3
"""lambda sqrt(alpha) / amplitude, up to which a sine upholds a limit cycle without damping: 0.730."""
_HALVINGS = 10
"""Halvings of a factor of four, when a least frequency is sought: to 0.14 %."""


class SineError(NamedTuple):
    """The error under sines of one amplitude (rad/s^2), with damping (1/s); gains in rad^0.5/s and rad/s^2."""

    lambda_: float
    alpha: float
    amplitude: float
    damping: float = 0.0

    def _phase_sine(self, frequency: float) -> float:
        """Return the sine of the phase at which the disturbance makes up for the losses of a half cycle."""
        friction = self.damping * self.alpha * np.pi**3 / (24.0 * 2.0 * np.pi * frequency)
        return (friction + self.lambda_ * math.sqrt(self.alpha) / SINE_LIMIT) / self.amplitude

    def predict_cycle(self, frequency: float) -> SineCycle | None:
        """Find the limit cycles under a sine of a frequency (Hz) by balance of energy; None if there is none.

        A half cycle takes half a period, in which x2 falls by 2 V = pi alpha / w - 2 (amplitude / w) cos(phase), with w = 2
        pi frequency. The sine puts in the energy 2 alpha amplitude sin(phase) / w^2; damping and lambda take out what they
        take of a parabola. The sine of the phase is at most 1: without damping there is a cycle where lambda sqrt(alpha) <
        `SINE_LIMIT` times the amplitude.
        """
        sine, circular = self._phase_sine(frequency), 2.0 * np.pi * frequency
        if sine > 1.0:
            return None
        middle, half = 0.5 * np.pi * self.alpha / circular, self.amplitude * math.sqrt(1.0 - sine**2) / circular
        return SineCycle(middle + half, middle - half)

    def predict_least_frequency(self) -> float:
        """Return the least frequency (Hz) at which a sine has a limit cycle, by :meth:`predict_cycle`.

        It is 0 without damping, and `inf` if lambda alone forbids a cycle. It is too high if alpha is close to the
        amplitude.
        """
        driving_amplitude = self.amplitude - self.lambda_ * math.sqrt(self.alpha) / SINE_LIMIT
        return self.damping * self.alpha * np.pi**2 / (48.0 * driving_amplitude) if driving_amplitude > 0.0 else np.inf

    def _find_cycle(self, frequency: float, peak: float, phase: float) -> tuple[float, float] | None:
        """Find a peak (rad/s) and phase near given ones that repeat after a simulated half cycle, by Newton's method; None
        without them."""
        circular = 2.0 * np.pi * frequency
        unit = self.alpha / circular

        def cycle_residual(unknowns: np.ndarray) -> np.ndarray:
            peak, phase = unknowns[0] * unit, unknowns[1]
            if peak <= 0.0:
                return np.array([1.0, 1.0])
            push, start = (lambda t: self.amplitude * np.sin(circular * t + phase)), (0.0, peak, 0.0)
            x2, time, _, _ = _half_cycle(self.lambda_, self.alpha, push, self.damping, start, np.inf)
            return np.array([(-x2 - peak) / unit, time * circular / np.pi - 1.0])

        solution = root(cycle_residual, (peak / unit, phase), method="hybr")
        has_converged = solution.success and np.abs(solution.fun).max() < 1e-6
        return (float(solution.x[0]) * unit, float(solution.x[1])) if has_converged else None

    def simulate_cycle(self, frequency: float) -> SineCycle | None:
        """Find the limit cycles without the approximation of :meth:`predict_cycle`, where Newton's method begins.

        Returns None if the approximation has no cycle, or if the method does not converge.
        """
        predicted = self.predict_cycle(frequency)
        if predicted is None:
            return None
        phase = math.asin(self._phase_sine(frequency))
        stable = self._find_cycle(frequency, predicted.stable, np.pi - phase)
        threshold = self._find_cycle(frequency, predicted.threshold, phase)
        return None if stable is None or threshold is None else SineCycle(stable[0], threshold[0])

    def simulate_least_frequency(self) -> float | None:
        """Find the least frequency (Hz) of a limit cycle without the approximation of :meth:`predict_least_frequency`.

        The stable cycle is followed from twice the approximate frequency down to where Newton's method finds none. Returns
        None if it finds none at all, or if the approximation is 0 or `inf`.
        """
        high = 2.0 * self.predict_least_frequency()
        predicted = self.predict_cycle(high) if 0.0 < high < np.inf else None
        if predicted is None:
            return None
        cycle = self._find_cycle(high, predicted.stable, np.pi - math.asin(self._phase_sine(high)))
        if cycle is None:
            return None
        low = 0.25 * high
        for _ in range(_HALVINGS):
            middle = math.sqrt(low * high)
            # by homogeneity peaks go with the period
            next_cycle = self._find_cycle(middle, cycle[0] * high / middle, cycle[1])
            if next_cycle is None:
                low = middle
            else:
                high, cycle = middle, next_cycle
        return high
