"""The HTML page: well-formed, complete, and nothing of the user's text taken for markup."""

import dataclasses
import json
import os
from html import unescape
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
from browser import check_figures, needs_chromium, open_pages
from small_study import ALPHA, LAMBDA, listed_axis, make_result, rigid_study, small_study, spaced_axis

from jaxbl.files import write_atomic
from jaxbl.lines import NextStep
from jaxbl.report.drawing import Picture
from jaxbl.report.gain_plane import RESERVE_WORDS
from jaxbl.report.page import format_page
from jaxbl.report.panels import pack_numbers
from jaxbl.report.results import describe, write_report
from jaxbl.result import KeyFigure, Result, ResultTable
from jaxbl.sweeps.trial import run

VOID = {"meta", "img", "wbr"}


class Page(HTMLParser):
    """Checks that tags nest, and collects text, tags and pictures."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.text, self.images = [], [], "", []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag == "img":
            self.images.append(dict(attrs))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


HOSTILE = "<script>alert('a')</script> & \"b\" <b>"


def test_everything_is_escaped_and_in_its_place():
    picture = Picture(b"<svg>", (96, 48), HOSTILE, HOSTILE, [{"title": HOSTILE}])
    table = ResultTable(HOSTILE, [HOSTILE, "n"], [[HOSTILE, 1.23456789], [None, True], ["x", float("nan")], ["y", 3]])
    result = Result(
        HOSTILE, "good", HOSTILE, [KeyFigure(HOSTILE, HOSTILE)], [HOSTILE], [HOSTILE], [table], [NextStep(HOSTILE, HOSTILE)]
    )
    text = format_page(result, [(HOSTILE, picture)], f'title = "{HOSTILE}"')
    page = Page(text)
    # values of the figure, and the page's own
    assert page.tags.count("script") == 2
    # of the key figure alone
    assert page.tags.count("b") == 1
    image = {"src": "data:image/svg+xml;base64,PHN2Zz4=", "alt": HOSTILE, "width": "96", "height": "48"}
    assert page.images == [image]
    # title twice, answer, key figure and its meaning, remark, detail, step and its question, caption, table's heading, head
    # and cell, config
    assert page.text.count(HOSTILE) == 14
    values = text.partition('<script type="application/json">')[2].partition("</script>")[0]
    assert json.loads(values) == [{"title": HOSTILE}]
    for cell in ("1.235", "–", "yes", "nan", ">3<"):
        assert cell in text


@pytest.mark.parametrize(
    ("words", "ending"),
    [
        (["/bin/jaxbl", "plot", "a b"], ", with: jaxbl plot 'a b'<"),
        (["/lib/jaxbl/__main__.py", "plot", "c"], ", with: jaxbl plot c<"),
        (["/lib/pytest/__main__.py", "tests"], None),
        (["notebook.py"], None),
        ([""], None),
    ],
)
def test_a_page_names_the_command_that_made_it(words, ending, monkeypatch):
    monkeypatch.setattr("sys.argv", words)
    text = unescape(format_page(Result("title", "good", "answer"), [], ""))
    assert "Made by jaxbl" in text and (ending in text if ending else ", with: " not in text)


def test_page_of_a_sweep(tmp_path):
    axes = [
        spaced_axis(ALPHA, 1.0, 50.0, 5),
        spaced_axis(LAMBDA, 1.0, 20.0, 4),
        listed_axis("observer.discretisation", "implicit", "explicit"),
    ]
    data = rigid_study({"title": "a <b> c", "notes": ["first remark"]}, axes=axes)
    result = make_result(
        data,
        motor__velocity_rmse=lambda frame: frame[ALPHA],
        motor__converged=lambda frame: frame[ALPHA] > 2.0,
        motor__margin_alpha=lambda frame: frame[ALPHA],
        motor__margin_exact=lambda frame: 2.0,
    )
    found = write_report(result, tmp_path)
    assert (found.verdict, found.headline) == (
        "good",
        "40 runs: the motor observer converges in 80.0 %, with the best gains in every run.",
    )
    assert found.key_figures == [
        ("2.66 rad/s", "motor: worst velocity error, rms, of the best gains (alpha = 2.66, lambda = 2.71)"),
        (
            "× 2.66",
            f"motor: {RESERVE_WORDS}; 4 of 20 gains are as good within 5 %",
        ),
    ]
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert len(page.images) == len(list((tmp_path / "figures").iterdir())) == 1
    for text in (
        found.headline,
        *found.remarks,
        "a <b> c",
        "first remark",
        "observer.discretisation",
    ):
        assert text in page.text


def test_a_sweep_says_up_to_where_an_observer_converges():
    axes = [listed_axis("encoders.noise", 1e-6, 1e-5, 1e-4), listed_axis("drive.motor_viscous", 0.1, 0.2)]
    edge = {"motor__converged": lambda frame: frame["encoders.noise"] < 5e-5}
    found = describe(make_result(rigid_study(axes=axes), **edge))
    assert found.verdict == "doubtful"
    assert found.headline.endswith("converges in 66.7 % (100 % up to encoder noise 10 µrad, 0 % beyond).")
    scattered = {"motor__converged": lambda frame: frame["encoders.noise"] != 1e-5}
    assert "up to" not in describe(make_result(rigid_study(axes=axes), **scattered)).headline


def test_page_of_a_run_and_its_files(tmp_path):
    trial = run(small_study({"title": HOSTILE, "notes": [HOSTILE], "identifier.start": 10.0}))
    lines = write_report(trial, tmp_path).sentences
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        *("figures", "manifest.json", "report.html", "summary.json", "trace.parquet")
    ]
    assert json.loads((tmp_path / "summary.json").read_text(encoding="utf-8")) == trial.summary
    pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "trace.parquet"), trial.trace)
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert len(page.images) == 7
    assert (tmp_path / "report.html").stat().st_size < 5e6
    assert HOSTILE in lines and HOSTILE in page.text
    for text in (lines[0], *lines[-2:], "half_gap", "rms velocity error"):
        assert text in page.text


@needs_chromium
@pytest.mark.usefixtures("every_figure_drawn")
def test_figures_say_their_values_and_zoom_and_tables_sort(tmp_path):
    axes = [spaced_axis(ALPHA, 1.0, 50.0, 5), spaced_axis(LAMBDA, 1.0, 20.0, 4)]
    result = make_result(rigid_study(axes=axes), motor__velocity_rmse=lambda frame: frame[ALPHA] * frame[LAMBDA])
    long = NextStep(f"jaxbl explore {'a_long_folder/' * 30} --static page", "How do other metrics look?")
    rows = [
        ["motor.velocity_rmse", "rad/s", 3.5],
        ["load.torque_rmse", "N m", None],
        ["chatter", "rad/s", 20.0],
        ["a", "", 0.1],
    ]
    table = ResultTable("Medians", ["metric", "unit", "median"], rows)
    write_report(result, tmp_path, dataclasses.replace(describe(result), next_steps=[long], tables=[table]))
    with open_pages(tmp_path / "report.html", color_scheme="dark") as (page,):
        check_figures(page, 1)
        view, values = page.locator(".view"), page.locator(".values")
        panel = json.loads(page.locator("figure script").text_content())[0]
        left, top, width, height = panel["place"]
        # of the map's first column, the middle row
        view.hover(position=place(view, left + 0.05 * width, top + 0.5 * height))
        texts = dict(line.rsplit(": ", 1) for line in values.inner_text().split("\n"))
        alpha = 50.0**0.5
        assert [float(text.split()[0]) for text in texts.values()] == pytest.approx([alpha, 1.0, alpha], rel=1e-3)
        assert list(texts) == [
            "motor: velocity error, rms (rad/s)",
            "λ, correction gain (√rad/s)",
            "α, switching gain (rad/s²)",
        ]
        # the same place, zoomed: the pointer stays on its cell
        view.dblclick(position=place(view, left + 0.05 * width, top + 0.5 * height))
        assert "width: 300%" in page.locator("figure img").get_attribute("style")
        view.hover(position=place(view, left + 0.05 * width, top + 0.5 * height))
        assert dict(line.rsplit(": ", 1) for line in values.inner_text().split("\n")) == texts
        page.get_by_label("whole figure").click()
        assert not page.locator("figure img").get_attribute("style")
        # by keyboard, and said to a screen reader
        view.focus()
        for key in ("ArrowLeft", "ArrowUp"):
            page.keyboard.press(key)
        assert page.locator(".spoken").text_content() == values.text_content() != ""
        # words after numbers, and backwards
        table = page.locator("table").last
        first = table.locator("tbody tr td:first-child")
        before = first.all_inner_texts()
        table.get_by_role("button", name="metric").click()
        assert first.all_inner_texts() == sorted(before)
        table.get_by_role("button", name="median").click()
        table.get_by_role("button", name="median").click()
        numbers = [float(text.replace("–", "-inf")) for text in table.locator("td:nth-child(3)").all_inner_texts()]
        finite = [number for number in numbers if number > -float("inf")]
        assert finite == sorted(finite, reverse=True) == numbers[: len(finite)]


def signal_panel(top, label, slope):
    """A panel over ten seconds, with a band and a span."""
    time = np.linspace(0.0, 10.0, 101)
    values = np.where((time > 4.0) & (time < 4.5), np.nan, slope * time)
    line = {
        "name": "seen",
        "colour": "#000000",
        "x": pack_numbers(time),
        "y": pack_numbers(values),
        "width": 1.5,
        "dashes": "--",
        "marker": "",
        "opacity": 1.0,
    }
    axis = {"log": False, "key": "", "names": []}
    return {
        "place": [0.1, top, 0.8, 0.35],
        "title": "",
        "lines": [line],
        "x": axis | {"label": "time (s)", "ends": [0.0, 10.0]},
        "y": axis | {"label": label, "ends": [0.0, 30.0], "key": "a.b"},
        "bands": [
            {
                "name": "95 %",
                "colour": "#0072B2",
                "opacity": 0.2,
                "x": pack_numbers(time),
                "low": pack_numbers(values - 1.0),
                "high": pack_numbers(values + 1.0),
            }
        ],
        "spans": [
            {"name": "held out", "colour": "#8a8d93", "opacity": 0.3, "along": "x", "low": 6.0, "high": 8.0, "dashes": "-"}
        ],
    }


@needs_chromium
def test_signals_are_drawn_by_uplot_and_enlarged_together(tmp_path):
    svg = b'<svg xmlns="http://www.w3.org/2000/svg" width="500" height="400"/>'
    picture = Picture(
        svg,
        (500, 400),
        "two signals over time",
        "two signals over time, in words",
        [signal_panel(0.1, "position (rad)", 1.0), signal_panel(0.55, "speed (rad/s)", 2.0)],
    )
    other = picture._replace(panels=[signal_panel(0.1, "torque (N m)", 3.0)])
    text = format_page(Result("title", "good", "answer"), [("two", picture), ("other", other)], "")
    (tmp_path / "page.html").write_text(text, encoding="utf-8")
    with open_pages(tmp_path / "page.html", color_scheme="dark") as (page,):
        assert page.locator("figure .uplot").count() == 3 and not page.locator("figure img").first.is_visible()
        over = page.locator(".u-over").first
        box = over.bounding_box()
        page.mouse.move(box["x"] + 0.2 * box["width"], box["y"] + 0.9 * box["height"])
        lines = page.locator(".plane .values").first.inner_text().split("\n")
        assert lines == ["seen", "time (s): 2", "position (rad): 2 [a.b]"]
        # a drag over one enlarges all over the same quantity
        page.mouse.down()
        page.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 0.92 * box["height"], steps=3)
        page.mouse.up()
        shown = "charts.map((chart) => chart.shown[0].map(Math.round))"
        assert page.evaluate(shown) == [[2, 6]] * 3
        page.get_by_label("whole figure").first.click()
        assert page.evaluate(shown) == [[0, 10]] * 3
        assert page.locator(".legend").first.inner_text().split("\n") == ["seen", "95 %", "held out"]
        check_figures(page, 2)


def place(view, x, y):
    """Shares of a figure as pixels."""
    box = view.bounding_box()
    return {"x": x * box["width"], "y": y * box["height"]}


@needs_chromium
@pytest.mark.parametrize(("height", "shown"), [(316, 1037.0), (800, 650.0)])
def test_a_flat_picture_has_the_width_of_the_page_and_is_seen_at_once(tmp_path, height, shown):
    drawn = f'<svg xmlns="http://www.w3.org/2000/svg" width="1037" height="{height}"/>'.encode()
    picture = Picture(drawn, (1037, height), "Maps.", "three maps, one beside the other", [])
    figures = [KeyFigure(f"{i} rad/s", "motor: worst velocity error, rms, of the best gains") for i in range(4)]
    command = "jaxbl tune results/gain_map/study.toml --out results/gain_map_gains"
    steps = [NextStep(command, "Which gains have the least error?")] * 3
    result = Result("a", "good", "The observer converges in 68.0 %. " * 3, figures, [], [], [], steps)
    (tmp_path / "page.html").write_text(format_page(result, [("maps", picture)], "a = 1"), encoding="utf-8")
    with open_pages(tmp_path / "page.html") as (page,):
        page.set_viewport_size({"width": 1280, "height": 800})
        if height < 800:
            check_figures(page, 1)
        view, answer, step = (page.locator(part).first.bounding_box() for part in (".view", ".answer", "dd"))
        assert view["width"] == pytest.approx(shown, abs=40.0)
        assert (view["y"] > answer["y"] + answer["height"]) == (step["y"] > view["y"] + view["height"]) == (height < 800)
        # as it is copied: one line, whose options are whole
        assert page.locator("dd pre").first.text_content() == command


@needs_chromium
def test_nothing_of_the_users_runs_in_a_page(tmp_path):
    names = [
        HOSTILE,
        "<img src=x onerror=alert(1)>",
        "</script><script>alert(2)</script>",
        "a\x1b]0;b\x07\x00\u202e",
        "x" * 5000,
    ]
    picture = Picture(b'<svg xmlns="http://www.w3.org/2000/svg" width="9" height="9"/>', (9, 9), names[1], names[2] * 2, [])
    tables = [ResultTable(names[1], names, [names, names]), ResultTable("none", ["a"], [])]
    result = Result(names[2], "doubtful", names[0], [KeyFigure(names[1], names[0])], names, names, tables)
    text = format_page(result, [(names[0], picture)] * 2, "\n".join(names))
    (tmp_path / "page.html").write_text(text, encoding="utf-8")
    with open_pages(tmp_path / "page.html") as (page,):
        check_figures(page, 2)
        page.locator(".view").first.hover()
        for name in names[:3]:
            assert page.get_by_text(name, exact=True).count() >= 3


ALL_DIVERGED = {
    "finite": lambda frame: False,
    "motor__converged": lambda frame: False,
    **{f"motor__{name}": lambda frame: np.nan for name in ("velocity_rmse", "position_rmse", "f_plus")},
}


@needs_chromium
@pytest.mark.usefixtures("every_figure_drawn")
def test_pages_of_studies_that_nobody_expects(tmp_path):
    """Markup and letters from right to left in texts, ten thousand values of an axis, nothing but runs that diverged."""
    title = f"{HOSTILE} $\\frac{{$ {{0}} %s \u202e"
    lambdas = spaced_axis(LAMBDA, 1.0, 20.0, 2)
    long_axis = spaced_axis(ALPHA, 1.0, 50.0, 10_000)
    figure = {"kind": "heatmap", "x": ALPHA, "y": LAMBDA, "value": "motor.velocity_rmse", "overlays": ["exact"]}
    few = {"axes": [spaced_axis(ALPHA, 1.0, 50.0, 5), lambdas], "figures": [figure]}
    rising = {"motor__velocity_rmse": lambda frame: frame[ALPHA]}
    studies = {
        "texts": (few | {"title": title, "notes": [title] * 2}, rising),
        "map": ({"axes": [lambdas, long_axis]}, rising),
        "gone": (few, ALL_DIVERGED),
    }
    for name, (data, columns) in studies.items():
        (tmp_path / name).mkdir()
        write_report(make_result(rigid_study(**data), **columns), tmp_path / name)
    with open_pages(*(tmp_path / name / "report.html" for name in studies), color_scheme="dark") as pages:
        for page in pages:
            check_figures(page, 1)
        page_by_study = dict(zip(studies, pages, strict=True))
        assert page_by_study["texts"].locator("h1").text_content() == title
        assert page_by_study["texts"].get_by_text(title, exact=True).count() == 3
        assert page_by_study["gone"].get_by_text("10 runs diverged").count() == 1


def test_names_that_are_no_utf8_can_be_written_and_read(tmp_path):
    name = os.fsdecode(b"a\xff.csv")
    write_atomic(tmp_path / "page.html", format_page(Result(name, "good", name), [], ""))
    assert "<h1>a\\udcff.csv</h1>" in (tmp_path / "page.html").read_text(encoding="utf-8")
    write_atomic(tmp_path / "file.json", json.dumps({"file": name}, ensure_ascii=False))
    assert json.loads((tmp_path / "file.json").read_text(encoding="utf-8")) == {"file": name}
