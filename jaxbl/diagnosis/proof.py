"""The proof: what a model leaves on data that neither its numbers nor its choice have seen.

What is held out is opened here, once, after the model stands. It changes words and verdict, never the model. Of it nothing
is fitted but the state in which each window begins, from the window's first fifth, which is not scored; and of another log
the zeros of its encoders, where the model has those of its own, from the log's first fifth, which is not scored either.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxbl.chain import Experiment
from jaxbl.drive.effects import EFFECTS
from jaxbl.estimation.free_parameters import make_free_parameters, set_free_parameters
from jaxbl.estimation.logs import FIRST_FIFTH
from jaxbl.estimation.segments import segments_of
from jaxbl.json_types import JsonObject
from jaxbl.records import Record
from jaxbl.records.least_squares import rms

from .blocks import standard_errors_better
from .candidates import ZERO_SPREAD, owner_of
from .choice import Chosen
from .expected_errors import Expected, expected_errors, list_failed
from .linearised_model import find_driving_torque
from .neutral_effects import without
from .reference_log import Comparison, ReferenceLog
from .refit import ModelFits
from .setup import Setup, quiet
from .thresholds import LIMITS

ACTS = 0.5
"""Torque of an effect there, over that on the log, from which on it acts there, and can be shown."""


class Proof(NamedTuple):
    """A model beside what was held out.

    Attributes:
        record, log: what was held out.
        before, after: the model as given, and the one that stands.
        expected: errors of a complete model, by channel.
        failed: channels in which the model leaves more, but for the weak ones.
        worse: whether the model as given predicts better, all channels together.
        weak: channels that test nothing, since a complete model may leave more than the motion or the driving torque.
        untested: effects without which the model would pass as well: their torque there, and on the log that was fitted
            (`on_log`), N m, rms at the motor.
        holdout_z: standard errors by which each effect that acts there makes the model predict better.
        driving: torque that drives the machine there, rms, N m.
    """

    record: Record
    log: ReferenceLog
    before: Comparison
    after: Comparison
    expected: dict[str, Expected]
    failed: list[str]
    worse: bool
    weak: list[str]
    untested: JsonObject
    holdout_z: dict[str, float]
    driving: float

    @property
    def has_power(self) -> bool:
        """True if some channel is a test."""
        return len(self.weak) < len(self.expected)


def open_held_out(setup: Setup) -> tuple[Record, ReferenceLog]:
    """Open what was held out, as models are compared with it; it is cleaned and smoothed as the log was."""
    record, at_rest = setup.task.holdout.open(), setup.task.config.log.initial_state == "rest"
    segments = quiet(segments_of(record, setup.nominal.sides, at_rest), setup.input_noise.unfelt)
    return record, ReferenceLog(segments, setup.fitted.bandwidth, at_rest and setup.task.separate)


def _take_zeros(chosen: Chosen, log: ReferenceLog) -> tuple[Chosen, ReferenceLog]:
    """Give a model the zeros that another log counts from, by the first fifth of its segments; and the rest of that log."""
    cuts = [(segment, round(FIRST_FIFTH * len(segment))) for segment in log.segments]
    first, later = (replace(log, segments=part) for part in zip(*((s[:cut], s[cut:]) for s, cut in cuts), strict=True))
    names = [owner_of(number)[0] for number in chosen.fitted.free]
    zeros = [i for i, name in enumerate(names) if name in EFFECTS and EFFECTS[name].in_log]
    for i in zeros:
        # the twist at which two encoders show no torque
        fitted = chosen.fitted
        number, theta, white = fitted.free[i], fitted.theta.copy(), fitted.white.copy()
        free = make_free_parameters(fitted.experiment, [number.path], 1.0)
        spread = np.array([ZERO_SPREAD / free[0].scale])
        zero = ModelFits(fitted.experiment, free, spread, first.segments).fit({}, np.zeros(1))
        theta[i] = number.theta(free[0].value(zero.theta[0]))
        white[i, i] = zero.covariance[0, 0] * (free[0].scale / number.scale) ** 2
        experiment = set_free_parameters(fitted.experiment, fitted.free, theta)
        chosen = chosen._replace(fitted=fitted._replace(theta=theta, white=white, experiment=experiment))
    return (chosen, replace(later, at_rest=False)) if zeros else (chosen, log)


def prove(setup: Setup, chosen: Chosen) -> Proof:
    """Open what was held out, and compare the model that stands with it, as it is and without one effect after the other."""
    record, log = open_held_out(setup)
    if setup.task.separate:
        chosen, log = _take_zeros(chosen, log)
    fitted = chosen.fitted
    before, after = log.compare(setup.nominal), log.compare(fitted.experiment)
    expected = expected_errors(log, fitted, after, setup.input_noise, chosen.driving)
    # of what is to be predicted: the motion of each side about its mean, rad, and the torque that drives it, N m, rms
    driving, _ = find_driving_torque(fitted.experiment, log.segments)
    sizes = {name: float(np.std(values)) for name, values in log.readings().items()}
    sizes |= {f"torque_{side}": driving * float(fitted.experiment.drive.ratio(side)) for side in fitted.experiment.sides}
    weak = [name for name, channel in expected.items() if not channel.limit < sizes[name.partition(" ")[0]]]
    better = standard_errors_better(log, before, after)
    untested, holdout_z, model = {}, {}, fitted.experiment
    for name in fitted.names:
        less = without(model, name)
        compared = log.compare(less)
        torques = {"torque": _torque_between(log, model, less), "on_log": _torque_between(setup.fitted, model, less)}
        if torques["torque"] > ACTS * torques["on_log"]:
            holdout_z[name] = standard_errors_better(log, compared, after)
        if not list_failed(compared.errors, expected):
            untested[name] = torques
    return Proof(
        record, log, before, after, expected,
        # what tests nothing contradicts nothing
        [name for name in list_failed(after.errors, expected) if name not in weak],
        bool(fitted.names) and len(weak) < len(expected) and better < -LIMITS.difference,
        weak, untested, holdout_z, driving,
    )  # fmt: skip


def _torque_between(log: ReferenceLog, model: Experiment, other: Experiment) -> float:
    """Torque by which two models differ along a log, at the motor, rms, N m."""
    pair = [log.missing(experiment) for experiment in (model, other)]
    return float(
        np.hypot.reduce([rms(pair[0][side] - pair[1][side]) / float(model.drive.ratio(side)) for side in model.sides])
    )
