"""Commands that run several studies: damage to manifests and tables, folders of others, programs that studies share."""

import pandas as pd
import pytest
from small_study import ALPHA, LAMBDA, listed_axis, read_parts, rigid_study, thirty_run_study

from jaxbl.config import read_config
from jaxbl.errors import InputError
from jaxbl.files import MANIFEST, ResultFolder
from jaxbl.gains.stages import open_stages
from jaxbl.sweeps import programs
from jaxbl.sweeps.store import study_subject
from jaxbl.sweeps.sweep import sweep


def run_stage(folder, changes=None, **options):
    """One stage, with a pilot's number and a table; returns the lanes that were computed, what was found, and the table."""
    study = read_config(thirty_run_study(**(changes or {})))
    with open_stages(study, "tune", folder, None, **options) as stages:
        manifest = dict(stages.manifest)
        stages.write_manifest(pilot=1.5)
        table = stages.read_or_compute("table.parquet", lambda: pd.DataFrame({"x": [1.0, 2.0]}))
        stages.run(study, "coarse")
        return stages.cost["lanes"], manifest, table


def test_a_damaged_manifest_is_written_anew_where_that_is_asked_for(tmp_path):
    assert run_stage(tmp_path)[0] == 30
    path = tmp_path / MANIFEST
    before = path.read_bytes()
    path.write_bytes(before[: len(before) // 2])
    with pytest.raises(InputError, match=r"manifest\.json: is damaged \(.*\); begin anew with --overwrite"):
        run_stage(tmp_path)
    # what it said is found again; the stage's parts are there
    lanes, manifest, _ = run_stage(tmp_path, overwrite=True)
    assert (lanes, manifest) == (0, {})
    assert path.read_bytes() == before
    lanes, manifest, _ = run_stage(tmp_path)
    assert lanes == 0 and manifest["pilot"] == 1.5


def test_a_lost_manifest_does_not_make_the_folder_anothers(tmp_path):
    run_stage(tmp_path)
    path = tmp_path / MANIFEST
    path.unlink()
    with pytest.raises(InputError, match="is not empty and holds no results"):
        run_stage(tmp_path)
    results = ResultFolder(tmp_path, study_subject(read_config(thirty_run_study(encoders={"noise": 1e-3}))))
    results.write_manifest()
    before = read_parts(tmp_path / "tune" / "coarse")
    with pytest.raises(InputError, match=r"(belongs to|holds results of) another study"):
        run_stage(tmp_path, {"encoders": {"noise": 1e-3}})
    (tmp_path / "tune" / "table.parquet").unlink()
    with pytest.raises(InputError, match="holds results of another study"):
        run_stage(tmp_path, {"encoders": {"noise": 1e-3}})
    assert read_parts(tmp_path / "tune" / "coarse") == before
    # tables that are in the way are written over, too
    assert list(run_stage(tmp_path, overwrite=True)[2]["x"]) == [1.0, 2.0]


def test_a_damaged_table_is_computed_anew(tmp_path):
    run_stage(tmp_path)
    path = tmp_path / "tune" / "table.parquet"
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 1
    path.write_bytes(content)
    assert list(run_stage(tmp_path)[2]["x"]) == [1.0, 2.0]


def test_stages_share_programs_where_values_of_lanes_alone_differ(monkeypatch):
    """The third one has another drive, and figures of all are those of studies by themselves."""
    compiled = []
    monkeypatch.setattr(
        programs,
        "_compile_fused",
        lambda *options, compile_fused=programs._compile_fused: compiled.append(options) or compile_fused(*options),
    )
    axes = [[listed_axis(ALPHA, *alphas), listed_axis(LAMBDA, 1.0)] for alphas in ((5.0, 20.0), (7.0, 30.0), (5.0, 20.0))]
    inertias = 0.05, 0.05, 0.06
    studies = [
        rigid_study({"drive.motor_inertia": path}, axes=study_axes) for path, study_axes in zip(inertias, axes, strict=True)
    ]
    with open_stages(read_config(studies[0]), "tune", None, None, backend="fused") as stages:
        manifest = [stages.run(study, str(i)).frame for i, study in enumerate(studies)]
    assert len(compiled) == 2
    for frame, study in zip(manifest, studies, strict=True):
        pd.testing.assert_frame_equal(frame, sweep(study, backend="fused").frame, check_exact=True)
    assert len(compiled) == 5
