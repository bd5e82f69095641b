"""What a run's own disturbance, instead of the worst one, does to the error.

Gains that `[verify]` marks in the atlas are run once and judged; for those that miss the exact condition, the effect of the
run's own disturbance is computed as well. Of runs that converge although alpha is below their true f_plus, it is computed
how long the disturbance exceeds alpha, and which error it causes.
"""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from jaxbl.config import Config, read_config, with_values
from jaxbl.json_types import JsonObject
from jaxbl.observer.conditions import CONDITIONS, bisect, peak_ratio
from jaxbl.sweeps.elementwise import call_in_float64
from jaxbl.sweeps.trial import run

from .stages import Stages
from .under_tuned import Disturbance, SineError, excursion, peak_law, simulate_error
from .worst_case import half_cycle

_MOST_INPUTS = 32
"""Combinations of inputs and plants, evenly spread, that are run once more for their disturbance."""


def read_disturbance(drive: Any, side: str, trace: pd.DataFrame) -> Disturbance:
    """Return what disturbs the error of a side along a trace: the acceleration that the nominal model lacks.

    It is taken at the true velocity, and does not depend on the observer: f_plus contains the observer's velocity error as
    well.
    """
    velocity, torque, acceleration = (trace[name].to_numpy() for name in (f"{side}.velocity", "u", f"{side}.acceleration"))
    missing = acceleration - call_in_float64(partial(drive.acceleration, side), velocity, torque)
    return Disturbance(trace["t"].to_numpy(), missing, float(drive.viscous(side)) / float(drive.inertia(side)))


def summarise_converged_below(study: Config, side: str, frame: pd.DataFrame) -> JsonObject | None:
    """Summarise the converged runs of a level (`frame`) whose alpha is at most f_plus; None if there are none.

    Returns the number of `converged_runs`, and of the `runs` that were repeated. For the latter: how many have a disturbance
    that exceeds alpha, the largest share of time in which it does, and the largest excursion (rad/s) from zero, predicted
    and simulated, with the axis values of its run.
    """
    runs_below = frame[frame[f"{side}.converged"].astype(bool) & (frame[f"{side}.margin_alpha"] <= 1.0)]
    if not len(runs_below):
        return None
    paths = study.axis_paths
    inputs = [path for path in paths if not path.startswith(("observer.", "equivalent_control.", "identifier."))]
    groups = [group for _, group in runs_below.groupby(inputs, sort=True)] if inputs else [runs_below]
    rows = []
    for index in np.unique(np.linspace(0, len(groups) - 1, _MOST_INPUTS).astype(int)):
        group = groups[index]
        config = with_values(study, {path: group[path].iloc[0] for path in inputs})
        disturbance = read_disturbance(config.build().drive, side, run(config, backend="scan").trace)
        for alpha, runs in group.groupby(f"observer.{side}.alpha"):
            rows.append((excursion(float(alpha), disturbance), disturbance.share_above(alpha), runs, disturbance))
    predicted, _, runs, disturbance = max(rows, key=lambda row: row[0])
    # the least lambda damps the error least
    worst_run = runs.loc[runs[f"observer.{side}.lambda"].idxmin()]
    lambda_, alpha = (float(worst_run[f"observer.{side}.{gain}"]) for gain in ("lambda", "alpha"))
    return {
        "converged_runs": len(runs_below),
        "runs": sum(len(row[2]) for row in rows),
        "disturbance_exceeds": sum(len(row[2]) for row in rows if row[1] > 0.0),
        "share_above_alpha": max(row[1] for row in rows),
        "excursion_predicted": predicted,
        "excursion_simulated": simulate_error(lambda_, alpha, disturbance, velocity_error=0.0).largest,
        "at": {path: worst_run[path] for path in paths},
    }


def judge_marks(ideal: Config, stages: Stages) -> list[JsonObject]:
    """Judge the marked gains (`marks` of `verdict.json`): their bounds, margins and peak ratios.

    `ideal` is the study with ideal encoders.
    """
    judged, config = [], stages.config
    base = ideal.to_dict() | {"axes": [], "sweep": {}}
    drive = config.build().drive
    # the observer does not act on the drive: one run has the disturbance of all gains
    trace = run(read_config(base)).trace if config.verify.marks else None
    for side in config.sides:
        marks = [mark for mark in config.verify.marks if mark.side == side]
        if trace is None or not marks:
            continue
        pairs = [(mark.lambda_, mark.alpha) for mark in marks]
        gains = pd.DataFrame(pairs, columns=[f"observer.{side}.{gain}" for gain in ("lambda", "alpha")])
        runs = stages.repeat_runs(base, gains, "marks", side).to_dict("records")
        disturbance = read_disturbance(drive, side, trace)
        starts = tuple(float(base["observer"][side][f"{name}_error"]) for name in ("position", "velocity"))
        error, friction = abs(starts[1]), disturbance.damping
        for mark, pair, metrics in zip(marks, pairs, runs, strict=True):
            bound = np.float64(metrics[f"{side}.f_plus"])
            ratios = call_in_float64(_peak_ratios, *pair, bound, friction, error)
            explanation = None
            if float(ratios["peak_ratio"]) >= 1.0 and mark.alpha != 0.0 and np.isfinite(disturbance.values).all():
                explanation = _explain_convergence(*pair, disturbance, starts)
            judged.append(
                {
                    "name": mark.name,
                    "side": side,
                    "lambda": mark.lambda_,
                    "alpha": mark.alpha,
                    "f_plus": bound,
                    "alpha_ratio": mark.alpha / bound,
                    "lambda_ratio": mark.lambda_ / np.sqrt(bound),
                    "velocity_error": error,
                    "damping": friction * error / bound,
                    **ratios,
                    **{f"margin_{name}": metrics[f"{side}.margin_{name}"] for name in CONDITIONS},
                    "converged": metrics[f"{side}.converged"],
                    "convergence_time": metrics[f"{side}.convergence_time"],
                    "on_this_disturbance": explanation,
                }
            )
    return judged


