"""A simulated run as a segment of a log, or in windows."""

import jax
import numpy as np

from jaxbl.estimation.segments import Segment
from jaxbl.estimation.smoother import smooth
from jaxbl.estimation.trajectory import Windows


def make_segment(trace, period=1e-3, torque=None, transmitted=None):
    """The readings of a run; with another input, or with a measured torque."""
    sides = {"motor": "theta_e", "load": "theta_s"}
    readings = {side: trace[name].to_numpy() for side, name in sides.items() if name in trace}
    smoothed = {side: smooth(reading, period) for side, reading in readings.items()}
    torque = trace["u"].to_numpy() if torque is None else torque
    return Segment(slice(0, len(trace)), trace["t"].to_numpy(), period, torque, readings, smoothed, transmitted)


def cut(torque, readings, period, states, noise, samples):
    """Input, readings and states of a run in windows of so many samples."""
    count = len(torque) // samples

    def split(column):
        return np.asarray(column)[: count * samples].reshape(count, samples)

    rows = samples * np.arange(count)
    start = jax.tree.map(lambda column: split(column)[:, 0], states)
    finer = np.zeros((count, samples, len(readings)))
    measured = {side: split(positions) for side, positions in readings.items()}
    return Windows(split(torque), measured, period * rows, start, noise, np.zeros(count, bool), finer, rows)
