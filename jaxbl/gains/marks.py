"""Gains that `[verify]` marks in the atlas: each run once, and judged; those that miss the exact condition also by what the
run's own disturbance does to them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.config import Config, read_config
from jaxbl.observer.conditions import CONDITIONS, peak_ratio
from jaxbl.sweeps.trial import run

from .below_bound import disturbance, friction_of, share_above
from .stages import Stages
from .under_tuned import (
    excursion,
    least_cycle_frequency,
    least_cycle_frequency_simulated,
    peak_law,
    simulate_error,
    sine_cycle,
    sine_cycle_simulated,
)
from .worst_case import half_cycle


def judge_marks(config: Config, ideal: Config, stages: Stages) -> list[dict[str, Any]]:
    """Bounds, margins and peak ratios of the marked gains, on the study's drive with ideal encoders (`ideal`)."""
    found = []
    base = ideal.to_dict()
    drive = config.build().drive
    # the observer does not act on the drive: one run has the disturbance of all gains
    trace = run(read_config(base | {"axes": [], "sweep": {}})).trace if config.verify.marks else None
    for side in ("motor", "load"):
        marks = [given for given in config.verify.marks if given.side == side]
        if not marks:
            continue
        gains = {"lambda": [given.lambda_ for given in marks], "alpha": [given.alpha for given in marks]}
        pairs = list(zip(*gains.values(), strict=True))
        points = list(dict.fromkeys(pairs))
        axes = [
            {"path": f"observer.{side}.{name}", "values": list(values), "zip": "marks"}
            for name, values in zip(gains, zip(*points, strict=True), strict=True)
        ]
        frame = stages.rerun(base | {"axes": axes, "sweep": {}}, "marks", side)
        frame = frame.iloc[[points.index(pair) for pair in pairs]]
        error = abs(float(base["observer"][side]["velocity_error"]))
        starts = tuple(float(base["observer"][side][f"{name}_error"]) for name in ("position", "velocity"))
        friction = friction_of(drive, side)
        bounds = frame[f"{side}.f_plus"].to_numpy(float)
        with jax.enable_x64(True):
            # one by one, by one program for any number of them
            given = ((*pair, bound, friction, error) for pair, bound in zip(pairs, bounds, strict=True))
            ratios = [_ratios(*map(np.float64, one)) for one in given]
        assert trace is not None
        missing = disturbance(drive, side, trace)
        for i, (given, bound) in enumerate(zip(marks, bounds, strict=True)):
            row = {name.partition(".")[2]: frame[name].iloc[i] for name in frame.columns if name.startswith(side)}
            found.append(
                {
                    "name": given.name,
                    "side": side,
                    "lambda": given.lambda_,
                    "alpha": given.alpha,
                    "f_plus": bound,
                    "alpha_ratio": given.alpha / bound,
                    "lambda_ratio": given.lambda_ / np.sqrt(bound),
                    "velocity_error": error,
                    "damping": friction * error / bound,
                    **{name: float(one) for name, one in ratios[i].items()},
                    **{f"margin_{name}": row[f"margin_{name}"] for name in CONDITIONS},
                    "converged": bool(row["converged"]),
                    "convergence_time": row["convergence_time"],
                    "on_this_disturbance": None
                    if float(ratios[i]["peak_ratio"]) < 1.0 or given.alpha == 0.0 or not np.isfinite(missing).all()
                    else _explained(given.lambda_, given.alpha, trace["t"].to_numpy(), missing, friction, starts),
                }
            )
    return found


_FEWER = 0.1
"""Peak over the first one, whose time says how fast they fall."""


def _explained(
    lambda_: float,
    alpha: float,
    times: np.ndarray,
    missing: np.ndarray,
    friction: float,
    starts: tuple[float, ...],
) -> dict[str, Any]:
    """What a disturbance (rad/s^2) does to gains that miss the exact condition, by :mod:`.under_tuned`:
    predicted, and simulated in continuous time. `starts` are position error (rad) and velocity error (rad/s) at t = 0."""
    position, velocity = starts
    largest = float(np.abs(missing).max())
    share = share_above(alpha, missing)
    given = {"times": times, "disturbance": missing, "damping": friction}
    found: dict[str, Any] = {"largest_disturbance": largest, "share_above_alpha": share}
    if share > 0.0:
        found["excursion_predicted"] = excursion(alpha, **given)
        found["excursion_simulated"] = simulate_error(lambda_, alpha, **given, velocity_error=0.0).largest
    elif any(starts):
        # what a position error comes to at its first passage through zero, less what is lost until then
        peak = float(np.sqrt(velocity**2 + 2.0 * (alpha - missing[0] * np.sign(position)) * abs(position)))
        law = peak_law(lambda_, alpha, **given, peak=peak)
        path = simulate_error(lambda_, alpha, **given, position_error=position, velocity_error=velocity)
        # an error may end without another passage
        passed = np.r_[times[0], path.times, path.gone], np.r_[path.largest, path.peaks, 0.0]
        for name, at, peaks in (("predicted", times, law), ("simulated", *passed)):
            found[f"largest_{name}"] = float(peaks.max())
            fallen = np.flatnonzero(peaks > _FEWER * peak)[-1] + 1
            # inf or none: at the end of the run they are larger
            found[f"tenth_{name}"] = float(at[fallen]) if fallen < len(at) else None
    least = least_cycle_frequency(lambda_, alpha, largest, friction)
    cycle: dict[str, Any] = {"least_predicted": least, "least_simulated": None}
    if 0.0 < least < np.inf:
        # well beyond where the cycle begins
        frequency = 2.0 * least
        predicted, simulated = (
            of(lambda_, alpha, largest, frequency, friction) for of in (sine_cycle, sine_cycle_simulated)
        )
        cycle["least_simulated"] = least_cycle_frequency_simulated(lambda_, alpha, largest, friction)
        cycle |= {"frequency": frequency, "predicted": predicted and predicted._asdict()}
        cycle |= {"simulated": simulated and simulated._asdict()}
    return found | {"sine_cycle": cycle}


@jax.jit
def _ratios(lambda_: Any, alpha: Any, f_plus: Any, friction: Any, error: Any) -> dict[str, Any]:
    """Peak ratios of gains: in closed form, with the drive's friction at the starting error, and under a disturbance
    that never changes; and the velocity error (rad/s) that the worst disturbance upholds against friction."""

    def damped(speed: Any) -> Any:
        return half_cycle(lambda_, alpha, f_plus, damping=friction, speed=speed).ratio

    def halve(bounds: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], None]:
        low, high = bounds
        middle = jnp.sqrt(low * high)
        grows = damped(middle) >= 1.0
        return (jnp.where(grows, middle, low), jnp.where(grows, high, middle)), None

    rest = (alpha + f_plus) / jnp.maximum(friction, 1e-12)  # friction alone brakes harder than alpha beyond this speed
    # 40 halvings of seven decades: to a relative 1e-11
    (upheld, _), _ = jax.lax.scan(halve, (1e-6 * rest, 10.0 * rest), length=40)
    undamped = peak_ratio(lambda_, alpha, f_plus)
    start = jnp.where(error > 0.0, error, 1e-6 * rest)
    still = [
        half_cycle(lambda_, alpha, f_plus, damping=friction, speed=start, outward=d, homeward=d).ratio for d in (1.0, -1.0)
    ]
    return {
        "peak_ratio": undamped,
        "peak_ratio_damped": damped(start),
        "peak_ratio_constant": jnp.sqrt(still[0] * still[1]),
        "upheld_velocity_error": jnp.where(undamped < 1.0, 0.0, upheld),
    }