_FALLEN_SHARE = 0.1
"""The time at which peaks have fallen to this share of the first one is reported."""


def _explain_convergence(lambda_: float, alpha: float, disturbance: Disturbance, starts: tuple[float, ...]) -> JsonObject:
    """Explain how gains that miss the exact condition behave under a disturbance.

    The numbers are predicted by :mod:`.under_tuned`, and simulated in continuous time. `starts` are the position error (rad)
    and the velocity error (rad/s) at t = 0.
    """
    (position, velocity), (times, values, friction) = starts, disturbance
    largest, share = float(np.abs(values).max()), disturbance.share_above(alpha)
    explanation: JsonObject = {"largest_disturbance": largest, "share_above_alpha": share}
    if share > 0.0:
        explanation["excursion_predicted"] = excursion(alpha, disturbance)
        explanation["excursion_simulated"] = simulate_error(lambda_, alpha, disturbance, velocity_error=0.0).largest
    elif any(starts):
        # the velocity error at the first zero of the position error, without losses
        peak = float(np.sqrt(velocity**2 + 2.0 * (alpha - values[0] * np.sign(position)) * abs(position)))
        predicted_peaks = peak_law(lambda_, alpha, disturbance, peak)
        path = simulate_error(lambda_, alpha, disturbance, position_error=position, velocity_error=velocity)
        # an error may end without another passage
        simulated_peaks = np.r_[times[0], path.times, path.end_time], np.r_[path.largest, path.peaks, 0.0]
        for name, peak_times, peaks in (("predicted", times, predicted_peaks), ("simulated", *simulated_peaks)):
            explanation[f"largest_{name}"] = float(peaks.max())
            index = np.flatnonzero(peaks > _FALLEN_SHARE * peak)[-1] + 1
            # inf or None: peaks are larger at the end of the run
            explanation[f"tenth_{name}"] = float(peak_times[index]) if index < len(peak_times) else None
    sine = SineError(lambda_, alpha, largest, friction)
    least = sine.predict_least_frequency()
    cycle: JsonObject = {"least_predicted": least, "least_simulated": sine.simulate_least_frequency()}
    if 0.0 < least < np.inf:
        # far enough above the least frequency
        cycle["frequency"] = frequency = 2.0 * least
        for name, sine_cycle in (
            ("predicted", sine.predict_cycle(frequency)),
            ("simulated", sine.simulate_cycle(frequency)),
        ):
            cycle[name] = sine_cycle and sine_cycle._asdict()
    return explanation | {"sine_cycle": cycle}


@jax.jit
def _peak_ratios(lambda_: Any, alpha: Any, f_plus: Any, friction: Any, starting_speed: Any) -> dict[str, Any]:
    """Return peak ratios: in closed form, with friction at the starting error, and under a constant disturbance.

    `upheld_velocity_error` (rad/s) is the one that the worst disturbance upholds against friction.
    """

    def damped_ratio(speed: Any) -> Any:
        return half_cycle(lambda_, alpha, f_plus, damping=friction, speed=speed).ratio

    # beyond this speed friction alone brakes harder than alpha
    braking_speed = (alpha + f_plus) / jnp.maximum(friction, 1e-12)
    least = 1e-6 * braking_speed
    # 40 halvings of seven decades: to a relative 1e-11
    log_ratio, _ = bisect(lambda log: damped_ratio(least * jnp.exp(log)) < 1.0, jnp.full_like(least, jnp.log(1e7)), 40)
    undamped = peak_ratio(lambda_, alpha, f_plus)
    start = jnp.where(starting_speed > 0.0, starting_speed, least)
    constant_ratios = [
        half_cycle(lambda_, alpha, f_plus, damping=friction, speed=start, outward=sign, homeward=sign).ratio
        for sign in (1.0, -1.0)
    ]
    return {
        "peak_ratio": undamped,
        "peak_ratio_damped": damped_ratio(start),
        "peak_ratio_constant": jnp.sqrt(constant_ratios[0] * constant_ratios[1]),
        "upheld_velocity_error": jnp.where(undamped < 1.0, 0.0, least * jnp.exp(log_ratio)),
    }
