"""The command line: what it prints, what it leaves, how it ends."""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import tomllib
import urllib.request
from html import unescape
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import numpy as np
import pandas as pd
import pytest
import tomli_w
from command_server import run_command, run_python, start_command
from measured import EMPS, find_recording, simulate_log
from passed import PASSED
from progress_lines import without_progress
from shared_results import ATLAS
from small_study import ALPHA, LAMBDA, listed_axis, rigid_study, small_study, spaced_axis
from typer.main import get_command

from jaxbl import cli, terminal
from jaxbl.cli import setup
from jaxbl.cli.next_steps import (
    LogCall,
    after_comparison,
    after_diagnosis,
    after_identification,
    after_inspection,
    after_run,
    after_tuning,
)
from jaxbl.cli.options import folder_of
from jaxbl.errors import InputError
from jaxbl.files import lock_folder
from jaxbl.lines import NextStep, program_name
from jaxbl.result import Result
from jaxbl.sweeps.engine import Engine

pytestmark = pytest.mark.usefixtures("compiled_once")
FIGURE = {"kind": "line", "x": ALPHA, "value": "motor.velocity_rmse"}
AXES = [listed_axis(ALPHA, 5.0, 9.0, 20.0)]
GAINS = [listed_axis(ALPHA, 5.0, 9.0), listed_axis(LAMBDA, 3.0, 6.0)]

NO_RESULTS = (
    "{}: is not empty and holds no results with a manifest.json (an earlier jaxbl wrote none there); choose another folder "
    "with --out, where they are made anew"
)


def interrupt(*_):
    raise KeyboardInterrupt


def jaxbl(*arguments, cwd, **environment):
    """The command by a new interpreter, which imports what it needs."""
    return subprocess.run(
        [sys.executable, "-m", "jaxbl", *arguments], cwd=cwd, capture_output=True, text=True, timeout=120, check=False,
        env=os.environ | environment,
    )  # fmt: skip


def write_study(folder, data=None, name="study.toml"):
    path = folder / name
    path.write_text(tomli_w.dumps(data or rigid_study(axes=AXES, figures=[FIGURE])))
    return path


def list_files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_the_version_does_not_wait_for_jax(tmp_path):
    result = jaxbl("--version", cwd=tmp_path, PYTHONPROFILEIMPORTTIME="1")
    assert (result.returncode, result.stdout) == (0, f"jaxbl {version('jaxbl')}\n")
    assert " jaxbl.cli\n" in result.stderr
    assert " jax\n" not in result.stderr


def test_help_does_not_wait_for_jax(tmp_path):
    heavy = "{'jax', 'numpy', 'pandas', 'matplotlib', 'scipy', 'pydantic'}"
    code = f"import sys, jaxbl, jaxbl.cli; print(sorted({heavy} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
    result = jaxbl("--help", cwd=tmp_path)
    assert result.returncode == 0
    words = " ".join(result.stdout.split())
    assert words == " ".join(jaxbl("-h", cwd=tmp_path).stdout.split())
    headings = [line for line in result.stdout.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert headings[1:] == ["Start:", "From a data sheet or a study:", "From a log:", "Results:", "This machine:"]
    for name, command in get_command(cli.app).commands.items():
        # the whole first sentence, and below it an example that the command takes
        summary, *_, example, page = [line for line in command.help.split("\n") if line]
        assert f" {name} {summary}" in words and example.startswith(f"Example: jaxbl {name}")
        assert (Path(__file__).parents[1] / page.removeprefix("Read on: ")).is_file()


def test_a_sweep_and_its_second_call(tmp_path):
    """A user sees what is printed and left: no progress bar in a pipe, no work done twice."""
    write_study(tmp_path, rigid_study(axes=AXES, sweep={"seeds": 2}))
    # programs are compiled anew; matplotlib says so where it takes long to list the fonts
    cache = {"XDG_CACHE_HOME": str(tmp_path / "cache"), "MPLCONFIGDIR": matplotlib.get_cachedir()}
    first = jaxbl("sweep", "study.toml", cwd=tmp_path, **cache)
    assert (first.returncode, without_progress(first.stderr)) == (0, "")
    folder = tmp_path / "results" / "study_map"
    assert list_files(folder) == [
        "figures/line_motor_velocity_rmse.png", "manifest.json", "points/part-00000.parquet", "report.html", "study.toml",
    ]  # fmt: skip
    lines = first.stdout.splitlines()
    assert lines[0].startswith("✓ Good: 6 runs: the motor observer converges in ")
    assert lines[-1] == "results/study_map/report.html" and len(lines) <= 8
    page = (folder / "report.html").read_text()
    assert re.search(r"<li>Compiled in [\d.]+ s, ran 6 lanes in [\d.]+ s\.</li>", page)
    second = run_command("sweep", "study.toml", cwd=tmp_path, **cache)
    assert second.stdout.splitlines() == lines


def test_interrupted_sweep_says_how_to_go_on(tmp_path):
    """SIGINT while chunks are computed; the line that it prints finishes the study."""
    axes = [listed_axis("run.sample_period", *(1e-3 * (1 + i / 100) for i in range(30)))]
    study = write_study(tmp_path, rigid_study(axes=axes), "a study.toml")
    folder = tmp_path / "out"
    with start_command("sweep", study.name, "--out", "out", cwd=tmp_path) as process:
        for _ in range(3600):
            if list(folder.glob("points/part-*.parquet")) or process.poll() is not None:
                break
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=180)
    assert process.returncode == 130
    assert (
        without_progress(errors)
        == "interrupted; what is finished is kept. Go on with: jaxbl sweep 'a study.toml' --out out\n"
    )
    assert 1 <= len(list(folder.glob("points/part-*.parquet"))) < 30
    assert not json.loads((folder / "manifest.json").read_text())["results"]["sweep"]["finished"]


def test_interrupt_anywhere_else():
    with pytest.raises(SystemExit) as end:
        cli.main(interrupt)
    assert end.value.code == 130


