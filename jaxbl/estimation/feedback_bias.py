"""Bias by feedback: a log of a closed loop is tested with its reference as an instrument.

A controller answers to noise and disturbances, so that input and motion go with them, and least squares take them for the
drive. The reference does not know them: what a model leaves over must not go with it.
"""

from collections.abc import Sequence

import numpy as np

from jaxbl.chain import Experiment
from jaxbl.json_types import JsonObject
from jaxbl.quantity import Quantity
from jaxbl.records import Record

from .regression import balance
from .segments import Segment

_BLOCKS = 40
"""Blocks of a log, whose sums vary as all errors do, those that last for many samples included."""
_EDGE = 10
"""Samples at both ends of a segment where the smoothed motion is uncertain."""
_SIGNIFICANT = 1e-3
"""Probability of so large a shift without a bias, below which one is said."""


def find_feedback_bias(record: Record, segments: Sequence[Segment], fitted: Experiment) -> JsonObject:
    """Find by how much the reference as an instrument shifts inertia and viscous friction of each side.

    With residual r = u - J a - f v, motion X = (a, v) and instruments Z = (acceleration and velocity of the reference), the
    shift is (Z'X)^-1 Z'r; its covariance is that of sums over blocks. Reference: J. A. Hausman, Econometrica 46 (1978).

    Returns:
        By side the shifts `inertia` and `viscous` (:class:`jaxbl.quantity.Quantity`); `probability` of a shift as large by
        chance; whether it is `biased`; and a `sentence`. Empty for a log without a reference, or in pieces of a few samples.
    """
    parts = [segment for segment in segments if len(segment) > 4 * _EDGE]
    if record.reference is None or not parts:
        return {}
    period, bias_by_side, motions = record.sample_period, {}, [part.kinematics for part in parts]
    velocities = [np.gradient(record.reference[part.rows], period) for part in parts]
    inside = slice(_EDGE, -_EDGE)
    instruments = np.concatenate([np.column_stack([np.gradient(v, period), v])[inside] for v in velocities])
    balances = [balance(fitted, k) for k in motions]
    for side in fitted.sides:
        motion = np.concatenate([np.column_stack([k.acceleration[side], k.velocity[side]])[inside] for k in motions])
        residual = np.concatenate([np.asarray(equations[side].residual)[inside] for equations in balances])
        product = instruments.T @ motion
        if np.linalg.matrix_rank(product) < 2:
            sentence = f"{side}: the reference does not move; bias by feedback cannot be tested for."
            bias_by_side[side] = {"biased": None, "sentence": sentence}
            continue
        shift = np.linalg.solve(product, instruments.T @ residual)
        terms = instruments * (residual - motion @ shift)[:, None]
        sums = np.stack([block.sum(axis=0) for block in np.array_split(terms, _BLOCKS)])
        covariance = np.linalg.solve(product, np.linalg.solve(product, sums.T @ sums).T)
        # of two numbers
        probability = float(np.exp(-0.5 * shift @ np.linalg.solve(covariance, shift)))
        numbers = {
            name: Quantity(value, error, unit=record.unit_of(f"{side}.{name}", unit))
            for name, unit, value, error in zip(
                ("inertia", "viscous"), ("kg m²", "N m s/rad"), shift, np.sqrt(np.diag(covariance)), strict=True
            )
        }
        biased = probability < _SIGNIFICANT
        verdict = "numbers are biased by feedback, or an effect is missing" if biased else "no bias by feedback is seen"
        sizes = ", ".join(f"{name} {shift}" for name, shift in numbers.items())
        sentence = f"{side}: {verdict}; with the reference as instrument: {sizes} (p = {probability:.2g})."
        entries = {name: shift.to_dict() for name, shift in numbers.items()}
        bias_by_side[side] = entries | {"probability": probability, "biased": biased, "sentence": sentence}
    return bias_by_side
