"""One run with a record by loops is what the scan gives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from effect_values import VALUES

from jaxbl.chain import Experiment, Reducer, Run, scan
from jaxbl.drive import Encoders, Initial, TwoInertia, as_arrays
from jaxbl.drive.effects import make_effect
from jaxbl.drive.excitation import Multisine, Prbs
from jaxbl.drive.transmission import DeadZone
from jaxbl.fused.single_run import record_run
from jaxbl.observer import EquivalentControl, Identifier, ImplicitSuperTwisting, Observers
from jaxbl.sweeps.metrics import ALL_METRICS

NAMES = ["motor.stribeck_friction", "load.gravity", "motor.cogging", "actuator.lag"]
ODD_REDUCER = Reducer(
    lambda e: jnp.zeros_like(e.run.sample_period),
    lambda e, total, index, signals: total + jax.scipy.special.erf(signals.motor.measured),
    lambda e, total, state: {"odd": total, "sum": jax.scipy.special.erf(total)},
)


def make_experiment(excitation, steps, precision):
    return as_arrays(
        Experiment(
            drive=TwoInertia(0.05, 0.15, 7.0, 16.0, 5.0),
            transmission=DeadZone(60.0, 0.05),
            effects=tuple(make_effect(name, **VALUES[name]) for name in NAMES),
            initial=Initial(),
            excitation=excitation,
            encoders=Encoders(1e-4, motor_resolution=1e-5),
            observer=Observers(ImplicitSuperTwisting(10.0, 90.0, velocity_error=0.5), ImplicitSuperTwisting(2.5, 8.2)),
            equivalent_control=EquivalentControl(0.01),
            identifier=Identifier(0.1),
            run=Run(1e-3, steps, 2),
        ),
        np.dtype(precision),
    )


def record_row(state, signals):
    # in another order than the alphabet's; one of them needs no state
    return {"u": signals.input, "torque": signals.torque, "moving": signals.load.true.velocity > 0.0, "t": signals.time}


@pytest.fixture(scope="module")
def scan_run():
    """An experiment, and figures and record of it by the scan."""
    full_experiment = make_experiment(Prbs(5.0, 0.05), 523, "float64")
    return full_experiment, *jax.jit(lambda seed: scan(full_experiment, seed, (ALL_METRICS, ODD_REDUCER), record_row, 1))(
        jnp.asarray(3)
    )


@pytest.mark.parametrize(
    ("stride", "reducers"),
    [
        (1, (ALL_METRICS,)),
        (7, (ALL_METRICS,)),  # blocks with a rest, none a multiple of what is kept
        (600, (ALL_METRICS,)),
        (3, (ALL_METRICS, ODD_REDUCER)),  # what no loop can do
    ],
    ids=["whole", "every seventh", "the first alone", "by XLA"],
)
def test_figures_and_record_are_those_of_the_scan(scan_run, stride, reducers):
    full, figures, record = scan_run
    result, selected = record_run(full, 3, reducers, record_row, stride)
    assert list(selected) == ["u", "torque", "moving", "t"]
    assert set(result) == set(figures) - (set() if ODD_REDUCER in reducers else {"odd", "sum"})
    for name, column in selected.items():
        assert column.dtype == record[name].dtype
        np.testing.assert_allclose(column, record[name][::stride], rtol=1e-8, atol=1e-12, err_msg=name)
    for name, figure in result.items():
        np.testing.assert_allclose(figure, figures[name], rtol=1e-7, err_msg=name)


def test_a_run_in_single_precision():
    with jax.enable_x64(False):
        full_experiment = make_experiment(Multisine(5.0, 0.8), 500, "float32")
        result, selected = record_run(full_experiment, 3, (ALL_METRICS,), record_row)
        figures, record = jax.jit(lambda seed: scan(full_experiment, seed, (ALL_METRICS,), record_row))(
            jnp.asarray(3, jnp.uint32)
        )
    assert {column.dtype.name for column in selected.values()} == {"float32", "bool"}
    np.testing.assert_allclose(selected["torque"], record["torque"], atol=1e-3 * np.ptp(record["torque"]))
    np.testing.assert_allclose(result["motor.velocity_rmse"], figures["motor.velocity_rmse"], rtol=1e-3)
