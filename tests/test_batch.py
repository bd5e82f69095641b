"""A batch of diagnoses: the rows of its table, and how the terminal shows them."""

import math
from pathlib import Path

import pandas as pd
import pytest

from jaxbl import batch
from jaxbl.batch import format_batch, make_batch_row, read_batch, run_batch
from jaxbl.errors import InputError

DIAGNOSIS = {
    "verdict": "explained",
    "findings": [{"effect": "load.coulomb_friction", "confidence": 0.93}],
    "gap": {
        "holdout_rmse_before": {"theta_e": 0.1, "theta_s": 0.02},
        "holdout_rmse_after": {"theta_e": 0.0011, "theta_s": 0.00022},
        "noise_floor": {"theta_e": 0.001, "theta_s": 0.0002},
    },
}


def test_a_batch_is_a_table(tmp_path):
    rows = [
        make_batch_row(tmp_path / "a.csv", DIAGNOSIS),
        make_batch_row(tmp_path / "long.csv", None, "long.csv: holds nothing"),
    ]
    lines = format_batch(rows)
    assert lines == ["a.csv     explained  load.coulomb_friction (0.93)", "long.csv  refused    long.csv: holds nothing"]
    table = pd.DataFrame(rows)
    assert list(table["log"]) == ["a.csv", "long.csv"]
    assert table["theta_s_before"][0] == 0.02 and math.isnan(table["theta_s_before"][1])


def test_its_table_fits_a_terminal_with_long_names(tmp_path):
    names = [f"transmission.friction_of_{'another_' * i}package" for i in range(1, 5)]
    many_findings = DIAGNOSIS | {"findings": [{"effect": name, "confidence": 0.5} for name in names]}
    rows = [
        make_batch_row(tmp_path / name, result, refused)
        for name in ("a.csv", f"{'machine_' * 6}7.csv")
        for result, refused in (
            (many_findings, ""),
            (DIAGNOSIS, ""),
            (None, f"a.csv: {'columns should have other names; ' * 9}"),
        )
    ]
    lines = format_batch(rows)
    assert all(len(line) <= 80 for line in lines) and all(name in " ".join(lines) for name in names)
    # without the longest name of a file a row begins on one line with what was found
    assert format_batch(rows[:3])[0].startswith("a.csv  explained  transmission.friction_of_another_package;")


def test_every_kind_of_log_is_found_and_what_is_none_is_told(tmp_path):
    for name in (
        "a.csv",
        "b.txt",
        "c.tdms",
        "d.JSON",
        "e/metadata.yaml",
        "f.pdf",
        "a.toml",
        ".hidden",
        "holdout/b.dat",
        "g/x.csv",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    work, skipped = read_batch(tmp_path, tmp_path / "a.toml", tmp_path / "out", overwrite=False)
    assert [job.log.name for job in work] == ["a.csv", "b.txt", "c.tdms", "d.JSON", "e"]
    assert work[1].holdout == tmp_path / "holdout" / "b.dat"
    assert skipped == ["f.pdf", "g"]


def _make_row(job):
    assert all(path.is_absolute() for path in (job.log, job.model, job.folder))
    return make_batch_row(job.log, DIAGNOSIS)


def test_a_clusters_workers_diagnose(tmp_path, client, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a.csv", "b.csv", "c.csv", "a.toml"):
        (tmp_path / name).write_text("")
    work, _ = read_batch(Path(), Path("a.toml"), Path("out"), overwrite=False)
    calls = []
    monkeypatch.setattr(batch, "_diagnose_log", _make_row)
    rows = run_batch(work, Path("out"), None, lambda *done: calls.append(done), client)
    assert [row["log"] for row in rows] == ["a.csv", "b.csv", "c.csv"]
    assert calls == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert list(pd.read_csv("out/batch.csv")["verdict"]) == ["explained"] * 3


def test_a_damaged_manifest_is_made_anew_with_overwrite(tmp_path, monkeypatch):
    (tmp_path / "a.csv").write_text("")
    monkeypatch.setattr(batch, "_diagnose_log", _make_row)
    work, _ = read_batch(tmp_path, tmp_path / "a.toml", tmp_path / "out", overwrite=False)
    run_batch(work, tmp_path / "out", 1, lambda *done: None)
    manifest = tmp_path / "out" / "manifest.json"
    whole = manifest.read_bytes()
    manifest.write_bytes(whole[:-20])
    with pytest.raises(InputError, match=r"is damaged .* begin anew with --overwrite"):
        run_batch(work, tmp_path / "out", 1, lambda *done: None)
    run_batch([job._replace(overwrite=True) for job in work], tmp_path / "out", 1, lambda *done: None)
    assert manifest.read_bytes() == whole
