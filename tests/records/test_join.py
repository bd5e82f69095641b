"""Several logs as one record."""

import numpy as np
import pytest
from measured import made

from jaxbl.errors import InputError
from jaxbl.records import join, read_record


@pytest.fixture
def logs(tmp_path):
    def write(name, **how):
        made(**how).to_csv(tmp_path / name, index=False)
        return read_record(tmp_path / name)

    return write


def test_each_log_is_a_segment_with_its_own_rows(logs):
    first, second = logs("a.csv", count=1500), logs("b.csv", count=2500, seed=1)
    both = join([first, second])
    assert len(both.time) == 4000
    assert [(part.start, part.stop) for part in both.segments] == [(0, 1500), (1500, 4000)]
    assert np.all(np.diff(both.time) > 0.0)
    assert both.time[1500] > both.time[1499] + 5.0 * both.sample_period
    for side in ("motor", "load"):
        np.testing.assert_array_equal(both.positions[side][1500:], second.positions[side])
    np.testing.assert_array_equal(both.torque, np.concatenate([first.torque, second.torque]))
    assert both.notes[0] == "2 logs, one after the other: a.csv, b.csv."
    assert join([first]) is first


def test_logs_that_are_not_alike(logs, tmp_path):
    first, slow = logs("a.csv"), logs("slow.csv", period=2e-3)
    with pytest.raises(
        InputError, match=r"slow\.csv: is sampled every 0\.002 s, .*a\.csv every 0\.001 s; \[log\] resample = "
    ):
        join([first, slow])
    made().drop(columns="u").to_csv(tmp_path / "free.csv", index=False)
    free = read_record(tmp_path / "free.csv", {"absent": ["u"]})
    with pytest.raises(InputError, match=r"free\.csv: has no torque, which .*a\.csv has"):
        join([first, free])
