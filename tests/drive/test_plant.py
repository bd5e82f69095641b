"""The drive in motion: order, energy, momentum, closed forms and derivatives of the time stepping."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drive_reference import HOLD, LAWS, SIGMOID, START, TORQUES, integrate_reference, make_plant, simulate_plant
from hypothesis import given, settings, strategies as st

from jaxbl.drive import DRIVES, Initial, LinearShaft, Plant, Rigid, SigmoidBacklash, TwoInertia, as_arrays, make_effect

REST = dict.fromkeys(START, 0.0)
PAPER = {"motor_inertia": 0.05, "motor_viscous": 0.15, "load_inertia": 7.0, "load_viscous": 16.0, "gear_ratio": 5.0}
FREE = PAPER | {"motor_viscous": 0.0, "load_viscous": 0.0}


@pytest.mark.parametrize("law", LAWS)
def test_second_order_against_scipy(law):
    package_law, numpy_law = LAWS[law]
    expected = integrate_reference(numpy_law)
    coarse, fine = (
        np.abs(simulate_plant(make_plant(law=package_law), substeps) - expected).max() for substeps in (64, 1024)
    )
    # the hard gap is only piecewise smooth: of second order in the mean
    assert np.log2(coarse / fine) / 4.0 == pytest.approx(2.0, abs=0.1 if law == "dead_zone" else 5e-3)
    assert fine < 1e-6


def test_the_papers_drive_at_the_default_step():
    """Positions to 1e-8 rad over a period of the paper's input, held for a tenth of a second."""
    torques = 0.1 * np.sin(2.0 * np.pi * 0.16 * 0.1 * np.arange(62))
    drive = make_plant(law=SigmoidBacklash(stiffness=1.0, dead_zone=0.02, slope=20.0), **PAPER)
    expected = integrate_reference(
        lambda z: z - 0.08 * np.tanh(10.0 * z), drive=PAPER, start=REST, torques=torques, hold=0.1
    )
    assert np.abs(expected[:, 0]).max() > 0.1
    np.testing.assert_allclose(simulate_plant(drive, 1000, REST, torques, 0.1)[:, :2], expected[:, :2], atol=1e-8)
    # and without a single substep, an order above the noise of a good encoder
    np.testing.assert_allclose(simulate_plant(drive, 100, REST, torques, 0.1)[:, :2], expected[:, :2], atol=1e-6)


def potential_energy(law, z):
    if law == "sigmoid_backlash":
        return SIGMOID["stiffness"] * (
            0.5 * z**2 - 8.0 * SIGMOID["dead_zone"] / SIGMOID["slope"] * np.log(np.cosh(0.5 * SIGMOID["slope"] * z))
        )
    return 1.5 * (z if law == "linear_shaft" else z - np.clip(z, -0.05, 0.05)) ** 2


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("twist", [0.3, 1.0])
@pytest.mark.parametrize("eccentric", [False, True])
def test_energy_drifts_less_than_a_millionth_in_20_s(law, twist, eccentric):
    """On the paper's inertias at the default step, without friction and input, relative to the energy above the minimum."""
    error = {"amplitude": 0.2, "harmonic": 40.0, "phase": 0.5} if eccentric else {"amplitude": 0.0, "harmonic": 1.0}
    drive = make_plant(make_effect("transmission.eccentricity", **error), law=LAWS[law][0], **FREE)
    start = REST | {"motor_position": twist, "load_velocity": 0.05}
    states = np.vstack([[twist, 0.0, 0.0, 0.05], simulate_plant(drive, 10, start, np.zeros(20_000), 1e-3)])
    motor, load, motor_velocity, load_velocity = states.T
    kinetic = 0.5 * FREE["motor_inertia"] * motor_velocity**2 + 0.5 * FREE["load_inertia"] * load_velocity**2
    z = motor - FREE["gear_ratio"] * load + error["amplitude"] * np.sin(error["harmonic"] * load + error.get("phase", 0.0))
    energy = kinetic + potential_energy(law, z) - potential_energy(law, np.linspace(-0.3, 0.3, 10_001)).min()
    assert np.ptp(kinetic) > 0.5 * energy[0]  # it does swing
    assert np.abs(energy / energy[0] - 1.0).max() < 1e-6


numbers = st.floats(-2.0, 2.0)
STATES = st.builds(Initial, numbers, numbers, numbers, numbers)


@eqx.filter_jit
def _advance(drive, state, torque, time, step):
    return drive.advance(state, torque, time, step)


def advance(drive, state, step=1e-3, torque=0.0):
    return _advance(drive, state, *(jnp.asarray(value) for value in (torque, 0.3, step)))


FREE_DRIVES = {name: make_plant(law=law, **FREE) for name, (law, _) in LAWS.items()}


@settings(deadline=None, max_examples=50)
@given(STATES, st.sampled_from(sorted(LAWS)))
def test_the_transmission_conserves_momentum(initial, law):
    """Torque -C on the motor is N_0 C on the load, whatever C."""
    drive = FREE_DRIVES[law]
    before = drive.init(as_arrays(initial, jnp.float64))
    after = advance(drive, before, 1e-2)

    def momentum(velocity):
        return float(5.0 * 0.05 * velocity["motor"] + 7.0 * velocity["load"])

    assert momentum(after.velocity) == pytest.approx(momentum(before.velocity), rel=1e-12, abs=1e-12)


@pytest.fixture(scope="module")
def conservative_drive():
    effects = {
        "load.gravity": {"torque": 0.5},
        "motor.cogging": {"amplitude": 0.1, "harmonic": 6.0},
        "transmission.eccentricity": {"amplitude": 0.05, "harmonic": 3.0},
        "transmission.hardening": {"cubic_stiffness": 20.0},
    }
    return make_plant(*(make_effect(name, **numbers) for name, numbers in effects.items()), **PAPER)


