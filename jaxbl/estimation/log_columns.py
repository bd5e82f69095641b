"""Columns over a log: its smoothed motion, the fit's residuals, the fitted model's torques, and what the observers see."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from jaxbl.chain import Experiment, NamedArrays, Signals, State, TracedArrays, replay
from jaxbl.fused.compilation import jit
from jaxbl.json_types import JsonObject
from jaxbl.records import POSITION_CHANNELS, Record

from .regression import model_torques
from .search import SearchFit
from .segments import Segment


def join_columns(count: int, segments: Sequence[Segment], pieces: Sequence[Mapping[str, Any]]) -> NamedArrays:
    """Join the columns of segments to columns of a log of `count` samples; NaN between the segments."""
    columns: NamedArrays = {}
    for segment, piece in zip(segments, pieces, strict=True):
        for name, values in piece.items():
            columns.setdefault(name, np.full(count, np.nan))[segment.rows] = values
    return columns


def recorded_columns(record: Record, sides: Collection[str]) -> NamedArrays:
    """Columns of a log as it was read: `t`, `u`, and positions (`theta_e`, ...) of some sides."""
    assert record.torque is not None
    positions = {channel: record.positions[side] for side, channel in POSITION_CHANNELS.items() if side in sides}
    return {"t": record.time, "u": record.torque} | positions


def motion_columns(segment: Segment) -> NamedArrays:
    """Columns of each side's smoothed motion along a segment, with deviations."""
    columns: NamedArrays = {}
    for side, smoothed in segment.smoothed.items():
        for order, name in ((1, "velocity"), (2, "acceleration")):
            columns[f"{side}.{name}"] = smoothed.state[:, order]
            columns[f"{side}.{name}_deviation"] = smoothed.deviation(order)
    return columns


def columns_of(record: Record, segments: Sequence[Segment], fitted: Experiment, search_fit: SearchFit) -> NamedArrays:
    """Columns of a log and its fit, each of shape (samples,); NaN where the log gives none.

    `t`, `u`, positions (`theta_e`, ...), `transmitted` where it was measured; `SIDE.velocity` and `SIDE.acceleration` with
    their deviations; `SIDE.residual`, rad; the model's `torque` and `SIDE.effects`, N m.
    """
    columns = recorded_columns(record, fitted.sides)
    if record.transmitted is not None:
        columns["transmitted"] = record.transmitted
    pieces = []
    for segment in segments:
        deviation = {side: smoothed.deviation(1) for side, smoothed in segment.smoothed.items()}
        pieces.append(motion_columns(segment) | model_torques(fitted, segment.kinematics, deviation))
    rows = (search_fit.windows.rows[:, None] + np.arange(search_fit.samples)).ravel()
    for i, side in enumerate(fitted.sides):
        column = columns[f"{side}.residual"] = np.full(len(record.time), np.nan)
        column[rows] = search_fit.windows.noise[side] * search_fit.fit.residual[:, :, i].ravel()
    return columns | join_columns(len(record.time), segments, pieces)


_ESTIMATES = "velocity_estimate", "torque_estimate"
"""Columns of each observer."""


@jit
def _replay_observers(experiment: Experiment, torque: Any, measured: Any) -> TracedArrays:
    def keep(state: State, signals: Signals) -> JsonObject:
        row: JsonObject = {} if signals.twist is None else {"twist": signals.twist}
        for side in experiment.sides:
            row |= {f"{side}.{name}": getattr(signals.side(side), name) for name in _ESTIMATES}
        if state.identifier is not None:
            assert experiment.identifier is not None and experiment.transmission is not None
            path = experiment.identifier.estimate(state.identifier, experiment.transmission)
            row |= {f"{side}.{name}": value for side, values in path.items() for name, value in values.items()}
        return row

    return replay(experiment, torque, measured, record=keep)[1]


_STABLE_DAMPING = 2.0
"""Sampling periods over a side's own time constant at which its model, forward Euler, begins to diverge."""


def note_damping(experiment: Experiment) -> list[str]:
    """Say where observers cannot run, since friction stops a side within a sampling period; no sentence if they can."""
    period = float(experiment.run.sample_period)
    ratios = {
        side: float(experiment.drive.viscous(side)) * period / float(experiment.drive.inertia(side))  # type: ignore[attr-defined]
        for side in experiment.sides
    }
    return [
        f"The observers cannot run at this period: the {side}'s viscous friction times {1e3 * period:.4g} ms over its "
        f"inertia is {ratio:.3g}; it should be below {_STABLE_DAMPING:g}: record at a shorter period."
        for side, ratio in ratios.items()
        if ratio >= _STABLE_DAMPING
    ]


def observer_chain(experiment: Experiment, segments: Sequence[Segment], samples: int) -> tuple[NamedArrays, JsonObject]:
    """The paper's chain on the longest segment: observers, and the recursive identifier on their equivalent control.

    Columns of shape (samples,), NaN elsewhere, and the identifier's numbers at the end, by name and side.
    """
    longest = max(segments, key=len)
    signals = _replay_observers(experiment, longest.torque, longest.readings)
    # compiled programs sort their results by name
    estimates = [f"{side}.{name}" for side in experiment.sides for name in _ESTIMATES]
    in_order = {name: signals[name] for name in ("twist", *estimates, *signals) if name in signals}
    law_numbers = {} if experiment.transmission is None else experiment.transmission.truth()
    at_end = {name: {side: float(signals[f"{side}.{name}"][-1]) for side in experiment.sides} for name in law_numbers}
    return join_columns(samples, [longest], [in_order]), at_end
