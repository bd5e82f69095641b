"""Several logs of one machine as one record."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jaxbl.errors import InputError

from .reader import Record

_PAUSE = 10
"""Periods between logs."""


def join(records: Sequence[Record]) -> Record:
    """Put records one after the other, each in segments of its own, with figures and units of the first.

    Raises:
        InputError: other channels or another sampling period than the first one's.
    """
    first = records[0]
    if len(records) == 1:
        return first
    period, times, segments, notes, rows, end = first.sample_period, [], [], [], 0, 0.0
    for record in records:
        if not np.isclose(record.sample_period, period, rtol=1e-6, atol=0.0):
            raise InputError(
                f"{record.path}: is sampled every {record.sample_period:.6g} s, {first.path} every {period:.6g} s; "
                f"[log] resample = {period:.6g} reads both alike"
            )
        for one, other in ((record, first), (first, record)):
            if missing := _channels(other) - _channels(one):
                name = min(missing)
                raise InputError(f"{one.path}: has no {name}, which {other.path} has; logs of one machine should be alike")
        times.append(record.time - record.time[0] + end)
        end = float(times[-1][-1]) + _PAUSE * period
        segments += [slice(part.start + rows, part.stop + rows) for part in record.segments]
        rows += len(record.time)
        notes += [f"{record.path.name}: {note}" for note in record.notes]
    notes.insert(0, f"{len(records)} logs, one after the other: {', '.join(record.path.name for record in records)}.")
    return replace(
        first,
        time=np.concatenate(times),
        torque=_together([record.torque for record in records]),
        positions={side: _together([record.positions[side] for record in records]) for side in first.positions},
        transmitted=_together([record.transmitted for record in records]),
        segments=tuple(segments),
        notes=tuple(notes),
        intervals=np.concatenate([record.intervals for record in records]),
    )


def _channels(record: Record) -> set[str]:
    torques = {"torque": record.torque, "transmitted torque": record.transmitted}
    return {f"{side} position" for side in record.positions} | {name for name, one in torques.items() if one is not None}


def _together(parts):
    return None if parts[0] is None else np.concatenate(parts)
