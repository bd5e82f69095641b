"""Which effects a model lacks on a record: screened on the linearised model, decided by models that have them.

A round: all candidates are screened on the prediction errors of the model so far; of the best, each is put into the
model, its numbers and the model's own refitted (Gauss-Newton through the simulated step, the prior on the nominal numbers
kept), and their evidences compared. The best one stays if it raises the evidence, and the next round begins. In the end
free functions of time, position and velocity are fitted to what remains: one that raises the evidence clearly says that
something else is missing.
"""

import dataclasses
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import softmax

from jaxbl.drive.effects import EFFECTS
from jaxbl.drive.parameters import set_leaves
from jaxbl.identification.free_parameters import PRIOR_DEVIATION, FreeParameter, make_free_parameters
from jaxbl.identification.segments import Segment
from jaxbl.simulate import Experiment
from jaxbl.workers import announce

from .blocks import FLOOR, mean_squares, standard_errors_between
from .candidates import SHARE, Candidate, EffectNumbers, Numbers, are_possible, variants_of
from .evidence import Evidence, evidence_of
from .fitted_model import FittedModel
from .free_functions import functions_of
from .history import Step, describe_change
from .linearised_model import DIVERGED, Linear, Predictor
from .neutral_effects import candidates, complete, corrected
from .refit import refined
from .whittle import Spectrum, spectrum_of

VerdictName = Literal["explained", "no_discrepancy", "unknown_effect", "not_tested"]

ODDS = -2.0
"""Log prior odds of each effect to be missing: a probability of 0.12."""
_FINALISTS, _LEADERS = 5, 3
"""Candidates of a screening that are put into the model, and those that get a Kalman gain of their own before. Each costs a
refit."""
_BEHIND, _NEAR = 0.5, 25.0
"""A finalist is tried if the screening gives it this share of the best one's gain, or a gain within so many nats of it: it
is linear, and may order candidates wrongly."""
FAR = 5.0
"""Standard deviations of a number's prior beyond which it hardly lies (one in a million)."""
_WEAK = 6.0
"""Standard errors of an effect's torque below which the effect is asked for once more: an error of the first fit may be as
large."""
_REFIT_STEPS, _REFIT_SETTLED, _REFIT_GAIN = 15, 2e-3, 0.02
"""Gauss-Newton steps of a refit at most; the relative change of all numbers, and twice the logarithm of the likelihood that
a step may promise, below which it has ended. The last fit is exact (:mod:`.refit`); evidences are compared at this one."""
_LEAST_GAIN = 1e-3
"""Nats; what gains less in a screening gains nothing but rounding."""
_SAME = 3.0
"""Factor up to which a number that gives an effect its shape leaves it what it is: the distance of the values tried."""
_EARNED = 3.0
"""Nats that an effect must gain over its special case to be named in its place: odds of twenty."""
_SHARE_OF_UNKNOWN = 0.2
"""An effect is named beside something unknown if its gain is this share of what a free function gains: known effects that
only imitate the unknown one gain less."""
LEAST_CHANCE = 0.01
"""Alternatives of a lower probability are not listed."""
CLEAR = 100.0
"""Nats that a free function larger than :data:`LEAST` must gain to say that something else is missing: far beyond chance,
since quantisation and time stepping leave structure, too (benchmarks/NOTES.md)."""
_SIZES = 1.0, 0.3, 0.1, 0.03, 0.01, 0.003
"""Prior sizes of a free function that are tried, over :data:`.candidates.SHARE`: down to the least that counts."""
_MOST = 5
"""Effects that are sought: a servo motor shows dry and viscous friction, a constant torque, two waves of cogging."""
_RECENT = 4
"""Models along the record, and refits, that are kept: where one ended the next one begins; some are asked for again."""
LEAST = 1e-3
"""Share of the driving torque that an effect must have to be named; the error of time stepping is a twentieth of it."""


@dataclasses.dataclass(frozen=True)
class Model:
    """A set of effects in the model, all numbers refitted.

    Attributes:
        numbers: of the effects.
        theta: the nominal model's own numbers.
        log_evidence: nats; only differences count.
        log_likelihood: nats; as `log_evidence`.
        linear: the model along the record; effects of other names are in it at neutral numbers, or not at all.
    """

    numbers: dict[str, Numbers]
    theta: np.ndarray
    log_evidence: float
    log_likelihood: float
    linear: Linear

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.numbers)


