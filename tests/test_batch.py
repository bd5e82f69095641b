"""A batch of diagnoses: the rows of its table, and how the terminal shows them."""

import math

import pandas as pd

from jaxbl.batch import batch_lines, batch_row

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
    rows = [batch_row(tmp_path / "a.csv", DIAGNOSIS), batch_row(tmp_path / "long.csv", None, "long.csv: holds nothing")]
    lines = batch_lines(rows)
    assert lines[0] == "a.csv     explained       load.coulomb_friction (0.93)  theta_e 0.1 -> 0.0011 (0.001)"
    assert lines[1] == "long.csv  refused         long.csv: holds nothing"
    table = pd.DataFrame(rows)
    assert list(table["log"]) == ["a.csv", "long.csv"]
    assert table["theta_s_before"][0] == 0.02 and math.isnan(table["theta_s_before"][1])
