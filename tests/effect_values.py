"""Numbers of every effect of the package, large enough to be seen on the paper's drive."""

VALUES = {
    "motor.coulomb_friction": {"torque": 0.03},
    "load.coulomb_friction": {"torque": 0.1},
    "motor.stribeck_friction": {"torque": 0.02, "breakaway_torque": 0.05, "stribeck_velocity": 4.0},
    "load.stribeck_friction": {"torque": 0.1, "breakaway_torque": 0.2, "stribeck_velocity": 2.0},
    "motor.viscous_friction": {"viscous": 0.05},
    "load.viscous_friction": {"viscous": -0.1},
    "motor.quadratic_drag": {"drag": 0.005},
    "load.quadratic_drag": {"drag": 0.05},
    "motor.constant_torque": {"torque": 0.1},
    "load.constant_torque": {"torque": -0.2},
    "motor.inertia": {"inertia": 0.02},
    "load.inertia": {"inertia": -0.1},
    "load.gravity": {"torque": 0.5, "phase": 0.4},
    "load.periodic_disturbance": {"amplitude": 0.5, "frequency": 2.0, "phase": 0.5},
    "motor.cogging": {"amplitude": 0.1, "harmonic": 6.0, "phase": 0.3},
    "motor.torque_ripple": {"amplitude": 0.3, "harmonic": 5.0, "phase": -0.6},
    "transmission.backlash": {"half_gap": 0.04},
    "transmission.hardening": {"cubic_stiffness": 20.0},
    "transmission.damping": {"damping": 0.1},
    "transmission.eccentricity": {"amplitude": 0.05, "harmonic": 3.0, "phase": 0.7},
    "actuator.gain_error": {"relative": 0.1},
    "actuator.saturation": {"limit": 0.25},
    "actuator.lag": {"time_constant": 0.05},
}
"""Both sides keep turning forwards under a steady torque, so that dry friction slides throughout."""
