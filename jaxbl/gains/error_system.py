"""The error system (34) with f_plus = 1 under its worst disturbance, over a plane of alpha / f_plus and lambda / √f_plus,
and what the gain conditions ask for, there and anywhere."""

import dataclasses
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from jaxbl.config import Config
from jaxbl.observer.conditions import CONDITIONS, Condition, least_lambda_davila_fridman, peak_ratio
from jaxbl.sweeps.elementwise import apply_elementwise

from .stages import Stages
from .worst_case import half_cycle, least_lambda_simulated

SWITCHING_LIMIT = 0.02
"""Relative distance from lambda^2 = 4 c2, the switching limit of the closed form, within which the two are not compared."""


@dataclasses.dataclass(frozen=True)
class Normalised:
    """The error system with f_plus = 1 under its worst disturbance.

    Attributes:
        alpha: alpha / f_plus, shape (alphas,).
        lambda_: lambda / sqrt(f_plus), shape (lambdas,).
        ratio: simulated ratio of successive velocity peaks, shape (lambdas, alphas).
        closed_form: the same by the closed form.
        boundary: least lambda at which the simulated peaks fall, by bisection, shape (alphas,).
        damped: such boundaries under viscous damping, by damping (friction / inertia x speed / f_plus).
    """

    alpha: np.ndarray
    lambda_: np.ndarray
    ratio: np.ndarray
    closed_form: np.ndarray
    boundary: np.ndarray
    damped: dict[float, np.ndarray]

    @property
    def difference(self) -> float:
        """Largest difference of simulated and closed-form ratio away from the switching limit."""
        edge = np.sqrt(8.0 * (self.alpha + 1.0))
        far = np.abs(self.lambda_[:, None] / edge - 1.0) > SWITCHING_LIMIT
        return float(np.abs(self.ratio - self.closed_form)[far].max())


@jax.jit
def _plane(lambda_: Any, alpha: Any) -> Any:
    one = jnp.ones_like(lambda_)
    return half_cycle(lambda_, alpha, one).ratio, peak_ratio(lambda_, alpha, one)


@jax.jit
def _border(alpha: Any, damping: Any) -> Any:
    return least_lambda_simulated(alpha, jnp.ones_like(alpha), damping=damping)


def simulate_error_system(config: Config, stages: Stages) -> Normalised:
    """Simulate the error system over the plane, or take it from the folder."""
    settings = config.verify
    alpha, lambda_ = settings.alpha_ratio.values(), settings.lambda_ratio.values()
    cells = [c.ravel() for c in np.meshgrid(lambda_, alpha, indexing="ij")]
    shape = (len(lambda_), len(alpha))
    dampings = [0.0, *settings.damping]

    def plane() -> pd.DataFrame:
        ratio, closed = apply_elementwise(_plane, cells, stages.devices)
        return pd.DataFrame({"lambda_ratio": cells[0], "alpha_ratio": cells[1], "ratio": ratio, "closed_form": closed})

    def borders() -> pd.DataFrame:
        # by bisection: as sharp on a coarse map as on a fine one
        columns = [np.tile(alpha, len(dampings)), np.repeat(dampings, len(alpha))]
        least = apply_elementwise(_border, columns, stages.devices)
        return pd.DataFrame({"alpha_ratio": columns[0], "damping": columns[1], "least_lambda_ratio": least})

    with jax.enable_x64(True):
        map_ = stages.table("normalised.parquet", plane)
        boundary = stages.table("boundaries.parquet", borders)["least_lambda_ratio"].to_numpy()
    ratio, closed = (map_[name].to_numpy().reshape(shape) for name in ("ratio", "closed_form"))
    boundaries = dict(zip(dampings, boundary.reshape(len(dampings), -1), strict=True))
    return Normalised(alpha, lambda_, ratio, closed, boundaries.pop(0.0), boundaries)


@cache
def _conditions(q: float | None) -> dict[str, Condition]:
    if q is None:
        return CONDITIONS
    return CONDITIONS | {
        "davila_fridman": Condition(f"Davila-Fridman (32), q = {q:g}", partial(least_lambda_davila_fridman, q=q))
    }


def conditions_of(config: Config) -> dict[str, Condition]:
    """The gain conditions, with the study's q in (32)."""
    return _conditions(config.verify.q)


@cache
def _demands(q: float | None) -> Callable[..., Any]:
    return jax.jit(lambda alpha, f_plus: {name: one.least_lambda(alpha, f_plus) for name, one in _conditions(q).items()})


def demanded_lambda(config: Config, alpha: np.ndarray, f_plus: np.ndarray) -> dict[str, np.ndarray]:
    """Least lambda (rad^0.5/s) that each condition asks for at alpha and f_plus (rad/s^2), with the study's q in (32)."""
    with jax.enable_x64(True):
        found = apply_elementwise(_demands(config.verify.q), [np.asarray(alpha, float), np.asarray(f_plus, float)])
    return {name: found[name] for name in conditions_of(config)}


def counted(config: Config, name: str, holds: np.ndarray, converged: np.ndarray) -> dict[str, Any]:
    """How many runs a condition judges rightly and wrongly, from bool arrays of one shape."""
    return {
        "name": name,
        "title": conditions_of(config)[name].title,
        "holds": int(holds.sum()),
        "counterexamples": int((holds & ~converged).sum()),
        "fails_but_converged": int((~holds & converged).sum()),
    }


def judge_error_system(config: Config, found: Normalised) -> dict[str, Any]:
    """Count the cells of the plane by condition: a level of `verdict.json`."""
    converged = found.ratio < 1.0
    conditions = []
    for name, demanded in demanded_lambda(config, found.alpha, np.ones_like(found.alpha)).items():
        ratios = demanded / found.boundary
        conservatism = {"median": np.median(ratios), "max": ratios.max(), "columns": len(ratios), "at_least": 0}
        holds = found.lambda_[:, None] > demanded
        conditions.append(counted(config, name, holds, converged) | {"conservatism": conservatism})
    return {
        "level": "normalised",
        "cells": found.ratio.size,
        "converged": int(converged.sum()),
        "conditions": conditions,
    }
