"""Coordinates of a log that a missing torque may depend on: speed, position, reversals, gap, load, time and others."""

# arrays of numpy go where those of jax are asked for
# pyright: reportArgumentType=false

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from jaxbl.chain import Experiment
from jaxbl.estimation.regression import Kinematics, find_transmitted
from jaxbl.estimation.segments import Segment
from jaxbl.records.least_squares import rms

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
        symbol: for sentences.
        classes: names of the classes; empty for numbers.
    """

    values: np.ndarray
    unit: str = ""
    symbol: str = ""
    classes: tuple[str, ...] = ()


SideCoordinates = dict[str, list[dict[str, CoordinateValues]]]
"""Coordinates by name along each side's residuals, segment by segment."""
_ANGLES = {"motor": "θe", "load": "θs"}


def coordinates_of(
    experiment: Experiment, segment: Segment, residual: Residual, sliding: Collection[str] = ()
) -> dict[str, CoordinateValues]:
    """Coordinates of a residual along its segment; of those that explain as much, the simpler ones first.

    Positions of `sliding` sides are no angles.
    """
    part, side = segment.kinematics, residual.name
    length, omega = ("m", "v") if side in sliding else ("rad", "ω")
    velocity = part.velocity[side]
    still = np.abs(velocity) <= np.maximum(_STILL * segment.smoothed[side].deviation(1), _STILL_SHARE * rms(velocity))

    def position_of(place: str) -> CoordinateValues:
        unit, symbol = ("m", "x") if place in sliding else ("rad", _ANGLES[place])
        return CoordinateValues(part.position[place], unit, symbol)

    coordinates = {
        EVERYWHERE: CoordinateValues(np.zeros(len(velocity), int), classes=("everywhere",)),
        "direction": _by_sign(velocity, still, "backward", "at rest", "forward"),
        "reversals": _near_reversals(part, velocity, still, residual.bandwidth),
    }  # fmt: skip
    geared = len(part.position) > 1 and experiment.transmission is not None
    if geared:
        coordinates |= _gear_classes(experiment, part)
    coordinates["|speed|"] = CoordinateValues(np.abs(velocity), f"{length}/s", f"|{omega}|")
    coordinates["speed"] = CoordinateValues(velocity, f"{length}/s", omega)
    for place in [name for name in part.position if name in (side, "load") and name not in sliding]:
        position = part.position[place]
        if (turned := within_turn(position)) is not None:
            name = "turn" if place == side else f"{place} turn"
            coordinates[name] = CoordinateValues(turned, "rad", f"{_ANGLES[place]} mod 2π")
    coordinates["position"] = position_of(side)
    if side != "load" and geared:
        coordinates["load position"] = position_of("load")
    unit, force = ("m", "N") if "motor" in sliding else ("rad", "N m")
    if geared:
        twist, rate = (np.asarray(experiment.plant.twist(motion)) for motion in (part.position, part.velocity))
        coordinates["twist"] = CoordinateValues(twist, unit, "z")
        coordinates["twist rate"] = CoordinateValues(rate, f"{unit}/s", "ż")
    if side == "motor":
        coordinates["input"] = CoordinateValues(part.torque, force, "u")
    # the measured one's noise is the residual's, and would be found there
    width = np.sqrt(np.log(2.0)) / (2.0 * np.pi * residual.bandwidth / _SLOWER * residual.period)
    acceleration = gaussian_filter1d(part.acceleration[side], width)
    coordinates["acceleration"] = CoordinateValues(acceleration, f"{length}/s²", "a")
    coordinates["time"] = CoordinateValues(part.time, "s", "t")
    return coordinates


def within_turn(position: np.ndarray) -> np.ndarray | None:
    """Positions (rad) modulo a turn; None where they hardly exceed one."""
    return np.mod(position, 2.0 * np.pi) if np.nanmax(position) - np.nanmin(position) > _MORE_THAN_A_TURN else None


def all_coordinates(
    experiment: Experiment, segments: Sequence[Segment], residuals: SideResiduals, sliding: Collection[str]
) -> SideCoordinates:
    """Those of each side's residuals (:func:`coordinates_of`), segment by segment."""
    return {
        side: [
            coordinates_of(experiment, segment, residual, sliding)
            for segment, residual in zip(segments, pieces, strict=True)
        ]
        for side, pieces in residuals.items()
    }


def _gear_classes(experiment: Experiment, part: Kinematics) -> dict[str, CoordinateValues]:
    """On which side of the gap the transmission is, and which way it is loaded."""
    classes, plant = {}, experiment.plant
    torque = np.asarray(find_transmitted(experiment, part) if part.transmitted is None else part.transmitted)
    if plant.half_gap > 0.0:
        twist = np.asarray(plant.twist(part.position))
        inside = np.abs(twist) < plant.half_gap
        classes["gap"] = _by_sign(twist, inside, "outside, z < 0", "inside of the gap", "outside, z > 0")
    idle = np.abs(torque) < _IDLE * rms(torque)
    classes["load sign"] = _by_sign(torque, idle, "negative load", "no load", "positive load")
    return classes


def _by_sign(values: np.ndarray, is_none: np.ndarray, *classes: str) -> CoordinateValues:
    """Classes of a signal: negative, none, positive."""
    return CoordinateValues(np.where(is_none, 1, np.where(values > 0.0, 2, 0)), classes=classes)


def _near_reversals(part: Kinematics, velocity: np.ndarray, still: np.ndarray, bandwidth: float) -> CoordinateValues:
    """Tell where the motion reverses nearby, and to which direction: near is what the low-pass smears, and some more."""
    time = part.time
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
