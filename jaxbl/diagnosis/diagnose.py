"""What a model lacks, from a log: the function behind `jaxbl diagnose`.

Where model and log disagree, which effect is missing, the model with it, and the proof on data that neither the choice nor
the fit has seen.
"""

from dataclasses import dataclass

import jax
import numpy as np
import pandas as pd

from jaxbl.config import Config, ConfigSource
from jaxbl.drive.parameters import set_leaves
from jaxbl.errors import InputError
from jaxbl.estimation.feedback_bias import find_feedback_bias
from jaxbl.estimation.free_parameters import free_values
from jaxbl.estimation.logs import Logs, arrays
from jaxbl.estimation.observer_gains import gains_for
from jaxbl.files import to_jsonable
from jaxbl.json_types import JsonObject
from jaxbl.records import POSITION_CHANNELS, Record
from jaxbl.workers import Progress, announce, limit_blas_threads, make_stage_counter

from .choice import Choice, Chosen
from .confidence import explained_share
from .coordinates import SideCoordinates, all_coordinates
from .diagnosis_summary import (
    describe_gap,
    describe_observers,
    extended_study,
    rival_tables,
    summary_of,
    trace_of,
    where_lacking,
)
from .diagnosis_task import DiagnosisTask, read_diagnosis_task
from .judgement import judge
from .localise import Localised, localise
from .motor_alone import diagnose_alone
from .neutral_effects import without
from .numbers_by_log import contradictions
from .observer_residual import SideObserved, observed_torques
from .proof import Proof, prove
from .residuals import Residual, SideResiduals
from .setup import Setup, set_up
from .thresholds import LIMITS


@dataclass(frozen=True)
class Diagnosis:
    """A diagnosis of a model by a log.

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
    observed: SideObserved
    coordinates: SideCoordinates
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
"""Set-up, search, model, proof, observers, summary; from the motor alone fit, effects, proof."""


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
            model, held_out, summary, trace = diagnose_alone(task, done)
            return Diagnosis(
                task.config, model, task.record, held_out, to_jsonable(summary), trace,
                {}, {}, {}, {}, {},
                replays="excitation" in task.missing,
            )  # fmt: skip
        announce("smoothing the log")
        choice = Choice(set_up(task))
        done()
        announce("comparing effects")
        chosen = choice.choose()
        setup = choice.setup
        if chosen.verdict == "no_discrepancy":
            _check_input_shown(setup, choice.search.fits.given.find_input_significance())
        done()
        fitted, lacking_after = chosen.fitted, setup.fitted.find_lacking(chosen.fitted.experiment)
        if not np.isfinite(fitted.covariance).all():
            raise InputError(f"{task.record.path}: the model's numbers cannot be fitted to this log; is its input complete?")
        tables = choice.tabulate(chosen, lacking_after)
        _, gain_values = gains_for(task.missing, fitted.experiment, setup.recorded)
        values = free_values(setup.free, fitted.theta) | gain_values
        model = extended_study(task, fitted.numbers, values, tables.effects() if tables else ())
        done()
        # the model stands; only now what was held out is read
        announce("testing on held-out data")
        proof = prove(setup, chosen)
        # of an effect that does not act there nothing is said
        confirmed = tuple(finding.confirm(proof.holdout_z.get(finding.effect, np.inf)) for finding in chosen.findings)
        chosen = chosen._replace(findings=confirmed)
        share = explained_share(setup.nominal, proof.before.errors, proof.after.errors, proof.expected)
        apart = contradictions(task, fitted, setup.fitted, chosen.driving)
        judgement = judge(chosen, proof, share, bool(apart))
        done()
        announce("running the observers")
        missing = _missing(setup, proof, chosen, lacking_after)
        observing = set_leaves(setup.bare, arrays(gain_values))
        # nothing is decided by them
        unseen = {} if task.separate else observed_torques(observing, proof.log.segments)
        observed = observed_torques(observing, setup.fitted.segments), unseen
        trace = trace_of(setup, proof, missing, observed)
        done()
        summary = summary_of(setup, chosen, choice.search.history, proof.holdout_z) | {
            "verdict": judgement.verdict,
            "explained_share": share,
        }
        views, notes = describe_observers(observing, observed[0], setup)
        for side, witness in views.items():
            summary["where"][side]["observed"] = witness
        summary["feedback"] = find_feedback_bias(task.record, setup.fitted.segments, fitted.experiment)
        summary["notes"] += [there["sentence"] for there in summary["feedback"].values()] + notes
        summary["contradictions"] = apart
        summary["gap"] = describe_gap(setup, proof, judgement)
        if judgement.verdict == "unknown_effect":
            segments = setup.fitted.segments
            coordinates = all_coordinates(fitted.experiment, segments, lacking_after, setup.sliding)
            left = localise(fitted.experiment, lacking_after, segments, coordinates)
            summary["where_after"] = where_lacking(task.record, left)
        if tables is not None:
            summary["torque_tables"] = tables.summarise(proof.log, proof.after)
        if chosen.rival is not None:
            summary["rival"] = rival_tables(setup, chosen.rival)
        done()
    before, after = missing["missing_before"], missing["missing_after"]
    pairs = {
        side: [
            (*pair, bool(part))
            for part in ([1] if task.separate else [0, 1])
            for pair in zip(before[part][side], after[part][side], strict=True)
        ]
        for side in setup.lacking
    }
    return Diagnosis(
        task.config, model, task.record, proof.record, to_jsonable(summary), trace, setup.lacking, observed[0],
        setup.coordinates,
        setup.located, pairs, replays="excitation" in task.missing,
    )  # fmt: skip


def _missing(
    setup: Setup, proof: Proof, chosen: Chosen, lacking_after: SideResiduals
) -> dict[str, tuple[SideResiduals, SideResiduals]]:
    """Torques that models lack on the log and on what was held out, by names of columns: the model as given, the one with
    the effects, that without each of them, and the one with another effect in place of one."""
    fitted = chosen.fitted
    reduced = {f"missing_without.{name}": without(fitted.experiment, name) for name in fitted.names}
    if chosen.rival is not None:
        reduced[f"missing_with.{chosen.rival.added[0]}"] = chosen.rival.fitted.experiment
    after = lacking_after, proof.after.torques
    missing = {"missing_before": (setup.lacking, proof.before.torques), "missing_after": after}
    for name, experiment in reduced.items():
        # the trace has no samples of another log
        held_out = {} if setup.task.separate else proof.log.find_lacking(experiment)
        missing[name] = setup.fitted.find_lacking(experiment), held_out
    return missing


def _check_input_shown(setup: Setup, deviations: float) -> None:
    """Refuse to say that nothing is missing where noise hides everything; `deviations`: standard deviations by which the log
    shows its input."""
    if deviations * LIMITS.effect_size >= LIMITS.significant:
        return
    record = setup.task.record
    noise = ", ".join(
        f"{value:.2g} {record.statistics.channels[POSITION_CHANNELS[side]].unit} ({POSITION_CHANNELS[side]})"
        for side, value in setup.fitted.noise.items()
    )
    least = LIMITS.significant / max(deviations, 1e-12)
    raise InputError(
        f"{record.path}: noise hides everything: with readings as noisy as {noise}, no torque of less than "
        f"{100.0 * least:.0f} % of the input would be seen; noise {least / LIMITS.effect_size:.2g} times smaller, or "
        "torques as many times larger, are needed"
    )
