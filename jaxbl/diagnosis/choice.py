"""The model that stands: what the search found, its numbers, and what no known effect explains as tables.

Everything is decided by blocks of the log that was fitted: each quarter is predicted by numbers that were fitted without it,
to first order (:attr:`FittedModel.left_out`), so that a model gains nothing by numbers that only fit. Nothing here sees what
is held out (:mod:`.proof`).
Reference: S. Arlot, A. Celisse, A survey of cross-validation procedures, Statistics Surveys 4 (2010), section 8.
"""

from typing import NamedTuple

import numpy as np

from jaxbl.drive.effects import EFFECTS

from .blocks import is_worse, standard_errors_better
from .confidence import Finding, explained_share, is_little, weigh
from .effect_search import EffectSearch, Explanation, VerdictName
from .expected_errors import expected_errors, failed
from .fitted_model import FittedModel
from .history import Step
from .reference_log import Comparison
from .residuals import SideResiduals
from .setup import Setup
from .thresholds import LIMITS
from .torque_fit import fit_to_torque
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
        by_torque: standard errors by which numbers of least missing torque beat those of least prediction errors; 0 where
            they are the latter.
        driving: torque that drives the machine, rms, N m.
    """

    found: Explanation
    fitted: FittedModel
    compared: Comparison
    findings: tuple[Finding, ...]
    rival: Rival | None
    by_torque: float
    driving: float

    @property
    def verdict(self) -> VerdictName:
        """What the log alone says."""
        if self.found.left > LIMITS.unknown or self.by_torque > 0.0:
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
        known = *setup.task.config.uncertainty.exact, *rotary
        self.search = EffectSearch(setup.bare, setup.own, setup.prior.tolist(), self.log, known)
        self.before = self.log.compare(setup.nominal)
        # asked for twice of one model, and made of many draws
        self._tested: tuple[FittedModel, bool, bool] | None = None

    @property
    def history(self) -> list[Step]:
        """Every comparison that decided something."""
        return self.search.history

    def choose(self) -> Chosen:
        """Search for effects, and settle the numbers."""
        found = self.search.run()
        fitted, compared = found.fitted, self.search.compare(found.fitted)
        if not fitted.names and not standard_errors_better(self.log, self.before, compared) > LIMITS.seen:
            fitted, compared = self._as_given(fitted), self.before
        findings = weigh(found)
        chosen = Chosen(found, fitted, compared, findings, _closest(found), 0.0, self.search.fits.given.drive)
        return self._fit_to_torque(chosen) if self._leaves_more(chosen, or_little=True) else chosen

    def tabulate(self, chosen: Chosen, lacking: SideResiduals) -> Tabulation | None:
        """Tabulate what no known effect explains, where something is left; `lacking`: the torque that is."""
        if not self._is_plausible(chosen.fitted) or not self._leaves_more(chosen):
            return None
        tables = tabulate(self.log, chosen.fitted.experiment, chosen.compared, lacking, self.setup.sliding)
        z, why = (None, "no table predicts better") if tables is None else (tables.z, "predicts better, and has no name")
        self.history.append(Step("add a table of what is left", None, z, tables is not None, why))
        return tables

    def _leaves_more(self, chosen: Chosen, *, or_little: bool = False) -> bool:
        """Tell whether a model leaves more on the log than a complete one would; or less than half explained."""
        setup, fitted = self.setup, chosen.fitted
        if self._tested is None or self._tested[0] is not fitted:
            whole = self.log.compare(fitted.experiment)
            expected = expected_errors(self.log, fitted, whole, setup.input_noise, chosen.driving)
            share = explained_share(setup.nominal, self.before.errors, whole.errors, expected)
            self._tested = fitted, bool(failed(self.log.with_slow(whole), expected)), is_little(share)
        _, fails, little = self._tested
        return fails or (or_little and little)

    def _fit_to_torque(self, chosen: Chosen) -> Chosen:
        """Take the numbers of least missing torque, if they are better by blocks."""
        fitted = fit_to_torque(self.search.fits, chosen.fitted, self.log) if chosen.fitted.names else None
        if fitted is None:
            return chosen
        compared = self.search.compare(fitted)
        z = standard_errors_better(self.log, chosen.compared, compared)
        noise = self.log.noise_floor(self.before.torques)
        possible = self._is_plausible(fitted) and not is_worse(compared, self.before, noise)
        kept = z > LIMITS.seen and possible
        why = (
            f"{LIMITS.seen:g} standard error is asked"
            if possible
            else "its numbers cannot be, or the model as given is better"
        )
        self.history.append(Step("numbers of least missing torque", None, z, kept, why))
        return chosen._replace(fitted=fitted, compared=compared, by_torque=z) if kept else chosen

    def _as_given(self, fitted: FittedModel) -> FittedModel:
        """Return the model with the numbers that it came with."""
        own, known = self.setup.own, np.diag(self.setup.prior**2)
        # if nothing is missing, its numbers are off by as much as the fit says
        off = fitted.white + np.outer(fitted.theta, fitted.theta)
        return fitted._replace(
            experiment=self.setup.nominal, theta=np.zeros(len(own)), covariance=known, white=off, left_out=None
        )

    def _is_plausible(self, fitted: FittedModel) -> bool:
        """Tell whether a model's own numbers are where they may be by what is known of them."""
        return bool(np.all(np.abs(fitted.theta[: len(self.setup.prior)]) < LIMITS.far * self.setup.prior))


def _closest(found: Explanation) -> Rival | None:
    """Find the rival over which the effect in whose place it stands gains least."""
    every = [trial for trials in found.rivals.values() for trial in trials if np.isfinite(trial.gain.nats)]
    best = min(every, key=lambda trial: trial.gain.nats, default=None)
    return None if best is None else Rival(best.added[0], best.fitted)
