"""The model that stands: what the search found, its numbers, and what no known effect explains as tables.

Everything is decided by blocks of the log that was fitted: each quarter is predicted by numbers that were fitted without it,
to first order (:attr:`FittedModel.left_out`), so that a model gains nothing by numbers that only fit. Nothing here sees what
is held out (:mod:`.proof`).
Reference: S. Arlot, A. Celisse, A survey of cross-validation procedures, Statistics Surveys 4 (2010), section 8.
"""

from typing import NamedTuple

import numpy as np

from jaxbl.drive.effects import EFFECTS
from jaxbl.errors import InputError

from .blocks import standard_errors_better
from .confidence import Finding, weigh
from .effect_search import EffectSearch, Explanation, VerdictName
from .expected_errors import expected_errors, list_failed
from .fitted_model import FittedModel
from .history import Step
from .neutral_effects import candidates
from .reference_log import Comparison
from .residuals import SideResiduals
from .setup import Setup
from .thresholds import LIMITS
from .torque_tables import Tabulation, tabulate


class Rival(NamedTuple):
    """The best model with another effect in place of one that was found.

    Attributes:
        effect: the other one.
        fitted: the model with it.
    """

    effect: str
    fitted: FittedModel


class Chosen(NamedTuple):
    """The model that stands.

    Attributes:
        found: the explanation.
        fitted: the model with it.
        compared: how it compares on the log, each quarter by numbers fitted without it.
        findings: its effects, and how sure they are.
        rival: the best model with another effect, or None.
        driving: torque that drives the machine, rms, N m.
        prior: standard deviation of theta of the model's own numbers.
        numbers_off: whether that is more than is stated of them.
    """

    found: Explanation
    fitted: FittedModel
    compared: Comparison
    findings: tuple[Finding, ...]
    rival: Rival | None
    driving: float
    prior: np.ndarray
    numbers_off: bool

    @property
    def verdict(self) -> VerdictName:
        """What the log alone says."""
        if self.found.left > LIMITS.unknown:
            return "unknown_effect"
        return "explained" if self.fitted.names else "no_discrepancy"


class Choice:
    """Finds the model that stands.

    Attributes:
        setup: the nominal model and the log.
        search: for effects.
        before: the model as given on the log.
    """

    def __init__(self, setup: Setup):
        self.setup, self.log = setup, setup.fitted
        # a linear axis has no turns
        rotary = [name for name, kind in EFFECTS.items() if kind.rotary and name.partition(".")[0] in setup.sliding]
        stated, sought = setup.task.config.uncertainty, candidates(setup.bare)
        for name in {*stated.expected}.difference(sought, (effect.name for effect in setup.bare.effects)):
            raise InputError(
                f"uncertainty.expected: '{name}' is no effect that is sought on this drive; it should be one of: "
                f"{', '.join(sought)}"
            )
        known = *stated.exact, *rotary
        self.search = EffectSearch(setup.bare, setup.own, setup.prior.tolist(), self.log, known, stated.expected)
        self.before = self.log.compare(setup.nominal)

    def choose(self) -> Chosen:
        """Search for effects, and settle the numbers."""
        found = self.search.run()
        fitted, compared = found.fitted, self.search.compare(found.fitted)
        if not fitted.names and not standard_errors_better(self.log, self.before, compared) > LIMITS.seen:
            fitted, compared = self._as_given(fitted), self.before
        findings = weigh(found)
        fits, closest = self.search.fits, _closest(found)
        numbers_off = fits is self.search.rough and fitted is found.fitted
        return Chosen(found, fitted, compared, findings, closest, fits.given.drive, fits.prior, numbers_off)

    def tabulate(self, chosen: Chosen, lacking: SideResiduals) -> Tabulation | None:
        """Tabulate what no known effect explains, where something is left; `lacking`: the torque that is."""
        fitted = chosen.fitted
        whole, away = self.log.compare(fitted.experiment), np.abs(fitted.theta[: len(chosen.prior)]) / chosen.prior
        expected = expected_errors(self.log, fitted, whole, self.setup.input_noise, chosen.driving)
        if np.max(away, initial=0.0) > LIMITS.far or not list_failed(self.log.with_slow(whole), expected):
            return None
        tables = tabulate(self.log, fitted.experiment, chosen.compared, lacking, self.setup.sliding)
        z, why = (None, "no table predicts better") if tables is None else (tables.z, "predicts better, and has no name")
        self.search.history.append(Step("add a table of what is left", None, z, tables is not None, why))
        return tables

    def _as_given(self, fitted: FittedModel) -> FittedModel:
        """Return the model with the numbers that it came with."""
        known = np.diag(self.setup.prior**2)
        # if nothing is missing, its numbers are off by as much as the fit says
        off = fitted.white + np.outer(fitted.theta, fitted.theta)
        return fitted._replace(
            experiment=self.setup.nominal, theta=0.0 * fitted.theta, covariance=known, white=off, left_out=None
        )


def _closest(found: Explanation) -> Rival | None:
    """Find the rival over which the effect in whose place it stands gains least."""
    every = [trial for trials in found.rivals.values() for trial in trials if np.isfinite(trial.gain.nats)]
    best = min(every, key=lambda trial: trial.gain.nats, default=None)
    return None if best is None else Rival(best.added[0], best.fitted)