SHARED = (
    "sweep: --detach needs the --scheduler of a cluster that stays, --share goes without one; neither goes with "
    "--overwrite, as others may be at work in the folder; choose another one with --out"
)
NO_SUCH_FILE = "no such file; here are axis.toml, below.toml, figure.toml, gains.toml, part.toml, ..."
BAD = {
    "no such file": (
        ["sweep", "none.toml"],
        f"none.toml: {NO_SUCH_FILE}",
    ),
    "a name that is near": (["sweep", "studi.toml"], "studi.toml: no such file; did you mean study.toml?"),
    "no such folder": (["sweep", "studies/a.toml"], "studies/a.toml: no such file: there is no folder studies"),
    "a folder": (["simulate", "."], ".: is a folder; a TOML file is needed"),
    "no axes": (["sweep", "plain.toml"], "plain.toml: axes: the study has none; add [[axes]], or use 'jaxbl simulate'"),
    "wrong key": (["simulate", "wrong.toml"], "wrong.toml: run: unknown key 'durations'; did you mean 'duration'?"),
    "wrong axis": (
        ["sweep", "axis.toml"],
        "axis.toml: axes[0]: unknown path 'observer.motor.alfa'; nearest valid path: 'observer.motor.alpha'",
    ),
    "wrong axis, dry": (
        ["sweep", "axis.toml", "--dry-run"],
        "axis.toml: axes[0]: unknown path 'observer.motor.alfa'; nearest valid path: 'observer.motor.alpha'",
    ),
    "no such backend": (
        ["sweep", "study.toml", "--backend", "gpu"],
        "--backend: there is no 'gpu'; it should be one of fused, scan",
    ),
    "seeds alone, fused": (
        ["sweep", "seeds.toml", "--backend", "fused"],
        "seeds.toml: --backend fused: the fused loop does not support lanes that differ only in their seed; "
        "use --backend scan",
    ),
    "no such backend for gains": (
        ["tune", "study.toml", "--backend", "Scan"],
        "--backend: there is no 'Scan'; it should be one of fused, scan",
    ),
    "no such backend for conditions": (
        ["verify", "study.toml", "--backend", "xla"],
        "--backend: there is no 'xla'; it should be one of fused, scan",
    ),
    "wrong figure": (
        ["sweep", "figure.toml"],
        "figure.toml: figures[0].value: 'motor.velocity_rms' is no metric; did you mean 'motor.velocity_rmse'?",
    ),
    "foreign folder": (
        ["sweep", "study.toml", "--out", "full"],
        NO_RESULTS.format("full"),
    ),
    "foreign folder, run": (
        ["simulate", "study.toml", "--out", "full"],
        NO_RESULTS.format("full"),
    ),
    "foreign folder, benchmark": (
        ["bench", "--out", "full"],
        NO_RESULTS.format("full"),
    ),
    "a file as folder": (
        ["sweep", "study.toml", "--out", "plain.toml"],
        "plain.toml: is a file; --out should name a folder",
    ),
    "too sparse": (
        ["simulate", "study.toml", "--every", "201"],
        "study.toml: every: should be between 1 and the number of samples 200, not 201",
    ),
    "nothing to tune for": (
        ["tune", "rest.toml"],
        "rest.toml: motor: f⁺ = 0: nothing disturbs the observer's model, so that gains have nothing to overcome; "
        "add a transmission, an effect, or an excitation that moves the drive",
    ),
    "foreign folder, tune": (
        ["tune", "study.toml", "--out", "full"],
        NO_RESULTS.format("full"),
    ),
    "nothing to verify": (
        ["verify", "study.toml"],
        "study.toml: axes: verify needs axes over both gains of an observer, "
        "such as observer.motor.alpha and observer.motor.lambda",
    ),
    "q of no condition": (["verify", "q.toml"], "q.toml: verify.q: should be less than 1, not 1.2"),
    "no gain above f_plus": (
        ["verify", "below.toml"],
        "below.toml: verify: alpha_ratio.start 0.9 should exceed 1: no lambda converges where alpha is not above f_plus",
    ),
    "foreign folder, verify": (
        ["verify", "gains.toml", "--out", "full"],
        NO_RESULTS.format("full"),
    ),
    "nothing to include": (
        ["tune", "part.toml"],
        f"part.toml: include: none.toml: {NO_SUCH_FILE}",
    ),
    "no such share": (
        ["sweep", "study.toml", "--share", "3/2"],
        "--share 3/2: should be I/N, such as 2/8: the second of eight",
    ),
    "a share of a cluster": (
        ["sweep", "study.toml", "--share", "1/2", "--scheduler", "local:2"],
        SHARED,
    ),
    "leaving no cluster": (
        ["sweep", "study.toml", "--detach"],
        SHARED,
    ),
    "leaving, and removing what is there": (
        ["sweep", "study.toml", "--detach", "--scheduler", "tcp://127.0.0.1:1", "--overwrite"],
        SHARED,
    ),
    "a cluster for one log": (
        ["diagnose", "log.csv", "--scheduler", "local:2"],
        "--scheduler goes with --batch: one log is one process's work; leave it out, or give a folder",
    ),
    "no such cluster": (
        ["sweep", "study.toml", "--scheduler", "local:0"],
        "study.toml: --scheduler local:0: local:N needs the number of processes, 1 to 1024",
    ),
    "no such store": (
        ["sweep", "study.toml", "--out", "foo://bucket/a"],
        "foo://bucket/a: is no place for results (Unsupported filesystem: 'foo'); it should be a folder, or s3://BUCKET/FOLDER",
    ),
    "nothing of which to say the status": (
        ["status", "full"],
        "full: holds no study (no manifest.json of a sweep); run 'jaxbl sweep' first",
    ),
    "nothing to plot": (["plot", "full"], "full: holds no study (no manifest.json of a sweep); run 'jaxbl sweep' first"),
    "nowhere to plot": (["plot", "none"], "none: holds no study (no manifest.json of a sweep); run 'jaxbl sweep' first"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_exit_2(case, tmp_path, monkeypatch, capsys):
    arguments, message = BAD[case]
    write_study(tmp_path)
    write_study(tmp_path, rigid_study(), "plain.toml")
    write_study(tmp_path, rigid_study(sweep={"seeds": 2}), "seeds.toml")
    write_study(tmp_path, rigid_study({"run.durations": 1.0}), "wrong.toml")
    write_study(tmp_path, rigid_study(axes=[listed_axis("observer.motor.alfa", 1.0)]), "axis.toml")
    write_study(tmp_path, rigid_study(axes=AXES, figures=[FIGURE | {"value": "motor.velocity_rms"}]), "figure.toml")
    at_rest = {"excitation.amplitude": 0.0, "observer.motor.velocity_error": 0.0}
    write_study(tmp_path, rigid_study(at_rest), "rest.toml")
    write_study(tmp_path, rigid_study(axes=GAINS), "gains.toml")
    write_study(tmp_path, rigid_study(axes=GAINS, verify={"q": 1.2}), "q.toml")
    write_study(
        tmp_path, rigid_study(axes=GAINS, verify={"alpha_ratio": {"start": 0.9, "stop": 2.0, "num": 4}}), "below.toml"
    )
    (tmp_path / "part.toml").write_text('include = "none.toml"')
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("mine")
    before = list_files(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("jaxbl.workers.start_jax", lambda: None)
    monkeypatch.setattr(sys, "argv", ["jaxbl", *arguments])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    assert capsys.readouterr() == ("", f"jaxbl: {message}\n")
    assert list_files(tmp_path) == before


@pytest.mark.parametrize("arguments", [["sweep"], ["sweep", "study.toml", "--outt", "a"], ["swep", "study.toml"]])
def test_wrong_usage_exits_2(arguments, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["jaxbl", *arguments])
    # else click names the module that python -m runs, pytest
    monkeypatch.setattr(sys.modules["__main__"], "__package__", None)
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    assert "Usage: jaxbl" in capsys.readouterr().err


def test_dry_run_says_the_cost_and_writes_nothing(call, tmp_path):
    write_study(tmp_path, rigid_study(axes=AXES, sweep={"seeds": 4, "chunk": 4}))
    code, lines, _ = call("sweep", "study.toml", "--dry-run")
    assert code == 0
    assert list_files(tmp_path) == ["study.toml"]
    assert lines[0] == "points       3 (12 runs with all seeds)"
    assert lines[1] == "chunks       4 of 4 lanes"
    assert [line.split()[0] for line in lines[2:]] == ["memory", "compilation", "run"]


def test_shares_and_how_far_they_are(call, tmp_path):
    write_study(tmp_path, rigid_study(axes=AXES, sweep={"seeds": 4, "chunk": 4}, title="small [red]"))
    code, lines, _ = call("sweep", "study.toml", "--share", "2/2", "--out", "a")
    assert code == 0
    assert lines[0] == "a: 'small [red]', 2 of 4 parts (50 %) of 12 runs"
    assert lines[1].startswith("  no process is at work in it")
    assert lines[2] == "When all parts are there, 'jaxbl sweep study.toml --out a' writes the report."
    assert call("status", "a")[1] == lines[:2]
    # who is last writes the report
    code, lines, _ = call("sweep", "study.toml", "--share", "1/2", "--out", "a")
    assert code == 0 and lines[0].startswith("✓ Good: 12 runs: ") and lines[-1] == "a/report.html"
    assert call("status", "a")[1] == ["a: 'small [red]', 4 of 4 parts (100 %) of 12 runs", "  finished"]
    assert len(list_files(tmp_path / "a" / "points")) == 4 and (tmp_path / "a" / "report.html").is_file()


def test_a_sweep_is_explored(call, tmp_path):
    write_study(tmp_path, rigid_study(axes=GAINS))
    call("sweep", "study.toml", "--out", "out")
    code, lines, _ = call("explore", "out", "--static", "page")
    assert code == 0 and lines[0].startswith("4 runs: ") and lines[-1] == "page/index.html"
    assert {"index.html", "views.js", "uPlot.js", "hyparquet.js", "data.js", "study.toml", "points.parquet"} <= set(
        list_files(Path("page"))
    )
    with pytest.raises(InputError, match="out: holds results of a study"):
        call("explore", "out", "--static", "out")


def test_explore_serves_until_it_is_interrupted(call, tmp_path):
    write_study(tmp_path, rigid_study(axes=GAINS))
    call("sweep", "study.toml", "--out", "out")
    # a browser that only writes down how it was called
    seen = tmp_path / "called"
    browser = f"sh -c 'echo %s > {seen}'"
    with start_command(
        "explore", "out", "--json", "--browser", cwd=tmp_path, TMPDIR=str(tmp_path), BROWSER=browser
    ) as process:
        (url,) = (line.split()[1] for line in iter(process.stderr.readline, "Ctrl+C ends it.\n") if line.startswith("Open "))
        with urllib.request.urlopen(url) as answer:
            assert b"jaxbl explore" in answer.read()
        while not seen.exists() or not seen.read_text():
            time.sleep(0.05)
        # its command line, which others see, has a file of this user's and not the token
        assert url.split("/")[3] not in seen.read_text() and seen.read_text().startswith(f"file://{tmp_path}/jaxbl-explore-")
        assert any(file.startswith("jaxbl-explore-") for file in list_files(tmp_path))
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=60)
    assert process.returncode == 0 and errors == "" and json.loads(output)["exit"] == 0
    assert not any(file.startswith("jaxbl-explore-") for file in list_files(tmp_path))


def test_plot_draws_other_figures_from_the_stored_points(call, tmp_path, monkeypatch):
    study = write_study(tmp_path)
    call("sweep", study, "--out", "out")
    folder = tmp_path / "out"
    monkeypatch.setattr(Engine, "__init__", lambda *_: pytest.fail("plot simulates"))
    for path in [*folder.glob("figures/*"), folder / "report.html"]:
        path.unlink()
    code, lines, _ = call("plot", folder)
    assert code == 0
    assert lines[-1] == str(folder / "report.html")
    assert [path.name for path in folder.glob("figures/*")] == ["line_motor_velocity_rmse.png"]
    write_study(
        tmp_path, rigid_study({"title": "other title"}, axes=AXES, figures=[FIGURE | {"value": "motor.chatter"}]), "b.toml"
    )
    call("plot", folder, "--config", "b.toml")
    assert "other title" in (folder / "report.html").read_text()
    assert (folder / "figures" / "line_motor_chatter.png").exists()
    write_study(tmp_path, rigid_study({"run.duration": 0.3}, axes=AXES), "c.toml")
    with pytest.raises(InputError, match=r"c\.toml: is not the study in .*; only title, notes and figures may differ"):
        call("plot", folder, "--config", "c.toml")


def test_simulate_leaves_trace_summary_figures_and_report(call, tmp_path):
    write_study(tmp_path, rigid_study(axes=AXES))
    code, lines, _ = call("simulate", "study.toml", "--every", 10, "--seed", 3)
    folder = tmp_path / "results" / "study_run"
    assert code == 0
    assert lines[-1] == "results/study_run/report.html"
    assert {"trace.parquet", "summary.json", "report.html", "figures/torque.png"} <= set(list_files(folder))
    assert len(pd.read_parquet(folder / "trace.parquet")) == 20
    assert json.loads((folder / "summary.json").read_text())["seed"] == 3


def test_values_and_observers_are_changed_on_the_command_line(call, tmp_path):
    write_study(tmp_path, rigid_study(axes=AXES))
    (tmp_path / "gains.toml").write_text("[observer.motor]\nlambda = 7.0\nalpha = 31.0\n")
    changes = ["--gains", "gains.toml", "--set", f"{ALPHA}=33", "--set", "observer.discretisation=explicit"]
    assert call("simulate", "study.toml", *changes, "--out", "run")[0] == 0
    conditions = json.loads((tmp_path / "run" / "summary.json").read_text())["conditions"]["motor"]
    assert (conditions["lambda"], conditions["alpha"]) == (7.0, 33.0)
    assert call("sweep", "study.toml", *changes, "--out", "map")[0] == 0
    study = tomllib.loads((tmp_path / "map" / "study.toml").read_text())
    assert study["observer"]["motor"]["lambda"] == 7.0 and study["observer"]["discretisation"] == "explicit"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--set", "observer"], "--set observer: should be PATH=VALUE, such as observer.motor.lambda=3"),
        (
            ["--set", "observer.motor.lamda=1"],
            "--set observer.motor.lamda=1: unknown path 'observer.motor.lamda'; nearest valid path: 'observer.motor.lambda'",
        ),
        (
            ["--set", "run.duration=1", "--set", "observer.motor.lambda=x"],
            "--set observer.motor.lambda=x: observer.motor.lambda: should be a valid number, not 'x'",
        ),
        (
            ["--set", "observer.motor.lambda=-2"],
            "--set observer.motor.lambda=-2: observer.motor.lambda: should be greater than or equal to 0, not -2.0",
        ),
        (["--gains", "none.toml"], "--gains none.toml: no such file; here are gains.toml, study.toml"),
        (["--gains", "gains.toml"], "--gains gains.toml: observer.motor.alpha: should be a valid number, not 'much'"),
        # of two keys that do not go together, found when the runs begin
        (["--set", "run.sample_period=3"], "--set run.sample_period=3: "),
    ],
)
@pytest.mark.parametrize("command", ["simulate", "sweep", "tune", "verify", "export"])
def test_a_wrong_change_is_said_by_its_option_and_not_by_the_study(command, options, message, call, tmp_path):
    write_study(tmp_path, rigid_study(axes=AXES))
    (tmp_path / "gains.toml").write_text("[observer.motor]\nlambda = 7.0\nalpha = 'much'\n")
    with pytest.raises(InputError) as error:
        call(command, "study.toml", *options)
    assert str(error.value).startswith(message)


