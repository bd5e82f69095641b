"""What a model lacks, from a log: the function behind `jaxbl diagnose`.

Where model and log disagree, which effect is missing, the model with it, and the proof on data that neither the choice nor
the fit has seen.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import numpy as np
import pandas as pd

from jaxbl.config import Config, ConfigSource
from jaxbl.drive.parameters import set_leaves
from jaxbl.errors import InputError
from jaxbl.files import to_jsonable
from jaxbl.identification.logs import Logs, arrays, gains_for
from jaxbl.json_types import JsonObject
from jaxbl.records import POSITION_CHANNELS, Record
from jaxbl.simulate import Experiment
from jaxbl.workers import Progress, announce, limit_blas_threads, make_stage_counter

from .coordinates import CoordinateValues, all_coordinates
from .diagnosis_summary import (
    contradictions_of,
    extended_study,
    observers_say,
    rival_tables,
    summarise_test,
    summary_of,
    trace_of,
    where_lacking,
)
from .diagnosis_task import DiagnosisTask, read_diagnosis_task
from .effect_search import EffectSearch, Explanation, Finding
from .expected_errors import Expected, expected_errors, failed
from .judgement import exchanged, explained_share, is_little, judged
from .localise import SIGNIFICANT, Localised, localise
from .motor_alone import diagnose_alone
from .neutral_effects import without
from .numbers_by_log import contradictions
from .observer_residual import Observed, observed_torques
from .proof import SEEN, SURE, Accepted, Control, Proof, beaten, free_values
from .reference_log import at_period
from .residuals import Residual, SideResiduals, residual_torques
from .setup import Setup, set_up
from .torque_fit import fit_to_torque
from .torque_regression import extended
from .torque_tables import tabulated

_BOUND = 4.0
"""Standard deviations that the model's own numbers may be off where they are held."""
_HIDDEN = 0.3
"""Share of the input: where a torque of that size would not have been seen, noise hides everything."""


@dataclass(frozen=True)
class Diagnosis:
    """What a log says that a model lacks.

    Attributes:
        config: the study, as given.
        model: the study with the missing effects and all numbers fitted anew; it runs in every other command.
        record: the part of the log that was fitted.
        holdout: what was held out: the rest of the log, or another one.
        summary: as in `diagnosis.json`.
        trace: one row a sample of the log: `t`, `u`, positions, `twist`, `held_out`, and on each side the torque that the
            model lacks as given (`motor.missing_before`, its noise is `motor.noise`), with the effects
            (`motor.missing_after`), without one of these (`motor.missing_without.NAME`), and with another one in place of
            the last (`motor.missing_with.NAME`), N m; what the model as given lacks by the observers
            (`motor.observed_before`, `motor.observed_noise`), N m, empty while they converge; and the smoothed
            `motor.velocity`, rad/s, and `motor.acceleration`, rad/s^2.
        residuals: torques that the model as given lacks, by side, of each segment that was fitted.
        observed: the same by the observers' equivalent control.
        coordinates: along them, by side, of each segment.
        located: where the model lacks them, by side.
        pairs: torques that the model lacks as given and with the effects, by side, of each segment, and whether it was held
            out; where that is another log, of that alone.
        replays: whether the model's excitation is to be the log's, for want of one in the study.
    """

    config: Config
    model: Config
    record: Record
    holdout: Record
    summary: JsonObject
    trace: pd.DataFrame
    residuals: SideResiduals
    observed: dict[str, list[Observed]]
    coordinates: dict[str, list[dict[str, CoordinateValues]]]
    located: dict[str, Localised]
    pairs: dict[str, list[tuple[Residual, Residual, bool]]]
    replays: bool


def diagnose(log: Logs, model: ConfigSource, *, holdout: Logs | None = None) -> Diagnosis:
    """Find what a model lacks, add it, and prove on held-out data that the gap shrinks.

    Args:
        log: the file, read as the study's `[log]` table says, or a record; or several of them, of one machine.
        model: study with nominal numbers: TOML file, mapping or config; `[uncertainty]` says how well they are known.
            `[excitation]` and `[observer]` may be missing.
        holdout: another log (or several) of the machine, on which it is proved; left out: the last quarter of the log.

    Raises:
        InputError: unfit log or study, a hold-out log of another machine, or a model that diverges.
    """
    return run_diagnosis(read_diagnosis_task(log, model, holdout=holdout))


