"""Effects that the missing torque itself shows, where prediction errors do not.

A one-step predictor corrects itself at every reading, and what is left of a slow torque in its errors may be less than what
is unknown beside it. Here candidates are columns of a regression on the torque that a model still lacks, low-passed as that
is, and judged by cross-validation on blocks of the log, which takes errors for as correlated as they are. The best are put
into the model, all numbers are fitted, and the models are compared on the log block by block.
Reference: S. Arlot, A. Celisse, A survey of cross-validation procedures, Statistics Surveys 4 (2010), section 8.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from jaxbl.drive.parameters import get_leaf
from jaxbl.identification.segments import Segment
from jaxbl.records.least_squares import BlockRegression

from .blocks import SEEN, standard_errors_better
from .candidates import Candidate, Forces, Numbers, are_possible, columns_of, variants_of
from .effect_search import LEAST_CHANCE, EffectSearch, Explanation, Finding, Model, contains, exclusive
from .fitted_model import FittedModel
from .history import Step, describe_change
from .reference_log import Comparison, ReferenceLog
from .residuals import Residual, SideResiduals, as_smoothed, low_passed, narrowed

_BLOCKS = 10
"""Of consecutive samples, each left out once: more than the eight of which a standard error is any use."""
_GAIN = 0.03
"""Share of the rms that a candidate has to take away by cross-validation, and by which models have to differ."""
_TRIED = 3
"""Candidates of a regression that are put into the model."""
_NAMED = 0.9
"""Confidence from which on an effect is named: below it the missing torque is not that of one effect."""
_ADDED = 3
"""Effects that are added at most."""


class _Proposal(NamedTuple):
    """A candidate, its numbers, and the share of the missing torque's rms that it takes away by cross-validation."""

    name: str
    numbers: Numbers
    gain: float


class _Tried(NamedTuple):
    """A model with an effect more (or one in place of its special case), and how it compares on the log."""

    name: str
    fitted: FittedModel
    compared: Comparison
    z: float


def extend_explanation(
    search: EffectSearch, found: Explanation, fitted: FittedModel, log: ReferenceLog, history: list[Step]
) -> Explanation:
    """An explanation with what a regression on the missing torque adds; the same one if it adds nothing.

    Args:
        search: that found it.
        found: the explanation.
        fitted: the model with it.
        log: the log that was searched, whose low-pass missing torques are looked at behind.
        history: gets what is tried.
    """
    for _ in range(_ADDED):
        more = _with_one_more(search, found, fitted, log, history)
        if more is None:
            break
        found, fitted = more
    return found


def _with_one_more(
    search: EffectSearch, found: Explanation, now: FittedModel, log: ReferenceLog, history: list[Step]
) -> tuple[Explanation, FittedModel] | None:
    model = found.model
    compared = log.compare(now.experiment)
    every: list[_Tried] = []
    # what the search preferred a simpler effect to, with the numbers that it had there
    general = {name: one for name, one in found.general.items() if any(contains(name, other) for other in model.names)}
    proposed = [_Proposal(name, numbers, 0.0) for name, numbers in general.items()]
    proposed += [one for one in _proposals(search, model, compared.torques, log) if one.name not in general][:_TRIED]
    for one in proposed:
        kept = {name: numbers for name, numbers in now.numbers.items() if not _replaced(name, one.name)}
        fitted = search.fit(kept | {one.name: one.numbers}, now.theta[: len(search.free)])
        if not are_possible(fitted.numbers, search.period):
            continue
        after = log.compare(fitted.experiment)
        z = standard_errors_better(log, compared, after)
        every.append(_Tried(one.name, fitted, after, z))
    tried = [one for one in every if one.z > SEEN and _less(one.compared, compared)]

    def note(kept: str, why: str) -> None:
        asked = f"{SEEN:g} standard error and {_GAIN:.0%} of the missing torque are asked"
        for trial in every:
            nats = trial.fitted.log_likelihood - now.log_likelihood
            reason = why if trial in tried else asked
            history.append(
                Step(describe_change(now.numbers, trial.fitted.numbers), nats, trial.z, trial.name == kept, reason)
            )

    if not tried:
        note("", "")
        return None

    def lead(one: _Tried) -> float:
        """Standard errors by which one beats the nearest of the others."""
        others = [standard_errors_better(log, other.compared, one.compared) for other in tried if other is not one]
        return min(others, default=one.z)

    best = max(tried, key=lead)
    findings = [one for one in found.findings if not _replaced(one.effect, best.name)]
    rivals = {one.name: standard_errors_better(log, one.compared, best.compared) for one in tried if one is not best}
    for name in model.names:
        if _replaced(name, best.name):
            rivals[name] = best.z
    chances = {name: float(ndtr(-z)) for name, z in rivals.items()}
    alternatives = tuple((name, one) for name, one in chances.items() if one > LEAST_CHANCE)
    confidence = 1.0 - sum(chances.values())
    if confidence < _NAMED:
        note("", f"the missing torque shows it, but not it alone: confidence {confidence:.2f} of {_NAMED:g}")
        return None
    note(best.name, f"the missing torque shows {best.name} best")
    findings.append(Finding(best.name, confidence, best.fitted.numbers[best.name], alternatives))
    adopted = search.adopted(found, best.fitted.numbers, best.fitted.theta[: len(search.free)], findings)
    return adopted, best.fitted