def test_an_interrupted_verification_says_how_to_go_on(call, tmp_path, monkeypatch):
    write_study(tmp_path, rigid_study(axes=GAINS, verify=ATLAS))
    monkeypatch.setattr(Engine, "run", interrupt)
    changes = ["--set", "encoders.noise=1e-5", "--set", f"{ALPHA}=5"]
    code, _, errors = call("verify", "study.toml", "--out", "out", "--backend", "scan", *changes)
    assert code == 130
    command = f"jaxbl verify study.toml --backend scan --set encoders.noise=1e-5 --set {ALPHA}=5 --out out"
    assert errors == [f"interrupted; what is finished is kept. Go on with: {command}"]


TUNE = {"num": 3, "refine": 1, "alpha_ratio": {"start": 1.2, "stop": 20.0}, "lambda_ratio": {"start": 0.5, "stop": 10.0}}


def tunable_study(**table):
    """A drive under a constant torque, its observer starting 0.1 rad/s off."""
    changes = {"encoders.noise": 1e-5, "observer.motor.velocity_error": 0.1, "run.position_tolerance": 0.01}
    return rigid_study(changes, effects=[{"kind": "motor.constant_torque", "torque": 0.05}], tune=TUNE | table)


def test_shares_by_the_command_of_which_the_last_writes_the_report(call, tmp_path):
    write_study(tmp_path, small_study(axes=AXES, sweep={"seeds": 2, "chunk": 4}))
    code, lines, _ = call("sweep", "study.toml", "--share", "1/2")
    assert code == 0 and "1 of 2 parts (50 %) of 6 runs" in lines[0]
    assert lines[-1] == "When all parts are there, 'jaxbl sweep study.toml --out results/study_map' writes the report."
    with lock_folder(tmp_path / "results" / "study_map", shared=True):
        # another one is still at work: it is the last
        code, lines, _ = call("sweep", "study.toml", "--share", "2/2")
        assert code == 0 and "2 of 2 parts (100 %)" in lines[0] and "all parts are there" in lines[1]
        assert not (tmp_path / "results" / "study_map" / "report.html").exists()
    code, lines, _ = call("sweep", "study.toml", "--share", "2/2")
    assert code == 0 and lines[-1] == "results/study_map/report.html"


