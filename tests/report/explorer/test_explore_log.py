"""A log and what models make of it in a browser: its columns, and its page by mouse and keyboard."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from browser import check_figures, needs_chromium, open_pages

from jaxbl.errors import InputError
from jaxbl.files import log_subject, open_results
from jaxbl.report.explorer.folder import write_page, write_static
from jaxbl.report.explorer.log import write_log
from jaxbl.report.explorer.sources import open_source

HOSTILE = "motor.<img src=x onerror=alert(1)>"
TIME = np.arange(4000) * 1e-3 + 1e5
ANGLE = 5.0 * np.sin(2.0 * TIME)
RIPPLE = 0.1 * np.cos(3.0 * ANGLE)


def make_trace():
    columns = {
        "t": TIME,
        "u": np.cos(TIME),
        "theta_e": ANGLE,
        "theta_s": ANGLE / 5.0,
        "twist": 0.2 * ANGLE,
        "held_out": TIME[2999] < TIME,
    }
    columns |= {"motor.velocity": 10.0 * np.cos(2.0 * TIME), "motor.noise": 0.01 + 0.0 * TIME}
    columns |= {"motor.missing_before": RIPPLE, "motor.missing_after": 0.01 * np.sign(np.sin(500.0 * TIME))}
    columns |= {f"motor.missing_without.{HOSTILE}": RIPPLE + 0.02, "motor.missing_with.motor.stiction": 0.5 * RIPPLE}
    frame = pd.DataFrame(columns)
    frame.loc[:99, frame.columns.str.contains("missing")] = np.nan
    return frame


def make_summary(unit="rad"):
    units = {"theta_e": unit, "theta_s": "rad"}
    explained = {"speed": {"explained": 0.1}, "position": {"explained": 0.9}, "turn": {"explained": 0.2}}
    return {
        "title": "", "file": "axis.csv", "sample_period": 1e-3, "findings": [{"effect": HOSTILE}], "notes": [],
        "gap": {"units": units, "holdout": {"bandwidth": {"motor": 40.0}}}, "where": {"motor": {"coordinates": explained}},
    }  # fmt: skip


def test_columns_and_what_is_said_of_them(tmp_path):
    log = write_log(make_summary(), make_trace(), tmp_path)
    stored_table = pq.read_table(tmp_path / "points.parquet").to_pandas()
    assert stored_table["t"].dtype == np.float64 and stored_table["u"].dtype == np.float32
    np.testing.assert_array_equal(stored_table["t"], TIME)
    np.testing.assert_allclose(stored_table["twist"], 0.2 * ANGLE, atol=1e-6)
    assert (
        stored_table["motor.turn"].between(0.0, 2.0 * np.pi).all()
        and "load.turn" not in stored_table
        and "motor.noise" not in stored_table
    )
    units = {coordinate["column"]: coordinate["unit"] for coordinate in log["coordinates"]}
    assert units["motor.velocity"] == "rad/s" and units["u"] == "N m" and log["held"]
    # over what explains most
    assert log["over"] == ["theta_e", "motor.turn"]
    (group,) = log["groups"]
    assert (group["name"], group["unit"], group["bandwidth"]) == ("motor: missing torque", "N m", 40.0)
    assert {coordinate["column"]: coordinate["label"] for coordinate in group["lines"]} == {
        "motor.missing_before": "model as given",
        "motor.missing_after": "with the missing effects",
        f"motor.missing_without.{HOSTILE}": f"with the missing effects, without {HOSTILE}",
        "motor.missing_with.motor.stiction": f"with motor.stiction in place of {HOSTILE}",
    }


def test_a_linear_axis_has_forces_and_no_turns(tmp_path):
    log = write_log(make_summary("m"), make_trace(), tmp_path)
    units = {coordinate["column"]: coordinate["unit"] for coordinate in log["coordinates"]}
    assert units["theta_e"] == "m" and units["motor.velocity"] == "m/s" and units["u"] == "N"
    assert "motor.turn" not in units and log["groups"][0]["name"] == "motor: missing force"


def test_an_identification_and_an_element(tmp_path):
    motor = (f"motor.{name}" for name in ("velocity", "velocity_estimate", "residual", "torque_estimate"))
    frame = pd.DataFrame(dict.fromkeys(("t", "u", "theta_e", "torque", *motor), TIME))
    result = {"residual": {"motor": {"unit": "rad"}}, "sample_period": 1e-3}
    groups = write_log(result, frame, tmp_path)["groups"]
    assert [group["name"] for group in groups] == ["motor: position residual", "torque in the transmission", "motor: speed"]
    element = {"kind": "element", "sample_period": 1e-3}
    log = write_log(element, pd.DataFrame(dict.fromkeys(("t", "u", "displacement", "torque"), TIME)), tmp_path)
    assert log["over"] == ["u", "displacement"]
    assert [group["label"] for group in log["groups"][0]["lines"]] == ["measured", "by the fitted law"]
    with pytest.raises(InputError, match=r"explore: trace\.parquet has no column that the page could draw"):
        write_log(result, frame.loc[:, ["t", "u"]], tmp_path)


def write_identification(folder):
    """A folder as `jaxbl identify` leaves it."""
    result = {
        "title": HOSTILE, "identity": "1", "file": "axis.csv", "sample_period": 1e-3, "parameters": {}, "notes": [],
        "kind": "element", "warnings": [], "refused": [],
        "torque": {"element": {"rms": 1.0, "relative": 0.1, "unit": "N m"}},
        "method": {"element": {"terms": [], "gains": {}, "reversals": 4}},
    }  # fmt: skip
    trace = make_trace().rename(columns={"motor.missing_before": "motor.residual"})
    with open_results(folder, log_subject(Path("axis.csv"))) as results, results.write_files("identification.json") as draft:
        trace.to_parquet(draft / "trace.parquet", index=False)
        (draft / "model.toml").write_text("[drive]\ngear_ratio = 4.0\n")
        (draft / "identification.json").write_text(json.dumps(result))


def test_folders_without_results_and_damaged_ones(tmp_path):
    with pytest.raises(InputError, match="is missing, or holds no results; give a folder that 'jaxbl sweep', 'simulate'"):
        open_source(tmp_path)
    write_identification(tmp_path)
    (tmp_path / "trace.parquet").write_bytes(b"no table")
    source = open_source(tmp_path)
    with pytest.raises(InputError, match=r"trace\.parquet: is missing, damaged or edited; run the command that wrote it"):
        write_static(source, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@needs_chromium
def test_lines_coordinates_and_moments(tmp_path):
    output = {"title": HOSTILE, "lead": [HOSTILE], "config": HOSTILE, "file": "model.toml"}
    write_page(tmp_path, ("log",), write_log(make_summary(), make_trace(), tmp_path) | output)
    with open_pages(tmp_path / "index.html") as (page,):
        page.wait_for_selector("body[data-drawn*='motor.missing_before motor.missing_after']")
        assert page.locator("#title").text_content() == page.locator("#lead").text_content() == HOSTILE
        assert page.locator("#overhead").inner_text().startswith("Over motor position θe, and over")

        def read_sizes():
            rows = (row.split("\t") for row in page.locator("#sizes tbody tr").all_inner_texts())
            return {name: [float(number) for number in values] for name, *values in rows}

        # the moving average leaves what is slow, and takes the fast part away
        ripple = [np.sqrt(np.mean(part**2)) for part in (RIPPLE[100:3000], RIPPLE[3000:])]
        assert (
            read_sizes()["model as given"] == pytest.approx(ripple, rel=0.05)
            and max(read_sizes()["with the missing effects"]) < 2e-3
        )
        page.select_option("#cutoff", "none")
        page.locator("#sizes td:text-is('0.01')").first.wait_for()
        assert read_sizes()["model as given"] == pytest.approx(ripple, rel=1e-3)
        # with one effect less: another line, another map
        page.locator("#lines input").nth(2).check()
        page.wait_for_selector("#over2 figure:nth-child(3)")
        assert read_sizes()[f"with the missing effects, without {HOSTILE}"][0] == pytest.approx(
            np.sqrt(np.mean((RIPPLE[100:3000] + 0.02) ** 2)), rel=1e-3
        )
        # the mean in a cell of position and speed is the ripple at that position
        page.select_option("#y", "motor.velocity")
        page.wait_for_selector("body[data-drawn^='motor: missing torque theta_e motor.velocity ']")
        plane = page.locator("#over2 figure .plane").first
        box = plane.locator(".u-over").bounding_box()
        page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.01 * box["height"])
        mean, position, speed = [
            float(line.split(": ")[1].split()[0]) for line in plane.locator(".values").inner_text().split("\n")
        ]
        assert mean == pytest.approx(0.1 * np.cos(3.0 * position), abs=5e-3) and speed > 9.0
        # a moment, and a part
        page.locator("#moment").fill("500")
        assert page.locator("#now").inner_text().startswith("t 100002 s, input u ")
        plot_area = page.locator("#time .plane").bounding_box()
        page.mouse.move(plot_area["x"] + 200, plot_area["y"] + 100)
        page.mouse.down()
        page.mouse.move(plot_area["x"] + 400, plot_area["y"] + 102, steps=3)
        page.mouse.up()
        assert page.locator("#state").inner_text().startswith("From 10000")
        shown = page.locator("#sizes tbody").inner_text()
        page.click("#play")
        page.locator("#play:text-is('pause')").wait_for()
        check_figures(page, 0)
        # the link opens the same part, coordinates and lines
        page.reload()
        page.wait_for_selector("body[data-drawn^='motor: missing torque theta_e motor.velocity ']")
        assert page.locator("#sizes tbody").inner_text() == shown
        with page.expect_download() as download:
            page.click("#csv")
        table = pd.read_csv(download.value.path())
        assert (
            list(table)[:3] == ["t", "theta_e", "motor.velocity"]
            and TIME[0] < table["t"][0] < table["t"].iloc[-1] < TIME[-1]
        )
