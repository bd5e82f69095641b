"""The documentation's site: every page in a browser, and where its links lead."""

import os
import re
import subprocess
import sys
import tomllib
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag, urlsplit

import nbformat
import pytest
from browser import assert_accessible, assert_readable, needs_chromium, open_pages
from markdown_blocks import read_blocks, zero_numbers
from progress_lines import without_progress
from small_study import spaced_axis

import jaxbl

ROOT = Path(__file__).parents[1]
SITE = ROOT / "docs" / "_build" / "html"
pytestmark = pytest.mark.pages


@pytest.fixture(scope="module")
def pages():
    """Pages of the site, as `make site` builds them: only pages that have changed since the last build."""
    words = "-m sphinx --fail-on-warning --keep-going --quiet --builder html --conf-dir docs . docs/_build/html"
    assert words in (ROOT / "Makefile").read_text(encoding="utf-8")
    subprocess.run(
        [sys.executable, *words.split()], cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}, check=True, timeout=900
    )
    return sorted(SITE.rglob("*.html"))


class Links(HTMLParser):
    """Places that a page has, and where it leads."""

    def __init__(self, text):
        super().__init__()
        self.places, self.targets = {""}, set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        for key, value in attrs:
            if key in ("id", "name") and value:
                self.places.add(value)
            elif key in ("href", "src") and not urlsplit(value).scheme:
                self.targets.add(value)


def test_every_link_leads_somewhere(pages):
    links_of = {page: Links(page.read_text(encoding="utf-8")) for page in pages}
    assert sum(len(page.targets) for page in links_of.values()) > 1000
    for page, links in links_of.items():
        for target in links.targets:
            place, anchor = map(unquote, urldefrag(target.partition("?")[0]))
            file = (page.parent / place).resolve() if place else page
            assert file.is_file(), (page, target)
            assert not anchor or anchor in links_of[file].places, (page, target)


@pytest.mark.parametrize("name", ["tutorial", "log_tutorial"])
def test_tutorials_print_what_their_texts_say(pages, name):
    """The site ran the page: its `output` blocks are what was printed, but for the numbers."""
    page = (SITE / "docs" / f"{name}.html").read_text(encoding="utf-8")
    printed = set(zero_numbers(unescape(re.sub(r"<[^>]*>", "", page))))
    blocks = read_blocks(ROOT / "docs" / f"{name}.md")
    expected = [line for block in blocks if block.language == "output" for line in zero_numbers(block.text)]
    assert [line for line in expected if line not in printed] == []
    notebook = nbformat.read(SITE.parent / "jupyter_execute" / "docs" / f"{name}.ipynb", as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    run = [block for block in blocks if block.language in ("python", "toml") or block.text.startswith("jaxbl ")]
    assert len(cells) == len(run)
    errors = [output.text for cell in cells for output in cell.outputs if output.get("name") == "stderr"]
    assert without_progress("".join(errors)) == ""
    assert "<figure>" in page


def test_what_the_log_tutorial_announces_is_what_its_machine_does(pages):
    """The numbers that were found, and the error of the tuned gains, on the machine that made the log."""
    notebook = nbformat.read(SITE.parent / "jupyter_execute" / "docs" / "log_tutorial.ipynb", as_version=4)
    outputs = "".join(output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", ()))
    for name, truth in (("motor_inertia", 0.05), ("motor_viscous", 0.15), ("coulomb_friction.torque", 0.2)):
        value = float(re.search(rf"(\S+) .*, no interval  (?:drive|effects\.motor)\.{name}\n", outputs)[1])
        assert value == pytest.approx(truth, rel=0.02), name
    assert re.search(r" 0\.1 ± \S+ N m  motor\.cogging: amplitude\n", outputs)
    assert re.search(r"kind='motor\.cogging' .*harmonic=7\.0 ", outputs)
    announced, achieved = map(float, re.search(r"announced ([\d.]+) rad/s, achieved ([\d.]+) rad/s", outputs).groups())
    assert 1 / 1.3 <= announced / achieved <= 1.3
    # a search on the machine itself, under the same constraints
    blocks = read_blocks(ROOT / "docs" / "log_tutorial.md")
    machine = tomllib.loads(next(block.text for block in blocks if block.text.startswith("# machine.toml")))
    axes = [spaced_axis("observer.motor.lambda", 0.3, 100.0, 24), spaced_axis("observer.motor.alpha", 2.0, 500.0, 24)]
    frame = jaxbl.sweep(machine | {"axes": axes}).frame
    allowed = (frame["motor.margin_alpha"] >= 1.1) & (frame["motor.margin_exact"] >= 1.1)
    assert achieved <= 1.1 * frame["motor.velocity_rmse"][allowed].min()


@needs_chromium
def test_every_page_can_be_read_by_everyone(pages):
    """Each in both colour schemes and at both widths."""
    files = [file for file in pages if file != SITE / "index.html"]  # it only leads to the first
    with open_pages(files[0]) as (page,):
        for file in files:
            page.emulate_media(color_scheme="light")
            page.set_viewport_size({"width": 1100, "height": 900})
            page.goto(file.as_uri())
            images = page.evaluate("[...document.images].map((image) => [image.currentSrc, image.naturalWidth, image.alt])")
            assert [image for image in images if not all(image)] == [], page.url
            assert_accessible(page)
            page.emulate_media(color_scheme="dark")
            assert_readable(page)
            page.set_viewport_size({"width": 400, "height": 900})
            assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), page.url
