"""Which effects could explain what a fit leaves: linear regression of its residuals on all candidates at once.

The residuals are those of a trajectory fit (prediction errors or free runs on windows), so that records in closed loop and
integrating drives are handled, and noise of derivatives, which biases regressions of torques, does not come in. The model's
own numbers take part with their prior, else they would absorb an effect, or an effect would stand in for them. Everything
after the derivatives is small dense algebra: singles and pairs of candidates cost next to nothing.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbl.drive.plant import PlantState
from jaxbl.identification.trajectory import Free, Windows, projected_residual, with_values
from jaxbl.simulate import Experiment

from .candidates import Candidate, neutral_of


class Columns(NamedTuple):
    """Residuals and derivatives, window by window, as products.

    Attributes:
        products: of all columns with one another and with the residuals, which come last;
            shape (windows, columns + 1, columns + 1).
        nuisance: how many columns are the model's own numbers; they come first.
        places: columns of each candidate.
        samples: residuals in each window.
    """

    products: Float[np.ndarray, "windows columns columns"]
    nuisance: int
    places: tuple[tuple[int, ...], ...]
    samples: int


def columns_of(
    experiment: Experiment,
    free: Sequence[Free],
    theta: Float[Array, " parameters"],
    windows: Windows,
    candidates: Sequence[Candidate],
) -> Columns:
    """Derivatives of a fit's residuals by its own numbers and by what every candidate would add.

    Args:
        experiment: with its nominal numbers.
        free: the numbers that were fitted.
        theta: where the fit ended.
        windows: the record.
        candidates: of :func:`jaxbl.discrepancy.candidates.candidates_for`.
    """
    known = len(experiment.effects)
    extended = eqx.tree_at(
        lambda e: e.effects, experiment, (*experiment.effects, *(effect for one in candidates for effect in one.effects))
    )
    windows = dataclasses.replace(windows, start=_started(extended, windows))
    firsts = known + np.cumsum([0, *(len(one.effects) for one in candidates[:-1])])
    leaves = [(int(first) + c.instance, c.leaf) for first, one in zip(firsts, candidates, strict=True) for c in one.columns]
    trials = [c.trial for one in candidates for c in one.columns]
    neutral = jnp.asarray([value for one in candidates for value in neutral_of(one)], float)
    sloped = np.array([trial is None for trial in trials])
    values = jnp.asarray([0.0 if trial is None else trial for trial in trials], float)
    products = np.asarray(
        _products(extended, tuple(free), theta, windows, tuple(leaves), neutral, values, tuple(sloped.tolist()))
    )
    # columns come with the derivatives first, then those of the trials
    order = np.argsort(np.concatenate([np.flatnonzero(sloped), np.flatnonzero(~sloped)]))
    n = len(free)
    order = np.concatenate([np.arange(n), n + order, [products.shape[1] - 1]])
    products = products[:, order][:, :, order]
    ends = n + np.cumsum([0, *(len(one.columns) for one in candidates)])
    places = tuple(tuple(range(a, b)) for a, b in itertools.pairwise(ends))
    return Columns(products, n, places, int(windows.torque.shape[1]) * len(experiment.sides))


def _started(extended: Experiment, windows: Windows) -> PlantState:
    """Initial states with those of the candidates: an actuator's is what the input just asked for."""
    states = list(windows.start.effects)
    for effect in extended.effects[len(states) :]:
        begun = windows.torque[:, 0] if effect.place == "actuator" else jnp.zeros(len(windows.time))
        states.append(jax.tree.map(lambda x, begun=begun: jnp.broadcast_to(x, begun.shape) + begun, effect.init()))
    return PlantState(windows.start.position, windows.start.velocity, tuple(states))


