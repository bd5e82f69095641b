"""The documentation's site: every page in a browser, and where its links lead."""

import json
import os
import re
import subprocess
import sys
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag, urlsplit

import pytest
from browser import accessible, needs_chromium, opened

ROOT = Path(__file__).parents[1]
SITE = ROOT / "docs" / "_build" / "html"

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def pages():
    """Its pages, as `make docs` builds them: only those that have changed since it last did."""
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
    known = {page: Links(page.read_text(encoding="utf-8")) for page in pages}
    assert sum(len(page.targets) for page in known.values()) > 1000
    for page, links in known.items():
        for target in links.targets:
            place, anchor = map(unquote, urldefrag(target.partition("?")[0]))
            file = (page.parent / place).resolve() if place else page
            assert file.is_file(), (page, target)
            assert not anchor or anchor in known[file].places, (page, target)


NOTEBOOKS = {
    "gains": ("velocity error of the motor observer: ", "motor: lambda = "),
    "log": ("inertia about 0.05 kg m²", "the model lacks motor.cogging", "amplitude = 0.1 ±", "harmonic = 7"),
}
"""What their cells say when the site is built, which runs them."""


def test_notebooks_run_and_say_what_their_texts_claim(pages):
    files = {file.stem: file.read_text(encoding="utf-8") for file in (ROOT / "docs" / "notebooks").iterdir()}
    assert files.keys() == NOTEBOOKS.keys()
    for name, lines in NOTEBOOKS.items():
        cells = [cell for cell in json.loads(files[name])["cells"] if cell["cell_type"] == "code"]
        assert not any(cell["outputs"] or cell["execution_count"] for cell in cells), "outputs make large diffs: clear them"
        page = (SITE / "docs" / "notebooks" / f"{name}.html").read_text(encoding="utf-8")
        said = unescape(re.sub(r"<[^>]*>", "", page))
        assert [line for line in lines if line not in said] == []
        assert (page.count("<figure>"), "stderr" in page) == (3, False)


DARK = (
    "README.html",
    "api.html",
    "gallery.html",
    "log.html",
    "reference.html",
    "theory.html",
    "genindex.html",
    "search.html",
)
"""Pages with all that there is to colour."""


@needs_chromium
def test_every_page_can_be_read_by_everyone(pages):
    """Each in both colour schemes and at both widths."""
    shown = [page for page in pages if page != SITE / "index.html"]  # it only leads to the first
    with opened(*shown) as open_pages:
        for page in open_pages:
            images = page.evaluate("[...document.images].map((one) => [one.currentSrc, one.naturalWidth, one.alt])")
            assert [one for one in images if not all(one)] == [], page.url
            accessible(page)
            page.set_viewport_size({"width": 400, "height": 900})
            assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), page.url
            page.emulate_media(color_scheme="dark")
            # all pages have one style
            if page.url.endswith(DARK):
                accessible(page, colours_only=True)