def test_tune_leaves_gains_numbers_figures_and_report(call, tmp_path, monkeypatch):
    write_study(tmp_path, tunable_study())
    code, lines, _ = call("tune", "study.toml")
    folder = tmp_path / "results" / "study_gains"
    assert code == 0
    figures = {"figures/tuning_motor.png"}
    assert {"gains.toml", "tuning.json", "report.html", "manifest.json"} | figures <= set(list_files(folder))
    assert "λ = " in lines[0] and "α = " in lines[0] and len(lines) <= 8
    assert re.search(r"Compiled in [\d.]+ s, ran 26 lanes in [\d.]+ s\.", (folder / "report.html").read_text())
    assert lines[-1] == "results/study_gains/report.html"
    # the second call computes nothing and says the same
    monkeypatch.setattr(Engine, "run", lambda *_: pytest.fail("a finished search simulates"))
    assert call("tune", "study.toml")[:2] == (0, lines)
    # nor does plot, which needs the study
    (folder / "report.html").unlink()
    assert call("plot", "results/study_gains", "--config", "study.toml")[:2] == (0, lines)
    with pytest.raises(InputError, match=r"results/study_gains: no study is kept beside tuning\.json; give it by --config"):
        call("plot", "results/study_gains")
    # other commands may share the folder, another study may not
    assert call("simulate", "study.toml")[0] == 0
    write_study(tmp_path, tunable_study(margin_exact=1.5), "b.toml")
    with pytest.raises(InputError, match="holds results of another study"):
        call("tune", "b.toml", "--out", folder)


