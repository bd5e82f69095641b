"""The paper's drive (Table 1) with gains that meet the exact condition, for tests of the whole chain."""

import jax.numpy as jnp

from jaxbl.chain import Experiment, Run
from jaxbl.drive import Encoders, Initial, SigmoidBacklash, TwoInertia, as_arrays
from jaxbl.drive.excitation import Sine
from jaxbl.observer import DISCRETISATIONS, EquivalentControl, Identifier, Observers

DRIVE = TwoInertia(0.05, 0.15, 7.0, 16.0, 5.0)
LAW = SigmoidBacklash(1.0, 0.02, 20.0)


def paper_experiment(
    discretisation="implicit",
    *,
    time_constant=0.0,
    noise=0.0,
    regressor_filter="matched",
    start=2.0,
    steps=20_000,
    substeps=10,
    velocity_error=0.0,
    dtype=jnp.float64,
    **replacements,
) -> Experiment:
    """The experiment; `replacements` replaces whole members."""
    observer = DISCRETISATIONS[discretisation]
    members = {
        "drive": DRIVE,
        "transmission": LAW,
        "effects": (),
        "initial": Initial(),
        "excitation": Sine(0.1, 0.16),
        "encoders": Encoders(noise),
        "observer": Observers(observer(4.0, 9.0, velocity_error=velocity_error), observer(0.5, 0.2)),
        "equivalent_control": EquivalentControl(time_constant),
        "identifier": Identifier(start, 1.0, regressor_filter),
        "run": Run(1e-3, steps, substeps),
    }
    return as_arrays(Experiment(**(members | replacements)), dtype)
