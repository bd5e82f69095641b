"""Every effect against equations written out independently; dry friction against closed forms; other packages' effects."""

import ast
import functools
import inspect
import re
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drive_reference import START, integrate_reference, make_block, make_plant, simulate_plant, simulate_plant_batch
from effect_values import ENCODERS, VALUES
from scipy.integrate import solve_ivp

from jaxbl.drive import EFFECTS, LinearShaft, Plant, TwoInertia, as_arrays, make_effect, parameters
from jaxbl.drive.effects import CoulombFriction, Motion, SideEffect, StribeckFriction, angle, base, size, tables
from jaxbl.drive.parameters import parameter

DTYPES = pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])


def make_effects(values):
    return [make_effect(name, **numbers) for name, numbers in values.items()]


def make_neutral(name):
    """An effect at numbers with which it does nothing."""
    numbers = VALUES[name] | EFFECTS[name].neutral()
    zeros = {key: (0.0,) * len(torques) for key, torques in numbers.items() if key.endswith("_torques")}
    # its gain is a quotient
    tiny = dict.fromkeys(numbers, 1e-30) if name == "actuator.back_emf" else {}
    return make_effect(name, **numbers | zeros | tiny)


@functools.cache
def simulate_single_effects(substeps, dtype=jnp.float64):
    """The trajectory of the drive with each effect by its name, the others neutral: all by one program."""
    neutral = {name: make_neutral(name) for name in VALUES}
    effects = [neutral | {name: make_effect(name, **VALUES[name])} for name in VALUES]
    plants = [make_plant(*by_name.values(), dtype=dtype) for by_name in effects]
    return dict(zip(VALUES, simulate_plant_batch(plants, substeps, dtype), strict=True))


def reference_errors(values, *substeps):
    """Distances of the drive from the reference, by so many substeps."""
    expected = integrate_reference(effects=values)
    assert expected[:, 2:].min() > 0.1  # sliding forwards
    return [np.abs(simulate_plant(make_plant(*make_effects(values)), n) - expected).max() for n in substeps]


@pytest.fixture(scope="module")
def motion_without_effects():
    """The reference without effects."""
    return integrate_reference()


def test_the_names_are_the_contract():
    values = VALUES | ENCODERS
    assert set(EFFECTS) == set(values)
    for name, effect in zip(values, make_effects(values), strict=True):
        assert effect.name == name
        assert inspect.getdoc(EFFECTS[name]) and list(parameters(effect))


@pytest.mark.parametrize("name", VALUES)
def test_each_effect_is_what_its_equation_says_to_second_order(name, motion_without_effects):
    expected = integrate_reference(effects={name: VALUES[name]})
    assert expected[:, 2:].min() > 0.1  # sliding forwards
    coarse, fine = (np.abs(simulate_single_effects(n)[name] - expected).max() for n in (128, 1024))
    assert np.abs(expected - motion_without_effects).max() > 0.1  # it matters
    # a hard gap is only piecewise smooth: of second order in the mean
    tolerance = 0.2 if name == "transmission.backlash" else 0.01
    assert np.log2(coarse / fine) / 3.0 == pytest.approx(2.0, abs=tolerance)
    assert fine < 3e-5


def test_effects_on_an_encoder_change_its_reading_alone():
    effects = make_effects(ENCODERS)
    np.testing.assert_array_equal(simulate_plant(make_plant(*effects), 8), simulate_plant(make_plant(), 8))
    two_inertia, rigid = make_plant(*effects), make_block(*effects)
    assert float(two_inertia.read("motor", 0.3, 2.0)) == pytest.approx(0.4)
    skewed = 0.3 - 2e-3 * 2.0
    assert float(two_inertia.read("load", 0.3, 2.0)) == pytest.approx(skewed + 0.01 * np.sin(2.0 * skewed + 0.4))
    # a rigid drive has one encoder
    assert float(rigid.read("motor", 0.3, 2.0)) == pytest.approx(0.1 + skewed + 0.01 * np.sin(2.0 * (skewed + 0.1) + 0.4))
    assert float(make_plant().read("load", 0.3, 2.0)) == pytest.approx(0.3)


