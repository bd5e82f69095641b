"""Noise and disturbance that make a super-twisting observer's velocity error large: a search, for what proofs allow.

The error system is that of :mod:`.invariant_set`, in its units; every error found here is one that bounded noise and a
bounded missing acceleration do cause. The best adversaries come from an exploration (:mod:`.reachable`). Runs then try what
it found with parts flipped, steady and random switching, and feedback by regions of the phase plane.
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxbl.observer.super_twisting import DISCRETISATIONS, AbstractSuperTwisting

from . import reachable
from .invariant_set import ErrorSystem, Proof
from .reachable import Reached

_SIDE = 1e-6
"""Innovation, over 1 + N, from which on its sign is sure."""
_LANES = 1 << 14
_LEAST, _MOST = 100, 2_000
"""Samples of a run from rest: by the length of the way that the exploration found."""
_FROM_START = 0.1
"""Part of the runs that begin with starting errors, and last until the errors have settled."""
_RATES = (1e-3, 0.5)
"""Least and largest rate of switching, or of flips, in a sample."""


_ROUNDING = 1e-9
"""Relative: by so much an error is above a bound at least."""


class Sequence(NamedTuple):
    """Choices of an adversary, sample by sample, arrays of one shape: noise, mean and moment (m and q) of the missing
    acceleration, and the sign of the nominal one."""

    noise: Any
    mean: Any
    moment: Any
    nominal: Any


class Search(NamedTuple):
    """What an adversary found.

    Attributes:
        runs: simulated, each of many samples.
        explored: states of the exploration, each at the end of a run of its own.
        worst: largest error of the velocity estimate from rest, f⁺ T.
        latest: last sample at which a run from the starting errors was above the settled bound; -1 if none was.
        violations: runs with an error above the bound of its sample; the exploration counts as one.
        sequence: choices that lead from rest to the worst error of the exploration.
    """

    runs: int
    explored: int
    worst: float
    latest: int
    violations: int
    sequence: Sequence


def explore(observer: AbstractSuperTwisting, system: ErrorSystem) -> tuple[Reached, Sequence]:
    """Errors of this observer that can be reached from rest, and the way to the worst one; for use with x64 enabled."""
    n, a = system.noise, system.alpha
    # the ends of the sliding set; a switch of which rounding would decide is left out
    ends = np.array([a, -a, 0.0] if system.implicit else [_SIDE * (1.0 + n), -_SIDE * (1.0 + n)])
    # of one sign, and with a switch in the middle of the period; the nominal acceleration with it or against it
    signs = (1.0, -1.0) if system.push else (1.0,)
    mean, moment, nominal = np.array([(*one, sign) for one in ((1.0, 0.5), (0.0, 0.25)) for sign in signs]).T

    def noises(states: np.ndarray) -> np.ndarray:
        extreme = np.clip(ends[:, None] - states[:, 0], -n, n)
        return np.concatenate([extreme, np.full((1, len(states)), n), np.full((1, len(states)), -n)])

    found = reachable.explore(
        reachable.step_of(observer), noises, np.column_stack([moment + 0.5 * system.push * nominal, mean])
    )
    return found, Sequence(found.noise, *(found.sign * x[found.push] for x in (mean, moment, nominal)))


class _Lanes(NamedTuple):
    """Adversaries of a batch, one each lane."""

    kind: Any
    """0: a sequence with flips, 1: random switching, 2: steady switching, 3: feedback."""
    rate: Any
    """Of switching or of flips in a sample, of noise and acceleration, shape (2, lanes)."""
    back: Any
    """Rate at which a flip ends; shape (lanes,)."""
    phase: Any
    """Of steady switching, in cycles, shape (2, lanes)."""
    line: Any
    """Feedback: slope in lambda and offset in f⁺ T of the lines, of noise and of acceleration each, shape (4, lanes)."""
    mean: Any
    """Mean m of an acceleration with one switch in a period."""
    side: Any
    """Sign of what that switch and the nominal acceleration add to the position."""
    position: Any
    velocity: Any
    bits: Any
    """State of the random numbers."""


def _drawn(rng: np.random.Generator, system: ErrorSystem, start: tuple[float, float]) -> _Lanes:
    """A batch of adversaries, all kinds in turn; `start`: largest errors, of position and velocity."""
    shape, root = (_LANES,), math.sqrt(1.0 + system.noise)
    low, high = np.log(_RATES)
    rates = np.exp(rng.uniform(low, high, (2, _LANES)))
    lines = np.concatenate([rng.uniform(-1.0, 2.0, (2, _LANES)), 0.5 * root * rng.normal(size=(2, _LANES))])
    # lines through the origin, and the sign of the velocity error
    lines[2:, rng.random(_LANES) < 0.5] = 0.0
    lines[:2, rng.random(_LANES) < 0.1] = 0.0
    corner = np.where(
        rng.random((2, _LANES)) < 0.7, np.sign(rng.normal(size=(2, _LANES))), rng.uniform(-1.0, 1.0, (2, _LANES))
    )
    return _Lanes(
        kind=np.arange(_LANES) % 4,
        rate=rates,
        back=np.where(rng.random(_LANES) < 0.7, 0.4, rates[0]),
        phase=rng.random((2, _LANES)),
        line=lines,
        mean=np.where(rng.random(_LANES) < 0.8, 1.0, rng.random(_LANES)),
        side=np.sign(rng.normal(size=shape)),
        position=start[0] * corner[0],
        velocity=start[1] * corner[1],
        bits=rng.integers(1, 2**32, _LANES, dtype=np.uint32),
    )


def _uniform(bits: Array) -> tuple[Array, Array]:
    """The next state of xorshift (G. Marsaglia, 2003), and a number in 0 ... 1."""
    for left, right in ((13, 0), (0, 17), (5, 0)):
        bits = bits ^ ((bits << left) if left else (bits >> right))
    return bits, bits.astype(float) / 2.0**32


@functools.partial(jax.jit, static_argnames="keep")
def _run(
    observer: AbstractSuperTwisting,
    noise_bound: Array,
    push: Array,
    lanes: _Lanes,
    sequence: Sequence,
    bounds: Array,
    settled: Array,
    keep: bool = False,
) -> tuple[Array, Array, Array, Any]:
    """Each lane's largest error, whether it went above a bound, and the last sample above `settled`; by the observer's own
    step on a double integrator. With `keep` the choices, too."""

    def one(carry: tuple[Any, ...], given: tuple[Any, ...]) -> tuple[tuple[Any, ...], Any]:
        state, position, velocity, bits, signs, worst, above, latest = carry
        k, taken, bound = given
        e, g = position - state.position, velocity - state.velocity
        replay, root = lanes.kind == 0, jnp.sign(e) * jnp.sqrt(jnp.abs(e))
        own, new_signs = [], []
        for i in range(2):
            bits, drawn = _uniform(bits)
            rate = jnp.where(replay & (signs[i] < 0.0), lanes.back, lanes.rate[i])
            new_signs.append(jnp.where(drawn < rate, -signs[i], signs[i]))
            steady = jnp.where((k * lanes.rate[i] + lanes.phase[i]) % 1.0 < 0.5, 1.0, -1.0)
            led = jnp.where(g - lanes.line[i] * observer.lambda_ * root - lanes.line[2 + i] >= 0.0, 1.0, -1.0)
            own.append(jnp.where(lanes.kind == 1, new_signs[i], jnp.where(lanes.kind == 2, steady, led)))
        noise = jnp.where(replay, taken.noise * new_signs[0], -noise_bound * own[0])
        mean = jnp.where(replay, taken.mean * new_signs[1], own[1] * lanes.mean)
        moment = 0.5 * own[1] * lanes.mean + 0.25 * lanes.side * (1.0 - lanes.mean**2)
        moment = jnp.where(replay, taken.moment * new_signs[1], moment)
        nominal = jnp.where(replay, taken.nominal * new_signs[1], lanes.side)
        state, estimate = observer.step(state, position + noise, lambda _: push * nominal, jnp.ones(()))
        error = jnp.abs(estimate.velocity - velocity)
        new = (
            state,
            position + velocity + moment + 0.5 * push * nominal,
            velocity + mean + push * nominal,
            bits,
            tuple(new_signs),
            jnp.maximum(worst, error),
            above | (error > bound * (1.0 + _ROUNDING)),
            jnp.where(error > settled * (1.0 + _ROUNDING), k, latest),
        )
        return new, Sequence(noise, mean, moment, nominal) if keep else None

    flat = jnp.zeros_like(lanes.position)
    start = observer.start(flat, flat, lambda _: flat, jnp.ones(()))
    ones, k = flat + 1.0, jnp.arange(bounds.shape[0])
    carry = start, lanes.position, lanes.velocity, lanes.bits, (ones, ones), flat, flat > 0.0, jnp.full(flat.shape, -1)
    (*_, worst, above, latest), kept = jax.lax.scan(one, carry, (k, sequence, bounds))
    return worst, above, latest, kept


def search(
    system: ErrorSystem,
    position: float,
    velocity: float,
    proof: Proof,
    settled: float,
    runs: int,
    seed: int = 0,
) -> Search:
    """Look for errors above what is proven, in so many runs.

    Args:
        system: the error system.
        position, velocity: largest errors at the start, f⁺ T² and f⁺ T.
        proof: what is proven for this system and start.
        settled: the bound that counts after the reaching time, f⁺ T.
        runs: at least so many are simulated; rounded up to whole batches.
        seed: of what is drawn at random.
    """
    name = "implicit" if system.implicit else "explicit"
    rng, batches = np.random.default_rng(seed), max(1, math.ceil(runs / _LANES))
    with jax.enable_x64(True):
        observer = DISCRETISATIONS[name](jnp.asarray(system.lambda_), jnp.asarray(system.alpha))
        explored, best = explore(observer, system)
        rest = np.full(min(max(_LEAST, math.ceil(1.2 * len(best.noise))), _MOST), proof.bounds[-1])
        after = np.concatenate([proof.bounds, rest])
        worst, latest, violations = explored.worst, -1, int(explored.worst > rest[0] * (1.0 + _ROUNDING))
        bound, push = jnp.asarray(system.noise), jnp.asarray(system.push)

        def run(lanes: _Lanes, limits: np.ndarray, keep: bool = False) -> tuple[Any, ...]:
            given = _extended(best, len(limits))
            return jax.tree.map(np.asarray, _run(observer, bound, push, lanes, given, limits, np.asarray(settled), keep))

        for batch in range(batches):
            from_start = batch % round(1.0 / _FROM_START) == 0
            lanes = _drawn(rng, system, (position, velocity) if from_start else (0.0, 0.0))
            limits = after if from_start else rest
            most, above, late, _ = run(lanes, limits)
            violations += int(above.sum())
            if from_start:
                latest = max(latest, int(late.max()))
                continue
            k = int(np.where(lanes.kind == 0, most, 0.0).argmax())
            if most[k] > worst:
                # what it chose is the sequence of the batches that follow
                alone = _Lanes(*(x[..., k : k + 1] for x in lanes))
                kept = run(alone, limits, keep=True)[3]
                best = Sequence(*(x[:, 0] for x in kept))
            worst = max(worst, float(most.max()))
    return Search(batches * _LANES, explored.kept, worst, latest, violations, best)


def _extended(sequence: Sequence, samples: int) -> Sequence:
    """The sequence again and again, for so many samples."""
    return Sequence(*(np.resize(x, samples) for x in sequence))
