"""The error system (34) with f_plus = 1 under its worst disturbance, over a plane of alpha / f_plus and lambda / √f_plus,
and the least lambda of each gain condition."""

import dataclasses
from collections.abc import Iterator
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from jaxbl.config import Config
from jaxbl.json_types import JsonObject
from jaxbl.observer.conditions import CONDITIONS, Condition, least_lambda_davila_fridman, peak_ratio
from jaxbl.sweeps.elementwise import apply_elementwise

from .stages import Stages
from .worst_case import half_cycle, least_lambda_simulated

SWITCHING_LIMIT = 0.02
"""Simulation and closed form are not compared within this relative distance of lambda^2 = 4 c2, where the form changes."""


@dataclasses.dataclass(frozen=True)
class ErrorSystemMap:
    """Peak ratios of the error system with f_plus = 1 under its worst disturbance.

    Attributes:
        alpha: alpha / f_plus, shape (alphas,).
        lambda_: lambda / sqrt(f_plus), shape (lambdas,).
        ratio: simulated ratio of successive velocity peaks, shape (lambdas, alphas).
        difference: largest one between simulated and closed-form ratio, away from the switching limit.
        boundary: least lambda at which the simulated peaks fall, by bisection, shape (alphas,).
        boundary_by_damping: the same under viscous damping (friction / inertia x speed / f_plus).
    """

    alpha: np.ndarray
    lambda_: np.ndarray
    ratio: np.ndarray
    difference: float
    boundary: np.ndarray
    boundary_by_damping: dict[float, np.ndarray]


@jax.jit
def normalised_peak_ratios(lambda_: Any, alpha: Any) -> Any:
    """Return the simulated ratio of successive peaks at f_plus = 1, and that of the closed form."""
    f_plus = jnp.ones_like(lambda_)
    return half_cycle(lambda_, alpha, f_plus).ratio, peak_ratio(lambda_, alpha, f_plus)


@jax.jit
def _least_lambda(alpha: Any, damping: Any) -> Any:
    return least_lambda_simulated(alpha, jnp.ones_like(alpha), damping=damping)


def simulate_error_system(stages: Stages) -> ErrorSystemMap:
    """Simulate the error system over the plane, or read it from the folder."""
    settings = stages.config.verify
    alpha, lambda_ = settings.alpha_ratio.values(), settings.lambda_ratio.values()
    cells = [c.ravel() for c in np.meshgrid(lambda_, alpha, indexing="ij")]
    dampings = [0.0, *settings.damping]

    def compute_map() -> pd.DataFrame:
        ratio, closed = apply_elementwise(normalised_peak_ratios, cells, stages.devices)
        return pd.DataFrame({"lambda_ratio": cells[0], "alpha_ratio": cells[1], "ratio": ratio, "closed_form": closed})

    def compute_boundaries() -> pd.DataFrame:
        # by bisection: as sharp on a coarse map as on a fine one
        columns = [np.tile(alpha, len(dampings)), np.repeat(dampings, len(alpha))]
        least = apply_elementwise(_least_lambda, columns, stages.devices)
        return pd.DataFrame({"alpha_ratio": columns[0], "damping": columns[1], "least_lambda_ratio": least})

    with jax.enable_x64(True):
        map_ = stages.read_or_compute("normalised.parquet", compute_map)
        boundary = stages.read_or_compute("boundaries.parquet", compute_boundaries)["least_lambda_ratio"].to_numpy()
    ratio, closed_form = (map_[name].to_numpy() for name in ("ratio", "closed_form"))
    is_far = np.abs(cells[0] / np.sqrt(8.0 * (cells[1] + 1.0)) - 1.0) > SWITCHING_LIMIT
    difference = float(np.abs(ratio - closed_form)[is_far].max())
    boundaries = dict(zip(dampings, boundary.reshape(len(dampings), -1), strict=True))
    return ErrorSystemMap(alpha, lambda_, ratio.reshape(len(lambda_), -1), difference, boundaries.pop(0.0), boundaries)


@cache
def list_conditions(q: float | None) -> dict[str, Condition]:
    """Return the gain conditions by name, with the study's q in (32); cached, as compiled programs are by the function."""
    if q is None:
        return CONDITIONS
    return CONDITIONS | {
        "davila_fridman": Condition(f"Davila-Fridman (32), q = {q:g}", partial(least_lambda_davila_fridman, q=q))
    }


def judge_conditions(
    q: float | None, lambda_: np.ndarray, alpha: np.ndarray, f_plus: np.ndarray, converged: np.ndarray
) -> Iterator[tuple[JsonObject, np.ndarray, np.ndarray]]:
    """Count the runs that each gain condition judges rightly and wrongly, with the study's q in (32).

    Yields for each condition its counts, where it holds, and the least lambda (rad^0.5/s) that it demands. Alpha and f_plus
    (rad/s^2) have one shape, to which those of lambda and `converged` broadcast.
    """
    for name, condition in list_conditions(q).items():
        with jax.enable_x64(True):
            demanded = apply_elementwise(condition.least_lambda, [alpha, f_plus])
        holds = lambda_ > demanded
        counts = {
            "name": name,
            "title": condition.title,
            "holds": int(holds.sum()),
            "counterexamples": int((holds & ~converged).sum()),
            "fails_but_converged": int((~holds & converged).sum()),
        }
        yield counts, holds, demanded


def summarise_ratios(ratios: np.ndarray, at_least: int = 0) -> JsonObject:
    """Summarise the ratios of demanded lambda to the least that works; in `at_least` columns the true one is larger."""
    columns = pd.Series(ratios)
    return {"median": columns.median(), "max": columns.max(), "columns": len(columns), "at_least": at_least}


def judge_error_system(config: Config, error_map: ErrorSystemMap) -> JsonObject:
    """Count the cells of the plane by condition: a level of `verdict.json`."""
    converged, alpha = error_map.ratio < 1.0, error_map.alpha
    judgements = judge_conditions(config.verify.q, error_map.lambda_[:, None], alpha, np.ones_like(alpha), converged)
    return {
        "level": "normalised",
        "cells": error_map.ratio.size,
        "converged": int(converged.sum()),
        "conditions": [
            counts | {"conservatism": summarise_ratios(demanded / error_map.boundary)} for counts, _, demanded in judgements
        ],
    }
