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
def open_pages(*paths, **options):
    """Open a page for each file or address in a new profile; assert that they log no error and ask for nothing elsewhere."""
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


def check_figures(page, figures):
    """Assert that a page shows this number of figures, each with a text, and that screen reader and keyboard can use it."""
    images = page.evaluate("[...document.images].map((image) => [image.complete && image.naturalWidth > 0, image.alt])")
    assert len(images) == figures
    assert all(loaded and len(text) > 20 for loaded, text in images)
    assert_accessible(page)
    size = page.viewport_size
    # a report; an explorer's tables may be wider than a telephone
    for width, height in ((1280, 800), (1024, 768), (390, 844)) if page.locator(".card").count() else ():
        page.set_viewport_size({"width": width, "height": height})
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), (page.url, width)
        if width == 1280:
            # the answer and its picture are seen at once
            for part in (".card .answer", ".card .view")[: 1 + bool(figures)]:
                box = page.locator(part).first.bounding_box()
                assert box["y"] + box["height"] <= height, (page.url, part, box)
    page.set_viewport_size(size)


_checked_styles: set[str] = set()
"""Colours, backgrounds and sizes of texts whose contrast has been measured: it is that of all other texts with them."""

_MARK_NEW_STYLES = """(checked) => {
    const seen = new Set(checked), backgrounds = new Map(), added = [];
    for (const element of document.querySelectorAll("*")) {
        const style = getComputedStyle(element), box = element.getBoundingClientRect();
        const layer = [style.backgroundColor, style.backgroundImage, style.opacity].join();
        const behind = backgrounds.get(element.parentElement) ?? "";
        backgrounds.set(element, layer === "rgba(0, 0, 0, 0),none,1" ? behind : `${behind}; ${layer}`);
        const key = [backgrounds.get(element), style.color, style.fontSize, style.fontWeight].join();
        const text = [...element.childNodes].some((node) => node.nodeType === Node.TEXT_NODE && node.data.trim());
        const visible = box.width * box.height > 0 && box.right > 0 && element.checkVisibility({visibilityProperty: true});
        const isNew = (text || element.matches("input, select, textarea")) && visible && !seen.has(key);
        element.toggleAttribute("data-new-style", isNew);
        if (isNew) added.push(key), seen.add(key);
    }
    return added;
}"""


def _find_violations(page, context, **options):
    """Return what is serious for people with disabilities: the rule and the first element."""
    if not page.evaluate("'axe' in window"):
        page.evaluate(Axe().axe_script)
    # axe would ask for style sheets, which a page from disk may not
    options |= {"preload": False, "resultTypes": ["violations"]}
    violations = page.evaluate(
        "([context, options]) => axe.run(context, options).then((results) => results.violations)", [context, options]
    )
    return [
        (violation["id"], violation["nodes"][0]["html"])
        for violation in violations
        if violation["impact"] in ("serious", "critical")
    ]


def assert_readable(page):
    """Assert that text stands out from what is behind it, and that nothing is wider than the window."""
    styles = page.evaluate(_MARK_NEW_STYLES, list(_checked_styles))
    if styles:
        assert _find_violations(page, "[data-new-style]", runOnly=["color-contrast"]) == [], page.url
        _checked_styles.update(styles)
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), page.url


def assert_accessible(page):
    """Assert that a page is readable, and that nothing serious is in the way of a screen reader or keyboard."""
    assert _find_violations(page, "html", rules={"color-contrast": {"enabled": False}}) == [], page.url
    assert_readable(page)
