"""Power laws: found where they are made, not found where there is none, and the reasons of their ends."""

import json

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from small_study import LAMBDA, NOISE, listed_axis, make_result, rigid_study, spaced_axis

import jaxbl
from jaxbl.config import read_config
from jaxbl.errors import InputError
from jaxbl.gains.accuracy_laws import LEAST_POINTS, accuracy_laws, fit_power_law
from jaxbl.report.results import write_report
from jaxbl.sweeps.sweep import sweep

PERIOD, WORDS = "run.sample_period", "observer.discretisation"
POSITION, VELOCITY = "motor.position_rmse", "motor.velocity_rmse"
PERIODS = [1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2]
NOISES = [0.0, *np.geomspace(1e-7, 1e-1, 13)]


def law_figure(x=PERIOD, value=VELOCITY, theory=1.0, **keys):
    return {"kind": "line", "x": x, "value": value, "theory": theory} | keys


def study(*figures, axes=None, **tables):
    axes = axes or [listed_axis(PERIOD, *PERIODS), listed_axis(NOISE, *NOISES)]
    return rigid_study({"run.duration": 1.0}, axes=axes, figures=list(figures), **tables)


def fit_only_law(data, **columns):
    (fitted_law,) = accuracy_laws(make_result(data, **columns))
    return fitted_law


@given(
    exponent=st.floats(-3.0, 3.0), factor=st.floats(1e-9, 1e9), count=st.integers(LEAST_POINTS, 30), span=st.floats(1.0, 5.0)
)
def test_an_exact_law_is_found_whole(exponent, factor, count, span):
    x = np.geomspace(1e-5, 1e-5 * 10.0**span, count)
    fit = fit_power_law(x, factor * x**exponent)
    assert fit is not None
    assert (fit.first, fit.last) == (0, count - 1)
    assert fit.slope == pytest.approx(exponent, abs=1e-9)
    assert fit.standard_error < 1e-9
    assert fit(x) == pytest.approx(factor * x**exponent)


@settings(max_examples=30)
@given(exponent=st.floats(0.5, 3.0), seed=st.integers(0, 1000))
def test_floor_and_saturation_are_left_out(exponent, seed):
    x = np.geomspace(1e-6, 1.0, 25)
    pure = (x / 1e-3) ** exponent
    floor, top = (1e-5 / 1e-3) ** exponent, (1e-1 / 1e-3) ** exponent
    bent = 1.0 / np.hypot(1.0 / np.hypot(pure, floor), 1.0 / top)
    fit = fit_power_law(x, bent * np.exp(0.01 * np.random.default_rng(seed).standard_normal(len(x))))
    assert fit is not None
    assert fit.slope == pytest.approx(exponent, abs=0.1)
    assert x[fit.first] > 3e-6
    assert x[fit.last] < 0.3


def test_the_standard_error_is_that_of_the_scatter():
    x = np.geomspace(1e-5, 1e-1, 12)
    rng = np.random.default_rng(1)
    fits = [fit_power_law(x, x**1.5 * np.exp(0.02 * rng.standard_normal(len(x)))) for _ in range(300)]
    whole_fits = [fit for fit in fits if fit is not None and fit.last - fit.first == len(x) - 1]
    assert len(whole_fits) > 270
    slopes = np.array([fit.slope for fit in whole_fits])
    errors = np.array([fit.standard_error for fit in whole_fits])
    assert errors.mean() == pytest.approx(slopes.std(), rel=0.15)
    # Student's t with 10 degrees of freedom: 1 in 20 beyond 2.23
    assert 0.9 < np.mean(np.abs(slopes - 1.5) < 2.23 * errors) < 0.99


@pytest.mark.parametrize(
    "y",
    [
        np.exp(np.linspace(0.0, 2.0, 10) ** 2),  # bends all along
        np.tile([1.0, 3.0], 5),  # no line
        np.zeros(10),
        np.full(10, np.nan),
    ],
)
def test_no_law_is_no_number(y):
    assert fit_power_law(np.geomspace(1.0, 100.0, 10), y) is None


