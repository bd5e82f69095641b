"""From gains to the drive and back: `tune`, `export`, a C compiler, and the log through the compiled code, beside the chain
that `identify` runs on the same log."""

import jax
import numpy as np
import pandas as pd
import pytest
import tomli_w
from native import STRICT, UNCONTRACTED, run_program
from small_study import multisine_study

from jaxbl.cli import app, main
from jaxbl.config import read_config
from jaxbl.estimation.log_columns import observer_chain
from jaxbl.estimation.logs import on_record, read_logs
from jaxbl.estimation.segments import segments_of
from jaxbl.sweeps.trial import run

TUNE = {"num": 4, "refine": 0, "alpha_ratio": {"start": 1.2, "stop": 6.0}, "lambda_ratio": {"start": 1.5, "stop": 6.0},
        "margin_exact": 1.05, "margin_alpha": 1.05}  # fmt: skip
TOLERANCES = {"run.position_tolerance": 0.05, "run.velocity_tolerance": 5.0}


def run_command(*words):
    main(lambda: app([*map(str, words)], standalone_mode=False))


@pytest.mark.program("gcc")
def test_tuned_gains_come_back_from_the_compiled_code_as_in_identify(tmp_path):
    # at ten times the noise the load's observer amplifies XLA's joined products to 1e-7 of the torque's rms
    data = multisine_study(2.0, tune=TUNE, encoders={"noise": 1e-5})
    for path, value in TOLERANCES.items():
        table, key = path.split(".")
        data[table][key] = value
    study = tmp_path / "axis.toml"
    study.write_text(tomli_w.dumps(data))
    before = read_config(study).to_dict()["observer"]
    run_command("tune", study, "--out", tmp_path / "tuned", "--quiet")

    tuned = tmp_path / "tuned_axis.toml"
    gains_alone = {key: value for key, value in data.items() if key not in ("observer", "tune")}
    tuned.write_text(tomli_w.dumps({"include": ["axis.toml", "tuned/gains.toml"]} | gains_alone))
    config = read_config(tuned)
    after = config.to_dict()["observer"]
    assert all(after[side]["alpha"] != before[side]["alpha"] for side in ("motor", "load"))

    log = tmp_path / "log.csv"
    run(config, seed=3).trace[["t", "u", "theta_e", "theta_s"]].to_csv(log, index=False)
    code = tmp_path / "code"
    run_command("export", tuned, "--target", "c", "--precision", "double", "--name", "axis", "--out", code, "--quiet")
    run_program("gcc", *STRICT, *UNCONTRACTED, "-O2", "axis.c", "axis_filter.c", "-lm", "-o", "axis_filter", cwd=code)
    run_program("./axis_filter", log, "filtered.csv", cwd=code)
    frame = pd.read_csv(code / "filtered.csv")

    with jax.enable_x64(True):
        record = read_logs(config, log)
        experiment = on_record(config, record)
        columns, identified = observer_chain(experiment, segments_of(record, experiment.sides, False), len(record.time))
    assert len(frame) == len(record.time)
    for side in ("motor", "load"):
        torque = columns[f"{side}.torque_estimate"]
        rms = float(np.sqrt(np.mean(torque**2)))
        assert rms > 0.1
        np.testing.assert_allclose(frame[f"{side}_torque_estimate"], torque, rtol=0.0, atol=1e-9 * rms)
        assert frame[f"{side}_identified"].iloc[-1] == 1
        for name in ("stiffness", "half_gap"):
            assert frame[f"{side}_{name}"].iloc[-1] == pytest.approx(identified[name][side], rel=1e-7)
