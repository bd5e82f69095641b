"""Pages in a real browser: Chromium without a screen, found on this machine; tests are skipped where it has none."""

import functools
import shutil
from contextlib import contextmanager

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import sync_playwright

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="pages are opened in Chromium, which is not here (Debian: apt-get install chromium)"
)


@contextmanager
def opened(*paths, **options):
    """A page of each file or address, without an error, or a request for anything elsewhere. One browser at a time."""
    wrong = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        context = browser.new_context(**{"viewport": {"width": 1100, "height": 900}} | options)
        context.on("console", lambda message: wrong.append(message.text) if message.type in ("error", "warning") else None)
        context.on("weberror", lambda error: wrong.append(str(error.error)))
        context.on("dialog", lambda dialog: wrong.append(dialog.message))
        pages = []
        for path in paths:
            page, where = context.new_page(), path if isinstance(path, str) else path.resolve().as_uri()
            page.on("request", functools.partial(_elsewhere, wrong, where if isinstance(path, str) else "file:"))
            page.goto(where)
            pages.append(page)
        yield pages
        assert wrong == [], wrong
        browser.close()


def _elsewhere(wrong, here, request):
    if not request.url.startswith((here, "data:", "blob:")):
        wrong.append(request.url)


def check(page, figures):
    """So many figures have loaded and have a text; nothing serious is in the way of a screen reader or keyboard."""
    images = page.evaluate("[...document.images].map((one) => [one.complete && one.naturalWidth > 0, one.alt])")
    assert len(images) == figures
    assert all(loaded and len(text) > 20 for loaded, text in images)
    accessible(page)


LIKE = "tr ~ tr ~ tr ~ tr, li ~ li ~ li ~ li, dl ~ dl ~ dl ~ dl, p ~ p ~ p ~ p"
"""Elements whose colours are those of the neighbours before them: measuring all takes most of the time of a long page."""


def accessible(page, colours_only=False):
    """Nothing serious is in the way of a screen reader or keyboard, and nothing is wider than the window."""

    def serious(context, **options):
        # axe would ask for style sheets, which a page from disk may not
        options |= {"preload": False, "resultTypes": ["violations"]}
        found = Axe().run(page, context=context, options=options).response["violations"]
        return [(one["id"], one["nodes"][0]["html"]) for one in found if one["impact"] in ("serious", "critical")]

    if not colours_only:
        assert serious(None, rules={"color-contrast": {"enabled": False}}) == [], page.url
    assert serious({"exclude": [[LIKE]]}, runOnly=["color-contrast"]) == [], page.url
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), page.url
