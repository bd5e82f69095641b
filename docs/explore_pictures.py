"""The pictures of docs/explore.md: `python docs/explore_pictures.py SWEEP DIAGNOSIS`, folders of `jaxbl sweep` on
sweeps/gain_map.toml and of `jaxbl diagnose` as in docs/log_tutorial.md. Needs Chromium."""

import shutil
import sys
import threading
from collections.abc import Callable
from pathlib import Path

from playwright.sync_api import Browser, Page, sync_playwright

from jaxbl.report.explorer.folder import Source
from jaxbl.report.explorer.server import ExplorerServer
from jaxbl.report.explorer.sources import open_source

FIGURES = Path(__file__).parent / "figures"


def opened(browser: Browser, url: str) -> Page:
    """A page whose figures are drawn."""
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    page.goto(url)
    page.locator("body[data-drawn*=motor]").wait_for()
    return page


def sweep(page: Page) -> None:
    """A map with a gain condition, and the run of a cell."""
    page.locator("#told:has-text('stored')").wait_for()
    page.mouse.move(2, 2)
    page.screenshot(path=FIGURES / "explore_sweep.png")


def log(page: Page) -> None:
    """Missing torque, before and after."""
    page.locator("#moment").fill("400")
    box = page.locator("#drawn").bounding_box()
    assert box is not None
    clip = {"x": 0.0, "y": 0.0, "width": 1440.0, "height": box["y"] + box["height"]}
    page.screenshot(path=FIGURES / "explore_log.png", full_page=True, clip=clip)  # type: ignore[arg-type]


def draw(source: Source, picture: Callable[[Page], None]) -> None:
    """Serve a page, and have its picture taken."""
    with ExplorerServer(source) as server, sync_playwright() as playwright:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        picture(opened(browser, server.url))
        browser.close()
        server.shutdown()


if __name__ == "__main__":
    draw(open_source(sys.argv[1]), sweep)
    draw(open_source(sys.argv[2]), log)
