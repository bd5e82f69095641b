"""What the GPU benchmark runs computes the right thing; Pallas's interpreter stands in for a GPU."""

from functools import partial

import gpu
import jax
import numpy as np

from jaxbl.fused.lane_simulator import DeviceSimulator
from jaxbl.throughput.jaxbl_chain import FusedChain
from jaxbl.throughput.workload import Workload


def test_lorenz_by_the_kernel_and_by_the_scan():
    with jax.enable_x64(False):
        fused, scanned = gpu.lorenz_fused(130, 40, 1e-2, interpret=True)(), gpu.lorenz_scanned(130, 40, 1e-2)()
    assert fused.shape == scanned.shape == (3, 130)
    np.testing.assert_allclose(fused, scanned, rtol=1e-5, atol=1e-6)
    assert np.ptp(fused[2]) > 0.1


def test_the_kernel_alone_gives_the_figures_of_a_run(monkeypatch):
    monkeypatch.setattr(gpu, "DeviceSimulator", partial(DeviceSimulator, interpret=True))
    work = Workload(130, 150, "float64")
    actual, full, expected = (run() for run in (gpu.chain_kernel(work), gpu.chain_fused(work), FusedChain(work, 1)))
    assert set(actual) == set(full) == set(expected)
    for name, figure in expected.items():
        assert actual[name].shape == (130,)
        np.testing.assert_array_equal(actual[name], full[name])
        # so short a run identifies nothing
        if name.endswith("_rmse"):
            np.testing.assert_allclose(actual[name], figure, rtol=1e-6, err_msg=name)