@settings(deadline=None, max_examples=50)
@given(initial=STATES, torque=numbers)
def test_the_scheme_is_symmetric_in_time(conservative_drive, initial, torque):
    """A step back undoes a step: this is what keeps the energy."""
    drive = conservative_drive
    before = drive.init(as_arrays(initial, jnp.float64))
    forward = advance(drive, before, 1e-2, torque)
    backward = advance(drive, forward, -1e-2, torque)
    np.testing.assert_allclose(jax.tree.leaves(backward), jax.tree.leaves(before), atol=1e-8)


def test_a_linear_shaft_against_the_closed_form():
    """Free drive: the centre of momentum moves on, the twist swings at sqrt(K (1 / J_e + N_0^2 / J_s))."""
    stiffness, twist = 2.0, 0.4
    drive = make_plant(law=LinearShaft(stiffness), **FREE)
    start = REST | {"motor_position": twist, "motor_velocity": 0.5, "load_velocity": 0.1}
    time = 1e-3 * np.arange(1, 5001)
    states = simulate_plant(drive, 10, start, np.zeros(5000), 1e-3)
    omega = np.sqrt(stiffness * (1.0 / 0.05 + 25.0 / 7.0))
    z = twist * np.cos(omega * time)  # 0.5 = N_0 0.1: no twist rate at the start
    weighted = 5.0 * 0.05 * (twist + 0.5 * time) + 7.0 * 0.1 * time
    load = (weighted - 5.0 * 0.05 * z) / (25.0 * 0.05 + 7.0)
    np.testing.assert_allclose(states[:, 1], load, atol=2e-8)
    np.testing.assert_allclose(states[:, 0], z + 5.0 * load, atol=1e-6)


def test_effects_and_drive_parameters_are_differentiable():
    """Forward derivatives of the whole motion, which the fits need, against differences."""

    def end(stiffness, drag):
        drive = make_plant(make_effect("load.quadratic_drag", drag=0.05), law=LinearShaft(3.0))
        drive = eqx.tree_at(lambda p: (p.transmission.stiffness, p.effects[0].drag), drive, (stiffness, drag))
        return _end_position(drive)

    values = (jnp.asarray(3.0), jnp.asarray(0.05))
    for i, step in enumerate((1e-4, 1e-5)):
        direction = tuple(jnp.asarray(float(i == j)) for j in range(2))
        _, derivative = jax.jvp(end, values, direction)
        end_above, end_below = (
            end(*(x + sign * step * d for x, d in zip(values, direction, strict=True))) for sign in (1.0, -1.0)
        )
        assert float(derivative) == pytest.approx(float(end_above - end_below) / (2.0 * step), rel=1e-6)
        assert abs(derivative) > 1e-3


def test_a_batch_of_drives_moves_as_each_alone():
    frictions = jnp.asarray([0.0, 0.05, 0.2])
    drive = make_plant(make_effect("motor.coulomb_friction", torque=0.0))

    def end(level):
        return _end_position(eqx.tree_at(lambda p: p.effects[0].torque, drive, level))

    together = jax.vmap(end)(frictions)
    np.testing.assert_allclose(together, [end(level) for level in frictions], rtol=1e-13)
    assert len(np.unique(together)) == 3


@jax.jit
def _end_position(drive):
    """Motor position after all `TORQUES`, in steps of an eighth of a hold."""
    step = HOLD / 8.0

    def advance_sample(state, inputs):
        torque, time = inputs
        return drive.advance(state, torque, time, jnp.asarray(step)), None

    torques = jnp.repeat(jnp.asarray(TORQUES), 8)
    times = step * jnp.arange(len(torques))
    state, _ = jax.lax.scan(advance_sample, drive.init(as_arrays(Initial(**START), jnp.float64)), (torques, times))
    return state.position["motor"]


def test_what_the_observers_know_of_a_drive():
    two_inertia, rigid = TwoInertia(**PAPER), Rigid(motor_inertia=0.05, motor_viscous=0.15)
    assert {drive.name: type(drive) for drive in (two_inertia, rigid)} == DRIVES
    for drive in (two_inertia, rigid):
        assert drive.acceleration("motor", 2.0, 0.5) == pytest.approx((0.5 - 0.15 * 2.0) / 0.05)
        assert drive.torque_gain("motor") == -1.0 and drive.ratio("motor") == 1.0
    assert two_inertia.acceleration("load", 2.0, 0.5) == pytest.approx(-16.0 * 2.0 / 7.0)  # the input does not act there
    assert two_inertia.torque_gain("load") == two_inertia.ratio("load") == 5.0
    heavier = Plant(two_inertia, LinearShaft(1.0), (make_effect("load.inertia", inertia=0.5),))
    assert (heavier.inertia("motor"), heavier.inertia("load")) == (0.05, 7.5)


def test_initial_state_has_the_sides_of_the_drive():
    initial = as_arrays(Initial(motor_position=1.0, motor_velocity=2.0, load_position=3.0, load_velocity=4.0), jnp.float64)
    two = make_plant(make_effect("actuator.lag", time_constant=0.1)).init(initial)
    assert (two.position, two.velocity, two.effects) == ({"motor": 1.0, "load": 3.0}, {"motor": 2.0, "load": 4.0}, ((0.0,),))
    rigid = Plant(Rigid(0.05, 0.15), None).init(initial)
    assert (rigid.position, rigid.velocity) == ({"motor": 1.0}, {"motor": 2.0})
