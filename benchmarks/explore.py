"""The figures of docs/explore.md and docs/speed.md: how fast the explorer is, and how far rounding brings runs apart.

`python benchmarks/explore.py` sweeps sweeps/gain_map.toml, serves it, clicks cells, and writes a page of 10^7 made-up
points. Needs Chromium.
"""

import shutil
import sys
import threading
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from playwright.sync_api import Page, sync_playwright

from jaxbl import workers

workers.start_jax()
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from small_study import ALPHA, LAMBDA, NOISE, make_result, rigid_study, spaced_axis  # noqa: E402

from jaxbl.config import read_config, with_values  # noqa: E402
from jaxbl.report.explorer.folder import Source, write_static  # noqa: E402
from jaxbl.report.explorer.server import ExplorerServer  # noqa: E402
from jaxbl.report.explorer.study import study_source, write_study  # noqa: E402
from jaxbl.sweeps.sweep import open_study, sweep  # noqa: E402
from jaxbl.sweeps.trial import run, run_perturbed  # noqa: E402

MAP = Path(__file__).parents[1] / "sweeps" / "gain_map.toml"
ERROR = "motor.velocity_rmse"
HOVER = """() => {
  const plot = document.querySelector("#plot .plane"), box = plot.getBoundingClientRect();
  return Math.max(...Array.from({ length: 50 }, (_, k) => {
    const at = { clientX: box.left + 100 + 10 * k, clientY: box.top + 100 + 5 * k, bubbles: true };
    const began = performance.now();
    plot.dispatchEvent(new PointerEvent("pointermove", at));
    return performance.now() - began;
  }));
}"""


def clicks(page: Page) -> None:
    """Time from a click to the drawn run."""
    page.locator("body[data-drawn*=motor]").wait_for()
    times, before = [], None
    for k in range(13):
        page.locator("#plot .plane").click(position={"x": 200 + 40 * k, "y": 150 + 20 * k})
        while (now := page.evaluate("document.body.dataset.simulated")) == before:
            time.sleep(0.02)
        times.append(int(now.split(", ")[-1].removesuffix(" ms")))
        before = now
    first, *later = times
    print(f"click to run: first {first} ms, then {min(later)} to {max(later)} ms")


def large(place: Path) -> None:
    """A page of 10^7 points, one metric."""
    axes = [spaced_axis(NOISE, 1e-6, 1e-2, 10), spaced_axis(ALPHA, 2.0, 50.0, 1000), spaced_axis(LAMBDA, 1.0, 20.0, 1000)]
    result = make_result(
        rigid_study(axes=axes), motor__velocity_rmse=lambda f: f[ALPHA] * f[LAMBDA] * (1.0 + 1e3 * f[NOISE])
    )
    source = Source("", [], lambda out, live: write_study(result, out, [], served=live), {}, lambda: None, lambda: None)
    began = time.perf_counter()
    index = write_static(source, place / "page")
    print(f"{len(result.frame):.0e} points written in {time.perf_counter() - began:.1f} s")
    with ExplorerServer(source) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        server.newest()
        for name, url in (("disk", index.as_uri()), ("server", server.url)):
            for _ in range(3):
                with sync_playwright() as playwright:
                    browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
                    page, began = browser.new_page(viewport={"width": 1200, "height": 900}), time.perf_counter()
                    page.goto(url, wait_until="commit")
                    page.locator("body[data-drawn=overview]").wait_for()
                    first = time.perf_counter() - began
                    page.locator("body[data-drawn*=motor]").wait_for()
                    load_seconds, loaded = (
                        time.perf_counter() - began,
                        "performance.getEntriesByType('navigation')[0].loadEventEnd",
                    )
                    print(
                        f"{name}: loaded {page.evaluate(loaded) / 1e3:.2f} s, first picture {first:.2f} s, all points "
                        f"{load_seconds:.2f} s, values {page.evaluate(HOVER):.1f} ms"
                    )
                    browser.close()
        server.shutdown()


def further_runs() -> None:
    """Time of one run after others of the same study."""
    config, medians = read_config(MAP), {}
    for backend in ("fused", "scan"):
        times = []
        for k in range(12):
            began = time.perf_counter()
            run(with_values(config, {LAMBDA: 4.0 + k}), backend=backend)  # type: ignore[arg-type]
            times.append(time.perf_counter() - began)
        medians[backend] = np.median(times[2:])
    print("a further run of 20 000 samples: " + ", ".join(f"{name} {seconds:.3f} s" for name, seconds in medians.items()))


def rounding(folder: Path) -> None:
    """Runs of the gain map, again: stored by lanes, one by one, and with numbers that differ in the last digits."""
    result = open_study(folder)
    frame, paths = result.frame, [axis.path for axis in result.config.axes]
    cells = frame[np.isclose(frame[NOISE], 1e-4) & (frame["seed"] == 0)].sample(30, random_state=0)
    apart = []
    for _, row in cells.iterrows():
        point = with_values(result.config, {path: float(row[path]) for path in paths})
        apart.append(abs(run(point, backend="scan").summary["metrics"][ERROR] / row[ERROR] - 1.0))
    print(f"30 cells at a noise of 1e-4 rad, run again by scan: {np.sum(np.array(apart) > 1e-3)} differ by more than 0.1 % "
          f"from the sweep, the largest by {100 * max(apart):.2g} %")  # fmt: skip
    point = with_values(result.config, {NOISE: 1e-4, LAMBDA: 1.512, ALPHA: 5.268})
    near = [metrics[ERROR] for metrics in run_perturbed(point, 0, 20)]
    seeds = [run(point, seed=seed, backend="scan").summary["metrics"][ERROR] for seed in range(20)]
    for name, values in (("numbers that differ in the last digits", near), ("seeds", seeds)):
        print(f"{name}: {np.mean(values):.4f} rad/s, standard deviation {100 * np.std(values) / np.mean(values):.2g} %")
    trace, neighbour = (
        run(with_values(point, {ALPHA: alpha}), backend="scan").trace for alpha in (5.268, 5.268 * (1 + 1e-14))
    )
    difference = (trace["motor.velocity_estimate"] - neighbour["motor.velocity_estimate"]).abs()
    print(f"estimates differ by more than 1 mrad/s from {trace['t'][difference > 1e-3].iloc[0]:.2f} s on")


if __name__ == "__main__":
    with TemporaryDirectory() as name:
        place = Path(name)
        further_runs()
        sweep(MAP, place / "map")
        rounding(place / "map")
        with ExplorerServer(study_source(place / "map")) as server, sync_playwright() as playwright:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": 1200, "height": 900})
            page.goto(server.url)
            clicks(page)
            browser.close()
            server.shutdown()
        large(place)
