"""Kinematics as commonly found: Butterworth low-pass of 4th order forth and back, then central differences."""

import numpy as np
from scipy import signal

from jaxbl.estimation.regression import Kinematics
from jaxbl.estimation.segments import Segment
from jaxbl.estimation.smoother import Smoothed


def differentiate(time: np.ndarray, torque: np.ndarray, positions: dict[str, np.ndarray], cutoff: float) -> Kinematics:
    """Kinematics of a log.

    Args:
        time: even, s, shape (samples,).
        torque: input held from each sample to the next, N m, shape (samples,).
        positions: of each side, rad, shape (samples,).
        cutoff: of the low-pass, Hz.
    """
    period = (time[-1] - time[0]) / (len(time) - 1)
    sections = signal.butter(4, min(2.0 * cutoff * period, 0.99), output="sos")
    smoothed = {}
    for side, position in positions.items():
        smooth = signal.sosfiltfilt(sections, position)
        velocity = np.gradient(smooth, period)
        states = np.stack([smooth, velocity, np.gradient(velocity, period)], axis=1)
        smoothed[side] = Smoothed(states, np.empty(0), np.nan, np.nan)
    return Segment(slice(0, len(time)), time, period, torque, positions, smoothed).kinematics
