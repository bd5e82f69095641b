"""Two studies side by side: points matched by values and seeds, differences against noise and roundings."""

import dataclasses

import numpy as np
import pytest
from scipy import stats
from small_study import ALPHA, LAMBDA, NOISE, listed_axis, make_result, rigid_study, spaced_axis

from jaxbl.report.compare import draw as draw_comparison
from jaxbl.report.results import describe
from jaxbl.sweeps.compare import compare

RMSE = "motor.velocity_rmse"
GAINS = [spaced_axis(ALPHA, 1.0, 16.0, 5), spaced_axis(LAMBDA, 1.0, 8.0, 20)]


def study(*axes, function=lambda frame: frame[ALPHA], seeds=6, changes=None, **columns):
    """A study whose error is a function of its points and seeds."""
    return make_result(
        rigid_study(changes, axes=list(axes or GAINS), sweep={"seeds": seeds}), motor__velocity_rmse=function, **columns
    )


def noisy_error(shift=lambda frame: 0.0, spread=0.1, seed=0, own_spread=0.01):
    """An error under noise that runs of one seed share, and a little that they do not."""

    def function(frame):
        rng, other = np.random.default_rng(5), np.random.default_rng([1, seed])
        shared = rng.normal(size=100)[frame["seed"]]
        return frame[ALPHA] * (1.0 + spread * shared + own_spread * other.normal(size=len(frame)) + shift(frame))

    return function


def compare_metric(first, second, metric=RMSE):
    return next(change for change in compare(first, second).metrics if change.metric == metric)


def far_shift(frame):
    return 0.15 * (frame[ALPHA] > 5.0)


def test_points_beyond_noise_are_named_with_their_place_and_direction():
    first, second = study(function=noisy_error()), study(function=noisy_error(far_shift, seed=2))
    change = compare_metric(first, second)
    assert (change.points, change.differs, change.up, change.better) == (100, 40, 40, "less")
    assert change.where == {ALPHA: pytest.approx([8.0, 16.0])}
    assert change.most[ALPHA] > 7.0
    assert change.most["second"] / change.most["first"] == pytest.approx(1.15, abs=0.05)
    # 40 % of the points, by 15 % each
    assert change.moved.low < 1.15**0.4 < change.moved.high
    assert change.moved.is_sure(1.0)
    frame = compare(first, second).frame(RMSE)
    assert (frame["differs"] == (frame[ALPHA] > 5.0)).all()
    # without pairs this noise hides the change
    later = make_result(
        first.config.to_dict() | {"sweep": {"seeds": 6, "first_seed": 50}},
        motor__velocity_rmse=noisy_error(far_shift, seed=2),
    )
    later.source["seed"] += 50
    unpaired = compare(first, later)
    assert (unpaired.seeds, unpaired.paired) == (0, False)
    assert next(m for m in unpaired.metrics if m.metric == RMSE).differs == 0


@pytest.mark.parametrize("paired", [True, False])
def test_the_tests_are_those_of_scipy(paired):
    first = study(function=noisy_error(own_spread=0.05))
    second = study(function=noisy_error(own_spread=0.05, seed=1, shift=lambda frame: 0.1 * frame[LAMBDA] - 0.2))
    if not paired:
        second.source["seed"] += 10
    a, b = (result.frame.sort_values([ALPHA, LAMBDA, "seed"])[RMSE].to_numpy().reshape(100, 6) for result in (first, second))
    p = (stats.ttest_rel(a, b, axis=1) if paired else stats.ttest_ind(a, b, axis=1, equal_var=False)).pvalue
    expected = stats.false_discovery_control(p, method="by") <= 0.05
    differs = compare(first, second).frame(RMSE).sort_values([ALPHA, LAMBDA])["differs"].to_numpy()
    assert 0 < expected.sum() < 100
    np.testing.assert_array_equal(differs, expected)


def test_noise_alone_is_no_difference():
    differing = [
        compare_metric(study(function=noisy_error(seed=i)), study(function=noisy_error(seed=100 + i))).differs
        for i in range(20)
    ]
    # at most one in twenty comparisons names any point, on average
    assert sum(count > 0 for count in differing) <= 3


@pytest.mark.parametrize("seeds", [1, 4])
def test_roundings_are_no_difference(seeds):
    def size(frame):
        # from the resolution of float64 to much more
        return np.where(frame[ALPHA] > 10.0, 1e-17, frame[ALPHA])

    wobble = np.random.default_rng(0).normal(size=100 * seeds)
    first = study(function=size, seeds=seeds)
    second = study(function=lambda frame: size(frame) * (1.0 + 1e-11 * wobble) + 1e-17 * np.abs(wobble), seeds=seeds)
    assert compare_metric(first, second).count == 0
    assert compare_metric(first, study(function=lambda frame: 1.001 * size(frame), seeds=seeds)).changed == 80