def test_a_search_that_finds_nothing_leaves_no_gains_and_exits_1(tmp_path, monkeypatch, capsys):
    write_study(tmp_path, tunable_study(margin_exact=1e4))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("jaxbl.workers.start_jax", lambda: None)
    monkeypatch.setattr(sys, "argv", ["jaxbl", "tune", "study.toml"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 1
    out, errors = capsys.readouterr()
    errors = without_progress(errors)
    assert out == ""
    assert errors.startswith("jaxbl: motor: none of the 9 gains ") and errors.count("\n") == 1
    assert "margin_exact = 10000: 0 (largest" in errors
    assert not {"gains.toml", "tuning.json", "report.html"} & {path.name for path in tmp_path.rglob("*")}


def test_an_interrupted_search_says_how_to_go_on(call, tmp_path, monkeypatch):
    write_study(tmp_path, tunable_study())
    monkeypatch.setattr(Engine, "run", interrupt)
    code, _, errors = call("tune", "study.toml", "--out", "out")
    assert code == 130
    assert errors == ["interrupted; what is finished is kept. Go on with: jaxbl tune study.toml --out out"]


def test_a_run_that_diverges_is_reported_and_exits_1(call, tmp_path):
    write_study(tmp_path, rigid_study(effects=[{"kind": "motor.viscous_friction", "viscous": 1e4}]))
    code, lines, _ = call("simulate", "study.toml")
    assert code == 1
    assert lines[0].startswith("✗ Failed: The run diverges")
    assert (tmp_path / "results" / "study_run" / "summary.json").exists()


def test_results_of_another_study_stay_until_overwriting_is_asked_for(call, tmp_path):
    write_study(tmp_path)
    call("sweep", "study.toml", "--out", "out")
    write_study(tmp_path, rigid_study({"title": "second", "run.duration": 0.3}, axes=AXES), "b.toml")
    for command in ("sweep", "simulate"):
        with pytest.raises(InputError, match=r"out: holds results of another study \(small\)"):
            call(command, "b.toml", "--out", "out")
    call("sweep", "b.toml", "--out", "out", "--overwrite")
    assert json.loads((tmp_path / "out" / "manifest.json").read_text())["results"]["sweep"]["title"] == "second"


def test_progress_on_a_terminal_is_a_line_that_is_taken_away(monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setattr(terminal, "_LOOK", 0.01)
    for unit in ("runs", terminal.STEPS, ""):
        with terminal.progress_bar(unit) as progress:
            progress(2, 3)
            time.sleep(0.1)
    assert capsys.readouterr().out == ""


def test_progress_in_a_pipe_is_a_line_now_and_then(monkeypatch, capsys):
    with terminal.progress_bar("runs") as progress:
        progress(1, 3)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(terminal, "_EVERY", 0.05)
    monkeypatch.setattr(terminal, "_LOOK", 0.01)
    for quiet, output in ((True, False), (False, True)):
        with terminal.progress_bar("runs", quiet=quiet):
            time.sleep(0.2)
        out, errors = capsys.readouterr()
        assert out == without_progress(errors) == "" and bool(errors) == output


def test_lines_of_progress_say_what_is_done_the_share_and_the_remaining_time():
    lines = terminal.ProgressLines("runs", "compiling", 0.0)
    assert [lines.look(t) for t in (1.0, 9.0, 10.0, 11.0)] == [None, None, "jaxbl: compiling, for 10.0 s so far", None]
    # what an earlier call has left is counted at once, and says nothing of the speed
    lines.update(500, 1000)
    assert lines.look(12.0) is None
    for t in range(13, 90):
        lines.update(500 + 2 * (t - 12), 1000)
        shown_line = lines.look(float(t))
    lines.hear("drawing")
    assert lines.look(90.0) == "jaxbl: drawing, 654 of 1000 runs (65 %), about 3 min left"
    assert without_progress("jaxbl: drawing, 654 of 1000 runs (65 %), about 2 min left\nx\n") == "x\n"
    assert shown_line is None


def test_work_that_follows_the_last_count_has_a_time_or_a_count_of_its_own():
    """No line stands at 100 %, and none tells a remaining time from another stage's speed."""
    lines = terminal.ProgressLines("runs", "compiling", 0.0, pause=1.0)
    for t in range(1, 11):
        lines.update(10 * t, 100)
        shown_line = lines.look(float(t))
    assert shown_line == "jaxbl: running, for 0.0 s so far"
    lines.hear("repeating runs")
    assert [lines.look(t) for t in (11.0, 31.0)] == [f"jaxbl: repeating runs, for {t} s so far" for t in ("0.0", "20.0")]
    lines.update(0, 50)
    assert lines.look(32.0) == "jaxbl: repeating runs, 0 of 50 runs (0 %)"
    lines.update(5, 50)
    assert lines.look(42.0) == "jaxbl: repeating runs, 5 of 50 runs (10 %), about 90.0 s left"


def test_steps_of_unlike_length_tell_no_remaining_time():
    lines = terminal.ProgressLines(terminal.STEPS, "compiling", 0.0, pause=1.0)
    lines.update(1, 6)
    assert lines.look(1.0) == "jaxbl: running, step 2 of 6, for 0.0 s so far"
    shown_line = lines.look(300.0)
    assert shown_line == "jaxbl: running, step 2 of 6, for 5 min so far" and without_progress(f"{shown_line}\n") == ""


@pytest.mark.parametrize(("seconds", "text"), [(0.04, "0.0 s"), (99.0, "99.0 s"), (600.0, "10 min"), (7200.0, "2.0 h")])
def test_durations(seconds, text):
    assert terminal.format_duration(seconds) == text


def test_default_folder():
    assert folder_of(Path("a/b.toml"), "map", None) == Path("results/b_map")


# gain_map is run by tests/test_docs.py, as the README says
SHIPPED_STUDIES = {
    "load_gains": "sweep",
    "gain_boundary": "sweep",
    "paper_table1": "simulate",
    "tune_paper_drive": "tune",
    "observer_choice": "tune",
    "condition_atlas": "verify",
}
RUN_SHIPPED = """
import contextlib, io, json, sys
from jaxbl.__main__ import program

ended = {}
for name, command in json.loads(sys.argv[1]).items():
    sys.argv = ["jaxbl", command, f"{name}.toml"]
    with contextlib.redirect_stderr(io.StringIO()) as errors:
        try:
            program()
            code = 0
        except SystemExit as end:
            code = end.code or 0
    ended[name] = [code, errors.getvalue()]
print(json.dumps(ended))
"""


def shorten_study(study):
    """Shorten a study to few points and half a second."""
    study["run"]["duration"] = 0.5
    tuned = study.get("tune", {})
    tuned["refine"] = 0
    if "observers" in tuned:
        # the super-twisting one and a differentiator; tests/gains/test_observer_choice.py has others
        tuned |= {"trials": 8, "observers": tuned["observers"][::8]}
    else:
        tuned["num"] = 3
    for axis in tuned.get("axes", []):
        axis["values"] = axis["values"][-1:]
    if "refine" in study.get("sweep", {}):
        study["sweep"]["refine"] = 1
    if "verify" in study:
        # shapes of the verified study that other tests read, which share its programs
        verify = study["verify"]
        verify |= {"damping": verify["damping"][:1], "marks": verify["marks"][:2]}
        for ratio in ("alpha_ratio", "lambda_ratio"):
            verify[ratio]["num"] = ATLAS[ratio]["num"]
    for axis in study.get("axes", []):
        axis |= {"num": 2} if "num" in axis else {"values": axis["values"][:2]}


def test_shipped_studies_run_without_a_word_on_stderr(tmp_path):
    # in a process of their own, where float64 is on only inside the engine
    for name in SHIPPED_STUDIES:
        study = tomllib.loads((Path(__file__).parents[1] / "sweeps" / f"{name}.toml").read_text(encoding="utf-8"))
        shorten_study(study)
        write_study(tmp_path, study, f"{name}.toml")
    result = run_python("-c", RUN_SHIPPED, json.dumps(SHIPPED_STUDIES), cwd=tmp_path, timeout=900.0)
    assert (result.returncode, without_progress(result.stderr)) == (0, "")
    results = json.loads(result.stdout.splitlines()[-1])
    outcomes = {name: (code, without_progress(errors)) for name, (code, errors) in results.items()}
    assert outcomes == dict.fromkeys(SHIPPED_STUDIES, (0, ""))


def test_inspect_writes_a_first_model(call, tmp_path):
    simulate_log(count=6000, gap=0.1, noise=1e-4).to_csv("axis.csv", index=False)
    code, lines, _ = call("inspect", "axis.csv", "--write", "axis.toml")
    assert code == 0 and "axis.toml: a first model." in lines
    assert "Next: jaxbl identify axis.csv --model axis.toml" in lines
    text = (tmp_path / "axis.toml").read_text()
    assert text.startswith("# Proposed by jaxbl inspect --write from axis.csv.") and "gear_ratio = 20.0" in text
    assert call("inspect", "axis.csv", "--model", "axis.toml", "--out", "again")[0] == 0
    with pytest.raises(InputError, match=r"axis.toml: is there already; --write needs a new name"):
        call("inspect", "axis.csv", "--write", "axis.toml")
    # a name of a log is no line of the model
    Path("axis.csv").rename("axis\nseed = 7\n.csv")
    assert call("inspect", "axis\nseed = 7\n.csv", "--write", "again.toml", "--out", "named")[0] == 0
    assert "seed" not in tomllib.loads((tmp_path / "again.toml").read_text())


def test_inspect_says_what_a_log_holds_and_leaves_numbers_figures_and_report(call, tmp_path):
    simulate_log(count=6000, gap=0.1, noise=1e-4).to_csv("axis.csv", index=False)
    code, lines, _ = call("inspect", "axis.csv")
    folder = tmp_path / "results" / "axis_inspected"
    assert code == 0
    assert lines[0].startswith("✓ Good: The log shows inertia, ")
    assert any(line.split(maxsplit=2)[-1] == "6000 samples every 1 ms, even stamps, 1 segment" for line in lines)
    assert any(line.startswith("As read: motor up to ") and "u up to " in line for line in lines)
    assert lines[-1] == "results/axis_inspected/report.html" and len(lines) <= 8
    figures = {f"figures/{name}.png" for name in ("channels", "twist")}
    assert {"inspection.json", "report.html"} | figures <= set(list_files(folder))
    assert json.loads((folder / "inspection.json").read_text())["gear_ratio"] == pytest.approx(20.0, rel=1e-3)
    # again, and with a gear ratio that it contradicts
    assert call("inspect", "axis.csv")[:2] == (0, lines)
    write_study(tmp_path, small_study({"drive.gear_ratio": 5.0}), "model.toml")
    with pytest.raises(InputError, match=r"axis.csv: theta_e moves 20 for each 1 of theta_s, where gear_ratio is 5"):
        call("inspect", "axis.csv", "--model", "model.toml")


def test_inspect_reads_as_the_model_says_and_leaves_other_results_alone(call, tmp_path):
    simulate_log(count=1000).drop(columns="theta_s").rename(columns={"theta_e": "x"}).to_parquet("axis.parquet")
    (tmp_path / "log.toml").write_text('[log]\ntheta_e = "x"\n')
    assert call("inspect", "axis.parquet", "--model", "log.toml")[0] == 0
    (tmp_path / "part.toml").write_text('include = "log.toml"\ntitle = "my axis"\n')
    assert call("inspect", "axis.parquet", "--model", "part.toml")[0] == 0
    write_study(tmp_path, rigid_study(log={"theta_e": "x"}), "study.toml")
    assert call("inspect", "axis.parquet", "--model", "study.toml")[0] == 0
    (tmp_path / "wrong.toml").write_text('[log]\ntheta_e = { colum = "x" }\n')
    with pytest.raises(InputError, match=r"wrong.toml: log.theta_e: unknown key 'colum'; did you mean 'column'\?"):
        call("inspect", "axis.parquet", "--model", "wrong.toml")
    simulate_log(count=1000).to_csv("axis.csv", index=False)
    with pytest.raises(InputError, match=r"results/axis_inspected: holds results of another log \(.*axis.parquet\)"):
        call("inspect", "axis.csv")
    assert call("inspect", "axis.csv", "--overwrite")[0] == 0
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("mine")
    with pytest.raises(InputError, match="full: is not empty and holds no results"):
        call("inspect", "axis.csv", "--out", "full")
    with pytest.raises(InputError, match=r"none\.csv: no such file"):
        call("inspect", "none.csv")
    assert not (tmp_path / "results" / "none_inspected").exists()


def test_a_transmission_on_a_test_rig_is_identified_and_no_drive(call, tmp_path):
    t = 0.01 * np.arange(1200)
    x = 0.02 * np.sin(2.0 * np.pi * 0.5 * t)
    u = 500.0 * (x - np.clip(x, -0.005, 0.005)) + 0.01 * np.random.default_rng(0).standard_normal(1200)
    for name in ("rig.csv", "again.csv"):
        pd.DataFrame({"t": t, "x": 1e3 * x, "force": u}).to_csv(tmp_path / name, index=False)
    model = write_study(tmp_path, {"log": {"kind": "element", "theta_e": {"column": "x", "unit": "mm"}, "u": "force"}})
    code, out, _ = call("inspect", "rig.csv", "--model", model, "--out", "seen")
    assert code == 0 and out[0].startswith("✓ Good: The log shows ") and "gap" in out[0]
    code, out, err = call("identify", "rig.csv", "--model", model, "--out", "found", "--holdout", "again.csv")
    assert (code, err) == (0, []) and any(line.endswith(" N/m  transmission.stiffness") for line in out)
    parameters = json.loads(Path("found/identification.json").read_text())["parameters"]
    assert json.loads(Path("found/identification.json").read_text())["title"] == "Transmission of rig.csv"
    assert parameters["transmission.half_gap"]["value"] == pytest.approx(0.005, rel=0.01)
    assert tomllib.loads(Path("found/model.toml").read_text())["transmission"]["law"] == "dead_zone"
    assert {"figures/loop.png", "figures/residual.png", "report.html", "trace.parquet"} <= set(list_files(Path("found")))
    with pytest.raises(InputError, match=r"study.toml: log.kind: 'element' is a transmission alone, without the drive"):
        call("diagnose", "rig.csv", "--model", model)
    for extra in (["rig.csv"], ["--profile"], ["--next-experiment", "next.csv"]):
        with pytest.raises(
            InputError, match="of a transmission on a test rig one log is fitted at a time, without --profile"
        ):
            call("identify", "rig.csv", *extra, "--model", model)
    pd.DataFrame({"t": t, "x": t, "force": u}).to_csv("rig.csv", index=False)
    with pytest.raises(InputError, match=r"rig.csv: the displacement never turns back"):
        call("identify", "rig.csv", "--model", model, "--out", "other")


def test_inspect_runs_without_a_word_on_stderr(tmp_path):
    (tmp_path / "log.toml").write_text(tomli_w.dumps({"log": EMPS}))
    result = run_command(
        "inspect", str(find_recording("emps/DATA_EMPS.mat")), "--model", "log.toml", "--out", "out", cwd=tmp_path
    )
    assert (result.returncode, without_progress(result.stderr)) == (0, "")
    assert "the motion spans" in result.stdout


def test_a_refined_sweep_from_the_command_line(call, tmp_path):
    axes = [spaced_axis(LAMBDA, 0.5, 40.0, 3), spaced_axis(ALPHA, 2.0, 200.0, 3)]
    figure = {"kind": "heatmap", "x": ALPHA, "y": LAMBDA, "value": "motor.converged"}
    explicit = {"observer.discretisation": "explicit", "run.duration": 0.1, "run.velocity_tolerance": 0.1}
    write_study(tmp_path, rigid_study(explicit, axes=axes, figures=[figure], sweep={"refine": 3, "chunk": 32}))
    code, lines, _ = call("sweep", "study.toml", "--dry-run")
    assert code == 0
    assert lines[:3] == [
        "points       9 on the coarse grid (9 runs with all seeds)",
        "refinement   at most 289 points; as many as the borders need, not counted below",
        "chunks       1 of 32 lanes",
    ]
    assert all(len(line) <= 80 for line in lines)
    code, first, _ = call("sweep", "study.toml")
    assert code == 0
    assert re.match(r"✓ Good: \d+ runs at \d+ of 289 grid points \([\d.]+ %\): ", first[0])
    _, second, _ = call("sweep", "study.toml")
    assert second == first
    _, plot_lines, _ = call("plot", "results/study_map")
    assert plot_lines == second


# of one length and structure: what one test has compiled serves the others
AXIS = rigid_study(
    {"run.duration": 0.6, "encoders.noise": 1e-5, "excitation.frequency": 4.0, "run.substeps": 2},
    effects=[{"kind": "motor.coulomb_friction", "torque": 0.02}],
    identify={"starts": 1, "window": 0.1},
)


def test_a_log_is_identified(call, tmp_path):
    write_study(tmp_path, AXIS, "axis.toml")
    assert call("simulate", "axis.toml", "--out", "made")[0] == 0
    pd.read_parquet("made/trace.parquet")[["t", "u", "theta_e"]].to_csv("axis.csv", index=False)
    code, lines, _ = call("identify", "axis.csv", "--model", "axis.toml")
    assert code == 0
    assert any(line.endswith(" kg m²  drive.motor_inertia") for line in lines)
    assert lines[-1] == "results/axis_identified/report.html"
    content = json.loads((tmp_path / "results/axis_identified/identification.json").read_text())
    names = ["drive.motor_inertia", "drive.motor_viscous", "effects.motor.coulomb_friction.torque"]
    assert list(content["parameters"]) == names
    finished = (tmp_path / "results/axis_identified/identification.json").stat().st_mtime_ns
    assert call("identify", "axis.csv", "--model", "axis.toml") == (code, lines, [])
    assert (tmp_path / "results/axis_identified/identification.json").stat().st_mtime_ns == finished
    assert call("simulate", "results/axis_identified/model.toml", "--out", "again")[0] == 0
    write_study(tmp_path, AXIS | {"identify": {"parameters": ["drive.mass"]}}, "wrong.toml")
    with pytest.raises(InputError, match=r"^wrong\.toml: 'drive\.mass' is no number of the plant; fitted can be: "):
        call("identify", "axis.csv", "--model", "wrong.toml", "--out", "new")
    with pytest.raises(InputError, match=r"^none\.csv: no such file"):
        call("identify", "none.csv", "--model", "axis.toml", "--out", "new")
    assert not (tmp_path / "new").exists()
    with pytest.raises(InputError, match="results of another log"):
        call("identify", "made/trace.parquet", "--model", "axis.toml", "--out", "results/axis_identified")


IDENTIFY = ["identify", "an axis.csv", "--model", "axis.toml"]


@pytest.fixture
def axis_log(tmp_path):
    """A log and its study."""
    write_study(tmp_path, AXIS, "axis.toml")
    time = np.arange(600) * 1e-3
    # inertia and viscous friction as nominal
    torque = np.cos(20.0 * time) + 0.15 * np.sin(20.0 * time)
    log = pd.DataFrame({"t": time, "u": torque, "theta_e": -0.05 * np.cos(20.0 * time) + 1e-5 * np.cos(1e6 * time)})
    log.to_csv(tmp_path / "an axis.csv", index=False)


INTERRUPTED = "interrupted; nothing was written. Start again with: jaxbl identify 'an axis.csv' --model axis.toml"


def test_an_interrupted_identification_says_how_to_start_again(axis_log, call, tmp_path, monkeypatch):
    monkeypatch.setattr("jaxbl.estimation.identify.run_identification", interrupt)
    options = ["--holdout", "an axis.csv", "--profile"]
    assert call(*IDENTIFY, *options) == (
        130,
        [],
        [f"{INTERRUPTED} {shlex.join(options)} --out 'results/an axis_identified'"],
    )
    assert list_files(tmp_path / "results") == []


def test_an_interrupt_of_the_report_leaves_what_another_call_has_found(axis_log, call, tmp_path, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr("jaxbl.report.page.format_page", interrupt)
        assert call(*IDENTIFY, "--out", "out") == (130, [], [f"{INTERRUPTED} --out out"])
        assert not (tmp_path / "out").exists()
    assert call(*IDENTIFY, "--out", "out")[0] == 0
    before = {name: (tmp_path / "out" / name).read_bytes() for name in list_files(tmp_path / "out")}
    write_study(tmp_path, AXIS | {"title": "another"}, "axis.toml")
    monkeypatch.setattr("jaxbl.report.page.format_page", interrupt)
    assert call(*IDENTIFY, "--out", "out") == (130, [], [f"{INTERRUPTED} --out out"])
    assert {name: (tmp_path / "out" / name).read_bytes() for name in list_files(tmp_path / "out")} == before


def test_an_interrupt_while_numbers_are_sought(axis_log, tmp_path):
    """SIGINT from outside, as soon as the folder is there."""
    folder = tmp_path / "results" / "an axis_identified"
    with start_command(*IDENTIFY, cwd=tmp_path) as process:
        for _ in range(3600):
            if folder.exists() or process.poll() is not None:
                break
            time.sleep(0.05)
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=180)
    assert process.returncode == 130
    command = "jaxbl identify 'an axis.csv' --model axis.toml --out 'results/an axis_identified'"
    assert without_progress(errors) == f"interrupted; nothing was written. Start again with: {command}\n"
    assert not folder.exists()


GAP = {"theta_e": 0.1, "torque_motor": 1.0}
DIAGNOSIS = {
    "title": "",
    "history": [],
    "parameters": {},
    "verdict": "explained",
    "findings": [
        {
            "effect": "motor.coulomb_friction",
            "confidence": 0.97,
            "likely": True,
            "share": 0.12,
            "z": 21.0,
            "parameters": {"torque": {"value": 0.05, "standard_error": 0.001, "unit": "N m"}},
            "alternatives": [],
        }
    ],
    "where": {"motor": {"sentence": "motor side, somewhere"}},
    "contradictions": [],
    "warnings": [],
    "notes": [],
    "gap": {
        "holdout": {"file": "axis.csv", "separate": False, "from": 0.4, "to": 0.6, "window": 0.1},
        "units": {"theta_e": "rad", "torque_motor": "N m"},
        "holdout_rmse_before": GAP,
        "holdout_rmse_after": {"theta_e": 0.001, "torque_motor": 0.01},
        "noise_floor": {"theta_e": 0.001, "torque_motor": 0.01},
        "expected": {"theta_e": {"limit": 0.0012}, "torque_motor": {"limit": 0.02}},
        "test": PASSED,
    },
}


class _Found:
    def __init__(self, task):
        self.summary = DIAGNOSIS | {"identity": task.identity, "file": str(task.record.path.resolve())}


@pytest.fixture
def quick_tasks(monkeypatch):
    """Diagnoses without the computation; returns the tasks that were run."""
    tasks = []

    def run_task(task, progress=None):
        tasks.append(task)
        return _Found(task)

    def report(result, folder, described=None):
        with folder.write_files("diagnosis.json", identity=result.summary["identity"]) as draft:
            (draft / "report.html").write_text("its page")
            (draft / "diagnosis.json").write_text(json.dumps(result.summary))

    monkeypatch.setattr("jaxbl.diagnosis.diagnose.run_diagnosis", run_task)
    monkeypatch.setattr("jaxbl.report.results.write_report", report)
    return tasks


DIAGNOSE = ["diagnose", "an axis.csv", "--model", "axis.toml"]


def test_a_log_is_diagnosed_once(axis_log, quick_tasks, call, tmp_path):
    code, lines, _ = call(*DIAGNOSE, "--next-experiment", "next.csv")
    assert code == 0
    assert lines[0].startswith("✓ Good: The model lacks motor.coulomb_friction; with it, it predicts new data as well as")
    assert lines[2].strip().startswith("next experiment  Nothing is tied") and not (tmp_path / "next.csv").exists()
    figures = [
        "         1 → 0.01 N m  motor: missing torque: rms error on held-out data (limit 0.02)",
        "      0.1 → 0.001 rad  motor position: rms error on held-out data (limit 0.0012)",
        "  0.0500 ± 0.0010 N m  motor.coulomb_friction: torque",
    ]
    assert lines[4:6] == figures[:2]
    run = "jaxbl simulate 'results/an axis_diagnosed/model.toml' --out 'results/an axis_diagnosed_run'"
    assert lines[-2] == f"Next: {run}"
    assert lines[-1] == "results/an axis_diagnosed/report.html"
    code, others, errors = call(*DIAGNOSE)
    assert (code, errors, others[:2], others[2:5]) == (0, [], lines[:2], figures) and others[-2:] == lines[-2:]
    assert len(quick_tasks) == 1
    shutil.copy("an axis.csv", "other.csv")
    with pytest.raises(InputError, match="results of another log"):
        call("diagnose", "other.csv", "--model", "axis.toml", "--out", "results/an axis_diagnosed")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["diagnose", "--model", "axis.toml"], "no log; give one or several"),
        (["diagnose", "an axis.csv"], "no model; give a study"),
        ([*DIAGNOSE, "--holdout", "none.csv", "--out", "new"], r"none\.csv: no such file"),
        ([*DIAGNOSE, "--holdout", "an axis.csv", "--out", "new"], "is the log itself"),
        ([*DIAGNOSE, "--batch", "."], "takes no logs"),
        ([*DIAGNOSE, "--jobs", "2"], "--jobs goes with --batch"),
        ([*DIAGNOSE, "--max-travel", "1"], "--max-travel limits what --next-experiment"),
        ([*DIAGNOSE, "--next-experiment", "next.csv", "--max-torque", "-1"], "--max-torque is -1; it has to be positive"),
        (["diagnose", "--batch", "none"], "none: no such folder"),
        (["diagnose", "--batch", "empty"], "empty: holds no log"),
        (["diagnose", "--batch", "."], r"an axis\.csv: no model; give --model TOML, or an axis\.toml beside it"),
    ],
)
def test_what_cannot_be_diagnosed_is_told(arguments, message, axis_log, quick_tasks, call, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=message) as error:
        call(*arguments)
    assert "\n" not in str(error.value)
    assert not quick_tasks and not (tmp_path / "new").exists()


