"""Plant steps so fine that their error does not count in the numbers of a fit.

Finer steps change the simulated positions; the fit's derivatives say what that change does to its numbers. Where it is more
than a tenth of their standard errors, what finer steps add to the positions is simulated, and the fit done again with it
(defect correction): with the study's steps and their compiled programs, but the positions of finer ones.
Reference: H. Stetter, The defect correction principle and discretization methods, Numer. Math. 29 (1978).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jaxbl.chain import Experiment

from .free_parameters import PRIOR_DEVIATION, FreeParameter, set_free_parameters
from .intervals import spread
from .trajectory import Fit, Windows, fit, positions_over_noise, simulate_windows

_SHARE = 0.1
"""Of a standard error that twice as many steps may change a number: coverage of 95 % falls by 0.1 % then."""
_LINEAR = 1.0
"""Standard errors by which a number may move without a new fit: the derivatives hold there to a few percent."""
_LESS_LIKELY = 2.0
"""Loss of log-likelihood with finer steps from which on the study's are right: the log is a simulation with them."""
_MOST = 640
"""Plant steps in a sample."""
_FITS = 3
"""Fits with the positions of finer steps, at most."""


def refine_steps(
    experiment: Experiment, free: Sequence[FreeParameter], windows: Windows, first: Fit
) -> tuple[Windows, Fit, Sequence[np.ndarray], int]:
    """Refine the plant steps of a fit until twice as many change no number by a tenth of its standard error.

    Args:
        experiment: the nominal model, with the study's steps.
        free: numbers that were fitted.
        windows: the record.
        first: fit with the study's steps.

    Returns:
        Windows and fit with finer steps, or as they were if these make the log less likely; errors of theta that remain,
        each of shape (parameters,); and plant steps in a sample.
    """
    study_windows, best, change, left, excess = windows, first, np.zeros(len(free)), np.zeros(len(free)), 0.0
    steps = study_steps = experiment.run.substeps

    def simulate(steps: int) -> np.ndarray:
        """Positions of the best fit over the noise with so many plant steps in a sample, shape (windows, samples, sides)."""
        model = set_free_parameters(experiment, free, best.theta)
        model = replace(model, run=replace(model.run, substeps=steps))
        return positions_over_noise(model, windows, simulate_windows(model, windows, best.start).position)

    for fits_left in reversed(range(_FITS)):
        deviation = spread(best).deviations
        jacobian = best.jacobian.reshape(-1, len(free))
        normal = jacobian.T @ jacobian + np.eye(len(free)) / PRIOR_DEVIATION**2
        # of what diverges nothing is finite, and finer steps are of no help
        with np.errstate(all="ignore"):
            coarse = fine = simulate(study_steps)
            while True:
                half = simulate(2 * steps)
                left = np.linalg.solve(normal, jacobian.T @ (half - fine).ravel())
                excess = float(np.max(np.abs(left) / deviation)) / _SHARE
                if not excess > 1.0 or steps >= _MOST:
                    break
                # errors fall with the square of the steps
                steps = min(steps * 2 ** int(np.ceil(0.5 * np.log2(excess) + 1e-9)), _MOST)
                fine = simulate(steps)
        if steps == study_steps:
            return windows, best, [], steps
        finer = half - coarse
        change = np.linalg.solve(normal, jacobian.T @ (finer - windows.finer).ravel())
        windows = replace(windows, finer=finer)
        if np.all(np.abs(change) < _LINEAR * deviation):
            best, change = best._replace(theta=best.theta + change), np.zeros(len(free))
            break
        if fits_left:
            best = fit(experiment, free, windows, best.theta)
            if not best.cost - first.cost < _LESS_LIKELY * spread(first).variance:
                return study_windows, first, [change], study_steps
    # by the order of the steps, a third of the last change is left
    return windows, best, [change, left / 3.0] if excess > 1.0 else [change], 2 * steps