def test_one_seed_tells_no_noise():
    first, second = study(function=noisy_error(), seeds=1), study(function=noisy_error(far_shift, seed=2), seeds=1)
    comparison = compare(first, second)
    assert not comparison.knows_noise
    change = next(m for m in comparison.metrics if m.metric == RMSE)
    assert (change.differs, change.changed, change.count) == (None, 100, 100)
    assert np.isnan(change.moved.low)
    assert any("Noise: not known (one common seed)" in line for line in describe(comparison).remarks)


def test_different_grids_are_compared_where_both_have_points():
    other = [
        spaced_axis(ALPHA, 1.0, 4096.0, 13),
        listed_axis(LAMBDA, *(np.geomspace(1.0, 8.0, 20)[::2] * (1.0 + 1e-12)).tolist()),
    ]
    comparison = compare(study(function=noisy_error()), study(*other, function=noisy_error(far_shift, seed=2), seeds=9))
    assert comparison.points == (50, 50, 80)
    assert (comparison.seeds, comparison.paired) == (6, True)
    assert next(m for m in comparison.metrics if m.metric == RMSE).points == 50
    assert "Points: 50 in both; 50 in the first alone, 80 in the second alone." in describe(comparison).remarks


def test_an_axis_of_one_study_is_compared_at_the_others_value():
    several = study(*GAINS, listed_axis(NOISE, 1e-3, 1e-4, 0.0), function=lambda frame: frame[ALPHA] * (1.0 + frame[NOISE]))
    comparison = compare(study(function=lambda frame: frame[ALPHA] * (1.0 + 1e-4)), several)
    assert comparison.points == (100, 0, 200)
    assert next(m for m in comparison.metrics if m.metric == RMSE).changed == 0
    # and where the other does not have the number at all
    word = listed_axis("effects.motor.coulomb_friction.torque", 0.0, 0.1)
    with_effect = rigid_study(axes=[*GAINS, word], effects=[{"kind": "motor.coulomb_friction", "torque": 0.1}])
    comparison = compare(study(), make_result(with_effect))
    assert comparison.points == (0, 100, 200)
    assert comparison.metrics == ()
    assert describe(comparison).headline == "No point is in both studies: no metric is compared."


def test_config_by_keys_with_what_decides_nothing_left_out():
    effects = [{"kind": "motor.coulomb_friction", "torque": 0.1}, {"kind": "encoder.delay", "time": 1e-3}]
    first = study(changes={"title": "one"})
    second = make_result(
        rigid_study({"title": "two", "drive.motor_inertia": 0.06}, axes=GAINS, effects=effects[:1], sweep={"seeds": 2})
    )
    comparison = compare(first, second)
    assert comparison.config["drive.motor_inertia"] == (0.05, 0.06)
    assert comparison.config["sweep.seeds"] == (6, 2)
    assert comparison.config["effects.motor.coulomb_friction.torque"] == (None, 0.1)
    assert not any(key.startswith(("title", "axes")) for key in comparison.config)


def test_what_is_true_or_false_and_what_is_not_defined():
    columns = {"motor__converged": lambda frame: frame[ALPHA] > 3.0}
    times = {"motor__convergence_time": lambda frame: np.where(frame[ALPHA] > 3.0, 1.0, np.nan)}
    comparison = compare(study(**columns, **times), study(motor__convergence_time=lambda frame: 0.0 * frame[ALPHA] + 1.0))
    converged, time = (
        next(m for m in comparison.metrics if m.metric == f"motor.{n}") for n in ("converged", "convergence_time")
    )
    assert (converged.changed, converged.up, converged.moved.value) == (40, 40, pytest.approx(0.4))
    assert (time.points, time.only, time.changed) == (60, (0, 240), 0)
    result = describe(comparison)
    assert (
        "+40.00 % (+40.00 % to +40.00 %)",
        "motor.converged: better at 40, worse at 0 of 100 points",
    ) in result.key_figures
    assert any("motor.convergence_time (240 runs)" in line for line in result.remarks)


@pytest.mark.parametrize("axes", [GAINS, GAINS[1:], [*GAINS, listed_axis(NOISE, 0.0, 1e-4)], [listed_axis(NOISE, 1e-4)]])
def test_text_and_figure(axes):
    def size(shift, seed):
        return lambda frame: noisy_error(shift, seed=seed)(frame.assign(**{} if ALPHA in frame else {ALPHA: 9.0}))

    first, second = study(*axes, function=size(lambda frame: 0.0, 0)), study(*axes, function=size(far_shift, 2))
    comparison = compare(first, second)
    drawings = [*draw_comparison(comparison)]
    assert [drawing.name for drawing in drawings] == ["factors"]
    names = {field.name for field in dataclasses.fields(comparison) if not field.name.startswith("_")}
    assert set(comparison.to_dict()) == names
