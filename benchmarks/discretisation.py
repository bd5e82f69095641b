"""Discretisations of differentiators: bias and chatter without noise, and the worst velocity error under noise.

    python benchmarks/discretisation.py

Without noise: orders 1 to 5 on a polynomial of degree n, on a sinusoid and at rest, four schemes beside one another.

Under noise: a double integrator under an unknown acceleration |d| <= L, read every T with a noise |eta| <= N, and the worst
velocity error beside the least one that any causal differentiator can have. For linear observers that is the sum of absolute
sensitivities. For switching ones it is the largest of those that adversaries find, a lower bound of the worst case:

- the search over reachable errors of jaxbl.gains.reachable, over both sides of d and many values of eta.
- the two pairs of signals behind the bounds of benchmarks/differentiation_bound.py.

Units there: T = 1, L = 1.
"""

import functools
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
from differentiation_bound import best_samples, least_exact_error, least_worst_error, worst_signal

from jaxbl.gains.reachable import build_error_step, explore
from jaxbl.observer import (
    COEFFICIENTS,
    DIFFERENTIATORS,
    ExplicitSuperTwisting,
    ExtendedState,
    ImplicitSuperTwisting,
    Luenberger,
    ObserverState,
)
from jaxbl.observer.differentiator import solve_correction


def free(velocity):
    return 0.0 * velocity


# without noise


def taylor(n, h):
    return np.array([[h ** (j - i) / factorial(j - i) if j >= i else 0.0 for j in range(n + 1)] for i in range(n + 1)])


def terms(n, lipschitz, size, sign):
    """Corrections of states 0 ... n for an error of this size."""
    j = np.arange(1, n + 2)
    return jnp.asarray(COEFFICIENTS[n]) * lipschitz ** (j / (n + 1)) * size ** ((n + 1 - j) / (n + 1)) * sign


def explicit(n, lipschitz, h):
    """Forward Euler of each correction, Taylor's series between samples; the outputs are the states."""

    def step(z, y):
        error = y - z[0]
        return taylor(n, h) @ z + h * terms(n, lipschitz, jnp.abs(error), jnp.sign(error)), z

    return step


def each_implicit(n, lipschitz, h):
    """Taylor's series, and each state corrected by its own term at the new error; the outputs are the states.

    The equation is that of the first state, e + h k_1 L^(1/(n+1)) |e|^(n/(n+1)) s = b: no set-valued term in it.
    """
    slope = h * COEFFICIENTS[n][0] * lipschitz ** (1.0 / (n + 1))

    def step(z, y):
        z = taylor(n, h) @ z
        b = y - z[0]

        def halve(_, bounds):
            low, high = bounds
            middle = 0.5 * (low + high)
            above = middle + slope * middle ** (n / (n + 1)) > jnp.abs(b)
            return jnp.where(above, low, middle), jnp.where(above, middle, high)

        low, high = jax.lax.fori_loop(0, 60, halve, (jnp.zeros(()), jnp.abs(b)))
        z = z + h * terms(n, lipschitz, 0.5 * (low + high), jnp.sign(b))
        return z, z

    return step


def backward_euler(n, lipschitz, h):
    """All states at the new sample; the outputs are the states."""
    unit = lipschitz * h ** (n + 1)
    reach = COEFFICIENTS[n][n] * unit

    def step(z, y):
        b = y - h ** np.arange(n + 1) @ z
        beyond = b - jnp.clip(b, -reach, reach)
        size = unit * solve_correction(COEFFICIENTS[n], jnp.abs(beyond) / unit) ** (n + 1)
        corrections = terms(n, lipschitz, size, jnp.sign(beyond)).at[n].set((b - beyond) / h ** (n + 1))
        rows = []
        for i in range(n, -1, -1):
            rows.append(z[i] + h * (corrections[i] + (rows[-1] if rows else 0.0)))
        z = jnp.stack(rows[::-1])
        return z, z

    return step


def proper(n, lipschitz, h):
    """The package's: backward Euler with exact outputs."""
    observer = DIFFERENTIATORS[n](jnp.asarray(lipschitz))

    def step(z, y):
        new, estimate = observer.step(ObserverState(z[0], z[1], tuple(z[2:])), y, free, jnp.asarray(h))
        return jnp.stack([new.position, new.velocity, *new.further]), jnp.stack([estimate.position, estimate.velocity])

    return step


