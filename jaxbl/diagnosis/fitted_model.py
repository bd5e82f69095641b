"""A model with some effects whose numbers are all fitted, and what may be said of these numbers."""

from typing import NamedTuple

import numpy as np

from jaxbl.chain import Experiment
from jaxbl.drive.effects import EFFECTS, Numbers, make_effect
from jaxbl.drive.parameters import get_leaf, leaf_paths, set_leaves
from jaxbl.estimation.free_parameters import FreeParameter
from jaxbl.estimation.logs import arrays
from jaxbl.fused import Arrays

from .linearised_model import Linear, Predictor
from .thresholds import LIMITS

LEAST_LEFT = 0.05
"""Share of a positive number that is left of it at least where it is moved."""


class FitPoint(NamedTuple):
    """Numbers and initial states that a fit of prediction errors has tried.

    Attributes:
        theta: of all numbers.
        start: initial positions and velocities of each segment.
        linear: the model there, along the path of its predictor.
        predictor: of it.
        cost: minus twice the log-likelihood, with the prior.
    """

    theta: np.ndarray
    start: Arrays
    linear: Linear
    predictor: Predictor
    cost: float


class FittedModel(NamedTuple):
    """A model with some effects, all numbers fitted.

    Attributes:
        names: of the effects.
        experiment: the model.
        free: numbers that were fitted, its own first.
        theta: of these.
        covariance: of theta.
        white: the same if prediction errors are white, as those of a complete model.
        inflation: of their variances, by not knowing the other numbers; of what is wrong with a number, that of the number.
        end: where the fit ended: another one begins there.
        left_out: changes of theta where one quarter of the log after the other is left out; shape (quarters, theta).
        log_odds: of the effects before the log is seen, nats.
        log_evidence: nats, by Laplace's method (D. MacKay, Neural Computation 4, 1992); only differences count.
        foretold: prediction errors, each quarter by numbers fitted without it, rad, shape (samples, sides).
    """

    names: tuple[str, ...]
    experiment: Experiment
    free: tuple[FreeParameter, ...]
    theta: np.ndarray
    covariance: np.ndarray
    white: np.ndarray
    end: FitPoint
    left_out: np.ndarray | None = None
    log_odds: float = 0.0
    log_evidence: float = -np.inf
    foretold: np.ndarray | None = None
    inflation: np.ndarray = np.ones(0)

    @property
    def linear(self) -> Linear:
        """The model along the log; of the model as given, with its own numbers fitted."""
        return self.end.linear

    def share(self, name: str) -> float:
        """Torque of an effect along the log, rms over the driving torque's."""
        return self.linear.torque_share(get_leaf(self.experiment, f"effects.{name}"))

    def own_share(self, name: str) -> float:
        """Torque of an effect that no other number of the model makes up for, as :meth:`share`."""
        sizes = {f"effects.{name}.{leaf}" for leaf in EFFECTS[name].sizes()}
        inflation = [factor for number, factor in zip(self.free, self.inflation, strict=True) if number.path in sizes]
        return self.share(name) / float(np.sqrt(min(inflation, default=1.0)))

    def missed_share(self, name: str) -> float:
        """Torque that laws of the other effects may miss, as :meth:`share`."""
        laws = [effect for effect in self.experiment.effects if effect.law_error and effect.name != name]
        return float(np.linalg.norm([effect.law_error * self.linear.torque_share(effect) for effect in laws]))

    def counts(self, name: str) -> bool:
        """Tell whether the log shows an effect, and its torque is large enough to be named; of a finer law, what parts it
        from the plain one has to be, too."""
        effect, place, numbers = get_leaf(self.experiment, f"effects.{name}"), name.partition(".")[0], self.numbers[name]
        plain = [make_effect(f"{place}.{kind}", **law) for kind, law in EFFECTS[name].plainer(numbers).items()]
        return self.linear.shows(name, numbers) and all(
            self.linear.torque_share(effect, *less) > LIMITS.least_torque for less in [(), *zip(plain)]
        )

    @property
    def numbers(self) -> dict[str, Numbers]:
        """All numbers of the effects, those that were not free among them."""
        effects = {name: get_leaf(self.experiment, f"effects.{name}") for name in self.names}
        return {
            name: {leaf: float(get_leaf(effect, leaf)) for leaf in leaf_paths(effect)} for name, effect in effects.items()
        }

    def errors(self) -> Numbers:
        """Standard errors of the values."""
        deviation = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return {number.path: float(number.slope(self.theta[i])) * deviation[i] for i, number in enumerate(self.free)}

    def move_by(self, change: np.ndarray) -> Experiment:
        """The model with a change of theta, to first order: a number that the log hardly shows may change by several times
        its size, and by no more; what must stay positive stays so."""
        values = {}
        for number, theta, step in zip(self.free, self.theta, change, strict=True):
            value, slope = float(number.value(theta)), float(number.slope(theta))
            values[number.path] = max(value + slope * step, LEAST_LEFT * value) if number.positive else value + slope * step
        return set_leaves(self.experiment, arrays(values))
