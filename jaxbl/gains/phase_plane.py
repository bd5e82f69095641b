"""The error (33)-(34) of an observer in its phase plane: slope, peaks, majorant of the proof (Fig. 29)."""

import numpy as np

from jaxbl.observer.conditions import least_lambda_davila_fridman
from jaxbl.sweeps.elementwise import call_in_float64


def error_slope(error: np.ndarray, rate: np.ndarray, lambda_: float) -> np.ndarray:
    """Slope of the position error (rad/s): the velocity error less the square-root term of (7)-(8).

    Args:
        error: position error (rad).
        rate: velocity error (rad/s), of the same shape.
        lambda_: gain.
    """
    return rate - lambda_ * np.sqrt(np.abs(error)) * np.sign(error)


def error_peaks(error: np.ndarray, rate: np.ndarray, most_peaks: int) -> tuple[np.ndarray, np.ndarray]:
    """Peaks of an observer's velocity error: its values where the position error changes sign.

    Args:
        error: position error (rad) at each sample.
        rate: velocity error without the square-root term (rad/s), which is the slope of `error` where that is zero.
        most_peaks: peaks that are wanted.

    Returns:
        Indices of the samples before, and peaks (rad/s); those that stand out from the chatter of the last quarter (three
        times its rms), the first `most_peaks` only.
    """
    crossings = np.flatnonzero((error[:-1] * error[1:] < 0.0) | ((error[:-1] == 0.0) & (error[1:] != 0.0)))
    share = error[crossings] / (error[crossings] - error[crossings + 1])
    peaks = rate[crossings] + share * (rate[crossings + 1] - rate[crossings])
    chatter = 3.0 * np.sqrt(np.mean(rate[-max(len(rate) // 4, 1) :] ** 2))
    below_chatter = np.flatnonzero(~(np.abs(peaks) > chatter))
    count = min(below_chatter[0] if len(below_chatter) else len(peaks), most_peaks)
    return crossings[:count], peaks[:count]


def majorant(peak: float, lambda_: float, alpha: float, f_plus: float) -> tuple[np.ndarray, np.ndarray]:
    """The majorant curve (36) of a half cycle and of the next one, from a peak (rad/s): e (rad) and its slope (rad/s).

    Each half cycle drops from its largest e to the next peak, which is (37) times the one before. Needs alpha > f and
    lambda > 0.
    """
    ratio = float(call_in_float64(least_lambda_davila_fridman, alpha, f_plus)) / lambda_
    along = np.linspace(0.0, 1.0, 100)
    # (36), as e over its largest, and slope over the peak
    e, slope = np.r_[along * (2.0 - along), 1.0, 0.0], np.r_[1.0 - along, -ratio, -ratio]
    largest = peak**2 / (2.0 * (alpha - f_plus)) * np.sign(peak)
    return largest * np.r_[e, -(ratio**2) * e], peak * np.r_[slope, -ratio * slope]
