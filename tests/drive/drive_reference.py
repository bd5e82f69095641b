"""An oracle for the drive: the equations of motion written out once more in NumPy, integrated by SciPy to tight tolerance.

Nothing of the physics here comes from the package; :func:`simulate_plant` runs the package's own plant for comparison.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from jaxbl.drive import DeadZone, Initial, LinearShaft, Plant, Rigid, SigmoidBacklash, TwoInertia, as_arrays

DRIVE = {"motor_inertia": 0.05, "motor_viscous": 0.02, "load_inertia": 0.5, "load_viscous": 0.3, "gear_ratio": 2.0}
SIGMOID = {"stiffness": 3.0, "dead_zone": 0.02, "slope": 20.0}
START = {"motor_position": 0.3, "motor_velocity": 6.0, "load_position": -0.1, "load_velocity": 3.0}
HOLD = 0.125
TORQUES = np.array([0.4, -0.1, 0.5, 0.1, -0.3, 0.6, 0.2, 0.3])


def sigmoid_torque(z):
    """Law (3) with the constants of `SIGMOID`, in the paper's exponential form."""
    return 3.0 * (z - 4.0 * 0.02 * (1.0 - np.exp(-20.0 * z)) / (1.0 + np.exp(-20.0 * z)))


def derivatives(t, y, u, law, effects, drive):
    """d/dt of (theta_e, theta_s, omega_e, omega_s, lagged torque, bristles of motor and load, hysteresis, twist and velocity
    of a third inertia) under a commanded torque u, sliding forwards only."""

    def number_of(effect, key):
        return effects.get(effect, {}).get(key, 0.0)

    def side_torque(name, v):
        stribeck = f"{name}.stribeck_friction"
        falling = (number_of(stribeck, "breakaway_torque") - number_of(stribeck, "torque")) * np.exp(
            -((v / effects[stribeck]["stribeck_velocity"]) ** 2) if stribeck in effects else 0.0
        )
        dry = number_of(f"{name}.coulomb_friction", "torque") + number_of(stribeck, "torque") + falling
        if (drifting := effects.get(f"{name}.drifting_friction")) is not None:
            cold, warm = drifting["initial_torque"], drifting["torque"]
            dry += warm + (cold - warm) * np.exp(-t / drifting["time_constant"])
        differs = f"{name}.asymmetric_friction"
        half_sign = 0.5 if v > 0.0 else -0.5
        dry += half_sign * number_of(differs, "torque_difference")
        return (
            dry * np.sign(v)
            + (number_of(f"{name}.viscous_friction", "viscous") + half_sign * number_of(differs, "viscous_difference")) * v
            + number_of(f"{name}.quadratic_drag", "drag") * abs(v) * v
            + number_of(f"{name}.constant_torque", "torque")
        )

    def bristle_torque(name, v, z):
        """Torque of LuGre's model and dz/dt, in its own numbers sigma_0, sigma_1, g."""
        numbers = effects.get(f"{name}.presliding_friction")
        if numbers is None:
            return 0.0, 0.0
        stiffness = numbers["torque"] / numbers["length"]
        fall = np.exp(-((v / numbers["stribeck_velocity"]) ** 2))
        g = numbers["torque"] + (numbers["breakaway_ratio"] * numbers["torque"] - numbers["torque"]) * fall
        z_dot = v - stiffness * abs(v) * z / g
        return stiffness * z + numbers["damping"] * z_dot, z_dot

    def interpolate_tables(name, theta, v):
        table = effects.get(f"{name}.tabulated")
        if table is None:
            return 0.0
        theta = np.mod(theta, 2.0 * np.pi) if table.get("turn") else theta
        position_torque = np.interp(theta, table["positions"], table["position_torques"]) if "positions" in table else 0.0
        return position_torque + (np.interp(v, table["speeds"], table["speed_torques"]) if "speeds" in table else 0.0)

    theta_e, theta_s, omega_e, omega_s, lagged, z_e, z_s, w, twist, third = y
    u = u * (1.0 + number_of("actuator.gain_error", "relative"))
    if "actuator.saturation" in effects:
        u = min(max(u, -number_of("actuator.saturation", "limit")), number_of("actuator.saturation", "limit"))
    u_dot = 0.0
    if "actuator.lag" in effects:
        u, u_dot = lagged, (u - lagged) / number_of("actuator.lag", "time_constant")
    if "actuator.back_emf" in effects:
        winding = effects["actuator.back_emf"]
        u = winding["torque_constant"] * (u - winding["torque_constant"] * omega_e) / winding["resistance"]

    amplitude, n, phase = (number_of("transmission.eccentricity", key) for key in ("amplitude", "harmonic", "phase"))
    ratio = drive["gear_ratio"] - amplitude * n * np.cos(n * theta_s + phase)
    z = theta_e - drive["gear_ratio"] * theta_s + amplitude * np.sin(n * theta_s + phase)
    z -= number_of("transmission.offset", "offset")
    z_dot = omega_e - ratio * omega_s
    half_gap = number_of("transmission.backlash", "half_gap")
    if abs(z) < half_gap:
        z, z_dot = 0.0, 0.0
    else:
        z -= half_gap * np.sign(z)
    torque = law(z)
    torque += (
        number_of("transmission.hardening", "cubic_stiffness") * z**3 + number_of("transmission.damping", "damping") * z_dot
    )
    torque += number_of("transmission.hysteresis", "torque") * w
    w_dot = z_dot - 0.5 * (abs(z_dot) * abs(w) * w + z_dot * w * w)
    w_dot /= effects.get("transmission.hysteresis", {"length": 1.0})["length"]

    at_motor = side_torque("motor", omega_e) + number_of("motor.cogging", "amplitude") * np.sin(
        number_of("motor.cogging", "harmonic") * theta_e + number_of("motor.cogging", "phase")
    )
    at_motor += interpolate_tables("motor", theta_e, omega_e)
    at_load = side_torque("load", omega_s) + interpolate_tables("load", theta_s, omega_s)
    for k, name in ((1, ""), (2, "_2"), (3, "_3")):
        turn = k * number_of("motor.cogging_harmonics", "harmonic") * theta_e
        at_motor += number_of("motor.cogging_harmonics", f"sine{name}") * np.sin(turn)
        at_motor += number_of("motor.cogging_harmonics", f"cosine{name}") * np.cos(turn)
    rate = 2.0 * np.pi * number_of("load.flexibility", "frequency")
    third_dot = -(rate**2) * twist - 2.0 * number_of("load.flexibility", "damping_ratio") * rate * (third - omega_s)
    at_load += number_of("load.flexibility", "inertia") * third_dot
    at_load += number_of("load.gravity", "torque") * np.sin(theta_s - number_of("load.gravity", "phase"))
    at_load += number_of("load.periodic_disturbance", "amplitude") * np.sin(
        2.0 * np.pi * number_of("load.periodic_disturbance", "frequency") * t
        + number_of("load.periodic_disturbance", "phase")
    )
    if "motor.torque_ripple" in effects:
        ripple = effects["motor.torque_ripple"]
        u *= 1.0 + ripple["amplitude"] * np.sin(ripple["harmonic"] * theta_e + ripple["phase"])
    at_motor += number_of("transmission.load_friction", "coefficient") * abs(torque) * np.sign(omega_e)
    bent_e, z_e_dot = bristle_torque("motor", omega_e, z_e)
    bent_s, z_s_dot = bristle_torque("load", omega_s, z_s)
    at_motor, at_load = at_motor + bent_e, at_load + bent_s
    omega_e_dot = (u - torque - drive["motor_viscous"] * omega_e - at_motor) / (
        drive["motor_inertia"] + number_of("motor.inertia", "inertia")
    )
    omega_s_dot = (ratio * torque - drive["load_viscous"] * omega_s - at_load) / (
        drive["load_inertia"] + number_of("load.inertia", "inertia")
    )
    twist_rate = third - omega_s
    return [omega_e, omega_s, omega_e_dot, omega_s_dot, u_dot, z_e_dot, z_s_dot, w_dot, twist_rate, third_dot]


