"""Figures, table and page of an inspected log."""

import json

import numpy as np
import pytest
from browser import check_figures, needs_chromium, open_pages
from measured import GEAR_RATIO, SERVO, find_recording, simulate_log
from panel_parts import names_of
from test_page import Page

from jaxbl.records import inspect
from jaxbl.report.drawing import save
from jaxbl.report.inspect import draw as draw_inspection
from jaxbl.report.results import describe, write_report
from jaxbl.result import format_result

UNEVEN_TIMES = np.cumsum(1e-3 * np.random.default_rng(1).uniform(0.7, 1.4, 3000))
BOTH_ENCODERS = ["channels", "twist"]
CASES = {
    "both encoders": (simulate_log(count=6000, gap=0.1, noise=1e-3), {}, BOTH_ENCODERS),
    "uneven, with a gap": (simulate_log(UNEVEN_TIMES).drop(index=range(1000, 1400)), {}, BOTH_ENCODERS),
    "motor alone": (simulate_log().drop(columns="theta_s"), {}, BOTH_ENCODERS[:1]),
    "load alone, linear": (simulate_log().drop(columns="theta_e"), {"theta_s": {"unit": "m"}}, BOTH_ENCODERS[:1]),
    "free": (simulate_log().assign(u=0.0), {}, BOTH_ENCODERS),
    "no torque": (simulate_log(), {"absent": ["u"]}, BOTH_ENCODERS),
    "sensor": (simulate_log(), {"transmitted": "u"}, BOTH_ENCODERS),
    "noise": (simulate_log().assign(theta_e=np.random.default_rng(0).standard_normal(4000)), {}, BOTH_ENCODERS),
}


@pytest.mark.parametrize("case", CASES)
def test_all_figures_are_drawn_with_units(tmp_path, case):
    frame, log, names = CASES[case]
    frame.to_parquet(tmp_path / "log.parquet")
    drawings = [*draw_inspection(inspect(tmp_path / "log.parquet", log))]
    assert [d.name for d in drawings] == names
    for d in drawings:
        assert d.caption.endswith(".")
        assert save(d, tmp_path / f"{d.name}.png").stat().st_size > 5000
        assert "(" in d.panels[-1].x.label
        assert "(" in d.panels[0].y.label
    units = [panel.y.label.split("\n")[-1] for panel in drawings[0].panels]
    if case == "load alone, linear":
        assert units == ["(N)", "(m)", "(m/s)"]
    if case == "both encoders":
        assert units == ["(N m)", "(rad)", "(rad)", "(rad/s)"]


def test_a_gap_is_not_drawn_over(tmp_path):
    simulate_log().drop(index=range(1000, 1400)).to_parquet(tmp_path / "log.parquet")
    channels, *_ = draw_inspection(inspect(tmp_path / "log.parquet"))
    # one break between the parts, and the one at the end
    assert [int(np.isnan(panel.parts[0].y).sum()) for panel in channels.panels] == [2, 2, 2, 2]


def test_the_card_fits_a_terminal_whatever_is_wrong(tmp_path):
    frame = simulate_log(UNEVEN_TIMES, noise=1e-3).drop(index=range(1000, 1400))
    limit = 0.5 * frame["u"].max()
    frame["u"] = frame["u"].clip(-limit, limit)
    frame.loc[500, "theta_e"] += 3.0
    frame.loc[700, "theta_s"] += 3.0
    frame["t"] *= 1000.0
    frame = frame.assign(sensor=frame["u"])
    frame.loc[200:202, "t"] = frame.loc[200, "t"]
    frame.to_parquet(tmp_path / "log.parquet")
    inspection = inspect(tmp_path / "log.parquet", {"theta_s": {"skew": 1.0}, "transmitted": "sensor", "stop": 2.9e3})
    result = describe(inspection)
    lines = format_result(result, ["report.html"])
    assert len(lines) <= 8 and all(len(line) <= 100 for line in lines)
    assert result.verdict == "doubtful" and len(result.details) > 3
    channels = result.tables[1]
    assert channels.columns[4:] == [
        "resolution", "noise", "bandwidth (Hz)", "saturated (share)", "jumps", "skew (ms)", "standard error (ms)"
    ]  # fmt: skip
    assert [row[0] for row in channels.rows] == list(inspection.record.statistics.channels)


def test_the_report_holds_table_figures_and_how_the_log_was_read(tmp_path):
    (tmp_path / "out").mkdir()
    simulate_log(gap=0.1).rename(columns={"theta_e": "a<b"}).to_parquet(tmp_path / "log.parquet")
    inspection = inspect(tmp_path / "log.parquet", {"theta_e": "a<b"}, gear_ratio=GEAR_RATIO)
    assert write_report(inspection, tmp_path / "out").sentences == describe(inspection).sentences
    page = (tmp_path / "out" / "report.html").read_text()
    Page(page)
    assert page.count("<img") == 2
    for text in ("What the log can identify", "Coulomb friction", "a&lt;b", "resolution"):
        assert text in page
    data = json.loads((tmp_path / "out" / "inspection.json").read_text())
    assert data["identifiable"][0]["quantity"] == "inertia"


@needs_chromium
def test_the_page_in_a_browser(tmp_path):
    simulate_log(gap=0.1).to_parquet(tmp_path / "log.parquet")
    write_report(inspect(tmp_path / "log.parquet", gear_ratio=GEAR_RATIO), tmp_path)
    with open_pages(tmp_path / "report.html") as (page,):
        check_figures(page, 2)


def test_a_real_log_with_two_encoders(tmp_path):
    inspection = inspect(find_recording("servoproject_dual_encoder/outputEncoderData.txt"), SERVO, gear_ratio=1.0)
    *_, twist = draw_inspection(inspection)
    assert twist.name == "twist" and len(twist.panels) == 1
    assert names_of(*twist.panels) == ["load on its first side", "on the other"]
    figure = describe(inspection).key_figures[0]
    assert figure == ("126 s", "42000 samples every 3 ms, even stamps, 1 segment")
