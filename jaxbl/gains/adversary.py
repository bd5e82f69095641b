"""A search for noise and disturbances that make a super-twisting observer's velocity error large: it tests proven bounds.

The error system and its units are those of :mod:`.invariant_set`. Bounded noise and a bounded missing acceleration can cause
every error that is found here. The best adversaries come from an exploration of states (:mod:`.reachable`). Further runs try
its sequence with parts flipped, steady and random switching, and feedback by regions of the phase plane.
"""

import functools
import math
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxbl.observer.super_twisting import DISCRETISATIONS, AbstractSuperTwisting
from jaxbl.workers import check_cost

from . import reachable
from .invariant_set import ErrorSystem, Proof
from .reachable import Reached

_SIGN_MARGIN = 1e-6
"""Least innovation, over 1 + N, whose sign does not depend on rounding."""
_LANES = 1 << 14
_LEAST_SAMPLES, _MOST_SAMPLES = 100, 2_000
"""Limits of the samples of a run from rest; it is a little longer than the explored sequence."""
_BATCHES_FROM_START = 10
"""One batch in so many begins with starting errors, and lasts until the errors have settled."""
_RATE_RANGE = (1e-3, 0.5)
"""Least and largest rate of switching, or of flips, in a sample."""
_ROUNDING = 1e-9
"""Least relative excess over a bound that counts as a violation."""


class Sequence(NamedTuple):
    """Choices of an adversary by sample: noise, mean and moment (m and q) of the missing acceleration, and the sign of the
    nominal one. All arrays have one shape."""

    noise: Any
    mean: Any
    moment: Any
    nominal: Any


class SearchResult(NamedTuple):
    """The result of a search for violations.

    Attributes:
        runs: number of simulated runs.
        explored: number of explored states, each at the end of a run of its own.
        worst: largest error of the velocity estimate from rest, f⁺ T.
        latest: last sample at which a run from the starting errors was above the settled bound; -1 without one.
        violations: runs with an error above the bound of its sample; the exploration counts as one.
    """

    runs: int
    explored: int
    worst: float
    latest: int
    violations: int


def _build_observer(system: ErrorSystem) -> AbstractSuperTwisting:
    kind = DISCRETISATIONS["implicit" if system.implicit else "explicit"]
    return kind(jnp.asarray(system.lambda_), jnp.asarray(system.alpha))


def explore_errors(system: ErrorSystem) -> tuple[Reached, Sequence]:
    """Explore the errors that can be reached from rest; x64 must be enabled.

    Returns the result, and the sequence that leads to the worst error.
    """
    noise_bound, alpha = system.noise, system.alpha
    # the ends of the sliding set; innovations whose sign would depend on rounding are avoided
    margin = _SIGN_MARGIN * (1.0 + noise_bound)
    ends = np.array([alpha, -alpha, 0.0] if system.implicit else [margin, -margin])
    # constant, and with a switch in the middle of the period; the nominal acceleration adds to it or opposes it
    signs = (1.0, -1.0) if system.push else (1.0,)
    mean, moment, nominal = np.array([(*push, sign) for push in ((1.0, 0.5), (0.0, 0.25)) for sign in signs]).T

    def noises(states: np.ndarray) -> np.ndarray:
        extreme = np.clip(ends[:, None] - states[:, 0], -noise_bound, noise_bound)
        return np.concatenate([extreme, np.full((1, len(states)), noise_bound), np.full((1, len(states)), -noise_bound)])

    reached = reachable.explore(
        reachable.build_error_step(_build_observer(system)),
        noises,
        np.column_stack([moment + 0.5 * system.push * nominal, mean]),
    )
    return reached, Sequence(reached.noise, *(reached.sign * x[reached.push] for x in (mean, moment, nominal)))


class _Adversaries(NamedTuple):
    """Adversaries of a batch, one per lane."""

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