def test_too_few_points_or_too_short_a_range_is_no_law():
    x = np.geomspace(1.0, 9.0, 10)
    assert fit_power_law(x, x) is None
    assert fit_power_law(np.array([1.0, 10.0, 100.0]), np.ones(3)) is None
    gap = np.ones(10, dtype=bool)
    gap[[3, 6]] = False
    assert fit_power_law(np.geomspace(1.0, 1e3, 10), np.ones(10), gap) is None


def test_of_two_laws_the_wider_counts():
    x = np.geomspace(1e-5, 1e-1, 13)
    fit = fit_power_law(x, np.where(x < 1.1e-4, x * 1e-4, x**2))
    assert fit.slope == pytest.approx(2.0)
    assert x[fit.first] == pytest.approx(1e-4)


def test_laws_of_each_series_and_panel_with_seeds_as_replicates():
    axes = [listed_axis(PERIOD, *PERIODS), listed_axis(WORDS, "explicit", "implicit"), listed_axis(LAMBDA, 0.5, 1.0)]
    data = study(law_figure(series=WORDS, facet=LAMBDA), axes=axes, sweep={"seeds": 3})

    def error(frame):
        power = frame[LAMBDA] + 0.5 * (frame[WORDS] == "implicit")
        return frame[PERIOD] ** power * (1.0 + 0.5 * frame["seed"])

    laws = accuracy_laws(make_result(data, motor__velocity_rmse=error))
    assert [(fitted_law.series[WORDS], fitted_law.where[LAMBDA], round(fitted_law.slope, 6)) for fitted_law in laws] == [
        ("explicit", 0.5, 0.5), ("implicit", 0.5, 1.0), ("explicit", 1.0, 1.0), ("implicit", 1.0, 1.5),
    ]  # fmt: skip
    assert [fitted_law.agrees for fitted_law in laws] == [False, True, True, False]
    np.testing.assert_allclose(laws[1].y_values, np.array(PERIODS) * 3.0 ** (1 / 3))


def test_law_of_noise_ends_at_the_floor_of_the_period_and_at_the_signal():
    fitted_law = fit_only_law(
        study(law_figure(NOISE, theory=0.5, where={PERIOD: 1e-3})),
        motor__velocity_rmse=lambda f: np.hypot(10.0 * f[PERIOD], np.minimum(20.0 * f[NOISE] ** 0.5, 1.0)),
    )
    assert fitted_law.slope == pytest.approx(0.5, abs=0.02)
    assert fitted_law.range == pytest.approx((10**-5.5, 1e-4))
    assert fitted_law.stops["below"].startswith("sampling period: the error is 2.24 times that without noise")
    assert fitted_law.stops["above"].startswith("saturation: the error is 36 % of the signal")


def test_law_of_the_period_ends_at_the_floor_of_noise():
    fitted_law = fit_only_law(
        study(law_figure(where={NOISE: 1e-7})),
        motor__velocity_rmse=lambda f: np.hypot(f[PERIOD], 0.1 * f[NOISE] ** 0.5),
    )
    assert fitted_law.slope == pytest.approx(1.0, abs=0.03)
    assert fitted_law.stops["below"].startswith("noise floor: the error is 1.45 times that without noise")
    assert fitted_law.stops["above"] == "end of the sweep"
    # the same without noise
    assert fit_only_law(study(law_figure(where={NOISE: "least"})), motor__velocity_rmse=lambda f: f[PERIOD]).in_range.all()


def test_white_noise_that_the_period_still_averages_is_named():
    fitted_law = fit_only_law(
        study(
            law_figure(NOISE, POSITION, where={PERIOD: "least"}),
            axes=[listed_axis(PERIOD, 1e-5, 4e-5), listed_axis(NOISE, *NOISES)],
        ),
        motor__position_rmse=lambda f: np.hypot(0.1 * f[NOISE], 1.0 * f[NOISE] ** 0.75 * f[PERIOD] ** 0.5),
        motor__velocity_rmse=lambda f: 0.0 * f[NOISE],
    )
    assert fitted_law.slope == pytest.approx(1.0, abs=0.1)
    assert fitted_law.stops["below"].startswith("sampling period: the error grows with it as h^0.")


