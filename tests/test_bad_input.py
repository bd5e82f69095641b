"""Bad input of any kind gets one line, in seconds and in little memory."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import tomli_w
from command_server import run_command, run_python
from measured import simulate_log
from progress_lines import without_progress
from small_study import ALPHA, listed_axis, rigid_study

TESTS = Path(__file__).parent

# said of the inputs that :mod:`bad_inputs` lists; "" where there is nothing to say
EXPECTED_LINES = {
    "study inertia": "drive.motor_inertia: should be at least 1e-30, not 4.94066e-324",
    "study substeps of 1e30": "run.substeps: should be a number of 64 bits, not 0xc9f2c9cd04674edea40000000",
    "study substeps of 1e9": "run.substeps: should be less than or equal to 100000, not 1000000000",
    "study nested": "tables or arrays are nested too deep",
    "study nested tables": "a.b.b.b.b.b.b.b.b.b.b.b.b.b.b.b: tables or arrays within one another; at most 16 are possible",
    "study dotted": "line 1: a key of more than 50 parts; none has as many",
    "study nested far": "tables or arrays are nested too deep",
    "study long kind": "effects[0].kind: unknown kind 'xxx",
    "study long key": "a key should have at most 200 characters, not 5000",
    "study long title": "title: String should have at most 500 characters, not 'xxx",
    "study long path": "axes[0]: unknown path 'ooo",
    "study chained": "include: more than 100 files, with those that they include; fewer are needed",
    "study doubled": "include: more than 100 files, with those that they include; fewer are needed",
    "study pipe included": "pipe.csv: is a pipe or a device; a file is needed",
    "study device included": "/dev/zero: is a pipe or a device; a file is needed",
    "study pipe recorded": "pipe.csv: is a pipe or a device; a file is needed",
    "study device recorded": "/dev/zero: is a pipe or a device; a file is needed",
    "study harmonics": "excitation.count: should be less than or equal to 10000, not 1000000000",
    "study values": "has 12 MB; it should have at most 8 MB",
    "study fewer values": "holds more than 300000 values; give axes by start, stop and num, inputs as a recorded file",
    "study sine at the rate": "excitation: frequency 1000 Hz has to be below half the sampling rate, 500 Hz",
    "study short steps": "excitation: hold 1e-12 s has to be at least run.sample_period, 0.001 s",
    "study short record": "short.csv: ends after 0.05 s, and the run only after 0.2 s; run.duration should be at most 0.05",
    "study gear ratio": "drive.gear_ratio: should be greater than or equal to 0.0000001, not 1e-12",
    "study escape": r"title: should have no control characters such as '\x1b'",
    "log number": "should hold an array of objects, one a row, or of rows of equally many numbers",
    "log deep array": "is nested too deep; a log holds rows, or arrays by name",
    "log deep object": "is nested too deep; a log holds rows, or arrays by name",
    "log one line": "line 1 has more than 1 MB; a log has a line for each row",
    "log one line of text": "line 1 has more than 1 MB; a log has a line for each row",
    "log one cell": "line 1 has more than 1 MB; a log has a line for each row",
    "log a long row": "line 2 has more than 1 MB; a log has a line for each row",
    "log late stamps": "column 't', data row 2 is 1e+297; a reading should be below 1e+30",
    "log early stamps": "the period of the time stamps is 1e-303 s, as no drive is sampled; see [log] t.unit",
    "log far positions": "column 'theta_e', data row 1 is -2.78976e+300; a reading should be below 1e+30",
    "log no motion": "theta_e moves by only 6.4e-299 rad; see its unit and factor in [log]",
    "log no torque": "u is at most 1.65e-299; see its unit and factor in [log]",
    "log resampled": "a period of 1e-12 s makes 3999000000001 samples of 4000",
    "log drifting": "log.theta_s.drift: should be greater than or equal to -0.1, not -1000000000.0",
    "log unpacks": "",
    "log unpacks twice": "",
    "log unpacks in use": "column 'u' of 2000000000000 values takes 8e+04 GB of memory",
    "log unpacks less": "column 'u' has 90000000 values and the time 400; they should be equally many",
    "log unpacks cells": "",
    "log external": "Not read: theta_s: links are not followed",
    "log external link": "Not read: theta_s: links are not followed",
    "log loop": "",
    "log complex": "column 'theta_s' holds complex numbers; it should hold real numbers",
    "log dates": "Time is counted from 2025-12-31T23:00:00.000000000.",
    "log frozen": "theta_s stands still from 1 to 2.999 s while theta_e moves by 59.6 rad: readings that are frozen",
    "log clipped": "theta_s stands still at the end of its range from 0.827 to 1.647 s while theta_e moves by 30.9 rad",
    "log escape": r"no column 'theta_e' or 'theta_s'; columns: t, u, \x1b[31mred, b",
    "log pipe": "pipe.csv: is a pipe or a device; a file is needed",
    "log device": "/dev/zero: is a pipe or a device; a file is needed",
}


def read_lines(kind: str, folder: Path, count: int = 0) -> dict[str, str]:
    """Lines about the inputs of a kind, by a process that ends where one takes too much."""
    result = run_python(TESTS / "bad_inputs.py", kind, folder, count, cwd=folder, timeout=1500.0)
    assert result.returncode == 0, result.stderr[-5000:]
    return json.loads((folder / "said.json").read_text())


@pytest.fixture(scope="module")
def lines_by_input(tmp_path_factory):
    return read_lines("listed", tmp_path_factory.mktemp("listed"))


def test_every_listed_input_was_tried(lines_by_input):
    assert lines_by_input.keys() == EXPECTED_LINES.keys()


@pytest.mark.parametrize("case", EXPECTED_LINES)
def test_listed_inputs_get_their_lines(lines_by_input, case):
    assert EXPECTED_LINES[case] in lines_by_input[case]
    assert bool(EXPECTED_LINES[case]) == bool(lines_by_input[case])


@pytest.mark.parametrize("kind", ["toml", "logs"])
def test_generated_inputs_are_read_or_refused(kind, tmp_path, repeats):
    """Read, or refused in one line; the process itself ends at an exception, at ten seconds, and at two gigabytes."""
    count = repeats(70, 1000)
    lines = read_lines(kind, tmp_path, count).values()
    assert len(lines) >= count
    # neither all refused nor all read
    refused = sum(str(tmp_path) in line for line in lines)
    assert count / 10 < refused < len(lines) - count / 25


def test_a_command_ends_with_two_and_one_line(tmp_path):
    os.mkfifo(tmp_path / "log.csv")
    result = run_command("inspect", "log.csv", cwd=tmp_path)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr == "jaxbl: log.csv: is a pipe or a device; a file is needed\n"


def test_letters_of_a_file_s_name_do_not_reach_the_terminal(tmp_path):
    simulate_log().to_csv(tmp_path / "a\x1b[31mb.csv", index=False)
    result = run_command("inspect", "a\x1b[31mb.csv", cwd=tmp_path)
    assert (result.returncode, result.stderr) == (0, "")
    # the folder has the log's name
    assert r"a\x1b[31mb_inspected" in result.stdout.splitlines()[-1]
    assert "\x1b" not in result.stdout


def test_a_name_is_no_mathematics_and_a_folder_may_be_read_only(tmp_path):
    """The figures come after all computing: a name must not make them fail."""
    axes = [listed_axis(ALPHA, 5.0, 9.0)]
    figures = [{"kind": "line", "x": ALPHA, "value": "motor.velocity_rmse"}]
    (tmp_path / "study.toml").write_text(tomli_w.dumps(rigid_study(title=r"$\frac{$ 漢", axes=axes, figures=figures)))
    result = run_command("sweep", "study.toml", cwd=tmp_path)
    assert (result.returncode, without_progress(result.stderr)) == (0, "")
    # and where the results may only be read, that is said before the figures are drawn
    folder = tmp_path / "results" / "study_map"
    folder.chmod(0o555)
    # the superuser may write anywhere, unless that right is given up
    before = () if os.geteuid() else ("setpriv", "--bounding-set=-dac_override")
    if before and shutil.which("setpriv") is None:
        return
    call = [*before, sys.executable, "-m", "jaxbl", "plot", folder]
    result = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)
    folder.chmod(0o755)
    message = f"{folder}: cannot be written to (Permission denied); copy it to where you may write, and plot that"
    assert (result.returncode, without_progress(result.stderr)) == (2, f"jaxbl: {message}\n")


@pytest.mark.parametrize("wait", [0.0, 0.3, 1.0, 2.0])
def test_an_interrupt_before_work_begins(tmp_path, default_interrupt, wait):
    """While modules are loaded; some of them swallow a KeyboardInterrupt."""
    simulate_log().to_csv(tmp_path / "log.csv", index=False)
    (tmp_path / "study.toml").write_text(tomli_w.dumps(rigid_study()))
    call = [sys.executable, "-X", "importtime", "-m", "jaxbl", "identify", "log.csv", "--model", "study.toml"]
    with subprocess.Popen(call, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        # Python itself is up once it has loaded a module that only jaxbl asks for
        lines = iter(process.stderr.readline, "")
        next(line for line in lines if line.endswith(" typer\n") or " click" in line)
        time.sleep(wait)
        process.send_signal(signal.SIGINT)
        content = process.stderr.read()
        process.wait(300)
    lines_left = [line for line in content.splitlines() if not line.startswith("import time:")]
    assert process.returncode == 130
    assert len(lines_left) == 1 and lines_left[0].startswith("interrupted")