def integrate_reference(law=sigmoid_torque, effects=None, drive=DRIVE, start=START, torques=TORQUES, hold=HOLD):
    """Integrate the equations: (theta_e, theta_s, omega_e, omega_s) at the end of each hold, shape (holds, 4)."""
    y = [start["motor_position"], start["load_position"], start["motor_velocity"], start["load_velocity"], *[0.0] * 6]
    states = []
    delay_samples = (effects or {}).get("actuator.delay", {"delay": 0.0})["delay"] / hold
    # a delayed input changes within a hold
    full_samples, edge = int(delay_samples), (delay_samples - int(delay_samples)) * hold
    arriving = [*[0.0] * (full_samples + 1), *torques]
    for k in range(len(torques)):
        spans = [(0.0, edge, arriving[k]), (edge, hold, arriving[k + 1])] if edge else [(0.0, hold, arriving[k + 1])]
        for begin, end, u in spans:
            # max_step: an adaptive step must not leap over a gap
            solution = solve_ivp(
                derivatives,
                (k * hold + begin, k * hold + end),
                y,
                method="DOP853",
                rtol=1e-12,
                atol=1e-13,
                max_step=0.02,
                args=(u, law, effects or {}, drive),
            )
            y = solution.y[:, -1]
        states.append(y[:4])
    return np.array(states)


