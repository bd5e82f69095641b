"""A diagnosis sample by sample: `trace.parquet`."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from jaxbl.records import POSITION_CHANNELS

from .diagnosis_task import DiagnosisTask
from .observer_residual import Observed
from .residuals import Residual

Torques = Mapping[str, list[Residual]]
"""By side, segment by segment."""


def trace_of(
    task: DiagnosisTask,
    fitted: tuple[Torques, Torques],
    held: tuple[Torques, Torques],
    observed: tuple[Mapping[str, list[Observed]], Mapping[str, list[Observed]]],
) -> pd.DataFrame:
    """One row a sample of the log; of another one that was held out there is nothing.

    Args:
        task: study and logs.
        fitted: torques that the model lacks as given and with the effects, on the log.
        held: the same on what was held out.
        observed: what the model as given lacks by the observers, on both; nothing on another log.
    """
    whole = task.record if task.separate else task.holdout
    names = {side: POSITION_CHANNELS[side] for side in ("motor", "load") if side in whole.positions}
    columns: dict[str, Any] = {"t": whole.time, "u": whole.torque}
    columns |= {name: whole.positions[side] for side, name in names.items()}
    columns["held_out"] = np.arange(len(whole.time)) >= len(task.record.time)
    sources = [(task.record, fitted)] + ([] if task.separate else [(task.holdout, held)])
    for side in fitted[0]:
        for name, which, attribute in (
            ("missing_before", 0, "torque"), ("missing_after", 1, "torque"), ("noise", 0, "deviation"),
        ):  # fmt: skip
            column = np.full(len(whole.time), np.nan)
            for record, pair in sources:
                for part, one in zip(record.segments, pair[which][side], strict=True):
                    column[part] = getattr(one, attribute)
            columns[f"{side}.{name}"] = column
    for side in observed[0]:
        torque, noise = np.full((2, len(whole.time)), np.nan)
        for record, pieces in zip((task.record, task.holdout), observed, strict=True):
            for part, one in zip(record.segments if pieces else (), pieces.get(side, ()), strict=True):
                if one.converged:
                    rows = slice(part.start + one.skipped, part.stop)
                    torque[rows], noise[rows] = one.residual.torque, one.residual.deviation
        columns |= {f"{side}.observed_before": torque, f"{side}.observed_noise": noise}
    return pd.DataFrame(columns)
