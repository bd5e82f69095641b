"""Free parameters: the numbers of an experiment that a fit may change, and the coordinates theta of the fit."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxbl.chain import Experiment
from jaxbl.drive.parameters import get_leaf, leaf_paths, set_leaves
from jaxbl.errors import InputError

PLANT_TABLES = ("drive", "transmission", "effects")
"""Tables of the config whose numbers move the plant."""
PRIOR_DEVIATION = 3.0
"""Standard deviation of theta before a log is seen: a factor of e^3, wider than any number is known."""


class FreeParameter(NamedTuple):
    """A number to be fitted. It is scale exp(theta) if it stays positive, otherwise nominal + scale theta.

    theta is 0 at the nominal value. A change of theta is a relative change of the number, or of an angle one in rad; of a
    number that is nominally 0 it is a share of the size that the log gives it (:func:`make_free_parameters`).

    Attributes:
        path: dotted path of the number in the experiment.
        unit: of the number.
        nominal: value before the fit.
        scale: change of the number per change of theta, at theta = 0.
        positive: True if the number stays positive in a fit.
        role: its part in an effect (:class:`jaxbl.drive.effects.Role`); "" for other numbers.
        maximum: largest value that a study may give it, or None.
        minimum: 0 if a study may not make it negative, or None. Fits go through 0, so that what is 0 is found without bias;
            what they tell is not below.
    """

    path: str
    unit: str
    nominal: float
    scale: float
    positive: bool
    role: str = ""
    maximum: float | None = None
    minimum: float | None = None

    def value(self, theta: Any) -> Any:
        """The number at a theta, an array or a float."""
        value = self.scale * _exp(theta) if self.positive else self.nominal + self.scale * theta
        if not isinstance(value, jax.Array):
            return np.clip(value, -np.inf if self.minimum is None else self.minimum, self.maximum)
        return value if self.maximum is None else jnp.minimum(value, self.maximum)

    def theta(self, value: float) -> float:
        """Theta at a value."""
        return float(np.log(value / self.scale) if self.positive else (value - self.nominal) / self.scale)

    def slope(self, theta: Any) -> Any:
        """Derivative of the number by theta."""
        return self.scale * (_exp(theta) if self.positive else 0.0 * theta + 1.0)


def _exp(theta: Any) -> Any:
    # JAX would compile a program for a single number
    return jnp.exp(theta) if isinstance(theta, jax.Array) else np.exp(theta)


class SignalSizes(NamedTuple):
    """Sizes of a log's signals, from which a number that is nominally 0 gets its scale.

    Attributes:
        torque: of the input, N m.
        speed: of the motor, rad/s.
        twist: of the transmission, rad.
    """

    torque: float
    speed: float = 0.0
    twist: float = 0.0

    def scale_number(self, experiment: Experiment, path: str, unit: str) -> float:
        """Size of a number at which its torque is that of the input, by its unit; 1 where the log gives none."""
        side = "load" if path.split(".")[1].startswith("load") and "load" in experiment.sides else "motor"
        ratio = float(experiment.drive.ratio(side))
        torque, speed = self.torque * ratio, self.speed / ratio
        with np.errstate(divide="ignore", invalid="ignore"):
            size = {
                "N m": torque,
                "N m s/rad": np.divide(torque, speed),
                "N m s²/rad²": np.divide(torque, speed**2),
                "N m/rad³": np.divide(torque, self.twist**3),
                "kg m²": float(experiment.drive.inertia(side)),
                "rad": self.twist,
                "s": float(experiment.run.sample_period),
            }.get(unit, 1.0)
        return float(size) if np.isfinite(size) and size > 0.0 else 1.0


def make_free_parameters(
    experiment: Experiment, paths: Sequence[str], sizes: SignalSizes | float
) -> tuple[FreeParameter, ...]:
    """Make free parameters of the numbers at some paths.

    Args:
        experiment: has the nominal values.
        paths: dotted paths of numbers of the plant.
        sizes: of the log's signals, or of its input alone (N m): they scale what is nominally 0.

    Raises:
        InputError: a path that is unknown or named twice.
    """
    sizes = sizes if isinstance(sizes, SignalSizes) else SignalSizes(sizes)
    parameters = {path: leaf for path, leaf in leaf_paths(experiment).items() if path.split(".")[0] in PLANT_TABLES}
    free: list[FreeParameter] = []
    for path in paths:
        if path not in parameters:
            raise InputError(f"'{path}' is no number of the plant; fitted can be: {', '.join(parameters)}")
        if path in paths[: len(free)]:
            raise InputError(f"'{path}' is named twice; once is enough")
        nominal, parameter = float(get_leaf(experiment, path)), parameters[path]
        role = parameter.role.kind if parameter.role else ""
        limits = parameter.minimum, parameter.above
        minimum = 0.0 if any(limit is not None and limit >= 0.0 for limit in limits) else None
        # an angle has no relative size
        scale = 1.0 if role == "angle" else abs(nominal) or sizes.scale_number(experiment, path, parameter.unit)
        positive = minimum is not None and nominal > 0.0
        free.append(FreeParameter(path, parameter.unit, nominal, scale, positive, role, parameter.maximum, minimum))
    return tuple(free)


def free_values(free: Sequence[FreeParameter], theta: np.ndarray) -> dict[str, float]:
    """Values of free numbers, by path; theta may have others behind them."""
    return {number.path: float(number.value(theta[i])) for i, number in enumerate(free)}


def set_free_parameters(experiment: Experiment, free: Sequence[FreeParameter], theta: Array | np.ndarray) -> Experiment:
    """Return the experiment with the free parameters at theta, shape (parameters,)."""
    return set_leaves(experiment, {parameter.path: parameter.value(theta[i]) for i, parameter in enumerate(free)})
