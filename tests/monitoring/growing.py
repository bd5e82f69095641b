"""A drive whose gap changes as it runs, simulated by `jaxbl.chain.step` with another gap at each sample."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from small_study import multisine_study

from jaxbl.chain import Sample, initial_state, step, unit_noise
from jaxbl.config import prepare, read_config

HALF_GAP, STIFFNESS = 0.08, 60.0
LAW = {"law": "dead_zone", "stiffness": STIFFNESS, "half_gap": HALF_GAP}


def axis(duration=10.0, **tables):
    """A geared axis with a hard gap, as a mapping; gains above the bounds that its impacts ask for."""
    observer = {"motor": {"lambda": 60.0, "alpha": 2000.0}, "load": {"lambda": 6.0, "alpha": 60.0}}
    return multisine_study(duration, **{"transmission": LAW, "observer": observer} | tables)


def simulate_log(data, gaps, seed=0):
    """The log of a study whose half gap is `gaps` (samples) times its own."""
    experiment = prepare(read_config(data))
    size = experiment.transmission.half_gap
    count = len(gaps)

    @jax.jit
    def simulate_gaps(gaps):
        def sample(state, inputs):
            index, gap, noise = inputs
            current = eqx.tree_at(lambda e: e.transmission.half_gap, experiment, size * gap)
            state, signals = step(current, state, Sample(index * experiment.run.sample_period, noise=noise))
            return state, (signals.input, signals.motor.measured, signals.load.measured)

        noise = unit_noise(jnp.asarray(seed), jnp.arange(count, dtype=jnp.int32), experiment.sides)
        return jax.lax.scan(sample, initial_state(experiment), (jnp.arange(count) * 1.0, gaps, noise))[1]

    u, motor, load = (np.asarray(column) for column in simulate_gaps(jnp.asarray(gaps, float)))
    time = np.arange(count) * float(experiment.run.sample_period)
    return pd.DataFrame({"t": time, "u": u, "theta_e": motor, "theta_s": load})
