"""The suite's own rules: which tests are slow, as measured; which files begin; programs that a test needs; repeats.

`pytest --measure` writes `durations.json`: the seconds of each slow test function, over all of its cases.
"""

import json
import shutil
from collections import Counter
from pathlib import Path

import pytest

DURATIONS = Path(__file__).with_name("durations.json")
SLOW = 1.0
"""Seconds from which a test function is slow, over all of its cases: the quick suite leaves it out."""

_PACKAGES = {
    "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi",
    "cc": "gcc",
    "x86_64-w64-mingw32-gcc": "gcc-mingw-w64-x86-64",
}
"""Packages of Debian that are not called as their program."""


def _name_function(nodeid: str) -> str:
    return nodeid.partition("[")[0].rpartition("tests/")[2]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--measure", action="store_true", help=f"write the durations of slow tests to {DURATIONS.name}")
    parser.addoption("--longest", type=float, default=float("inf"), help="leave out test functions that took longer, s")
    parser.addoption("--long", action="store_true", help="repeat as often as the fixture `repeats` may")


def pytest_configure(config: pytest.Config) -> None:
    # with workers, only the process that they report to sees all
    if config.getoption("--measure") and not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Stopwatch())


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Choose and mark tests, and put files with much slow work first, each as a whole: workers end together."""
    durations = json.loads(DURATIONS.read_text(encoding="utf-8"))
    longest = config.getoption("--longest")
    items[:] = [item for item in items if durations.get(_name_function(item.nodeid), 0.0) <= longest]
    seconds = Counter()
    for function, duration in durations.items():
        seconds[function.partition("::")[0]] += duration
    for item in items:
        if _name_function(item.nodeid) in durations:
            item.add_marker("slow")
        if "repeats" in getattr(item, "fixturenames", ()):
            item.add_marker("long")
    items.sort(key=lambda item: -seconds[_name_function(item.nodeid).partition("::")[0]])


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip a test where a program is missing that it needs."""
    missing = [name for mark in item.iter_markers("program") for name in mark.args if shutil.which(name) is None]
    if missing:
        packages = " ".join(_PACKAGES.get(name, name) for name in missing)
        pytest.skip(f"no {', '.join(missing)} (Debian: apt-get install {packages})")


@pytest.fixture
def repeats(request: pytest.FixtureRequest):
    """Return the first number of two, or the second one in `make test-long`."""
    return lambda few, many: many if request.config.getoption("--long") else few


class _Stopwatch:
    """Sums up the durations of test functions, and writes those that are slow."""

    def __init__(self) -> None:
        self.seconds = Counter()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.seconds[_name_function(report.nodeid)] += report.duration

    def pytest_sessionfinish(self) -> None:
        slow = {function: round(duration, 1) for function, duration in sorted(self.seconds.items()) if duration >= SLOW}
        DURATIONS.write_text(json.dumps(slow, indent=0) + "\n", encoding="utf-8")