@dataclasses.dataclass(frozen=True)
class Finding:
    """An effect that is missing.

    Attributes:
        effect: its name.
        confidence: probability that it is this one.
        numbers: of the effect.
        alternatives: other effects that the record does not rule out in its place, and their probabilities.
    """

    effect: str
    confidence: float
    numbers: Numbers
    alternatives: tuple[tuple[str, float], ...]


@dataclasses.dataclass(frozen=True)
class Explanation:
    """What a record says that a model lacks.

    Attributes:
        verdict: as in `diagnosis.json`.
        findings: in the order in which they were found.
        model: the nominal model with the findings, all numbers refitted.
        nominal: the nominal model, its own numbers refitted.
        wrong: the best model with another effect in place of the last finding, or None.
        rest: gain in evidence (nats) of each free function of time, position or velocity, and its most likely size among
            those tried, as a share of the driving torque.
        general: effects that were tried in place of a finding and contain it, and their numbers.
    """

    verdict: VerdictName
    findings: tuple[Finding, ...]
    model: Model
    nominal: Model
    wrong: Model | None
    rest: dict[str, tuple[float, float]]
    general: EffectNumbers = dataclasses.field(default_factory=dict)


class _Scored(NamedTuple):
    """A candidate on the linearised model, judged by the density of its errors whatever the predictor and its variance.

    Attributes:
        found: under a given deviation of the errors.
        count: of samples.
        deviation: of the errors by side, rad; its size, common to both sides, is then the one of largest likelihood.
        name: of the candidate; empty where there is none.
        variant: its index.
    """

    found: Evidence
    count: int
    deviation: np.ndarray
    name: str = ""
    variant: int = -1

    @property
    def log_likelihood(self) -> float:
        errors = self.count * len(self.deviation)
        size = max(self.found.misfit / errors, 1e-300)
        return -0.5 * errors * (np.log(size) + 1.0) - self.count * float(np.sum(np.log(self.deviation)))

    @property
    def log_evidence(self) -> float:
        return self.found.log_evidence + 0.5 * self.found.misfit + self.log_likelihood


class _Tried(NamedTuple):
    """A candidate that was put into the model: its gain in evidence (nats), and its numbers."""

    name: str
    gain: float
    numbers: Numbers


class _Point(NamedTuple):
    """A model at some numbers: sum of squares with the prior's, and the linear step from there and what that promises."""

    linear: Linear
    values: dict[str, Numbers]
    theta: np.ndarray
    found: Evidence
    cost: float
    promised: float


