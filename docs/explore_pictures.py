"""The pictures of docs/explore.md: `python docs/explore_pictures.py SWEEP DIAGNOSIS`, folders of `jaxbl sweep` on
sweeps/gain_map.toml and of `jaxbl diagnose` as in docs/log_tutorial.md. Needs Chromium."""

import shutil
import sys
import threading
from collections.abc import Callable
from pathlib import Path

from playwright.sync_api import Browser, Locator, Page, sync_playwright

from jaxbl.report.explorer.folder import Source
from jaxbl.report.explorer.log import log_source
from jaxbl.report.explorer.server import served
from jaxbl.report.explorer.study import study_source

FIGURES = Path(__file__).parent / "figures"


def opened(browser: Browser, url: str) -> Page:
    """A page whose figures are drawn."""
    page = browser.new_page(viewport={"width": 1000, "height": 700})
    page.goto(url)
    page.locator("body[data-drawn*=motor]").wait_for()
    return page


def sweep(page: Page) -> None:
    """A map with a gain condition, and the run of a cell."""
    page.select_option("#condition", "exact")
    page.select_option("#at0", "2")
    page.locator("body[data-drawn*=motor]").wait_for()
    page.locator("#plot").click(position={"x": 420, "y": 300})
    page.locator("#told:has-text('stored')").wait_for()
    page.mouse.move(2, 2)
    save(page, page.locator("#traces figure").nth(2), "explore_sweep.png")


def log(page: Page) -> None:
    """Missing torque, before and after."""
    page.locator("#moment").fill("400")
    save(page, page.locator("#over2"), "explore_log.png")


def save(page: Page, last: Locator, name: str) -> None:
    """A page down to an element."""
    box = last.bounding_box()
    assert box is not None
    height = box["y"] + page.evaluate("window.scrollY") + box["height"]
    page.screenshot(path=FIGURES / name, full_page=True, clip={"x": 0, "y": 0, "width": 1000, "height": height})


def draw(source: Source, picture: Callable[[Page], None]) -> None:
    """Serve a page, and have its picture taken."""
    with served(source) as server, sync_playwright() as playwright:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        picture(opened(browser, server.url))
        browser.close()
        server.shutdown()


if __name__ == "__main__":
    draw(study_source(sys.argv[1]), sweep)
    diagnosed = log_source(sys.argv[2])
    assert diagnosed is not None, f"{sys.argv[2]}: holds no results of a log"
    draw(diagnosed, log)
