"""Free parameters: the numbers of an experiment that a fit may change, and the coordinates theta of the fit."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxbl.drive.parameters import Parameter, get_leaf, leaf_paths, set_leaves
from jaxbl.errors import InputError
from jaxbl.simulate import Experiment

PLANT_TABLES = ("drive", "transmission", "effects")
"""Tables of the config whose numbers move the plant."""
PRIOR_DEVIATION = 3.0
"""Standard deviation of theta before a log is seen: a factor of e^3, wider than any number is known."""


class FreeParameter(NamedTuple):
    """A number to be fitted. It is scale exp(theta) if it must stay positive, otherwise nominal + scale theta.

    theta is 0 at the nominal value. A change of theta is a relative change of the number, or of an angle one in rad.

    Attributes:
        path: dotted path of the number in the experiment.
        unit: of the number.
        nominal: value before the fit.
        scale: change of the number per change of theta, at theta = 0.
        positive: True if the number must stay positive.
        role: its part in an effect (:class:`jaxbl.drive.effects.Role`); "" for other numbers.
        maximum: largest value that a study may give it, or None.
    """

    path: str
    unit: str
    nominal: float
    scale: float
    positive: bool
    role: str = ""
    maximum: float | None = None

    def value(self, theta: Any) -> Any:
        """The number at a theta, an array or a float."""
        value = self.scale * _exp(theta) if self.positive else self.nominal + self.scale * theta
        if self.maximum is None:
            return value
        return jnp.minimum(value, self.maximum) if isinstance(value, jax.Array) else np.minimum(value, self.maximum)

    def slope(self, theta: Any) -> Any:
        """Derivative of the number by theta."""
        return self.scale * (_exp(theta) if self.positive else 0.0 * theta + 1.0)


def _exp(theta: Any) -> Any:
    # JAX would compile a program for a single number
    return jnp.exp(theta) if isinstance(theta, jax.Array) else np.exp(theta)


def make_free_parameters(experiment: Experiment, paths: Sequence[str], torque: float) -> tuple[FreeParameter, ...]:
    """Make free parameters of the numbers at some paths.

    Args:
        experiment: has the nominal values.
        paths: dotted paths of numbers of the plant.
        torque: size of the input, N m: the scale of torques whose nominal value is 0.

    Raises:
        InputError: a path that is unknown or named twice, or a positive number without a nominal value.
    """
    parameters = {path: leaf for path, leaf in leaf_paths(experiment).items() if path.split(".")[0] in PLANT_TABLES}
    free: list[FreeParameter] = []
    for path in paths:
        if path not in parameters:
            raise InputError(f"'{path}' is no number of the plant; fitted can be: {', '.join(parameters)}")
        if path in paths[: len(free)]:
            raise InputError(f"'{path}' is named twice; once is enough")
        nominal, parameter = float(get_leaf(experiment, path)), parameters[path]
        positive = is_positive(parameter)
        if positive and nominal <= 0.0:
            raise InputError(f"'{path}' must stay positive, and its nominal value is {nominal:g}; give one to start from")
        role = parameter.role.kind if parameter.role else ""
        # an angle has no relative size
        scale = 1.0 if role == "angle" else abs(nominal) or (torque if parameter.unit == "N m" else 0.0) or 1.0
        free.append(FreeParameter(path, parameter.unit, nominal, scale, positive, role, parameter.maximum))
    return tuple(free)


def is_positive(parameter: Parameter) -> bool:
    """True if a number must not become negative."""
    return any(limit is not None and limit >= 0.0 for limit in (parameter.minimum, parameter.above))


def set_free_parameters(experiment: Experiment, free: Sequence[FreeParameter], theta: Array | np.ndarray) -> Experiment:
    """Return the experiment with the free parameters at theta, shape (parameters,)."""
    return set_leaves(experiment, {parameter.path: parameter.value(theta[i]) for i, parameter in enumerate(free)})