SCHEMES = {
    "explicit": explicit,
    "implicit, each state alone": each_implicit,
    "backward Euler, its own states": backward_euler,
    "backward Euler, exact outputs (jaxbl)": proper,
}


def late_velocity(scheme, n, lipschitz, h, y, start):
    """Velocities of the last quarter along readings, from the states `start`."""
    return np.asarray(jax.lax.scan(scheme(n, lipschitz, h), jnp.asarray(start), jnp.asarray(y))[1])[-y.size // 4 :, 1]


def without_noise(h=0.02):
    """Rows of the table: scheme, order, and errors in h^n L."""
    t = h * np.arange(-1500, 1501)
    late = t[-t.size // 4 :]
    w = 2.0
    for name, scheme in SCHEMES.items():
        for n in range(1, 6):
            lipschitz = w ** (n + 1)
            unit = h**n * lipschitz
            polynomial = np.polynomial.Polynomial([3.0 * 0.3**i / factorial(i) for i in range(n + 1)])
            first = [polynomial.deriv(i)(t[0]) if i else polynomial(t[0]) for i in range(n + 1)]
            derivative = late_velocity(scheme, n, lipschitz, h, polynomial(t), first)
            bias = np.abs(derivative - polynomial.deriv()(late)).max() / unit
            first = [w**i * np.sin(w * t[0] + i * np.pi / 2) for i in range(n + 1)]
            derivative = late_velocity(scheme, n, lipschitz, h, np.sin(w * t), first)
            sine = np.abs(derivative - w * np.cos(w * late)).max() / unit
            resting = late_velocity(scheme, n, lipschitz, h, 0.0 * t, [1e-3 * (i == 0) for i in range(n + 1)])
            # what rounding of readings of this size makes of a velocity
            rounding = 2**n * np.finfo(float).eps * np.abs(polynomial(t)).max() / h / unit
            yield name, n, bias, sine, np.abs(np.diff(resting)).max() / unit, rounding


# under noise


def error(observer, noise_bound, shares):
    """Velocity error after the last sample; `shares` of d and eta in -1 ... 1, shape (2, samples)."""
    d, eta = shares[0], noise_bound * shares[1]
    zero = jnp.zeros(())

    def advance(carry, disturbance):
        state, position, velocity = carry
        push, noise = disturbance
        state, estimate = observer.step(state, position + noise, free, jnp.ones(()))
        miss = estimate.velocity - velocity
        # the acceleration acts from this sample to the next
        return (state, position + velocity + 0.5 * push, velocity + push), miss

    start = observer.start(zero, zero, free, jnp.ones(()))
    return jax.lax.scan(advance, (start, zero, zero), (d, eta))[1][-1]


@functools.partial(jax.jit, static_argnums=0)
def simulate_errors(kind, gains, noise, shares):
    return jnp.abs(error(kind(*gains), noise, shares))


@functools.partial(jax.jit, static_argnums=(0, 3))
def worst_linear(kind, gains, noise, samples):
    """The worst case itself of an observer that is linear in d and eta."""
    sensitivity = jax.grad(lambda x: error(kind(*gains), noise, x))(jnp.zeros((2, samples)))
    return jnp.abs(sensitivity).sum()


NEAR = np.array([-4.0, -1.0, 0.0, 1.0, 4.0])
"""Innovations (T² L) to try beside noises from -N to N: those near zero decide what a switching term does."""


def search_worst(kind, gains, noise, most=1_200_000):
    """The largest velocity error that the search finds."""

    def noises(states):
        spaced = np.repeat(np.linspace(-noise, noise, 5)[:, None], len(states), axis=1)
        return np.concatenate([spaced, np.clip(NEAR[:, None] - states[:, 0], -noise, noise)])

    observer, zero = kind(*map(jnp.asarray, gains)), jnp.zeros(())
    further = len(observer.start(zero, zero, free, jnp.ones(())).further)
    return explore(build_error_step(observer), noises, np.array([[0.5, 1.0] + [0.0] * further]), most).worst


@functools.cache
def pairs(noise, samples):
    """Shares of the signals behind the bounds: read as zero throughout, and read as minus itself, a signal without noise."""
    disturbances = []
    for slope, part in ((1.0, 1.0), (2.0, 0.5)):
        signal = worst_signal(noise, slope, 1.0, samples - 1)
        d = part * np.append(signal.acceleration[::-1], 0.0)
        disturbances.append(jnp.asarray(np.stack([d, -signal.signal[::-1] / max(noise, 1e-300)])))
    return disturbances


def worst(kind, gains, noise, samples):
    """The largest velocity error found."""
    if kind in (Luenberger, ExtendedState):
        return float(worst_linear(kind, gains, noise, samples))
    return max(
        search_worst(kind, gains, noise), *(float(simulate_errors(kind, gains, noise, x)) for x in pairs(noise, samples))
    )


def chatter(observer):
    """Largest change of the velocity estimate from sample to sample at rest, late, in T L."""
    y = jnp.full(4000, 0.3)

    def advance(state, y):
        state, estimate = observer.step(state, y, free, jnp.ones(()))
        return state, estimate.velocity

    start = observer.start(jnp.asarray(0.1), jnp.asarray(0.2), free, jnp.ones(()))
    late = np.asarray(jax.lax.scan(advance, start, y)[1])[-1000:]
    return float(np.abs(np.diff(late)).max())


def horizon(noise):
    return 30 * best_samples(noise, 1.0, 1.0) + 60


def under_noise(sizes):
    """Rows of the table: observer, worst errors found over the least possible one, and chatter."""
    usual = (1.5, 1.1)
    bandwidths = (0.1, 0.15, 0.2, 0.3, 0.4, 0.8, 1.6, 6.0)
    gains = [(k * a**0.5, a) for a in (1.1, 1.3, 2.0) for k in (1.5, 1.8, 2.1)]
    rows = {
        "super-twisting, explicit": (ExplicitSuperTwisting, [usual]),
        "super-twisting, implicit": (ImplicitSuperTwisting, [usual]),
        "the same, its best gains": (ImplicitSuperTwisting, gains),
        "Luenberger, its best gains": (Luenberger, [(w, z) for w in bandwidths for z in (0.7, 1.0)]),
        "extended state, its best gains": (ExtendedState, [(w,) for w in bandwidths]),
        "differentiator of order 2, its best gain": (DIFFERENTIATORS[2], [(x,) for x in (0.1, 0.3, 1.0)]),
    }
    for name, (kind, choices) in rows.items():
        ratios = []
        for noise in sizes:
            least_error, best = min((worst(kind, gains, noise, horizon(noise)), gains) for gains in choices)
            ratios.append(f"{least_error / least_worst_error(noise, 1.0, 1.0):.2f}")
            if len(choices) > 1:
                ratios[-1] += f" ({', '.join(f'{x:.2g}' for x in best)})"
        yield name, ratios, chatter(kind(*choices[0]))


def main() -> None:
    print("Without noise, in h^n L: velocity error on a polynomial of degree n (what rounding makes), on a sinusoid with")
    print("the largest (n+1)-th derivative L, and the largest change from sample to sample at rest\n")
    print("| scheme | order | polynomial | sinusoid | at rest |\n|---|---|---|---|---|")
    for name, n, bias, sine, resting, rounding in without_noise():
        print(f"| {name} | {n} | {bias:.1e} ({rounding:.0e}) | {sine:.3g} | {resting:.1e} |", flush=True)
    sizes = (0.0, 1.0, 10.0, 100.0)
    least = ", ".join(f"{least_worst_error(n, 1.0, 1.0):.4g} T L at N = {n:g} T² L" for n in sizes)
    print(f"\nWorst velocity error found, over the least possible one ({least})\n")
    print(f"| observer | {' | '.join(f'N = {n:g}' for n in sizes)} | chatter at rest, T L |")
    print("|" + "---|" * (len(sizes) + 2))
    exact = [least_exact_error(n, 1.0, 1.0) / least_worst_error(n, 1.0, 1.0) for n in sizes]
    print(f"| least with the least error without noise (adaptive quotient) | {' | '.join(f'{r:.2f}' for r in exact)} | 0 |")
    for name, ratios, resting in under_noise(sizes):
        print(f"| {name} | {' | '.join(ratios)} | {resting:.1e} |", flush=True)


if __name__ == "__main__":
    with jax.enable_x64(True):
        main()
