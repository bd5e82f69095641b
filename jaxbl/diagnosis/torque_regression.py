"""Effects that the missing torque itself shows: where an engineer begins.

Candidates are columns of a regression on the torque that a model still lacks, along the measured motion and behind one
low-pass, and are judged by cross-validation on blocks of the log, which takes errors for as correlated as they are. The best
ones are proposed one by one; and, added one after the other, all together, since two that are missing may hide each other.
Reference: S. Arlot, A. Celisse, A survey of cross-validation procedures, Statistics Surveys 4 (2010), section 8.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxbl.drive.effects import Numbers
from jaxbl.drive.parameters import get_leaf
from jaxbl.records.least_squares import BlockRegression, mean_error

from .candidates import Candidate, Forces, MotionTorques, columns_of, contains, replaces
from .linearised_model import Linear
from .reference_log import ReferenceLog
from .residuals import SideResiduals, as_smoothed, low_passed
from .thresholds import LIMITS

_BLOCKS = 10
"""Of consecutive samples, each left out once: more than the eight of which a standard error is any use."""
SHOWN = 0.02
"""Share of the missing torque's rms that each of effects proposed together has to take away, and a general effect more than
its special case."""
_MOST = 6
"""Effects that are proposed together at most."""


class TorqueProposal(NamedTuple):
    """A candidate, its numbers, the share of the missing torque's rms that it takes away by cross-validation, and the mean
    squared errors that it leaves of each block, by side."""

    variant: Candidate
    numbers: Numbers
    share: float
    squares: Sequence[np.ndarray]

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.variant.name


class TorqueRegression:
    """Missing torques of all sides, and columns of effects, behind one low-pass; as products, block by block."""

    def __init__(
        self,
        linear: Linear,
        names: Sequence[str],
        lacking: SideResiduals,
        log: ReferenceLog,
        base: Sequence[Candidate],
        variants: Sequence[Candidate],
    ):
        """Prepare the regression.

        Args:
            linear: the model along the log.
            names: of its effects, whose sizes are fitted along.
            lacking: torques that it lacks, by side, segment by segment.
            log: that models are compared on.
            base: candidates that take part in every fit: errors of numbers that may change.
            variants: candidates to be tried.
        """
        self.variants, forces = list(variants), []
        for signals in linear.signals:
            # the model's own acceleration, where torque is missing, is not that of the log
            part = replace(signals.part, modelled=signals.part.acceleration)
            measured = MotionTorques(linear.experiment, part, signals.segment)
            there = measured.of([get_leaf(linear.experiment, f"effects.{name}") for name in names])
            gone = [{place: -torque for place, torque in torques.items()} for torques in there]
            forces.append(Forces([*there, *gone, *columns_of([*base, *variants], measured)]))
        self.places: dict[Candidate, tuple[np.ndarray, list[int]]] = {}
        self.names, place = names, 2 * len(names)
        for candidate in (*base, *variants):
            end = place + candidate.width
            self.places[candidate] = np.arange(place, end), [end] if candidate.offset else []
            place = end + candidate.offset
        self.base = np.concatenate([np.zeros(0), *(self.places[candidate][0] for candidate in base)]).astype(int)
        self.sides = []
        for i, side in enumerate(lacking):
            rows = []
            for force, segment, residual in zip(forces, log.segments, lacking[side], strict=True):
                # what acts on the input acts on the motor, which is the first side
                columns = force.on(i, len(segment)) + (force.on(-1, len(segment)) if i == 0 else 0.0)
                columns = as_smoothed(columns, segment.smoothed[side], segment.period)
                rows.append(low_passed(np.vstack([columns, residual.torque]), residual, log.bandwidth[side]))
            *columns, target = np.concatenate(rows, axis=1)
            # each side over its own missing torque
            size = np.sqrt(np.sum(target**2))
            if len(target) < 2 * _BLOCKS:
                # blocks of a row say nothing
                self.variants = []
            self.sides.append(BlockRegression.of(target / size, np.transpose(columns) / size, _BLOCKS))
        # without any candidate
        self.squares = self._cross_validate([])[0] if self.variants else []

    def propose(self) -> list[TorqueProposal]:
        """Propose the best variant of each effect that surely takes something away, the best effect first."""
        best: dict[str, TorqueProposal] = {}
        for variant in self.variants:
            trial = self._try([], variant, self.squares)
            if trial is not None and trial.share > (best[variant.name].share if variant.name in best else 0.0):
                best[variant.name] = trial
        return sorted(best.values(), key=lambda proposal: -proposal.share)

    def propose_together(self) -> dict[str, Numbers]:
        """Propose effects that take most away one after the other, with their numbers together."""
        chosen: list[Candidate] = []
        squares = self.squares
        linear = [variant for variant in self.variants if not variant.offset]
        while len(chosen) < _MOST:
            trials = [
                trial
                for variant in linear
                if not any(replaces(variant.name, other.name) or replaces(other.name, variant.name) for other in chosen)
                and (trial := self._try(chosen, variant, squares)) is not None
                and trial.share > SHOWN
            ]
            if not trials:
                break
            most = max(trials, key=lambda trial: trial.share)
            plain = [trial for trial in trials if contains(most.name, trial.name) and trial.share > most.share - SHOWN]
            best = max(plain or [most], key=lambda trial: trial.share)
            squares = best.squares
            chosen.append(best.variant)
        values = self._cross_validate(chosen)[1] if chosen else np.zeros(0)
        numbers, place = {}, 0
        for variant in chosen:
            of = variant.numbers(values[place : place + variant.width].tolist())
            place += variant.width
            if of is not None:
                numbers[variant.name] = of
        return numbers

    def _try(self, beside: Sequence[Candidate], variant: Candidate, before: Sequence[np.ndarray]) -> TorqueProposal | None:
        """Try a candidate beside others; None where it takes nothing away, or its numbers are not allowed."""
        after, values = self._cross_validate([*beside, variant])
        gains = np.sum([(old - new) / np.mean(old) for old, new in zip(before, after, strict=True)], axis=0)
        z = float(np.mean(gains) / max(mean_error(gains), 1e-300))
        ratio = np.prod([np.mean(new) / np.mean(old) for old, new in zip(before, after, strict=True)])
        place = sum(other.width for other in beside)
        numbers = variant.numbers(values[place : place + variant.width].tolist())
        if numbers is None or not z > LIMITS.difference:
            return None
        return TorqueProposal(variant, numbers, 1.0 - float(np.sqrt(ratio)), after)

    def _cross_validate(self, chosen: Sequence[Candidate]) -> tuple[list[np.ndarray], np.ndarray]:
        """Find the mean squared errors of each block left out, by side, and the coefficients by all blocks.

        The coefficients of candidates come first.

        An effect that is replaced is taken out of the model. Columns act on all sides with one coefficient, each side over
        its own missing torque.
        """
        gone = [i for i, name in enumerate(self.names) if any(replaces(variant.name, name) for variant in chosen)]
        remaining = [i for i in range(len(self.names)) if i not in gone]
        columns = np.concatenate([*(self.places[variant][0] for variant in chosen), remaining, self.base]).astype(int)
        fixed = [place for variant in chosen for place in self.places[variant][1]] + [len(self.names) + i for i in gone]
        sides = [side.select(columns, fixed) for side in self.sides]
        joined = BlockRegression(np.sum([side.products for side in sides], axis=0), sides[0].counts)
        fits = joined.fit_without_each()
        return [side.held_out(fits) for side in sides], joined.fit()
