"""Verification of the conditions: its counts done again from the frames, causes that are known, and what is kept."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
from shared_results import ATLAS, GAINS, INPUTS, VERIFY_STUDY
from small_study import ALPHA, LAMBDA, listed_axis, rigid_study

from jaxbl.config import read_config
from jaxbl.errors import InputError
from jaxbl.gains import error_system as module
from jaxbl.gains.counterexamples import repeat_with_change
from jaxbl.gains.stages import Stages
from jaxbl.gains.verify import verify
from jaxbl.sweeps.engine import Engine
from jaxbl.sweeps.sweep import open_study, sweep

AMPLITUDE, FREQUENCY, PERIOD = "excitation.amplitude", "excitation.frequency", "run.sample_period"
KEYS = {
    "drive": [AMPLITUDE, FREQUENCY, LAMBDA, ALPHA, "seed"],
    "sampled": [AMPLITUDE, FREQUENCY, LAMBDA, ALPHA, PERIOD, "seed"],
}
BOUNDS = {"true": "motor.f_plus", "claimed": "motor.f_plus_acceleration"}
CAUSES = {"run too short", "period too long", "noise", "quantisation", "explicit discretisation"}
GENERAL_CAUSES = {"several", "f_plus underestimated", "unexplained"}


def exact_lambda(ratio):
    """Least lambda at f_plus = 1 from the integrals of docs/theory_appendix.md."""
    c1, c2 = 2.0 * (ratio - 1.0), 2.0 * (ratio + 1.0)

    def arc(lambda_, c):
        return quad(lambda a: 1.0 / (np.sin(a) ** 2 + lambda_ * np.sin(a) * np.cos(a) + c * np.cos(a) ** 2), 0.0, np.pi / 2)[
            0
        ]

    def log_peaks(lambda_):
        return 0.5 * np.log(c2 / c1) - 0.5 * lambda_ * (arc(lambda_, c1) + arc(-lambda_, c2))

    return brentq(log_peaks, 0.0, 1.9 * np.sqrt(c2))


def demand_lambda(alpha, f_plus):
    """Least lambda by condition for one pair."""
    names = ("davila_fridman", "levant", "seeber_horn", "moreno_osorio", "exact")
    if not alpha > f_plus:
        return dict.fromkeys(names, np.nan if np.isnan(f_plus) else np.inf)
    values = (
        np.sqrt(2.0 / (alpha - f_plus)) * (alpha + f_plus) * 1.3 / 0.7,
        np.sqrt(4.0 * f_plus * (alpha + f_plus) / (alpha - f_plus)),
        np.sqrt(alpha + f_plus),
        np.sqrt(4.0 * (alpha - np.sqrt(alpha**2 - f_plus**2))),
        np.sqrt(f_plus) * exact_lambda(alpha / f_plus),
    )
    return dict(zip(names, values, strict=True))


def level_entry(summary, level):
    (level_data,) = [entry for entry in summary["levels"] if entry["level"] == level]
    return level_data


def test_normalised_level_counted_again(verified_study):
    verdict, _ = verified_study
    level_data, plane = level_entry(verdict.summary, "normalised"), verdict.error_map
    np.testing.assert_allclose(plane.alpha, np.geomspace(1.05, 12.0, 7))
    np.testing.assert_allclose(plane.lambda_, np.geomspace(0.05, 12.0, 9))
    assert plane.ratio.shape == (9, 7)
    assert level_data["cells"] == 63
    least = [demand_lambda(alpha, 1.0) for alpha in plane.alpha]
    np.testing.assert_allclose(plane.boundary, [column["exact"] for column in least], atol=1e-6)
    demanded_held = np.array([[lambda_ > column["exact"] for column in least] for lambda_ in plane.lambda_])
    np.testing.assert_array_equal(plane.ratio < 1.0, demanded_held)
    assert level_data["converged"] == demanded_held.sum()
    for entry in level_data["conditions"]:
        column = np.array([demands[entry["name"]] for demands in least])
        holds = plane.lambda_[:, None] > column
        assert 0 < entry["holds"] == holds.sum() < 63
        assert entry["counterexamples"] == 0
        assert entry["fails_but_converged"] == (~holds & demanded_held).sum()
        ratios = column / [demands["exact"] for demands in least]
        conservatism = entry["conservatism"]
        np.testing.assert_allclose(
            (conservatism["median"], conservatism["max"]), (np.median(ratios), ratios.max()), rtol=1e-5
        )


@pytest.fixture(scope="module")
def judged_cells(verified_study):
    """Rows of the frames as dicts by level and bound, each with the lambda that the conditions demand."""
    verdict, _ = verified_study
    return {
        (level, bound): [
            row | {"demanded": demand_lambda(row[ALPHA], row[column])} for row in verdict.levels[level].to_dict("records")
        ]
        for level in KEYS
        for bound, column in BOUNDS.items()
    }


@pytest.mark.parametrize(("level", "cells"), [("drive", 12), ("sampled", 48)])
def test_levels_of_the_drive_counted_again(level, cells, verified_study, judged_cells):
    verdict, _ = verified_study
    level_data = level_entry(verdict.summary, level)
    rows = judged_cells[level, "true"]
    keys = {tuple(row[key] for key in KEYS[level]) for row in rows}
    assert level_data["side"] == "motor"
    assert level_data["cells"] == len(rows) == len(keys) == cells
    assert level_data["converged"] == sum(row["motor.converged"] for row in rows)
    assert level_data["diverged"] == sum(not row["finite"] for row in rows)
    assert level_data["converged"] > 0
    for bound, listing in (("true", level_data["conditions"]), ("claimed", level_data["claimed_bound"]["conditions"])):
        rows = judged_cells[level, bound]
        for entry in listing:
            name = entry["name"]
            holds = [row[LAMBDA] > row["demanded"][name] for row in rows]
            assert entry["holds"] == sum(holds) > 0
            assert entry["counterexamples"] == sum(
                h and not row["motor.converged"] for h, row in zip(holds, rows, strict=True)
            )
            unneeded = sum(not h and row["motor.converged"] for h, row in zip(holds, rows, strict=True))
            assert entry["fails_but_converged"] == unneeded
    # the least lambda that worked, everything else being equal
    first = {}
    for row in judged_cells[level, "true"]:
        if row["motor.converged"]:
            other_values = tuple(row[key] for key in KEYS[level] if key != LAMBDA)
            if other_values not in first or row[LAMBDA] < first[other_values][LAMBDA]:
                first[other_values] = row
    for entry in level_data["conditions"]:
        ratios = np.array([row["demanded"][entry["name"]] / row[LAMBDA] for row in first.values()])
        least = np.array([row[LAMBDA] == 0.05 for row in first.values()])
        strict = np.isfinite(ratios) & (ratios > 1.0)
        conservatism = entry["conservatism"]
        if strict.any():
            np.testing.assert_allclose(
                (conservatism["median"], conservatism["max"]), (np.median(ratios[strict]), ratios[strict].max())
            )
        else:
            assert conservatism["median"] is None and conservatism["max"] is None
        assert (conservatism["columns"], conservatism["at_least"]) == (strict.sum(), (strict & least).sum())
    if level == "drive":
        assert (
            level_data["conditions"][0]["name"] == "davila_fridman"
            and level_data["conditions"][0]["conservatism"]["columns"] > 0
        )
    small = [row[BOUNDS["true"]] > row[BOUNDS["claimed"]] for row in judged_cells[level, "true"] if row["motor.converged"]]
    assert level_data["claimed_bound"]["too_small"] == pytest.approx(np.mean(small))


def test_counterexamples_are_the_runs_that_failed_where_a_condition_held(verified_study, judged_cells):
    verdict, _ = verified_study
    counterexamples = verdict.counterexamples
    assert set(counterexamples["side"]) == {"motor"}
    sizes = []
    for (level, bound), rows in judged_cells.items():
        keys = KEYS[level]
        for name in rows[0]["demanded"]:
            failed = {
                tuple(row[key] for key in keys)
                for row in rows
                if row[LAMBDA] > row["demanded"][name] and not row["motor.converged"]
            }
            part = counterexamples[
                (counterexamples["level"] == level)
                & (counterexamples["bound"] == bound)
                & (counterexamples["condition"] == name)
            ]
            level_data = list(part[keys].itertuples(index=False, name=None))
            assert len(level_data) == len(failed)
            assert set(level_data) == failed
            sizes.append(len(failed))
    assert sum(sizes) == len(counterexamples)
    assert np.sum(np.array(sizes) > 0) >= 5


def test_every_counterexample_carries_its_point_and_a_cause(verified_study):
    counterexamples = verified_study[0].counterexamples
    for level, part in counterexamples.groupby("level"):
        assert part[KEYS[level]].notna().all(axis=None)
    assert counterexamples.loc[counterexamples["level"] == "drive", PERIOD].isna().all()
    for cause in counterexamples["cause"]:
        assert cause in GENERAL_CAUSES or set(cause.split(" or ")) <= CAUSES, cause
    # what is not there is no cause
    assert not counterexamples["cause"].str.contains("quantisation").any()
    # of one run, one cause at the true bound
    true = counterexamples[counterexamples["bound"] == "true"]
    # half a rad/s takes longer than there is time
    assert set(true.loc[true["level"] == "drive", "cause"]) == {"run too short"}
    assert (true.groupby(["level", *KEYS["sampled"]], dropna=False)["cause"].nunique() == 1).all()


def test_causes_in_the_summary_count_runs(verified_study):
    verdict, _ = verified_study
    for level, keys in KEYS.items():
        part = verdict.counterexamples[verdict.counterexamples["level"] == level]
        run_counts = level_entry(verdict.summary, level).get("causes", {})
        assert set(run_counts) == set(part["bound"])
        for bound, causes in run_counts.items():
            runs = part[part["bound"] == bound].drop_duplicates(keys)
            assert sum(causes.values()) == len(runs)


def test_verdict_on_disk(verified_study):
    verdict, folder = verified_study
    level_data = json.loads((folder / "verdict.json").read_text())
    assert level_data == verdict.summary
    assert [level["level"] for level in level_data["levels"]] == ["normalised", "drive", "sampled"]
    for level in level_data["levels"]:
        assert isinstance(level["cells"], int)
        assert [entry["name"] for entry in level["conditions"]] == list(module.CONDITIONS)
        for entry in level["conditions"]:
            assert isinstance(entry["holds"], int) and isinstance(entry["counterexamples"], int)
            assert {"median", "max"} <= set(entry["conservatism"])
    stored = pd.read_parquet(folder / "counterexamples.parquet")
    pd.testing.assert_frame_equal(stored, verdict.counterexamples, check_dtype=False)
    true = verdict.counterexamples[verdict.counterexamples["bound"] == "true"]
    assert level_data["counterexamples_in_all"] == len(true)
    assert [entry["cause"] for entry in level_data["counterexamples"]] == true["cause"].tolist()[:200]


def read_contents(folder):
    return {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in folder.rglob("*") if path.is_file()}


def test_second_call_simulates_nothing_and_says_the_same(verified_study, monkeypatch):
    verdict, folder = verified_study
    results = {path: stored for path, stored in read_contents(folder).items() if path.parent.name == "points"}
    assert len(results) > 5
    monkeypatch.setattr(Engine, "run", lambda *_: pytest.fail("a finished level is simulated"))
    monkeypatch.setattr(module, "normalised_peak_ratios", lambda *_: pytest.fail("the plane is simulated again"))
    second = verify(VERIFY_STUDY, folder)
    assert second.summary == verdict.summary
    for level, frame in verdict.levels.items():
        pd.testing.assert_frame_equal(second.levels[level], frame)
    pd.testing.assert_frame_equal(second.counterexamples, verdict.counterexamples)
    contents_after = read_contents(folder)
    assert all(contents_after[path] == stored for path, stored in results.items())


def test_another_studys_folder_is_left_as_it_is(verified_study):
    _, folder = verified_study
    before = read_contents(folder)
    with pytest.raises(InputError, match="holds results of another study"):
        verify(rigid_study({"run.duration": 0.1}, axes=GAINS, verify=ATLAS), folder)
    assert read_contents(folder) == before


AT_REST = rigid_study(
    {"encoders.noise": 0.0, "observer.motor.velocity_error": 0.0},
    excitation={"kind": "sine", "amplitude": 0.1, "frequency": 2.0},
    effects=[{"kind": "motor.coulomb_friction", "torque": 0.2}],
    axes=[listed_axis(LAMBDA, 0.1, 6.0), listed_axis(ALPHA, 0.5, 9.0)],
    verify=ATLAS,
)


@pytest.fixture(scope="module")
def verified_at_rest(tmp_path_factory):
    """The verdict on `AT_REST`, and its folder."""
    folder = tmp_path_factory.mktemp("at_rest")
    return verify(AT_REST, folder), folder


def test_another_q_and_other_marks_go_on_with_what_is_there(verified_at_rest, monkeypatch, tmp_path):
    verdict, folder = verified_at_rest
    shutil.copytree(folder, tmp_path / "copy")
    monkeypatch.setattr(module, "normalised_peak_ratios", lambda *_: pytest.fail("the plane is simulated again"))
    equal_marks = [{"name": name, "lambda": 5.0, "alpha": 8.0} for name in ("one", "the same")]
    second = verify(AT_REST | {"verify": ATLAS | {"q": 0.6, "marks": equal_marks}}, tmp_path / "copy")
    titles = [level["conditions"][0]["title"] for level in second.summary["levels"]]
    assert titles == ["Davila-Fridman (32), q = 0.6"] * 3
    least, before = (v.summary["levels"][0]["conditions"][0]["conservatism"]["median"] for v in (second, verdict))
    # (1 + q) / (1 - q) at 0.6 and at 0.3
    assert least / before == pytest.approx(4.0 / (13.0 / 7.0))
    demands, same = second.summary["marks"]
    assert demands | {"name": "the same"} == same


def test_a_verification_keeps_to_its_backend(verified_study):
    _, folder = verified_study
    with pytest.raises(InputError, match="was begun without --backend; go on without it, or choose another folder"):
        verify(VERIFY_STUDY, folder, backend="scan")


def test_a_folder_of_other_files_is_left_as_it_is(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(InputError, match="is not empty and holds no results"):
        verify(VERIFY_STUDY, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("q", [-0.1, 0.0, 1.0, 1.5, float("nan")])
def test_q_outside_of_its_range(q, tmp_path):
    with pytest.raises(InputError, match=r"^config: verify\.q: should be "):
        verify(rigid_study(axes=GAINS, verify={"q": q}), tmp_path / "new")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("axes", [[], GAINS[:1], GAINS[1:], INPUTS])
def test_a_study_without_gain_axes(axes, tmp_path):
    with pytest.raises(InputError, match=r"^axes: verify needs axes over both gains of an observer, such as"):
        verify(rigid_study(axes=axes), tmp_path / "new")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("study", "message"),
    [
        (
            rigid_study(axes=[listed_axis(LAMBDA, 1.0, 2.0, zip="g"), listed_axis(ALPHA, 2.0, 3.0, zip="g")]),
            r"axes\[0\]\.zip: verify seeks the least lambda",
        ),
        (
            rigid_study(
                axes=[{"path": path, "start": 1.0, "stop": 9.0} for path in (LAMBDA, ALPHA)],
                sweep={"design": "sobol", "points": 4},
            ),
            r"sweep\.design: .* whole grid; remove it",
        ),
        (
            rigid_study(
                axes=[{"path": path, "start": 1.0, "stop": 9.0, "num": 3} for path in (LAMBDA, ALPHA)],
                sweep={"refine": 1},
            ),
            r"sweep\.refine: .* whole grid; remove it",
        ),
        (
            rigid_study(axes=GAINS, verify={"marks": [{"name": "m", "side": "load", "lambda": 1.0, "alpha": 2.0}]}),
            r"verify\.marks\[0\]\.side: 'load' has no meaning on a rigid drive; it should be 'motor'",
        ),
        (
            rigid_study(axes=GAINS, verify={"damping": [3000.0]}),
            r"verify\.damping\[0\]: should be less than or equal to 1000",
        ),
    ],
    ids=["zipped lambda", "sobol", "refined", "load mark on a rigid drive", "damping"],
)
def test_what_cannot_be_judged_is_refused_before_anything_runs(study, message, tmp_path):
    with pytest.raises(InputError, match=message):
        verify(study, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_without_anything_unknown_there_is_nothing_to_check():
    study = rigid_study({"drive.motor_viscous": 0.0, "encoders.noise": 0.0}, axes=GAINS, verify=ATLAS)
    with pytest.raises(InputError, match=r"motor: f⁺ = 0: "):
        verify(study)


def test_a_long_period_is_the_cause_and_a_quarter_of_the_runs_own_mends_it(verified_study):
    """Forward Euler chatters with period times alpha: a quarter of 16 ms would do, or no Euler."""
    verdict, folder = verified_study
    level_data = verdict.counterexamples
    point_row = level_data[(level_data["level"] == "sampled") & (level_data[ALPHA] == 8.0) & (level_data[LAMBDA] == 12.0)]
    assert set(point_row[PERIOD]) == {16e-3}
    assert set(point_row["cause"]) == {"explicit discretisation", "period too long or explicit discretisation"}
    periods = [
        open_study(cause_folder).config.run.sample_period
        for cause_folder in (folder / "verify/causes").glob("sampled-*-period_too_long")
    ]
    assert sorted(periods) == [0.25e-3, 4e-3]


def test_runs_repeated_for_their_cause_keep_their_noise():
    study = read_config(rigid_study(axes=GAINS, sweep={"seeds": 2, "first_seed": 5}))
    frame = sweep(study).frame
    change, stages = {"run.substeps": 2}, Stages(study, "verify")
    rows = repeat_with_change(study.to_dict(), study.axis_paths, frame.iloc[[1, 5]], change, stages, "again")
    keys = [LAMBDA, ALPHA, "seed"]
    pd.testing.assert_frame_equal(rows[keys].reset_index(drop=True), frame.iloc[[1, 5]][keys].reset_index(drop=True))
    assert set(rows["seed"]) <= {5, 6}


def test_claimed_bound_that_misses_friction_at_rest(verified_at_rest):
    """A torque below break-away moves nothing: no acceleration, but friction acts all the same."""
    verdict, _ = verified_at_rest
    frame = verdict.levels["drive"]
    np.testing.assert_allclose(frame["motor.f_plus_acceleration"], 0.0, atol=1e-12)
    np.testing.assert_allclose(frame["motor.f_plus"][frame[ALPHA] == 9.0], 0.1 / 0.05, rtol=0.01)
    level_data = verdict.counterexamples
    assert set(level_data["level"]) == {"drive", "sampled"}
    assert set(level_data["bound"]) == {"claimed"}
    assert set(level_data[ALPHA]) == {0.5}
    assert set(level_data["cause"]) == {"f_plus underestimated"}
    assert level_entry(verdict.summary, "drive")["claimed_bound"]["too_small"] == 1.0