def _less(after: Comparison, before: Comparison) -> bool:
    """Tell whether some missing torque has become smaller by a share that matters."""
    return any(after.errors[name] < (1.0 - _GAIN) * value for name, value in before.errors.items() if "torque" in name)


def _replaced(name: str, by: str) -> bool:
    """Tell whether an effect gives way to another one: its special case, or of the same word at one place."""
    return contains(by, name) or exclusive(by, [name])


def _proposals(search: EffectSearch, model: Model, lacking: SideResiduals, log: ReferenceLog) -> list[_Proposal]:
    """Candidates that take away a part of the missing torque by cross-validation, the best one of each name, best first."""
    linear = model.linear
    # frequencies are sought in what this leaves
    linear.choose(())
    # errors of numbers that may change are no finding of this regression: they take part in it
    own = [name for name in search.lacking if linear.same(name) is not None and linear.nominal(name) is not None]
    sought = [name for name in search.lacking if not any(one == name or contains(one, name) for one in model.names)]
    base = variants_of(search.nominal, [name for name in own if name not in model.names], linear.scales)
    variants = variants_of(search.nominal, [name for name in sought if name not in own], linear.scales)
    regression = _Regression(model, lacking, log, base, variants)
    found: dict[str, _Proposal] = {}
    for one in variants:
        proposal = regression.propose(one)
        if proposal is not None and proposal.gain > (found[one.name].gain if one.name in found else _GAIN):
            found[one.name] = proposal
    return sorted(found.values(), key=lambda one: -one.gain)


class _Regression:
    """Missing torques of all sides, and columns of effects, behind one low-pass; as products, block by block."""

    def __init__(
        self,
        model: Model,
        lacking: SideResiduals,
        log: ReferenceLog,
        base: Sequence[Candidate],
        variants: Sequence[Candidate],
    ):
        self.names, self.sides = model.names, tuple(lacking)
        forces = []
        for signals in model.linear.signals:
            there = signals.of([get_leaf(model.linear.experiment, f"effects.{name}") for name in model.names])
            forces.append(Forces([*there, *columns_of([*base, *variants], signals)]))
        self.places: dict[Candidate, tuple[np.ndarray, int]] = {}
        at = len(model.names)
        for one in (*base, *variants):
            self.places[one] = np.arange(at, at + one.width), (at + one.width if one.offset else -1)
            at += one.width + one.offset
        self.base = np.concatenate([np.arange(0), *(self.places[one][0] for one in base)]).astype(int)
        self.regressions = []
        for i, side in enumerate(self.sides):
            pieces = zip(forces, log.segments, lacking[side], strict=True)
            rows = [
                _with_target(_on_side(force, i, len(segment)), segment, residual, side, log.bandwidth[side])
                for force, segment, residual in pieces
            ]
            *columns, target = np.concatenate(rows, axis=1)
            # each side over its own missing torque
            size = np.sqrt(np.sum(target**2))
            self.regressions.append(BlockRegression.of(target / size, np.transpose(columns) / size, _BLOCKS))
        self.without = self._cross_validate(np.array([*range(len(model.names)), *self.base]), -1)[0]

    def propose(self, candidate: Candidate) -> _Proposal | None:
        """Try a candidate beside the model's effects; None where it is not allowed or not surely better."""
        columns, offset = self.places[candidate]
        kept = [i for i, name in enumerate(self.names) if not _replaced(name, candidate.name)]
        at = np.array([*columns, *kept, *self.base])
        squares, values = self._cross_validate(at, offset)
        gains = np.sum(
            [one / np.mean(one) - new / np.mean(one) for one, new in zip(self.without, squares, strict=True)], axis=0
        )
        if not np.mean(gains) > np.std(gains, ddof=1) / np.sqrt(_BLOCKS):
            return None
        ratio = np.prod([np.mean(new) / np.mean(one) for one, new in zip(self.without, squares, strict=True)])
        numbers = candidate.numbers(values[: len(columns)].tolist())
        return None if numbers is None else _Proposal(candidate.name, numbers, 1.0 - float(np.sqrt(ratio)))

    def _cross_validate(self, at: np.ndarray, offset: int) -> tuple[list[np.ndarray], np.ndarray]:
        """Mean squared errors of each block left out, by side, and the coefficients by all blocks.

        Columns act on all sides with one coefficient, each side over its own missing torque.
        """
        sides = [side.select(at, [offset] if offset >= 0 else []) for side in self.regressions]
        joined = BlockRegression(np.sum([side.products for side in sides], axis=0), sides[0].counts)
        fits = joined.fit_without_each()
        return [side.held_out(fits) for side in sides], joined.fit()


def _on_side(forces: Forces, i: int, samples: int) -> np.ndarray:
    """Torques on a side, shape (columns, samples); those on the input act on the motor, which is the first."""
    return forces.on(i, samples) + (forces.on(-1, samples) if i == 0 else 0.0)


def _with_target(columns: np.ndarray, segment: Segment, residual: Residual, side: str, cutoff: float) -> np.ndarray:
    """Torques as the missing torque of a side is seen, and that torque; shape (columns + 1, rows)."""
    seen = low_passed(as_smoothed(columns, segment.smoothed[side], segment.period), residual, cutoff)
    return np.concatenate([seen, narrowed(residual, cutoff)[0].torque[None]])
