"""An identification from the motor's encoder and torque alone, in the form that one from both encoders has."""

# arrays of numpy go where those of jax are asked for
# pyright: reportArgumentType=false

import dataclasses
from collections.abc import Collection, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.chain import Experiment, PlantState
from jaxbl.drive.parameters import set_leaves
from jaxbl.errors import InputError
from jaxbl.json_types import JsonObject
from jaxbl.lines import percent
from jaxbl.records import Record

from .free_parameters import FreeParameter
from .identification_summary import describe_position
from .intervals import UNSEEN, Refusal, Spread, refusals
from .log_columns import join_columns, motion_columns, recorded_columns
from .logs import LogTask, arrays
from .regression import balance, transmit
from .search import SearchFit
from .segments import Segment, at_period, segments_of
from .trajectory import Fit, Windows
from .unseen_load import SHOWN, Gap, Point, UnseenLoad, find_gap, half_gap_of, is_known, widths


class Alone(NamedTuple):
    """A fit to the motor's readings alone.

    Attributes:
        search_fit: the fit of the numbers that the log shows, all of the log as one window.
        values: all numbers of the fit by path, those that the log does not show among them: they belong together.
        gap: what it says of a gap; None where the model has none to be found.
        reason: why no gap is shown, in a clause; "" where one is.
        model: what was fitted.
        point: its best numbers.
    """

    search_fit: SearchFit
    values: dict[str, float]
    gap: Gap | None
    reason: str
    model: UnseenLoad
    point: Point

    @property
    def experiment(self) -> Experiment:
        """The model with these numbers."""
        return set_leaves(self.model.experiment, arrays(self.values))

    @property
    def doubtful(self) -> bool:
        """True if the readings call for a gap that is not shown, or allow one so wide that the load is never met."""
        return bool(self.reason) and self.gap is not None and (self.gap.is_needed or self.gap.unmet)


def search_alone(task: LogTask, nominal: Experiment, free: tuple[FreeParameter, ...], segments: Sequence[Segment]) -> Alone:
    """Fit a model to the motor's readings; other arguments as of :class:`.search.ParameterSearch`.

    Raises:
        InputError: the model diverges.
    """
    record, spread = task.record, task.config.identify.spread
    model = UnseenLoad(nominal, free, widths(free, spread), segments, task.config.log.initial_state == "rest")
    gap, point = search_gap(model, record)
    if gap is not None and gap.is_needed:
        width = gap.spread
    else:
        point, width = dataclasses.replace(model, held=[] if model.gap is None else [model.gap]).settle(point)
    alone = alone_of(model, point, width, [], gap, spread, record)
    if not_met(model, alone.point, record) or alone.doubtful:
        # numbers of a model that the log contradicts, with a gap of any size, or without a load have no interval
        nothing = np.full_like(alone.search_fit.spread.covariance, np.inf)
        search_fit = dataclasses.replace(alone.search_fit, spread=alone.search_fit.spread._replace(covariance=nothing))
        alone = alone._replace(search_fit=search_fit)
    return alone


def search_gap(model: UnseenLoad, record: Record) -> tuple[Gap | None, Point]:
    """Search for a gap, where the model has one to be found; and the fit to go on from, without one that is not needed.

    Raises:
        InputError: the model diverges.
    """
    gap = None if model.gap is None else find_gap(model)
    point = model.fit() if gap is None else gap.best if gap.is_needed else gap.without
    if not np.isfinite(point.deviance):
        raise InputError(f"{record.path}: the model diverges on this log; its nominal numbers should be nearer")
    return gap, point


def alone_of(
    model: UnseenLoad, point: Point, width: Spread, absent: Sequence[int], gap: Gap | None, spread: float, record: Record
) -> Alone:
    """The fit that a search ended with, and its covariance (`width`); the numbers at some places (`absent`) are none that
    was found. `spread`: factor by which inertias and stiffness may be off."""
    values, reason = model.numbers(point.theta), ""
    if gap is not None and model.gap is not None:
        # what is said of the gap is said of the model that is left
        reason = why_not(gap, model, point, width.deviations[model.gap], spread, record)
        absent = [*absent, model.gap] if reason else absent
        if not gap.is_needed:
            values[model.free[model.gap].path] = 0.0
    return Alone(_describe_fit(model, point, width, {*absent}, reason), values, gap, reason, model, point)


_FACTOR, _LEFT = 6.0, 0.05
"""Torque that the model may leave unexplained: times the noise of the recorded one, and over its rms. A fit that has missed
the right numbers leaves more."""
_REVERSALS = 2
"""Of the torque in the gear at least, without which a gap would not show: one there and one back."""
_FAR = 1.5
"""Times the logarithm of `[identify] spread` that inertias and stiffness may be off: more is another drive, or a fit that
went wrong."""


def not_met(model: UnseenLoad, point: Point, record: Record) -> str:
    """Why a fit cannot be right, in a clause: a torque moves the motor that is in neither; "" if there is none."""
    left, size = model.measure_unexplained(point), model.torque
    if left <= max(_FACTOR * model.torque_noise, _LEFT * size):
        return ""
    return (
        f"a torque of {left:.2g} {record.unit_of('motor.torque', 'N m')} rms ({percent(left / size)} of the driving "
        "torque) is left unexplained; the model lacks something else, or its nominal numbers are too far off"
    )


