"""The truth behind the bench: drives with any effect, many at once, without a line of the package that is put to the test.

Equations (SI units, sides `motor` and `load`, u held between samples):

    J_e dω_e/dt = u_a - C - f_e ω_e - resist_e - dry friction_e
    J_s dω_s/dt = (N - e') C - f_s ω_s - resist_s - dry friction_s
    C = law(δ) + K_3 δ³ + D dδ/dt,  δ = what the hard gap leaves of z = θ_e - N θ_s + e(θ_s)

Integrator: classical Runge-Kutta of fourth order between events. In between, each side sticks or slips in one direction and
the gap is open or closed at one flank, so the right side is smooth; a step that crosses an event (a velocity through zero,
break-away, contact made or lost) is taken back and shortened by the secant rule until it ends on it, and then the mode
changes. Stick is exact: a side that sticks has velocity zero. Fourth order through events. Checked against SciPy in
tests/benchmarks.

The same source runs in two engines: compiled lane by lane where numba is installed, and vectorised NumPy where it is not.
"""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

STEP = 2.5e-4
"""Longest integrator step, s; a sample has at least two. Half of it changes the cases by less than their noise."""

_NAMES = """motor_inertia motor_viscous load_inertia load_viscous ratio stiffness dead_zone slope gap half_gap cubic damping
ecc_amplitude ecc_harmonic ecc_phase
motor_dry motor_coulomb motor_extra motor_stribeck motor_drag motor_constant motor_gravity motor_periodic motor_hysteresis
load_dry load_coulomb load_extra load_stribeck load_drag load_constant load_gravity load_periodic load_hysteresis
motor_drift load_drift drift_time motor_dent load_dent dent_position dent_width gravity_phase
periodic_rate periodic_phase cog_amplitude cog_harmonic cog_phase hysteresis_length
motor_random load_random gain limit lag_rate
loop kp kd filter motor_noise motor_resolution torque_limit period steps origin
ripple_amplitude ripple_harmonic ripple_phase
motor_bristle load_bristle bristle_torque bristle_excess bristle_stribeck bristle_damping
base_harmonic base_sine base_cosine base_sine_2 base_cosine_2 base_sine_3 base_cosine_3
shaft_torque shaft_length third_motor third_load third_rate third_damping delayed
motor_sided load_sided motor_warming load_warming warming_rate mesh"""
_ROWS = _NAMES.split()
P = SimpleNamespace(**{name: i for i, name in enumerate(_ROWS)})
"""Row of each number in the parameters of a lane."""

ANGLE_TOLERANCE, SPEED_TOLERANCE, TORQUE_TOLERANCE = 1e-11, 1e-10, 1e-9
"""Largest distance from an event at which a step ends: rad, rad/s, and share of the friction level."""

SPARE = 60
"""Attempts in a sample beyond its steps, after which one is taken as it is: a guard against chatter."""


@dataclass(frozen=True)
class Machine:
    """A drive in the words of the package's config.

    Attributes:
        drive: the `[drive]` table.
        transmission: the `[transmission]` table; None on a rigid drive.
        effects: `[[effects]]`; beside the package's kinds
            `unknown.drifting_friction` (side, torque, share, time): dry friction that runs from torque (1 + share) to
            torque (1 - share) over `time` s;
            `unknown.hysteresis` (side, torque, length): Bouc-Wen, n = 2;
            `unknown.dent` (side, torque, position, width): dry friction in a bell around one position;
            `unknown.random_torque` (side, torque): rms of the band-limited torque that :class:`Run` holds.
    """

    drive: Mapping[str, Any]
    transmission: Mapping[str, Any] | None
    effects: Sequence[Mapping[str, Any]] = ()

    @property
    def rigid(self) -> bool:
        return self.drive["kind"] == "rigid"

    @property
    def ratio(self) -> float:
        """Motor turns for one of the load; 1 on a rigid drive."""
        return 1.0 if self.rigid else float(self.drive["gear_ratio"])


