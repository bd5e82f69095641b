"""The recursive identifier against batch least squares, the paper's differential form, and long float32 runs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from jaxbl.drive import DeadZone, LinearShaft, SigmoidBacklash, as_arrays
from jaxbl.observer import EquivalentControl, Identifier

SIGMOID = SigmoidBacklash(1.0, 0.02, 20.0)
LAWS = [SIGMOID, LinearShaft(2.0), DeadZone(3.0, 0.05)]
H = 1e-3
SHARE = -np.expm1(-H / 0.01)
"""Share of a new sample in a low-pass of 10 ms."""


def identify(identifier, law, z, torques, time_constant=0.0, dtype=jnp.float64, block=None):
    """Information, estimates and excitation after twists z (rad) and torques (N m) of the sides, one a millisecond.

    Sums are settled every `block` samples.
    """
    identifier, law, low_pass = as_arrays((identifier, law, EquivalentControl(time_constant)), dtype)
    z = jnp.asarray(z, dtype)
    torques = {side: jnp.asarray(torque, dtype) for side, torque in torques.items()}
    return run_identifier(identifier, law, low_pass, z, torques, block)


@eqx.filter_jit
def run_identifier(identifier, law, low_pass, z, torques, block):
    h = jnp.asarray(H, z.dtype)

    def add_sample(state, inputs):
        i, z, torques = inputs
        return identifier.step(state, law, low_pass, z, torques, i.astype(z.dtype) * h, h), None

    def add_block(state, samples):
        return identifier.settle(jax.lax.scan(add_sample, state, samples)[0]), None

    state = identifier.init(law, tuple(torques), jnp.asarray(0.0, z.dtype))
    samples = (jnp.arange(z.size), z, torques)
    if block is None:
        state, _ = jax.lax.scan(add_sample, state, samples)
    else:
        state, _ = jax.lax.scan(add_block, state, jax.tree.map(lambda x: x.reshape(-1, block), samples))
    return information_matrix(state), identifier.estimate(state, law), identifier.excitation(state)


def information_matrix(state):
    """The information matrix from its upper triangle."""
    n = len(state.regressors)
    upper = jnp.stack([total.value(state.weight) for total in state.information])
    rows, columns = jnp.triu_indices(n)
    return jnp.zeros((n, n), upper.dtype).at[rows, columns].set(upper).at[columns, rows].set(upper)


def simulate_record(law, size=4000, noise=0.05, seed=0):
    """Twists that work the law, and a noisy torque of each side."""
    random = np.random.default_rng(seed)
    z = 0.3 * np.sin(30.0 * H * np.arange(size)) + 0.05 * random.normal(size=size)
    torque = np.asarray(law.torque(law.deflection(jnp.asarray(z))))
    return z, {side: torque + noise * random.normal(size=size) for side in ("motor", "load")}


def numpy_regressors(law, z):
    match law:
        case SigmoidBacklash():
            e = np.exp(-law.slope * z)
            return np.stack([z, -4.0 * (1.0 - e) / (1.0 + e)], 1)
        case LinearShaft():
            return z[:, None]
        case DeadZone():
            contact = 1.0 * (np.abs(z) > law.half_gap)
            return np.stack([contact * z, -contact * np.sign(z)], 1)


def parameters_of(law, theta):
    match law:
        case SigmoidBacklash():
            return {"stiffness": theta[0], "dead_zone": theta[1] / theta[0], "half_gap": 4.0 * theta[1] / theta[0]}
        case LinearShaft():
            return {"stiffness": theta[0]}
        case DeadZone():
            return {"stiffness": theta[0], "half_gap": theta[1] / theta[0]}


@pytest.mark.parametrize("regressor_filter", ["none", "matched"])
@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_least_squares_of_both_sides(law, regressor_filter):
    """With forgetting, a delayed start, and the low-pass of one sample's delay on phi where it is matched."""
    z, torques = simulate_record(law)
    forgetting, start, time_constant = 0.9999, 501, 0.01
    identifier = Identifier(start * H, forgetting, regressor_filter)
    _, estimates, _ = identify(identifier, law, z, torques, time_constant)
    phi = numpy_regressors(law, z)
    if regressor_filter == "matched":
        filtered, late = np.zeros_like(phi), np.zeros(phi.shape[1])
        for i, raw in enumerate(phi):
            filtered[i] = late
            late = late + (1.0 - np.exp(-H / time_constant)) * (raw - late)
        phi = filtered
    root_weight = np.sqrt(forgetting ** np.arange(z.size)[::-1])[start:, None]
    for side, torque in torques.items():
        theta, *_ = np.linalg.lstsq(root_weight * phi[start:], root_weight[:, 0] * torque[start:])
        expected = parameters_of(law, theta)
        assert estimates[side].keys() == expected.keys()
        for name, value in expected.items():
            np.testing.assert_allclose(estimates[side][name], value, rtol=1e-9)
    assert estimates["motor"]["stiffness"] != estimates["load"]["stiffness"]


