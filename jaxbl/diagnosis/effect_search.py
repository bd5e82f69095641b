"""Which effects a model lacks on a log: propose, try, accept by one rule, until nothing is accepted.

A round: effects are proposed by the prediction errors of the linearised model (:mod:`.evidence`) and by a regression on the
missing torque (:mod:`.torque_regression`), there also several together. Each is put into the model, all numbers are fitted
(:mod:`.refit`), and the two models are compared (:class:`Gain`). The best one that is accepted stays. Then whatever is there
is asked for again: an effect stays if the model without it, or with its special case in its place, is worse by the same
rule. In the end what was passed by is tried in the place of what is there: rivals, other waves, laws with a memory, and
effects where numbers were taken to be off. Then free functions of time, position and velocity are fitted to what remains:
one that gains clearly says that something else is missing. What is less likely than something unknown in its place goes
again (:mod:`.choice`).
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np

from jaxbl.chain import Experiment
from jaxbl.drive.effects import EFFECTS, AbstractEffect, Numbers
from jaxbl.estimation.free_parameters import FreeParameter
from jaxbl.records.least_squares import column_rms
from jaxbl.workers import announce

from .blocks import standard_errors_better, standard_errors_between
from .candidates import (
    NO_CANDIDATE,
    Candidate,
    EffectNumbers,
    are_possible,
    contains,
    is_finer_law,
    owner_of,
    release,
    replaces,
    variants_of,
)
from .evidence import Evidence, Products, evidence_of
from .free_functions import functions_of
from .history import Step, describe_change
from .linearised_model import Linear, Predictor
from .neutral_effects import candidates, find_corrected
from .reference_log import Comparison, ReferenceLog
from .refit import FittedModel, ModelFits
from .thresholds import LIMITS
from .torque_regression import SHOWN, TorqueRegression

VerdictName = Literal["explained", "no_discrepancy", "unknown_effect", "not_tested"]

_PROPOSED, _BY_TORQUE, _LEADERS = 5, 4, 3
"""Effects of each kind of proposal that are put into the model in a round at most, and those that get a predictor of their
own before."""
_PROMISING = 0.5
"""A candidate is tried where it promises this share of the most nats that an accepted one gained (promises are linear), or
takes away this share of the torque that the best one does; several together count by this share of their worth."""
_SIZES = 1.0, 0.3, 0.1, 0.03, 0.01, 0.003
"""Prior sizes of a free function that are tried, over `effect_size`: down to the least that counts."""
_MOST = 8
"""Effects that are sought."""


class Gain(NamedTuple):
    """States what one model has over another.

    Attributes:
        nats: of log-evidence on the log.
        standard_errors: by which it predicts blocks of the log better, by numbers fitted without them: in prediction errors,
            or in windows and torques, unless the other ones surely contradict.
        asked: standard errors that make up for its odds before the log is seen: of a model that is right, z standard errors
            are 2 z² nats over one that is not (:func:`.blocks.standard_errors_between`).
    """

    nats: float
    standard_errors: float
    asked: float = 0.0

    @property
    def is_accepted(self) -> bool:
        """The rule: whether the log and its blocks are for the one model, each by more than its odds are against it."""
        return self.nats > 0.0 and self.standard_errors > self.asked

    @property
    def worth(self) -> float:
        """Nats as far as the blocks agree, whose z standard errors are 2 z² nats."""
        by_blocks = 2.0 * self.standard_errors * abs(self.standard_errors)
        agreed = min(self.nats, by_blocks, key=abs) if self.nats * by_blocks > 0.0 else by_blocks
        return float(np.clip(agreed, -700.0, 700.0))

    @property
    def rule(self) -> str:
        """Say what is asked of it."""
        return f"nats above 0 and {self.asked:.2g} standard errors are asked"


class Trial(NamedTuple):
    """Holds a model that was tried.

    Attributes:
        added: the effects that it has more; none where its own numbers are further off than stated.
        fitted: the model.
        gain: over the model without them; of a rival, what the other one gains over it.
    """

    added: tuple[str, ...]
    fitted: FittedModel
    gain: Gain

    @property
    def worth(self) -> float:
        """Nats by which the most likely one is chosen: several at once have to be worth more than one of them."""
        return self.gain.worth * (_PROMISING if len(self.added) > 1 else 1.0)


class _Proposal(NamedTuple):
    """Effects that may be missing, their numbers, the change of the model's own numbers beside them, and the nats that they
    promise; infinite where these are not known. And the best variant of a single one."""

    numbers: EffectNumbers
    change: np.ndarray | float = 0.0
    nats: float = np.inf
    variant: Candidate = NO_CANDIDATE


class Explanation(NamedTuple):
    """The effects that a model lacks by a log.

    Attributes:
        fitted: the model with the effects that were found.
        gains: over the model without an effect, by effect.
        rivals: models with another effect in place of one of these, and what the found one gains over each, by effect.
        plainer: the same with a plain law of it.
        largest_gain: nats that a free function of time, position or velocity gains at most.
    """

    fitted: FittedModel
    gains: dict[str, Gain]
    rivals: dict[str, list[Trial]]
    plainer: dict[str, list[Trial]]
    largest_gain: float

    def odds_of(self, plain: Trial) -> float:
        """Odds of a plain law in place of an effect: by the gain over it; and what parts them may be something unknown."""
        return float(np.exp(-plain.gain.worth)) + (self.largest_gain / max(plain.gain.nats, 1.0)) ** 2


class EffectSearch:
    """Searches a log for effects that a model lacks."""

    def __init__(
        self,
        experiment: Experiment,
        free: Sequence[FreeParameter],
        prior: Sequence[float],
        log: ReferenceLog,
        exact: Collection[str] = (),
        expected: Collection[str] = (),
        check_model: Callable[[FittedModel], None] = lambda fitted: None,
    ):
        """Prepare to explain a log.

        Args:
            experiment: the nominal model, with array leaves; its sample period is that of the log.
            free, prior: its own numbers that are not exactly known, and the relative standard deviation of each.
            log: the log.
            exact: dotted paths of numbers that are known, and names of effects that are surely not missing.
            expected: names of effects that surely act: they are in the model from the first, and stay.
            check_model: called with each model that is accepted; it ends the search by an exception.
        """
        self.log, self.expected, self.check_model, stated = log, expected, check_model, np.asarray(prior)
        self.fits = self.stated = ModelFits(experiment, free, stated, log.segments)
        rough = np.hypot(stated, LIMITS.number_error)
        self.rough = ModelFits(experiment, free, rough, log.segments, LIMITS.effect_odds)
        self.lacking = [name for name in candidates(experiment) if name not in exact and find_corrected(name) not in exact]
        self.floor = LIMITS.noise_structure * sum(map(len, log.segments)) * len(experiment.sides)
        self.history: list[Step] = []
        self._compared: dict[tuple, Comparison] = {}
        self._tried: dict[str, list[Trial]] = {}
        self.passed_by: FittedModel | None = None

    # ---- models beside one another ----

    def compare(self, fitted: FittedModel) -> Comparison:
        """Compare a model with the log, each quarter by numbers that were fitted without it."""
        key = fitted.names, fitted.theta.tobytes()
        if key not in self._compared:
            models = [] if fitted.left_out is None else [fitted.move_by(change) for change in fitted.left_out]
            self._compared[key] = self.log.compare(fitted.experiment, models=models)
        return self._compared[key]

    def gain(self, before: FittedModel, after: FittedModel) -> Gain:
        """Tell what one model gains over another; infinite where one of them cannot be."""
        asked = float(np.sqrt(0.5 * max(before.log_odds - after.log_odds, 0.0)))
        if not self._is_possible(after):
            return Gain(-np.inf, -np.inf, asked)
        if not self._is_possible(before):
            return Gain(np.inf, np.inf, asked)
        assert before.foretold is not None and after.foretold is not None
        size = column_rms(after.foretold)
        foretold = standard_errors_between(*(list((model.foretold / size).T) for model in (before, after)))  # type: ignore
        simulated = standard_errors_better(self.log, self.compare(before), self.compare(after))
        least, most = sorted((foretold, simulated))
        # what is known of the model's own numbers counts, but for what two standard deviations explain
        count = len(self.stated.prior)
        moved = [float(np.sum((model.theta[:count] / model.linear.prior[:count]) ** 2)) for model in (before, after)]
        beyond = float(np.sqrt(max(moved[0] - moved[1] - LIMITS.sure**2, 0.0)))
        margin = (most if least > -LIMITS.sure else least) + beyond
        return Gain(after.log_evidence - before.log_evidence, margin, asked)

    def _is_possible(self, fitted: FittedModel) -> bool:
        """Tell whether a model can be simulated, and each of its effects has a torque that counts."""
        return (
            fitted.foretold is not None
            and are_possible(fitted.numbers, self.log.period)
            and all(map(fitted.counts, fitted.names))
        )

    # ---- the loop ----

    def run(self) -> Explanation:
        """Find what is missing."""
        explanation = self._explain(self._begin())
        if self.fits is self.rough and self.passed_by is not None and not explanation.largest_gain > LIMITS.unknown:
            # a few effects may be likelier than numbers that are all off
            self.fits = self.stated
            by_effects = self._explain(self.passed_by)
            nats = by_effects.fitted.log_evidence - explanation.fitted.log_evidence
            self._note("effects in place of numbers that are off", Gain(nats, np.nan), nats > 0.0, "the likelier ones stay")
            if nats > 0.0:
                explanation = by_effects
            else:
                self.fits = self.rough
        self._note_remainder(explanation)
        return explanation

    def _note_remainder(self, explanation: Explanation) -> None:
        remaining = explanation.largest_gain
        self._note(
            "fit free functions to what remains", Gain(remaining, np.nan), bool(remaining > LIMITS.unknown),
            f"a free function still gains {remaining:.3g} nats; {LIMITS.unknown:g} show something unknown",
        )  # fmt: skip

    def _explain(self, current: FittedModel) -> Explanation:
        """Add, replace and take out effects until nothing is accepted."""
        # effects that make each other needless would come and go without end
        visited = set()
        while True:
            state = self._identify(current)
            better = None if state in visited else self._next(current)
            visited.add(state)
            # in the end every effect is asked for, and of several at once each
            thorough = better is None or len(better.names) > len(current.names) + 1
            reduced = self._reduce(better or current, thorough=thorough)
            current = reduced.fitted
            if better is not None:
                self.check_model(current)
            if better is not None or self._identify(current) not in visited:
                continue
            explanation = self._conclude(reduced)
            accepted = [
                (name, trial)
                for name, rivals in explanation.rivals.items()
                for trial in (*rivals, *self._try_laws(current, name))
                if self.gain(current, trial.fitted).is_accepted
            ]
            name, best = max(accepted, key=lambda pair: -pair[1].gain.nats, default=("", None))
            if best is None or self._identify(best.fitted) in visited:
                return explanation
            (other,) = best.added
            self._note(f"take {other} for {name}", best.gain, True, "it is better by the same rule", loss=True)
            if name != other:
                self._tried[other] = [Trial((name,), current, best.gain)]
            current = best.fitted

    def _conclude(self, reduced: Explanation) -> Explanation:
        """Fit rivals to what was found, and free functions to what remains."""
        current = reduced.fitted
        rivals = {name: self._rivals(current, name) for name in current.names}
        return reduced._replace(rivals=rivals, largest_gain=self.find_largest_gain(current))

    def leave_out(self, explanation: Explanation, name: str, plain: Trial | None) -> Explanation:
        """Explain a log without an effect that was found, or with a plain law of it, as something unknown is likelier in the
        place of what is left out."""
        current = explanation.fitted
        less = self._exchange(current, name) if plain is None else plain.fitted
        gain = explanation.gains[name] if plain is None else plain.gain
        change = describe_change(current.numbers, less.numbers)
        self._note(change, gain, True, "something unknown is likelier in its place", loss=True)
        explanation = self._conclude(self._reduce(less, thorough=True))
        self._note_remainder(explanation)
        return explanation

    def _begin(self) -> FittedModel:
        """Fit the model as given, with what is known to act and with errors of the recording that are larger than effects
        are, which would stand for them."""
        current = self.fits.fit({}, 0.0 * self.fits.prior)
        for name in self.lacking:
            neutral = _Proposal({name: EFFECTS[name].neutral()})
            if name in self.expected:
                linear, variants = self._vary(current, [name])
                ranked = self._rank(linear, current.names, variants, linear.best_predictor)
                trial = self._try(current, ranked[0] if ranked else neutral)
                stays, reason = self._is_possible(trial.fitted), "known to act"
            elif not EFFECTS[name].in_log:
                continue
            else:
                trial = self._try(current, neutral)
                stays = trial.gain.is_accepted and trial.fitted.share(name) > LIMITS.effect_size
                reason = f"{trial.gain.rule}, and {LIMITS.effect_size:g} of the driving torque"
            self._note(f"add {name}", trial.gain, stays, reason)
            current = trial.fitted if stays else current
        return current

    def _identify(self, fitted: FittedModel) -> tuple[bool, frozenset[tuple]]:
        """Tell models apart by what is known of the numbers, and by the laws of their effects."""
        return self.fits is self.rough, frozenset(_law(name, numbers) for name, numbers in fitted.numbers.items())

    def _next(self, current: FittedModel) -> FittedModel | None:
        """Find the best model with more effects that is accepted."""
        trials = self._try_all(current)
        accepted = [trial for trial in trials if trial.gain.is_accepted]
        best = max(accepted, key=lambda trial: trial.worth, default=None)
        fitted = None
        if self.fits is self.stated and self.passed_by is None:
            fitted = self._try_numbers(current, 0.0 if best is None else best.worth)
        for trial in trials:
            is_best = trial is best and fitted is None
            reason = "most likely" if is_best else "less likely" if trial in accepted else trial.gain.rule
            self._note(describe_change(current.numbers, trial.fitted.numbers), trial.gain, is_best, reason)
        if fitted is not None:
            return fitted
        if best is None:
            self.history.append(Step("add one more effect", None, None, False, "none of them gains enough on the log"))
            return None
        self._tried |= {
            name: [trial for trial in accepted if trial is not best] for name in best.added if name not in current.names
        }
        return best.fitted

    def _try_all(self, current: FittedModel) -> list[Trial]:
        """Try what is proposed, but for what promises far less than others gained that are accepted."""
        trials = list[Trial]()
        # as many effects as numbers are no likelier than that these are off
        before = None if self.fits is self.rough else self.passed_by
        most = _MOST if before is None else len(before.names) + len(self.stated.prior)
        for proposal in self._propose(current) if len(current.names) < most else ():
            if not any(trial.gain.is_accepted and proposal.nats < _PROMISING * trial.gain.nats for trial in trials):
                trials.append(self._try(current, proposal))
        return trials

    def _try_numbers(self, current: FittedModel, worth: float) -> FittedModel | None:
        """Let the model's own numbers be further off than stated, if it is worth more than effects are."""
        fitted = self.rough.fit(current.numbers, current.theta[: len(self.stated.prior)], current)
        trial = Trial((), fitted, self.gain(current, fitted))
        best = trial if trial.gain.is_accepted and trial.worth > worth else None
        if best is not None:
            # it may be one of the numbers alone
            corrections = [
                name for name in self.lacking if current.linear.same(name) is not None and name not in current.names
            ]
            singles = [self._try(current, _Proposal({name: EFFECTS[name].neutral()})) for name in corrections]
            best = max([trial, *(single for single in singles if single.gain.is_accepted)], key=lambda single: single.worth)
        reason = "most likely" if best is trial else "less likely" if trial.gain.is_accepted else trial.gain.rule
        self._note("let all numbers be further off than stated", trial.gain, best is trial, reason)
        if best is trial:
            self.fits, self.passed_by = self.rough, current
        elif best is not None:
            self._note(f"add {best.added[0]}", best.gain, True, "it is one of the numbers alone")
        return None if best is None else best.fitted

    def _try(self, current: FittedModel, proposal: _Proposal) -> Trial:
        """Put more effects into a model, in place of those that cannot stand beside them."""
        new, theta = proposal.numbers, current.theta[: len(self.fits.prior)]
        old = {name: numbers for name, numbers in current.numbers.items() if not any(replaces(other, name) for other in new)}
        announce(f"trying {' + '.join([*old, *new])}")
        promise = proposal.nats if np.isfinite(proposal.nats) else 0.0
        as_proposed = self.fits.fit({**old, **new}, theta + proposal.change, current, tuple(new), promise)
        fitted = self._simplify(as_proposed)
        staying = [name for name in old if name in fitted.names or any(contains(name, plain) for plain in fitted.names)]
        _, before = self._identify(current)
        added = [
            name
            for name, numbers in fitted.numbers.items()
            if _law(name, numbers) not in before and not any(other == name or contains(other, name) for other in staying)
        ]
        if not added:
            return Trial(tuple(new), as_proposed, self.gain(current, as_proposed))
        if len(staying) < len(old):
            # what went stood for the new ones: they are compared with the model that has neither
            current = self._refit(current, {name: old[name] for name in staying})
        return Trial(tuple(added), fitted, self.gain(current, fitted))

    def _refit(self, current: FittedModel, numbers: EffectNumbers, *added: str) -> FittedModel:
        """Fit a model with other effects, from the own numbers of one; `added`: those that are new there."""
        return self._simplify(self.fits.fit(numbers, current.theta[: len(self.fits.prior)], current, added))

    def _exchange(self, current: FittedModel, name: str, law: EffectNumbers | None = None, *added: str) -> FittedModel:
        """Fit a model without one of its effects, or with another law in its place."""
        remaining = {other: numbers for other, numbers in current.numbers.items() if other != name}
        return self._refit(current, {**remaining, **(law or {})}, *added)

    def _simplify(self, fitted: FittedModel) -> FittedModel:
        """Put plain laws in the place of effects that are no more than these beside the others; take out what is nothing."""
        if fitted.foretold is None:
            return fitted
        numbers = dict[str, Numbers]()
        for name, values in fitted.numbers.items():
            if name in self.expected or fitted.counts(name):
                numbers[name] = values
            elif fitted.share(name) > LIMITS.least_torque:
                # where there is no plain law, a model with it cannot be
                numbers |= next(self._plain_laws(fitted, name), {name: values})
        return fitted if numbers == fitted.numbers else self._refit(fitted, numbers)

    def _plain_laws(self, fitted: FittedModel, name: str) -> Iterator[EffectNumbers]:
        """Yield the plain laws of an effect that may stand in its place beside the others, with their numbers."""
        place = name.partition(".")[0]
        for kind, law in EFFECTS[name].plainer(fitted.numbers[name]).items():
            plain = f"{place}.{kind}"
            if plain == name or (plain in self.lacking and plain not in fitted.names):
                yield {plain: law}

    def _reduce(self, current: FittedModel, *, thorough: bool) -> Explanation:
        """Take effects out of a model that gain nothing beside the others or, with special cases in their place, over these;
        and hold its numbers to what is stated of them, if they gain nothing by being further off.

        Returns:
            The model, what each effect gains, and the special cases of each; unless `thorough`, only these are tried. No
            rivals, and nothing that remains.
        """
        while True:
            gains, plainer, fewer = dict[str, Gain](), dict[str, list[Trial]](), None
            for name in current.names:
                certain, plainer[name] = name in self.expected, []
                for law in () if certain else self._plain_laws(current, name):
                    trial = self._ask_for(current, self._exchange(current, name, law), [*law])
                    plainer[name].append(trial)
                    if not trial.gain.is_accepted:
                        fewer = trial.fitted
                        break
                if fewer is None and thorough:
                    trial = self._ask_for(current, self._exchange(current, name), certain=certain)
                    gains[name] = trial.gain
                    fewer = None if certain or trial.gain.is_accepted else trial.fitted
                if fewer is not None:
                    break
            if fewer is None and thorough and self.fits is self.rough:
                less = self.stated.fit(current.numbers, 0.0 * self.stated.prior, current)
                trial = self._ask_for(current, less, change="hold the numbers to what is stated")
                if not trial.gain.is_accepted:
                    self.fits, fewer = self.stated, less
            if fewer is None:
                return Explanation(current, gains, {}, plainer, 0.0)
            current = fewer

    def _ask_for(
        self, current: FittedModel, less: FittedModel, law: Sequence[str] = (), change: str = "", *, certain: bool = False
    ) -> Trial:
        """Ask whether a model gains over one with less, or with a plain `law`, which is to take its place if it does not;
        `certain`: whether it stays anyway."""
        gain = self.gain(less, current)
        change = change or describe_change(current.numbers, less.numbers)
        self._note(change, gain, not (certain or gain.is_accepted), gain.rule, loss=True)
        return Trial(tuple(law), less, gain)

    def _rivals(self, current: FittedModel, name: str) -> list[Trial]:
        """Fit models with another effect in place of one, of the best that were accepted in its round."""
        rivals = list[Trial]()
        for trial in sorted(self._tried.get(name, []), key=lambda trial: -trial.gain.nats)[:2]:
            (other, *more) = trial.added
            if more or other in current.names or contains(other, name) or contains(name, other):
                continue
            if any(replaces(effect, other) or replaces(other, effect) for effect in current.names if effect != name):
                continue
            fitted = self._exchange(current, name, {other: trial.fitted.numbers[other]}, other)
            gain = self.gain(fitted, current)
            reason = f"{name if gain.is_accepted else 'neither'} is better by the same rule"
            self._note(f"replace {name} by {other}", gain, False, reason, loss=True)
            if other in fitted.names:
                rivals.append(trial._replace(fitted=fitted, gain=gain))
        return rivals

    def _try_laws(self, current: FittedModel, name: str) -> list[Trial]:
        """Fit a model with the likeliest other waves of an effect, if it has any, as a fit leaves whole numbers as they are,
        and with finer laws of a memory in its place: no screening along a predictor's path foresees how they change it."""
        waves = {leaf: current.numbers[name][leaf] for leaf in EFFECTS[name].roles("harmonic")}
        with_memory = [law for law in self.lacking if EFFECTS[law].advance is not AbstractEffect.advance]
        laws = [law for law in with_memory if law != name and is_finer_law(law) and replaces(law, name)]
        if not (waves or laws):
            return []
        linear, variants = self._vary(current, [name, *laws])
        suitable = [
            variant
            for variant in variants
            if variant.name != name or any(getattr(variant.effects[0], leaf) != count for leaf, count in waves.items())
        ]
        trials = list[Trial]()
        for proposal in self._rank(linear, current.names, suitable, linear.best_predictor, -np.inf):
            (law,) = proposal.numbers
            trial = self._try(current, proposal)
            gain = self.gain(trial.fitted, current)
            change = f"{name} with other waves" if law == name else describe_change(current.numbers, trial.fitted.numbers)
            self._note(change, gain, False, "what is better by the same rule stays", loss=True)
            trials.append(trial._replace(gain=gain))
        return trials

    def _note(self, change: str, gain: Gain, accepted: bool, reason: str, *, loss: bool = False) -> None:
        nats, z = (-number if loss else number for number in gain[:2])
        self.history.append(Step(change, nats, None if np.isnan(z) else z, accepted, reason))

    # ---- proposals ----

    def _vary(self, current: FittedModel, names: Sequence[str]) -> tuple[Linear, list[Candidate]]:
        """Linearise a model along the log, and list the variants of effects that this may show."""
        linear = self.fits.linearise(current.numbers, current.theta[: len(self.fits.prior)])
        return linear, variants_of(self.fits.nominal, names, linear.scales)

    def _propose(self, current: FittedModel) -> list[_Proposal]:
        """Propose effects that may be missing, most promising first."""
        linear, variants = self._vary(current, [name for name in self.lacking if name not in current.names])
        regression = self._regress(linear, current, variants)
        finer = [law for name, numbers in current.numbers.items() for law in release(name, numbers, linear.scales(name))]
        ranked = self._rank(linear, current.names, variants, linear.best_predictor)
        if ranked:
            # a predictor chosen without an effect makes up for it
            leaders = [linear.choose([proposal.variant]) for proposal in ranked[:_LEADERS]]
            predictor = min(leaders, key=lambda leader: leader.log_square)
            ranked = self._rank(linear, current.names, variants, predictor)
        promised = {proposal.variant.name: proposal for proposal in ranked[:_PROPOSED]}
        by_torque = regression.propose()[:_BY_TORQUE]
        additional = [
            effect for effect in by_torque if effect.name not in promised and effect.share > _PROMISING * by_torque[0].share
        ]
        proposals = [
            proposal
            for name, proposal in promised.items()
            if not any(
                contains(name, other) and proposal.nats < special.nats - LIMITS.general_odds
                for other, special in promised.items()
            )
        ]
        proposals += [
            _Proposal({effect.name: effect.numbers})
            for effect in additional
            if not any(contains(effect.name, other.name) and effect.share < other.share + SHOWN for other in additional)
        ]
        together = regression.propose_together()
        if len(together) > 1:
            proposals.append(_Proposal(together))
        # a screening chooses among their trial values; what they gain it does not foresee, as a memory changes the path
        laws = self._rank(linear, current.names, finer, linear.best_predictor, -np.inf)
        proposals += [law._replace(nats=np.inf) for law in laws]
        return proposals

    def _regress(self, linear: Linear, current: FittedModel, variants: Sequence[Candidate]) -> TorqueRegression:
        """Prepare the regression on what a model lacks; errors of numbers that may change take part, and are no finding."""
        free = {name for name in self.lacking if linear.same(name) is not None and linear.nominal(name) is not None}
        base = [variant for variant in variants if variant.name in free]
        # the recorded input is what is explained
        tested = [variant for variant in variants if variant.name not in free and not variant.name.startswith("actuator.")]
        return TorqueRegression(linear, current.names, self.compare(current).torques, self.log, base, tested)

    def _rank(
        self, linear: Linear, names: Sequence[str], variants: Sequence[Candidate], predictor: Predictor, least: float = 0.0
    ) -> list[_Proposal]:
        """Rank the best variants of effects by the linearised model, of those that promise at `least` so many nats."""
        if not variants or not np.isfinite(predictor.deviation).all():
            # nothing to rank, or no predictor follows this model
            return []
        alone, *models = linear.products(variants, predictor)
        base = evidence_of(alone)
        assert base is not None
        best: dict[str, _Proposal] = {}
        for columns in models:
            variant = columns.candidate
            gone = [name for name in names if name == variant.name or replaces(variant.name, name)]
            evidence = evidence_of(_without(columns, linear, gone))
            if evidence is not None:
                nats = self._nats(linear, base, evidence) - linear.choices(variant.name)
                if nats > (best[variant.name].nats if variant.name in best else least):
                    best[variant.name] = _Proposal(
                        {variant.name: evidence.numbers}, evidence.own_change[: len(self.fits.prior)], nats, variant
                    )
        return sorted(best.values(), key=lambda proposal: -proposal.nats)

    def _nats(self, linear: Linear, base: Evidence, evidence: Evidence) -> float:
        """Tell the gain in evidence where the size of errors is not known."""
        errors = linear.count * len(linear.sides)
        explained = 0.5 * errors * float(np.log(max(base.misfit, 1e-300) / max(evidence.misfit, 1e-300)))
        return evidence.log_evidence - base.log_evidence + 0.5 * (evidence.misfit - base.misfit) + explained

    def find_largest_gain(self, fitted: FittedModel) -> float:
        """Find what a free function gains at most beside a model, nats, of those that are large enough for an effect at the
        most likely size of those tried."""
        linear = fitted.linear
        alone, *models = linear.products(functions_of(linear.signals), linear.best_predictor)
        none, gains = evidence_of(alone), []
        for columns in models:
            best = (-np.inf, 0.0)
            for size in _SIZES:
                scale = columns.scale.copy()
                scale[columns.shared_count :] *= size
                with_function = evidence_of(columns._replace(scale=scale))
                # columns that are all but alike may have no solution
                if none is not None and with_function is not None:
                    nats = self._nats(linear, none, with_function)
                    best = max(best, (nats - min(max(nats, 0.0), self.floor), size * LIMITS.effect_size))
            if best[1] > LIMITS.least_torque:
                gains.append(best[0])
        return max(gains, default=0.0)


def _law(name: str, numbers: Numbers) -> tuple:
    """Identify the law of an effect: its name, its waves, and what it does not hold."""
    return name, *(numbers[leaf] for leaf in EFFECTS[name].roles("harmonic")), *EFFECTS[name].list_released(numbers)


def _without(columns: Products, linear: Linear, names: Collection[str]) -> Products:
    """Change products to those of a model without the torque of some of its effects."""
    gone = [1 + i for i, number in enumerate(linear.free) if owner_of(number)[0] in names]
    change = np.eye(len(columns.scale))
    for k in gone:
        number, theta = linear.free[k - 1], linear.theta[k - 1]
        if number.role == "size":
            change[0, k] = -float(number.value(theta)) / float(number.slope(theta))
    scale = columns.scale.copy()
    scale[gone] = np.inf
    return columns._replace(products=change @ columns.products @ change.T, scale=scale)