@dataclass
class Run:
    """One experiment on a machine.

    Attributes:
        machine: what moves.
        period: sample period, s.
        torque: commanded torque of each sample in open loop, N m; in closed loop it is the feed-forward.
        reference: motor position asked for, rad, and its rate, rad/s: shape (2, samples); None in open loop.
        kp, kd, filter: gains of the loop, N m/rad and N m s/rad, and the share 0..1 of a new difference in its velocity.
        torque_limit: of the loop, N m.
        initial: θ_e, ω_e, θ_s, ω_s.
        bent: deflection of the bristles of `presliding_friction` when the run begins, rad.
        hung: twist of the spring of `load.flexibility`, rad, and velocity of the inertia behind it, rad/s, when the run
            begins.
        acting: torque that the actuator makes when the run begins, N m (for `actuator.lag`).
        origin: time at which the run begins, s.
        motor_noise, load_noise: rms of the encoders, rad; resolutions in rad, 0 for none.
        torque_noise: rms of noise in the recorded torque, N m.
        disturbance: unit-rms torque at the samples, for `unknown.random_torque`; linear in between.
        seed: of the noise.
    """

    machine: Machine
    period: float
    torque: np.ndarray
    reference: np.ndarray | None = None
    kp: float = 0.0
    kd: float = 0.0
    filter: float = 1.0
    torque_limit: float = math.inf
    initial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    acting: float = 0.0
    bent: float = 0.0
    hung: tuple[float, float] = (0.0, 0.0)
    origin: float = 0.0
    motor_noise: float = 0.0
    load_noise: float = 0.0
    motor_resolution: float = 0.0
    load_resolution: float = 0.0
    torque_noise: float = 0.0
    disturbance: np.ndarray | None = None
    seed: int = 0


@dataclass
class Trace:
    """Readings of a run, and the true states.

    Attributes:
        t, u, theta_e, theta_s: time, recorded torque, encoder readings (no theta_s on a rigid drive).
        command: torque without the noise of its channel.
        states: true θ_e, ω_e, θ_s, ω_s at the samples, shape (4, samples).
    """

    t: np.ndarray
    u: np.ndarray
    theta_e: np.ndarray
    theta_s: np.ndarray | None
    command: np.ndarray = field(repr=False)
    states: np.ndarray = field(repr=False)


def pack(run: Run, step: float = STEP) -> np.ndarray:
    """Numbers of a lane, in the order of `P`."""
    machine, values = run.machine, dict.fromkeys(_ROWS, 0.0)
    drive, law = machine.drive, machine.transmission or {}
    values |= {"load_inertia": 1.0, "ratio": machine.ratio, "limit": math.inf, "dent_width": 1.0, "hysteresis_length": 1.0}
    values |= {"shaft_length": 1.0}
    values |= {"gain": 1.0, "drift_time": 1.0, "kp": run.kp, "kd": run.kd, "filter": run.filter, "period": run.period}
    values["steps"] = float(max(2, math.ceil(run.period / step - 1e-9)))
    values |= {"torque_limit": run.torque_limit, "motor_noise": run.motor_noise, "motor_resolution": run.motor_resolution}
    values["origin"] = run.origin
    values["loop"] = float(run.reference is not None)
    for key in ("motor_inertia", "motor_viscous", "load_inertia", "load_viscous"):
        values[key] = drive.get(key, values[key])
    for key in ("stiffness", "dead_zone", "slope", "half_gap"):
        values[key] = law.get(key, 0.0)
    values["gap"] = float(law.get("law") == "dead_zone")
    for effect in machine.effects:
        _add(values, effect, machine.rigid)
        if effect["kind"] == "actuator.delay":  # in whole samples
            values["delayed"] = float(round(effect["delay"] / run.period))
    with_memory = [values[name] != 0.0 for name in ("motor_hysteresis", "load_hysteresis", "motor_bristle", "load_bristle")]
    if sum(with_memory) > 1:
        raise ValueError("one effect of a machine may have a memory")
    return np.array([values[name] for name in _ROWS])