def make_plant(*effects, law=None, dtype=jnp.float64, **changes):
    """Make the package's plant with the constants of `DRIVE`."""
    law = SigmoidBacklash(**SIGMOID) if law is None else law
    return as_arrays(Plant(TwoInertia(**(DRIVE | changes)), law, effects), dtype)


def make_block(*effects, inertia=0.05, viscous=0.0, dtype=jnp.float64):
    """Make a plant of a single inertia on whatever the effects make of its support."""
    return as_arrays(Plant(Rigid(motor_inertia=inertia, motor_viscous=viscous), None, effects), dtype)


@eqx.filter_jit
def _simulate(plant, initial, torques, substeps, hold):
    step = hold / substeps.astype(hold.dtype)

    def advance_hold(carry, torque):
        state, start = carry
        effects, arriving = plant.receive(state.effects, torque, hold)
        state = eqx.tree_at(lambda s: s.effects, state, effects)

        def advance(i, state):
            since = i.astype(hold.dtype) * step
            return plant.advance(state, arriving(since, step), start + since, step)

        state = jax.lax.fori_loop(0, substeps, advance, state)
        sides = [(part, side) for part in (state.position, state.velocity) for side in plant.drive.sides]
        return (state, start + hold), jnp.stack([part[side] for part, side in sides])

    return jax.lax.scan(advance_hold, (plant.init(initial), jnp.zeros_like(hold)), torques)[1]


def simulate_plant(plant, substeps, start=START, torques=TORQUES, hold=HOLD, dtype=jnp.float64):
    """Simulate the package's plant: positions, then velocities, at the end of each hold, as :func:`integrate_reference`."""
    initial, torques, hold = as_arrays((Initial(**start), jnp.asarray(torques, dtype), float(hold)), dtype)
    states = _simulate(plant, initial, torques, jnp.asarray(substeps), hold)
    assert states.dtype == dtype
    return np.asarray(states)


_simulate_stacked = eqx.filter_jit(eqx.filter_vmap(_simulate, in_axes=(eqx.if_array(0), None, None, None, None)))


def simulate_plant_batch(plants, substeps, dtype=jnp.float64):
    """Simulate several plants of one structure at once from `START` under `TORQUES`, shape (plants, holds, 4)."""
    stacked = jax.tree.map(lambda *numbers: np.stack(numbers), *plants)
    initial, torques, hold = as_arrays((Initial(**START), jnp.asarray(TORQUES, dtype), float(HOLD)), dtype)
    states = _simulate_stacked(stacked, initial, torques, jnp.asarray(substeps), hold)
    assert states.dtype == dtype
    return np.asarray(states)


LAWS = {
    "sigmoid_backlash": (SigmoidBacklash(**SIGMOID), sigmoid_torque),
    "linear_shaft": (LinearShaft(stiffness=3.0), lambda z: 3.0 * z),
    "dead_zone": (
        DeadZone(stiffness=3.0, half_gap=0.05),
        lambda z: 3.0 * (z - 0.05) if z > 0.05 else 3.0 * (z + 0.05) if z < -0.05 else 0.0,
    ),
}
"""Law by name: the package's, and the same in NumPy."""