def _draw_adversaries(rng: np.random.Generator, system: ErrorSystem, start: tuple[float, float]) -> _Adversaries:
    """A batch of adversaries, all kinds in turn; `start`: largest errors, of position and velocity."""
    root = math.sqrt(1.0 + system.noise)
    low, high = np.log(_RATE_RANGE)
    rates = np.exp(rng.uniform(low, high, (2, _LANES)))
    lines = np.concatenate([rng.uniform(-1.0, 2.0, (2, _LANES)), 0.5 * root * rng.normal(size=(2, _LANES))])
    # lines through the origin, and the sign of the velocity error
    lines[2:, rng.random(_LANES) < 0.5] = 0.0
    lines[:2, rng.random(_LANES) < 0.1] = 0.0
    corner = np.where(
        rng.random((2, _LANES)) < 0.7, np.sign(rng.normal(size=(2, _LANES))), rng.uniform(-1.0, 1.0, (2, _LANES))
    )
    return _Adversaries(
        kind=np.arange(_LANES) % 4,
        rate=rates,
        back=np.where(rng.random(_LANES) < 0.7, 0.4, rates[0]),
        phase=rng.random((2, _LANES)),
        line=lines,
        mean=np.where(rng.random(_LANES) < 0.8, 1.0, rng.random(_LANES)),
        side=np.sign(rng.normal(size=_LANES)),
        position=start[0] * corner[0],
        velocity=start[1] * corner[1],
        bits=rng.integers(1, 2**32, _LANES, dtype=np.uint32),
    )


def _draw_uniform(bits: Array) -> tuple[Array, Array]:
    """The next state of xorshift (G. Marsaglia, 2003), and a number in 0 ... 1."""
    bits ^= bits << 13
    bits ^= bits >> 17
    bits ^= bits << 5
    return bits, bits.astype(float) / 2.0**32


@functools.partial(jax.jit, static_argnames="record")
def _run_adversaries(
    observer: AbstractSuperTwisting,
    system: ErrorSystem,
    lanes: _Adversaries,
    sequence: Sequence,
    bounds: Array,
    settled: Array,
    record: bool = False,
) -> tuple[Array, Array, Array, Any]:
    """Simulate the observer's own step on a double integrator, with an adversary in each lane.

    Returns each lane's largest error, whether it exceeded a bound, the last sample above `settled`, and if `record` the
    choices.
    """

    def step_lane(carry: tuple[Any, ...], sample_inputs: tuple[Any, ...]) -> tuple[tuple[Any, ...], Any]:
        state, position, velocity, bits, signs, worst, above, latest = carry
        k, choices, bound = sample_inputs
        position_error, velocity_error = position - state.position, velocity - state.velocity
        replay, root = lanes.kind == 0, jnp.sign(position_error) * jnp.sqrt(jnp.abs(position_error))
        directions, new_signs = [], []
        for i in range(2):
            bits, uniform = _draw_uniform(bits)
            rate = jnp.where(replay & (signs[i] < 0.0), lanes.back, lanes.rate[i])
            new_signs.append(jnp.where(uniform < rate, -signs[i], signs[i]))
            steady = jnp.where((k * lanes.rate[i] + lanes.phase[i]) % 1.0 < 0.5, 1.0, -1.0)
            feedback = jnp.where(
                velocity_error - lanes.line[i] * observer.lambda_ * root - lanes.line[2 + i] >= 0.0, 1.0, -1.0
            )
            directions.append(jnp.where(lanes.kind == 1, new_signs[i], jnp.where(lanes.kind == 2, steady, feedback)))
        noise = jnp.where(replay, choices.noise * new_signs[0], -system.noise * directions[0])
        mean = jnp.where(replay, choices.mean * new_signs[1], directions[1] * lanes.mean)
        moment = 0.5 * directions[1] * lanes.mean + 0.25 * lanes.side * (1.0 - lanes.mean**2)
        moment = jnp.where(replay, choices.moment * new_signs[1], moment)
        nominal = jnp.where(replay, choices.nominal * new_signs[1], lanes.side)
        acceleration = system.push * nominal
        state, estimate = observer.step(state, position + noise, lambda _: acceleration, jnp.ones(()))
        error = jnp.abs(estimate.velocity - velocity)
        new = (
            state,
            position + velocity + moment + 0.5 * acceleration,
            velocity + mean + acceleration,
            bits,
            tuple(new_signs),
            jnp.maximum(worst, error),
            above | (error > bound * (1.0 + _ROUNDING)),
            jnp.where(error > settled * (1.0 + _ROUNDING), k, latest),
        )
        return new, Sequence(noise, mean, moment, nominal) if record else None

    flat = jnp.zeros_like(lanes.position)
    start = observer.start(flat, flat, lambda _: flat, jnp.ones(()))
    upward, index = flat + 1.0, jnp.arange(bounds.shape[0])
    carry = start, lanes.position, lanes.velocity, lanes.bits, (upward, upward), flat, flat > 0.0, jnp.full(flat.shape, -1)
    (*_, worst, above, latest), recorded = jax.lax.scan(step_lane, carry, (index, sequence, bounds))
    return worst, above, latest, recorded