def _add(values: dict[str, float], effect: Mapping[str, Any], rigid: bool) -> None:
    place, kind = effect["kind"].split(".")
    side = "motor" if rigid or effect.get("side", place) == "motor" else "load"
    get = effect.get
    match kind:
        case "coulomb_friction":
            values[f"{side}_coulomb"] += get("torque")
        case "stribeck_friction":
            values[f"{side}_coulomb"] += get("torque")
            values[f"{side}_extra"] += get("breakaway_torque") - get("torque")
            values[f"{side}_stribeck"] = 1.0 / get("stribeck_velocity")
        case "viscous_friction":
            values[f"{side}_viscous"] += get("viscous")
        case "quadratic_drag":
            values[f"{side}_drag"] += get("drag")
        case "constant_torque":
            values[f"{side}_constant"] += get("torque")
        case "inertia":
            values[f"{side}_inertia"] += get("inertia")
        case "gravity":
            values[f"{side}_gravity"] += get("torque")
            values["gravity_phase"] = get("phase", 0.0)
        case "periodic_disturbance":
            values[f"{side}_periodic"] += get("amplitude")
            values["periodic_rate"] = 2.0 * math.pi * get("frequency")
            values["periodic_phase"] = get("phase", 0.0)
        case "cogging":
            values["cog_amplitude"] += get("amplitude")
            values["cog_harmonic"], values["cog_phase"] = get("harmonic"), get("phase", 0.0)
        case "cogging_harmonics":
            for key in ("harmonic", "sine", "cosine", "sine_2", "cosine_2", "sine_3", "cosine_3"):
                values[f"base_{key}"] = get(key, 0.0)
        case "flexibility":
            values[f"third_{side}"], values["third_damping"] = get("inertia"), get("damping_ratio", 0.02)
            values["third_rate"] = 2.0 * math.pi * get("frequency")
        case "hysteresis" if place == "transmission":
            values["shaft_torque"], values["shaft_length"] = get("torque"), get("length")
        case "torque_ripple":
            values["ripple_amplitude"] += get("amplitude")
            values["ripple_harmonic"], values["ripple_phase"] = get("harmonic"), get("phase", 0.0)
        case "backlash":
            values["half_gap"] += get("half_gap")
            values["gap"] = 1.0
        case "hardening":
            values["cubic"] += get("cubic_stiffness")
        case "damping":
            values["damping"] += get("damping")
        case "eccentricity":
            values["ecc_amplitude"] += get("amplitude")
            values["ecc_harmonic"], values["ecc_phase"] = get("harmonic", 1.0), get("phase", 0.0)
        case "gain_error":
            values["gain"] *= 1.0 + get("relative")
        case "saturation":
            values["limit"] = get("limit")
        case "delay":
            pass
        case "lag":
            values["lag_rate"] = 1.0 / get("time_constant")
        case "asymmetric_friction":
            values[f"{side}_sided"] += 0.5 * get("viscous_difference")
            values[f"{side}_constant"] += 0.5 * get("torque_difference", 0.0)
        case "load_friction":
            values["mesh"], values["motor_dry"] = get("coefficient"), 1.0
        case "drifting_friction" if place != "unknown":
            values[f"{side}_coulomb"] += get("torque")
            values[f"{side}_warming"] += get("initial_torque") - get("torque")
            values["warming_rate"] = 1.0 / get("time_constant")
        case "drifting_friction":
            values[f"{side}_coulomb"] += get("torque")
            values[f"{side}_drift"] += get("torque") * get("share")
            values["drift_time"] = get("time")
        case "hysteresis":
            values[f"{side}_hysteresis"] += get("torque")
            values["hysteresis_length"] = get("length")
        case "dent":
            values[f"{side}_dent"] += get("torque")
            values["dent_position"], values["dent_width"] = get("position"), get("width")
        case "random_torque":
            values[f"{side}_random"] += get("torque")
        case "presliding_friction":
            # LuGre's own numbers: sigma_0, F_c, F_s - F_c, 1 / v_s, sigma_1
            values[f"{side}_bristle"] = get("torque") / get("length")
            values["bristle_torque"] = get("torque")
            values["bristle_excess"] = (get("breakaway_ratio", 1.0) - 1.0) * get("torque")
            values["bristle_stribeck"] = 1.0 / get("stribeck_velocity", 1.0)
            values["bristle_damping"] = get("damping", 0.0)
        case _:
            raise ValueError(f"unknown effect {effect['kind']}")
    if kind in ("coulomb_friction", "stribeck_friction", "dent", "drifting_friction"):
        values[f"{side}_dry"] = 1.0