_STAGES, _STAGES_ALONE = 6, 3
"""Set-up, search, proof, controls, observers, summary; from the motor alone fit, effects, proof."""


def run_diagnosis(task: DiagnosisTask, progress: Progress | None = None) -> Diagnosis:
    """Do what :func:`jaxbl.diagnosis.diagnosis_task.read_diagnosis_task` read.

    Args:
        task: what to do.
        progress: called with finished and total stages after each.

    Raises:
        InputError: a model that diverges.
    """
    alone = task.config.drive.kind == "two_inertia" and "load" not in task.record.positions
    done = make_stage_counter(_STAGES_ALONE if alone else _STAGES, progress)
    with jax.enable_x64(True), limit_blas_threads():
        if alone:
            found = diagnose_alone(task, done)
            return Diagnosis(
                task.config, found.model, task.record, task.holdout, to_jsonable(found.summary), found.trace,
                {}, {}, {}, {}, {},
                replays="excitation" in task.missing,
            )  # fmt: skip
        announce("smoothing the log")
        setup = set_up(task)
        proof = Proof(setup)
        done()
        announce("comparing effects")
        search, found = _explained(setup)
        done()
        announce("testing on held-out data")
        (search, found, accepted, controls), expected = _proved(proof, search, found)
        fitted, after = accepted.fitted, accepted.after
        done()
        if not np.isfinite(fitted.covariance).all():
            raise InputError(f"{task.record.path}: the model's numbers cannot be fitted to this log; is its input complete?")
        share = explained_share(setup.nominal, proof.before.errors, after.errors, expected)
        apart = contradictions(task, fitted, setup.fitted, setup.holdout, found.model.linear.drive)
        errors = proof.other.with_slow(proof.before), proof.other.with_slow(after)
        judgement = judged(found, fitted, *errors, expected, controls, setup.prior, share, accepted.gains, bool(apart))
        found = judgement.found
        done()
        announce("running the observers")
        missing = _missing(setup, proof, accepted, controls)
        lacking_after, _ = missing["missing_after"]
        on_log, on_holdout = _paired(setup.lacking, lacking_after), _paired(proof.before.torques, after.torques)
        _, gain_values = gains_for(task.missing, fitted.experiment, setup.recorded)
        observing = set_leaves(setup.bare, arrays(gain_values))
        observed = _observed(setup, observing)
        trace = trace_of(setup, missing, observed)
        done()
        summary = summary_of(setup, accepted, found)
        about, notes = observers_say(observing, observed[0], setup)
        for side, one in about.items():
            summary["where"][side]["observed"] = one
        summary["notes"] += notes
        summary["explained_share"] = share
        summary["contradictions"] = contradictions_of(task.record, fitted, apart)
        summary["gap"] = proof.gap(fitted, after) | summarise_test(judgement, *errors, expected, controls)
        if found.verdict == "unknown_effect":
            segments = setup.fitted.segments
            coordinates = all_coordinates(fitted.experiment, segments, lacking_after, setup.sliding)
            left = localise(fitted.experiment, lacking_after, segments, coordinates)
            summary["where_after"] = where_lacking(task.record, left)
        tables = None
        if judgement.failed and not judgement.far:
            tables = tabulated(proof, fitted.experiment, after, lacking_after, setup.sliding)
        if tables is not None:
            summary["torque_tables"] = tables.said()
        if found.wrong is not None:
            summary["rival"] = rival_tables(task.config, setup.own, found.wrong)
        values = free_values(setup.own, fitted.theta) | gain_values
        model = extended_study(task.config, fitted.numbers, values, tables.effects() if tables else ())
        done()
    pairs = {
        side: [*((*one, False) for one in on_log[side] if not task.separate), *((*one, True) for one in on_holdout[side])]
        for side in on_log
    }
    return Diagnosis(
        task.config, model, task.record, task.holdout, to_jsonable(summary), trace, setup.lacking, observed[0],
        setup.coordinates,
        setup.located, pairs, replays="excitation" in task.missing,
    )  # fmt: skip


