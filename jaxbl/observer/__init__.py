"""What runs in real time: super-twisting observers, equivalent control, recursive least squares; and gain conditions."""

from .equivalent_control import EquivalentControl as EquivalentControl
from .recursive import Identifier as Identifier
from .recursive import IdentifierState as IdentifierState
from .super_twisting import OBSERVERS as OBSERVERS
from .super_twisting import AbstractSuperTwisting as AbstractSuperTwisting
from .super_twisting import Estimate as Estimate
from .super_twisting import ExplicitSuperTwisting as ExplicitSuperTwisting
from .super_twisting import ImplicitSuperTwisting as ImplicitSuperTwisting
from .super_twisting import Observers as Observers
from .super_twisting import ObserverState as ObserverState