def why_not(gap: Gap, model: UnseenLoad, point: Point, deviation: float, spread: float, record: Record) -> str:
    """Why a log does not show a gap by the best fit, whose theta has this standard error of the gap, and what would, in one
    clause; "" where it does. `spread`: as of :func:`alone_of`."""
    unit = record.unit_of("motor.position", "rad")
    both_ways = "moves back and forth that drive the load both ways, wider than the gap, would show one"
    if wrong := not_met(model, point, record):
        return wrong
    if gap.unmet:
        return (
            f"the readings are met without one, and as well by a motor that, within a gap, never meets the load; {both_ways}"
        )
    if not gap.is_needed:
        if gap.at_most >= model.travel:
            return f"any half gap fits; {both_ways}"
        if gap.crossings < _REVERSALS:
            return f"the torque in the gear hardly changes its sign; {both_ways}"
        return (
            f"without one the motor's readings are met as well (noise {model.noise:.2g} {unit}); half gaps of up to "
            f"{gap.at_most:.3g} {unit} are not ruled out; faster reversals would show smaller ones"
        )
    if gap.crossings < 1:
        return f"the motor moves as if in a gap, but meets one flank at most: it is wider than this motion; {both_ways}"
    far = {
        number.path: float(np.exp(x))
        for number, x in zip(model.free, point.theta, strict=True)
        if is_known(number) and abs(x) > _FAR * np.log(spread)
    }
    if far:
        numbers = ", ".join(f"{path} times {factor:.3g}" for path, factor in far.items())
        return f"the log is met only with numbers far from the nominal ones ({numbers}); check these, or the log"
    if not deviation < UNSEEN:
        return f"one would be met, but of any size up to {model.travel:.3g} {unit}; {both_ways}"
    return ""


def _describe_fit(model: UnseenLoad, point: Point, width: Spread, absent: Collection[int], reason: str) -> SearchFit:
    """The fit of the numbers that the log shows; the others were fitted with them, and their intervals allow for that."""
    sought = np.setdiff1d(np.arange(len(model.free)), [*absent])
    width_sought = width.only(sought)
    refused, condition = refusals([model.free[i] for i in sought], width_sought)
    unfound = [Refusal({model.free[i].path: 1.0}, np.inf, reason if i == model.gap else "") for i in absent]
    visible = sought[width_sought.deviations < UNSEEN]
    torque = np.concatenate([segment.torque for segment in model.segments])
    # all of the log as one window, without a state of its own
    no_state, zero = PlantState({}, {}, ()), np.zeros(1, int)
    windows = Windows(torque[None], {}, zero, no_state, {"motor": model.noise}, zero, np.empty(0), zero)
    fit = Fit(point.theta[visible], no_state, (point.errors / model.noise)[None, :, None], np.empty(0), True)
    return SearchFit(
        free=tuple(model.free[i] for i in visible), fit=fit,
        spread=width.only(visible)._replace(variance=point.variance / model.noise**2),
        windows=windows, smoothness={"motor": point.smoothness},
        refused=[*unfound, *refused],
        condition=condition, steps=model.experiment.run.substeps,
    )  # fmt: skip


def columns_alone(record: Record, alone: Alone) -> dict[str, np.ndarray]:
    """Columns of the log and its fit, shape (samples,): `t`, `u`, `theta_e`, the motor's smoothed motion and residual, and
    what the model says of the load and of the torque in the gear (`load.modelled_position`, `load.modelled_velocity`,
    `torque`), with the same torque by the motor's side (`torque_by_motor`); NaN in parts of the log that are too short.
    """
    fitted, model, pieces = alone.experiment, alone.model, []
    for segment, state in zip(model.segments, model.states(alone.point), strict=True):
        k, state = segment.kinematics, jax.tree.map(jnp.asarray, state)
        through = transmit(fitted.plant, state, state.effects)
        # without a torque in the gear the motor's equation leaves over what it should be
        none = jnp.zeros_like(through)
        motion = dataclasses.replace(
            k, position=state.position | k.position, velocity=state.velocity | k.velocity,
            acceleration={"load": none} | k.acceleration, transmitted=none,
        )  # fmt: skip
        pieces.append(
            motion_columns(segment)
            | {
                "motor.residual": segment.readings["motor"] - state.position["motor"],
                "load.modelled_position": state.position["load"],
                "load.modelled_velocity": state.velocity["load"],
                "torque": through,
                "torque_by_motor": balance(fitted, motion)["motor"].residual,
            }
        )
    return recorded_columns(record, ["motor"]) | join_columns(len(record.time), model.segments, pieces)


def gap_summary(alone: Alone) -> JsonObject | None:
    """Describe the gap by the motor alone, as `backlash` of `identification.json`; None where the model has none."""
    gap, model = alone.gap, alone.model
    if gap is None or model.gap is None:
        return None
    number = model.free[model.gap]
    return {
        "shown": not alone.reason,
        "path": number.path,
        "nominal": number.nominal * half_gap_of(number),
        "half_gap": None if alone.reason else model.half_gap(alone.point.theta),
        "at_most": gap.at_most,
        "unmet": gap.unmet,
        "gain": gap.gain,
        "needed": SHOWN,
        "crossings": gap.crossings,
        "why": alone.reason or None,
    }


def alone_on_holdout(record: Record, alone: Alone, nominal: np.ndarray) -> JsonObject:
    """Predict another log of the motor by the fitted numbers, and by the nominal ones, whose theta is of shape (free,)."""
    fitted, smoothness = alone.model, alone.point.smoothness
    segments = segments_of(record, ["motor"], fitted.at_rest)
    model = dataclasses.replace(fitted, experiment=at_period(fitted.experiment, record.sample_period), segments=segments)
    after, before = (model.predict(theta, smoothness).variance ** 0.5 for theta in (alone.point.theta, nominal))
    position = describe_position(record, "motor", model.noise, rms=after, nominal_rms=before)
    window = max(map(len, segments)) * record.sample_period
    return {"file": str(record.path.resolve()), "window": window, "position": {"motor": position}, "torque": {}}
