"""Everyone does the same work: each entry's figures are those of a loop in NumPy; wrong ones are not timed."""

import functools
import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from jaxbl.errors import NoResult
from jaxbl.throughput import run
from jaxbl.throughput.run import (
    PRECISIONS,
    Entry,
    _check_entry,
    _is_timed,
    _reference_metrics,
    _select_runnable,
    make_entries,
)
from jaxbl.throughput.workload import METRIC_NAMES, RANGES, Workload
from jaxbl.workers import count_cores

STEPS = 1500
ONE_PRECISION = {
    "c++, one core": "float64",
    "jaxbl fused, one core": "float32",
    run.SCAN_NAME: "float32",
    "jaxbl scan, one device": "float64",
    "numba, blocks of lanes": "float64",
    "diffrax, Euler, one device": "float64",
}
"""Entries that are compiled slowly, or that another one differs from by its cores alone."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("kernel")


def _short_curve(curve, entries, lanes, *remainder):
    return curve(entries, min(lanes, 64), *remainder)


@functools.cache
def reference_metrics(lanes):
    return _reference_metrics(lanes, STEPS)


@pytest.mark.parametrize(
    ("name", "precision"),
    [
        (entry.name, precision)
        for entry in make_entries(Path(), 2, 2)
        for precision in PRECISIONS
        if _is_timed(entry, precision, quick=False) and ONE_PRECISION.get(entry.name, precision) == precision
    ],
)
def test_figures_are_those_of_the_reference(name, precision, folder):
    runnable, left_out = _select_runnable(make_entries(folder, 2, 2), folder)
    if name in left_out:
        pytest.skip(left_out[name])
    entry = next(entry for entry in runnable if entry.name == name)
    figures = entry.prepare(Workload(min(entry.lanes, 70), STEPS, precision))()
    assert set(figures) == set(METRIC_NAMES)
    assert all(len(values) == min(entry.lanes, 70) for values in figures.values())
    # which raises where they are not
    _check_entry(entry, precision, figures, reference_metrics(min(entry.lanes, 70)))


def test_a_wrong_result_is_not_timed():
    true = reference_metrics(64)
    off_by_a_percent = {name: 1.01 * values for name, values in true.items()}
    entry = Entry("someone", lambda workload: lambda: off_by_a_percent, 64)
    with pytest.raises(NoResult, match=r"someone, float64: .* is off by 0.01"):
        _check_entry(entry, "float64", off_by_a_percent, true)
    undefined = true | {"motor.stiffness": np.full(64, np.nan)}
    with pytest.raises(NoResult, match=r"motor\.stiffness"):
        _check_entry(entry, "float64", undefined, true)


def test_the_whole_benchmark_uses_the_cores_there_are(monkeypatch):
    used, parts, thread_counts, curve = [], [], [], run._measure_curve

    def make_fused_entry(folder, count, devices):
        used.append(count)
        return [
            entry._replace(lanes=2**10) for entry in make_entries(folder, count, devices) if entry.name == run.FUSED_NAME
        ]

    def short_curve(entries, lanes, *remainder):
        thread_counts.append(lanes)
        return curve(entries, min(lanes, 128), *remainder)

    monkeypatch.setenv("CXX", "no-such-compiler")
    monkeypatch.setattr(run, "make_entries", make_fused_entry)
    monkeypatch.setattr(run, "_measure_curve", short_curve)
    result = run.bench(quick=True, progress=lambda done, total: parts.append((done, total)))
    assert set(used) == {result.machine["cores"]} == {count_cores()}
    assert parts[-1][0] == parts[-1][1]
    assert all(row.lane_steps_per_second >= row.median_lane_steps_per_second > 0 for row in result.rows)
    assert thread_counts == [2**k for k in range(6, 19, 3)]
    assert [point["lanes"] for point in result.curve] == [min(lanes, 128) for lanes in thread_counts]
    assert len(result.study) == 1


def test_a_failing_check_leaves_table_and_file(monkeypatch, call, tmp_path):
    def zero_metrics(workload):
        return lambda: {name: np.zeros(workload.lanes) for name in METRIC_NAMES}

    def make_right_and_wrong_entries(folder, count, devices):
        ours = next(entry for entry in make_entries(folder, count, devices) if entry.name == run.FUSED_NAME)
        return [ours._replace(lanes=2**10), Entry(run.CPP_NAME, zero_metrics, 2**10)]

    monkeypatch.setattr(run, "make_entries", make_right_and_wrong_entries)
    monkeypatch.setattr(run, "_measure_curve", functools.partial(_short_curve, run._measure_curve))
    monkeypatch.setattr("jax.config.update", lambda *_: None)
    code, lines, _ = call("bench", "--quick")
    saved = json.loads((tmp_path / "results" / "bench" / "bench.json").read_text())
    assert code == 1
    assert {row["name"] for row in saved["rows"]} == {point["name"] for point in saved["curve"]} == {run.FUSED_NAME}
    assert len(saved["failures"]) == 2
    assert all(
        f"{run.CPP_NAME}, {precision}: " in failure for precision, failure in zip(PRECISIONS, saved["failures"], strict=True)
    )
    assert any(line.startswith(run.FUSED_NAME) for line in lines)
    assert lines[-2:] == saved["failures"]


def test_no_right_result_is_an_error(monkeypatch):
    entry = Entry("someone", lambda workload: lambda: {name: np.zeros(workload.lanes) for name in METRIC_NAMES}, 64)
    monkeypatch.setenv("CXX", "no-such-compiler")
    monkeypatch.setattr(run, "make_entries", lambda *_: [entry])
    with pytest.raises(NoResult, match="someone, float32"):
        run.bench(quick=True)


def test_who_cannot_run_is_left_out_with_a_reason(monkeypatch, folder):
    find = importlib.util.find_spec
    monkeypatch.setattr(run.importlib.util, "find_spec", lambda name: None if name == "numba" else find(name))
    monkeypatch.setenv("CXX", "no-such-compiler")
    runnable, left_out = _select_runnable(make_entries(folder, 2, 2), folder / "none")
    assert "install g++" in left_out["c++, one core"]
    assert "jaxbl[bench]" in left_out["numba, blocks of lanes"]
    monkeypatch.setenv("CXX", "false")
    _, left_out = _select_runnable(make_entries(folder, 2, 2), folder / "broken")
    assert "cannot compile chain.cpp: exit code 1" in left_out["c++, one core"]
    assert {"jaxbl fused, all cores", "NumPy, lane arrays"} <= {entry.name for entry in runnable}


def test_fewer_lanes_are_the_first_of_more():
    first_lanes, more_lanes = (Workload(lanes, STEPS, "float64").values() for lanes in (5, 500))
    for path, (low, high) in RANGES.items():
        np.testing.assert_array_equal(first_lanes[path], more_lanes[path][:5])
        assert more_lanes[path].min() >= low
        assert more_lanes[path].max() <= high
        # every tenth of the range has its share of lanes
        shares = np.histogram(np.log(more_lanes[path]), 10, np.log([low, high]))[0]
        assert shares.min() > 40
