"""The error of a super-twisting observer sample by sample, by the observer's own step."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.observer.super_twisting import DISCRETISATIONS


def stepped(system, e, g, noise, mean, moment, nominal):
    """One sample of the observer's own step on a double integrator: e, g of the next sample, and the estimate's error."""
    observer = DISCRETISATIONS["implicit" if system.implicit else "explicit"](system.lambda_, system.alpha)
    with jax.enable_x64(True):
        zero = jnp.zeros_like(jnp.asarray(e))
        start = observer.start(zero, zero, lambda v: 0.0 * v, 1.0)
        state, estimate = observer.step(start, jnp.asarray(e) + noise, lambda _: jnp.asarray(nominal), 1.0)
    e_next = e + g + moment + 0.5 * nominal - np.asarray(state.position)
    return e_next, g + mean + nominal - np.asarray(state.velocity), np.abs(np.asarray(estimate.velocity) - g)