def build(jit: Any, pick: Any) -> SimpleNamespace:
    """The engine's functions, elementwise over lanes: `p` holds a row a number, `y` is (θ_e, ω_e, θ_s, ω_s, m, hysteresis of
    the shaft, twist of the third inertia's spring, its velocity), m the hysteresis or the deflection of bristles.

    Args:
        jit: what compiles a function, or leaves it as it is.
        pick: pick(condition, a, b).
    """
    P_ = P  # constants of the compiled functions
    (J_E, F_E, J_S, F_S, N, K, J0, SLOPE, GAP, HALF, CUBIC, DAMP, EA, EN, EP) = (
        P_.motor_inertia, P_.motor_viscous, P_.load_inertia, P_.load_viscous, P_.ratio, P_.stiffness, P_.dead_zone, P_.slope,
        P_.gap, P_.half_gap, P_.cubic, P_.damping, P_.ecc_amplitude, P_.ecc_harmonic, P_.ecc_phase,
    )  # fmt: skip
    (E_DRY, E_C, E_X, E_V, E_Q, E_K, E_G, E_T, E_H) = range(P_.motor_dry, P_.motor_hysteresis + 1)
    (S_DRY, S_C, S_X, S_V, S_Q, S_K, S_G, S_T, S_H) = range(P_.load_dry, P_.load_hysteresis + 1)
    (E_DRIFT, S_DRIFT, DRIFT_T, E_DENT, S_DENT, DENT_AT, DENT_W, G_PHASE, T_RATE, T_PHASE, CA, CN, CP, H_LEN) = range(
        P_.motor_drift, P_.hysteresis_length + 1
    )
    (E_R, S_R, GAIN, LIMIT, LAG, LOOP, KP, KD, FILTER, NOISE, RES, U_MAX, PERIOD, STEPS) = range(
        P_.motor_random, P_.steps + 1
    )
    R_A, R_N, R_P = P_.ripple_amplitude, P_.ripple_harmonic, P_.ripple_phase
    E_B, S_B, B_C, B_X, B_V, B_D = range(P_.motor_bristle, P_.bristle_damping + 1)
    BN, BS, BC, BS2, BC2, BS3, BC3 = range(P_.base_harmonic, P_.base_cosine_3 + 1)
    SHAFT_T, SHAFT_L, E_T3, S_T3, T_W, T_D = range(P_.shaft_torque, P_.third_damping + 1)
    E_A, S_A, E_W, S_W, W_RATE, MESH = range(P_.motor_sided, P_.mesh + 1)
    angle, speed, share = ANGLE_TOLERANCE, SPEED_TOLERANCE, TORQUE_TOLERANCE

    @jit
    def twist(p, theta_e, theta_s):
        return theta_e - p[N] * theta_s + p[EA] * np.sin(p[EN] * theta_s + p[EP])

    @jit
    def torques(p, y, contact, now, u, noise):
        """Sum of torques without dry friction, level of dry friction, both sides; and the rates of what is behind."""
        theta_e, w_e, theta_s, w_s, w, shaft, spring, w_t = y
        turn = p[EN] * theta_s + p[EP]
        ratio = p[N] - p[EA] * p[EN] * np.cos(turn)
        z = theta_e - p[N] * theta_s + p[EA] * np.sin(turn)
        closed = np.abs(contact)
        bent = closed * (z - contact * p[GAP] * p[HALF])
        through = p[K] * (bent - 4.0 * p[J0] * np.tanh(0.5 * p[SLOPE] * bent)) + p[CUBIC] * bent * bent * bent
        through = through + p[DAMP] * closed * (w_e - ratio * w_s)
        # Bouc-Wen in the shaft
        rate = closed * (w_e - ratio * w_s)
        shaft_rate = (rate - 0.5 * (np.abs(rate) * shaft * np.abs(shaft) + rate * shaft * shaft)) / p[SHAFT_L]
        through = through + p[SHAFT_T] * shaft
        slip = w_t - pick(p[E_T3] != 0.0, w_e, w_s)
        third = -p[T_W] * p[T_W] * spring - 2.0 * p[T_D] * p[T_W] * slip
        swing = np.sin(p[T_RATE] * now + p[T_PHASE])
        held = w * np.abs(w)
        drift = 1.0 - 2.0 * now / p[DRIFT_T]
        on_motor = p[E_DENT] != 0.0
        bump = (pick(on_motor, theta_e, theta_s) - p[DENT_AT]) / p[DENT_W]
        bump = np.exp(-bump * bump)
        u = u * (1.0 + p[R_A] * np.sin(p[R_N] * theta_e + p[R_P]))
        sum_e = u - through - p[F_E] * w_e - p[E_Q] * w_e * np.abs(w_e) - p[E_K] - p[E_T] * swing - p[E_H] * w
        turn = p[BN] * theta_e
        sum_e = sum_e - p[E_T3] * third - p[BS] * np.sin(turn) - p[BC] * np.cos(turn)
        sum_e = sum_e - p[BS2] * np.sin(2.0 * turn) - p[BC2] * np.cos(2.0 * turn)
        sum_e = sum_e - p[BS3] * np.sin(3.0 * turn) - p[BC3] * np.cos(3.0 * turn)
        sum_e = sum_e - p[E_G] * np.sin(theta_e - p[G_PHASE]) - p[CA] * np.sin(p[CN] * theta_e + p[CP]) - p[E_R] * noise
        sum_s = ratio * through - p[F_S] * w_s - p[S_Q] * w_s * np.abs(w_s) - p[S_K] - p[S_T] * swing - p[S_H] * w
        sum_s = sum_s - p[S_G] * np.sin(theta_s - p[G_PHASE]) - p[S_R] * noise - p[S_T3] * third
        fall_e, fall_s = w_e * p[E_V], w_s * p[S_V]
        dry_e = p[E_C] + p[E_X] * np.exp(-fall_e * fall_e) + p[E_DRIFT] * drift + p[E_DENT] * bump
        dry_s = p[S_C] + p[S_X] * np.exp(-fall_s * fall_s) + p[S_DRIFT] * drift + p[S_DENT] * bump
        warming = np.exp(-now * p[W_RATE])
        dry_e = dry_e + p[E_W] * warming + p[MESH] * np.abs(through)
        dry_s = dry_s + p[S_W] * warming
        sum_e = sum_e - p[E_A] * np.abs(w_e)
        sum_s = sum_s - p[S_A] * np.abs(w_s)
        v = pick(p[E_H] != 0.0, w_e, w_s)
        # Bouc-Wen with n = 2 and beta = gamma = 1/2
        w_rate = (v - 0.5 * (np.abs(v) * held + v * w * w)) / p[H_LEN]
        # or LuGre's bristles: the state is their deflection then
        v = pick(p[E_B] != 0.0, w_e, w_s)
        bristles = p[E_B] + p[S_B]
        fall = v * p[B_V]
        most = p[B_C] + p[B_X] * np.exp(-fall * fall)
        bend = v - bristles * np.abs(v) * w / pick(bristles > 0.0, most, 1.0)
        damped = p[B_D] * bend
        sum_e = sum_e - p[E_B] * w - pick(p[E_B] > 0.0, damped, 0.0)
        sum_s = sum_s - p[S_B] * w - pick(p[S_B] > 0.0, damped, 0.0)
        w_rate = pick(bristles > 0.0, bend, w_rate)
        return sum_e, np.maximum(dry_e, 0.0), sum_s, np.maximum(dry_s, 0.0), w_rate, shaft_rate, slip, third

    @jit
    def rates(p, y, modes, now, u, noise):
        contact, d_e, d_s = modes
        sum_e, dry_e, sum_s, dry_s, w_rate, shaft, spring, third = torques(p, y, contact, now, u, noise)
        # a side that sticks has d = 0 and stays
        a_e = np.abs(d_e) * (sum_e - d_e * dry_e) / p[J_E]
        a_s = np.abs(d_s) * (sum_s - d_s * dry_s) / p[J_S]
        return y[1], a_e, y[3], a_s, w_rate, shaft, spring, third

    @jit
    def lagged_torque(p, s, u, lagged):
        """Torque that acts s seconds after the sample: first-order lag of the held one, exactly."""
        return pick(p[LAG] > 0.0, u + (lagged - u) * np.exp(-s * p[LAG]), u)

    @jit
    def take_step(y, k, h):
        return (
            y[0] + h * k[0], y[1] + h * k[1], y[2] + h * k[2], y[3] + h * k[3],
            y[4] + h * k[4], y[5] + h * k[5], y[6] + h * k[6], y[7] + h * k[7],
        )  # fmt: skip

    @jit
    def advance(p, y, modes, s, h, start, u, lagged, n0, slope):
        """One step of the classical Runge-Kutta method."""
        m, e = s + 0.5 * h, s + h
        u_m = lagged_torque(p, m, u, lagged)
        k1 = rates(p, y, modes, start + s, lagged_torque(p, s, u, lagged), n0 + slope * s)
        k2 = rates(p, take_step(y, k1, 0.5 * h), modes, start + m, u_m, n0 + slope * m)
        k3 = rates(p, take_step(y, k2, 0.5 * h), modes, start + m, u_m, n0 + slope * m)
        k4 = rates(p, take_step(y, k3, h), modes, start + e, lagged_torque(p, e, u, lagged), n0 + slope * e)
        c = h / 6.0
        return (
            y[0] + c * (k1[0] + 2.0 * (k2[0] + k3[0]) + k4[0]),
            y[1] + c * (k1[1] + 2.0 * (k2[1] + k3[1]) + k4[1]),
            y[2] + c * (k1[2] + 2.0 * (k2[2] + k3[2]) + k4[2]),
            y[3] + c * (k1[3] + 2.0 * (k2[3] + k3[3]) + k4[3]),
            y[4] + c * (k1[4] + 2.0 * (k2[4] + k3[4]) + k4[4]),
            y[5] + c * (k1[5] + 2.0 * (k2[5] + k3[5]) + k4[5]),
            y[6] + c * (k1[6] + 2.0 * (k2[6] + k3[6]) + k4[6]),
            y[7] + c * (k1[7] + 2.0 * (k2[7] + k3[7]) + k4[7]),
        )

    @jit
    def holds(dry, d, velocity, total, level):
        """Distance of a side from an event, in tolerances: speed left in its direction, or friction left while it sticks."""
        sliding = pick(d != 0.0, d * velocity / speed, (level - np.abs(total)) / (share * level + 1e-300))
        return pick(dry > 0.0, sliding, 1.0)

    @jit
    def distances(p, y, modes, now, u, noise):
        contact, d_e, d_s = modes
        sum_e, dry_e, sum_s, dry_s, _, _, _, _ = torques(p, y, contact, now, u, noise)
        z = twist(p, y[0], y[2])
        gap = pick(contact != 0.0, contact * z - p[HALF], p[HALF] - np.abs(z)) / angle
        return (
            pick(p[GAP] > 0.0, gap, 1.0),
            holds(p[E_DRY], d_e, y[1], sum_e, dry_e),
            holds(p[S_DRY], d_s, y[3], sum_s, dry_s),
            sum_e, dry_e, sum_s, dry_s, z,
        )  # fmt: skip

    @jit
    def mode_at_rest(total, level):
        """Mode of a side at rest: it sticks, or starts where the torques push it."""
        return pick(np.abs(total) <= level, 0.0, np.sign(total))

    @jit
    def attempt(p, y, modes, s, h, tries, start, u, lagged, n0, slope):
        """Try a step: take it, take it and change modes, or shorten it."""
        h = np.minimum(h, p[PERIOD] - s)
        old = distances(p, y, modes, start + s, lagged_torque(p, s, u, lagged), n0 + slope * s)
        new_y = advance(p, y, modes, s, h, start, u, lagged, n0, slope)
        end = s + h
        new = distances(p, new_y, modes, start + end, lagged_torque(p, end, u, lagged), n0 + slope * end)
        cut = 1.0
        crossed = False
        for i in range(3):
            before = np.maximum(old[i], 0.0)
            over = new[i] < -1.0
            crossed = crossed | over
            cut = pick(over, np.minimum(cut, (before + 0.5) / (before - pick(over, new[i], -2.0))), cut)
        taken = np.logical_not(crossed & (h > 1e-10) & (tries < p[STEPS] + SPARE))
        contact, d_e, d_s = modes
        c = pick(taken & (new[0] <= 0.0), pick(contact != 0.0, 0.0, np.sign(new[7])), contact)
        event_e, event_s = taken & (new[1] <= 0.0), taken & (new[2] <= 0.0)
        e = pick(event_e, mode_at_rest(new[3], new[4]), d_e)
        l = pick(event_s, mode_at_rest(new[5], new[6]), d_s)  # noqa: E741
        y = (
            pick(taken, new_y[0], y[0]),
            pick(taken, pick(event_e, 0.0, new_y[1]), y[1]),
            pick(taken, new_y[2], y[2]),
            pick(taken, pick(event_s, 0.0, new_y[3]), y[3]),
            pick(taken, new_y[4], y[4]),
            pick(taken, new_y[5], y[5]),
            pick(taken, new_y[6], y[6]),
            pick(taken, new_y[7], y[7]),
        )
        s = pick(taken, end, s)
        h = pick(taken, p[PERIOD] / p[STEPS], h * cut)
        return y, (c, e, l), s, h

    @jit
    def begin(p, y, modes, start, u, lagged, n0):
        """Modes at a sample: the input has jumped, and what stuck may not do so any more."""
        contact, d_e, d_s = modes
        sum_e, dry_e, sum_s, dry_s, _, _, _, _ = torques(p, y, contact, start, lagged_torque(p, 0.0, u, lagged), n0)
        stuck_e, stuck_s = (d_e == 0.0) & (np.abs(sum_e) > dry_e), (d_s == 0.0) & (np.abs(sum_s) > dry_s)
        return contact, pick(stuck_e, np.sign(sum_e), d_e), pick(stuck_s, np.sign(sum_s), d_s)

    @jit
    def first(p, y):
        """Modes at the start."""
        z = twist(p, y[0], y[2])
        contact = pick(p[GAP] > 0.0, pick(np.abs(z) > p[HALF], np.sign(z), 0.0), 1.0)
        d_e = pick(p[E_DRY] > 0.0, np.sign(y[1]), 1.0)
        d_s = pick(p[S_DRY] > 0.0, np.sign(y[3]), 1.0)
        return contact, d_e, d_s

    @jit
    def control(p, theta_e, unit, previous, velocity, u, reference, rate):
        """Reading of the motor encoder, the loop's velocity, and the commanded torque."""
        noisy = theta_e + p[NOISE] * unit
        count = pick(p[RES] > 0.0, p[RES], 1.0)
        reading = pick(p[RES] > 0.0, count * np.round(noisy / count), noisy)
        velocity = velocity + p[FILTER] * ((reading - previous) / p[PERIOD] - velocity)
        asked = u + p[KP] * (reference - reading) + p[KD] * (rate - velocity)
        asked = np.minimum(np.maximum(asked, -p[U_MAX]), p[U_MAX])
        return reading, velocity, pick(p[LOOP] > 0.0, asked, u)

    @jit
    def acting(p, u):
        scaled = p[GAIN] * u
        return np.minimum(np.maximum(scaled, -p[LIMIT]), p[LIMIT])

    return SimpleNamespace(
        attempt=attempt, begin=begin, first=first, control=control, acting=acting, lagged_torque=lagged_torque
    )