@eqx.filter_jit
def _products(
    extended: Experiment,
    free: tuple[Free, ...],
    theta: Array,
    windows: Windows,
    leaves: tuple[tuple[int, str], ...],
    neutral: Array,
    trials: Array,
    sloped: tuple[bool, ...],
) -> Array:
    slopes = [i for i, one in enumerate(sloped) if one]
    steps = [i for i, one in enumerate(sloped) if not one]

    def residual(theta: Array, sizes: Array) -> Array:
        at = eqx.tree_at(
            lambda e: [getattr(e.effects[i], leaf) for i, leaf in leaves], extended, [sizes[i] for i in range(len(leaves))]
        )
        return projected_residual(with_values(at, free, theta), windows)[0]

    def by_size(theta: Array, sizes: Array) -> Array:
        return residual(theta, neutral.at[jnp.asarray(slopes)].set(sizes))

    value = residual(theta, neutral)
    own, others = jax.jacfwd(by_size, argnums=(0, 1))(theta, neutral[jnp.asarray(slopes)])
    columns = [own, others]
    if steps:
        tried = jnp.stack([neutral.at[i].set(trials[i]) for i in steps])
        columns.append(jnp.moveaxis(jax.vmap(lambda sizes: residual(theta, sizes))(tried) - value[None], 0, -1))
    both = jnp.concatenate([*columns, value[..., None]], axis=-1)
    both = both.reshape(both.shape[0], -1, both.shape[-1])
    return jnp.einsum("wni,wnj->wij", both, both)


class Score(NamedTuple):
    """What some candidates together would explain.

    Attributes:
        which: their indices.
        gain: by how much the sum of squared residuals, in units of their variance, would fall; prior counted.
        unseen: the same on windows that the coefficients were not found on.
        coefficients: of their columns.
        deviation: their standard deviations.
    """

    which: tuple[int, ...]
    gain: float
    unseen: float
    coefficients: np.ndarray
    deviation: np.ndarray


_FOLDS = 4


def scores(columns: Columns, prior: Sequence[float], variance: float, most: int = 1) -> list[Score]:
    """Score all candidates, and all sets of up to `most` of them, best first.

    Args:
        columns: of :func:`columns_of`.
        prior: standard deviation of each of the model's own numbers (relative), about the values at which the fit was
            begun less where it ended.
        variance: of the residuals.
        most: candidates in a set.
    """
    precision = np.array([1.0 / one**2 for one in prior])
    folds = [np.arange(len(columns.products)) % _FOLDS == i for i in range(min(_FOLDS, len(columns.products)))]
    whole = columns.products.sum(axis=0) / variance
    parts = [columns.products[fold].sum(axis=0) / variance for fold in folds]
    found = []
    for count in range(1, most + 1):
        for which in itertools.combinations(range(len(columns.places)), count):
            chosen = [place for i in which for place in columns.places[i]]
            found.append(_score(columns, which, chosen, precision, whole, parts))
    return sorted(found, key=lambda one: -one.gain)


def _solved(products: np.ndarray, chosen: np.ndarray, precision: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of columns that explain the residuals best, and their covariance."""
    matrix = products[np.ix_(chosen, chosen)] + np.diag(np.concatenate([precision, np.zeros(len(chosen) - len(precision))]))
    size = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    inverse = np.linalg.pinv(matrix / np.outer(size, size), rcond=1e-12, hermitian=True) / np.outer(size, size)
    # a residual is measured less simulated: what the columns add must take it away
    return -inverse @ products[chosen, -1], inverse


def _left(products: np.ndarray, chosen: np.ndarray, coefficients: np.ndarray) -> float:
    """Sum of squared residuals once the columns are in."""
    inner = products[np.ix_(chosen, chosen)]
    return float(products[-1, -1] + 2.0 * coefficients @ products[chosen, -1] + coefficients @ inner @ coefficients)


def _score(
    columns: Columns,
    which: tuple[int, ...],
    chosen: Sequence[int],
    precision: np.ndarray,
    whole: np.ndarray,
    parts: Sequence[np.ndarray],
) -> Score:
    own = np.arange(columns.nuisance)
    both = np.concatenate([own, np.asarray(chosen, int)])

    def cost(products: np.ndarray, places: np.ndarray, values: np.ndarray) -> float:
        return _left(products, places, values) + float(precision @ values[: len(own)] ** 2)

    without, _ = _solved(whole, own, precision)
    within, covariance = _solved(whole, both, precision)
    gain = cost(whole, own, without) - cost(whole, both, within)
    unseen = 0.0
    for part in parts:
        others = whole - part
        unseen += _left(part, own, _solved(others, own, precision)[0])
        unseen -= _left(part, both, _solved(others, both, precision)[0])
    tail = slice(len(own), None)
    return Score(which, gain, unseen, within[tail], np.sqrt(np.diag(covariance))[tail])


def best_of_each(found: Sequence[Score], candidates: Sequence[Candidate]) -> Mapping[str, Score]:
    """The best variant of every effect, from scores of single candidates."""
    best: dict[str, Score] = {}
    for one in found:
        if len(one.which) == 1:
            best.setdefault(candidates[one.which[0]].name, one)
    return best