def _missing(
    setup: Setup, proof: Proof, accepted: Accepted, controls: Sequence[Control]
) -> dict[str, tuple[SideResiduals, SideResiduals]]:
    """Torques that models lack on the log and on what was held out, by names of columns: the model as given, the one with
    the effects, that without each of them, and the one with another effect in place of the last."""
    fitted = accepted.fitted
    others = {f"missing_without.{name}": without(fitted.experiment, name) for name in fitted.names}
    others |= {f"missing_with.{one.effect}": one.experiment for one in controls if one.experiment is not None}
    after = residual_torques(fitted.experiment, setup.fitted.segments), accepted.after.torques
    found = {"missing_before": (setup.lacking, proof.before.torques), "missing_after": after}
    for name, experiment in others.items():
        held: SideResiduals = {}
        # the trace has no samples of another log
        if not setup.task.separate:
            held = residual_torques(at_period(experiment, setup.holdout.period), setup.holdout.segments)
        found[name] = residual_torques(experiment, setup.fitted.segments), held
    return found


def _paired(before: SideResiduals, after: SideResiduals) -> dict[str, list[tuple[Residual, Residual]]]:
    return {side: list(zip(pieces, after[side], strict=True)) for side, pieces in before.items()}


def new_search(setup: Setup, bound: float = np.inf, without: Collection[str] = ()) -> EffectSearch:
    """The search for effects on the log; `bound`: standard deviations that the model's own numbers may be off; `without`:
    effects that are not sought."""
    exact = (*setup.task.config.uncertainty.exact, *without)
    return EffectSearch(setup.bare, setup.own, setup.prior.tolist(), setup.fitted.segments, bound, exact)


def _explained(setup: Setup) -> tuple[EffectSearch, Explanation]:
    """What the log says that the model lacks.

    Where two effects are missing at once, the model's own numbers may go wrong, and hide both. If they do, effects are
    sought with these numbers held near to what is known of them; what that finds counts if its numbers stay there without
    being held, beside something unknown too: numbers that cannot be explain nothing.
    """
    search = new_search(setup)
    found = search.run()
    if not search.plausible(found):
        other = new_search(setup, _BOUND)
        again = other.run()
        if other.plausible(again):
            search, found = other, again
    if found.verdict == "no_discrepancy":
        _check_shown(setup, search.linear({}, np.zeros(len(setup.own))).shown())
    return search, found


class _Proved(NamedTuple):
    """An explanation as far as the held-out data bear it out, the search that found it, and the controls of its model."""

    search: EffectSearch
    found: Explanation
    accepted: Accepted
    controls: list[Control]

    def expected(self, setup: Setup) -> dict[str, Expected]:
        """Errors of a complete model on the held-out data."""
        drive = self.found.model.linear.drive
        return expected_errors(setup.holdout, self.accepted.fitted, self.accepted.after, setup.input_noise, drive)

    def or_better(self, proof: Proof, other: "_Proved", least: float) -> "_Proved":
        """Another one in its place, if the held-out data prefer that by so many standard errors, and not by numbers of the
        model that cannot be."""
        if proof.plausible(self.accepted.fitted) and not proof.plausible(other.accepted.fitted):
            return self
        if not other.accepted.fitted.names or beaten(proof.other, self.accepted.after, other.accepted.after) < least:
            return self
        gone = dict.fromkeys([*self.accepted.withdrawn, *other.accepted.withdrawn])
        named = other.accepted.fitted.names
        accepted = other.accepted._replace(withdrawn=[name for name in gone if name not in named])
        return other._replace(accepted=accepted)

    def by_torque(self, proof: Proof) -> "_Proved":
        """The model with the numbers of least missing torque, if the held-out data prefer them."""
        accepted = self.accepted
        fitted = fit_to_torque(self.search, accepted.fitted, proof.setup.fitted) if accepted.fitted.names else None
        if fitted is None:
            return self
        after = proof.other.compare(fitted.experiment)
        z = beaten(proof.other, accepted.after, after)
        if not z > SEEN or proof.worse(after, proof.before) or not proof.plausible(fitted):
            return self
        controls = proof.controls(self.search, fitted, after, self.found.wrong)
        # a complete model has the same numbers by both
        found = replace(self.found, verdict="unknown_effect")
        return _Proved(self.search, found, accepted._replace(fitted=fitted, after=after, by_torque=z), controls)