def test_float_resolution_ends_a_law_and_leaves_none_where_all_is_zero():
    rounding = 1e-3 * np.finfo(np.float32).eps
    data = study(law_figure(where={NOISE: 0.0}))
    data["run"]["precision"] = "float32"
    fitted_law = fit_only_law(
        data,
        motor__velocity_rmse=lambda f: np.hypot(f[PERIOD], rounding / f[PERIOD]),
        motor__position_size=lambda f: 1e-3 + 0.0 * f[PERIOD],
    )
    assert fitted_law.slope == pytest.approx(1.0, abs=0.02)
    assert fitted_law.stops["below"].startswith("float resolution: the error is ")
    fitted_law = fit_only_law(
        study(law_figure(value=POSITION, where={NOISE: 0.0})), motor__position_rmse=lambda f: 0.0 * f[PERIOD]
    )
    assert fitted_law.fit is None
    assert fitted_law.to_dict()["slope"] is None
    assert fitted_law.stops == dict.fromkeys(("below", "above"), "float resolution: the error is exactly zero")


def test_a_diverged_seed_takes_its_point_out():
    data = study(law_figure(where={NOISE: 0.0}), sweep={"seeds": 2})
    fitted_law = fit_only_law(
        data,
        motor__velocity_rmse=lambda f: f[PERIOD],
        finite=lambda f: (f[PERIOD] < 9e-3) | (f["seed"] == 0),
    )
    assert fitted_law.range == (1e-5, 3e-3)
    assert fitted_law.stops["above"].startswith("no number: a run diverged")


def test_an_end_without_a_known_cause_says_so():
    fitted_law = fit_only_law(
        study(law_figure(where={NOISE: 0.0})), motor__velocity_rmse=lambda f: 1e-3 * np.maximum(f[PERIOD], 1e-4)
    )
    assert fitted_law.stops == {"below": "other: local slope 0.00", "above": "end of the sweep"}


