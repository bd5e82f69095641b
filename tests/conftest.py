"""Settings of all tests: float64 unless a test asks otherwise, no silent rank promotion, two CPU devices."""

import os
import signal
import sys
from pathlib import Path

# what one worker, command or run has compiled serves the others of this Python; another one packs programs otherwise
os.environ |= {
    "JAX_NUM_CPU_DEVICES": "2",
    "JAX_COMPILATION_CACHE_DIR": str(Path(__file__).parents[1] / ".cache" / "jax" / sys.implementation.cache_tag),
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    # tests change what is compiled
    "JAXBL_PROGRAMS": "",
    # messages name the command as a shell finds it
    "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
}

import jax
import pytest
from figure_kinds import draw_figures_by_kind, every_figure
from hypothesis import settings
from progress_lines import without_progress

from jaxbl.workers import clear_programs_if_needed, collect_garbage_rarely

pytest_plugins = ["shared_results", "suite"]

collect_garbage_rarely()
# to draw figures takes longer than most of what they show
draw_figures_by_kind()
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

# a crowded machine is no failure
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")

# benchmarks are scripts beside the package; the tests' bench of hidden effects is one of them
sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))


@pytest.fixture(autouse=True, scope="module")
def _few_programs():
    """Clear compiled programs after a file: those of many files would use up the memory maps of a process."""
    yield
    clear_programs_if_needed()


@pytest.fixture
def every_figure_drawn():
    """Draw every figure, for tests that look at files of figures or at places in them."""
    with every_figure():
        yield


@pytest.fixture(scope="module")
def compiled_once():
    """Studies of a file that differ in values of lanes alone share the program of their chunks."""
    from jaxbl.sweeps.programs import share_programs

    with share_programs():
        yield


@pytest.fixture(scope="session")
def client():
    """A Dask cluster of two workers in this process."""
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0") as workers,
        Client(workers, set_as_default=False) as connection,
    ):
        yield connection


@pytest.fixture
def default_interrupt():
    """SIGINT as in a terminal, also for processes that are started: a suite in the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def call(monkeypatch, tmp_path):
    """The command in this process: exit code, lines on stdout, lines on stderr but for progress."""
    monkeypatch.setattr("jaxbl.workers.start_jax", lambda: None)
    # the oldest typer warns when it is imported beside the newest click
    from typer.testing import CliRunner

    from jaxbl import cli

    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        result = CliRunner().invoke(cli.app, list(map(str, arguments)), standalone_mode=False)
        end = result.exception if isinstance(result.exception, SystemExit) else None
        if result.exception is not None and end is None:
            raise result.exception
        code = end.code if end else (result.return_value or 0)
        return code, result.stdout.splitlines(), without_progress(result.stderr).splitlines()

    return run
