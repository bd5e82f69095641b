"""Parameters of a machine from its log: the function behind `jaxbl identify`.

A trajectory fit with intervals, and beside it the paper's chain, the study's observers run on the recorded positions with
the recursive identifier (27)-(28) on their equivalent control.
"""

import dataclasses
from collections.abc import Callable, Sequence

import jax
import numpy as np
import pandas as pd

from jaxbl.chain import Experiment
from jaxbl.config import Config, ConfigSource, read_model, with_values
from jaxbl.drive.parameters import set_leaves
from jaxbl.errors import InputError
from jaxbl.files import to_jsonable
from jaxbl.json_types import JsonObject
from jaxbl.quantity import Quantity, read_quantities
from jaxbl.records import Record
from jaxbl.workers import Progress, limit_blas_threads, make_stage_counter

from .feedback_bias import find_feedback_bias
from .free_parameters import FreeParameter, free_values, make_free_parameters
from .identification_summary import mark_lacking, on_holdout, summary_of, torque_errors
from .intervals import profile
from .log_columns import columns_of, note_damping, observer_chain
from .logs import Logs, LogTask, SealedRecord, arrays, decimation, default_paths, on_record, read_with_holdout
from .motor_alone import alone_on_holdout, columns_alone, gap_summary, search_alone
from .observer_gains import gains_for
from .regression import find_motion_share, remembers_input
from .search import ParameterSearch
from .segments import Segment, long_enough, segments_of, signal_sizes, skip_unknown_input


@dataclasses.dataclass(frozen=True)
class Identification:
    """A machine as its log shows it.

    Attributes:
        config: the study, with its nominal numbers.
        model: the study with the numbers found.
        record: the log, or the logs one after the other.
        summary: as in `identification.json`.
        trace: one row a sample: `t`, `u`, positions, `transmitted` where it was measured, smoothed velocities and
            accelerations with standard deviations, residuals of the fit (rad), torques by the fitted model at the smoothed
            motion (`torque` of the law, `motor.effects`, `load.effects`), and what the observers and the recursive
            identifier make of the record.
        replays: whether the model's excitation is to be the log's, for want of one in the study.
    """

    config: Config
    model: Config
    record: Record
    summary: JsonObject
    trace: pd.DataFrame
    replays: bool

    @property
    def parameters(self) -> dict[str, Quantity]:
        """The numbers found, by path, with standard errors, 95 % intervals, units and nominal values."""
        return read_quantities(self.summary["parameters"])


def read_identification_task(
    log: Logs,
    model: ConfigSource,
    *,
    parameters: Sequence[str] | None = None,
    holdout: Logs | None = None,
    profile: bool | None = None,
) -> LogTask:
    """Read study and logs; arguments as of :func:`identify`.

    Raises:
        InputError: unfit log or study.
    """
    config, missing = read_model(model)
    if parameters is not None:
        config = config.with_keys("identify", parameters=list(parameters))
    if profile is not None:
        config = config.with_keys("identify", profile=profile)
    record, other = read_with_holdout(config, log, holdout)
    if any(remembers_input(effect.build()) for effect in config.effects):
        at_rest = config.log.initial_state == "rest"
        record, other = skip_unknown_input(record, at_rest), None if other is None else skip_unknown_input(other, at_rest)
    return LogTask(config, missing, record, None if other is None else SealedRecord(other))


def identify(
    log: Logs,
    model: ConfigSource,
    *,
    parameters: Sequence[str] | None = None,
    holdout: Logs | None = None,
    profile: bool | None = None,
) -> Identification:
    """Identify a machine from its log.

    Args:
        log: the file, read as the study's `[log]` table says, or a record; or several of them, of one machine.
        model: study with nominal numbers: TOML file, mapping or config. `[excitation]` and `[observer]` may be missing: the
            input is the log's, and gains are chosen on it.
        parameters: dotted paths of the numbers to find, in place of `[identify] parameters`.
        holdout: another log (or several) of the machine, on which the model found is tried out.
        profile: whether to compute profile-likelihood intervals, in place of `[identify] profile`.

    Raises:
        InputError: unfit log or study, or a number that cannot be fitted.
    """
    return run_identification(read_identification_task(log, model, parameters=parameters, holdout=holdout, profile=profile))


