"""A study as maps in a browser: its data, and its page by mouse and keyboard, from disk and served."""

import base64
import json
import re
import threading
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from browser import check_figures, needs_chromium, open_pages
from small_study import ALPHA, LAMBDA, NOISE, listed_axis, make_result, rigid_study, small_study, spaced_axis

from jaxbl.config import read_config
from jaxbl.errors import InputError
from jaxbl.report.aggregates import Groups
from jaxbl.report.explorer.folder import Source, write_static
from jaxbl.report.explorer.server import ExplorerServer
from jaxbl.report.explorer.study import simulate_nearby, simulate_point, study_source, write_study
from jaxbl.report.maps import best_gains, worst_runs
from jaxbl.sweeps.sweep import open_study, share, sweep
from jaxbl.sweeps.trial import run

pytestmark = pytest.mark.usefixtures("compiled_once")
HOSTILE = "</script><script>alert(1)</script> <b>a</b> \u202e"
AXES = [listed_axis(NOISE, 1e-5, 1e-4), spaced_axis(ALPHA, 2.0, 50.0, 6), spaced_axis(LAMBDA, 1.0, 20.0, 5)]


def product_error(frame):
    return frame[ALPHA] * frame[LAMBDA] * (1.0 + 1e3 * frame[NOISE]) + 0.1 * frame["seed"]


def make_study_result(**columns):
    data = rigid_study({"title": HOSTILE}, axes=AXES, sweep={"seeds": 3})
    return make_result(data, motor__velocity_rmse=product_error, motor__f_plus=lambda frame: 1.0, **columns)


def make_source(result, lead=()):
    return Source(
        result.config.title,
        lead,
        lambda out, served: write_study(result, out, lead, served=served),
        {},
        lambda: None,
        lambda: None,
    )


def read_data(folder):
    return json.loads((folder / "data.js").read_text().removeprefix("jaxblData(").rstrip().removesuffix(");"))


def test_rows_are_in_the_order_of_the_axes_whatever_that_of_the_parts(tmp_path):
    result = make_study_result(motor__convergence_time=lambda frame: np.where(frame["seed"] > 0, np.inf, 1.0))
    shuffled = result.frame.sample(frac=1.0, random_state=0).iloc[5:]
    write_static(make_source(result.__class__(result.config, shuffled), ["found"]), tmp_path / "out")
    data, table = read_data(tmp_path / "out"), pq.read_table(tmp_path / "out" / "points.parquet").to_pandas()
    assert (data["rows"], data["found"], data["title"]) == (180, 175, HOSTILE)
    paths = [path["path"] for axis in data["axes"] for path in axis["paths"]]
    grid = pd.MultiIndex.from_product([axis["paths"][0]["values"] for axis in data["axes"]], names=paths)
    expected = shuffled.set_index(paths)["motor.velocity_rmse"].reindex(grid).to_numpy()
    np.testing.assert_allclose(table["motor.velocity_rmse"], expected, rtol=1e-6)
    # what is infinite is not there
    assert table["motor.convergence_time"].isna().sum() > 100
    # the same bytes in scripts, for pages from disk
    scripts = "".join(file.read_text() for file in sorted((tmp_path / "out").glob("points.*.js")))
    assert scripts.startswith("jaxblBytes(0, ") and len(scripts) > 4 * data["bytes"] / 3


def test_sizes_are_drawn_and_lanes_that_diverged_are_not_there(tmp_path):
    columns = {"motor__stiffness_error": lambda frame: -2.0, "finite": lambda frame: frame["seed"] != 1}
    result = make_result(small_study(axes=AXES, sweep={"seeds": 3}), **columns)
    write_static(make_source(result, []), tmp_path)
    table = pq.read_table(tmp_path / "points.parquet").to_pandas()
    stiffness_error = table["motor.stiffness_error"]
    assert stiffness_error.isna().mean() == pytest.approx(1.0 / 3.0) and set(stiffness_error.dropna()) == {2.0}
    assert set(table["finite"]) == {0.0, 1.0}
    (shown_metric,) = [metric for metric in read_data(tmp_path)["metrics"] if metric["name"] == "motor.stiffness_error"]
    assert shown_metric["label"].startswith("motor: |")