def _compile_loop() -> Any:
    """The engine that numba compiles, or None without numba (or with BENCH_ENGINE=numpy in the environment)."""
    if os.environ.get("BENCH_ENGINE") == "numpy":
        return None
    try:
        import numba
    except ImportError:
        return None
    jit = numba.njit(inline="never")
    engine = build(jit, jit(lambda condition, a, b: a if condition else b))
    attempt, begin, first, control, acting, lagged_torque = (
        engine.attempt, engine.begin, engine.first, engine.control, engine.acting, engine.lagged_torque,
    )  # fmt: skip
    period, steps, origin, delayed = P.period, P.steps, P.origin, P.delayed

    @numba.njit(parallel=True)
    def run(parameters, lengths, initial, torque, reference, rate, unit, noise, command, readings, states):
        for lane in numba.prange(len(parameters)):
            p = parameters[lane]
            y_start = initial[lane]
            y = (y_start[0], y_start[1], y_start[2], y_start[3], y_start[5], 0.0, y_start[6], y_start[7])
            modes = first(p, y)
            previous, velocity, lagged = initial[lane, 0], initial[lane, 1], initial[lane, 4]
            for k in range(lengths[lane]):
                start = p[origin] + k * p[period]
                previous, velocity, u = control(
                    p, y[0], unit[lane, k], previous, velocity, torque[lane, k], reference[lane, k], rate[lane, k]
                )
                command[lane, k], readings[lane, k] = u, previous
                for i in range(4):
                    states[lane, i, k] = y[i]
                late = int(p[delayed])
                u = acting(p, command[lane, k - late] if k >= late else initial[lane, 4])
                slope = (noise[lane, k + 1] - noise[lane, k]) / p[period]
                modes = begin(p, y, modes, start, u, lagged, noise[lane, k])
                s, h, tries = 0.0, p[period] / p[steps], 0
                while s < p[period] * (1.0 - 1e-12):
                    y, modes, s, h = attempt(p, y, modes, s, h, tries, start, u, lagged, noise[lane, k], slope)
                    tries += 1
                lagged = lagged_torque(p, p[period], u, lagged)

    return run


