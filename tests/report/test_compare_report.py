"""What `jaxbl compare` leaves."""

import json
import shutil

import pytest
from small_study import ALPHA, LAMBDA, listed_axis, rigid_study, spaced_axis
from test_page import Page

from jaxbl import cli
from jaxbl.config import read_config
from jaxbl.files import ResultFolder
from jaxbl.sweeps.sweep import sweep


@pytest.fixture
def run_command(monkeypatch, capsys):
    """Exit code and output of a command."""

    monkeypatch.setattr("jaxbl.workers.start_jax", lambda: None)

    def run(*words):
        monkeypatch.setattr("sys.argv", ["jaxbl", *map(str, words)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        return end.value.code or 0, "".join(capsys.readouterr())

    return run


AXES = [spaced_axis(ALPHA, 5.0, 20.0, 3), listed_axis(LAMBDA, 4.0, 8.0)]


@pytest.fixture(scope="module")
def studies_folder(tmp_path_factory):
    """Two studies, of which the second moves further at more points."""
    folder = tmp_path_factory.mktemp("studies")
    wider_axes = [spaced_axis(ALPHA, 5.0, 80.0, 5), AXES[1]]
    for name, axes, amplitude in (("before", AXES, 0.1), ("after", wider_axes, 0.4)):
        study = rigid_study({"excitation.amplitude": amplitude, "title": name}, axes=axes, sweep={"seeds": 4})
        sweep(read_config(study), folder / name, backend="scan")
    return folder


def test_command_writes_text_json_and_figure(studies_folder, run_command):
    words = ["compare", str(studies_folder / "before"), str(studies_folder / "after"), "--out", str(studies_folder / "both")]
    code, output = run_command(*words)
    assert code == 0, output
    lines = output.splitlines()
    assert len(lines) <= 8 and all(len(line) <= 100 for line in lines[:-1])
    assert "metrics differ by more than noise" in output and "Points: 6 in both; 0 in the first alone" in output
    page = Page((studies_folder / "both" / "report.html").read_text()).text
    for text in ("excitation.amplitude", "motor.f_plus_acceleration", "Noise: by differences seed by seed, 4 seeds"):
        assert text in page
    data = json.loads((studies_folder / "both" / "comparison.json").read_text())
    assert data["config"]["excitation.amplitude"] == [0.1, 0.4]
    assert data["points"] == {"both": 6, "first_only": 0, "second_only": 4}
    sizes = next(metric for metric in data["metrics"] if metric["metric"] == "motor.f_plus_acceleration")
    # the acceleration of a linear drive is in proportion to its input
    assert (sizes["points"], sizes["differs"], sizes["up"]) == (6, 6, 6)
    assert sizes["moved"]["value"] == pytest.approx(4.0, rel=1e-6)
    assert (studies_folder / "both" / "figures" / "factors.png").stat().st_size > 5000
    # again into the same folder, without a difference now: no figure is left
    code, output = run_command(
        "compare", str(studies_folder / "before"), str(studies_folder / "before"), "--out", str(studies_folder / "both")
    )
    assert code == 0, output
    assert output.startswith("✓ Good: No metric differs by more than noise at 6 common points.")
    assert "The configs differ in nothing that decides a number." in output
    assert not list((studies_folder / "both" / "figures").iterdir())


def test_unfinished_studies_are_compared_as_far_as_they_are(studies_folder, tmp_path, run_command):
    shutil.copytree(studies_folder / "before", tmp_path / "part")
    results = ResultFolder.read(tmp_path / "part")
    results.entries["sweep"] |= {"rows": 48, "parts": 2, "finished": False}
    results.write_manifest()
    code, output = run_command(
        "compare", str(studies_folder / "before"), str(tmp_path / "part"), "--out", str(tmp_path / "out")
    )
    assert code == 0, output
    assert "is not finished: 24 of 48 runs are compared." in " ".join(output.split())


@pytest.mark.parametrize(
    ("second", "out", "message"),
    [
        ("nothing", "new", "nothing: holds no study (no manifest.json of a sweep); run 'jaxbl sweep' first"),
        ("after", "before", "before: holds results of a study (before); choose another folder with --out"),
    ],
)
def test_bad_input(studies_folder, run_command, second, out, message):
    code, output = run_command(
        "compare", str(studies_folder / "before"), str(studies_folder / second), "--out", str(studies_folder / out)
    )
    assert code == 2
    assert message in output
    assert not (studies_folder / "new").exists()
