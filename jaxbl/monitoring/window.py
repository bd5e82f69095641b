r"""Gap, stiffness and friction from a window of what the observers give, with standard errors.

The regression is the identifier's (18)-(26): torque by a side's equivalent control on the law's regressors, which pass the
same low-pass. A window takes the place of sums over all time, which would see a growing gap late. Three things are added,
without which the numbers of a real drive would be wrong:

- The observers' torque holds what the nominal model lacks beside the law. Columns sign(v), v and 1 take Coulomb friction, an
  error of the viscous one, and a constant torque of the side. Here v are slopes of cubics through the readings around each
  sample (Savitzky-Golay): observers cannot look ahead, and the noise of their velocities makes friction look smaller.
- A column -dC/dz takes the zero of the twist, as two encoders seldom count from the same one.
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

from jaxbl.drive.transmission import AbstractTransmission
from jaxbl.identification.compilation import jit
from jaxbl.observer.equivalent_control import EquivalentControl
from jaxbl.records.linear_filters import savitzky_golay_slopes
from jaxbl.simulate import Experiment

PARTS = 10
"""Blocks of a window, of which the jackknife leaves out one at a time."""
SETTLING = 10.0
"""Time constants of the low-pass after which a filter has forgotten how it began."""
_SLOPE = 2.0
"""Time constants of the low-pass to each side over which a velocity is the slope of a cubic."""
_TURNS = 0.9
"""Mean of sign(v) under the low-pass below which a side stands still or turns: its friction has no direction there."""
_ITERATIONS, _CONVERGED = 20, 0.05
"""Of the law at its own numbers: at most, and the last change of the half gap in its standard errors."""
_HELD = 1e-4
"""Share of its own sum of squares by which the constant torque is held at zero: where the twist never leaves contact, only
the sum of it and the zero of the twist is known."""
_SINGULAR = 1e-9
"""Smallest eigenvalue of the scaled normal equations that determines anything in double precision."""


class Number(NamedTuple):
    """A value and its standard error."""

    value: float
    error: float


class Found(NamedTuple):
    """Numbers of one side from a window: of the law by its own names, `coulomb` (N m) and `viscous` (N m s/rad) friction."""

    numbers: dict[str, Number]
    law: AbstractTransmission
    zero: float


@jit
def _sums(
    law: AbstractTransmission,
    low_pass: EquivalentControl,
    period: jax.Array,
    matched: bool,
    gain: jax.Array,
    zero: jax.Array,
    rows: dict[str, jax.Array],
) -> tuple[jax.Array, jax.Array]:
    """Normal equations of each block of the window, (blocks, p, p) and (blocks, p)."""
    twist, velocity = rows["twist"] - zero, rows["velocity"]
    slope = jax.vmap(jax.grad(lambda z: law.torque(law.deflection(z))))(twist)
    one = jnp.ones_like(twist)
    columns = [*law.regressors(twist), *(-x / gain for x in (jnp.sign(velocity), velocity, one)), -slope]
    raw = jnp.stack(columns, axis=1)

    def advance(filtered: jax.Array, row: jax.Array) -> tuple[jax.Array, jax.Array]:
        # what acted up to a sample, as in the identifier: the value before it
        return low_pass.filter(filtered, row, period), filtered

    x = jax.lax.scan(advance, jnp.zeros_like(raw[0]), raw)[1] if matched else raw
    moving = jnp.abs(x[:, -4] * gain) > _TURNS
    weighted = x * (rows["counts"] * moving)[:, None]
    weighted, x, torque = (a.reshape(PARTS, -1, *a.shape[1:]) for a in (weighted, x, rows["torque"]))
    return jnp.einsum("bnp,bnq->bpq", weighted, x), jnp.einsum("bnp,bn->bp", weighted, torque)


def _solved(information: np.ndarray, right: np.ndarray) -> np.ndarray | None:
    """Coefficients of normal equations; None where they are not determined."""
    size = np.sqrt(np.diag(information))
    if not (np.isfinite(size).all() and (size > 0.0).all()):
        return None
    scaled = information / np.outer(size, size)
    scaled[-2, -2] += _HELD
    if np.linalg.eigvalsh(scaled)[0] < _SINGULAR:
        return None
    return np.linalg.solve(scaled, right / size) / size


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
        self.samples = PARTS * max(math.ceil(seconds / self._period / PARTS), 1)
        self._constant = constant = float(experiment.equivalent_control.time_constant)
        self._settling = math.ceil(max(SETTLING * constant, float(experiment.identifier.start)) / self._period)
        self._half = max(math.ceil(_SLOPE * constant / self._period), 2)
        self._rows: dict[str, np.ndarray] = {}
        self._unsettled = 0
        self._last: dict[str, Found] = {}

    @property
    def full(self) -> bool:
        """Whether there are rows of the whole time, with those that are not counted."""
        return bool(self._rows) and len(self._rows["twist"]) == self.samples

    def add(self, rows: dict[str, np.ndarray], anew: bool) -> None:
        """Add what :meth:`.live_chain.LiveChain.take` gave.

        Where it began anew, samples do not count until the observers have settled, and neither do those before whose
        velocity would reach over the break.
        """
        if anew:
            self._unsettled = self._settling
            if self._rows:
                self._rows["counts"][-self._half :] = 0.0
        count = len(rows["twist"])
        counts = (np.arange(count) >= self._unsettled).astype(float)
        self._unsettled = max(self._unsettled - count, 0)
        new = rows | {"counts": counts}
        if not self._rows:
            self._rows = {name: values[:0] for name, values in new.items()}
        self._rows = {name: np.concatenate([old, new[name]])[-self.samples :] for name, old in self._rows.items()}

    def estimate(self) -> dict[str, Found]:
        """Numbers of each side whose window determines them; none before the window is full."""
        if not self.full:
            return {}
        counts = self._rows["counts"].copy()
        # the filter of the regressors begins with the window; velocities at its end lack the readings after it
        counts[: max(math.ceil(SETTLING * self._constant / self._period), self._half)] = 0.0
        counts[-self._half :] = 0.0
        found = {}
        for side in self._experiment.sides:
            velocity = savitzky_golay_slopes(self._rows[f"{side}.position"], self._half) / self._period
            rows = {"twist": self._rows["twist"], "torque": self._rows[f"{side}.torque"], "velocity": velocity}
            one = self._of_side(side, rows | {"counts": counts})
            if one is not None:
                found[side] = one
                self._last[side] = one
        return found

    def _of_side(self, side: str, rows: dict[str, np.ndarray]) -> Found | None:
        experiment = self._experiment
        matched = experiment.identifier is not None and experiment.identifier.regressor_filter == "matched"
        before = self._last.get(side)
        law, zero = (experiment.transmission, 0.0) if before is None else (before.law, before.zero)
        assert law is not None
        given = {name: jnp.asarray(values) for name, values in rows.items()}
        period, gain = (jnp.asarray(one, float) for one in (self._period, experiment.drive.torque_gain(side)))
        for _ in range(_ITERATIONS):
            sums = _sums(law, experiment.equivalent_control, period, matched, gain, jnp.asarray(zero), given)
            numbers = self._numbers(side, law, *map(np.asarray, sums))
            if numbers is None:
                return None
            shift = numbers.pop("zero")
            gap = numbers.get("half_gap")
            change = max(abs(shift.value), 0.0 if gap is None else abs(gap.value - float(law.half_gap)))
            law, zero = _at(law, numbers), zero + shift.value
            if change <= _CONVERGED * (shift.error if gap is None else max(gap.error, shift.error)):
                return Found(numbers, law, zero)
        return None

    def _numbers(
        self, side: str, law: AbstractTransmission, information: np.ndarray, right: np.ndarray
    ) -> dict[str, Number] | None:
        """Numbers with standard errors, and the shift of the twist's zero; None where they are not determined."""
        whole = _solved(information.sum(axis=0), right.sum(axis=0))
        if whole is None:
            return None
        parts = []
        for i in range(PARTS):
            one = _solved(information.sum(axis=0) - information[i], right.sum(axis=0) - right[i])
            if one is None:
                return None
            parts.append(self._named(side, law, one))
        value = self._named(side, law, whole)
        found = {}
        for name, own in value.items():
            left = np.array([part[name] for part in parts])
            error = math.sqrt((PARTS - 1) / PARTS * float(((left - left.mean()) ** 2).sum()))
            if not (math.isfinite(own) and math.isfinite(error)):
                return None
            found[name] = Number(own, error)
        return found if found["stiffness"].value > 0.0 else None

    def _named(self, side: str, law: AbstractTransmission, theta: np.ndarray) -> dict[str, float]:
        *own, coulomb, viscous, _, zero = (float(one) for one in theta)
        found = {name: float(value) for name, value in law.from_theta(tuple(map(np.float64, own))).items()}  # type: ignore[arg-type]
        nominal = float(self._experiment.drive.viscous(side))  # type: ignore[attr-defined]
        return found | {"coulomb": coulomb, "viscous": nominal + viscous, "zero": zero}


def _at(law: AbstractTransmission, numbers: dict[str, Number]) -> AbstractTransmission:
    """The law with numbers that were found; a negative gap is none."""
    fields = {field.name for field in dataclasses.fields(law)}
    values = {name: one.value for name, one in numbers.items() if name in fields}
    return dataclasses.replace(law, **{name: jnp.asarray(max(value, 0.0)) for name, value in values.items()})