def test_zipped_axes_are_one(tmp_path):
    axes = [spaced_axis(ALPHA, 2.0, 50.0, 3), {"path": LAMBDA, "values": [1.0, 1.0, 3.0], "zip": "pair"},
            {"path": NOISE, "values": [1e-5, 1e-4, 1e-4], "zip": "pair"}]  # fmt: skip
    result = make_result(rigid_study(axes=axes), motor__velocity_rmse=product_error)
    write_static(make_source(result, []), tmp_path)
    table = pq.read_table(tmp_path / "points.parquet").to_pandas()
    assert len(table) == 9 and [len(axis["paths"]) for axis in read_data(tmp_path)["axes"]] == [1, 2, 1]
    np.testing.assert_allclose(table["motor.velocity_rmse"], result.frame["motor.velocity_rmse"], rtol=1e-6)


def test_folders_of_others_are_refused(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "index.html").write_text("mine")
    with pytest.raises(InputError, match="mine: is not empty and holds no results"):
        write_static(make_source(make_study_result(), []), tmp_path / "mine")
    assert (tmp_path / "mine" / "index.html").read_text() == "mine"
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="file: is a file; --out should name a folder"):
        write_static(make_source(make_study_result()), tmp_path / "file")
    for _ in range(2):
        write_static(make_source(make_study_result(), []), tmp_path / "again")
    other = make_source(make_study_result())._replace(identity="another study")
    with pytest.raises(InputError, match="again: holds results of another page"):
        write_static(other, tmp_path / "again")


def read_pointer_values(values):
    """The numbers beside the pointer: of the cell, of x, of y."""
    return [float(line.split(": ")[-1].split()[0]) for line in values.inner_text().split("\n")]


def find_place(page, x, y, chart=0, whole="#plot"):
    """A place within the axes of a chart, as shares of their lengths, in pixels of the page."""
    axes = page.locator(f"{whole} .u-over").nth(chart)
    axes.wait_for()
    box = axes.bounding_box()
    return box["x"] + x * box["width"], box["y"] + (1.0 - y) * box["height"]


def drag(page, start, end):
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*end, steps=3)
    page.mouse.up()


def save_download(page, selector, path):
    with page.expect_download() as download:
        page.click(selector)
    path.write_bytes(Path(download.value.path()).read_bytes())
    return path


