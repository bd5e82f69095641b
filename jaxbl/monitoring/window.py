r"""Gap, stiffness and friction from a window of what the observers give, with standard errors.

The regression is the identifier's (18)-(26): torque by a side's equivalent control on the law's regressors, which pass the
same low-pass. A window takes the place of sums over all time, which would see a growing gap late. Three things are added,
without which the numbers of a real drive would be wrong:

- The observers' torque holds what the nominal model lacks beside the law. Columns sign(v), v and 1 take Coulomb friction, an
  error of the viscous one, and a constant torque of the side. Here v are slopes of cubics through the readings around each
  sample (Savitzky-Golay): observers cannot look ahead, and the noise of their velocities makes friction look smaller.
- A column -dC/dz takes the zero of the twist, as two encoders seldom count from the same one, and the rate of the
  elastic deflection the damping of the gear, which would pass for a part of the gap.
- The law is taken at the numbers that the window itself gives, in a few iterations. With a hard dead zone,
  C = K (z - b sign z) in contact, its regression is the Gauss-Newton step of the least squares in K and b.

Standard errors are those of the jackknife over blocks of the window, as residuals of observers are far from independent:
they count what differs from block to block, and not what is wrong in all of them alike.
Reference: B. Efron, C. Stein, The jackknife estimate of variance, Annals of Statistics 9 (1981).
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.chain import Experiment, NamedArrays
from jaxbl.drive.transmission import AbstractTransmission
from jaxbl.fused.compilation import jit
from jaxbl.observer.equivalent_control import EquivalentControl
from jaxbl.quantity import Quantity
from jaxbl.records.least_squares import jackknife_variance
from jaxbl.records.linear_filters import savitzky_golay_slopes

BLOCKS = 10
"""Blocks of a window, of which the jackknife leaves out one at a time."""
SETTLING = 10.0
"""Time constants of the low-pass after which a filter has forgotten how it began."""
_SLOPE = 2.0
"""Time constants of the low-pass to each side over which a velocity is the slope of a cubic."""
_LEAST_DIRECTION = 0.9
"""Mean of sign(v) under the low-pass below which a side stands still or turns: its friction has no direction there."""
_ITERATIONS, _CONVERGED = 20, 0.05
"""Of the law at its own numbers: at most, and the last change of the half gap in its standard errors."""
_CONSTANT_TORQUE_WEIGHT = 1e-4
"""Share of its own sum of squares by which the constant torque is held at zero: where the twist never leaves contact, only
the sum of it and the zero of the twist is known."""
_SINGULAR = 1e-9
"""Smallest eigenvalue of the scaled normal equations that determines anything in double precision."""


class SideNumbers(NamedTuple):
    """Numbers of one side from a window: of the law by its own names, `coulomb` (N m) and `viscous` (N m s/rad) friction."""

    numbers: dict[str, Quantity]
    law: AbstractTransmission
    zero: float


@jit
def _sum_blocks(
    law: AbstractTransmission,
    low_pass: EquivalentControl,
    period: jax.Array,
    matched: bool,
    gain: jax.Array,
    zero: jax.Array,
    rows: dict[str, jax.Array],
) -> tuple[jax.Array, jax.Array]:
    """Sum the normal equations of each block of the window: `(blocks, p, p)` and `(blocks, p)`."""
    twist, velocity = rows["twist"] - zero, rows["velocity"]
    slope = jax.vmap(jax.grad(lambda z: law.torque(law.deflection(z))))(twist)
    ones_column = jnp.ones_like(twist)
    friction = [-column / gain for column in (jnp.sign(velocity), velocity, ones_column)]
    damping = jax.jvp(law.deflection, (twist,), (rows["rate"],))[1]
    columns = [*law.regressors(twist), damping, *friction, -slope]
    raw = jnp.stack(columns, axis=1)

    def advance(filtered: jax.Array, row: jax.Array) -> tuple[jax.Array, jax.Array]:
        # what acted up to a sample, as in the identifier: the value before it
        return low_pass.filter(filtered, row, period), filtered

    filtered_columns = jax.lax.scan(advance, jnp.zeros_like(raw[0]), raw)[1] if matched else raw
    moving = jnp.abs(filtered_columns[:, -4] * gain) > _LEAST_DIRECTION
    weighted = filtered_columns * (rows["counts"] * moving)[:, None]
    weighted, filtered_columns, torque = (
        a.reshape(BLOCKS, -1, *a.shape[1:]) for a in (weighted, filtered_columns, rows["torque"])
    )
    return jnp.einsum("bnp,bnq->bpq", weighted, filtered_columns), jnp.einsum("bnp,bn->bp", weighted, torque)


def _solve(information: np.ndarray, right: np.ndarray) -> np.ndarray | None:
    """Solve normal equations `(n, p, p)` and `(n, p)`; None where any of them are not determined."""
    size = np.sqrt(np.diagonal(information, axis1=1, axis2=2))
    if not (np.isfinite(size).all() and (size > 0.0).all()):
        return None
    scaled = information / (size[:, :, None] * size[:, None, :])
    scaled[:, -2, -2] += _CONSTANT_TORQUE_WEIGHT
    if np.linalg.eigvalsh(scaled).min() < _SINGULAR:
        return None
    return np.linalg.solve(scaled, (right / size)[..., None])[..., 0] / size


class Window:
    """The rows of the last seconds, and the numbers that they give.

    Args:
        experiment: the study, with leaves in float64.
        seconds: length.
    """

    def __init__(self, experiment: Experiment, seconds: float):
        assert experiment.transmission is not None and experiment.identifier is not None
        self._experiment = experiment
        self._period = float(experiment.run.sample_period)
        self.samples = BLOCKS * max(math.ceil(seconds / self._period / BLOCKS), 1)
        self._constant = constant = float(experiment.equivalent_control.time_constant)
        self._settling = math.ceil(max(SETTLING * constant, float(experiment.identifier.start)) / self._period)
        self._half = max(math.ceil(_SLOPE * constant / self._period), 2)
        self._rows: NamedArrays = {}
        self._rows_until_settled = 0
        self._matched = experiment.identifier.regressor_filter == "matched"
        self._last_estimates = dict.fromkeys(experiment.sides, SideNumbers({}, experiment.transmission, 0.0))

    def add(self, rows: NamedArrays, restarts: bool) -> None:
        """Add rows from :meth:`.live_chain.LiveChain.take`.

        Where it began anew, samples do not count until the observers have settled, and neither do those before whose
        velocity would reach over the break.
        """
        if restarts:
            self._rows_until_settled = self._settling
            if self._rows:
                self._rows["counts"][-self._half :] = 0.0
        count = len(rows["twist"])
        counts = (np.arange(count) >= self._rows_until_settled).astype(float)
        self._rows_until_settled = max(self._rows_until_settled - count, 0)
        new_rows = rows | {"counts": counts}
        self._rows = {
            name: np.concatenate([self._rows.get(name, new[:0]), new])[-self.samples :] for name, new in new_rows.items()
        }

    def estimate(self) -> dict[str, SideNumbers] | None:
        """Numbers of each side whose window determines them; None before there are rows for its whole length."""
        if len(self._rows.get("twist", ())) < self.samples:
            return None
        counts = self._rows["counts"].copy()
        # the filter of the regressors begins with the window; velocities at its end lack the readings after it
        counts[: max(math.ceil(SETTLING * self._constant / self._period), self._half)] = 0.0
        counts[-self._half :] = 0.0
        estimates, twist = {}, self._rows["twist"]
        for side in self._experiment.sides:
            position, torque = (self._rows[f"{side}.{name}"] for name in ("position", "torque"))
            rate, velocity = (savitzky_golay_slopes(values, self._half) / self._period for values in (twist, position))
            columns = {"twist": twist, "rate": rate, "velocity": velocity, "torque": torque, "counts": counts}
            if (numbers := self._estimate_side(side, columns)) is not None:
                estimates[side] = numbers
        self._last_estimates |= estimates
        return estimates

    def _estimate_side(self, side: str, rows: NamedArrays) -> SideNumbers | None:
        experiment, (_, law, zero) = self._experiment, self._last_estimates[side]
        columns = {name: jnp.asarray(values) for name, values in rows.items()}
        period, gain = (jnp.asarray(number, float) for number in (self._period, experiment.drive.torque_gain(side)))
        for _ in range(_ITERATIONS):
            sums = _sum_blocks(law, experiment.equivalent_control, period, self._matched, gain, jnp.asarray(zero), columns)
            numbers = self._solve_with_errors(side, law, *map(np.asarray, sums))
            if numbers is None:
                return None
            shift, half_gap = numbers.pop("zero"), float(law.half_gap)
            gap = numbers.get("half_gap", Quantity(half_gap, 0.0))
            change = max(abs(shift.value), abs(gap.value - half_gap))
            # a negative gap becomes zero
            placed = {name: jnp.asarray(max(numbers[name].value, 0.0)) for name in vars(law) if name in numbers}
            law, zero = dataclasses.replace(law, **placed), zero + shift.value
            if change <= _CONVERGED * max(gap.standard_error, shift.standard_error):
                return SideNumbers(numbers, law, zero)
        return None

    def _solve_with_errors(
        self, side: str, law: AbstractTransmission, information: np.ndarray, right: np.ndarray
    ) -> dict[str, Quantity] | None:
        """Solve for the numbers with standard errors, and the shift of the twist's zero; None where not determined."""
        # of all blocks, and of all but each
        coefficients = _solve(
            *(sums.sum(axis=0) - np.concatenate([np.zeros_like(sums[:1]), sums]) for sums in (information, right))
        )
        if coefficients is None:
            return None
        values, *without = (self._name_coefficients(side, law, theta) for theta in coefficients)
        errors = np.sqrt(jackknife_variance(np.array([[*numbers.values()] for numbers in without])))
        numbers = {name: Quantity(values[name], error) for name, error in zip(values, errors.tolist(), strict=True)}
        is_determined = all(number.is_finite for number in numbers.values()) and numbers["stiffness"].value > 0.0
        return numbers if is_determined else None

    def _name_coefficients(self, side: str, law: AbstractTransmission, theta: np.ndarray) -> dict[str, float]:
        *law_theta, _, coulomb, viscous, _, zero = theta
        nominal = float(self._experiment.drive.viscous(side))  # type: ignore[attr-defined]
        numbers = law.from_theta(tuple(law_theta)) | {"coulomb": coulomb, "viscous": nominal + viscous, "zero": zero}
        return {name: float(value) for name, value in numbers.items()}