def search_violations(
    system: ErrorSystem,
    position: float,
    velocity: float,
    proof: Proof,
    settled: float,
    runs: int,
    seed: int = 0,
) -> SearchResult:
    """Search for errors above the proven bounds.

    Args:
        system: the error system.
        position, velocity: largest errors at the start, f⁺ T² and f⁺ T.
        proof: proven bounds for this system and start.
        settled: the bound after the reaching time, f⁺ T.
        runs: least number of simulated runs; it is rounded up to whole batches.
        seed: random seed.
    """
    rng, batches = np.random.default_rng(seed), max(1, math.ceil(runs / _LANES))
    with jax.enable_x64(True):
        observer, (explored, best) = _build_observer(system), explore_errors(system)
        samples = np.clip(math.ceil(1.2 * len(best.noise)), _LEAST_SAMPLES, _MOST_SAMPLES)
        final_bounds = np.full(samples, proof.bounds[-1])
        all_bounds = np.concatenate([proof.bounds, final_bounds])
        worst, latest, violations = explored.worst, -1, int(explored.worst > final_bounds[0] * (1.0 + _ROUNDING))

        def run(lanes: _Adversaries, limits: np.ndarray, record: bool = False) -> tuple[Any, ...]:
            # repeated until it is as long
            sequence = Sequence(*(np.resize(choices, len(limits)) for choices in best))
            return jax.tree.map(
                np.asarray, _run_adversaries(observer, system, lanes, sequence, limits, np.asarray(settled), record)
            )

        for batch in range(batches):
            # batches of both kinds have compiled
            if batch == 1:
                began = time.monotonic()
            elif batch == 1 + _BATCHES_FROM_START:
                seconds = (time.monotonic() - began) * batches / _BATCHES_FROM_START
                check_cost("a search for a counterexample", 0.0, "", seconds)
            from_start = batch % _BATCHES_FROM_START == 0
            lanes = _draw_adversaries(rng, system, (position, velocity) if from_start else (0.0, 0.0))
            limits = all_bounds if from_start else final_bounds
            largest, went_above, latest_samples, _ = run(lanes, limits)
            violations += int(went_above.sum())
            if from_start:
                latest = max(latest, int(latest_samples.max()))
                continue
            index = int(np.where(lanes.kind == 0, largest, 0.0).argmax())
            if largest[index] > worst:
                # later batches vary this lane's choices
                worst_lane = _Adversaries(*(x[..., index : index + 1] for x in lanes))
                recorded = run(worst_lane, limits, record=True)[3]
                best = Sequence(*(x[:, 0] for x in recorded))
            worst = max(worst, float(largest.max()))
    return SearchResult(batches * _LANES, explored.state_count, worst, latest, violations)
