"""Observers, equivalent control and recursive least squares, which run in real time; and gain conditions.

Observers stand in the order in which lists name them.
"""

# ruff: noqa: I001
from .base import OBSERVERS, AbstractObserver, OperatingConditions, Estimate, Observers, ObserverState
from .super_twisting import DISCRETISATIONS, AbstractSuperTwisting, ExplicitSuperTwisting, ImplicitSuperTwisting
from .differentiator import COEFFICIENTS, DIFFERENTIATORS
from .linear import DirtyDerivative, ExtendedState, Kalman, Luenberger
from .equivalent_control import EquivalentControl
from .recursive import Identifier