@needs_chromium
def test_values_regions_cuts_and_a_point_as_config(tmp_path):
    result = make_study_result(motor__converged=lambda frame: frame["seed"] > 0)
    page_file = write_static(make_source(result, [HOSTILE]), tmp_path / "out")
    with open_pages(page_file, color_scheme="dark") as (page,):
        page.wait_for_selector(f"body[data-drawn='motor.velocity_rmse {ALPHA} {LAMBDA}']")
        assert page.locator("#title").text_content() == page.locator("#lead").text_content() == HOSTILE
        values = page.locator("#plot .values").first
        # a cell: the median over seeds, at the noise with the larger spread
        page.select_option("#at-encoders-noise", "0")
        page.mouse.move(*find_place(page, 0.25, 0.5))
        alphas, lambdas = np.geomspace(2.0, 50.0, 6), np.geomspace(1.0, 20.0, 5)
        assert read_pointer_values(values) == pytest.approx(
            [alphas[1] * lambdas[2] * 1.01 + 0.1, alphas[1], lambdas[2]], rel=1e-3
        )
        check_figures(page, 0)
        # of what is true or false, the share
        page.select_option("#metric", "motor.converged")
        page.wait_for_selector("body[data-drawn^='motor.converged ']")
        page.mouse.move(*find_place(page, 0.26, 0.5))
        assert read_pointer_values(values)[0] == pytest.approx(2.0 / 3.0, rel=1e-3)
        page.select_option("#metric", "motor.velocity_rmse")
        page.wait_for_selector("body[data-drawn^='motor.velocity_rmse ']")
        # other noise, the largest seed
        page.select_option("#at-encoders-noise", "1")
        page.select_option("#how", "largest")
        page.wait_for_function("page.said && page.view.how === 'largest'")
        page.mouse.move(*find_place(page, 0.25, 0.5))
        assert read_pointer_values(values)[0] == pytest.approx(alphas[1] * lambdas[2] * 1.1 + 0.2, rel=1e-3)
        # the exact condition is drawn, at the median f_plus
        page.wait_for_selector("#state:has-text('f⁺ = 1 rad/s²')")
        # axes change places
        page.select_option("#x", LAMBDA)
        page.wait_for_selector(f"body[data-drawn='motor.velocity_rmse {LAMBDA} {ALPHA}']")
        # a region by mouse, a cell by keyboard
        drag(page, find_place(page, 0.05, 0.9), find_place(page, 0.6, 0.3))
        page.wait_for_function("page.shown.view.from[1] === 1")
        page.mouse.move(*find_place(page, 0.02, 0.02))
        assert read_pointer_values(values)[1:] == pytest.approx([lambdas[0], alphas[1]], rel=1e-3)
        page.locator("#plot .plane").focus()
        for key in ("ArrowRight", "Enter"):
            page.keyboard.press(key)
        page.locator("#cuts .uplot").nth(1).wait_for()
        where = page.locator("#where").inner_text()
        # what is saved stays the chosen cell, whatever is looked at then
        page.keyboard.press("ArrowLeft")
        page.select_option("#at-encoders-noise", "0")
        save_download(page, "#point", tmp_path / "out" / "point.toml")
        save_download(page, "#gains", tmp_path / "gains.toml")
        # side by side, a map of each noise; the chosen point stays, and is marked in both
        page.select_option("#facet", NOISE)
        page.wait_for_selector(f"body[data-drawn='motor.velocity_rmse {LAMBDA} {ALPHA} {NOISE}']")
        assert page.evaluate("page.shown.panels.map(({ chart }) => chart.marks.at(-1)[2])") == ["ghost", "ring"]
        page.click("#whole")
        page.wait_for_function("page.shown.view.from[1] === 0")
        page.mouse.move(*find_place(page, 0.1, 0.1))
        assert values.inner_text().endswith(f"{NOISE} = 1e-5 rad") and page.locator("#where").inner_text() == where
        assert save_download(page, "#picture", tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    config = read_config(tmp_path / "out" / "point.toml")
    assert config.encoders.noise == 1e-4 and config.axes == []
    motor = config.observer.motor
    assert any(motor.alpha == pytest.approx(alpha) for alpha in alphas)
    assert where.startswith(f"{NOISE} 1e-4 rad, motor.alpha {motor.alpha:.4g} rad/s², motor.lambda {motor.lambda_:.4g} ")
    observer = tomllib.loads((tmp_path / "gains.toml").read_text())["observer"]
    assert observer == {"motor": {"lambda": config.observer.motor.lambda_, "alpha": config.observer.motor.alpha}}


@needs_chromium
def test_a_filter_the_points_it_leaves_and_a_link_to_them(tmp_path):
    """In maps, as points of one metric over another, over parallel axes, and as a table."""
    columns = {
        "motor__converged": lambda frame: frame[ALPHA] > 3.0,
        "motor__margin_exact": lambda frame: frame[LAMBDA] / 2.0,
        "motor__chatter": lambda frame: 1.0 / frame[ALPHA],
    }
    result, frame = make_study_result(**columns), make_study_result(**columns).frame
    page_file = write_static(make_source(result), tmp_path / "out")
    passing = frame[frame["motor.converged"] & (frame["motor.margin_exact"] > 1.1)]
    filtered = f"#state:has-text('{len(passing)} of 180 points pass the filter.')"
    with open_pages(page_file) as (page,):
        page.wait_for_selector("body[data-drawn^='motor.velocity_rmse ']")
        page.fill("#filter", "converged and margin > 1.1")
        page.keyboard.press("Enter")
        page.wait_for_selector(filtered)
        page.mouse.move(*find_place(page, 0.02, 0.9))
        assert "left out by the filter" in page.locator("#plot .values").inner_text()
        # what it cannot read is told
        page.fill("#filter", "convergd")
        page.keyboard.press("Enter")
        page.wait_for_selector("#state:has-text(\"Filter: 'convergd' is no axis or metric\")")
        page.fill("#filter", f"not converged or seed != 0 and {NOISE} < 2e-5")
        page.keyboard.press("Enter")
        either = ~frame["motor.converged"] | (frame["seed"] != 0) & (frame[NOISE] < 2e-5)
        page.wait_for_selector(f"#state:has-text('{either.sum()} of 180 points pass')")
        # one metric over another
        page.fill("#filter", "converged and margin > 1.1")
        page.keyboard.press("Enter")
        page.select_option("#kind", "points")
        page.select_option("#px", "motor.chatter")
        page.select_option("#py", "motor.velocity_rmse")
        page.wait_for_selector("body[data-drawn='motor.velocity_rmse motor.chatter motor.velocity_rmse']")
        page.wait_for_selector(filtered)
        # the link opens the same
        page.reload()
        page.wait_for_selector(f"{filtered} >> visible=true")
        assert page.evaluate("page.shown.chart.lines[0].x.length") == len(passing)
        # over parallel axes a drag along one of them adds to the filter
        page.select_option("#kind", "parallel")
        page.wait_for_function("page.kinds.parallel.chart")
        alpha = page.evaluate("page.kinds.parallel.fields().findIndex((one) => one.name.endsWith('.alpha'))")
        count = page.evaluate("page.kinds.parallel.fields().length")
        across = (alpha + 0.4) / (count - 0.2)
        drag(page, find_place(page, across - 0.02, 0.6), find_place(page, across + 0.02, 1.0))
        page.wait_for_function("page.view.filter.includes('observer.motor.alpha >= ')")
        assert page.locator("#filter").input_value().startswith("converged and margin > 1.1 and observer.motor.alpha >= ")
        page.wait_for_function("document.querySelector('#state').textContent.includes('points pass')")
        # the best points as a table, and all of them as CSV
        page.click("#count")
        first = page.locator("#rows tbody tr").first
        first.wait_for()
        table = pd.read_csv(save_download(page, "#csv", tmp_path / "points.csv"))
        assert table["motor.velocity_rmse"].is_monotonic_increasing and set(table["motor.converged"]) == {"yes"}
        bounds = [float(word) for word in re.findall(r"alpha [<>]= (\S+)", page.locator("#filter").input_value())]
        inside = passing[(passing[ALPHA] >= bounds[0]) & (passing[ALPHA] <= bounds[1])]
        assert 0 < len(inside) == len(table) < len(passing)
        np.testing.assert_allclose(table["motor.velocity_rmse"], np.sort(inside["motor.velocity_rmse"]), rtol=1e-5)
        first.locator("button").click()
        page.locator("#where:not(:empty)").wait_for()
        check_figures(page, 0)


@needs_chromium
def test_an_address_with_anything_in_it_opens_a_page(tmp_path):
    page_file = write_static(make_source(make_study_result()), tmp_path / "out")
    addresses = [
        "metric=%3Cimg%20src=x%20onerror=alert(1)%3E&x=nothing&y=seed&facet=seed&how=constructor",
        f"at.{NOISE}=1e99&at.seed=-3&region=9~9~1~1&row=1e3&pins=9999~x",
        f"region=0.5~1~3~NaN&at.{NOISE}=0.7&row=179&condition=none",
        "kind=points&px=constructor&range=a~b~~&filter=%3Cb%3E",
        "kind=parallel&metric=seed&filter=seed%20%3E%20x",
        "kind=__proto__",
        "%%%",
    ]
    with open_pages(page_file) as (page,):
        for words in addresses:
            page.goto("about:blank")
            page.goto(f"{page_file.as_uri()}#{words}")
            page.wait_for_selector("body[data-drawn]:not([data-drawn='overview'])")
            page.wait_for_selector("#state:not(:has-text('reading'))")
            assert page.locator("#plot .uplot").count() >= 1 and "cannot be read" not in page.locator("#state").inner_text()


def test_the_first_view_is_the_slice_with_a_border_and_has_the_best_gains(tmp_path):
    columns = {
        "motor__converged": lambda frame: (frame[ALPHA] > 10.0) | (frame[NOISE] < 5e-5),
        "motor__margin_alpha": lambda frame: frame[ALPHA],
        "motor__margin_exact": lambda frame: 2.0,
    }
    result = make_study_result(**columns)
    write_static(make_source(result), tmp_path)
    data = read_data(tmp_path)
    assert data["start"] == {"x": 1, "y": 2, "at": [1, 0, 0, 0]}
    assert [star[0] for star in data["stars"]] == [1, 0]
    # of the gains of least error those that may change most, as in the report
    runs = worst_runs(
        Groups([result.frame[result.frame[NOISE] > 5e-5]], [LAMBDA, ALPHA], [LAMBDA, ALPHA, "seed"]),
        "motor.velocity_rmse",
    )
    best = best_gains(runs)
    place = runs.index[best.index]
    axes = [axis["paths"][0]["values"] for axis in data["axes"]]
    assert (axes[2][data["stars"][0][2]], axes[1][data["stars"][0][1]]) == place
    assert data["overview"]["shape"] == [5, 6]


@needs_chromium
def test_signs_whole_numbers_and_axes_in_any_order(tmp_path):
    together = [listed_axis("run.substeps", 1, 2, zip="pair"), listed_axis(NOISE, 1e-5, 1e-4, zip="pair")]
    axes = [*together, spaced_axis(ALPHA, 2.0, 50.0, 6), listed_axis(LAMBDA, 20.0, 1.0, 5.0)]
    axes = [listed_axis("effects.1.torque", 0.25, 0.5), listed_axis("effects.motor.cogging.harmonic", 3, 4), *axes]
    friction = {"kind": "motor.coulomb_friction", "torque": 0.02}
    effects = [friction, friction, {"kind": "motor.cogging", "amplitude": 0.01, "harmonic": 2}]
    columns = {"motor__velocity_rmse": lambda frame: frame[ALPHA] - 10.0, "motor__f_plus": lambda frame: 1.0}
    result = make_result(rigid_study(axes=axes, effects=effects), **columns)
    with open_pages(write_static(make_source(result), tmp_path / "out")) as (page,):
        page.wait_for_selector(f"body[data-drawn='motor.velocity_rmse {ALPHA} {LAMBDA}']")
        # from the least to the largest, which no logarithm shows
        assert "colours: motor: velocity error, rms (rad/s), from -8 to 40" in page.locator("#plot .plane").get_attribute(
            "aria-label"
        )
        assert page.locator("[id='at-run-substeps'] option").all_inner_texts() == ["all", "1, 1e-5 rad", "2, 1e-4 rad"]
        # a curve goes from small to large
        assert page.locator("#condition").count() == 0
        page.mouse.click(*find_place(page, 0.95, 0.1))
        page.locator("#where:not(:empty)").wait_for()
        save_download(page, "#point", tmp_path / "out" / "point.toml")
        # enlarged until numbers end
        assert page.evaluate("ticks(1, 1 + Number.EPSILON, false).length") <= 7
        assert page.evaluate("[ticks(0.4, 120, true), ticks(0, 1, false), ticks(2, 3, true)]") == [
            [0.5, 1, 2, 5, 10, 20, 50, 100], [0, 0.2, 0.4, 0.6, 0.8, 1], [2, 2.2, 2.4, 2.6, 2.8, 3],
        ]  # fmt: skip
    config = read_config(tmp_path / "out" / "point.toml")
    assert (config.run.substeps, config.observer.motor.lambda_, config.observer.motor.alpha) == (1, 20.0, 50.0)
    effects_of_point = config.to_dict()["effects"]
    assert [effect.get("torque", effect.get("harmonic")) for effect in effects_of_point] == [0.02, 0.25, 3]


SWEEP_STUDY = rigid_study(
    axes=[listed_axis(NOISE, 1e-5, 1e-4), spaced_axis(ALPHA, 5.0, 50.0, 3), spaced_axis(LAMBDA, 1.0, 20.0, 2)],
    sweep={"chunk": 4},
)


@pytest.fixture(scope="module")
def swept_folder(tmp_path_factory):
    """A sweep of twelve runs, stored."""
    folder = tmp_path_factory.mktemp("swept")
    sweep(SWEEP_STUDY, folder)
    return folder


def test_a_run_simulated_anew_is_that_of_its_config(swept_folder):
    result = study_source(swept_folder).answers["simulated"]({"values": {NOISE: 1e-4, ALPHA: 50.0, LAMBDA: 1.0}, "seed": 0})
    trial = run(tomllib.loads(result["config"]))
    assert trial.config.encoders.noise == 1e-4 and trial.config.observer.motor.alpha == pytest.approx(50.0)
    assert set(result["metrics"]) == set(trial.summary["metrics"])
    for name, value in trial.summary["metrics"].items():
        assert result["metrics"][name] == (value if value is None else pytest.approx(value, rel=1e-9)), name
    velocity = np.frombuffer(base64.b64decode(result["columns"]["motor.velocity"]), "<f4")
    np.testing.assert_allclose(velocity, trial.trace["motor.velocity"], rtol=1e-5, atol=1e-7)
    # its phase plane shows the error, though the majorant goes far beyond it
    plane = result["planes"]["motor"]
    error, slope = (np.frombuffer(base64.b64decode(plane[name]), "<f4") for name in ("error", "slope"))
    assert plane["reach"] == pytest.approx([1.32 * np.abs(signal).max() for signal in (error, slope)], rel=1e-5)
    # the sweep stored the same
    frame = open_study(swept_folder).frame
    row = frame[(frame[NOISE] == 1e-4) & (frame[ALPHA] > 49.0) & (frame[LAMBDA] < 2.0)]
    assert row["motor.velocity_rmse"].item() == pytest.approx(result["metrics"]["motor.velocity_rmse"], rel=1e-6)


VALUES = {NOISE: 1e-4, ALPHA: 50.0, LAMBDA: 1.0}


@pytest.mark.parametrize(
    ("question", "message"),
    [
        (7, f"values: should have a value of each axis: {NOISE}, {ALPHA}, {LAMBDA}"),
        ({"seed": 0}, "values: should have a value of each axis"),
        ({"values": VALUES | {"run.duration": 1e9}, "seed": 0}, "values: should have a value of each axis"),
        ({"values": VALUES | {NOISE: -1.0}, "seed": 0}, "encoders.noise"),
        ({"values": VALUES | {ALPHA: "<b>"}, "seed": 0}, "observer.motor.alpha"),
        ({"values": VALUES, "seed": -1}, r"seed: should be a whole number from 0 and below 2\^31"),
        ({"values": VALUES}, "seed: should be a whole number"),
        *(({"values": VALUES, "seed": seed}, "seed: should be a whole number") for seed in (True, False, 1.0, "1", [1])),
    ],
)
def test_points_that_the_study_may_not_have_are_refused(swept_folder, question, message):
    with pytest.raises(InputError, match=message):
        study_source(swept_folder).answers["simulated"](question)


def test_numbers_that_differ_in_the_last_digit_of_their_precision_give_nearly_the_same():
    config, asked = (
        read_config(SWEEP_STUDY | {"run": SWEEP_STUDY["run"] | {"precision": "float32"}}),
        {"values": VALUES, "seed": 0},
    )
    name = "motor.velocity_rmse"
    metrics, near = (
        simulate_point(config, asked)["metrics"][name],
        [metric[name] for metric in simulate_nearby(config, asked)["metrics"]],
    )
    assert near == pytest.approx([metrics] * 6, rel=1e-3) and len({metrics, *near}) > 3


CLICKS = """async () => {
  const seeds = [], fetched = fetch, runs = new Runs({ named: [] });
  globalThis.fetch = async (what, { body }) => {
    seeds.push(JSON.parse(body).seed);
    await new Promise((resolve) => setTimeout(resolve, 50));
    return { ok: false, json: async () => ({ error: "no" }) };
  };
  const first = runs.simulate({}, 1);
  while (!seeds.length) await new Promise((resolve) => setTimeout(resolve));
  await Promise.all([first, runs.simulate({}, 2), runs.simulate({}, 3)]);
  globalThis.fetch = fetched;
  return seeds;
}"""
"""Two clicks while the run of another is simulated, and the seeds that the server is asked for."""


@needs_chromium
def test_a_click_simulates_the_run_which_can_be_pinned_and_run_again(swept_folder, tmp_path):
    with ExplorerServer(study_source(swept_folder)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with open_pages(server.url) as (page,):
            page.wait_for_selector("body[data-drawn^='motor.velocity_rmse ']")
            # beside the map, and both in the window
            page.set_viewport_size({"width": 1440, "height": 900})
            page.mouse.click(*find_place(page, 0.9, 0.1))
            page.wait_for_selector("body[data-simulated*='motor.alpha 50, motor.lambda 1, seed 0, ']")
            page.locator("#told:has-text('stored')").wait_for()
            text = page.locator("#told").inner_text()
            assert text.endswith("as stored in the sweep.")
            boxes = [page.locator(name).bounding_box() for name in ("#plot .plane", "#traces figure:nth-child(2) .plane")]
            assert boxes[0]["x"] + boxes[0]["width"] < boxes[1]["x"]
            assert all(box["y"] > 0 and box["y"] + box["height"] < 900 for box in boxes)
            save_download(page, "#point", tmp_path / "point.toml")
            trial = run(tmp_path / "point.toml")
            error = trial.summary["metrics"]["motor.velocity_rmse"]
            assert float(text.split(": ")[-1].split(",")[0]) == pytest.approx(error, rel=1e-3)
            signals = pd.read_csv(save_download(page, "#runcsv", tmp_path / "run.csv"))
            np.testing.assert_allclose(signals["motor.velocity"], trial.trace["motor.velocity"], rtol=1e-5, atol=1e-7)
            assert save_download(page, "#runpicture", tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")
            page.click("#pinned button")
            page.mouse.click(*find_place(page, 0.1, 0.9))
            page.wait_for_selector("body[data-simulated*='motor.alpha 5, motor.lambda 20, seed 0, ']")
            assert page.locator("#pinned li").count() == 2
            figures = page.locator("#traces figure")
            assert figures.count() == 5 and "error of the observer in the phase plane" in figures.last.inner_text()
            # the pinned run is thin, and drawn after the newest one
            widths = "page.runs.plots[0].lines.map(({ width }) => width)"
            assert page.evaluate(widths) == [2, 2, 1, 1]
            # drawn, and read by keyboard
            coloured = (
                "getImageData(85, 15, 200, 80).data.some((byte, i, all) => i % 4 === 0 && Math.abs(byte - all[i + 2]) > 60)"
            )
            drawn = f"[...document.querySelectorAll('#traces canvas')].map((canvas) => canvas.getContext('2d').{coloured})"
            assert all(page.evaluate(drawn))
            figures.first.locator(".plane").focus()
            page.keyboard.press("ArrowRight")
            assert figures.first.locator(".values").inner_text().split("\n")[1] == "time: 0 s"
            # figures over time are enlarged together
            drag(page, find_place(page, 0.2, 0.5, 0, "#traces"), find_place(page, 0.6, 0.52, 0, "#traces"))
            ranges = page.evaluate("page.runs.plots.map((one) => one.range && one.range[0])")
            assert (
                ranges[0] == pytest.approx([0.04, 0.12], abs=0.01)
                and ranges[1] == ranges[2] == ranges[0]
                and ranges[-1] is None
            )
            # as difference, of which the newest has none
            page.select_option("#against", "difference")
            apart = page.evaluate("page.runs.plots[0].lines.map(({ y }) => Math.max(...y.map(Math.abs)))")
            # the true velocity does not depend on the gains
            assert apart[0] > 1e-3 and apart[1] == 0.0
            check_figures(page, 0)
            # a link restores both runs
            page.reload()
            page.locator("#pinned li").nth(1).wait_for()
            page.wait_for_selector("body[data-simulated*='motor.alpha 5, motor.lambda 20, seed 0, ']")
            assert page.locator("#pinned button").all_inner_texts() == ["unpin", "pin"]
            # a run that the sweep has no figures of
            missing_metric = "{ metric: { name: 'm', label: 'error', yes: false, size: true }, value: NaN }"
            reply = page.evaluate(f"new Runs({{}}).compared({{ metrics: {{ m: -2 }} }}, {missing_metric})")
            assert reply == "error: 2. The sweep has none: its run diverged, or is not there yet."
            # of clicks while one is simulated the last one counts
            assert page.evaluate(CLICKS) == [1, 3]
            assert page.locator("#told").inner_text() == "Not simulated: no"
            # points that cannot be read are told, and read later
            page.route("**/points.parquet", lambda route: route.fulfill(status=206, body=b"nothing"))
            page.select_option("#metric", "motor.position_rmse")
            page.locator('#state:has-text("The study\'s points cannot be read")').wait_for()
            page.unroute("**/points.parquet")
            page.select_option("#metric", "motor.velocity_rmse")
            page.select_option("#metric", "motor.position_rmse")
            page.wait_for_selector("body[data-drawn^='motor.position_rmse ']")
        server.shutdown()


def test_a_study_at_work_is_written_anew_when_its_page_is_loaded_again(tmp_path):
    share(SWEEP_STUDY, tmp_path / "out", (1, 2))
    with ExplorerServer(study_source(tmp_path / "out")) as server:

        def read_version(version):
            file = server.file(version, "data.js")
            assert file is not None
            return read_data(file.parent)

        versions = server.newest(), server.newest()
        assert [read_version(version)["found"] for version in versions] == [8, 8] and read_version(versions[0])["served"]
        sweep(SWEEP_STUDY, tmp_path / "out")
        last = server.newest()
        assert read_version(last)["found"] == 12 and server.newest() == last


WORDS = {"path": "observer.discretisation", "values": ["implicit", "explicit"]}


def product_of_gains(frame):
    return frame[ALPHA] * frame[LAMBDA]


def test_points_of_a_design_keep_their_axes_words_among_them(tmp_path):
    axes = [{"path": ALPHA, "start": 2.0, "stop": 50.0, "scale": "log"}, {"path": LAMBDA, "start": 1.0, "stop": 20.0}, WORDS]
    data = rigid_study(axes=axes, sweep={"design": "sobol", "points": 8, "seeds": 2})
    columns = {"finite": lambda frame: frame["seed"] == 0, "motor__position_rmse": lambda frame: 1e300}
    result = make_result(data, motor__velocity_rmse=product_of_gains, **columns)
    write_study(result, tmp_path, ["found"])
    description, table = read_data(tmp_path), pq.read_table(tmp_path / "points.parquet").to_pandas()
    assert (description["rows"], description["found"], description["total"], description["sampled"]) == (32, 32, 32, True)
    assert [(axis["path"], axis["words"], axis["log"]) for axis in description["axes"]] == [
        (ALPHA, None, True), (LAMBDA, None, False), (WORDS["path"], WORDS["values"], False)
    ]  # fmt: skip
    np.testing.assert_array_equal(table[ALPHA], result.frame[ALPHA])
    words = [WORDS["values"][int(axis)] for axis in table[WORDS["path"]]]
    assert words == [*result.frame[WORDS["path"]]] and set(words) == set(WORDS["values"])
    assert table["motor.velocity_rmse"].isna().equals(table["seed"] == 1.0)
    assert table["motor.position_rmse"].isna().all()


@needs_chromium
def test_a_study_of_one_axis_is_drawn_over_it_and_its_points_kept(tmp_path):
    result = make_result(
        rigid_study(axes=[spaced_axis(ALPHA, 2.0, 50.0, 6)]), motor__velocity_rmse=lambda frame: 2.0 * frame[ALPHA]
    )
    page_file = write_static(make_source(result), tmp_path / "out")
    with open_pages(page_file) as (page,):
        page.wait_for_selector(f"body[data-drawn='motor.velocity_rmse {ALPHA} motor.velocity_rmse']")
        page.select_option("#log", "linear")
        page.wait_for_function("!page.shown.chart.x.log")
        page.locator("#plot .plane").focus()
        for key in ("ArrowRight", "ArrowRight", "ArrowRight"):
            page.keyboard.press(key)
        alpha = np.geomspace(2.0, 50.0, 6)[2]
        lines = page.locator("#plot .values").inner_text().replace(f" [{ALPHA}]", "").split("\n")
        numbers = [float(line.split(": ")[-1].split()[0]) for line in lines]
        assert numbers == pytest.approx([2.0 * alpha, alpha, 2.0 * alpha], rel=1e-3)
        page.keyboard.press("Enter")
        page.locator("#chosen").wait_for()
        page.locator("#where:not(:empty)").wait_for()
        save_download(page, "#point", tmp_path / "out" / "point.toml")
        check_figures(page, 0)
    assert read_config(tmp_path / "out" / "point.toml").observer.motor.alpha == pytest.approx(alpha, rel=1e-12)