def test_no_search_starts_on_a_doubtful_log_unless_it_is_forced(axis_log, quick_tasks, call, tmp_path):
    """A torque that is too small by a factor of 20."""
    log = pd.read_csv("an axis.csv")
    log.assign(u=0.05 * log["u"]).to_csv("an axis.csv", index=False)
    for command in (IDENTIFY, DIAGNOSE):
        with pytest.raises(InputError, match=r"an axis\.csv: Doubtful: u .* --force searches all the same$"):
            call(*command, "--out", "new")
    assert not quick_tasks and not (tmp_path / "new").exists()
    code, _, _ = call(*DIAGNOSE, "--force")
    assert code == 0 and len(quick_tasks) == 1


def test_an_interrupted_diagnosis_writes_nothing_and_says_how_to_start_again(axis_log, call, tmp_path, monkeypatch):
    monkeypatch.setattr("jaxbl.diagnosis.diagnose.run_diagnosis", interrupt)
    message = "interrupted; nothing was written. Start again with: jaxbl diagnose 'an axis.csv' --model axis.toml --out out"
    assert call(*DIAGNOSE, "--out", "out") == (130, [], [message])
    assert not (tmp_path / "out").exists()


def test_a_folder_of_logs_is_diagnosed_and_goes_on_where_it_stopped(axis_log, quick_tasks, call, tmp_path):
    (tmp_path / "logs").mkdir()
    for name in ("a.csv", "b.csv"):
        shutil.copy("an axis.csv", tmp_path / "logs" / name)
    (tmp_path / "logs" / "broken.csv").write_text("t,u\n0,1\n")
    # in this process: another one knows nothing of `quick_tasks`
    command = "diagnose", "--batch", "logs", "--model", "axis.toml", "--jobs", "1", "--out"
    code, lines, _ = call(*command, "out")
    assert code == 0
    # what is found may go on below
    assert [line.split()[:2] for line in lines if not line.startswith(" ")][:3] == [
        ["a.csv", "explained"],
        ["b.csv", "explained"],
        ["broken.csv", "refused"],
    ]
    assert lines[-1] == "out/batch.csv"
    table = pd.read_csv("out/batch.csv")
    assert list(table["log"]) == ["a.csv", "b.csv", "broken.csv"] and "broken.csv" in table["refused"][2]
    assert not (tmp_path / "out" / "broken").exists()
    shutil.rmtree(tmp_path / "out" / "b")
    assert call(*command, "out") == (0, lines, [])
    assert len(quick_tasks) == 3
    # a model of its own, and a hold-out log
    shutil.copy("axis.toml", tmp_path / "logs" / "a.toml")
    (tmp_path / "logs" / "b.csv").unlink()
    (tmp_path / "logs" / "broken.csv").rename(tmp_path / "logs" / "a2.csv")
    (tmp_path / "logs" / "a.csv").write_text("t,u\n0,1\n")
    assert call(*command, "again")[0] == 2


