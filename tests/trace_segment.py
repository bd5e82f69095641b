"""A simulated run as a segment of a log."""

from jaxbl.estimation.segments import Segment
from jaxbl.estimation.smoother import smooth


def make_segment(trace, period=1e-3, torque=None, transmitted=None):
    """The readings of a run; with another input, or with a measured torque."""
    sides = {"motor": "theta_e", "load": "theta_s"}
    readings = {side: trace[name].to_numpy() for side, name in sides.items() if name in trace}
    smoothed = {side: smooth(reading, period) for side, reading in readings.items()}
    torque = trace["u"].to_numpy() if torque is None else torque
    return Segment(slice(0, len(trace)), trace["t"].to_numpy(), period, torque, readings, smoothed, transmitted)
