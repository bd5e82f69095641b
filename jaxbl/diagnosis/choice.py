"""Which of several models stands: they are compared on the log that they were fitted to, block by block.

Each quarter of the log is predicted by numbers that were fitted without it, to first order
(:attr:`FittedModel.left_out`), so that a model gains nothing by numbers that only fit. Nothing here sees what is held out
(:mod:`.proof`).
Reference: S. Arlot, A. Celisse, A survey of cross-validation procedures, Statistics Surveys 4 (2010), section 8.
"""

from collections.abc import Collection
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxbl.drive.effects import EFFECTS, Numbers
from jaxbl.simulate import Experiment
from jaxbl.workers import announce

from .blocks import SEEN, SURE, is_better, is_worse, standard_errors_better, take_folds
from .candidates import EffectNumbers, are_possible
from .confidence import exchanged, explained_share, is_little, weigh
from .effect_search import FAR, EffectSearch, Explanation, Finding
from .expected_errors import expected_errors, failed
from .fitted_model import FittedModel, special_case
from .history import Step, describe_change
from .reference_log import Comparison
from .residuals import SideResiduals
from .setup import Setup
from .torque_fit import fit_to_torque
from .torque_regression import extend_explanation
from .torque_tables import Tabulation, tabulate

_BOUND = 4.0
"""Standard deviations that the model's own numbers may be off where they are held."""


class Rival(NamedTuple):
    """The best model with another effect in place of the last.

    Attributes:
        effect: the other one.
        experiment: the model with it, its numbers fitted.
        standard_errors: by which the chosen model is better, by blocks of the log.
    """

    effect: str
    experiment: Experiment
    standard_errors: float


class Chosen(NamedTuple):
    """The model that stands.

    Attributes:
        search: that found it.
        found: the explanation.
        fitted: the model with it.
        compared: how it compares on the log, each quarter by numbers fitted without it.
        withdrawn: effects that were found, and that it is without.
        gains: standard errors by which it beats the model without an effect, by effect.
        rival: the best model with another effect, or None.
        by_torque: standard errors by which numbers of least missing torque beat those of least prediction errors; 0 where
            they are the latter.
    """

    search: EffectSearch
    found: Explanation
    fitted: FittedModel
    compared: Comparison
    withdrawn: list[str]
    gains: Numbers
    rival: Rival | None = None
    by_torque: float = 0.0


def new_search(setup: Setup, bound: float = np.inf, without: Collection[str] = ()) -> EffectSearch:
    """The search for effects on the log; `bound`: standard deviations that the model's own numbers may be off; `without`:
    effects that are not sought."""
    exact = (*setup.task.config.uncertainty.exact, *without)
    return EffectSearch(setup.bare, setup.own, setup.prior.tolist(), setup.fitted.segments, bound, exact)


def explain(setup: Setup, history: list[Step]) -> tuple[EffectSearch, Explanation]:
    """Find what the log says that the model lacks.

    Where two effects are missing at once, the model's own numbers may go wrong, and hide both. If they do, effects are
    sought with these numbers held near to what is known of them; what that finds counts if its numbers stay there without
    being held, beside something unknown too: numbers that cannot be explain nothing.
    """
    search = new_search(setup)
    found = search.run()
    history += search.history
    if not search.plausible(found):
        other = new_search(setup, _BOUND)
        again = other.run()
        kept = other.plausible(again)
        why = f"the model's own numbers leave {FAR:g} standard deviations of [uncertainty]; held within {_BOUND:g}"
        ends = "they stay there when they are free: this search counts" if kept else "they leave it when they are free"
        history.append(Step("search again", None, None, kept, f"{why}, {ends}"))
        history += other.history
        if kept:
            return other, again
    return search, found


