"""Recursive least squares (22)-(28) on the equivalent control, both sides at once.

The paper integrates the estimate and its covariance, (27)-(28). Their exact discrete solution is (23) with sums for the
integrals, and that is what is kept here: the information matrix sum(phi phi^T), and sum(phi z_2). Sums do not drift as
an integrated covariance does. They have two levels: samples are added to a recent part, and :meth:`Identifier.settle`
moves that, every few hundred samples, into a total which carries its rounding error along (Kahan). 10^6 samples in
float32 thus cost no digits, at half the price of compensating every sample. Regressors are taken in torque, phi = r(z),
and the right-hand side is the torque that the equivalent control stands for, J z_2 / gain: the corrected (20), in which
inertias and gear ratio are divided out. Both sides thus share one information matrix.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbl.drive.parameters import Scalar, option, parameter
from jaxbl.drive.transmission import AbstractTransmission

from .equivalent_control import EquivalentControl

Number = Float[Array, ""]


class RunningSum(NamedTuple):
    """A sum in two levels: recent samples, and the total before them with the rounding error it has made."""

    recent: Number
    total: Number
    error: Number

    def add(self, forgetting: Scalar, value: Number) -> "RunningSum":
        return self._replace(recent=forgetting * self.recent + value)

    def settle(self, weight: Number) -> "RunningSum":
        """Move the recent part into the total, which has lost in `weight` since the last time."""
        corrected = self.recent - weight * self.error
        decayed = weight * self.total
        total = decayed + corrected
        return RunningSum(jnp.zeros_like(self.recent), total, (total - decayed) - corrected)

    def value(self, weight: Number) -> Number:
        return weight * self.total + self.recent


class IdentifierState(NamedTuple):
    """Filtered regressors (n), upper triangle of the information matrix (n (n + 1) / 2), right-hand sides (n a side), and
    the weight that forgetting leaves to what is settled."""

    regressors: tuple[Number, ...]
    information: tuple[RunningSum, ...]
    moments: dict[str, tuple[RunningSum, ...]]
    weight: Number


class Identifier(eqx.Module):
    """Least squares of the torque on the regressors of a transmission law, with n = 1 or 2 unknowns."""

    start: Scalar = parameter("s", "time from which samples count", default=0.0, minimum=0.0)
    forgetting: Scalar = parameter("", "weight of a sample relative to the next", default=1.0, above=0.0, maximum=1.0)
    regressor_filter: Literal["matched", "none"] = option(
        "low-pass on the regressors: that of the equivalent control, or none", default="matched"
    )

    def init(self, law: AbstractTransmission, sides: tuple[str, ...], zero: Number) -> IdentifierState:
        """Empty sums; `zero` gives the dtype."""
        n = len(law.regressors(zero))
        empty = RunningSum(zero, zero, zero)
        return IdentifierState(
            regressors=(zero,) * n,
            information=(empty,) * (n * (n + 1) // 2),
            moments=dict.fromkeys(sides, (empty,) * n),
            weight=jnp.ones_like(zero),
        )

    def step(
        self,
        state: IdentifierState,
        law: AbstractTransmission,
        low_pass: EquivalentControl,
        z: Number,
        torque: dict[str, Number],
        time: Number,
        step: Scalar,
    ) -> IdentifierState:
        """Take in one sample: measured twist z (rad), and the torque (N m) by each side's equivalent control."""
        raw = law.regressors(z)
        filtered = tuple(low_pass.filter(old, new, step) for old, new in zip(state.regressors, raw, strict=True))
        # the equivalent control at a sample balances what acted up to it: it is one sample late, and so must phi be
        phi = state.regressors if self.regressor_filter == "matched" else raw
        # half a sample period of slack: time is a rounded multiple of it
        counts = (time > self.start - 0.5 * step).astype(z.dtype)
        weighted = tuple(counts * p for p in phi)
        # before the start nothing must be forgotten either: the sums are still zero
        n = len(raw)
        pairs = [(i, j) for i in range(n) for j in range(i, n)]
        information = tuple(
            total.add(self.forgetting, weighted[i] * phi[j]) for total, (i, j) in zip(state.information, pairs, strict=True)
        )
        right = {
            side: tuple(total.add(self.forgetting, w * torque[side]) for total, w in zip(totals, weighted, strict=True))
            for side, totals in state.moments.items()
        }
        return IdentifierState(filtered, information, right, self.forgetting * state.weight)

    def settle(self, state: IdentifierState) -> IdentifierState:
        """The same sums, ready for further samples without loss; :func:`jaxbl.simulate.scan` calls it block by block."""
        settled = jax.tree.map(
            lambda total: total.settle(state.weight),
            (state.information, state.moments),
            is_leaf=lambda node: isinstance(node, RunningSum),
        )
        return IdentifierState(state.regressors, *settled, weight=jnp.ones_like(state.weight))

    def estimate(self, state: IdentifierState, law: AbstractTransmission) -> dict[str, dict[str, Number]]:
        """Parameters of the law by each side: {"motor": {"stiffness": ..., "dead_zone": ..., "half_gap": ...}, ...}.

        NaN where the excitation so far determines nothing.
        """
        return {
            side: law.from_theta(tuple(jnp.where(determined, x, jnp.nan) for x in theta))
            for side, (determined, theta) in self.solution(state).items()
        }

    def solution(self, state: IdentifierState) -> dict[str, tuple[Number, tuple[Number, ...]]]:
        """Of each side, whether the excitation so far determines the coefficients theta, and theta: finite in any case."""
        information = _sum_values(state, state.information)
        return {
            side: _solve_normal_equations(information, _sum_values(state, totals)) for side, totals in state.moments.items()
        }

    def excitation(self, state: IdentifierState) -> Number:
        """Smallest eigenvalue of the information matrix scaled to unit diagonal: 0 undetermined, 1 orthogonal."""
        information = _sum_values(state, state.information)
        if len(information) == 1:
            return (information[0] > 0.0).astype(information[0].dtype)
        return 1.0 - jnp.abs(_regressor_correlation(information))


def _sum_values(state: IdentifierState, sums: tuple[RunningSum, ...]) -> tuple[Number, ...]:
    return tuple(total.value(state.weight) for total in sums)


def _regressor_correlation(information: tuple[Number, ...]) -> Number:
    first, both, second = information
    size = jnp.sqrt(first) * jnp.sqrt(second)
    return jnp.where(size > 0.0, both / jnp.where(size > 0.0, size, 1.0), 1.0)


def _solve_normal_equations(information: tuple[Number, ...], right: tuple[Number, ...]) -> tuple[Number, tuple[Number, ...]]:
    """Whether the scaled normal equations for n = 1 or 2 have a solution, and it; elementwise over lanes."""
    if len(right) == 1:
        total = information[0]
        determined = total > 0.0
        return determined, (right[0] / jnp.where(determined, total, 1.0),)
    first, second = jnp.sqrt(information[0]), jnp.sqrt(information[2])
    correlation = _regressor_correlation(information)
    determinant = 1.0 - correlation * correlation
    determined = determinant > 4.0 * jnp.finfo(determinant.dtype).eps
    first, second, determinant = (jnp.where(determined, x, 1.0) for x in (first, second, determinant))
    a, b = right[0] / first, right[1] / second
    return determined, ((a - correlation * b) / (determinant * first), (b - correlation * a) / (determinant * second))
