"""What lanes share is the same by the loop of scalars and by XLA's scan, block after block."""

import jax
import numpy as np
import pytest

from jaxbl.chain import Experiment, Run
from jaxbl.drive import Encoders, Initial, LinearShaft, TwoInertia, as_arrays
from jaxbl.drive.excitation import Multisine
from jaxbl.fused import shared_part as module
from jaxbl.fused.lane_simulator import HostSimulator
from jaxbl.fused.shared_part import SharedPartLoop, SharedPartScan
from jaxbl.observer import EquivalentControl, ImplicitSuperTwisting, Observers
from jaxbl.sweeps.metrics import ALL_METRICS


def make_experiment(excitation, dtype):
    full_experiment = Experiment(
        drive=TwoInertia(0.05, 0.15, 7.0, 16.0, 5.0),
        transmission=LinearShaft(60.0),
        effects=(),
        initial=Initial(),
        excitation=excitation,
        encoders=Encoders(1e-4),
        observer=Observers(ImplicitSuperTwisting(10.0, 90.0), ImplicitSuperTwisting(2.5, 8.2)),
        equivalent_control=EquivalentControl(0.01),
        identifier=None,
        run=Run(1e-3, 600, 2),
    )
    return as_arrays(full_experiment, dtype)


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize(
    ("excitation", "path", "states"),
    [
        (Multisine(5.0, 0.8, 6), "observer.motor.alpha", True),
        (Multisine(5.0, 0.8, 6), "drive.motor_inertia", False),
    ],
    ids=["shared plant", "plants of their own"],
)
def test_the_loop_does_what_the_scan_does(monkeypatch, precision, excitation, path, states):
    loops = []

    class RecordedLoop(SharedPartLoop):
        def __init__(self, shared):
            super().__init__(shared)
            loops.append((self, SharedPartScan(shared), shared))

    monkeypatch.setattr(module, "SharedPartLoop", RecordedLoop)
    with jax.enable_x64(precision == "float64"):
        length = HostSimulator(make_experiment(excitation, precision), (ALL_METRICS,), (path,), 16, 1)._block_length
        ((run_loop, run_scan, shared),) = loops
        assert (run_loop._loop is not None) >= states
        # the plant's four states are not carried by each lane
        assert (len(shared.state) >= 4) == states
        loop_state = scan_state = [np.zeros((), leaf.dtype) for leaf in shared.state]
        for first in range(0, 600, length):
            loop_state, loop_ends, outputs = run_loop(loop_state, 3, first, length)
            scan_state, *scan_outputs = run_scan(scan_state, 3, first, length)
            for actual, expected in zip((loop_state, loop_ends, outputs), (scan_state, *scan_outputs), strict=True):
                for array, reference in zip(actual, expected, strict=True):
                    assert np.asarray(array).dtype == reference.dtype
                    # rounding, which a stiff shaft amplifies
                    tolerance = 1e-9 if precision == "float64" else 1e-2
                    size = np.max(np.abs(np.asarray(reference, float))) + 1e-30
                    np.testing.assert_allclose(array, reference, rtol=tolerance, atol=tolerance * size)
        # both blocks in one stretch: the loop settles its state between them
        long_state, long_ends, _ = run_loop([np.zeros((), leaf.dtype) for leaf in shared.state], 3, 0, 600)
        np.testing.assert_array_equal(long_state, loop_state)
        assert [ends[-1] for ends in long_ends] == [ends[0] for ends in loop_ends]
        assert len(outputs) > 0
        assert any(np.ptp(np.asarray(column, float)) > 0.0 for column in outputs)