_STAGES, _STAGES_ALONE = 6, 3
"""Smoothing, search, profiles, observers, columns of the trace, summary; from the motor alone the first two and the last."""


def run_identification(task: LogTask, progress: Progress | None = None) -> Identification:
    """Do what :func:`read_identification_task` read; `progress` is called with finished and total stages after each.

    Raises:
        InputError: a number that cannot be fitted, or a log that the model cannot follow.
    """
    config, record, settings = task.config, task.record, task.config.identify
    assert record.torque is not None
    alone = config.drive.kind == "two_inertia" and "load" not in record.positions
    done = make_stage_counter(_STAGES_ALONE if alone else _STAGES, progress)
    with jax.enable_x64(True), limit_blas_threads():
        nominal = on_record(config, record)
        paths = list(settings.parameters or default_paths(config, nominal))
        if not paths:
            raise InputError("model: no number to identify: all are in [uncertainty] exact; take one out")
        at_rest, sides = config.log.initial_state == "rest", [side for side in nominal.sides if side in record.positions]
        segments = segments_of(record, sides, at_rest)
        free = make_free_parameters(nominal, paths, signal_sizes(nominal, segments))
        done()
        if alone:
            return _from_motor(task, nominal, free, segments, done)
        search_fit = ParameterSearch(nominal, segments, settings, at_rest=at_rest, name=str(record.path)).run(free)
        done()
        # by NumPy, as in the summary: JAX's exponential function may differ in the last digit
        values = free_values(search_fit.free, search_fit.fit.theta)
        fitted = set_leaves(nominal, arrays(values))
        profiles = {}
        if settings.profile:
            profiles = profile(nominal, search_fit.free, search_fit.windows, search_fit.fit, search_fit.spread)
        done()
        gains, gain_values = gains_for(task.missing, fitted, segments)
        chain, recursive = observer_chain(set_leaves(fitted, arrays(gain_values)), segments, len(record.time))
        if damping := note_damping(fitted):
            chain, recursive = {name: np.full_like(column, np.nan) for name, column in chain.items()}, {}
        done()
        trace = pd.DataFrame(columns_of(record, segments, fitted, search_fit) | chain)
        factor = decimation(config, record)
        parts = long_enough(segments, factor)
        done()
        summary = summary_of(task, fitted, search_fit, profiles, recursive)
        summary["torque"] = torque_errors(record, fitted, parts, factor)
        summary["feedback"] = bias = find_feedback_bias(record, segments, fitted)
        summary["notes"] = [*(there["sentence"] for there in bias.values()), *summary["notes"], *damping]
        if summary["rejected"]:
            mark_lacking(summary, find_motion_share(fitted, parts, factor))
        if gains:
            summary["gains"] = {side: chosen._asdict() for side, chosen in gains.items()}
        if task.holdout is not None:
            summary["holdout"] = on_holdout(config, task.holdout.open(), nominal, fitted, search_fit.samples)
        done()
    model = with_values(config, values | gain_values)
    return Identification(config, model, record, to_jsonable(summary), trace, "excitation" in task.missing)


def _from_motor(
    task: LogTask, nominal: Experiment, free: tuple[FreeParameter, ...], segments: list[Segment], done: Callable[[], None]
) -> Identification:
    """The rest of an identification without the load's encoder; what needs both encoders is left out."""
    config, record = task.config, task.record
    alone = search_alone(task, nominal, free, segments)
    done()
    trace = pd.DataFrame(columns_alone(record, alone))
    summary, gap = summary_of(task, alone.experiment, alone.search_fit), gap_summary(alone)
    summary["torque"], summary["backlash"] = {}, gap
    if gap is not None and gap["why"] and gap["path"].startswith("transmission."):
        # follows from a number that was not found
        summary["parameters"].pop("transmission.half_gap", None)
    if task.holdout is not None:
        summary["holdout"] = alone_on_holdout(task.holdout.open(), alone, np.zeros(len(free)))
    done()
    return Identification(
        config, with_values(config, alone.values), record, to_jsonable(summary), trace, "excitation" in task.missing
    )
