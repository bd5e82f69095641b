"""The gap by the bench's own account: how well a model foretells the truth of the hold-out run.

The model runs in the bench's simulator over windows of the hold-out log, each from the true state and under the torque that
was truly commanded. No encoder noise, no estimated initial state and no integrator of the package comes in between, and no
drift of free-running positions; what is left is what the model has wrong.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from .cases import Case
from .effects import rms
from .simulator import Machine, Run, simulate

WINDOW = 0.5
"""Length of the windows, s."""
_SMALL = 0.1
"""Errors below this share of the encoder's noise are no errors."""


def foretold(case: Case, *models: Mapping[str, Any]) -> list[dict[str, float]]:
    """Rms error in rad of each model's positions over the windows, by channel.

    Args:
        case: whose hold-out run is foretold.
        models: studies, of which `drive`, `transmission` and `effects` are used.

    Raises:
        ValueError: a model has an effect that the bench does not know.
    """
    run, truth = case.runs[1], case.traces[1]
    length = min(round(WINDOW / run.period), len(truth.t))
    starts = range(0, len(truth.t) - length + 1, length)
    runs = []
    for model in models:
        machine = Machine(model["drive"], model.get("transmission"), model.get("effects", ()))
        acting = _acting(machine, truth.command, run.period)
        runs += [
            Run(
                machine,
                run.period,
                truth.command[k : k + length],
                initial=tuple(truth.states[:, k]),
                acting=acting[k],
                origin=float(truth.t[k]),
            )
            for k in starts
        ]
    traces = simulate(runs)
    found = []
    for i in range(len(models)):
        own = traces[i * len(starts) : (i + 1) * len(starts)]
        errors = np.stack([trace.states - truth.states[:, k : k + length] for k, trace in zip(starts, own, strict=True)])
        channels = {"theta_e": 0} if case.runs[1].machine.rigid else {"theta_e": 0, "theta_s": 2}
        found.append({name: rms(errors[:, row]) for name, row in channels.items()})
    return found


def proof(case: Case, model: Mapping[str, Any]) -> tuple[float | None, bool | None]:
    """Reduction of the gap from the nominal to the extended model, mean over channels, and whether it grew in one.

    Without a gap before there is no reduction; without a model that the bench can run there is neither.
    """
    try:
        before, after = foretold(case, case.model, model)
    except (KeyError, TypeError, ValueError):
        return None, None
    noise = {"theta_e": case.runs[1].motor_noise, "theta_s": case.runs[1].load_noise}
    reductions, worse = [], False
    for channel, old in before.items():
        small, new = _SMALL * noise[channel], after[channel]
        worse = worse or not new <= 1.05 * max(old, small)
        if old > small:
            reductions.append(1.0 - new / old if math.isfinite(new) else -math.inf)
    return (float(np.mean(reductions)) if reductions else None), worse


def _acting(machine: Machine, command: np.ndarray, period: float) -> np.ndarray:
    """Torque that the actuator makes at each sample."""
    gain, limit, keep = 1.0, math.inf, 0.0
    for effect in machine.effects:
        gain *= 1.0 + effect["relative"] if effect["kind"] == "actuator.gain_error" else 1.0
        limit = effect["limit"] if effect["kind"] == "actuator.saturation" else limit
        keep = math.exp(-period / effect["time_constant"]) if effect["kind"] == "actuator.lag" else keep
    acting, now = np.zeros(len(command)), 0.0
    for k, u in enumerate(np.clip(gain * command, -limit, limit)):
        acting[k] = now
        now = u + (now - u) * keep
    return acting