def test_one_json_object_has_what_was_found_or_what_is_wrong(call, tmp_path, monkeypatch, capsys):
    write_study(tmp_path)
    code, lines, _ = call("sweep", "study.toml", "--json", "--out", "out")
    content = json.loads("\n".join(lines))
    assert (code, content["command"], content["exit"]) == (0, "sweep", 0)
    assert content["summary"] == {"title": "small", "runs": 3, "finished": True}
    assert (
        content["found"][0].startswith("3 runs: ") and content["verdict"] == "good" and content["open"] == "out/report.html"
    )
    assert [step["command"].split()[1] for step in content["next"]] == ["tune", "explore", "simulate"]
    assert {tuple(step) for step in content["next"]} == {("command", "answers")}
    assert set(content["files"]) == {
        f"out/{name}" for name in list_files(tmp_path / "out") if not name.startswith("points/")
    }
    assert call("sweep", "study.toml", "--quiet", "--out", "out") == (0, [], [])
    monkeypatch.setattr(sys, "argv", ["jaxbl", "sweep", "none.toml", "--json"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    out, errors = capsys.readouterr()
    message = "none.toml: no such file; here are study.toml"
    assert (end.value.code, errors) == (2, f"jaxbl: {message}\n")
    assert json.loads(out) == {"command": "sweep", "exit": 2, "error": message}


def test_completion_knows_the_commands(tmp_path):
    environment = {"_JAXBL_COMPLETE": "complete_bash", "COMP_WORDS": "jaxbl swee", "COMP_CWORD": "1"}
    code = "import sys; sys.argv = ['jaxbl']; from jaxbl.__main__ import program; program()"
    result = run_python("-c", code, cwd=tmp_path, **environment)
    assert result.stdout.split() == ["sweep"]


def test_the_demo_is_the_study_of_the_tree_or_of_the_wheel():
    shipped_study = setup.find_shipped_study("gain_map.toml")
    assert shipped_study.is_file() and shipped_study.name == "gain_map.toml"
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
    files = project["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    assert files == {"sweeps/gain_map.toml": "jaxbl/studies/gain_map.toml"}


def read_steps(content):
    """Command lines of an outcome as JSON, each with its question."""
    return [(step["command"], step["answers"]) for step in json.loads("\n".join(content))["next"]]


def read_page_text(path):
    """The text of a page, with its commands as they are copied."""
    return unescape(re.sub("</?span>", "", Path(path).read_text(encoding="utf-8")))


def test_what_the_demo_says_to_try_next_works_as_it_stands(call, tmp_path, monkeypatch):
    study = write_study(tmp_path, tunable_study() | {"axes": GAINS, "notes": ["The question: which gains?"]}, "a map.toml")
    monkeypatch.setattr(setup, "find_shipped_study", lambda name: study)
    code, lines, _ = call("demo", "--out", "results/a map")
    assert code == 0 and lines[-1] == "results/a map/report.html"
    steps = read_steps(call("demo", "--out", "results/a map", "--json")[1])
    assert lines[-2] == f"Next: {steps[0][0]}"
    assert [shlex.split(command)[1] for command, _ in steps] == ["tune", "explore", "simulate", "init"]
    page = read_page_text("results/a map/report.html")
    assert all(text in page for text in ("The question: which gains?", *chain(*steps)))
    # another page of the same study says the same
    assert read_steps(call("plot", "results/a map", "--json")[1]) == steps[:-1]
    for command, _ in steps[:-1]:
        words = shlex.split(command)[1:]
        # else it serves the page until it is ended
        code, lines, _ = call(*words, *(["--static", "page"] if words[0] == "explore" else []))
        assert code == 0 and Path(lines[-1]).is_file()
    # the last one asks; who has such a file is not told to write it
    with pytest.raises(InputError, match="numbers are missing"):
        call(*shlex.split(steps[-1][0])[1:])
    write_study(tmp_path, name="drive.toml")
    assert len(read_steps(call("demo", "--out", "results/a map", "--json")[1])) == 3


def test_after_logs_what_is_open_by_what_was_found():
    logs, model, folder = [Path("a b.csv")], Path("m.toml"), Path("out")
    command = ["diagnose", "a b.csv", "--model", "m.toml", "--out", "out"]

    def make_task(samples, parts=1, missing=("excitation",)):
        cut = tuple(slice(i * samples // parts, (i + 1) * samples // parts) for i in range(parts))
        return SimpleNamespace(record=SimpleNamespace(segments=cut), missing=frozenset(missing))

    def list_commands(steps):
        assert steps[-1].command == "jaxbl explore out"
        return [step.command for step in steps[:-1]]

    def identify_steps(rms, task=None, holdout=None, planned_file=None, **more):
        summary = {"residual": {"motor": {"rms": rms, "noise": 1.0}}} | more
        return list_commands(
            after_identification(
                task or make_task(1000), summary, LogCall(logs, model, holdout, planned_file, folder, command)
            )
        )

    diagnose = "jaxbl diagnose 'a b.csv' --model m.toml"
    simulate = "jaxbl simulate out/model.toml --out out_run"
    assert identify_steps(3.0) == [f"{diagnose} --out out_diagnosed"]
    # too short to hold a quarter out, but for another log
    assert identify_steps(3.0, make_task(300)) == []
    assert identify_steps(3.0, make_task(300), Path("b.csv")) == [f"{diagnose} --holdout b.csv --out out_diagnosed"]
    assert identify_steps(1.0) == [simulate]
    # the input of a log with gaps cannot be played back; that of the study can
    assert identify_steps(1.0, make_task(1000, 2)) == [] and identify_steps(1.0, make_task(1000, 2, ())) == [simulate]
    unseen = {"backlash": {"shown": False}}
    assert identify_steps(1.0, **unseen) == [simulate, f"{diagnose} --out out --next-experiment out_next.csv"]
    assert (
        identify_steps(1.0, planned_file=Path("n.csv"), **unseen)
        == identify_steps(1.0, backlash={"shown": True})
        == [simulate]
    )

    def diagnose_steps(planned_file=None, **more):
        return list_commands(
            after_diagnosis(make_task(1000), DIAGNOSIS | more, LogCall(logs, model, None, planned_file, folder, command))
        )

    assert diagnose_steps() == [simulate]
    long = {"effect": "transmission.rotational_friction_of_somebody_elses_package", "confidence": 0.5}
    tied = [DIAGNOSIS["findings"][0] | {"alternatives": [long]}]
    experiment = f"{diagnose} --out out --next-experiment out_next.csv"
    assert diagnose_steps(findings=tied, rival=long) == [experiment, simulate]
    assert diagnose_steps(Path("n.csv"), findings=tied, rival=long) == [simulate]
    nothing = {"findings": [], "verdict": "no_discrepancy"}
    assert diagnose_steps(**nothing) == ["jaxbl identify 'a b.csv' --model m.toml --out out_identified"]
    assert diagnose_steps(findings=[], verdict="unknown_effect") == []


def test_after_runs_and_searches_what_to_do_with_the_gains():
    good, failed, file, folder = Result("t", "good", "."), Result("t", "failed", "."), Path("a b.toml"), Path("out")
    ((tune, _),) = after_run(good, file)
    assert tune == "jaxbl tune 'a b.toml'" and after_run(failed, file) == [NextStep(tune, "Which gains surely converge?")]
    assert [step.command for step in after_tuning(good, file, folder)] == [
        "jaxbl simulate 'a b.toml' --gains out/gains.toml --out out_run",
        "jaxbl export 'a b.toml' --gains out/gains.toml --out out_code",
    ]
    assert after_tuning(failed, file, folder) == []
    assert [step.command for step in after_comparison(failed, folder)] == ["jaxbl explore out"]
    assert after_comparison(Result("t", "no answer", "."), folder) == []


def test_the_page_of_an_inspected_log_says_how_to_go_on(call):
    simulate_log(count=6000, gap=0.1, noise=1e-4).to_csv("axis.csv", index=False)
    assert call("inspect", "axis.csv")[0] == 0
    ((command, _),) = after_inspection(Path("axis.csv"), None)
    page = read_page_text("results/axis_inspected/report.html")
    assert command == "jaxbl inspect axis.csv --write axis.toml" and command in page
    ((command, _),) = after_inspection(Path("axis.csv"), Path("m.toml"))
    assert command == "jaxbl identify axis.csv --model m.toml"


def test_commands_are_named_as_a_shell_finds_them(tmp_path, monkeypatch):
    folder = tmp_path / "my venv" / "bin"
    folder.mkdir(parents=True)
    for name in ("jaxbl", "python"):
        (folder / name).touch(0o755)
    monkeypatch.setattr(sys, "executable", str(folder / "python"))
    monkeypatch.setenv("PATH", str(folder))
    assert program_name() == "jaxbl"
    # `make demo` runs what is in a folder that the shell does not search
    monkeypatch.setenv("PATH", "/nowhere")
    assert program_name() == shlex.quote(str(folder / "jaxbl"))
    monkeypatch.chdir(tmp_path)
    assert program_name() == "'my venv/bin/jaxbl'"
    (folder / "jaxbl").unlink()
    assert program_name() == f"{shlex.quote(str(folder / 'python'))} -m jaxbl"
