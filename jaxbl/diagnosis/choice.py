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
from .confidence import Finding, missing_power, weigh
from .effect_search import EffectSearch, Explanation, Trial, VerdictName
from .expected_errors import expected_errors, list_failed
from .history import Step
from .neutral_effects import candidates
from .reference_log import Comparison
from .refit import FittedModel
from .residuals import SideResiduals
from .setup import Setup, doubt_input
from .thresholds import LIMITS
from .torque_tables import Tabulation, tabulate


class Chosen(NamedTuple):
    """The model that stands.

    Attributes:
        explanation: of the log.
        fitted: the model with it.
        compared: how it compares on the log, each quarter by numbers fitted without it.
        findings: its effects, and how sure they are.
        rival: the best model with another effect in place of one that was found, or None.
        driving: torque that drives the machine, rms, N m.
        prior: standard deviation of theta of the model's own numbers.
        numbers_off: whether that is more than is stated of them.
    """

    explanation: Explanation
    fitted: FittedModel
    compared: Comparison
    findings: tuple[Finding, ...]
    rival: Trial | None
    driving: float
    prior: np.ndarray
    numbers_off: bool

    @property
    def verdict(self) -> VerdictName:
        """Verdict by the log alone."""
        if self.explanation.largest_gain > LIMITS.unknown:
            return "unknown_effect"
        return "explained" if self.fitted.names else "no_discrepancy"


class _UnfeltInput(Exception):
    """Noise of the input did not act on the machine: the set-up without it, and what the model has that shows it."""


class Choice:
    """Finds the model that stands.

    Attributes:
        setup: the nominal model and the log; another one, if the search finds that noise of the input did not act.
        search: for effects.
        before: the model as given on the log.
    """

    def __init__(self, setup: Setup):
        self._begin(setup)

    def _begin(self, setup: Setup, *history: Step) -> None:
        self.setup, self.log = setup, setup.fitted
        # a linear axis has no turns
        rotary = [name for name, kind in EFFECTS.items() if kind.rotary and name.partition(".")[0] in setup.sliding]
        stated, sought = setup.task.config.uncertainty, candidates(setup.bare)
        for name in {*stated.expected}.difference(sought, (effect.name for effect in setup.bare.effects)):
            raise InputError(
                f"uncertainty.expected: '{name}' is no effect that is sought on this drive; it should be one of: "
                f"{', '.join(sought)}"
            )
        exact = *stated.exact, *rotary
        prior = setup.prior.tolist()
        self.search = EffectSearch(setup.bare, setup.free, prior, self.log, exact, stated.expected, self._check_input)
        self.search.history += history
        self.before = self.log.compare(setup.nominal)
        self._missing: tuple[FittedModel, float, list[str]] | None = None

    def _check_input(self, fitted: FittedModel) -> None:
        """End the search if a model shows that the machine did not feel noise of the input that drives models."""
        quieter = doubt_input(self.setup, fitted.experiment)
        if quieter is not None:
            raise _UnfeltInput(quieter, " and ".join(fitted.names) or "other numbers")

    def choose(self) -> Chosen:
        """Search for effects, and settle the numbers."""
        try:
            explanation = self.search.run()
        except _UnfeltInput as unfelt:
            setup, shown_by = unfelt.args
            reason = f"a model with {shown_by} shows that the machine did not feel it"
            self._begin(setup, Step("drive models without noise of the input", None, None, True, reason))
            return self.choose()
        explanation, findings = self._keep_likely(explanation)
        fitted, compared = explanation.fitted, self.search.compare(explanation.fitted)
        if not fitted.names and not standard_errors_better(self.log, self.before, compared) > LIMITS.difference:
            fitted, compared = self._as_given(fitted), self.before
        fits = self.search.fits
        # the rival over which the effect in whose place it stands gains least
        trials_of_all = [trial for trials in explanation.rivals.values() for trial in trials if np.isfinite(trial.gain.nats)]
        closest = min(trials_of_all, key=lambda trial: trial.gain.nats, default=None)
        numbers_off = fits is self.search.rough and fitted is explanation.fitted
        return Chosen(explanation, fitted, compared, findings, closest, fits.given.drive, fits.prior, numbers_off)

    def _keep_likely(self, explanation: Explanation) -> tuple[Explanation, tuple[Finding, ...]]:
        """Leave out effects in whose place something unknown is likelier, if blocks do not show them beyond doubt; take a
        plain law of one where that is likelier, if by blocks the two do not differ."""
        while True:
            findings = weigh(explanation, self._find_missing(explanation.fitted)[0] if explanation.fitted.names else 0.0)
            asked = [finding for finding in findings if finding.effect not in self.search.expected]
            unlikely = [
                (finding.confidence, finding.effect, None)
                for finding in asked
                if not finding.is_likely and explanation.gains[finding.effect].standard_errors < LIMITS.far
            ]
            unlikely += [
                (finding.confidence, finding.effect, trial)
                for finding in asked
                for trial in explanation.plainer[finding.effect]
                if explanation.odds_of(trial) > 1.0 and trial.gain.standard_errors < LIMITS.sure
            ]
            if not unlikely:
                return explanation, findings
            _, name, plain = min(unlikely, key=lambda doubt: doubt[0])
            explanation = self.search.leave_out(explanation, name, plain)

    def _find_missing(self, fitted: FittedModel) -> tuple[float, list[str]]:
        """Find the torque that a model leaves of the log where a complete one would leave less, over the driving torque, and
        the channels in which it leaves more."""
        if self._missing is None or self._missing[0] is not fitted:
            driving, compared = self.search.fits.given.drive, self.log.compare(fitted.experiment)
            expected = expected_errors(self.log, fitted, compared, self.setup.input_noise, driving)
            failed = list_failed(compared.errors, expected)
            torque = missing_power(fitted.experiment, compared.errors, expected) ** 0.5 if failed else 0.0
            self._missing = fitted, torque / driving, failed
        return self._missing[1:]

    def tabulate(self, chosen: Chosen, lacking: SideResiduals) -> Tabulation | None:
        """Tabulate what no known effect explains, where something is left; `lacking`: the torque that is."""
        fitted = chosen.fitted
        away = np.abs(fitted.theta[: len(chosen.prior)]) / chosen.prior
        if np.max(away, initial=0.0) > LIMITS.far or not self._find_missing(fitted)[1]:
            return None
        tables = tabulate(self.log, fitted.experiment, chosen.compared, lacking, self.setup.sliding)
        z, reason = (None, "no table predicts better") if tables is None else (tables.z, "predicts better, and has no name")
        self.search.history.append(Step("add a table of what is left", None, z, tables is not None, reason))
        return tables

    def _as_given(self, fitted: FittedModel) -> FittedModel:
        """Return the model with the numbers that it came with."""
        covariance = np.diag(self.setup.prior**2)
        # if nothing is missing, its numbers are off by as much as the fit says
        off = fitted.white + np.outer(fitted.theta, fitted.theta)
        return fitted._replace(
            experiment=self.setup.nominal, theta=0.0 * fitted.theta, covariance=covariance, white=off, left_out=None
        )