def test_effects_add_up_in_any_order():
    # two have kinks where the transmitted torque turns: of second order in the mean
    kinked = ("transmission.backlash", "transmission.load_friction")
    values = {name: numbers for name, numbers in VALUES.items() if name not in kinked}
    coarse, fine = reference_errors(values, 256, 4096)
    assert np.log2(coarse / fine) / 4.0 == pytest.approx(2.0, abs=0.02)
    # the actuator is a chain, and keeps its order
    shuffled = sorted(make_effects(values), key=lambda effect: (effect.place == "actuator", effect.place))
    in_order, reordered = (simulate_plant(make_plant(*order), 64) for order in (make_effects(values), shuffled))
    np.testing.assert_allclose(in_order, reordered, rtol=1e-11)


def test_damping_and_hardening_act_on_the_deflection_that_a_gap_leaves():
    values = {name: VALUES[f"transmission.{name.split('.')[1]}"] for name in VALUES if name.startswith("transmission.")}
    # damping sets in with a jump at the edges of the gap: of first order there
    coarse, fine = reference_errors(values, 1024, 16384)
    assert fine < 1e-4 and fine < coarse / 8.0


@pytest.mark.parametrize("name", VALUES)
def test_float32_stays_float32_and_close(name):
    double, single = (simulate_single_effects(32, dtype)[name] for dtype in (jnp.float64, jnp.float32))
    np.testing.assert_allclose(single, double, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("name", ["motor.viscous_friction", "load.quadratic_drag"])
def test_drags_are_odd(name):
    (effect,) = make_effects({name: VALUES[name]})
    assert effect.resist((), Motion(0.0, 0.0, 2.0)) == -effect.resist((), Motion(0.0, 0.0, -2.0)) != 0.0


# Dry friction. A block is the rigid drive, J = 0.05, without viscous friction.

COULOMB = CoulombFriction(side="motor", torque=0.1)
STRIBECK = StribeckFriction(side="motor", torque=0.05, breakaway_torque=0.1, stribeck_velocity=0.2)
REST = dict.fromkeys(START, 0.0)


def slide_block(friction, torque, seconds, dtype=jnp.float64, velocity=0.0, **block_values):
    """Position and velocity of a block at every default sample (1 ms in 10 substeps) under a constant torque."""
    torques = np.full(round(seconds * 1000), torque)
    start = REST | {"motor_velocity": velocity}
    return simulate_plant(make_block(friction, dtype=dtype, **block_values), 10, start, torques, 1e-3, dtype).T


@DTYPES
@pytest.mark.parametrize("friction", [COULOMB, STRIBECK])
@pytest.mark.parametrize("torque", [0.0999, -0.0999, 0.05])
def test_a_block_below_breakaway_does_not_creep_at_all(friction, torque, dtype):
    assert not slide_block(friction, torque, 10.0, dtype).any()


@DTYPES
def test_a_load_below_breakaway_does_not_creep_at_all(dtype):
    weight = make_effects({"load.constant_torque": {"torque": 0.3}, "motor.coulomb_friction": {"torque": 0.02}})
    drive = make_plant(*weight, CoulombFriction(side="load", torque=0.31), dtype=dtype)
    # the motor holds too, and with it the load sees its weight alone
    assert not simulate_plant(drive, 10, REST, np.full(10_000, 0.019), 1e-3, dtype).any()
    free = simulate_plant(
        make_plant(*weight, CoulombFriction(side="load", torque=0.29), dtype=dtype), 10, REST, [0.0] * 99, 1e-3, dtype
    )
    assert free[-1, 1] < 0.0


def test_one_inertia_rubs_by_what_its_load_takes():
    # an arm held out, m g l = 0.3 N m, in a gear with mu = 0.2: between 0.24 and 0.36 N m it does not move at all
    effects = make_effects(
        {"load.gravity": {"torque": 0.3, "phase": -0.5 * np.pi}, "transmission.load_friction": {"coefficient": 0.2}}
    )
    arm = make_block(*effects)
    for torque in (0.241, 0.359):
        assert not simulate_plant(arm, 10, REST, np.full(100, torque), 1e-3).any()
    for torque, remaining in ((0.37, 0.01), (0.23, -0.01)):
        velocity = simulate_plant(arm, 10, REST, np.full(10, torque), 1e-3)[-1, 1]
        assert velocity == pytest.approx(remaining / 0.05 * 0.01, rel=1e-3)


def test_a_block_above_breakaway_accelerates_as_the_closed_form_says():
    time = 1e-3 * np.arange(1, 2001)
    position, velocity = slide_block(COULOMB, -0.11, 2.0)
    np.testing.assert_allclose(velocity, -0.01 / 0.05 * time, rtol=1e-9)
    np.testing.assert_allclose(position, -0.5 * 0.01 / 0.05 * time**2, rtol=1e-9)
    # with viscous friction v = (u - F) / f (1 - exp(-f t / J)): viscous friction is of second order in the step
    position, velocity = slide_block(COULOMB, 0.15, 2.0, viscous=0.1)
    np.testing.assert_allclose(velocity, 0.5 * (1.0 - np.exp(-2.0 * time)), atol=1e-8)
    np.testing.assert_allclose(position, 0.5 * (time - 0.5 * (1.0 - np.exp(-2.0 * time))), atol=1e-8)


@DTYPES
def test_a_sliding_block_stops_where_and_when_the_closed_form_says_and_stays(dtype):
    velocity = 1.2345
    position, speed = slide_block(COULOMB, 0.03, 10.0, dtype, velocity=velocity)
    deceleration = (0.1 - 0.03) / 0.05
    stop = velocity / deceleration
    # it stops within one substep of h = 1e-4 s, so at most a h^2 / 2 off
    assert position[-1] == pytest.approx(0.5 * velocity * stop, abs=deceleration * 1e-8 if dtype == jnp.float64 else 1e-4)
    moving = np.count_nonzero(speed)
    assert moving * 1e-3 == pytest.approx(stop, abs=1.1e-3)
    assert not speed[moving:].any() and (position[moving:] == position[-1]).all()


@pytest.mark.parametrize("velocity", [0.0321, -0.5, 1.2345])
def test_a_block_turns_around_when_the_closed_form_says(velocity):
    """Within a substep: friction changes its sign at the turn, not at the step's end."""
    torque = -0.15 * np.sign(velocity)
    turn = abs(velocity) / ((0.15 + 0.1) / 0.05)
    position, speed = slide_block(COULOMB, torque, 1.0, velocity=velocity)
    assert speed[-1] == pytest.approx((1.0 - turn) * (0.15 - 0.1) / 0.05 * np.sign(torque), rel=1e-9)
    end = 0.5 * velocity * turn + 0.5 * speed[-1] * (1.0 - turn)
    # a h^2 / 4 at most in the step of the turn
    assert position[-1] == pytest.approx(end, abs=0.25 * 5.0 * 1e-8)


def test_stribeck_friction_holds_what_it_would_let_slide():
    """Between sliding friction and break-away: at rest it stays, in motion it goes on."""
    assert not slide_block(STRIBECK, 0.08, 2.0).any()
    time = 2.0
    _, velocity = slide_block(STRIBECK, 0.08, time, velocity=2.0)
    # far above the Stribeck velocity friction is F_c
    assert velocity[-1] == pytest.approx(2.0 + (0.08 - 0.05) / 0.05 * time, rel=1e-9)
    # above break-away it runs away, faster and faster
    _, velocity = slide_block(STRIBECK, 0.105, time)
    assert velocity[-1] > 2.0 * velocity[999] > 0.0


@DTYPES
def test_a_block_on_a_spring_loses_two_friction_deflections_a_swing_and_sticks(dtype):
    """The load held fast by its own friction, the motor swings on the shaft: x -> -(x - 2 F / K), until |x| <= F / K."""
    stiffness, level, inertia, start = 2.0, 0.05, 0.05, 0.33
    frictions = (CoulombFriction(side="motor", torque=level), CoulombFriction(side="load", torque=10.0))
    drive = as_arrays(Plant(TwoInertia(inertia, 0.0, 1.0, 0.0, 2.0), LinearShaft(stiffness), frictions), dtype)
    states = simulate_plant(drive, 10, REST | {"motor_position": start}, np.zeros(10_000), 1e-3, dtype)
    motor, load = states[:, 0], states[:, 1]
    assert not load.any()
    turning = [start]
    while abs(turning[-1]) > level / stiffness:
        turning.append(-np.sign(turning[-1]) * (abs(turning[-1]) - 2.0 * level / stiffness))
    half_period = np.pi * np.sqrt(inertia / stiffness)
    samples = np.round(half_period * np.arange(1, len(turning)) * 1000).astype(int) - 1
    tolerance = 3e-6 if dtype == jnp.float64 else 5e-5
    np.testing.assert_allclose(motor[samples], turning[1:], atol=tolerance)
    assert (motor[samples[-1] + 2 :] == motor[-1]).all()
    assert motor[-1] == pytest.approx(turning[-1], abs=tolerance)


def test_the_gain_of_the_input_is_that_of_small_ones():
    chain = make_effects({name: numbers for name, numbers in VALUES.items() if name.startswith("actuator.")})
    assert make_block(*chain).input_gain == pytest.approx(1.1 * 0.02 / 0.01)
    assert make_block().input_gain == 1.0


@pytest.mark.parametrize("samples", [0.0, 0.3, 1.0, 2.7, 16.0])
def test_a_delayed_input_is_the_input_shifted(samples):
    period, inputs = 2e-3, np.random.default_rng(0).standard_normal(40)
    delay = samples * period
    drive = make_block(make_effect("actuator.delay", delay=delay))
    states, quarters = (drive.effects[0].init(),), 0.25 * period * np.arange(4)
    for k, torque in enumerate(inputs):
        states, arriving = drive.receive(states, torque, period)
        for since in quarters:
            # the mean of what was commanded so much earlier, zero before the first command
            times = k * period + since - delay + 0.25 * period * (np.arange(1000) + 0.5) / 1000
            index = np.floor(times / period + 1e-9).astype(int)
            expected = np.mean(np.where(index < 0, 0.0, inputs[np.maximum(index, 0)]))
            assert arriving(since, 0.25 * period) == pytest.approx(expected, abs=5e-3)


# Effects of other packages.


class TorsionSpring(SideEffect):
    """A spring to the housing."""

    kind = "torsion_spring"
    spring_stiffness: float = size("N m/rad", "stiffness", minimum=0.0)

    def resist(self, state, motion):
        return self.spring_stiffness * motion.position


@pytest.fixture
def install(monkeypatch):
    """Pretend that packages with these entry points are installed."""

    def install_effects(**effects):
        def entry_points(*, group):
            assert group == "jaxbl.effects"
            return [types.SimpleNamespace(name=name, value="a:b", load=lambda v=value: v) for name, value in effects.items()]

        monkeypatch.setattr("jaxbl.registry.entry_points", entry_points)
        monkeypatch.setattr(EFFECTS, "_members", dict(BUILT_IN))
        monkeypatch.setattr(EFFECTS, "_loaded", False)

    return install_effects


BUILT_IN = {name: EFFECTS[name] for name in VALUES}


def test_other_packages_add_effects_through_entry_points(install):
    install(**{"motor.torsion_spring": TorsionSpring})
    assert EFFECTS["motor.torsion_spring"] is TorsionSpring
    assert set(EFFECTS) == {*VALUES, "motor.torsion_spring"}
    spring = make_effect("motor.torsion_spring", spring_stiffness=0.8)
    assert spring.name == "motor.torsion_spring"
    # omega = 4 rad/s
    states = simulate_plant(make_block(spring), 10, REST | {"motor_position": 0.5}, np.zeros(1000), 1e-3)
    np.testing.assert_allclose(states[:, 0], 0.5 * np.cos(4e-3 * np.arange(1, 1001)), atol=1e-7)


def test_other_packages_cannot_replace_a_built_in_effect(install):
    install(**{"motor.coulomb_friction": TorsionSpring})
    assert set(EFFECTS) == set(VALUES)
    assert EFFECTS["motor.coulomb_friction"] is CoulombFriction


class Without(SideEffect):
    kind = "without"
    torque: float = size("N m", "torque")
    speed: float = parameter("rad/s", "no role")


class Forgetful(TorsionSpring):
    kind = "forgetful"

    def resist(self, motion):
        return 0.0


class AsBefore(SideEffect):
    kind = "as_before"
    torque: float = size("N m", "torque")

    def dry_friction(self, state, velocity):
        return self.torque


class NotNeutral(SideEffect):
    kind = "not_neutral"
    torque: float = size("N m", "torque")

    def resist(self, state, motion):
        return 1.0 + self.torque


class TwoAngles(SideEffect):
    kind = "two_angles"
    a: float = angle("one")
    b: float = angle("another")


class Costly(SideEffect):
    kind = "costly"
    torque: float = size("$", "torque")


@pytest.mark.parametrize(
    ("name", "cls", "wrong"),
    [
        ("load.spring", TorsionSpring, "acts as motor.torsion_spring or load.torsion_spring"),
        ("actuator.torsion_spring", TorsionSpring, "acts as motor.torsion_spring or load"),
        ("motor.thing", 3, "derived from AbstractEffect"),
        ("motor.without", Without, "either all numbers or none should have a role"),
        ("motor.forgetful", Forgetful, r"resist should take \(self, state, motion\), not \(self, motion\)"),
        ("motor.as_before", AsBefore, r"dry_friction should take \(self, state, motion\), not \(self, state, velocity\)"),
        ("motor.not_neutral", NotNeutral, "not neutral: resist adds 1"),
        ("motor.two_angles", TwoAngles, "an angle should stand beside one size"),
        ("motor.costly", Costly, r"torque: unit should be one line without control characters and without \$, not '\$'"),
    ],
)
def test_what_is_wrong_with_an_effect_is_one_line_and_it_is_left_out(name, cls, wrong, install, caplog):
    install(**{name: cls})
    assert set(EFFECTS) == set(VALUES)
    (record,) = caplog.records
    assert re.search(wrong, record.message) and name in record.message and "\n" not in record.message


@pytest.mark.parametrize("name", VALUES)
def test_built_in_effects_would_pass_the_check_of_other_packages(name):
    base._check_effect(name, EFFECTS[name])


def test_no_other_module_holds_the_name_of_an_effect():
    """All that others need to know of an effect it says itself."""
    package = Path(base.__file__).parents[2]
    names = {*VALUES, *(name.split(".")[1] for name in VALUES)} - ORDINARY
    held = re.compile(rf"\b({'|'.join(map(re.escape, names))})\b")
    for file in package.rglob("*.py"):
        # the words for MuJoCo's elements, some of which have names of effects, are by class in to_mujoco.py
        if file.is_relative_to(package / "drive" / "effects") or file == package / "exports" / "to_mujoco.py":
            continue
        tree = ast.parse(file.read_text(encoding="utf-8"))
        docs = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs:
                assert not held.search(node.value), (file, node.value)


ORDINARY = {
    "inertia",
    "damping",
    "gravity",
    "backlash",
    "lag",
    "hardening",
    "saturation",
    "eccentricity",
    "hysteresis",
    "delay",
    "tabulated",
    "flexibility",
    "offset",
    "skew",
}
"""Kinds that are plain words, too: of nominal numbers, and of what a sentence may speak of (eccentric encoders)."""


def test_memory_moves_with_the_positions_to_second_order():
    """A Maxwell element, a spring behind a damper: it yields, so that its force depends on the way, not on the place."""

    class Maxwell(SideEffect):
        kind = "maxwell"
        torque: float = size("N m/rad", "stiffness")
        rate: float = parameter("1/s", "stiffness over damping")

        def init(self):
            return (jnp.zeros_like(self.torque),)

        def advance(self, state, motion, step):
            keep = jnp.exp(-self.rate * step)
            return (state[0] * keep + motion.velocity * -jnp.expm1(-self.rate * step) / self.rate,)

        def resist(self, state, motion):
            return self.torque * state[0]

    def rates(t, y):
        _, v, stretch = y
        return [v, (0.1 - 2.0 * stretch) / 0.05, v - 3.0 * stretch]

    expected = solve_ivp(rates, (0.0, 2.0), [0.2, 0.0, 0.0], rtol=1e-11, atol=1e-12).y[:2, -1]
    drive = make_block(Maxwell(side="motor", torque=2.0, rate=3.0))
    errors = []
    for samples in (100, 200, 400):
        start = REST | {"motor_position": 0.2}
        end = simulate_plant(drive, 1, start, np.full(samples, 0.1), 2.0 / samples)[-1]
        errors.append(np.abs(end - expected).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)
    assert np.log2(errors[1] / errors[2]) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("turn", [False, True])
@pytest.mark.parametrize("table", ["position", "speed", "both"])
def test_a_long_table_is_looked_up_and_not_traced_point_by_point(turn, table):
    """The program has one size for all tables; the torque is that of linear interpolation, constant beyond the ends."""
    rng = np.random.default_rng(3)
    points = np.cumsum(rng.uniform(1e-4, 2e-3, 10_000))
    torques = rng.normal(size=len(points))
    numbers = {}
    if table != "speed":
        numbers |= {"positions": tuple(points), "position_torques": tuple(torques)}
    if table != "position":
        numbers |= {"speeds": tuple(-points[::-1]), "speed_torques": tuple(torques)}
    with jax.enable_x64(True):
        effect = as_arrays(make_effect("load.tabulated", turn=turn, **numbers), float)
        position, velocity = (np.append(np.linspace(low, 11.0, 301), points[:5]) for low in (-2.0, -11.0))

        def resist(position, velocity):
            return effect.resist((), Motion(0.0, position, velocity))

        assert len(jax.make_jaxpr(resist)(1.0, 1.0).eqns) < 100
        torque = jax.jit(resist)(position, velocity)
    inside = position % (2.0 * np.pi) if turn else position
    expected = np.interp(inside, points, torques) if table != "speed" else 0.0
    expected = expected + (np.interp(velocity, -points[::-1], torques) if table != "position" else 0.0)
    np.testing.assert_allclose(torque, expected, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("count", [2, 3, 64, 65, 300])
def test_short_and_long_tables_agree(count, monkeypatch):
    """One beyond the limit has the torque that a chain of all its points gives."""
    points, torques = np.linspace(-1.0, 1.0, count).tolist(), np.sin(np.arange(count)).tolist()
    numbers = {"positions": tuple(points), "position_torques": tuple(torques)}
    x = np.linspace(-1.5, 1.5, 1001)
    found = []
    with jax.enable_x64(True):
        for limit in (10_000, 0):
            monkeypatch.setattr(tables, "_CHAINED_POINTS", limit)
            effect = as_arrays(make_effect("motor.tabulated", **numbers), float)
            found.append(np.broadcast_to(effect.resist((), Motion(0.0, x, 0.0)), x.shape))
    np.testing.assert_allclose(*found, rtol=0.0, atol=1e-13)