def _vectorise_loop() -> Any:
    """The engine in NumPy: all lanes of a batch advance together, longest first; what has its sample done waits."""
    engine = build(lambda function: function, np.where)

    def run(parameters, lengths, initial, torque, reference, rate, unit, noise, command, readings, states):
        order = np.argsort(-lengths, kind="stable")
        p = np.ascontiguousarray(parameters[order].T)
        y = (*initial[order, :4].T, initial[order, 5], np.zeros(len(order)), *initial[order, 6:].T)
        modes = engine.first(p, y)
        previous, velocity, lagged = y[0], y[1], initial[order, 4]
        for k in range(int(lengths.max())):
            live = int((lengths > k).sum())
            if live < p.shape[1]:
                order, p, lagged = order[:live], np.ascontiguousarray(p[:, :live]), lagged[:live]
                previous, velocity = previous[:live], velocity[:live]
                y, modes = tuple(part[:live] for part in y), tuple(part[:live] for part in modes)
            start = p[P.origin] + k * p[P.period]
            previous, velocity, u = engine.control(
                p, y[0], unit[order, k], previous, velocity, torque[order, k], reference[order, k], rate[order, k]
            )
            command[order, k], readings[order, k] = u, previous
            for i in range(4):
                states[order, i, k] = y[i]
            delayed = k - p[P.delayed].astype(int)
            u = engine.acting(p, np.where(delayed >= 0, command[order, np.maximum(delayed, 0)], initial[order, 4]))
            n0 = noise[order, k]
            slope = (noise[order, k + 1] - n0) / p[P.period]
            modes = engine.begin(p, y, modes, start, u, lagged, n0)
            s, h = np.zeros(live), p[P.period] / p[P.steps]
            open_, tries = np.arange(live), 0
            y, modes, h = [part.copy() for part in y], [part.copy() for part in modes], h.copy()
            all_open = True
            while len(open_):
                i = slice(None) if all_open else open_
                new = engine.attempt(
                    p[:, i], tuple(part[i] for part in y), tuple(part[i] for part in modes), s[i], h[i], tries,
                    start[i], u[i], lagged[i], n0[i], slope[i],
                )  # fmt: skip
                for part, values in zip([*y, *modes, s, h], [*new[0], *new[1], new[2], new[3]], strict=True):
                    part[i] = values
                tries += 1
                open_ = np.flatnonzero(s < p[P.period] * (1.0 - 1e-12))
                all_open = len(open_) == live
            y, modes = tuple(y), tuple(modes)
            lagged = engine.lagged_torque(p, p[P.period], u, lagged)

    return run


