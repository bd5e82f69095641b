"""Transmission laws: shape, symmetry, and agreement with their own regression."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jaxbl.drive import TRANSMISSIONS, DeadZone, LinearShaft, SigmoidBacklash, as_arrays

stiffness = st.floats(1e-2, 1e3)
gap = st.floats(0.0, 1.0)
LAWS = st.one_of(
    st.builds(SigmoidBacklash, stiffness=stiffness, dead_zone=gap, slope=st.floats(0.1, 1e3)),
    st.builds(LinearShaft, stiffness=stiffness),
    st.builds(DeadZone, stiffness=stiffness, half_gap=gap),
).map(lambda law: as_arrays(law, jnp.float64))
TWIST = st.floats(-5.0, 5.0).map(jnp.asarray)


def transmitted_torque(law, z):
    return law.torque(law.deflection(z))


def to_floats(values):
    return {key: float(value) for key, value in values.items()}


@settings(deadline=None, max_examples=50)
@given(LAWS, TWIST)
def test_laws_are_odd(law, z):
    assert transmitted_torque(law, -z) == -transmitted_torque(law, z)


@settings(deadline=None, max_examples=50)
@given(LAWS, TWIST)
def test_torque_is_the_regression_with_the_true_parameters(law, z):
    truth = law.truth()
    theta = (truth["stiffness"],)
    if len(truth) > 1:
        # the second unknown is K times the gap parameter that follows the stiffness
        theta += (truth["stiffness"] * list(truth.values())[1],)
    regressors = law.regressors(z)
    assert len(regressors) == len(theta)
    predicted = sum(r * t for r, t in zip(regressors, theta, strict=True))
    assert predicted == pytest.approx(float(transmitted_torque(law, z)), rel=1e-12, abs=1e-12 * float(law.stiffness))
    assert to_floats(law.from_theta(theta)) == pytest.approx(to_floats(truth), rel=1e-12)


@settings(deadline=None, max_examples=50)
@given(LAWS, TWIST)
def test_far_from_zero_the_law_is_the_shaft_less_the_half_gap(law, z):
    z = z + jnp.copysign(6.0 + 80.0 / getattr(law, "slope", 80.0), z)
    expected = float(jnp.sign(z) * law.stiffness * (jnp.abs(z) - law.truth().get("half_gap", 0.0)))
    assert transmitted_torque(law, z) == pytest.approx(expected, rel=1e-9, abs=1e-9 * float(law.stiffness))


def test_sigmoid_is_the_papers_exponential_form():
    law = SigmoidBacklash(stiffness=2.0, dead_zone=0.03, slope=25.0)
    z = np.linspace(-0.5, 0.5, 101)
    expected = 2.0 * (z - 4.0 * 0.03 * (1.0 - np.exp(-25.0 * z)) / (1.0 + np.exp(-25.0 * z)))
    np.testing.assert_allclose(transmitted_torque(law, jnp.asarray(z)), expected, atol=1e-15)
    # negative stiffness at zero where 2 gamma j_0 > 1
    assert jax.grad(law.torque)(0.0) == pytest.approx(2.0 * (1.0 - 2.0 * 25.0 * 0.03))


def test_dead_zone_is_free_inside_and_elastic_outside():
    law = DeadZone(stiffness=3.0, half_gap=0.1)
    inside = jnp.linspace(-0.1, 0.1, 21)
    assert not transmitted_torque(law, inside).any()
    assert transmitted_torque(law, jnp.asarray(0.3)) == pytest.approx(0.6)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_laws_keep_the_precision(dtype):
    laws = (SigmoidBacklash(1.0, 0.02, 20.0), LinearShaft(1.0), DeadZone(1.0, 0.1))
    assert {law.name for law in laws} == set(TRANSMISSIONS)
    z = jnp.asarray(0.3, dtype)
    for law in as_arrays(laws, dtype):
        assert {leaf.dtype for leaf in jax.tree.leaves((transmitted_torque(law, z), law.regressors(z)))} == {
            jnp.dtype(dtype)
        }
