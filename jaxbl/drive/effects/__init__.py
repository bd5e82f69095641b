"""Physical effects beyond the nominal drive: one class each, with a full name such as `load.coulomb_friction`.

Each family has a file. Installed packages add effects by the entry-point group `jaxbl.effects`: the entry point's name is
the effect's full name, its object a subclass of :class:`SideEffect`, :class:`TransmissionEffect`, :class:`ActuatorEffect`
or :class:`EncoderEffect`.
"""

# ruff: noqa: I001
# families, and the effects of each, stand in the order in which a model with all effects has them
from .friction import CoulombFriction, StribeckFriction, PreslidingFriction, DriftingFriction
from .friction import ViscousFriction, AsymmetricFriction, QuadraticDrag
from .loads import (
    ConstantTorque,
    Inertia,
    Gravity,
    PeriodicDisturbance,
    Cogging,
    CoggingHarmonics,
    TorqueRipple,
    Flexibility,
)
from .tables import Tabulated
from .gear import Backlash, Hardening, Damping, Hysteresis, Eccentricity, LoadFriction, TwistOffset
from .actuator import DELAY_SAMPLES, Delay, GainError, Saturation, Lag, BackEmf
from .encoders import Offset, Skew, EncoderEccentricity
from .base import (
    EFFECTS,
    AbstractEffect,
    ActuatorEffect,
    EncoderEffect,
    Motion,
    Numbers,
    Role,
    Scales,
    SideEffect,
    TransmissionEffect,
    angle,
    correction_of,
    frequency,
    harmonic,
    held,
    make_effect,
    shape,
    size,
    table,
)