def test_sums_are_the_solution_of_the_papers_differential_form():
    """(27)-(28), integrated by SciPy from a large covariance, on a torque that no parameters explain exactly."""
    duration = 4.0

    def z(t):
        return 0.3 * np.sin(3.0 * t)

    def torque(t):
        return z(t) - 0.08 * np.tanh(10.0 * z(t)) + 0.02 * np.sin(7.0 * t)

    def right(t, y):
        estimate, covariance = y[:2], y[2:].reshape(2, 2)
        phi = numpy_regressors(SIGMOID, np.array([z(t)]))[0]
        change = -covariance @ np.outer(phi, phi) @ covariance
        return np.concatenate([(torque(t) - estimate @ phi) * (phi @ covariance), change.ravel()])

    start = np.concatenate([np.zeros(2), 1e8 * np.eye(2).ravel()])
    theta = solve_ivp(right, (0.0, duration), start, method="LSODA", rtol=1e-9, atol=1e-12).y[:2, -1]
    t = H * (np.arange(round(duration / H)) + 0.5)
    _, estimates, _ = identify(Identifier(0.0, 1.0, "none"), SIGMOID, z(t), {"motor": torque(t)})
    for name, value in parameters_of(SIGMOID, theta).items():
        np.testing.assert_allclose(estimates["motor"][name], value, rtol=1e-4)
    # neither is the truth
    assert abs(theta[0] - 1.0) > 1e-2


def test_a_million_samples_in_float32():
    """Positive and accurate to float32's own rounding, which plain sums are not."""
    z, torques = simulate_record(SIGMOID, 1_000_000)
    z, torques = z.astype(np.float32), {side: torque.astype(np.float32) for side, torque in torques.items()}
    identifier = Identifier(0.0, 1.0, "none")
    information, estimates, excitation = identify(identifier, SIGMOID, z, torques, dtype=jnp.float32, block=500)
    exact, true, true_excitation = identify(identifier, SIGMOID, z, torques)
    assert information.dtype == jnp.float32
    np.testing.assert_array_equal(information, information.T)
    assert np.all(np.linalg.eigvalsh(np.asarray(information, float)) > 0.0)
    np.testing.assert_allclose(information, exact, rtol=3e-7)
    np.testing.assert_allclose(excitation, true_excitation, rtol=1e-4)
    for name in ("stiffness", "dead_zone"):
        np.testing.assert_allclose(estimates["motor"][name], true["motor"][name], rtol=1e-5)
    # which is not for nothing
    plain = np.cumsum(z * z, dtype=np.float32)[-1]
    assert abs(plain / exact[0, 0] - 1.0) > 3e-6


def test_start_and_forgetting_in_the_plain_sums():
    """The sample at `start` is the first to count, in float32 too, and each later one weighs the earlier ones down."""
    z = np.array([5.0, 7.0, 1.0, 2.0, 3.0])
    for dtype in (jnp.float32, jnp.float64):
        identifier = Identifier(2 * H, 0.5, "none")
        information, estimates, _ = identify(identifier, LinearShaft(1.0), z, {"motor": 4.0 * z}, dtype=dtype)
        np.testing.assert_allclose(information, [[0.25 * 1.0 + 0.5 * 4.0 + 9.0]])
        np.testing.assert_allclose(estimates["motor"]["stiffness"], 4.0)


def test_settling_changes_no_figure():
    z, torques = simulate_record(SIGMOID)
    identifier = Identifier(0.5, 0.99)
    reference = identify(identifier, SIGMOID, z, torques, 0.01)
    for block in (1, 400):
        settled = identify(identifier, SIGMOID, z, torques, 0.01, block=block)
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-10), settled, reference)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_nan_without_excitation(law):
    z, torques = simulate_record(law)
    _, estimates, excitation = identify(Identifier(), law, 0.0 * z, dict.fromkeys(torques, 0.0 * z))
    assert all(np.isnan(value) for side in estimates.values() for value in side.values())
    assert excitation == 0.0
    # before the start nothing is known either
    _, estimates, excitation = identify(Identifier(4.0), law, z, torques)
    assert all(np.isnan(value) for side in estimates.values() for value in side.values())
    assert excitation == 0.0


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_one_twist_does_not_determine_two_unknowns(dtype):
    constant_twist = np.full(100, 0.3)
    _, estimates, excitation = identify(
        Identifier(regressor_filter="none"), SIGMOID, constant_twist, {"motor": constant_twist}, dtype=dtype
    )
    assert all(np.isnan(value) for value in estimates["motor"].values())
    assert abs(excitation) < 1e-6


