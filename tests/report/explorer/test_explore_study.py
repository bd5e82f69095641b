"""A study as maps in a browser: its data, and its page by mouse and keyboard, from disk and served."""

import base64
import json
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
from jaxbl.report.explorer.folder import Source, write_static
from jaxbl.report.explorer.server import served
from jaxbl.report.explorer.study import nearby, simulated, study_source, write_study
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


@needs_chromium
def test_values_regions_cuts_and_a_point_as_config(tmp_path):
    result = make_study_result(motor__converged=lambda frame: frame["seed"] > 0)
    page_file = write_static(make_source(result, [HOSTILE]), tmp_path / "out")
    with open_pages(page_file, color_scheme="dark") as (page,):
        page.wait_for_selector(f"body[data-drawn='motor.velocity_rmse {LAMBDA} {ALPHA}']")
        assert page.locator("#title").text_content() == page.locator("#lead").text_content() == HOSTILE
        plot, values = page.locator("#plot"), page.locator("#values")
        box = page.evaluate("[document.querySelector('#plot').clientWidth, document.querySelector('#plot').clientHeight]")

        def place(x, y):
            return {"x": 78 + x * (box[0] - 78 - 118), "y": 26 + (1 - y) * (box[1] - 26 - 52)}

        # a cell: the median over seeds, at the first noise
        plot.hover(position=place(0.5, 0.25))
        alphas, lambdas = np.geomspace(2.0, 50.0, 6), np.geomspace(1.0, 20.0, 5)
        assert read_pointer_values(values) == pytest.approx(
            [alphas[1] * lambdas[2] * 1.01 + 0.1, lambdas[2], alphas[1]], rel=1e-3
        )
        check_figures(page, 0)
        # of what is true or false, the share
        page.select_option("#metric", "motor.converged")
        page.wait_for_selector("body[data-drawn^='motor.converged ']")
        plot.hover(position=place(0.5, 0.26))
        assert read_pointer_values(values)[0] == pytest.approx(2.0 / 3.0, rel=1e-3)
        page.select_option("#metric", "motor.velocity_rmse")
        page.wait_for_selector("body[data-drawn^='motor.velocity_rmse ']")
        # other noise, the largest seed
        page.select_option("#at0", "1")
        page.select_option("#how", "largest")
        plot.hover(position=place(0.5, 0.26))
        assert float(values.inner_text().split("\n")[0].split(": ")[-1]) == pytest.approx(
            alphas[1] * lambdas[2] * 1.1 + 0.2, rel=1e-3
        )
        # axes change places, and conditions can be drawn over gains
        page.select_option("#x", "1")
        page.wait_for_selector(f"body[data-drawn='motor.velocity_rmse {ALPHA} {LAMBDA}']")
        page.select_option("#condition", "exact")
        page.wait_for_selector("#state:has-text('f⁺ = 1 rad/s²')")
        # a region by mouse, a cell by keyboard
        bounding_box = plot.bounding_box()
        start, end = place(0.05, 0.9), place(0.6, 0.3)
        page.mouse.move(bounding_box["x"] + start["x"], bounding_box["y"] + start["y"])
        page.mouse.down()
        page.mouse.move(bounding_box["x"] + end["x"], bounding_box["y"] + end["y"], steps=3)
        page.mouse.up()
        plot.hover(position=place(0.01, 0.01))
        assert read_pointer_values(values)[1:] == pytest.approx([alphas[0], lambdas[1]], rel=1e-3)
        plot.focus()
        for key in ("ArrowRight", "Enter"):
            page.keyboard.press(key)
        assert page.locator("#chosen").is_visible()
        where = page.locator("#where").inner_text()
        # what is saved stays the chosen cell, whatever is looked at then
        page.keyboard.press("ArrowLeft")
        page.select_option("#at0", "0")
        with page.expect_download() as download:
            page.click("#point")
        (tmp_path / "out" / "point.toml").write_bytes(Path(download.value.path()).read_bytes())
        with page.expect_download() as gains:
            page.click("#gains")
        (tmp_path / "gains.toml").write_bytes(Path(gains.value.path()).read_bytes())
        # side by side, a map of each noise
        page.select_option("#facet", "0")
        page.wait_for_selector(f"body[data-drawn='motor.velocity_rmse {ALPHA} {LAMBDA} {NOISE}']")
        page.click("#whole")
        plot.hover(position={"x": 78 + 5, "y": 60})
        assert values.inner_text().endswith(f"{NOISE} = 1e-5 rad")
        with page.expect_download() as picture:
            page.click("#picture")
        assert Path(picture.value.path()).read_bytes().startswith(b"\x89PNG")
    config = read_config(tmp_path / "out" / "point.toml")
    assert config.encoders.noise == 1e-4 and config.axes == []
    motor = config.observer.motor
    assert any(motor.alpha == pytest.approx(alpha) for alpha in alphas)
    assert f" at {NOISE}: 1e-4 rad, {ALPHA}: {motor.alpha:.4g} " in where
    assert f", {LAMBDA}: {motor.lambda_:.4g} " in where
    observer = tomllib.loads((tmp_path / "gains.toml").read_text())["observer"]
    assert observer == {"motor": {"lambda": config.observer.motor.lambda_, "alpha": config.observer.motor.alpha}}


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
        page.wait_for_selector(f"body[data-drawn='motor.velocity_rmse {LAMBDA} {ALPHA}']")
        # from the least to the largest, which no logarithm shows
        assert page.locator("#map").get_attribute("aria-label").endswith("from -8 to 40")
        assert page.locator("#at2 option").all_inner_texts() == ["all", "1, 1e-5 rad", "2, 1e-4 rad"]
        # a curve goes from small to large
        assert page.locator("#condition").count() == 0
        page.locator("#plot").click(position={"x": 100, "y": 100})
        with page.expect_download() as download:
            page.click("#point")
        (tmp_path / "out" / "point.toml").write_bytes(Path(download.value.path()).read_bytes())
        # enlarged until numbers end
        assert page.evaluate("ticks(1, 1 + Number.EPSILON, 5).length") <= 6
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
    metrics, near = simulated(config, asked)["metrics"][name], [metric[name] for metric in nearby(config, asked)["metrics"]]
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
    with served(study_source(swept_folder)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with open_pages(server.url) as (page,):
            page.wait_for_selector("body[data-drawn^='motor.velocity_rmse ']")
            plot = page.locator("#plot")
            plot.click(position={"x": 200, "y": 100})
            page.wait_for_selector("body[data-simulated*='motor.alpha 50, motor.lambda 1, seed 0, ']")
            page.locator("#told:has-text('stored')").wait_for()
            text = page.locator("#told").inner_text()
            assert text.endswith("as stored in the sweep.")
            with page.expect_download() as download:
                page.click("#point")
            (tmp_path / "point.toml").write_bytes(Path(download.value.path()).read_bytes())
            error = run(tmp_path / "point.toml").summary["metrics"]["motor.velocity_rmse"]
            assert float(text.split(": ")[-1].split(",")[0]) == pytest.approx(error, rel=1e-3)
            page.click("#pinned button")
            plot.click(position={"x": 700, "y": 500})
            page.wait_for_selector("body[data-simulated*='motor.alpha 5, motor.lambda 20, seed 0, ']")
            assert page.locator("#pinned li").count() == 2
            figures = page.locator("#traces figure")
            assert figures.count() == 5 and "error of the observer in the phase plane" in figures.last.inner_text()
            # drawn, and read by keyboard
            coloured = (
                "getImageData(85, 15, 300, 150).data.some((byte, i, all) => i % 4 === 0 && Math.abs(byte - all[i + 2]) > 60)"
            )
            drawn = f"[...document.querySelectorAll('#traces canvas')].map((canvas) => canvas.getContext('2d').{coloured})"
            assert all(page.evaluate(drawn))
            figures.first.locator(".plane").focus()
            page.keyboard.press("ArrowRight")
            assert figures.first.locator(".values").inner_text().split("\n")[1] == "time: 0 s"
            check_figures(page, 0)
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
    with served(study_source(tmp_path / "out")) as server:

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
        page.select_option("#log", "false")
        plane, values = page.locator("#plot .plane"), page.locator("#plot .values")
        plane.focus()
        for key in ("ArrowRight", "ArrowRight", "ArrowRight", "Enter"):
            page.keyboard.press(key)
        alpha = np.geomspace(2.0, 50.0, 6)[2]
        assert [float(line.split(": ")[-1].split()[0]) for line in values.inner_text().split("\n")] == pytest.approx(
            [2.0 * alpha, alpha, 2.0 * alpha], rel=1e-3
        )
        page.locator("#chosen").wait_for()
        with page.expect_download() as download:
            page.click("#point")
        (tmp_path / "out" / "point.toml").write_bytes(Path(download.value.path()).read_bytes())
        check_figures(page, 0)
    assert read_config(tmp_path / "out" / "point.toml").observer.motor.alpha == pytest.approx(alpha, rel=1e-12)
