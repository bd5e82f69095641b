"""Numbers of least missing torque, for a model that is known not to be complete.

Of a complete model the prediction errors are noise, and the numbers of least prediction errors are the best there are. Where
something else is missing, a one-step predictor weighs it by how fast it changes, and numbers take over what they should not.
Here they leave the least torque behind the low-pass, with the prior on the model's own numbers kept.
References: M. Gautier, Dynamic identification of robots with power model, ICRA (1997); L. Ljung, System Identification
(1999), 8.5 (where the truth is not in the model set, the fit depends on the prefilter).
"""

import numpy as np
from scipy.optimize import least_squares

from jaxbl.identification.free_parameters import set_free_parameters
from jaxbl.identification.intervals import long_run

from .candidates import are_possible
from .fitted_model import FittedModel
from .reference_log import ReferenceLog
from .refit import ModelFits, leave_quarters_out

_STEP = 1e-4
"""Of theta, for differences: numbers are in units of themselves."""
_EVALUATIONS = 10
"""Of the fit, which begins near its end."""


def fit_to_torque(fits: ModelFits, fitted: FittedModel, log: ReferenceLog) -> FittedModel | None:
    """A model with the numbers of least missing torque, each side's over what it is at first; None if they are not possible.

    Torques are referred to the input: none becomes smaller because all do. Standard errors allow for correlation.
    """
    own, sides = len(fits.free), fitted.experiment.sides
    prior = np.concatenate([fits.prior**-2.0, np.zeros(len(fitted.free) - own)])
    # behind the low-pass there is one independent error in half a period
    apart = {side: max(0.5 / (log.bandwidth[side] * log.period), 1.0) for side in sides}
    first = log.missing(fitted.experiment)
    scale = {side: np.sqrt(apart[side] * np.mean(first[side] ** 2)) for side in sides}
    counts = [len(first[side]) for side in sides]

    def missing(theta: np.ndarray) -> np.ndarray:
        experiment = set_free_parameters(fitted.experiment, fitted.free, theta)
        left, gain = log.missing(experiment), float(experiment.plant.input_gain)
        return np.concatenate([left[side] / (gain * scale[side]) for side in sides])

    def slopes(theta: np.ndarray) -> np.ndarray:
        at = missing(theta)
        return np.stack([(missing(theta + change) - at) / _STEP for change in _STEP * np.eye(len(theta))], axis=1)

    root = np.diag(np.sqrt(prior))
    found = least_squares(
        lambda theta: np.concatenate([missing(theta), root @ theta]),
        fitted.theta,
        lambda theta: np.concatenate([slopes(theta), root]),  # type: ignore[arg-type]
        max_nfev=_EVALUATIONS,
    )
    jacobian, left = found.jac[: -len(root)], found.fun[: -len(root)]
    experiment = set_free_parameters(fitted.experiment, fitted.free, found.x)
    variance = float(np.mean((left * np.repeat(np.sqrt(list(apart.values())), counts)) ** 2))
    white = np.linalg.pinv(jacobian.T @ jacobian / variance + np.diag(prior), hermitian=True)
    middle = long_run(jacobian * left[:, None]) / variance**2 + np.diag(prior)
    # sides stand one after the other: a quarter of the log is a quarter of each
    order = np.argsort(np.concatenate([np.arange(count) / count for count in counts]), kind="stable")
    changes = leave_quarters_out(left[order, None], jacobian[order, None], np.diag(prior))
    model = fitted._replace(
        experiment=experiment, theta=found.x, covariance=white @ middle @ white, white=white, left_out=changes
    )
    numbers = model.numbers
    return model._replace(linear=fits.linearise(numbers, found.x[:own])) if are_possible(numbers, log.period) else None
