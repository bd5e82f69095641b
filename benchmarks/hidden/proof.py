"""The gap by the bench's own account: how well a model foretells the truth of the hold-out run.

The model runs in the bench's simulator over windows of the hold-out log, each from the true state and under the torque that
was truly commanded. No encoder noise, no estimated initial state and no integrator of the package comes in between, and no
drift of free-running positions; what is left is what the model has wrong.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.signal import lsim

from .cases import Case
from .effects import dahl
from .simulator import Machine, Run, Trace, pack, simulate

WINDOW = 0.5
"""Length of the windows, s."""
_SMALL = 0.1
"""Errors below this share of the encoder's noise are no errors."""


def foretold(asked: Sequence[tuple[Case, Mapping[str, Any]]]) -> list[dict[str, float] | None]:
    """Rms error in rad of models' positions over the windows, by channel.

    Args:
        asked: cases, and the study whose `drive`, `transmission` and `effects` are to foretell each one's hold-out run.

    Returns:
        For each; None where the bench cannot run the model.
    """
    runs: list[Run] = []
    ranges = []
    for case, model in asked:
        first = len(runs)
        try:
            windows = _windows(case, model)
            for run in windows:
                pack(run)
        except (KeyError, TypeError, ValueError):
            windows = []
        runs += windows
        ranges.append(range(first, len(runs)))
    traces = simulate(runs, batch=2048)
    errors_of_models: list[dict[str, float] | None] = []
    for (case, _), case_rows in zip(asked, ranges, strict=True):
        states, squares = case.traces[1].states, []
        for i in case_rows:
            k, length = round(runs[i].origin / runs[i].period), len(runs[i].torque)
            squares.append(np.mean((traces[i].states - states[:, k : k + length]) ** 2, axis=1))
        errors = np.sqrt(np.mean(squares, axis=0)) if squares else np.zeros(0)
        channels = {"theta_e": 0} if case.runs[1].machine.rigid else {"theta_e": 0, "theta_s": 2}
        errors_of_models.append({name: float(errors[row]) for name, row in channels.items()} if squares else None)
    return errors_of_models


def _windows(case: Case, model: Mapping[str, Any]) -> list[Run]:
    run, truth = case.runs[1], case.traces[1]
    machine = Machine(model["drive"], model.get("transmission"), model.get("effects", ()))
    acting = _acting(machine, truth.command, run.period)
    bent, hung = _bent(machine, truth), _hung(machine, truth)
    length = min(round(WINDOW / run.period), len(truth.t))
    return [
        Run(
            machine,
            run.period,
            truth.command[k : k + length],
            initial=tuple(truth.states[:, k]),
            acting=acting[k],
            bent=bent[k],
            hung=(hung[k, 0], hung[k, 1]),
            origin=float(truth.t[k]),
        )
        for k in range(0, len(truth.t) - length + 1, length)
    ]


def proofs(asked: Sequence[tuple[Case, Mapping[str, Any]]]) -> list[tuple[float | None, bool | None]]:
    """Reduction of the gap from the nominal to an extended model, mean over channels, and whether it grew in one.

    Without a gap before there is no reduction; without a model that the bench can run there is neither.
    """
    pairs = foretold([*((case, case.model) for case, _ in asked), *asked])
    results: list[tuple[float | None, bool | None]] = []
    for (case, _), before, after in zip(asked, pairs[: len(asked)], pairs[len(asked) :], strict=True):
        if before is None or after is None:
            results.append((None, None))
            continue
        noise = {"theta_e": case.runs[1].motor_noise, "theta_s": case.runs[1].load_noise}
        reductions, worse = [], False
        for channel, old in before.items():
            small, new = _SMALL * noise[channel], after[channel]
            worse = worse or not new <= 1.05 * max(old, small)  # nan is worse
            if old > small:
                reductions.append(1.0 - new / old if math.isfinite(new) else -math.inf)
        results.append((float(np.mean(reductions)) if reductions else None, worse))
    return results


def _bent(machine: Machine, truth: Trace) -> np.ndarray:
    """Deflection of the contacts of presliding friction at each sample of the true motion, from 0; rad."""
    for effect in machine.effects:
        place, _, kind = effect["kind"].partition(".")
        if kind == "presliding_friction":
            velocity = truth.states[1 if machine.rigid or place == "motor" else 3]
            return effect["length"] * dahl(velocity, float(truth.t[1] - truth.t[0]), effect["length"])
    return np.zeros(len(truth.t))


def _hung(machine: Machine, truth: Trace) -> np.ndarray:
    """Twist of the spring of `load.flexibility`, rad, and velocity of the inertia behind it, rad/s, at each sample of the
    true motion, from rest; shape (samples, 2)."""
    for effect in machine.effects:
        place, _, kind = effect["kind"].partition(".")
        if kind == "flexibility":
            velocity = truth.states[1 if machine.rigid or place == "motor" else 3]
            rate, damping = 2.0 * math.pi * effect["frequency"], 2.0 * effect.get("damping_ratio", 0.02)
            step, driven = [[0.0, 1.0], [-(rate**2), -damping * rate]], [[-1.0], [damping * rate]]
            return lsim((step, driven, np.eye(2), np.zeros((2, 1))), velocity, truth.t)[1]
    return np.zeros((len(truth.t), 2))


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
