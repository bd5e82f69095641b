"""Transmission laws: the torque C that gear and shaft transmit at a twist z = theta_e - N_0 theta_s.

For the recursive identifier (18)-(28) a law is also a linear regression, C = regressors(z) . theta, and converts the
coefficients theta into its own parameters.

Installed packages add laws by the entry-point group `jaxbl.transmissions`; the entry point's name is the law's.
"""

import abc
from collections.abc import Mapping
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from jaxbl.registry import Registry, check_module

from .parameters import Scalar, ScalarArray, parameter, parameters


class AbstractTransmission(eqx.Module):
    """A transmission law C(z): :meth:`deflection` of a twist, then :meth:`torque` of the deflection.

    Attributes:
        name: key `law` of the config.
        errors: names of metrics that the law adds, each with the key of `truth` whose relative identification error it is.
        stiffness: largest slope of the law, N m/rad; the plant's steps have to resolve it.
        half_gap: half of the free play, rad on the motor side; 0 without any.
    """

    name: ClassVar[str]
    errors: ClassVar[Mapping[str, str]] = {}
    stiffness: eqx.AbstractVar[Scalar]
    half_gap: eqx.AbstractVar[Scalar]

    def deflection(self, z: ScalarArray) -> ScalarArray:
        """Elastic deflection (rad) at a twist z (rad): the part of z beyond the free play."""
        return z

    def __call__(self, z: ScalarArray) -> ScalarArray:
        """Transmitted torque C (N m) at a twist z (rad)."""
        return self.torque(self.deflection(z))

    @abc.abstractmethod
    def torque(self, deflection: ScalarArray) -> ScalarArray:
        """Transmitted torque C (N m) on the motor shaft, at a deflection (rad)."""

    @abc.abstractmethod
    def regressors(self, z: ScalarArray) -> tuple[ScalarArray, ...]:
        """Functions r_i of the twist z (rad) such that C = sum_i r_i(z) theta_i, with unknown coefficients theta_i."""

    @abc.abstractmethod
    def from_theta(self, theta: tuple[ScalarArray, ...]) -> dict[str, ScalarArray]:
        """Convert regression coefficients theta into the numbers of :meth:`truth`."""

    def truth(self) -> dict[str, Scalar]:
        """Numbers that are identified, by name: those that the law declares, unless overridden."""
        return {field.name: getattr(self, field.name) for field, _ in parameters(self)}


TRANSMISSIONS = Registry("jaxbl.transmissions", partial(check_module, base=AbstractTransmission))
"""Laws by name, those of installed packages included."""


@TRANSMISSIONS.add
class SigmoidBacklash(AbstractTransmission):
    """Smooth backlash, eq. (3): C = K (z - 4 j_0 (1 - e^{-gamma z}) / (1 + e^{-gamma z})), with tanh(gamma z / 2).

    Far from zero C tends to K (z -+ 4 j_0): half of the gap is 4 j_0, not j_0. If 2 gamma j_0 > 1, the stiffness
    K (1 - 2 gamma j_0) at z = 0 is negative, and C changes sign near +-4 j_0; otherwise the law is only softer there.
    As a regression, C = K z - K j_0 4 tanh(gamma z / 2) has the coefficients K and K j_0 (21), with nominal gamma.
    """

    name = "sigmoid_backlash"
    errors: ClassVar = {"stiffness_error": "stiffness", "dead_zone_error": "half_gap"}
    stiffness: Scalar = parameter("N m/rad", "stiffness K", above=0.0)
    dead_zone: Scalar = parameter("rad", "dead-zone amplitude j_0 of law (3); the half gap is 4 j_0", minimum=0.0)
    slope: Scalar = parameter("1/rad", "slope gamma of law (3)", above=0.0)

    @property
    def half_gap(self) -> Scalar:
        return 4.0 * self.dead_zone

    def torque(self, deflection):
        return self.stiffness * (deflection - 4.0 * self.dead_zone * jnp.tanh(0.5 * self.slope * deflection))

    def regressors(self, z):
        return z, -4.0 * jnp.tanh(0.5 * self.slope * z)

    def from_theta(self, theta):
        stiffness, product = theta
        dead_zone = product / stiffness
        return {"stiffness": stiffness, "dead_zone": dead_zone, "half_gap": 4.0 * dead_zone}

    def truth(self):
        return {"stiffness": self.stiffness, "dead_zone": self.dead_zone, "half_gap": self.half_gap}


@TRANSMISSIONS.add
class LinearShaft(AbstractTransmission):
    """Flexible shaft without play (5): C = K z."""

    name = "linear_shaft"
    errors: ClassVar = {"stiffness_error": "stiffness"}
    half_gap: ClassVar[float] = 0.0  # type: ignore[misc]
    stiffness: Scalar = parameter("N m/rad", "stiffness K", above=0.0)

    def torque(self, deflection):
        return self.stiffness * deflection

    def regressors(self, z):
        return (z,)

    def from_theta(self, theta):
        return {"stiffness": theta[0]}


@TRANSMISSIONS.add
class DeadZone(AbstractTransmission):
    """Hard dead zone: C = K (z - clip(z, -half_gap, half_gap)).

    As a regression, C = K z - K b sign(z) in contact and 0 in the gap has the coefficients K and K b, where b is the half
    gap. Whether there is contact is taken from the nominal half gap, as gamma is nominal in law (3).
    """

    name = "dead_zone"
    errors: ClassVar = {"stiffness_error": "stiffness", "dead_zone_error": "half_gap"}
    stiffness: Scalar = parameter("N m/rad", "stiffness K in contact", above=0.0)
    half_gap: Scalar = parameter("rad", "half of the free play, on the motor side", minimum=0.0)

    def deflection(self, z):
        return z - jnp.clip(z, -self.half_gap, self.half_gap)

    def torque(self, deflection):
        return self.stiffness * deflection

    def regressors(self, z):
        contact = jnp.where(jnp.abs(z) > self.half_gap, 1.0, 0.0).astype(z.dtype)
        return contact * z, -contact * jnp.sign(z)

    def from_theta(self, theta):
        stiffness, product = theta
        return {"stiffness": stiffness, "half_gap": product / stiffness}