class Choice:
    """Compares models on the log.

    Attributes:
        setup: the nominal model and the log.
        log: what models are compared on.
        before: the model as given there.
        noise: of each channel, as far as the model as given tells.
        history: every comparison that decided something.
    """

    def __init__(self, setup: Setup, history: list[Step]):
        self.setup, self.log, self.history = setup, setup.fitted, history
        self.before = self.log.compare(setup.nominal)
        self.noise = self.log.noise_floor(self.before.torques)
        self._tested: tuple[FittedModel, bool, bool] | None = None

    def compare(self, fitted: FittedModel) -> Comparison:
        """Errors of a model on the log, each quarter by numbers that were fitted without it."""
        whole = self.log.compare(fitted.experiment)
        if fitted.left_out is None:
            return whole
        return take_folds(whole, [self.log.compare(fitted.move_by(change)) for change in fitted.left_out])

    def choose(self, search: EffectSearch, found: Explanation) -> Chosen:
        """The model that stands.

        Where the blocks take effects away, others are sought in their place. Where more is left than a complete model would
        leave, so are those that the missing torque itself shows, and numbers that leave less of it.
        """
        best = self._exchange(search, found)
        if best.withdrawn:
            other = new_search(self.setup, search.bound, best.withdrawn)
            again = other.run()
            self._note(f"search again without {' and '.join(best.withdrawn)}", None, None, True, "they were withdrawn")
            self.history += other.history
            if again.model.names not in ((), best.fitted.names) and other.plausible(again):
                best = self._better(best, self._exchange(other, again), SURE)
        if self._leaves_more(best):
            more = extend_explanation(best.search, best.found, best.fitted, self.log, self.history)
            if more is not best.found:
                best = self._better(best, self._exchange(best.search, more), SEEN)
        if self._leaves_more(best, or_little=True):
            best = self._fit_to_torque(best)
        rival = None if best.rival is None else best.rival.standard_errors
        findings = weigh(best.found, best.fitted, rival, best.gains)
        return best._replace(found=replace(best.found, findings=findings))

    def _note(self, tried: str, nats: float | None, z: float | None, kept: bool, why: str) -> None:
        self.history.append(Step(tried, nats, z, kept, why))

    def tabulate(self, chosen: Chosen, lacking: SideResiduals) -> Tabulation | None:
        """Tables of what no known effect explains, where something is left; `lacking`: the torque that is."""
        if not self._is_plausible(chosen.fitted) or not self._leaves_more(chosen):
            return None
        tables = tabulate(self.log, chosen.fitted.experiment, chosen.compared, lacking, self.setup.sliding)
        z, why = (None, "no table predicts better") if tables is None else (tables.z, "predicts better, and has no name")
        self._note("add a table of what is left", None, z, tables is not None, why)
        return tables

    def _leaves_more(self, chosen: Chosen, or_little: bool = False) -> bool:
        """Tell whether a model leaves more on the log than a complete one would; or less than half explained."""
        setup, fitted = self.setup, chosen.fitted
        if self._tested is None or self._tested[0] is not fitted:
            whole = self.log.compare(fitted.experiment)
            expected = expected_errors(self.log, fitted, whole, setup.input_noise, chosen.found.model.linear.drive)
            share = explained_share(setup.nominal, self.before.errors, whole.errors, expected)
            self._tested = fitted, bool(failed(self.log.with_slow(whole), expected)), is_little(share)
        _, fails, little = self._tested
        return fails or (or_little and little)

    def _better(self, best: Chosen, other: Chosen, least: float) -> Chosen:
        """Another model in place of the best, if it is better by so many standard errors, and not by numbers that cannot
        be."""
        z = standard_errors_better(self.log, best.compared, other.compared)
        possible = self._is_plausible(other.fitted) or not self._is_plausible(best.fitted)
        kept = bool(other.fitted.names) and possible and z >= least
        why = f"{least:g} standard errors are asked" if possible else "the model's own numbers cannot be what it needs"
        nats = other.fitted.log_likelihood - best.fitted.log_likelihood
        self._note(describe_change(best.fitted.numbers, other.fitted.numbers), nats, z, kept, why)
        gone = dict.fromkeys([*best.withdrawn, *other.withdrawn])
        withdrawn = [name for name in gone if name not in other.fitted.names]
        return other._replace(withdrawn=withdrawn) if kept else best

    def _fit_to_torque(self, chosen: Chosen) -> Chosen:
        """The model with the numbers of least missing torque, if they are better by blocks."""
        fitted = fit_to_torque(chosen.search, chosen.fitted, self.log) if chosen.fitted.names else None
        if fitted is None:
            return chosen
        compared = self.compare(fitted)
        z = standard_errors_better(self.log, chosen.compared, compared)
        possible = self._is_plausible(fitted) and not is_worse(compared, self.before, self.noise)
        kept = z > SEEN and possible
        why = f"{SEEN:g} standard error is asked" if possible else "its numbers cannot be, or the model as given is better"
        self._note("numbers of least missing torque", None, z, kept, why)
        if not kept:
            return chosen
        # a complete model has the same numbers by both
        found = replace(chosen.found, verdict="unknown_effect")
        rival = self._rival(chosen.search, found, compared)
        return chosen._replace(found=found, fitted=fitted, compared=compared, rival=rival, by_torque=z)

    def _rival(self, search: EffectSearch, found: Explanation, compared: Comparison) -> Rival | None:
        """The best model with a wrong effect, whose numbers are fitted as well."""
        if found.wrong is None or not found.model.names:
            return None
        fitted = search.fit(found.wrong.numbers, found.wrong.theta)
        z = standard_errors_better(self.log, self.compare(fitted), compared)
        return Rival(found.wrong.names[-1], fitted.experiment, z)

    def _exchange(self, search: EffectSearch, found: Explanation) -> Chosen:
        """As :meth:`choose`; an effect that another one beats changes places with it, once."""
        other: Explanation | None = found
        for _ in range(2):
            found = other or found
            chosen = self._withdraw(search, found)
            found, rival = chosen.found, chosen.rival
            other = None if rival is None else exchanged(found, rival.standard_errors)
            if rival is not None:
                last = found.model.names[-1]
                why = "better by log and blocks together" if other else f"{last} is better by log and blocks together"
                nats = None if found.wrong is None else found.wrong.log_evidence - found.model.log_evidence
                self._note(f"replace {last} by {rival.effect}", nats, -rival.standard_errors, other is not None, why)
            if other is None:
                break
        for name in chosen.fitted.names:
            chosen = self._simplify(chosen, name)
        return chosen

    def _withdraw(self, search: EffectSearch, found: Explanation) -> Chosen:
        """The model with what was found, as far as the blocks bear it out.

        Withdrawn, one after the other, are effects without which a model does about as well, the one of least torque first,
        since beside it others may only seem needless; and while the model is worse than the one given, the effect without
        which it does worst.
        """
        names, withdrawn = list(found.model.names), []
        fitted, compared, gains = None, self.before, {}
        while names:
            fitted = search.fit({name: found.model.numbers[name] for name in names}, found.model.theta)
            compared = self.compare(fitted)
            every = {name: self._gain(search, fitted, compared, name) for name in names}
            gains = {name: gain for name, (gain, _) in every.items()}
            needless = [name for name in names if not gains[name] > _least_gain(name)]
            needless += [name for name, own in fitted.numbers.items() if not are_possible({name: own}, search.period)]
            worse = is_worse(compared, self.before, self.noise)
            kept = not needless and not worse
            gone = "" if kept else min(needless, key=fitted.share) if needless else min(names, key=lambda name: gains[name])
            for name in names:
                asked = f"{_least_gain(name):g} standard error{'s' if _least_gain(name) > 1.0 else ''} asked"
                why = "the model as given is better" if name == gone and not needless else asked
                nats = -every[name][1]
                # a gain of the effect is a loss of the model without it
                self._note(f"remove {name}", nats, -gains[name], name == gone, why)
            if kept:
                break
            announce(f"trying without {gone}")
            withdrawn.append(gone)
            names.remove(gone)
        if not names:
            fitted = search.fit({}, found.nominal.theta)
            compared, gains = self.compare(fitted), {}
            if is_worse(compared, self.before, self.noise) or not is_better(compared.errors, self.before.errors):
                fitted, compared = self._as_given(fitted), self.before
        assert fitted is not None
        if withdrawn:
            found = search.without(found, withdrawn)
        return Chosen(search, found, fitted, compared, withdrawn, gains, self._rival(search, found, compared))

    def _as_given(self, fitted: FittedModel) -> FittedModel:
        """The model with the numbers that it came with."""
        own, known = self.setup.own, np.diag(self.setup.prior**2)
        # if nothing is missing, its numbers are off by as much as the fit says
        off = fitted.white + np.outer(fitted.theta, fitted.theta)
        return FittedModel((), self.setup.nominal, own, np.zeros(len(own)), known, off, fitted.linear)

    def _gain(self, search: EffectSearch, fitted: FittedModel, compared: Comparison, name: str) -> tuple[float, float]:
        """Standard errors and nats by which a model beats the one without an effect, all numbers fitted anew.

        Where its own numbers can take the effect's place, the log knows nothing of it, and what is known of these numbers
        decides: the deviations from it that they would need, beyond two, are added.
        """
        own, prior = len(self.setup.prior), self.setup.prior
        numbers = {other: values for other, values in fitted.numbers.items() if other != name}
        fewer = search.fit(numbers, fitted.theta[:own])
        without, by = (float(np.sum((each.theta[:own] / prior) ** 2)) for each in (fewer, fitted))
        # what two deviations would explain is no sign of anything
        z = standard_errors_better(self.log, self.compare(fewer), compared) + np.sqrt(max(without - by - SURE**2, 0.0))
        return z, fitted.log_likelihood - fewer.log_likelihood

    def _simplify(self, chosen: Chosen, name: str) -> Chosen:
        """The model with the special case of an effect in its place, where nothing parts the two: neither the fit
        (:func:`special_case`) nor the blocks."""
        search, fitted = chosen.search, chosen.fitted
        plain = special_case(fitted, name, self.log.noise)
        if plain is None or plain not in search.lacking or plain in fitted.names:
            return chosen
        reduced = EFFECTS[name].special_cases[plain.partition(".")[2]]
        numbers: EffectNumbers = {
            (plain if other == name else other): reduced(values) if other == name else values
            for other, values in fitted.numbers.items()
        }
        less = search.fit(numbers, fitted.theta[: len(self.setup.prior)])
        compared = self.compare(less)
        z = standard_errors_better(self.log, chosen.compared, compared)
        kept = z >= -SEEN and not is_worse(compared, self.before, self.noise)
        why = "the number that parts the two is not known" if kept else "the general one predicts better"
        self._note(f"replace {name} by {plain}", less.log_likelihood - fitted.log_likelihood, z, kept, why)
        if not kept:
            return chosen
        gains = {other: chosen.gains[other] for other in numbers if other != plain}
        gains[plain], _ = self._gain(search, less, compared, plain)
        found = _rename(search, chosen.found, less, name, plain)
        rival = self._rival(search, found, compared)
        return Chosen(search, found, less, compared, chosen.withdrawn, gains, rival)

    def _is_plausible(self, fitted: FittedModel) -> bool:
        """Tell whether a model's own numbers are where they may be by what is known of them."""
        return bool(np.all(np.abs(fitted.theta[: len(self.setup.prior)]) < FAR * self.setup.prior))


def _least_gain(name: str) -> float:
    """Standard errors by which an effect has to make a model better.

    What depends on the time alone imitates whatever is slow or random, and a wave's frequency and phase were chosen among
    many; but then it does not go on in another part of the log.
    """
    return SURE if EFFECTS[name].in_time else SEEN


def _rename(search: EffectSearch, found: Explanation, fitted: FittedModel, name: str, plain: str) -> Explanation:
    """An explanation with a special case in place of an effect, as probable as that was."""
    numbers, findings = fitted.numbers, []
    for finding in found.findings:
        if finding.effect == name:
            others = tuple(other for other in finding.alternatives if other[0] != plain)
            finding = Finding(plain, finding.confidence, numbers[plain], others)
        findings.append(finding)
    renamed = search.adopted(found, numbers, fitted.theta[: len(search.free)], findings)
    # a rival stands beside the same effects
    if found.wrong is not None and name == found.model.names[-1] and found.wrong.names[-1] != plain:
        return replace(renamed, wrong=found.wrong)
    return renamed
