"""Recursive least squares (22)-(28) on the equivalent control, for both sides at once.

The paper integrates the estimate and its covariance, (27)-(28). Their exact discrete solution is (23) with sums in place of
integrals, theta = (sum phi phi^T)^-1 sum phi tau. These sums, the information matrix and the moments, are stored here: they
do not drift as an integrated covariance does. Each sum has two levels. Samples are added to its recent part; every few
hundred samples :meth:`Identifier.settle` moves that part into a total, with the rounding error carried along (Kahan). 10^6
samples in float32 thus lose no digits, at half the cost of compensating every sample.

Regressors are those of the law, phi = r(z), and tau is the torque that the equivalent control stands for, J z_2 / gain.
This is (20) with inertias and gear ratio divided out, so that both sides share one information matrix.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxbl.drive.parameters import Scalar, ScalarArray, option, parameter
from jaxbl.drive.transmission import AbstractTransmission

from .equivalent_control import EquivalentControl

Number = ScalarArray


class RunningSum(NamedTuple):
    """A sum in two levels: recent samples, and the total before them with its rounding error."""

    recent: Number
    total: Number
    error: Number

    def add(self, forgetting: Scalar, term: Number) -> "RunningSum":
        """Add the term of a sample; older terms are multiplied by `forgetting`."""
        return self._replace(recent=forgetting * self.recent + term)

    def settle(self, weight: Number) -> "RunningSum":
        """Move the recent part into the total, of which forgetting has left the part `weight` since the last time."""
        corrected = self.recent - weight * self.error
        decayed = weight * self.total
        total = decayed + corrected
        return RunningSum(jnp.zeros_like(self.recent), total, (total - decayed) - corrected)

    def value(self, weight: Number) -> Number:
        """The whole sum; `weight` as in :meth:`settle`."""
        return weight * self.total + self.recent


class IdentifierState(NamedTuple):
    """State of the identifier, for n unknowns.

    Attributes:
        near: where the first regressor was when it last moved.
        stay: count of samples since then.
        regressors: filtered regressors, n numbers.
        information: upper triangle of the information matrix, n (n + 1) / 2 sums.
        right: n sums for each side.
        weight: the part of settled totals that forgetting has left.
        most: largest information on the first unknown so far.
    """

    near: Number
    stay: Number
    regressors: tuple[Number, ...]
    information: tuple[RunningSum, ...]
    right: dict[str, tuple[RunningSum, ...]]
    weight: Number
    most: Number


REMAINING = 0.01
"""Least share of the most information on the first unknown that has to remain: that of a motion a tenth as large. Where
forgetting has left less, as in a noisy standstill, the numbers are those of noise."""
LONGEST_STAY = 0.01
"""Share of the memory that counts of a stay: a first regressor that moves too little to keep the information above that
bound. All further samples say the same of the law and drive out what motion has told; friction at rest makes them wrong."""


class Identifier(eqx.Module):
    """Least squares of the torque on the regressors of a transmission law, tau = sum phi_i theta_i, with 1 or 2 unknowns."""

    start: Scalar = parameter("s", "time from which samples count", default=0.0, minimum=0.0)
    forgetting: Scalar = parameter("", "weight of a sample relative to the next", default=1.0, above=0.0, maximum=1.0)
    regressor_filter: Literal["matched", "none"] = option(
        "low-pass on the regressors: that of the equivalent control, or none", default="matched"
    )

    def init(self, law: AbstractTransmission, sides: tuple[str, ...], zero: Number) -> IdentifierState:
        """Return the state without samples; `zero` has the dtype."""
        n = len(law.regressors(zero))
        empty = RunningSum(zero, zero, zero)
        moments = dict.fromkeys(sides, (empty,) * n)
        sums = (empty,) * (n * (n + 1) // 2)
        return IdentifierState(zero, zero, (zero,) * n, sums, moments, jnp.ones_like(zero), zero)

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
        """Add a sample.

        Args:
            state: before the sample.
            law: transmission law with nominal numbers.
            low_pass: the filter of the equivalent control, for the regressors.
            z: measured twist, rad.
            torque: by each side's equivalent control, N m.
            time: s.
            step: sampling period, s.
        """
        raw = law.regressors(z)
        filtered = tuple(low_pass.filter(old, new, step) for old, new in zip(state.regressors, raw, strict=True))
        # the equivalent control at a sample balances the torque before it: it is one sample late, and so must phi be
        phi = state.regressors if self.regressor_filter == "matched" else raw
        moved = (phi[0] - state.near) ** 2 > REMAINING * (1.0 - self.forgetting) * state.most
        near, stay = jnp.where(moved, phi[0], state.near), jnp.where(moved, 0.0, state.stay + 1.0)
        # half a period of slack, as time is a rounded multiple of the period
        counts = (time > self.start - 0.5 * step) & (stay * (1.0 - self.forgetting) <= LONGEST_STAY)
        weighted = tuple(counts.astype(z.dtype) * p for p in phi)
        forgetting = jnp.where(counts, self.forgetting, 1.0)

        def add_terms(sums: tuple[RunningSum, ...], *terms: Number) -> tuple[RunningSum, ...]:
            return tuple(total.add(forgetting, term) for total, term in zip(sums, terms, strict=True))

        information = add_terms(state.information, *(p * q for i, p in enumerate(weighted) for q in phi[i:]))
        moments = {side: add_terms(sums, *(p * torque[side] for p in weighted)) for side, sums in state.right.items()}
        new = IdentifierState(near, stay, filtered, information, moments, forgetting * state.weight, state.most)
        return new._replace(most=jnp.maximum(state.most, _information_on_first(_sum_values(new, information))))

    def settle(self, state: IdentifierState) -> IdentifierState:
        """Settle all sums, so that further samples lose no digits; :func:`jaxbl.chain.scan` does so block by block."""
        information, moments = jax.tree.map(
            lambda total: total.settle(state.weight),
            (state.information, state.right),
            is_leaf=lambda node: isinstance(node, RunningSum),
        )
        return state._replace(information=information, right=moments, weight=jnp.ones_like(state.weight))

    def estimate(self, state: IdentifierState, law: AbstractTransmission) -> dict[str, dict[str, Number]]:
        """Parameters of the law, as each side identifies them, e.g. `{"motor": {"stiffness": ..., "half_gap": ...}, ...}`.

        They are NaN if the excitation does not determine them yet.
        """
        return {
            side: law.from_theta(tuple(jnp.where(determined, x, jnp.nan) for x in theta))
            for side, (determined, theta) in self.solution(state).items()
        }

    def solution(self, state: IdentifierState) -> dict[str, tuple[Number, tuple[Number, ...]]]:
        """Return for each side if the excitation determines the coefficients theta, and theta, which is always finite."""
        information = _sum_values(state, state.information)
        remains = _information_on_first(information) > REMAINING * state.most
        return {
            side: _solve_normal_equations(information, _sum_values(state, sums), remains)
            for side, sums in state.right.items()
        }

    def excitation(self, state: IdentifierState) -> Number:
        """Smallest eigenvalue of the information matrix, scaled to unit diagonal: 0 is undetermined, 1 is orthogonal."""
        return 1.0 - jnp.abs(_regressor_correlation(_sum_values(state, state.information)))


def _sum_values(state: IdentifierState, sums: tuple[RunningSum, ...]) -> tuple[Number, ...]:
    return tuple(total.value(state.weight) for total in sums)


def _information_on_first(information: tuple[Number, ...]) -> Number:
    """Information on the first unknown, whatever the second: a twist that stays adds none, however large it is."""
    if len(information) == 1:
        return information[0]
    first, product, second = information
    return first - product * (product / jnp.where(second > 0.0, second, 1.0))


def _regressor_correlation(information: tuple[Number, ...]) -> Number:
    """Correlation of two regressors; of one, 0. It is 1 where there is no information."""
    if len(information) == 1:
        return 1.0 - jnp.sign(information[0])
    first, product, second = information
    size = jnp.sqrt(first) * jnp.sqrt(second)
    return jnp.where(size > 0.0, product / jnp.where(size > 0.0, size, 1.0), 1.0)


def _solve_normal_equations(
    information: tuple[Number, ...], moments: tuple[Number, ...], remains: Number
) -> tuple[Number, tuple[Number, ...]]:
    """True if the scaled normal equations for n = 1 or 2 have one solution, and the solution; elementwise over lanes.

    `remains` is False where forgetting has left too little information.
    """
    if len(moments) == 1:
        return remains, (moments[0] / jnp.where(remains, information[0], 1.0),)
    first, second = jnp.sqrt(information[0]), jnp.sqrt(information[2])
    correlation = _regressor_correlation(information)
    determinant = 1.0 - correlation * correlation
    determined = remains & (determinant > 4.0 * jnp.finfo(determinant.dtype).eps)
    first, second, determinant = (jnp.where(determined, x, 1.0) for x in (first, second, determinant))
    a, b = moments[0] / first, moments[1] / second
    return determined, ((a - correlation * b) / (determinant * first), (b - correlation * a) / (determinant * second))
