"""Observers' worst velocity error beside the least one that any causal differentiator can have, and their chatter at rest.

    python benchmarks/discretisation.py

A double integrator under an unknown acceleration |d| <= L, read every T with a noise |eta| <= N. An adversary chooses d and
eta for the largest velocity error at the end, by the signs of gradients through the simulation, from random signals and that
of the linear program. What it finds is a lower bound of the worst case; for the explicit form a weaker one, as a switching
term has no gradient. Units: T = 1, L = 1.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.gains.differentiation_bound import best_samples, least_worst_error, worst_signal
from jaxbl.observer import DIFFERENTIATORS, ExplicitSuperTwisting, ExtendedState, ImplicitSuperTwisting, Luenberger

STARTS, ROUNDS = 96, 300


def free(velocity):
    return 0.0 * velocity


def error(observer, noise_bound, shares):
    """Velocity error after the last sample; `shares` of d and eta in -1 ... 1, shape (2, samples)."""
    d, eta = shares[0], noise_bound * shares[1]
    zero = jnp.zeros(())

    def one(carry, given):
        state, position, velocity = carry
        push, noise = given
        state, estimate = observer.step(state, position + noise, free, jnp.ones(()))
        miss = estimate.velocity - velocity
        # the acceleration acts from this sample to the next
        return (state, position + velocity + 0.5 * push, velocity + push), miss

    start = observer.start(zero, zero, free, jnp.ones(()))
    return jax.lax.scan(one, (start, zero, zero), (d, eta))[1][-1]


@functools.partial(jax.jit, static_argnums=0)
def ascended(kind, gains, noise_bound, shares):
    """The largest error over starts and rounds, of ascents with steps that shrink."""
    observer = kind(*gains)
    value = jax.vmap(jax.value_and_grad(lambda x: error(observer, noise_bound, x)))

    def rise(i, carry):
        x, best = carry
        found, slope = value(x)
        step = 2.0 * 0.5 ** (6.0 * i / ROUNDS)
        new = jnp.clip(x + step * jnp.sign(jnp.nan_to_num(slope)), -1.0, 1.0)
        return new, jnp.maximum(best, jnp.nanmax(jnp.abs(found)))

    return jax.lax.fori_loop(0, ROUNDS, rise, (shares, jnp.zeros(())))[1]


def worst(kind, gains, noise, samples):
    rng = np.random.default_rng(0)
    starts = rng.uniform(-1.0, 1.0, (STARTS, 2, samples))
    # pieces of one sign, of several lengths
    for i in range(STARTS // 2):
        length = 2 ** (i % 6)
        starts[i] = np.repeat(np.sign(rng.normal(size=(2, -(-samples // length)))), length, axis=1)[:, :samples]
    found = worst_signal(noise, 1.0, 1.0, samples - 1)
    starts[-1, 0] = np.append(found.acceleration[::-1], 0.0)
    starts[-1, 1] = -found.signal[::-1] / noise if noise else 0.0
    return float(ascended(kind, gains, noise, jnp.asarray(starts)))


def chatter(observer):
    """Largest change of the velocity estimate from sample to sample at rest, late, in T L."""
    y = jnp.full(4000, 0.3)

    def one(state, y):
        state, estimate = observer.step(state, y, free, jnp.ones(()))
        return state, estimate.velocity

    start = observer.start(jnp.asarray(0.1), jnp.asarray(0.2), free, jnp.ones(()))
    late = np.asarray(jax.lax.scan(one, start, y)[1])[-1000:]
    return float(np.abs(np.diff(late)).max())


def main() -> None:
    usual = (1.5, 1.1)
    bandwidths = (0.1, 0.2, 0.4, 0.8, 1.6, 6.0)
    grid = [(k * a**0.5, a) for a in (1.1, 2.0, 4.0) for k in (0.5, 1.0, 1.5, 2.0, 3.0)]
    rows = {
        "super-twisting, explicit": (ExplicitSuperTwisting, [usual]),
        "super-twisting, implicit": (ImplicitSuperTwisting, [usual]),
        "the same, its best gains": (ImplicitSuperTwisting, grid),
        "luenberger, its best gains": (Luenberger, [(w, z) for w in bandwidths for z in (0.7, 1.0)]),
        "extended state, its best gains": (ExtendedState, [(w,) for w in bandwidths]),
        "differentiator of order 2, L = 1": (DIFFERENTIATORS[2], [(1.0,)]),
    }
    sizes = (0.0, 1.0, 10.0, 100.0)
    least = ", ".join(f"{least_worst_error(n, 1.0, 1.0):.3g} T L at N = {n:g} T² L" for n in sizes)
    print(f"Worst velocity error found, over the least possible one ({least})\n")
    print(f"| observer | {' | '.join(f'N = {n:g}' for n in sizes)} | chatter at rest, T L |")
    print("|" + "---|" * (len(sizes) + 2))
    for name, (kind, choices) in rows.items():
        ratios = []
        for noise in sizes:
            samples = max(12 * best_samples(noise, 1.0, 1.0), 60)
            found = min(worst(kind, gains, noise, samples) for gains in choices)
            ratios.append(found / least_worst_error(noise, 1.0, 1.0))
        print(f"| {name} | " + " | ".join(f"{r:.2f}" for r in ratios) + f" | {chatter(kind(*choices[0])):.1e} |", flush=True)


if __name__ == "__main__":
    with jax.enable_x64(True):
        main()
