"""What runs in real time: observers, equivalent control, recursive least squares; and gain conditions.

Observers are in the order in which lists name them.
"""

# ruff: noqa: I001
from .base import OBSERVERS, AbstractObserver, OperatingConditions, Estimate, Observers, ObserverState
from .super_twisting import DISCRETISATIONS, AbstractSuperTwisting, ExplicitSuperTwisting, ImplicitSuperTwisting
from .differentiator import COEFFICIENTS, DIFFERENTIATORS, AbstractDifferentiator
from .linear import DirtyDerivative, ExtendedState, Kalman, Luenberger
from .equivalent_control import EquivalentControl
from .recursive import Identifier
