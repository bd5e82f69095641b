"""Table, chart and file of a benchmark."""

import json

import pytest

from jaxbl.report.bench import throughput_lines, write_bench_report
from jaxbl.throughput.run import CPP_NAME, FUSED_NAME, SCAN_NAME, BenchResult, BenchRow


@pytest.fixture
def bench_result():
    rows = []
    for precision, speed in (("float32", 2e9), ("float64", 5e8)):
        for name, share in ((CPP_NAME, 1.0), (FUSED_NAME, 0.8), (SCAN_NAME, 0.2), ("diffrax, Euler, one device", 1e-5)):
            row = BenchRow(name, precision, 1000, 100, 1.5, 1e-12, seconds=[1e5 / speed / share, 2e5 / speed / share])
            rows.append(row)
    curve = [
        {"name": name, "precision": "float32", "lanes": lanes, "steps": 100, "lane_steps_per_second": 1e6 * lanes}
        for name in (CPP_NAME, FUSED_NAME)
        for lanes in (64, 128, 256)
    ]
    study = [{"name": FUSED_NAME, "precision": "float32", "lanes": 1000, "steps": 3000, "seconds": 1.25}]
    machine = {"processor": "a processor", "cores": 2, "versions": {"jax": "1.0"}}
    left_out = {"numba, blocks of lanes": "no numba; pip install 'jaxbl[bench]'"}
    return BenchResult(machine, rows, curve, study, left_out)


def test_files_and_figures(bench_result, tmp_path):
    write_bench_report(bench_result, tmp_path)
    content = json.loads((tmp_path / "bench.json").read_text())
    row = next(r for r in content["rows"] if (r["name"], r["precision"]) == (FUSED_NAME, "float64"))
    assert row["lane_steps_per_second"] == pytest.approx(4e8)
    assert row["median_lane_steps_per_second"] == pytest.approx(4e8 / 1.5)
    assert {"name", "precision", "lanes", "steps", "lane_steps_per_second"} <= set(row)
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == ["lanes.png", "throughput.png"]


def test_the_table_says_who_where_and_how_far_from_the_ceiling(bench_result):
    lines = throughput_lines(bench_result)
    assert lines[0].startswith("a processor, 2 cores; jax 1.0; 100 samples")
    fused_line = next(line for line in lines if line.strip().startswith(FUSED_NAME))
    assert lines[3].split() == ["float32", "lanes", "best", "median", "of", "C++", "first", "off", "by"]
    assert fused_line.split()[4:] == ["1000", "1.6e+09", "1.07e+09", "0.8", "1.50", "s", "1e-12"]
    # those of both precisions below one another, within a terminal
    assert [line.split()[0] for line in lines if "lanes  " in line] == ["float32", "float64"]
    assert all(len(line) <= 80 for line in lines[3:])
    assert lines[-1] == "numba, blocks of lanes: left out, no numba; pip install 'jaxbl[bench]'"
    assert any("1.25 s" in line for line in lines)