class EffectSearch:
    """The search for missing effects on a record: the record, the nominal model, and the models tried."""

    def __init__(
        self,
        experiment: Experiment,
        free: Sequence[FreeParameter],
        prior: Sequence[float],
        segments: Sequence[Segment],
        bound: float = np.inf,
        exact: Collection[str] = (),
    ):
        """Prepare to explain a record.

        Args:
            experiment: the nominal model, with array leaves; its sample period is that of the record.
            free, prior: its own numbers that are not exactly known, and the relative standard deviation of each.
            segments: of the log.
            bound: standard deviations that each number may be off while effects are sought.
            exact: dotted paths of numbers that are known, and names of effects that are surely not missing.
        """
        self.bound = bound
        self.nominal, self.free, self.prior = complete(experiment), tuple(free), np.asarray(prior)
        self.lacking = [name for name in candidates(experiment) if name not in exact and corrected(name) not in exact]
        self.segments = segments
        self.history: list[Step] = []
        self.period = segments[0].period
        self.floor = FLOOR * sum(map(len, segments)) * len(experiment.sides)
        self._recent: dict[tuple, Linear] = {}
        self._models: dict[tuple, Model] = {}
        self._refitted: tuple[tuple, FittedModel] | None = None

    def fit(self, values: EffectNumbers, theta: np.ndarray) -> FittedModel:
        """The model with some effects, with the numbers of least prediction errors (:mod:`.refit`), its own first."""
        key = _key(values, theta)
        if self._refitted is None or self._refitted[0] != key:
            experiment = with_numbers(self.nominal, values)
            added = make_free_parameters(experiment, paths_of(values), self._torque)
            width = np.concatenate([self.prior, np.full(len(added), PRIOR_DEVIATION)])
            start = np.concatenate([theta, np.zeros(len(added))])
            fitted = refined(experiment, (*self.free, *added), start, width, self.segments)
            self._refitted = key, fitted._replace(names=tuple(values))
        return self._refitted[1]

    def plausible(self, found: Explanation) -> bool:
        """Whether the model's own numbers, fitted to the last digit, are where they may be by what is known of them."""
        theta = self.fit(found.model.numbers, found.model.theta).theta[: len(self.free)]
        return bool(np.all(np.abs(theta) < FAR * self.prior))

    @property
    def _torque(self) -> float:
        """Size of the input, N m."""
        return float(np.std(np.concatenate([one.torque for one in self.segments])))

    def linear(self, values: EffectNumbers, theta: np.ndarray) -> Linear:
        """The model with some effects along the record."""
        key = _key(values, theta)
        if key not in self._recent:
            if len(self._recent) == _RECENT:
                self._recent.pop(next(iter(self._recent)))
            experiment = with_numbers(self.nominal, values)
            added = make_free_parameters(experiment, paths_of(values), self._torque)
            widths = [EFFECTS[name].roles()[leaf].width for name in values for leaf in _fitted_numbers(name)]
            prior, at = np.concatenate([self.prior, widths]), np.concatenate([theta, np.zeros(len(added))])
            bound = np.concatenate([np.full(len(self.free), self.bound), np.full(len(added), np.inf)])
            self._recent[key] = Linear(experiment, (*self.free, *added), at, prior, self.segments, bound)
        return self._recent[key]

    def refit(self, values: EffectNumbers, theta: np.ndarray, predictor: Predictor) -> Model:
        """Put effects into the model and refit everything."""
        key = _key(values, theta), tuple(predictor.smoothness), predictor.deviation.tobytes()
        if key not in self._models:
            if len(self._models) == _RECENT:
                self._models.pop(next(iter(self._models)))
            self._models[key] = self._fitted(values, theta, predictor)
        return self._models[key]

    def _fitted(self, values: EffectNumbers, theta: np.ndarray, predictor: Predictor) -> Model:
        values = {name: dict(numbers) for name, numbers in values.items()}
        best: _Point | None = None
        change = np.zeros(0)
        for _ in range(_REFIT_STEPS):
            point = self._point(values, theta, predictor)
            if best is None or point.cost < best.cost:
                if not np.isfinite(point.cost):
                    break
                best, change = point, np.clip(point.found.own, -1.0, 1.0)
            else:
                change = 0.25 * change
            if np.max(np.abs(change), initial=0.0) < _REFIT_SETTLED or abs(best.promised) < _REFIT_GAIN:
                break
            theta, values = self._moved(best, change)
        if best is None or not are_possible(best.values, self.period):
            last = best or point
            return Model(last.values, last.theta, -np.inf, -np.inf, last.linear)
        scored = _Scored(best.found, best.linear.count, predictor.deviation)
        evidence = scored.log_evidence + len(values) * ODDS - sum(best.linear.choices(name) for name in values)
        return Model(best.values, best.theta, evidence, scored.log_likelihood, best.linear)

    def _point(self, values: dict[str, Numbers], theta: np.ndarray, predictor: Predictor) -> _Point:
        """Cost at some numbers, and where the linear step leads; infinite where they cannot be simulated."""
        found = None
        if any(EFFECTS[name].find_fault(numbers, self.period) for name, numbers in values.items()):
            linear = self.linear({}, theta)
        else:
            linear = self.linear(values, theta)
            columns = linear.columns((), predictor.smoothness, predictor.deviation)
            scale, sizes = columns.scale.copy(), {name: linear.size(name) for name in values}
            for i, one in enumerate(linear.free[len(self.free) :], 1 + len(self.free)):
                if one.role == "size":
                    scale[i] = sizes[_owner(one)[0]]
            if np.max(np.abs(columns.products)) < DIVERGED and np.isfinite(scale[1:]).all():
                found = evidence_of(dataclasses.replace(columns, scale=scale))
        if found is None:
            return _Point(linear, values, theta, Evidence(-np.inf, np.inf, {}, np.zeros(0)), np.inf, 0.0)
        cost = float(columns.products[0, 0] + np.sum((theta / self.prior) ** 2))
        own = len(theta)
        promised = cost - found.misfit - float(np.sum(((theta + found.own[:own]) / self.prior) ** 2))
        return _Point(linear, values, theta, found, cost, promised)

    def _moved(self, point: _Point, change: np.ndarray) -> tuple[np.ndarray, dict[str, Numbers]]:
        count = len(self.free)
        values = {name: dict(numbers) for name, numbers in point.values.items()}
        for one, by in zip(point.linear.free[count:], change[count:], strict=True):
            name, leaf = _owner(one)
            values[name][leaf] = float(one.value(by))
        return point.theta + change[:count], values

    def run(self) -> Explanation:
        """Find what is missing."""
        theta = np.zeros(len(self.free))
        nominal = current = self.refit({}, theta, self.linear({}, theta).choose(()))
        found: dict[str, list[_Tried]] = {}
        wrong: Model | None = None
        rest: dict[str, tuple[float, float]] | None = None
        visited: set[frozenset[str]] = set()
        while len(found) < _MOST:
            # two effects that make each other needless would come and go without end
            if frozenset(current.names) in visited:
                break
            visited.add(frozenset(current.names))
            predictor, tried = self._round(current)
            if not tried or tried[0][0] <= 0.0:
                predictor, tried = self._coloured_round(current)
            if not tried or tried[0][0] <= 0.0:
                self._note_round(current, predictor, tried)
                break
            self._note_round(current, predictor, tried)
            (_, current), *others = tried
            record = [_Tried(model.names[-1], gain, model.numbers[model.names[-1]]) for gain, model in tried]
            pruned = self._pruned(current, predictor.smoothness)
            current = self._note_change(current, pruned, "a later effect has made it needless")
            found = {name: one for name, one in found.items() if name in current.names} | {record[0].name: record}
            simpler, renamed = self._simplified(current, predictor.smoothness)
            current = self._note_change(current, simpler, "the simple effect gains as much as the general one")
            found = {renamed.get(name, name): one for name, one in found.items()}
            for plain in renamed.values():
                first, *rivals = found[plain]
                rivals = [one for one in rivals if one.name != plain]
                found[plain] = [_Tried(plain, first.gain, current.numbers[plain]), *rivals]
            # a rival stands beside the same effects
            rivals = (
                model
                for _, model in others
                if set(model.names[:-1]) == set(current.names[:-1]) and np.isfinite(model.log_evidence)
            )
            wrong = next(rivals, None)
            rest = self.remainder(current)
            # small beside what no effect explains: more of them would only imitate that
            if record[0].gain < _SHARE_OF_UNKNOWN * _most(rest) and _most(rest) > CLEAR:
                break
        rest = self.remainder(current) if rest is None else rest
        left = _most(rest)
        before = current.names
        if left > CLEAR and found:
            fewest, found = self._fewest(current, found, left)
            current = self._note_change(current, fewest, "beside something unknown the fewest numbers are kept")
        if len(current.names) > 1:
            current = self._note_change(current, self._settled(current), "needless with the numbers of the last fit")
            found = {name: tried for name, tried in found.items() if name in current.names}
        if current.names != before:
            # a rival stands beside the same effects
            same = (
                wrong is not None and current.names[-1:] == before[-1:] and set(wrong.names[:-1]) == set(current.names[:-1])
            )
            wrong = wrong if same else None
            # a free function that was needed beside the effect is needed without it, too
            rest = {name: max(rest[name], one) for name, one in self.remainder(current).items()}
            left = _most(rest)
        unknown = f"a free function still gains {left:.3g} nats; {CLEAR:g} show something unknown"
        self.history.append(Step("fit free functions to what remains", left, None, left > CLEAR, unknown))
        heat = self._heat(current) if left > CLEAR and found else 1.0
        findings = tuple(_finding(one, current, heat) for one in found.values())
        general = {one.name: one.numbers for name, tried in found.items() for one in tried if contains(one.name, name)}
        return Explanation(_verdict(left, findings), findings, current, nominal, wrong, rest, general)

    def _note_round(self, before: Model, predictor: Predictor, tried: Sequence[tuple[float, Model]]) -> None:
        """Write down which effects were put into the model, and what became of them."""
        for rank, (gain, model) in enumerate(tried):
            kept = rank == 0 and gain > 0.0
            why = "gains most" if kept else "gains less" if gain > 0.0 else "gains nothing beyond what noise may"
            z = self._standard_errors(before, model, predictor.smoothness)
            self.history.append(Step(describe_change(before.numbers, model.numbers), gain, z, kept, why))
        if not tried:
            self.history.append(Step("add one more effect", None, None, False, "none of them gains anything on the log"))

    def _note_change(self, before: Model, after: Model, why: str) -> Model:
        """The second model; written down if it has other effects."""
        if set(before.names) != set(after.names):
            z = self._standard_errors(before, after, after.linear.choose(()).smoothness)
            nats = after.log_evidence - before.log_evidence
            self.history.append(Step(describe_change(before.numbers, after.numbers), nats, z, True, why))
        return after

    def _standard_errors(self, before: Model, after: Model, smoothness: Sequence[float]) -> float:
        """Count the standard errors by which one model's prediction errors are below another's, by blocks of the log."""
        costs = []
        for model in (before, after):
            errors, deviation = np.concatenate(model.linear.left(smoothness)), before.linear.predictor(smoothness).deviation
            costs.append(mean_squares(errors, deviation))
        return standard_errors_between(*costs)

    def _heat(self, model: Model) -> float:
        """Find by how much evidence is overstated where errors are correlated: variance of the effects' numbers over what it
        were without correlation, the largest (tempered likelihood; P. Gruenwald, T. van Ommen, Bayesian Analysis 12, 2017).
        """
        best, own = self.fit(model.numbers, model.theta), len(self.free)
        variance, white = (np.diag(one)[own:] for one in (best.covariance, best.white))
        return max(float(np.max(variance / np.maximum(white, 1e-300), initial=1.0)), 1.0)

    def without(self, found: Explanation, names: Collection[str]) -> Explanation:
        """An explanation without some of its effects; free functions are fitted anew to what remains."""
        model = found.model
        kept = {name: numbers for name, numbers in model.numbers.items() if name not in names}
        # where nothing is kept, its own numbers have nothing to do with those beside effects
        theta = model.theta if kept else found.nominal.theta
        model = self.refit(kept, theta, model.linear.choose(()))
        rest = self.remainder(model)
        findings = tuple(one for one in found.findings if one.effect in kept)
        return Explanation(_verdict(_most(rest), findings), findings, model, found.nominal, None, rest, found.general)

    def adopted(
        self, found: Explanation, numbers: EffectNumbers, theta: np.ndarray, findings: Sequence[Finding]
    ) -> Explanation:
        """An explanation with other effects and numbers; free functions are fitted anew to what remains."""
        values = {name: dict(one) for name, one in numbers.items()}
        model = dataclasses.replace(found.model, numbers=values, theta=theta, linear=self.linear(values, theta))
        rest = self.remainder(model)
        return Explanation(_verdict(_most(rest), findings), tuple(findings), model, found.nominal, None, rest, found.general)

    def _fewest(self, model: Model, found: dict[str, list[_Tried]], left: float) -> tuple[Model, dict[str, list[_Tried]]]:
        """Where something unknown remains: only effects with a good part of its gain, and of those that differ by less than
        it the one with the fewest numbers, since spare numbers imitate the unknown."""
        predictor = model.linear.choose(())
        kept = {name: tried for name, tried in found.items() if tried[0].gain > _SHARE_OF_UNKNOWN * left}
        model = self.refit({name: model.numbers[name] for name in kept}, model.theta, predictor)
        for name, tried in list(kept.items()):
            fewer = [one for one in tried[1:] if len(one.numbers) < len(tried[0].numbers)]
            others = [one for one in fewer if one.gain > tried[0].gain - left]
            others = [one for one in others if one.name not in kept and not exclusive(one.name, set(kept) - {name})]
            for one in sorted(others, key=lambda one: (len(one.numbers), -one.gain))[:1]:
                numbers = {a: model.numbers[a] for a in model.names if a != name} | {one.name: one.numbers}
                plainer = self.refit(numbers, model.theta, predictor)
                if model.log_evidence - plainer.log_evidence < left:
                    model = plainer
                    kept = {(one.name if a == name else a): b for a, b in kept.items()}
                    # beside something unknown the two are as likely
                    equal = one._replace(gain=tried[0].gain)
                    kept[one.name] = [equal, *(other for other in tried if other.name != one.name)]
        return model, kept

    def _pruned(self, model: Model, smoothness: Sequence[float]) -> Model:
        """A model without the earlier effects that a later one has made needless."""
        for name in model.names[:-1]:
            model = self._needless(name, model.numbers, model.theta, model.linear.predictor(smoothness)) or model
        return model

    def _needless(self, name: str, numbers: EffectNumbers, theta: np.ndarray, predictor: Predictor) -> Model | None:
        """The model without one of its effects, all numbers refitted, if the effect gains nothing beside the others, and
        these do not become something else to stand for it: friction over a long way is a spring."""
        full = self.refit(numbers, theta, predictor)
        # no refit where the loss would be far too large even if others could take half of it over
        if 0.5 * _linear_loss(full.linear, name, predictor) > self.floor + CLEAR:
            return None
        less = self.refit({one: values for one, values in numbers.items() if one != name}, theta, predictor)
        return less if self._gain(less, full) <= 0.0 and not _changed(full, less) else None

    def _settled(self, model: Model) -> Model:
        """A model without effects that are needless once all numbers are those of least prediction errors: one may only have
        compensated for an error of the fit along the smoothed motion."""
        best, count = self.fit(model.numbers, model.theta), len(self.free)
        numbers = {name: dict(one) for name, one in model.numbers.items()}
        weak: set[str] = set()
        for one, at, by in zip(best.linear.free[count:], best.theta[count:], best.deviation[count:], strict=True):
            name, leaf = _owner(one)
            numbers[name][leaf] = float(one.value(at))
            if one.role == "size" and abs(numbers[name][leaf]) < _WEAK * float(one.slope(at)) * by:
                weak.add(name)
        theta = best.theta[:count]
        for name in sorted(weak, key=model.names.index, reverse=True):
            if len(model.names) == 1:
                break
            less = self._needless(name, numbers, theta, self.linear(numbers, theta).choose(()))
            if less is not None:
                model, numbers, theta = less, less.numbers, less.theta
        return model

    def _simplified(self, model: Model, smoothness: Sequence[float]) -> tuple[Model, dict[str, str]]:
        """A model in which simpler effects take the place of those that contain them and gain nothing over them, and the
        effects' new names."""
        renamed: dict[str, str] = {}
        for name in model.names:
            for kind, reduced in EFFECTS[name].special_cases.items():
                plain = f"{name.partition('.')[0]}.{kind}"
                if plain not in self.lacking or plain in model.names or name in renamed:
                    continue
                predictor = model.linear.predictor(smoothness)
                full = self.refit(model.numbers, model.theta, predictor)
                numbers = {plain if a == name else a: b for a, b in full.numbers.items()}
                numbers[plain] = reduced(full.numbers[name])
                less = self.refit(numbers, full.theta, predictor)
                if self._gain(less, full) <= 0.0:
                    model, renamed = less, renamed | {name: plain}
        return model, renamed

    def _round(self, current: Model) -> tuple[Predictor, list[tuple[float, Model]]]:
        """Models with one effect more, and their gains in evidence (nats), best first."""
        predictor = current.linear.choose(())
        current = self.refit(current.numbers, current.theta, predictor)
        predictor, finalists = self._screen(current, predictor)
        if not finalists:
            return predictor, []
        base = self.refit(current.numbers, current.theta, predictor)
        # under the predictor that suits it best
        base = max(base, current, key=lambda one: one.log_evidence)
        tried: list[tuple[float, Model]] = []
        best = finalists[0][0]
        for screened, one in finalists:
            # those far behind are tried only if none before them gained
            behind = screened < max(min(_BEHIND * best, best - _NEAR), 0.0)
            if behind and any(gain > 0.0 for gain, _ in tried):
                break
            model = self._with(current, one, predictor)
            tried.append((self._gain(base, model) if self._is_felt(model) else -np.inf, model))
        gains = {model.names[-1]: gain for gain, model in tried}
        # of an effect and its special case the simpler one, unless the other is clearly better
        tried = [
            (gain, model)
            for gain, model in tried
            if not any(contains(model.names[-1], name) and gain < other + _EARNED for name, other in gains.items())
        ]
        return predictor, sorted(tried, key=lambda pair: -pair[0])

    def _coloured_round(self, current: Model) -> tuple[Predictor, list[tuple[float, Model]]]:
        """As :meth:`_round` by Whittle's likelihood, where errors are not white; without those that gain nothing."""
        linear = current.linear
        predictor = linear.choose(())
        if not np.isfinite(predictor.deviation).all():
            return predictor, []
        spectrum = spectrum_of(linear.left(predictor.smoothness))
        if not spectrum.coloured:
            return predictor, []
        base, ranked = self._ranked(linear, self._variants(current), predictor.smoothness, spectrum)
        tried = []
        for one in ranked[:_FINALISTS]:
            gain = self._gain(base, one) + ODDS - linear.choices(one.name)
            if gain > 0.0:
                model = self._with(current, one, predictor)
                if self._is_felt(model):
                    tried.append((gain, model))
        return predictor, sorted(tried, key=lambda pair: -pair[0])

    def _with(self, current: Model, one: _Scored, predictor: Predictor) -> Model:
        """A model with one effect more, in place of its special cases, refitted from the numbers of the screening."""
        numbers = {name: values for name, values in current.numbers.items() if not contains(one.name, name)}
        numbers[one.name] = one.found.numbers
        announce(f"trying {' + '.join(numbers)}")
        return self.refit(numbers, current.theta + one.found.own[: len(self.free)], predictor)

    def _is_felt(self, model: Model) -> bool:
        """Tell whether a model can be simulated, and its last effect has a torque that counts."""
        return bool(np.isfinite(model.log_evidence)) and model.linear.share(model.names[-1]) > LEAST

    def remainder(self, model: Model) -> dict[str, tuple[float, float]]:
        """Gain in evidence of free functions beside a model (nats), and their size over the driving torque, by name."""
        rest = self._remainder(model.linear)
        if _most(rest) > CLEAR:
            # errors of the smoothed motion cancel to first order only; along the predictor's own path nothing is approximate
            rest = self._remainder(self.fit(model.numbers, model.theta).linear)
        return rest

    def _remainder(self, linear: Linear) -> dict[str, tuple[float, float]]:
        predictor, functions = linear.choose(()), functions_of(linear.signals)
        columns = linear.columns(functions, predictor.smoothness, predictor.deviation)
        gained = {}
        for i, one in enumerate(functions):
            best = (-np.inf, 0.0)
            for size in _SIZES:
                scale = columns.scale.copy()
                scale[list(columns.places[i])] *= size
                sized = dataclasses.replace(columns, scale=scale)
                none, some = evidence_of(sized), evidence_of(sized, functions, i)
                assert none is not None and some is not None
                base, more = (_Scored(found, linear.count, predictor.deviation) for found in (none, some))
                best = max(best, (self._gain(base, more), size * SHARE))
            gained[one.name] = best
        return gained

    def _gain(self, base: Model | _Scored, model: Model | _Scored) -> float:
        """Gain in evidence of a model's effect (nats), less what structure in the noise may bring (:data:`FLOOR`)."""
        if not np.isfinite([base.log_evidence, model.log_evidence]).all():
            # one of them diverges
            return -np.inf
        explained = model.log_likelihood - base.log_likelihood
        return model.log_evidence - base.log_evidence - min(max(explained, 0.0), self.floor)

    def _screen(self, model: Model, predictor: Predictor) -> tuple[Predictor, list[tuple[float, _Scored]]]:
        """The best candidates on the linearised model with their gains, and the predictor chosen with the first of them."""
        linear = model.linear
        predictor = linear.choose((), predictor.smoothness)
        variants = self._variants(model)
        _, ranked = self._ranked(linear, variants, predictor.smoothness, predictor.deviation)
        if not ranked:
            return predictor, []
        # a predictor chosen without an effect compensates for it: the best ones are tried with predictors of their own
        leaders = [linear.choose([variants[one.variant]]) for one in ranked[:_LEADERS]]
        few = {one.name for one in ranked[: 2 * _FINALISTS]}
        variants = [one for one in variants if one.name in few]
        predictor = min(leaders, key=lambda one: float(np.sum(np.log(one.deviation))))
        # compared with the model without them under the same predictor
        base, ranked = self._ranked(linear, variants, predictor.smoothness, predictor.deviation)
        gains = [(self._gain(base, one), one) for one in ranked[:_FINALISTS]]
        finalists = sorted((pair for pair in gains if pair[0] > _LEAST_GAIN), key=lambda pair: -pair[0])
        if finalists:
            best = variants[finalists[0][1].variant]
            predictor = linear.choose([best], predictor.smoothness)
        return predictor, finalists

    def _variants(self, model: Model) -> list[Candidate]:
        """Effects that a model lacks, at what was chosen last for it."""
        lacking = [name for name in self.lacking if name not in model.names and not exclusive(name, model.names)]
        return variants_of(self.nominal, lacking, model.linear.scales)

    def _ranked(
        self, linear: Linear, variants: Sequence[Candidate], smoothness: Sequence[float], noise: np.ndarray | Spectrum
    ) -> tuple[_Scored, list[_Scored]]:
        """The model without candidates, and with the best variant of each, best first."""
        columns = linear.columns(variants, smoothness, noise)
        # errors over their spectrum are of size 1
        deviation = np.ones(len(linear.sides)) if isinstance(noise, Spectrum) else noise
        none = evidence_of(columns)
        assert none is not None
        each = [
            _Scored(found, linear.count, deviation, one.name, i)
            for i, one in enumerate(variants)
            if (found := evidence_of(columns, variants, i)) is not None
        ]
        best: dict[str, _Scored] = {}
        for one in sorted(each, key=lambda one: -one.found.log_evidence):
            best.setdefault(one.name, one)
        return _Scored(none, linear.count, deviation), list(best.values())


