"""How two models are compared, block by block of a log."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxbl.diagnosis.blocks import standard_errors_better, standard_errors_between
from jaxbl.diagnosis.reference_log import Comparison

POSITION, TORQUE = 1e-4, 1e-2


def compare_errors(position, torque, *, gain=1.0, floor=TORQUE):
    """A model whose errors are so many times the noise; `floor`: noise of the torques by its own inertia, N m."""
    samples = {"theta_e": POSITION * position, "torque_motor": gain * TORQUE * torque}
    return Comparison({name: float(np.std(sample)) for name, sample in samples.items()}, {"motor": floor}, samples, gain, {})


LOG = SimpleNamespace(noise_floor=lambda torques: {"theta_e": POSITION, "torque_motor": torques["motor"]})


@pytest.fixture
def draw_errors():
    random = np.random.default_rng(0)
    return lambda size: size * random.standard_normal(1600)


def test_a_ripple_that_only_the_torque_shows_counts(draw_errors):
    # windows of the position go wrong by something else, which is far larger
    control, better = (
        compare_errors(draw_errors(500.0), draw_errors(4.0)),
        compare_errors(draw_errors(500.0), draw_errors(2.0)),
    )
    assert standard_errors_better(LOG, control, better) > 5.0
    assert standard_errors_better(LOG, better, control) < -2.0
    # or one channel against the other: all together
    assert (
        abs(
            standard_errors_better(
                LOG, compare_errors(draw_errors(4.0), draw_errors(2.0)), compare_errors(draw_errors(2.0), draw_errors(4.0))
            )
        )
        < 3.0
    )


def test_one_factor_on_all_torques_and_the_input_makes_no_model_better(draw_errors):
    position, torque = draw_errors(3.0), draw_errors(3.0)
    scaled = compare_errors(position, torque, gain=0.6, floor=0.6 * TORQUE)
    assert standard_errors_better(LOG, compare_errors(position, torque), scaled) == pytest.approx(0.0, abs=1e-9)
    # nor does a smaller inertia, by which readings make less noise of torque
    assert (
        standard_errors_better(LOG, compare_errors(position, torque, floor=0.6 * TORQUE), compare_errors(position, torque))
        == 0.0
    )


def test_blocks_in_which_both_models_err_by_less_than_noise_count_for_nothing():
    """A drive that stands still for a while: one model leaves exactly nothing there, the other a tenth of the noise."""
    moving = np.linspace(20.0, 60.0, 13)
    control, better = np.append(moving, np.zeros(3)), np.append(0.25 * moving, np.full(3, 0.01))
    assert standard_errors_between(control, better) > 5.0
    assert standard_errors_between(better, control) < -5.0
    # few blocks have nearly all of the errors
    few = np.append(np.full(15, 4.0), 1e6)
    assert standard_errors_between(few, few / 3.0) > 5.0
    assert standard_errors_between(np.full(16, np.inf), moving[:1].repeat(16)) == np.inf
