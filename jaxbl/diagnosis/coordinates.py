"""Coordinates of a log that a missing torque may depend on: speed, position, reversals, gap, load, time and others."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from jaxbl.estimation.regression import Kinematics, transmitted
from jaxbl.estimation.segments import Segment
from jaxbl.records.least_squares import rms
from jaxbl.simulate import Experiment

from .residuals import Residual, SideResiduals

EVERYWHERE = "all"
"""The coordinate that is the same all along a log."""


_STILL, _STILL_SHARE = 3.0, 1e-3
"""Standard deviations of a speed, and share of its rms, up to which a side stands still."""
_IDLE = 0.02
"""Share of the transmitted torque's rms up to which a gear is not loaded."""
_MORE_THAN_A_TURN = 1.2 * 2.0 * np.pi
"""Range of positions, rad, from which on turns are laid over one another."""
_SLOWER = 3.0
"""Factor between the bandwidths of a residual and of the acceleration it is looked at along: power of the noise of an
acceleration grows with the fifth power of the bandwidth."""


class CoordinateValues(NamedTuple):
    """A coordinate along a segment of a log.

    Attributes:
        values: a number a sample, or the index of its class.
        unit: of the number.
        classes: names of the classes; empty for numbers.
        symbol: for sentences.
    """

    values: np.ndarray
    unit: str = ""
    classes: tuple[str, ...] = ()
    symbol: str = ""


_ANGLES = {"motor": "θe", "load": "θs"}


def coordinates_of(
    experiment: Experiment, segment: Segment, residual: Residual, sliding: Collection[str] = ()
) -> dict[str, CoordinateValues]:
    """Coordinates of a residual along its segment; of those that explain as much, the simpler ones first.

    Positions of `sliding` sides are no angles.
    """
    part, side = segment.kinematics, residual.name
    length, omega = ("m", "v") if side in sliding else ("rad", "ω")
    velocity = np.asarray(part.velocity[side])
    deviation = np.asarray(segment.smoothed[side].deviation(1))
    still = np.abs(velocity) <= np.maximum(_STILL * deviation, _STILL_SHARE * rms(velocity))

    def position_of(one: str) -> CoordinateValues:
        unit, symbol = ("m", "x") if one in sliding else ("rad", _ANGLES[one])
        return CoordinateValues(np.asarray(part.position[one]), unit, symbol=symbol)

    found = {
        EVERYWHERE: CoordinateValues(np.zeros(len(velocity), int), classes=("everywhere",)),
        "direction": CoordinateValues(
            np.where(still, 1, np.where(velocity > 0.0, 2, 0)), classes=("backward", "at rest", "forward"),
        ),
        "reversals": _near_reversals(part, velocity, still, residual.bandwidth),
    }  # fmt: skip
    geared = len(part.position) > 1 and experiment.transmission is not None
    if geared:
        found |= _gear_classes(experiment, part)
    found["|speed|"] = CoordinateValues(np.abs(velocity), f"{length}/s", symbol=f"|{omega}|")
    found["speed"] = CoordinateValues(velocity, f"{length}/s", symbol=omega)
    for one in [name for name in part.position if name in (side, "load") and name not in sliding]:
        position = np.asarray(part.position[one])
        if (turned := within_turn(position)) is not None:
            name = "turn" if one == side else f"{one} turn"
            found[name] = CoordinateValues(turned, "rad", symbol=f"{_ANGLES[one]} mod 2π")
    found["position"] = position_of(side)
    if side != "load" and geared:
        found["load position"] = position_of("load")
    unit, force = ("m", "N") if "motor" in sliding else ("rad", "N m")
    if geared:
        twist, rate = (_twist(experiment, one) for one in (part.position, part.velocity))
        found["twist"] = CoordinateValues(twist, unit, symbol="z")
        found["twist rate"] = CoordinateValues(rate, f"{unit}/s", symbol="ż")
    if side == "motor":
        found["input"] = CoordinateValues(np.asarray(part.torque), force, symbol="u")
    # the measured one's noise is the residual's, and would be found there
    width = np.sqrt(np.log(2.0)) / (2.0 * np.pi * residual.bandwidth / _SLOWER * residual.period)
    acceleration = gaussian_filter1d(np.asarray(part.acceleration[side]), width)
    found["acceleration"] = CoordinateValues(acceleration, f"{length}/s²", symbol="a")
    found["time"] = CoordinateValues(np.asarray(part.time), "s", symbol="t")
    return found


def within_turn(position: np.ndarray) -> np.ndarray | None:
    """Positions (rad) modulo a turn; None where they hardly exceed one."""
    return np.mod(position, 2.0 * np.pi) if np.nanmax(position) - np.nanmin(position) > _MORE_THAN_A_TURN else None


def all_coordinates(
    experiment: Experiment,
    segments: Sequence[Segment],
    residuals: SideResiduals,
    sliding: Collection[str],
) -> dict[str, list[dict[str, CoordinateValues]]]:
    """Those of each side's residuals (:func:`coordinates_of`), segment by segment."""
    return {
        side: [coordinates_of(experiment, segment, one, sliding) for segment, one in zip(segments, pieces, strict=True)]
        for side, pieces in residuals.items()
    }


def _twist(experiment: Experiment, values: Mapping[str, Any]) -> np.ndarray:
    """Of positions, rad, or its rate, of velocities."""
    return np.asarray(values["motor"]) - float(experiment.drive.ratio("load")) * np.asarray(values["load"])


def _gear_classes(experiment: Experiment, part: Kinematics) -> dict[str, CoordinateValues]:
    """On which side of the gap the transmission is, and which way it is loaded."""
    found, plant = {}, experiment.plant
    torque = np.asarray(transmitted(experiment, part) if part.transmitted is None else part.transmitted)
    if plant.half_gap > 0.0:
        twist = _twist(experiment, part.position)
        inside = np.where(np.abs(twist) < plant.half_gap, 1, np.where(twist > 0.0, 2, 0))
        found["gap"] = CoordinateValues(inside, classes=("outside, z < 0", "inside of the gap", "outside, z > 0"))
    idle = np.abs(torque) < _IDLE * rms(torque)
    loaded = np.where(idle, 1, np.where(torque > 0.0, 2, 0))
    found["load sign"] = CoordinateValues(loaded, classes=("negative load", "no load", "positive load"))
    return found


def _near_reversals(part: Kinematics, velocity: np.ndarray, still: np.ndarray, bandwidth: float) -> CoordinateValues:
    """Whether the motion reverses nearby, and to which direction: near is what the low-pass smears, and some more."""
    time = np.asarray(part.time)
    sign = np.where(still, 0.0, np.sign(velocity))
    moving = np.flatnonzero(sign)
    turning = np.flatnonzero(np.diff(sign[moving]))
    near = np.zeros(len(time), int)
    if len(turning):
        first, last = moving[turning], moving[turning + 1]
        between = np.median(np.diff(time[first])) if len(first) > 1 else 0.5 * (time[-1] - time[0])
        window = min(max(0.3 / bandwidth, 0.05 * between), 0.2 * between)
        for begin, end in zip(first, last, strict=True):
            rows = slice(*np.searchsorted(time, (time[begin] - window, time[end] + window)))
            near[rows] = 1 if sign[end] > 0.0 else 2
    return CoordinateValues(near, classes=("away from reversals", "reversals to forward", "reversals to backward"))
