"""A drive of one's own with three encoders, registered for a test."""

import contextlib

import jaxbl
from jaxbl.drive import DRIVES
from jaxbl.drive.parameters import Scalar, parameter

SIDES = ("motor", "middle", "load")


class ThreeSides(jaxbl.AbstractDrive):
    """Three inertias: a shaft, and a gap behind it."""

    name = "three_sides"
    sides = SIDES
    motor_inertia: Scalar = parameter("kg m²", "motor inertia", above=0.0)
    middle_inertia: Scalar = parameter("kg m²", "inertia between", above=0.0)
    load_inertia: Scalar = parameter("kg m²", "load inertia", above=0.0)
    motor_viscous: Scalar = parameter("N m s/rad", "motor viscous friction", minimum=0.0)
    middle_viscous: Scalar = parameter("N m s/rad", "viscous friction between", minimum=0.0)
    load_viscous: Scalar = parameter("N m s/rad", "load viscous friction", minimum=0.0)
    stiffness: Scalar = parameter("N m/rad", "stiffness of shaft and gear", above=0.0)
    half_gap: Scalar = parameter("rad", "half of the gap", minimum=0.0)

    def body_torques(self, position, velocity):
        before = jaxbl.LinearShaft(self.stiffness)(position["motor"] - position["middle"])
        behind = jaxbl.DeadZone(self.stiffness, self.half_gap)(position["middle"] - position["load"])
        return {"motor": -before, "middle": before - behind, "load": behind}


NUMBERS = {"motor_inertia": 0.01, "middle_inertia": 0.02, "load_inertia": 0.05, "motor_viscous": 0.02,
           "middle_viscous": 0.05, "load_viscous": 0.1, "stiffness": 40.0, "half_gap": 0.02}  # fmt: skip
STUDY = {
    "drive": {"kind": "three_sides"} | NUMBERS,
    "excitation": {"kind": "sine", "amplitude": 1.0, "frequency": 0.8},
    "encoders": {"noise": 1e-5, "load_resolution": 1e-5},
    "observer": {side: {"lambda": 6.0, "alpha": 60.0} for side in SIDES},
    "run": {"duration": 1.0, "velocity_tolerance": 0.2},
}


@contextlib.contextmanager
def registered(cls=ThreeSides):
    """Register a drive of one's own for as long as the context lasts."""
    jaxbl.register(cls)
    try:
        yield
    finally:
        DRIVES._members.pop(cls.name)
