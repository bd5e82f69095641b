"""Transmission laws: torque over the gear as a function of the deflection z = theta_e - N_0 theta_s.

Each law also knows itself as a linear regression, torque = regressors(z) . theta, which is what the recursive
identifier of eqs. (18)-(28) works on, and how theta reads in the law's own parameters.

Further packages add laws through the entry-point group `jaxbl.transmissions`; the entry's name is the law's.
"""

import abc
from collections.abc import Mapping
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbl.registry import Registry, check_module

from .mujoco_parts import MujocoParts, Said, exactly, nearly, unsaid
from .parameters import Scalar, parameter


class AbstractTransmission(eqx.Module):
    """A transmission law. `deflection` is what of z is left once contact is made; torque follows from it.

    Attributes:
        name: key `law` of the config.
        errors: metrics that the law adds, and the parameter in `truth` of whose identified value each is the relative error.
        stiffness: largest slope of the law, N m/rad; the plant's steps have to resolve it.
        half_gap: half of the free play, rad on the motor side; 0 where there is none.
    """

    name: ClassVar[str]
    errors: ClassVar[Mapping[str, str]] = {}
    stiffness: eqx.AbstractVar[Scalar]
    half_gap: eqx.AbstractVar[Scalar]

    def deflection(self, z: Float[Array, ""]) -> Float[Array, ""]:
        """Elastic deflection in rad that the twist z (rad) leaves; z itself unless the law has a free gap."""
        return z

    @abc.abstractmethod
    def torque(self, deflection: Float[Array, ""]) -> Float[Array, ""]:
        """Transmitted torque C in N m on the motor shaft, for a deflection in rad."""

    @abc.abstractmethod
    def regressors(self, z: Float[Array, ""]) -> tuple[Float[Array, ""], ...]:
        """Functions of z, linear in the unknowns theta: C = sum(r_i theta_i)."""

    @abc.abstractmethod
    def from_theta(self, theta: tuple[Float[Array, ""], ...]) -> dict[str, Float[Array, ""]]:
        """The law's parameters, and what else `truth` has, from regression coefficients."""

    @abc.abstractmethod
    def truth(self) -> dict[str, Scalar]:
        """The same parameters as they are in this law."""

    def to_mujoco(self, parts: MujocoParts) -> Said:
        """Add the law to the parts of a MuJoCo model, as springs between the sides, and say how well that has it.

        The numbers are Python floats. A law that MuJoCo cannot say leaves no model.
        """
        return unsaid("its class does not say how")


TRANSMISSIONS = Registry("jaxbl.transmissions", partial(check_module, base=AbstractTransmission))
"""The laws by name: the built-in ones and those of installed packages."""


@TRANSMISSIONS.add
class SigmoidBacklash(AbstractTransmission):
    """Smooth backlash, eq. (3): C = K (z - 4 j_0 (1 - e^{-gamma z}) / (1 + e^{-gamma z})), with tanh(gamma z / 2).

    Far from zero C tends to K (z -+ 4 j_0): the gap has half-width 4 j_0, not j_0. Where 2 gamma j_0 > 1 the stiffness
    at z = 0, K (1 - 2 gamma j_0), is negative and C changes sign near +-4 j_0; below that the law is only softer there.
    """

    name: ClassVar[str] = "sigmoid_backlash"
    errors: ClassVar[Mapping[str, str]] = {"stiffness_error": "stiffness", "dead_zone_error": "half_gap"}
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

    def to_mujoco(self, parts):
        # springs in parallel, each slack up to its corner: tanh by chords
        corners, slopes, error = _chords()
        softening = 2.0 * self.slope * self.dead_zone * self.stiffness
        parts.spring(self.stiffness - softening * slopes[0])
        for corner, before, after in zip(corners[1:], slopes, [*slopes[1:], 0.0], strict=True):
            parts.spring(softening * (before - after), slack=2.0 / self.slope * corner)
        return nearly(
            f"{len(corners)} springs in parallel, with dead bands: the torque is at most "
            f"{4.0 * self.dead_zone * self.stiffness * error:.2g} N m off, {error:.1g} of 4 j_0 K"
        )


def _chords() -> tuple[list[float], list[float], float]:
    """tanh over x > 0 by chords: their corners and slopes, and the largest error. The last one ends at 1."""
    fine = np.linspace(0.0, 4.0, 4001)
    # the error of a chord goes with the second derivative and the square of its length
    share = np.cumsum(np.sqrt(np.tanh(fine)) / np.cosh(fine))
    corners = np.interp(np.linspace(0.0, 1.0, 25), share / share[-1], fine)
    heights = np.append(np.tanh(corners[:-1]), 1.0)
    error = np.max(np.abs(np.interp(fine, corners, heights) - np.tanh(fine)))
    return corners.tolist(), (np.diff(heights) / np.diff(corners)).tolist(), float(error)


@TRANSMISSIONS.add
class LinearShaft(AbstractTransmission):
    """Flexible shaft without play, eq. (5): C = K z."""

    name: ClassVar[str] = "linear_shaft"
    errors: ClassVar[Mapping[str, str]] = {"stiffness_error": "stiffness"}
    half_gap: ClassVar[float] = 0.0  # type: ignore[misc]
    stiffness: Scalar = parameter("N m/rad", "stiffness K", above=0.0)

    def torque(self, deflection):
        return self.stiffness * deflection

    def regressors(self, z):
        return (z,)

    def from_theta(self, theta):
        return {"stiffness": theta[0]}

    def truth(self):
        return {"stiffness": self.stiffness}

    def to_mujoco(self, parts):
        parts.spring(self.stiffness)
        return exactly("spring of a tendon between the joints")


@TRANSMISSIONS.add
class DeadZone(AbstractTransmission):
    """Hard dead zone: C = K (z - clip(z, -half_gap, half_gap)).

    Its regression, C = K z - K b sign(z) in contact and 0 in the gap, takes the contact from the nominal half gap, as
    the paper takes gamma: with a true half gap b near the nominal one, K and K b follow.
    """

    name: ClassVar[str] = "dead_zone"
    errors: ClassVar[Mapping[str, str]] = {"stiffness_error": "stiffness", "dead_zone_error": "half_gap"}
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

    def truth(self):
        return {"stiffness": self.stiffness, "half_gap": self.half_gap}

    def to_mujoco(self, parts):
        parts.half_gap += self.half_gap
        parts.spring(self.stiffness)
        return exactly("spring of a tendon between the joints, slack within the gap (springlength)")
