"""The describing function of a closed loop beside python-control's, and beside simulated limit cycles."""

import control
import describing_function
import numpy as np
import pytest

import jaxbl
from jaxbl.config import with_values


@pytest.fixture(scope="module")
def config():
    return jaxbl.read_config(describing_function.STUDY)


def test_dead_zone_beside_python_control():
    """A dead zone is what a saturation leaves."""
    saturation = control.saturation_nonlinearity(1.0)
    for ratio in (1.05, 1.5, 3.0, 40.0):
        expected = 1.0 - saturation.describing_function(ratio)
        assert describing_function.dead_zone_gain(ratio) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("gain", [4.0, 8.0, 12.0])
def test_prediction_beside_python_control(config, gain):
    """Transfer functions of its own, put together by it; its crossing of locus and describing function."""
    study = with_values(config, {"controller.position_gain": gain, "effects.load.coulomb_friction.torque": 0.0})
    period, rates, n, stiffness, half_gap = 1e-3, np.geomspace(5.0, 40.0, 1000), 5.0, 60.0, 0.02

    def sampled(*polynomials):
        system = control.tf(*polynomials, period)
        return control.frd(system(np.exp(1j * rates * period)), rates)

    motor, load = (control.frd(control.tf(1.0, [j, d, 0.0])(1j * rates), rates) for j, d in ((0.05, 0.15), (1.0, 2.0)))
    share = period / (period + 2e-3)
    differences = sampled([share / period, -share / period], [1.0, share - 1.0])
    # z^-1 (1 + T / T_i / (z - 1)), and the hold
    torque = sampled([2.0, 2.0 * (period / 0.1 - 1.0)], [1.0, -1.0, 0.0])
    torque = torque * control.frd(np.sinc(rates * period / (2.0 * np.pi)) * np.exp(-0.5j * rates * period), rates)
    loop = control.feedback(motor, torque * differences) * (1.0 + torque * gain * n**2 * load) + n**2 * load
    loop = control.frd(loop.frequency_response(rates).complex, rates, smooth=True)

    class DeadZone(control.descfcn.DescribingFunctionNonlinearity):
        def __call__(self, x):
            return stiffness * np.sign(x) * max(abs(x) - half_gap, 0.0)

        def _isstatic(self):
            return True

        def describing_function(self, amplitude):
            saturation = control.saturation_nonlinearity(half_gap)
            return stiffness * (1.0 - saturation.describing_function(amplitude))

    amplitudes = half_gap * np.geomspace(1.01, 20.0, 300)
    crossings = control.describing_function_response(loop, DeadZone(), amplitudes, rates, refine=False).intersections
    twist, rate = max(crossings)
    at = abs(1.0 / (1j * rate * (1j * rate + 2.0)))
    expected = n * at * DeadZone().describing_function(twist) * twist, rate / (2.0 * np.pi)
    np.testing.assert_allclose(describing_function.predict(study), expected, rtol=2e-3)


def test_prediction_beside_simulations(config):
    """First harmonics are within some percent where the cycle is far from its end, and know of no cycle at small gains."""
    data = config.to_dict() | {"figures": []}
    data["axes"] = [
        {"path": "transmission.half_gap", "values": [0.03, 0.1]},
        {"path": "controller.position_gain", "values": [2.0, 9.0, 12.0]},
    ]
    frame = jaxbl.sweep(data).frame
    for row in frame.to_dict("records"):
        predicted = describing_function.predict(
            with_values(config, {axis["path"]: row[axis["path"]] for axis in data["axes"]})
        )
        if row["controller.position_gain"] == 2.0:
            assert predicted == (0.0, 0.0) and row["load.limit_cycle_frequency"] == 0.0
        else:
            assert predicted.amplitude == pytest.approx(row["load.limit_cycle_amplitude"], rel=0.1)
            assert predicted.frequency == pytest.approx(row["load.limit_cycle_frequency"], rel=0.15)
