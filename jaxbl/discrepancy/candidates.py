"""Effects that may be missing from a model, as directions in which its trajectories could move.

Each candidate is a module of :mod:`jaxbl.drive.effects` at neutral numbers; what its size does to the residuals of a fit is one
column for each linear number. Numbers that do not enter linearly (a frequency, a speed, a limit) stand on a grid: each value
is a variant of the candidate.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxbl.drive.effects import AbstractEffect, effect_kinds
from jaxbl.drive.parameters import as_arrays
from jaxbl.simulate import Experiment

Numbers = dict[str, float]


class Column(NamedTuple):
    """What one number of a candidate does to the residuals.

    Attributes:
        instance: which of the candidate's effects has the number.
        leaf: the number.
        trial: value for which the change of the residuals is taken; None: their derivative at the neutral value.
    """

    instance: int
    leaf: str
    trial: float | None = None


class Candidate(NamedTuple):
    """One variant of an effect that may be missing.

    Attributes:
        name: of the effect, e.g. `load.coulomb_friction`.
        effects: modules at neutral numbers.
        columns: of the regression.
        numbers: the effect's numbers from the coefficients of the columns.
    """

    name: str
    effects: tuple[AbstractEffect, ...]
    columns: tuple[Column, ...]
    numbers: Callable[[Sequence[float]], Numbers]


class Motion(NamedTuple):
    """What of a record the grids depend on.

    Attributes:
        speed: typical speed of each side, rad/s (rms).
        torque: largest input, N m.
        period: of the samples, s.
        frequencies: that a load disturbance may have, Hz.
        motor_harmonics: of the motor's turn that may be seen.
        load_harmonics: of the load's turn that may be seen.
    """

    speed: dict[str, float]
    torque: float
    period: float
    frequencies: tuple[float, ...] = ()
    motor_harmonics: tuple[float, ...] = ()
    load_harmonics: tuple[float, ...] = (1.0,)


_STRIBECK = 0.05, 0.2, 0.6
"""Stribeck speeds tried, times the rms speed."""
_LAGS = 1.0, 3.0, 10.0
"""Time constants tried, in samples."""
_LIMITS = 0.95, 0.8, 0.6
"""Torque limits tried, times the largest input."""
_NO_LIMIT, _NO_LAG = 1e12, 1e-12


def candidates_for(experiment: Experiment, motion: Motion) -> list[Candidate]:
    """All effects that the model lacks and its drive can have, variant by variant.

    Args:
        experiment: the model.
        motion: of the record.
    """
    rigid = len(experiment.sides) == 1
    known = {effect.name for effect in experiment.effects}
    found = []
    for side in experiment.sides:
        found += _of_side(side, motion)
    found += _swinging("load.gravity", "torque", {})
    for frequency in motion.frequencies:
        found += _swinging("load.periodic_disturbance", "amplitude", {"frequency": frequency})
    for harmonic in motion.motor_harmonics:
        found += _swinging("motor.cogging", "amplitude", {"harmonic": harmonic})
    if not rigid:
        for harmonic in motion.load_harmonics:
            found += _swinging("transmission.eccentricity", "amplitude", {"harmonic": harmonic})
        found.append(_single("transmission.damping", "damping"))
        found.append(_single("transmission.hardening", "cubic_stiffness"))
        law = experiment.transmission
        if law is not None and "half_gap" not in law.truth():
            found.append(_single("transmission.backlash", "half_gap"))
    found.append(_single("actuator.gain_error", "relative"))
    for samples in _LAGS:
        found.append(_stepped("actuator.lag", "time_constant", _NO_LAG, samples * motion.period))
    for share in _LIMITS:
        found.append(_stepped("actuator.saturation", "limit", _NO_LIMIT, share * motion.torque))
    return [one for one in found if one.name not in known]


def _of_side(side: str, motion: Motion) -> list[Candidate]:
    found = [
        _single(f"{side}.{kind}", leaf)
        for kind, leaf in (
            ("coulomb_friction", "torque"), ("viscous_friction", "viscous"), ("quadratic_drag", "drag"),
            ("constant_torque", "torque"), ("inertia", "inertia"),
        )
    ]  # fmt: skip
    for share in _STRIBECK:
        speed = share * motion.speed[side]
        numbers = {"torque": 0.0, "breakaway_torque": 0.0, "stribeck_velocity": speed}

        def named(values: Sequence[float], speed: float = speed) -> Numbers:
            return {"torque": values[0], "breakaway_torque": values[1], "stribeck_velocity": speed}

        columns = Column(0, "torque"), Column(0, "breakaway_torque")
        found.append(
            Candidate(f"{side}.stribeck_friction", (_effect(f"{side}.stribeck_friction", numbers),), columns, named)
        )
    return found


def _effect(name: str, numbers: Numbers) -> AbstractEffect:
    return as_arrays(effect_kinds()[name](**numbers), float)


def _single(name: str, leaf: str) -> Candidate:
    return Candidate(name, (_effect(name, {leaf: 0.0}),), (Column(0, leaf),), lambda values: {leaf: values[0]})


def _stepped(name: str, leaf: str, neutral: float, trial: float) -> Candidate:
    """A number that is not linear: the change at a trial value, of which the regression takes a share."""

    def named(values: Sequence[float]) -> Numbers:
        return {leaf: trial}

    return Candidate(name, (_effect(name, {leaf: neutral}),), (Column(0, leaf, trial),), named)


def _swinging(name: str, leaf: str, numbers: Numbers) -> list[Candidate]:
    """A sinusoid of unknown phase: two of them, a quarter of a period apart."""

    def named(values: Sequence[float]) -> Numbers:
        sine, cosine = values
        return {leaf: math.hypot(sine, cosine), "phase": math.atan2(cosine, sine)} | numbers

    effects = tuple(_effect(name, numbers | {leaf: 0.0, "phase": phase}) for phase in (0.0, 0.5 * np.pi))
    return [Candidate(name, effects, (Column(0, leaf), Column(1, leaf)), named)]


def neutral_of(candidate: Candidate) -> list[Any]:
    """Values of the columns' numbers at which the candidate does nothing."""
    return [getattr(candidate.effects[column.instance], column.leaf) for column in candidate.columns]
