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


def between(difference, share, noise):
    """Standard errors for a model that foretells a difference otherwise, of which a share comes true."""
    return standard_errors_between([share * difference + noise], [(share - 1.0) * difference + noise])


def test_what_is_foretold_otherwise_has_to_come_true_by_more_than_half(draw_errors):
    difference, noise = draw_errors(0.5), draw_errors(1.0)
    assert between(difference, 1.0, noise) > 4.0 and between(difference, 0.0, noise) < -4.0
    assert abs(between(difference, 0.5, noise)) < 3.0


def test_blocks_in_which_two_models_foretell_the_same_say_nothing(draw_errors):
    moving, noise = draw_errors(0.5), draw_errors(1.0)
    moving[:300] = 0.0
    assert between(moving, 1.0, noise) > 3.5
    assert between(0.0 * moving, 1.0, noise) == 0.0
    # and one block that has nearly all of it is one block
    moving[-100:] *= 1e3
    assert 0.0 < between(moving, 1.0, noise) < 3.0


def test_a_model_that_diverges_is_no_better(draw_errors):
    finite, infinite = draw_errors(1.0), np.full(1600, np.inf)
    assert standard_errors_between([infinite], [finite]) == np.inf
    assert standard_errors_between([finite], [infinite]) == -np.inf
