"""Pages in a real browser: Chromium without a screen, found on this machine; tests are skipped where it has none."""

import asyncio
import atexit
import functools
import shutil
from contextlib import contextmanager

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import sync_playwright

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_chromium = pytest.mark.program(CHROMIUM or "chromium")


@functools.cache
def _browser():
    """Chromium, and the loop of Playwright, which runs for as long as the process does."""
    playwright = sync_playwright().start()
    browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
    loop = asyncio.get_running_loop()

    def close():
        asyncio._set_running_loop(loop)
        browser.close()
        playwright.stop()

    atexit.register(close)
    return browser, loop


@contextmanager
def opened(*paths, **options):
    """A page of each file or address in a profile of its own, without an error, or a request for anything elsewhere."""
    browser, loop = _browser()
    # outside, other code of this thread may run loops
    asyncio._set_running_loop(loop)
    errors = []
    context = browser.new_context(**{"viewport": {"width": 1100, "height": 900}} | options)
    try:
        context.on("console", lambda message: errors.append(message.text) if message.type in ("error", "warning") else None)
        context.on("weberror", lambda error: errors.append(str(error.error)))
        context.on("dialog", lambda dialog: errors.append(dialog.message))
        pages = []
        for path in paths:
            page, origin = context.new_page(), path if isinstance(path, str) else path.resolve().as_uri()
            page.on("request", functools.partial(_note_elsewhere, errors, origin if isinstance(path, str) else "file:"))
            page.goto(origin)
            pages.append(page)
        yield pages
        assert errors == [], errors
    finally:
        context.close()
        asyncio._set_running_loop(None)


def _note_elsewhere(errors, origin, request):
    if not request.url.startswith((origin, "data:", "blob:")):
        errors.append(request.url)


def check(page, figures):
    """So many figures have loaded and have a text; nothing serious is in the way of a screen reader or keyboard."""
    images = page.evaluate("[...document.images].map((image) => [image.complete && image.naturalWidth > 0, image.alt])")
    assert len(images) == figures
    assert all(loaded and len(text) > 20 for loaded, text in images)
    accessible(page)


REPEATED = "tr ~ tr ~ tr ~ tr, li ~ li ~ li ~ li, dl ~ dl ~ dl ~ dl, p ~ p ~ p ~ p"
"""Elements whose colours are those of the neighbours before them: measuring all takes most of the time of a long page."""


def accessible(page, colours_only=False):
    """Nothing serious is in the way of a screen reader or keyboard, and nothing is wider than the window."""

    def serious(context, **options):
        # axe would ask for style sheets, which a page from disk may not
        options |= {"preload": False, "resultTypes": ["violations"]}
        violations = Axe().run(page, context=context, options=options).response["violations"]
        return [
            (violation["id"], violation["nodes"][0]["html"])
            for violation in violations
            if violation["impact"] in ("serious", "critical")
        ]

    if not colours_only:
        assert serious(None, rules={"color-contrast": {"enabled": False}}) == [], page.url
    assert serious({"exclude": [[REPEATED]]}, runOnly=["color-contrast"]) == [], page.url
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), page.url