def exclusive(name: str, others: Iterable[str]) -> bool:
    """Whether an effect cannot stand beside one that is there: of dry friction a side has one law."""
    word, place = EFFECTS[name].exclusive, name.partition(".")[0]
    return word is not None and any(EFFECTS[one].exclusive == word and one.partition(".")[0] == place for one in others)


def contains(general: str, name: str) -> bool:
    """Whether an effect has another one at the same place as its special case."""
    place, _, kind = name.partition(".")
    return general.partition(".")[0] == place and kind in EFFECTS[general].special_cases


def _changed(before: Model, after: Model) -> bool:
    """Whether an effect's speed, length or time has changed by more than a factor (:data:`_SAME`)."""
    for name, numbers in after.numbers.items():
        for leaf in [leaf for leaf, role in EFFECTS[name].roles().items() if role.kind == "shape"]:
            now, then = abs(numbers[leaf]), abs(before.numbers[name][leaf])
            if not then <= _SAME * now <= _SAME**2 * then:
                return True
    return False


def _linear_loss(linear: Linear, name: str, predictor: Predictor) -> float:
    """Log-likelihood that a linearised model would lose without the torque of one of its effects, all other numbers at their
    best (nats); 0 where it has no number that its torque is proportional to."""
    gone = np.array([one.role == "size" and _owner(one)[0] == name for one in linear.free])
    columns = linear.columns((), predictor.smoothness, predictor.deviation)
    scale = columns.scale[1:]
    if not gone.any() or not np.isfinite(scale[gone]).all() or not np.max(np.abs(columns.products)) < DIVERGED:
        return 0.0
    precision = np.where(gone, 0.0, scale**-2.0)
    matrix = columns.products[1:, 1:] + np.diag(precision)
    towards = columns.products[1:, 0] - precision * columns.centre[1:]
    change = np.array(
        [-float(one.value(at)) / float(one.slope(at)) for one, at in zip(linear.free, linear.theta, strict=True)]
    )

    def least(free: np.ndarray) -> float:
        fixed = np.where(free, 0.0, change)
        at = (towards + matrix @ fixed)[free]
        gained = at @ np.linalg.lstsq(matrix[np.ix_(free, free)], at, rcond=1e-12)[0]
        return float(columns.products[0, 0] + 2.0 * towards @ fixed + fixed @ matrix @ fixed - gained)

    alive = np.isfinite(scale)
    errors = linear.count * len(linear.sides)
    with_it, without = least(alive), least(alive & ~gone)
    return 0.5 * errors * float(np.log(without / with_it)) if 0.0 < with_it < without else 0.0