def test_excitation_is_the_least_eigenvalue_of_the_normalised_matrix():
    z, torques = simulate_record(SIGMOID)
    information, _, excitation = identify(Identifier(regressor_filter="none"), SIGMOID, z, torques)
    information = np.asarray(information)
    scale = 1.0 / np.sqrt(np.diag(information))
    np.testing.assert_allclose(excitation, np.linalg.eigvalsh(information * np.outer(scale, scale))[0], rtol=1e-9)
    _, _, single = identify(Identifier(), LinearShaft(1.0), z, torques)
    assert single == 1.0


def stiffness_after(law, standstill, at, noise, dtype, forgetting, resumed=0):
    """Stiffness identified after 4 s of motion, `standstill` samples at one twist, and `resumed` ones of motion."""
    random = np.random.default_rng(7)
    motion = 0.3 * np.sin(2.0 * np.pi * 3.0 * H * np.arange(4000))
    z = np.concatenate([motion, np.full(standstill, at), motion[:resumed]])
    torque = np.asarray(law.torque(law.deflection(jnp.asarray(z)))) + 1e2 * noise * random.normal(size=z.size)
    readings = z + noise * random.normal(size=z.size)
    identifier = Identifier(0.0, forgetting, "none")
    return float(identify(identifier, law, readings, {"motor": torque}, dtype=dtype, block=500)[1]["motor"]["stiffness"])


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_after_a_standstill_there_are_no_numbers_or_good_ones(law, dtype, repeats):
    random = np.random.default_rng(8)
    for _ in range(repeats(3, 100)):
        # standstills of a tenth to thirty times the memory
        standstill = int(random.choice([2_000, 20_000]))
        memory = standstill / 10.0 ** random.uniform(-1.0, 1.5)
        case = random.choice([0.0, 0.02, 0.2]), 10.0 ** random.uniform(-5.0, -4.0), dtype, 1.0 - 1.0 / max(memory, 300.0)
        before, after = stiffness_after(law, 0, *case), stiffness_after(law, standstill, *case)
        again = stiffness_after(law, standstill, *case, resumed=2000)
        assert np.isnan(after) or abs(after / before - 1.0) < 0.5, (standstill, case, after)
        assert abs(again / before - 1.0) < 0.3, (standstill, case)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_a_standstill_takes_nothing_away_that_is_not_forgotten(law):
    before, after = (stiffness_after(law, standstill, 0.0, 1e-4, jnp.float64, 1.0) for standstill in (0, 20_000))
    assert abs(after / before - 1.0) < 0.01


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_a_standstill_under_load_leaves_the_last_numbers(law, dtype, repeats):
    """At rest friction holds a part of the torque, which says nothing of the law; noise is up to 1 % of the motion."""
    random = np.random.default_rng(9)
    for _ in range(repeats(3, 60)):
        forgetting, noise = random.choice([0.999, 0.9995]), 0.3 * 10.0 ** random.uniform(-4.0, -2.0)
        twists = 0.3 * np.sin(2.0 * np.pi * random.uniform(1.0, 5.0) * H * np.arange(4000))
        rest, held = random.uniform(-0.3, 0.3), random.uniform(-0.25, 0.25)
        z = np.concatenate([twists, np.full(20_000, rest)])
        # the drive comes to rest with the torque of the law, of which friction then takes over a part
        torque = np.asarray(law.torque(law.deflection(jnp.asarray(z)))) + held * (np.arange(z.size) > 4100)
        filtered = lfilter([0.0, SHARE], [1.0, SHARE - 1.0], torque) + noise * random.normal(size=z.size)
        readings = z + noise * random.normal(size=z.size)
        before, *after = (
            identify(
                Identifier(0.0, forgetting), law, readings[:end], {"motor": filtered[:end]}, 0.01, dtype=dtype, block=500
            )[1]["motor"]["stiffness"]
            for end in (4000, 4500, 6000, 24_000)
        )
        for stiffness in after:
            assert np.isnan(stiffness) or abs(stiffness / before - 1.0) < 0.2, (rest, held, noise, before, after)
        if noise < 1e-3:
            assert not np.isnan(after).any()


def test_a_stay_is_left_out_and_forgets_nothing():
    """The sums of a stay of any length are those of its first samples, a hundredth of the memory of them."""
    motion, forgetting = 0.3 * np.sin(30.0 * H * np.arange(2000)), 0.999
    identifier = Identifier(0.0, forgetting, "none")
    information = [
        identify(identifier, SIGMOID, np.concatenate([motion, np.full(stay, 0.5)]), {"motor": np.zeros(2000 + stay)})[0]
        for stay in (9, 10, 11, 5000)
    ]
    assert (information[0] != information[1]).any()
    assert (information[1] == information[2]).all() and (information[1] == information[3]).all()