BAD = {
    "no axis": (
        law_figure(where={"encoders.nois": 0.0}),
        f"where: 'encoders.nois' is not an axis of this study; did you mean '{NOISE}'?",
    ),
    "no value": (law_figure(where={NOISE: 2e-7}), f"where: '{NOISE}' has no value 2e-07; the nearest is 1e-07"),
    "no word": (
        law_figure(where={NOISE: "smallest"}),
        f"where: '{NOISE}' has no value 'smallest'; use a number, 'least' or 'largest'",
    ),
    "other axis": (
        law_figure(),
        f"theory: a fit needs single lines, and '{NOISE}' varies along them; fix it by where, series or facet",
    ),
    "no number": (
        law_figure(value="motor.converged", where={NOISE: 0.0}),
        "theory: 'motor.converged' is true or false and has no slope; leave theory out",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_figures_that_cannot_be_fitted(case):
    figure, message = BAD[case]
    with pytest.raises(InputError) as error:
        accuracy_laws(make_result(study(figure)))
    assert str(error.value) == f"figures[0].{message}"


def test_words_and_sampled_axes_in_where():
    axes = [listed_axis(PERIOD, *PERIODS), listed_axis(WORDS, "explicit", "implicit")]
    data = study(law_figure(where={WORDS: "implicit"}), axes=axes)
    fitted_law = fit_only_law(data, motor__velocity_rmse=lambda f: f[PERIOD] ** np.where(f[WORDS] == "implicit", 2.0, 1.0))
    assert fitted_law.slope == pytest.approx(2.0)
    with pytest.raises(InputError, match="has no value 'implict'; did you mean 'implicit'"):
        accuracy_laws(make_result(study(law_figure(where={WORDS: "implict"}), axes=axes)))
    data = study(
        law_figure(where={LAMBDA: 1.0}),
        axes=[axes[0], spaced_axis(LAMBDA, 1.0, 2.0)],
        sweep={"design": "sobol", "points": 4},
    )
    with pytest.raises(InputError, match="is sampled quasi-randomly and repeats no value"):
        accuracy_laws(make_result(data))


BAD_KEYS = {
    "heatmap with theory": (
        {"kind": "heatmap", "y": NOISE, "theory": 1.0},
        "figures[0]: a heatmap has no theory; use a line",
    ),
    "heatmap with where": ({"kind": "heatmap", "y": NOISE, "where": {}}, "figures[0]: a heatmap has no where; use facet"),
    "drawn and fixed": (
        {"where": {PERIOD: 1e-3}},
        f"figures[0]: {PERIOD} is drawn and cannot be fixed by where; leave it out of one of them",
    ),
    "no table": ({"where": NOISE}, "figures[0].where: should be a table, not 'encoders.noise'"),
    "a list": ({"where": {NOISE: [0.0]}}, f"figures[0].where.{NOISE}: should be a valid number, not [0.0]"),
    "theory in words": ({"theory": "one"}, "figures[0].theory: should be a valid number, not 'one'"),
}


@pytest.mark.parametrize("case", BAD_KEYS)
def test_wrong_keys_of_a_figure(case):
    keys, message = BAD_KEYS[case]
    figure = {key: value for key, value in law_figure().items() if key != "theory"} | keys
    with pytest.raises(InputError) as error:
        read_config(study(figure))
    assert str(error.value) == f"config: {message}"


@pytest.fixture(scope="module")
def swept_laws():
    """The shipped study made small: one inertia with a cogging torque that the observer does not know."""
    axes = [
        listed_axis(WORDS, "explicit", "implicit"),
        listed_axis(PERIOD, 1e-4, 2.5e-4, 6.25e-4, 2e-3, zip="period"),
        listed_axis("run.substeps", 1, 1, 1, 2, zip="period"),
        listed_axis(NOISE, 0.0, 3e-5, 1e-4, 3e-4, 1e-3),
    ]
    figures = [
        law_figure(value=POSITION, theory=2.0, series=WORDS, where={NOISE: 0.0}),
        law_figure(value=VELOCITY, theory=1.0, series=WORDS, where={NOISE: 0.0}),
        law_figure(NOISE, POSITION, 1.0, series=WORDS, where={PERIOD: "least"}),
        law_figure(NOISE, VELOCITY, 0.5, series=WORDS, where={PERIOD: "least"}),
    ]
    data = rigid_study(
        {"run.duration": 4.0, "observer.motor.lambda": 8.0, "observer.motor.velocity_error": 0.0},
        axes=axes,
        figures=figures,
        sweep={"seeds": 2},
        effects=[{"kind": "motor.cogging", "amplitude": 0.15, "harmonic": 2.0}],
        excitation={"kind": "sine", "amplitude": 0.4, "frequency": 0.5},
    )
    return sweep(data)


def test_slopes_of_a_real_sweep_are_theory_s(swept_laws):
    laws = {(fitted_law.figure, fitted_law.series[WORDS]): fitted_law for fitted_law in jaxbl.accuracy_laws(swept_laws)}
    for key, fitted_law in laws.items():
        if key == (0, "implicit"):
            assert fitted_law.fit is None
            assert fitted_law.stops["above"].startswith("float resolution")
        else:
            assert fitted_law.agrees, (key, fitted_law.slope, fitted_law.stops)
            assert fitted_law.standard_error < 0.05


def test_report_of_laws(swept_laws, tmp_path):
    result = write_report(swept_laws, tmp_path)
    assert "Accuracy laws: 7 of 8 have a slope within 0.1 of theory." in result.remarks
    (row,) = [row for row in result.tables[0].rows if not row[5]]
    assert row[0].startswith("motor.position_rmse over run.sample_period") and row[3].startswith("no")
    laws = json.loads((tmp_path / "laws.json").read_text())
    assert len(laws) == 8
    assert {"value", "x", "series", "where", "theory", "slope", "standard_error", "range", "points", "stops"} <= set(laws[0])
    assert laws[0]["where"] == {NOISE: 0.0}
    assert laws[0]["series"] == {WORDS: "explicit"}
    page = (tmp_path / "report.html").read_text()
    assert "<h2>Accuracy laws</h2>" in page
    assert "theory&#x27;s slope" in page