def _proved(proof: Proof, search: EffectSearch, found: Explanation) -> tuple[_Proved, dict[str, Expected]]:
    """What the held-out data leave of an explanation, and the errors of a complete model there.

    Where they take effects away, others are sought in their place. Where more is left than a complete model would leave, so
    are those that the missing torque itself shows, and numbers that leave less of it.
    """
    best = _exchanged(proof, search, found)
    if best.accepted.withdrawn:
        other = new_search(proof.setup, search.bound, best.accepted.withdrawn)
        again = other.run()
        if again.model.names not in ((), best.accepted.fitted.names) and other.plausible(again):
            best = best.or_better(proof, _exchanged(proof, other, again), SURE)
    expected = best.expected(proof.setup)
    if failed(proof.other.with_slow(best.accepted.after), expected):
        more = extended(best.search, best.found, best.accepted.fitted, proof.setup.fitted)
        if more is not best.found:
            # the log itself prefers it, too
            better = best.or_better(proof, _exchanged(proof, best.search, more), SEEN)
            if better is not best:
                best, expected = better, better.expected(proof.setup)
    after = best.accepted.after
    share = explained_share(proof.setup.nominal, proof.before.errors, after.errors, expected)
    if failed(proof.other.with_slow(after), expected) or is_little(share):
        better = best.by_torque(proof)
        if better is not best:
            return better, better.expected(proof.setup)
    return best, expected


def _exchanged(proof: Proof, search: EffectSearch, found: Explanation) -> _Proved:
    """As :func:`_proved`; an effect that another one beats on the held-out data changes places with it, once."""
    other: Explanation | None = found
    for _ in range(2):
        found = other or found
        accepted = proof.accepted(search, found)
        if accepted.withdrawn:
            found = search.without(found, accepted.withdrawn)
        controls = proof.controls(search, accepted.fitted, accepted.after, found.wrong)
        other = exchanged(found, controls)
        if other is None:
            break
    for name in accepted.fitted.names:
        plainer = proof.plainer(search, accepted, name)
        if plainer is not None:
            found, accepted = _renamed(search, found, plainer, name), plainer
            controls = proof.controls(search, accepted.fitted, accepted.after, found.wrong)
    return _Proved(search, found, accepted, controls)


def _renamed(search: EffectSearch, found: Explanation, accepted: Accepted, name: str) -> Explanation:
    """An explanation with a special case in place of an effect, as probable as that was."""
    numbers = accepted.fitted.numbers
    (plain,) = set(numbers) - {one.effect for one in found.findings}
    findings = []
    for one in found.findings:
        if one.effect == name:
            others = tuple(other for other in one.alternatives if other[0] != plain)
            one = Finding(plain, one.confidence, numbers[plain], others)
        findings.append(one)
    renamed = search.adopted(found, numbers, accepted.fitted.theta[: len(search.free)], findings)
    # a rival stands beside the same effects
    if found.wrong is not None and name == found.model.names[-1] and found.wrong.names[-1] != plain:
        return replace(renamed, wrong=found.wrong)
    return renamed


def _check_shown(setup: Setup, shown: float) -> None:
    """Refuse to say that nothing is missing where noise hides everything; `shown`: standard deviations by which the log
    shows its input."""
    if shown * _HIDDEN >= SIGNIFICANT:
        return
    record = setup.task.record
    noise = ", ".join(
        f"{value:.2g} {record.statistics.channels[POSITION_CHANNELS[side]].unit} ({POSITION_CHANNELS[side]})"
        for side, value in setup.fitted.noise.items()
    )
    least = SIGNIFICANT / max(shown, 1e-12)
    raise InputError(
        f"{record.path}: noise hides everything: with readings as noisy as {noise}, no torque of less than "
        f"{100.0 * least:.0f} % of the input would be seen; noise {least / _HIDDEN:.2g} times smaller, or torques as many "
        "times larger, are needed"
    )


def _observed(setup: Setup, nominal: Experiment) -> tuple[dict[str, list[Observed]], dict[str, list[Observed]]]:
    """What the observers see on the log, and on what was held out of it; nothing is decided by it."""
    held = {}
    if not setup.task.separate:
        held = observed_torques(at_period(nominal, setup.holdout.period), setup.holdout.segments)
    return observed_torques(nominal, setup.fitted.segments), held
