"""Medians and extremes of many runs: the same by few passes over kept rows as by many over parts."""

from io import BytesIO
from operator import itemgetter
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from small_study import ALPHA, LAMBDA, NOISE, listed_axis, make_result, rigid_study, spaced_axis

from jaxbl.report import aggregates
from jaxbl.report.aggregates import Groups
from jaxbl.report.results import write_report
from jaxbl.sweeps.engine import Engine
from jaxbl.sweeps.store import Store
from jaxbl.sweeps.sweep import open_study

NUMBERS = {
    "normal": lambda rng, n: rng.normal(size=n),
    "ties and zeros of both signs": lambda rng, n: rng.choice([0.0, -0.0, 1.0, 2.0], n),
    "over many decades": lambda rng, n: np.exp(50.0 * rng.normal(size=n)),
    "far apart": lambda rng, n: np.where(rng.random(n) < 0.5, -1e300, 1e-300) * rng.random(n),
}


@pytest.mark.parametrize("kind", NUMBERS)
def test_spread_is_that_of_pandas(kind):
    rng = np.random.default_rng(3)
    group_of, values = rng.integers(0, 20, 3000), NUMBERS[kind](rng, 3000)
    values[(rng.random(3000) < 0.1) | (group_of == 7)] = np.nan
    frame = pd.DataFrame({"group": group_of, "value": values})
    rows = [frame.iloc[i : i + 257] for i in range(0, 3000, 257)]
    actual = Groups(rows, ["group"]).spread(itemgetter("value"))
    groups = frame.groupby("group")["value"]
    for name, expected in (("least", groups.min()), ("median", groups.median()), ("largest", groups.max())):
        np.testing.assert_array_equal(actual[name], expected)


def test_groups_are_those_of_pandas():
    rng = np.random.default_rng(0)
    frame = pd.DataFrame(
        {"a": rng.choice(["x", "y"], 500), "b": rng.choice([3.0, 1.0, 2.0], 500), "v": rng.normal(size=500)}
    )
    frame.loc[rng.random(500) < 0.1, "v"] = np.nan
    frame["c"] = 1.0
    parts = [frame.iloc[i : i + 90] for i in range(0, 500, 90)]
    groups = Groups(parts, ["a", "b"], ["a", "c"])
    expected = frame.groupby(["a", "b"], sort=True)["v"]
    column = itemgetter("v")
    means = groups.means({"v": column})
    assert groups.varied == {"a"}
    pd.testing.assert_series_equal(means["v"], expected.mean())
    pd.testing.assert_series_equal(means["rows"], expected.size(), check_names=False)
    pd.testing.assert_series_equal(groups.spread(column)["median"], expected.median(), check_names=False)


def store_result(folder, data, **columns):
    """A made-up study in parts."""
    result = make_result(data, **columns)
    folder.mkdir()
    engine = Engine(result.config, backend="scan")
    store = Store.create(folder, engine)
    keys = [axis.path for axis in result.config.axes] + ["seed"]
    for index in range(len(engine)):
        labels = pd.DataFrame(engine.row_labels(engine.chunk(index)))
        store.write_part(index, labels.merge(result.frame, on=keys, how="left", validate="1:1"))
    store.update_manifest(finished=True)
    return open_study(folder)


MAP = {"kind": "heatmap", "x": ALPHA, "y": LAMBDA, "value": "motor.velocity_rmse"}
LINE = {"kind": "line", "x": ALPHA, "value": "motor.velocity_rmse"}
FIGURES = [
    MAP | {"facet": NOISE, "overlays": ["exact"]},
    MAP | {"value": "motor.converged"},
    LINE | {"series": NOISE},
    LINE | {"where": {LAMBDA: "least"}},
    LINE | {"where": {LAMBDA: "least", NOISE: 1e-4}, "theory": 0.5},
]
GRID = [listed_axis(NOISE, 1e-4, 1e-3), spaced_axis(ALPHA, 1.0, 100.0, 7), spaced_axis(LAMBDA, 1.0, 20.0, 5)]
STUDIES = {
    "grid": {"axes": GRID, "sweep": {"seeds": 4, "chunk": 50}},
    "design": {"axes": [GRID[0], *({k: v for k, v in axis.items() if k != "num"} for axis in GRID[1:])],
               "sweep": {"design": "sobol", "points": 64, "seeds": 2, "chunk": 50}},
}  # fmt: skip


def write_values(figure, file, **_):
    """Write the numbers and texts of a figure in place of its picture."""
    artists = [artist for ax in figure.axes for artist in ax.get_children()]
    texts = [artist.get_text() for artist in artists if isinstance(artist, Text)]
    readers = "get_xydata", "get_offsets", "get_array"
    numbers = [getattr(artist, reader)() for artist in artists for reader in readers if hasattr(artist, reader)]
    text = str([texts, *(np.ma.filled(np.ma.asarray(x, float), np.nan).tolist() for x in numbers)])
    if isinstance(file, BytesIO):
        file.write(text.encode())
    else:
        Path(file).write_text(text)


@pytest.mark.parametrize("kind", STUDIES)
def test_reports_are_the_same_part_by_part(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(Figure, "savefig", write_values)
    rng = np.random.default_rng(0)
    figures = FIGURES if kind == "grid" else FIGURES[:3]
    result = store_result(
        tmp_path / "study",
        rigid_study(figures=figures, **STUDIES[kind]),
        motor__velocity_rmse=lambda frame: np.sqrt(frame[ALPHA]) * np.exp(rng.normal(size=len(frame))),
        motor__converged=lambda frame: frame[LAMBDA] > rng.uniform(0.0, 20.0, len(frame)),
        motor__f_plus=lambda frame: rng.uniform(1.0, 30.0, len(frame)),
        finite=lambda frame: rng.random(len(frame)) < 0.99,
    )
    assert result.source.manifest["parts"] > 4
    full, parts = tmp_path / "whole", tmp_path / "parts"
    lines = []
    for folder in (full, parts):
        folder.mkdir()
        lines.append(write_report(result, folder))
        monkeypatch.setattr(aggregates, "_MOST_KEPT", 0)
    assert lines[0] == lines[1]
    # values of figures are in the page
    assert (full / "report.html").read_bytes() == (parts / "report.html").read_bytes()
    assert len(list((parts / "figures").iterdir())) == len(figures)
