"""The error of a super-twisting observer sample by sample, by the observer's own step."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.observer.super_twisting import DISCRETISATIONS


@functools.partial(jax.jit, static_argnums=0)
def _step_observer(implicit, lambda_, alpha, reading, nominal):
    """Return position and velocity that the observer expects after one sample, and its estimate of the velocity."""
    observer = DISCRETISATIONS["implicit" if implicit else "explicit"](lambda_, alpha)
    zero = jnp.zeros_like(reading)
    state, estimate = observer.step(observer.start(zero, zero, lambda v: 0.0 * v, 1.0), reading, lambda _: nominal, 1.0)
    return state.position, state.velocity, estimate.velocity


def step_errors(system, e, g, noise, mean, moment, nominal):
    """Advance e and g by one sample of the observer's own step on a double integrator; return also the estimate's error."""
    reading, nominal = np.broadcast_arrays(np.asarray(e, float) + noise, nominal)
    count = len(reading)
    # few lengths, as each is compiled
    length = next(size for size in (1, 4096, 65536, 2**18) if size >= count)
    with jax.enable_x64(True):
        gains = jnp.asarray(system.lambda_), jnp.asarray(system.alpha)
        padded = (np.resize(values, length) for values in (reading, nominal))
        position, velocity, estimate = (np.asarray(x)[:count] for x in _step_observer(system.implicit, *gains, *padded))
    return e + g + moment + 0.5 * nominal - position, g + mean + nominal - velocity, np.abs(estimate - g)