def _verdict(left: float, findings: Sequence[Finding]) -> VerdictName:
    return "unknown_effect" if left > CLEAR else "explained" if findings else "no_discrepancy"


def _most(rest: Mapping[str, tuple[float, float]]) -> float:
    """Largest gain of the free functions that are large enough for an effect."""
    return max((gain for gain, share in rest.values() if share > LEAST), default=0.0)


def _key(values: EffectNumbers, theta: np.ndarray) -> tuple:
    return (*((name, *numbers.items()) for name, numbers in values.items()), theta.tobytes())


def _finding(tried: Sequence[_Tried], model: Model, heat: float) -> Finding:
    """The first of those tried, with its confidence; differences of evidence are divided by `heat`."""
    name = tried[0].name
    # one that contains it is no other explanation
    tried = [one for one in tried if not contains(one.name, name)]
    # or nothing is missing
    *chances, _ = softmax(np.array([*(one.gain for one in tried), 0.0]) / heat)
    others = tuple((one.name, float(chance)) for one, chance in zip(tried[1:], chances[1:], strict=True))
    others = tuple(one for one in others if one[1] > LEAST_CHANCE)
    return Finding(name, float(chances[0]), model.numbers[name], others)


def _fitted_numbers(name: str) -> list[str]:
    """The numbers of an effect that are fitted: a harmonic is a whole number, and some are held."""
    return [leaf for leaf, role in EFFECTS[name].roles().items() if role.kind not in ("harmonic", "held")]


def paths_of(names: Iterable[str]) -> list[str]:
    """Dotted paths of the free numbers of effects."""
    return [f"effects.{name}.{leaf}" for name in names for leaf in _fitted_numbers(name)]


def _owner(one: FreeParameter) -> tuple[str, str]:
    """The effect that a number is of, and its name there."""
    name, _, leaf = one.path.removeprefix("effects.").rpartition(".")
    return name, leaf


def with_numbers(experiment: Experiment, values: EffectNumbers) -> Experiment:
    """A model with all effects (:func:`.neutral_effects.complete`), some of them with these numbers."""
    return set_leaves(
        complete(experiment, values),
        {
            f"effects.{name}.{leaf}": np.asarray(value, float)
            for name, numbers in values.items()
            for leaf, value in numbers.items()
        },
    )
