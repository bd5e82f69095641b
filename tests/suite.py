"""The suite's own rules: which tests are slow, as measured; which files begin; programs that a test needs; repeats.

`pytest --measure` writes `durations.json`: the seconds of each slow test function, over all of its cases, and of each slow
fixture, by its file, or by its name alone where several files use it. Of a function that was measured before, the longer
time stays: in a part of the suite it may compile what another test does in the whole. Delete the file to begin anew.
"""

import json
import shutil
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

DURATIONS = Path(__file__).with_name("durations.json")
SLOW = 0.7
"""Seconds from which a test function, over all of its cases, or a fixture is slow: the quick suite leaves it out."""

_PACKAGES = {
    "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi",
    "cc": "gcc",
    "x86_64-w64-mingw32-gcc": "gcc-mingw-w64-x86-64",
}
"""Packages of Debian that are not called as their program."""


def _name_function(nodeid: str) -> str:
    return nodeid.partition("[")[0].rpartition("tests/")[2]


def _read_durations() -> dict[str, float]:
    return json.loads(DURATIONS.read_text(encoding="utf-8")) if DURATIONS.exists() else {}


def _is_slow(test: pytest.Item, durations: Mapping[str, float]) -> bool:
    function = _name_function(test.nodeid)
    file = function.partition("::")[0]
    fixtures = getattr(test, "fixturenames", ())
    return any(name in durations for name in (function, *fixtures, *(f"{file}::{fixture}" for fixture in fixtures)))


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
    durations = _read_durations()
    longest = config.getoption("--longest")
    items[:] = [item for item in items if durations.get(_name_function(item.nodeid), 0.0) <= longest]
    seconds = Counter()
    for function, duration in durations.items():
        seconds[function.partition("::")[0]] += duration
    for item in items:
        if _is_slow(item, durations):
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


_fixtures = Counter()
"""Seconds of the fixtures that the running test has set up, without those of the fixtures that they use."""


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: pytest.FixtureDef) -> Iterator[None]:
    started, before = time.perf_counter(), _fixtures.total()
    try:
        return (yield)
    finally:
        file = _name_function(fixturedef.baseid)
        name = f"{file}::{fixturedef.argname}" if file.endswith(".py") else fixturedef.argname
        _fixtures[name] += time.perf_counter() - started - (_fixtures.total() - before)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(call: pytest.CallInfo) -> Iterator[None]:
    report = yield
    if call.when == "setup":
        # workers send what a report holds
        report.fixtures = dict(_fixtures)
        _fixtures.clear()
    return report


class _Stopwatch:
    """Sums up the durations of test functions and fixtures, and writes those that are slow."""

    def __init__(self) -> None:
        self.seconds = Counter()
        self.fixtures = Counter()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        fixtures = getattr(report, "fixtures", {})
        self.seconds[_name_function(report.nodeid)] += report.duration - sum(fixtures.values())
        for name, duration in fixtures.items():
            # each worker makes its own, and so may each case
            self.fixtures[name] = max(self.fixtures[name], duration)

    def pytest_sessionfinish(self) -> None:
        measured = {
            name: round(duration, 1) for name, duration in (self.seconds | self.fixtures).items() if duration >= SLOW
        }
        durations = Counter(measured) | Counter(_read_durations())
        DURATIONS.write_text(json.dumps(dict(sorted(durations.items())), indent=0) + "\n", encoding="utf-8")
