"""The rough rigid-drive fit, against motions that show little of the drive."""

import numpy as np

from jaxbl.records.gearing import fit_gearing
from jaxbl.records.resampling import Grid
from jaxbl.records.rigid_body import fit_rigid_drive

RANDOM = np.random.default_rng(3)


def test_motion_of_one_frequency_leaves_inertia_and_spring_alike():
    time = 1e-3 * np.arange(8000)
    position = np.sin(2.0 * np.pi * time)
    log = [slice(0, 8000)]
    for noise in (0.0, 1e-4):
        fit = fit_rigid_drive(0.3 * position, position + noise * RANDOM.standard_normal(8000), log, 1e-3)
        assert fit.inflation[0] > 1e3 and fit.inflation[3] > 1e3
    assert fit_rigid_drive(np.zeros(8000), position, log, 1e-3) is None
    assert fit_rigid_drive(position, RANDOM.standard_normal(8000), log, 1e-3) is None
    assert fit_gearing(Grid(time, {"theta_e": position, "theta_s": RANDOM.standard_normal(8000)}, log, 1e-3)) is None
