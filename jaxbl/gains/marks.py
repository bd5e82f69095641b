"""Gains that `[verify]` marks in the atlas: each run once, and judged."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.config import Config
from jaxbl.observer.conditions import CONDITIONS, peak_ratio
from jaxbl.observer.worst_case import half_cycle

from .stages import Stages


def judge_marks(config: Config, ideal: Config, stages: Stages) -> list[dict[str, Any]]:
    """Bounds, margins and peak ratios of the marked gains, on the study's drive with ideal encoders (`ideal`)."""
    found = []
    base = ideal.resolved()
    drive = config.build().drive
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
        friction = float(drive.viscous(side)) / float(drive.inertia(side))
        bounds = frame[f"{side}.f_plus"].to_numpy(float)
        with jax.enable_x64(True):
            given = (jnp.asarray(x, float) for x in (gains["lambda"], gains["alpha"], bounds))
            ratios = jax.jit(_ratios)(*given, jnp.asarray(friction, float), jnp.asarray(error, float))
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
                    **{name: np.asarray(values)[i] for name, values in ratios.items()},
                    **{f"margin_{name}": row[f"margin_{name}"] for name in CONDITIONS},
                    "converged": bool(row["converged"]),
                    "convergence_time": row["convergence_time"],
                }
            )
    return found


def _ratios(lambda_: Any, alpha: Any, f_plus: Any, friction: Any, error: Any) -> dict[str, Any]:
    """Peak ratios of some gains: in closed form, with the drive's friction at the starting error, and under a disturbance
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
