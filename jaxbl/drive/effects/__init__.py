"""Physical effects beyond the nominal drive, each written once and known by its full name (`load.coulomb_friction`).

One file a family. Further packages add effects through the entry-point group `jaxbl.effects`: the entry's name is the
effect's name, its object a subclass of :class:`SideEffect`, :class:`TransmissionEffect` or :class:`ActuatorEffect`.
"""

# ruff: noqa: I001
# families in the order in which a model with all effects has them
from .friction import CoulombFriction as CoulombFriction
from .friction import StribeckFriction as StribeckFriction
from .friction import ViscousFriction as ViscousFriction
from .friction import QuadraticDrag as QuadraticDrag
from .loads import ConstantTorque as ConstantTorque
from .loads import Inertia as Inertia
from .loads import Gravity as Gravity
from .loads import PeriodicDisturbance as PeriodicDisturbance
from .loads import Cogging as Cogging
from .gear import Backlash as Backlash
from .gear import Hardening as Hardening
from .gear import Damping as Damping
from .gear import Eccentricity as Eccentricity
from .actuator import GainError as GainError
from .actuator import Saturation as Saturation
from .actuator import Lag as Lag
from .base import EFFECTS as EFFECTS
from .base import AbstractEffect as AbstractEffect
from .base import ActuatorEffect as ActuatorEffect
from .base import Motion as Motion
from .base import Numbers as Numbers
from .base import Role as Role
from .base import Scales as Scales
from .base import SideEffect as SideEffect
from .base import TransmissionEffect as TransmissionEffect
from .base import angle as angle
from .base import correction_of as correction_of
from .base import frequency as frequency
from .base import harmonic as harmonic
from .base import make_effect as make_effect
from .base import shape as shape
from .base import size as size
