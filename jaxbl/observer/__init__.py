"""What runs in real time: super-twisting observers, equivalent control, recursive least squares; and gain conditions."""

from .equivalent_control import EquivalentControl
from .recursive import Identifier
from .super_twisting import OBSERVERS, ExplicitSuperTwisting, ImplicitSuperTwisting, Observers, ObserverState