_ENGINE: list[Any] = []


def engine() -> tuple[Any, str]:
    """The function that runs the lanes, and its name."""
    if not _ENGINE:
        compiled = _compile_loop()
        _ENGINE.extend((compiled, "numba") if compiled is not None else (_vectorise_loop(), "numpy"))
    return _ENGINE[0], _ENGINE[1]


def simulate(runs: Sequence[Run], step: float = STEP, batch: int = 256) -> list[Trace]:
    """Run experiments.

    Args:
        runs: they may differ in everything.
        step: longest integrator step, s.
        batch: how many advance together.
    """
    traces = []
    for first in range(0, len(runs), batch):
        traces.extend(_batch(runs[first : first + batch], step))
    return traces


def _batch(runs: Sequence[Run], step: float) -> list[Trace]:
    parameters = np.array([pack(run, step) for run in runs])
    lengths = np.array([len(run.torque) for run in runs])
    lanes, most = len(runs), int(lengths.max())
    torque, reference, rate, unit = (np.zeros((lanes, most)) for _ in range(4))
    noise, command, readings = np.zeros((lanes, most + 1)), np.zeros((lanes, most)), np.zeros((lanes, most))
    states = np.zeros((lanes, 4, most))
    randoms = []
    for i, run in enumerate(runs):
        rng = np.random.default_rng([run.seed, 7])
        n = lengths[i]
        torque[i, :n] = run.torque
        unit[i, :n] = rng.standard_normal(n)
        randoms.append(rng.standard_normal((2, n)))
        if run.reference is not None:
            reference[i, :n], rate[i, :n] = run.reference
        if run.disturbance is not None:
            noise[i, : n + 1] = run.disturbance[: n + 1]
    initial = np.array([(*run.initial, run.acting, run.bent, *run.hung) for run in runs], float)
    with np.errstate(all="ignore"):
        engine()[0](parameters, lengths, initial, torque, reference, rate, unit, noise, command, readings, states)
    traces = []
    for i, (run, n) in enumerate(zip(runs, lengths, strict=True)):
        load = states[i, 2, :n] + run.load_noise * randoms[i][0]
        if run.load_resolution > 0.0:
            load = run.load_resolution * np.round(load / run.load_resolution)
        u = command[i, :n] + run.torque_noise * randoms[i][1]
        traces.append(
            Trace(
                t=np.arange(n) * run.period,
                u=u,
                theta_e=readings[i, :n].copy(),
                theta_s=None if run.machine.rigid else load,
                command=command[i, :n].copy(),
                states=states[i, :, :n].copy(),
            )
        )
    return traces
