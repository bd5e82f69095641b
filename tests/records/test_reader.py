"""From columns to evenly spaced SI channels, and what is said of logs that are not fit for it."""

import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings, strategies as st
from measured import COULOMB, EMPS, GEAR_RATIO, INERTIA, SERVO, VISCOUS, XL330, find_recording, simulate_log
from small_study import small_study

from jaxbl.errors import InputError
from jaxbl.lines import DOUBT
from jaxbl.records import LogTable, NominalDrive, join_records, read_log_table, read_record
from jaxbl.sweeps.trial import run


def write_frame(tmp_path, frame, name="log.parquet"):
    path = tmp_path / name
    frame.to_parquet(path) if path.suffix == ".parquet" else frame.to_csv(path, index=False)
    return path


def test_a_log_in_si_units_is_read_as_it_stands(tmp_path):
    frame = simulate_log()
    record = read_record(write_frame(tmp_path, frame), gear_ratio=GEAR_RATIO)
    np.testing.assert_allclose(record.time, frame["t"], atol=1e-12)
    np.testing.assert_array_equal(record.torque, frame["u"])
    np.testing.assert_array_equal(record.positions["motor"], frame["theta_e"])
    np.testing.assert_array_equal(record.positions["load"], frame["theta_s"])
    assert record.sample_period == pytest.approx(1e-3, rel=1e-12)
    assert record.segments == (slice(0, 4000),)
    assert (record.start, record.closed_loop, record.transmitted, record.notes) == (0.0, None, None, ())
    assert record.statistics.sampling.even
    # the rough regression finds the drive that made the log
    statistics = dict(zip(record.statistics.dynamics.names, record.statistics.dynamics.values, strict=True))
    assert statistics["inertia"] == pytest.approx(INERTIA, rel=0.01)
    assert statistics["viscous"] == pytest.approx(VISCOUS, rel=0.02)
    assert statistics["coulomb"] == pytest.approx(COULOMB, rel=0.1)
    assert abs(record.statistics.channels["u"].skew) < 1e-4


def test_what_simulate_leaves_is_a_log(tmp_path):
    changes = {"run.duration": 1.0, "encoders.motor_resolution": 1e-4, "encoders.load_resolution": 1e-5}
    trial = run(small_study(changes))
    record = read_record(write_frame(tmp_path, trial.trace), trial.config.log, gear_ratio=5.0)
    np.testing.assert_array_equal(record.torque, trial.trace["u"])
    assert record.statistics.channels["theta_e"].resolution == pytest.approx(1e-4)
    assert record.statistics.channels["theta_s"].resolution == pytest.approx(1e-5)


UNIT_SIZES = {"rad": 1.0, "deg": math.pi / 180.0, "turn": 2.0 * math.pi, "m": 1.0, "mm": 1e-3}


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_positions_survive_units_signs_wraps_and_words(tmp_path_factory, data):
    truth = simulate_log(count=400, period=2e-3)
    unit = data.draw(st.sampled_from([*UNIT_SIZES, "counts"]))
    sign = data.draw(st.sampled_from([1, -1]))
    factor = data.draw(st.sampled_from([1.0, 0.5, 3.0]))
    counts = data.draw(st.sampled_from([4096.0, 20000.0]))
    log = {"column": "x", "unit": unit, "sign": sign, "factor": factor, "offset": 2.0}
    unit_size = 2.0 * math.pi / counts if unit == "counts" else UNIT_SIZES[unit]
    column = (truth["theta_e"].to_numpy() - 2.0) * sign / unit_size / factor
    step = 0.0
    if unit == "counts":
        log["counts_per_turn"] = counts
        column, step = np.round(column), unit_size * factor
        if data.draw(st.booleans()):
            # a counter of 18 bits, and the word logged as unsigned: it wraps around
            log |= {"wrap": 2.0**18, "signed_bits": 18}
            column = column % 2.0**18
        elif data.draw(st.booleans()):
            log["signed_bits"] = 32
            column = column % 2.0**32
    elif data.draw(st.booleans()):
        wrap = 1.1 * np.abs(np.diff(column)).max() * 2.0
        log["wrap"] = float(wrap)
        column = column % wrap
    if data.draw(st.booleans()):
        other = np.arange(len(column)) % 7.0
        column, log = column + other, log | {"minus": "other"}
        if "signed_bits" in log or "wrap" in log:
            log.pop("minus")
            column = column - other
    truth = truth.assign(x=column, other=np.arange(len(column)) % 7.0)
    path = write_frame(tmp_path_factory.mktemp("units"), truth)
    absent = ["theta_s"] + (["u"] if unit in ("m", "mm") else [])
    record = read_record(path, {"theta_e": log, "absent": absent})
    motion = record.positions["motor"] - truth["theta_e"].to_numpy()
    # where a wrapped position starts is not known
    motion -= (
        round(motion[0] / (unit_size * factor * log["wrap"])) * unit_size * factor * log["wrap"] if "wrap" in log else 0.0
    )
    np.testing.assert_allclose(motion, 0.0, atol=0.5 * step + 1e-6)
    assert record.statistics.channels["theta_e"].unit == ("m" if unit in ("m", "mm") else "rad")


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(["N m", "V", "A", "counts"]), st.floats(0.01, 100.0), st.sampled_from([1, -1]), st.floats(-1.0, 1.0),
    st.sampled_from(["", "signed_bits", "sign_bit"]), st.integers(15, 20),
)  # fmt: skip
def test_torques_survive_units_signs_and_words(tmp_path_factory, unit, factor, sign, offset, words, sign_bit):
    truth = simulate_log(count=400, period=2e-3)
    log = {"column": "x", "unit": unit, "factor": factor, "sign": sign, "offset": offset}
    column = (truth["u"].to_numpy() - offset) * sign / factor
    step = 0.0
    if words:
        log["factor"] = factor = 1e-4
        column, step = np.round((truth["u"].to_numpy() - offset) * sign / 1e-4), 1e-4
        if np.abs(truth["u"] - offset).max() > 3.2:
            return
        log[words] = sign_bit + (words == "signed_bits")
        column = column % 2.0 ** (sign_bit + 1) if words == "signed_bits" else np.abs(column) + (column < 0) * 2.0**sign_bit
    path = write_frame(tmp_path_factory.mktemp("units"), truth.assign(x=column))
    record = read_record(path, {"u": log})
    np.testing.assert_allclose(record.torque, truth["u"], atol=0.5 * step + 1e-9)


def test_linear_axes_measure_force(tmp_path):
    frame = simulate_log().drop(columns="theta_s")
    record = read_record(write_frame(tmp_path, frame), {"theta_e": {"unit": "m"}})
    assert [record.statistics.channels[name].unit for name in ("u", "theta_e")] == ["N", "m"]
    with pytest.raises(
        InputError, match=r"\[log\] u.unit is N m, but the position is in m; on a linear axis it should be N"
    ):
        read_record(write_frame(tmp_path, frame), {"theta_e": {"unit": "m"}, "u": {"unit": "N m"}})


def test_stamps_in_other_units_and_none_at_all(tmp_path):
    frame = simulate_log()
    for unit, unit_size in {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}.items():
        path = write_frame(tmp_path, frame.assign(t=(frame["t"] + 7.0) * unit_size))
        record = read_record(path, {"t": {"column": "t", "unit": unit}})
        assert record.start == pytest.approx(7.0)
        np.testing.assert_allclose(record.time, frame["t"], atol=1e-8)
    record = read_record(write_frame(tmp_path, frame.drop(columns="t")), {"t": {"period": 2e-3}})
    np.testing.assert_allclose(record.time, 2.0 * frame["t"], atol=1e-9)


def test_rounded_stamps_are_an_even_grid(tmp_path):
    frame = simulate_log(period=1.25e-3)
    for step in (1e-3, 5e-3):
        stamps = np.floor(frame["t"] / step + 1e-9) * step
        record = read_record(write_frame(tmp_path, frame.assign(t=stamps)), gear_ratio=GEAR_RATIO)
        assert record.statistics.sampling.even and record.statistics.sampling.repeated == 0
        assert record.sample_period == pytest.approx(1.25e-3, rel=1e-4)
        np.testing.assert_array_equal(record.torque, frame["u"])


def uneven_times(seed=1, count=4000):
    return np.cumsum(1e-3 * np.random.default_rng(seed).uniform(0.7, 1.4, count))


def test_uneven_stamps_are_resampled_to_their_median_period(tmp_path):
    times = uneven_times()
    record = read_record(write_frame(tmp_path, simulate_log(times)), gear_ratio=GEAR_RATIO)
    truth = simulate_log(times[0] + record.time)
    assert record.sample_period == record.statistics.sampling.median_period == pytest.approx(np.median(np.diff(times)))
    assert not record.statistics.sampling.even
    assert any(note.startswith("Resampled from uneven stamps: every 1.0") for note in record.notes)
    np.testing.assert_allclose(np.diff(record.time), record.sample_period, rtol=1e-9)
    np.testing.assert_allclose(record.positions["motor"], truth["theta_e"], atol=1e-8)
    assert len(record.intervals) == 3999


def test_resampling_keeps_the_impulse_of_a_held_torque(tmp_path):
    times = uneven_times()
    frame = simulate_log(times)
    for period in (None, 5e-4, 3.7e-3):
        record = read_record(write_frame(tmp_path, frame), {"resample": period} if period else None)
        assert record.sample_period == (period or record.statistics.sampling.median_period)
        impulse = np.concatenate([[0.0], np.cumsum(frame["u"].to_numpy()[:-1] * np.diff(times))])
        ends = record.time + times[0]
        expected = np.interp(ends, times, impulse)
        np.testing.assert_allclose(np.cumsum(record.torque)[:-1] * record.sample_period, expected[1:], atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**16), st.floats(0.05, 0.45))
def test_resampled_positions_are_accurate_to_the_fourth_order(tmp_path_factory, seed, jitter):
    folder = tmp_path_factory.mktemp("jitter")
    errors = []
    for period in (8e-3, 4e-3):
        times = period * (np.arange(round(4.0 / period)) + jitter * np.random.default_rng(seed).uniform(-1.0, 1.0))
        record = read_record(write_frame(folder, simulate_log(times)), {"resample": period, "absent": ["theta_s"]})
        inner = slice(20, -20)
        truth = simulate_log(times[0] + record.time)["theta_e"].to_numpy()
        errors.append(np.abs(record.positions["motor"] - truth)[inner].max())
    # h⁴ (5/384) of the fourth derivative, about 4 (2π 2.1)⁴, and the others'
    assert errors[0] < 4e-5
    assert errors[1] < max(errors[0] / 8.0, 1e-9)


def test_rows_that_are_missing_are_counted(tmp_path):
    frame = simulate_log()
    record = read_record(write_frame(tmp_path, frame.drop(index=[100, 200, 201])), gear_ratio=GEAR_RATIO)
    assert "3 rows are missing, after data row 100 first; they are interpolated." in record.notes
    jitter = 2e-4 * np.sin(np.arange(len(frame)))
    # whole milliseconds of samples 1.3 ms apart, even or not, are no missing rows
    for stamps in (frame["t"] + jitter, np.round(1.3 * frame["t"], 3), np.round(1.3 * (frame["t"] + jitter), 3)):
        record = read_record(write_frame(tmp_path, frame.assign(t=stamps)), gear_ratio=GEAR_RATIO)
        assert not any("are missing" in note for note in record.notes)


def test_repeated_stamps_are_left_out_and_gaps_part_the_log(tmp_path):
    frame = simulate_log(uneven_times())
    kept_rows = frame.drop(index=[*range(1000, 1200), *range(2500, 2510)])
    repeated = pd.concat([kept_rows.iloc[:500], kept_rows.iloc[[499, 499]], kept_rows.iloc[500:]])
    record = read_record(write_frame(tmp_path, repeated), gear_ratio=GEAR_RATIO)
    sampling = record.statistics.sampling
    assert (sampling.repeated, sampling.gaps, len(record.segments)) == (2, 2, 3)
    assert sampling.longest_interval == pytest.approx(0.21, rel=0.05)
    assert "2 rows have the stamp of the row before and were left out (data row 501 first)." in record.notes
    assert any(note.startswith("Gaps: 2; segments: 3; the longest gap is 0.2") for note in record.notes)
    assert any(note.endswith("s, after data row 1002.") for note in record.notes)
    for segment in record.segments:
        np.testing.assert_allclose(np.diff(record.time[segment]), record.sample_period, rtol=1e-9)
    ends = [segment.stop for segment in record.segments]
    assert ends == [*(segment.start for segment in record.segments[1:]), len(record.time)]
    truth = simulate_log(frame["t"].iloc[0] + record.time)
    np.testing.assert_allclose(record.positions["motor"], truth["theta_e"], atol=1e-6)


def test_gaps_between_even_stamps_leave_the_samples_alone(tmp_path):
    frame = simulate_log().drop(index=range(1000, 1200))
    record = read_record(write_frame(tmp_path, frame))
    assert record.segments == (slice(0, 1000), slice(1000, 3800))
    np.testing.assert_array_equal(record.positions["motor"], frame["theta_e"])
    np.testing.assert_allclose(record.time, frame["t"], atol=1e-9)


def test_rows_are_chosen_by_value_and_by_time(tmp_path):
    frame = simulate_log()
    on = (frame["t"] > 1.0) & (frame["t"] < 2.0)
    frame = frame.assign(on=on, mode=np.where(on, "run", "stop"), state=on.astype(int))
    for where in ({"on": True}, {"mode": "run"}, {"state": 1}, {"on": True, "mode": "run"}):
        record = read_record(write_frame(tmp_path, frame), {"where": where})
        np.testing.assert_array_equal(record.torque, frame["u"][on])
    record = read_record(write_frame(tmp_path, frame), {"where": {"on": False}, "start": 0.5, "stop": 3.0})
    assert len(record.segments) == 2
    np.testing.assert_array_equal(record.torque, frame["u"][~on & (frame["t"] >= 0.5) & (frame["t"] <= 3.0)])
    assert record.start == pytest.approx(0.5)
    assert record.time[0] == 0.0
    assert record.notes[0] == f"{len(record.time)} of 4000 rows are read, by [log] where, start and stop."


@pytest.mark.parametrize(
    ("skew", "quality"),
    [
        (3e-4, {"noise": 1e-3}),
        (2.3e-3, {"gap": 0.2, "resolution": 2.0 * math.pi / 4096}),
        (-1.2e-3, {"gap": 0.05, "noise": 1e-2}),
        (0.0, {"gap": 0.1, "noise": 1e-3}),
    ],
)
def test_skew_and_lost_motion_are_found_within_their_uncertainty(tmp_path, skew, quality, repeats):
    for seed in range(repeats(1, 3)):
        frame = simulate_log(count=6000, skew=skew, seed=seed, **quality)
        path = write_frame(tmp_path, frame)
        record = read_record(path, gear_ratio=GEAR_RATIO)
        gearing = record.statistics.gearing
        assert abs(gearing.skew - skew) < 4.0 * gearing.skew_error
        assert gearing.skew_error < 5e-5
        assert gearing.lost_motion == pytest.approx(quality.get("gap", 0.0), rel=0.03, abs=2e-3)
        assert gearing.ratio == pytest.approx(GEAR_RATIO, rel=1e-3)
        assert any("lags theta_e" in n or "leads theta_e" in n for n in record.notes) == bool(skew)
        # undone on request
        corrected = read_record(path, {"theta_s": {"skew": "estimate"}})
        assert any(note.startswith("theta_s: shifted by its skew") for note in corrected.notes)
        assert abs(corrected.statistics.gearing.skew) < 4.0 * gearing.skew_error


def test_a_given_skew_is_undone(tmp_path):
    frame = simulate_log(skew=2.5e-3)
    record = read_record(write_frame(tmp_path, frame), {"theta_s": {"skew": 2.5e-3}}, gear_ratio=GEAR_RATIO)
    np.testing.assert_allclose(GEAR_RATIO * record.positions["load"], record.positions["motor"], atol=1e-6)
    # an early channel leaves the others their samples
    record = read_record(write_frame(tmp_path, simulate_log(skew=-2.5e-3)), {"theta_s": {"skew": -2.5e-3}})
    assert record.start == pytest.approx(3e-3)
    np.testing.assert_allclose(record.torque, frame["u"][3:], atol=1e-9)
    np.testing.assert_allclose(GEAR_RATIO * record.positions["load"], frame["theta_e"][3:], atol=1e-6)
    late_frame = frame.assign(u=np.interp(frame["t"] - 4e-3, frame["t"], frame["u"]))
    gearing = read_record(write_frame(tmp_path, late_frame)).statistics.channels["u"]
    assert gearing.skew == pytest.approx(4e-3, abs=4.0 * gearing.skew_error + 1e-4)
    record = read_record(write_frame(tmp_path, late_frame), {"u": {"skew": 4e-3}})
    assert abs(record.statistics.channels["u"].skew) < 2e-4


def test_resolution_noise_saturation_and_jumps(tmp_path):
    step = 2.0 * math.pi / 4096
    frame = simulate_log(resolution=step, noise=5e-3)
    limit = 0.6 * frame["u"].abs().max()
    frame["u"] = frame["u"].clip(-limit, limit)
    frame.loc[1500, "theta_e"] += 100.0 * step
    frame.loc[2500:, "theta_e"] -= 150.0 * step
    record = read_record(write_frame(tmp_path, frame))
    motor, torque = record.statistics.channels["theta_e"], record.statistics.channels["u"]
    assert motor.resolution == pytest.approx(step, rel=1e-6)
    load = record.statistics.channels["theta_s"]
    assert GEAR_RATIO * load.noise == pytest.approx(math.hypot(5e-3, step / math.sqrt(12.0)), rel=0.1)
    assert motor.jumps == 2
    assert any(note.startswith("theta_e: 2 jumps") for note in record.notes)
    assert torque.saturated == pytest.approx((frame["u"].abs() == limit).mean())
    assert load.jumps == 0
    declared = read_record(write_frame(tmp_path, frame), {"u": {"saturation": float(limit)}})
    assert declared.statistics.channels["u"].saturated == torque.saturated
    assert motor.bandwidth == pytest.approx(2.1, abs=1.0)


def test_uneven_stamps_are_no_noise_and_no_jumps(tmp_path):
    record = read_record(write_frame(tmp_path, simulate_log(uneven_times(), noise=2e-3)))
    motor = record.statistics.channels["theta_e"]
    # splines between the readings smooth a little
    assert motor.noise == pytest.approx(2e-3, rel=0.3)
    assert motor.jumps == 0


def test_no_false_alarms(tmp_path):
    """Clean logs of many kinds are read without a remark."""
    step = 2.0 * math.pi / 2**14
    for frame in (
        simulate_log(),
        simulate_log(resolution=step),
        simulate_log(noise=1e-2),
        simulate_log(gap=0.1),
        simulate_log(count=500, period=5e-3),
    ):
        notes = read_record(write_frame(tmp_path, frame), gear_ratio=GEAR_RATIO).notes
        assert all(note.startswith("Lost motion at the motor: 0.1 ± ") for note in notes) and len(notes) <= 1
    # text with three decimals looks like no encoder
    assert read_record(write_frame(tmp_path, simulate_log().round(3), "log.csv"), gear_ratio=GEAR_RATIO).notes == ()


def replace_columns(**columns):
    return lambda frame: frame.assign(**{name: change(frame) for name, change in columns.items()})


def replace_cell(column, row, value):
    def change(frame):
        frame = frame.astype({column: object})
        frame.loc[row, column] = value
        return frame

    return change


BAD = {
    "no position": (lambda f: f[["t", "u"]], {}, "no column 'theta_e' or 'theta_s'; columns: t, u; "),
    "no torque": (
        lambda f: f.rename(columns={"u": "torque"}),
        {},
        r"no column 'u'; valid: t, torque, .*; \[log\] u can name it, absent = \[\"u\"\] says that there is none",
    ),
    "misnamed torque": (lambda f: f, {"u": "torqe"}, "no column 'torqe'; valid: t, u, theta_e, theta_s"),
    "misnamed position": (lambda f: f, {"theta_e": "theta_m"}, r"no column 'theta_m'; did you mean 'theta_[es]'\?"),
    "misspelt position": (
        lambda f: f.rename(columns={"theta_s": "Theta_S"}),
        {},
        r"no column 'theta_s', but 'Theta_S'; \[log\] theta_s = \"Theta_S\" would read it",
    ),
    "no time": (lambda f: f.rename(columns={"t": "time"}), {}, r"no column 't'; .*; \[log\] t.column can name another"),
    "text": (replace_cell("u", 17, "on"), {}, "column 'u', data row 18 is 'on'; it should be a finite number"),
    "nan": (
        lambda f: f.assign(theta_s=f["theta_s"].where(f.index < 50)),
        {},
        "column 'theta_s', data row 51 is empty or not a number",
    ),
    "text in time": (replace_cell("t", 0, "start"), {}, "column 't', data row 1 is 'start'"),
    "back in time": (replace_cell("t", 100, 0.05), {}, "column 't', data row 101: time goes back from 0.099 s to 0.05 s"),
    "no time passes": (
        replace_columns(t=lambda f: 0.0 * f["t"] + 3.0),
        {},
        "column 't' is 3 s in all rows; stamps should increase",
    ),
    "short": (lambda f: f.iloc[:63], {}, "has 63 rows; a log needs at least 64"),
    "short window": (
        lambda f: f,
        {"stop": 0.01},
        r"\[log\] where, start and stop leave 11 of 4000 rows; at least 64 are needed",
    ),
    "nowhere": (
        lambda f: f.assign(mode="run"),
        {"where": {"mode": "stop"}},
        r"\[log\] where leaves no row: 'mode' is never 'stop'; values: 'run'",
    ),
    "one column twice": (
        replace_columns(theta_s=lambda f: f["theta_e"]),
        {},
        "theta_e and theta_s are the same in every row; each needs a column of its own",
    ),
    "all gaps": (
        replace_columns(t=lambda f: f["t"] + np.floor(f["t"] / 0.02 + 1e-6)),
        {},
        "gaps leave no 64 samples in a row",
    ),
    "stuck": (
        replace_columns(theta_s=lambda f: 0.0 * f["t"] + 0.25),
        {},
        r"column 'theta_s' \(theta_s\) is 0.25 in all rows; it should move; absent = \[\"theta_s\"\] leaves it out",
    ),
    "at rest": (
        replace_columns(theta_e=lambda f: 1e-3 * (np.arange(len(f)) % 900 > 600) + 1e-3 * (np.arange(len(f)) % 7 > 5)),
        {"absent": ["theta_s"]},
        "theta_e moves by only 2 steps of its resolution 0.001; a log of a drive in motion is needed",
    ),
    "wrapped": (
        replace_columns(theta_e=lambda f: f["theta_e"] % (2.0 * np.pi)),
        {},
        r"column 'theta_e' \(theta_e\) jumps by about 6.283185307 at \d+ rows .* wraps around; "
        r"set wrap = 6.283185307 in \[log\] theta_e",
    ),
    "wrapped word": (
        replace_columns(theta_e=lambda f: np.round(f["theta_e"] * 1e4) % 65536),
        {"theta_e": {"unit": "counts", "counts_per_turn": 62831.0}},
        "set wrap = 65536 in",
    ),
    "wrong wrap": (
        lambda f: f,
        {"theta_e": {"wrap": 6.0}},
        r"column 'theta_e' ranges over [\d.]+, more than \[log\] theta_e.wrap = 6",
    ),
    "unsigned": (
        replace_columns(u=lambda f: np.round(f["u"] * 1000) % 65536),
        {"u": {"unit": "counts", "factor": 1e-3}},
        r"whole numbers up to \d+ and none about 32768: signed words of 16 bits, logged as unsigned; "
        r"set signed_bits = 16 in \[log\] u",
    ),
    "no such word": (lambda f: f, {"u": {"signed_bits": 8}}, r"column 'u', data row 1: .* is no word of 8 bits"),
    "no such magnitude": (lambda f: f, {"u": {"sign_bit": 10}}, r"column 'u', data row 1: .* is no word of 11 bits"),
    "beyond saturation": (lambda f: f, {"u": {"saturation": 0.1}}, r"exceeds \[log\] u.saturation = 0.1"),
    "degrees": (
        replace_columns(theta_e=lambda f: np.round(f["theta_e"] / (2.0 * np.pi) * 8192) * 360.0 / 8192),
        {},
        r"column 'theta_e' \(theta_e\) has steps of 0.0439453, a turn of 8192 counts in degrees: it is not in radians; "
        r"set unit = \"deg\" in \[log\] theta_e",
    ),
    "radians": (
        replace_columns(theta_s=lambda f: np.round(f["theta_s"] / (2.0 * np.pi) * 2**14) * 2.0 * np.pi / 2**14),
        {"theta_s": {"unit": "deg"}},
        r"a turn of 16384 counts in radians: it is not in degrees; set unit = \"rad\"",
    ),
    "counts": (
        replace_columns(theta_e=lambda f: np.round(f["theta_e"] * 1000)),
        {},
        r"holds whole numbers only: counts, not radians; set unit = \"counts\" and counts_per_turn in \[log\] theta_e",
    ),
    "continuous degrees": (
        replace_columns(theta_e=lambda f: np.degrees(f["theta_e"])),
        {},
        r"theta_e moves 1146 for each 1 of theta_s, where gear_ratio is 20: theta_e is in degrees",
    ),
    "continuous radians": (lambda f: f, {"theta_s": {"unit": "deg"}}, "theta_s is not in degrees; see unit in"),
    "load in degrees": (replace_columns(theta_s=lambda f: np.degrees(f["theta_s"])), {}, "theta_s is in degrees"),
    "wrong sign of a side": (
        replace_columns(theta_s=lambda f: -f["theta_s"]),
        {},
        "the sign of one of them is wrong; set sign = -1",
    ),
    "swapped": (
        lambda f: f,
        {"theta_e": "theta_s", "theta_s": "theta_e"},
        r"the sides are swapped; exchange the columns in \[log\] theta_e and theta_s",
    ),
    "swapped and turned": (
        replace_columns(theta_s=lambda f: -f["theta_s"]),
        {"theta_e": "theta_s", "theta_s": "theta_e"},
        "the sides are swapped, and one has the wrong sign",
    ),
    "at the motor": (
        replace_columns(theta_s=lambda f: 20.0 * f["theta_s"]),
        {},
        "theta_s is already referred to the motor shaft",
    ),
    "wrong ratio": (
        replace_columns(theta_s=lambda f: 2.0 * f["theta_s"]),
        {},
        r"theta_e moves 10 for each 1 of theta_s, where gear_ratio is 20: gear_ratio, or a unit in \[log\], is wrong",
    ),
    "wrong sign of the torque": (
        replace_columns(u=lambda f: -f["u"]),
        {},
        "the torque has the wrong sign: .*; set sign = -1 in",
    ),
    "estimate without motion": (
        replace_columns(theta_s=lambda f: 0.01 * np.random.default_rng(0).standard_normal(len(f))),
        {"theta_s": {"skew": "estimate"}},
        "theta_s.skew = 'estimate': ",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_logs_are_told_in_one_line(case, tmp_path):
    change, log, message = BAD[case]
    frame = change(simulate_log())
    text = any(frame[column].dtype == object for column in ("t", "u", "theta_s") if column in frame)
    path = write_frame(tmp_path, frame, "log.csv" if text else "log.parquet")
    with pytest.raises(InputError, match=message) as error:
        read_record(path, log, gear_ratio=GEAR_RATIO)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def test_columns_of_unequal_length_are_told(tmp_path):
    (tmp_path / "log.json").write_text(f'{{"t": {list(range(100))}, "u": {[0.0] * 100}, "theta_e": [1.0, 2.0]}}')
    with pytest.raises(InputError, match="column 'theta_e' has 2 values and the time 100; they should be equally many"):
        read_record(tmp_path / "log.json")


def test_doubts_are_remarks(tmp_path):
    frame = simulate_log()
    # one encoder of another drive
    unrelated = frame.assign(theta_s=simulate_log(seed=5)["theta_s"])
    notes = read_record(write_frame(tmp_path, unrelated), gear_ratio=GEAR_RATIO).notes
    assert any(note.startswith("theta_e and theta_s are hardly related") for note in notes)
    warnings = read_record(write_frame(tmp_path, frame.assign(t=1000.0 * frame["t"])), gear_ratio=GEAR_RATIO).warnings
    assert any("if the stamps are not in s, set [log] t.unit" in warning for warning in warnings)
    warnings = read_record(write_frame(tmp_path, frame.assign(t=frame["t"] / 1000.0)), gear_ratio=GEAR_RATIO).warnings
    assert any("rpm: check its unit" in warning for warning in warnings)
    notes = read_record(write_frame(tmp_path, frame.assign(u=0.0)), gear_ratio=GEAR_RATIO).notes
    assert notes == ("u is 0 in all rows: free motion, which does not show the inertia by itself.",)


@pytest.mark.parametrize(
    ("change", "times"),
    [
        (lambda frame: frame.assign(u=1000.0 * frame["u"]), "1e+03"),
        (lambda frame: frame.assign(theta_e=np.degrees(frame["theta_e"])), "0.0175"),
        (lambda frame: frame.assign(t=1000.0 * frame["t"]), "1e+06"),
        (lambda frame: frame.assign(u=frame["u"] / 1000.0), "0.001"),
        (lambda frame: frame.assign(u=3.0 * frame["u"]), None),
    ],
)
def test_an_inertia_far_from_the_nominal_one_is_said_first(tmp_path, change, times):
    """Torque in mN m or kN m, degrees for radians, ms for s; three times the nominal may well be."""
    path = write_frame(tmp_path, change(simulate_log().drop(columns="theta_s")))
    record = read_record(path, nominal=NominalDrive(INERTIA, VISCOUS))
    warnings = record.warnings
    assert bool(record.contradiction) == (times is not None)
    doubts = [warning for warning in warnings if warning.startswith("Doubtful: u moves theta_e as an inertia of")]
    assert len(doubts) == (times is not None)
    assert times is None or f", {times} times the nominal 0.01: check the units" in doubts[0]


@pytest.mark.parametrize(("stiffness", "refused"), [(1e6, True), (1e-3, False)])
def test_an_inertia_that_a_resonance_hides_is_doubted_and_not_refused(tmp_path, stiffness, refused):
    """A fiftieth of the nominal inertia: above the antiresonance the input supplies little."""
    nominal = NominalDrive(0.3, 0.0, load_inertia=0.3, stiffness=stiffness)
    record = read_record(write_frame(tmp_path, simulate_log().drop(columns="theta_s")), nominal=nominal)
    assert record.warnings[0].startswith("Doubtful: u moves theta_e as an inertia of")
    assert bool(record.contradiction) == refused


def test_a_torque_that_acts_late_is_doubted_and_not_refused(tmp_path):
    """An inertia of 1 kg m² on two sines, its torque recorded 40 ms before it acts."""
    t, w = 2e-3 * np.arange(4000), 2.0 * np.pi * np.array([[2.0], [3.3]])
    torque = -np.sum(np.sin(w * (t + 0.04)), axis=0)
    position = np.sum(np.sin(w * t) / w**2, axis=0)
    record = read_record(write_frame(tmp_path, pd.DataFrame({"t": t, "u": torque, "theta_e": position})))
    warnings = [warning for warning in record.warnings if "of the work" in warning]
    assert len(warnings) == 1 and not record.contradiction, (record.warnings, record.contradiction)
    assert warnings[0].endswith("of the work: the load drives it, or u has the wrong sign or acts late.")
    assert float(warnings[0].split("returns ")[1].split(" %")[0]) > 50.0


def test_work_far_from_that_of_the_nominal_friction_is_said_first(tmp_path):
    """A drive whose inertia does not show, as friction takes nearly all of the torque."""
    t = 2e-3 * np.arange(4000)
    position = np.sin(2.0 * np.pi * 0.2 * t) + 0.3 * np.sin(2.0 * np.pi * 0.5 * t)
    frame = pd.DataFrame({"t": t, "u": 2.0 * np.gradient(position, t), "theta_e": position})
    for factor, begin, surely in (
        (1.0, "", False),
        (1000.0, "Doubtful: friction takes", False),
        (0.01, "Doubtful: u is", True),
    ):
        record = read_record(write_frame(tmp_path, frame.assign(u=factor * frame["u"])), nominal=NominalDrive(1.0, 2.0))
        warnings = [warning for warning in record.warnings if warning.startswith("Doubtful")]
        assert (len(warnings), bool(record.contradiction)) == (bool(begin), surely), record.warnings
        assert not begin or warnings[0].startswith(begin)
    record = read_record(write_frame(tmp_path, frame.assign(u=-frame["u"])), nominal=NominalDrive(1.0, 2.0))
    assert record.contradiction.startswith("u falls with the speed as a viscous friction of -2"), record.contradiction


@pytest.mark.parametrize("friction", [0.05, 1.5])
def test_dry_friction_is_no_sign_of_a_wrong_unit(friction, tmp_path):
    """A drive that turns slowly: dry friction takes up to some hundred times the work of the model's viscous friction."""
    t = 2e-3 * np.arange(6000)
    position = np.sin(2.0 * np.pi * 0.2 * t) + 0.3 * np.sin(2.0 * np.pi * 0.5 * t)
    speed = np.gradient(position, t)
    u = 1e-3 * np.gradient(speed, t) + 5e-3 * speed + friction * np.sign(speed)
    frame = pd.DataFrame({"t": t, "u": u, "theta_e": position})
    record = read_record(write_frame(tmp_path, frame), nominal=NominalDrive(1e-3, 5e-3))
    assert not [warning for warning in record.warnings if warning.startswith("Doubtful")] and not record.contradiction


def test_friction_that_falls_with_the_speed_is_no_wrong_sign(tmp_path):
    t = 2e-3 * np.arange(6000)
    position = np.sin(2.0 * np.pi * 0.2 * t) + 0.3 * np.sin(2.0 * np.pi * 0.5 * t)
    speed = np.gradient(position, t)
    u = 0.1 * np.gradient(speed, t) - 0.5 * speed + 2.0 * np.sign(speed)
    nominal = NominalDrive(0.1, 0.5)
    record = read_record(write_frame(tmp_path, pd.DataFrame({"t": t, "u": u, "theta_e": position})), nominal=nominal)
    assert record.contradiction == ""


def test_a_falling_load_gives_its_energy_back(tmp_path):
    """Braking all the way down is no wrong sign."""
    t = 1e-3 * np.arange(3000)
    down = -0.5 * t + 0.02 * np.sin(8.0 * t)
    frame = pd.DataFrame({"t": t, "u": 1.0 + 0.05 * np.sin(5.0 * t), "theta_e": down})
    assert read_record(write_frame(tmp_path, frame)).torque is not None


TABLES = {
    "unknown key": ({"colum": 1}, r"log: unknown key 'colum'; valid: "),
    "unknown channel key": ({"theta_e": {"colum": 1}}, r"log.theta_e: unknown key 'colum'; did you mean 'column'\?"),
    "no column": ({"theta_e": {"column": 1.5}}, "log.theta_e.column: should be a column's name, or its number .*, not 1.5"),
    "sign": ({"u": {"sign": 2}}, "log.u.sign: should be 1 or -1, not 2"),
    "no counts": ({"theta_s": {"unit": "counts"}}, "log.theta_s: unit counts needs counts_per_turn"),
    "counts in rad": (
        {"theta_s": {"unit": "rad", "counts_per_turn": 2}},
        "log.theta_s: counts_per_turn is for unit counts, not for rad",
    ),
    "no constant": ({"u": {"unit": "A"}}, "log.u: unit A needs factor, the torque in N m .* of one A"),
    "unknown unit": ({"u": {"unit": "kNm"}}, "log.u.unit: should be 'N m', 'N', 'V', 'A' or 'counts', not 'kNm'"),
    "two times": ({"t": {"column": "t", "period": 1.0}}, "log.t: has both column and period"),
    "window": ({"start": 2.0, "stop": 1.0}, "log: start 2.0 should be less than stop 1.0"),
    "there and not": ({"u": "u", "absent": ["u"]}, "log: u is described and said to be absent; remove one of them"),
    "no position": ({"absent": ["theta_e", "theta_s"]}, "log: absent: .* one of them is needed"),
    "skew": ({"theta_s": {"skew": "guess"}}, "log.theta_s.skew: should be a number of seconds or 'estimate', not 'guess'"),
    "skew of the motor": ({"theta_e": {"skew": "estimate"}}, "log: theta_e.skew: 'estimate' is for theta_s"),
    "skew of a reference": ({"reference": {"skew": "estimate"}}, "log: reference.skew: 'estimate' is for theta_s"),
    "skew against nothing": ({"theta_s": {"skew": "estimate"}, "absent": ["theta_e"]}, "'estimate' needs theta_e"),
    "where": ({"where": {"mode": [1]}}, r"log.where.mode: should be a number, text, true or false, not \[1\]"),
    "absent": ({"absent": ["v"]}, r"log.absent\[0\]: should be 'u', 'theta_e' or 'theta_s', not 'v'"),
}


@pytest.mark.parametrize("case", TABLES)
def test_wrong_tables_name_the_key(case):
    table, message = TABLES[case]
    with pytest.raises(InputError, match=message):
        read_log_table(table)
    with pytest.raises(InputError, match=message):
        read_record("never opened", table)


def test_a_column_alone_stands_for_its_table_and_the_table_survives_toml():
    table = read_log_table({"t": 0, "theta_e": "x", "where": {"on": True, "mode": "a"}})
    assert table.t.column == 0 and table.theta_e.column == "x"
    assert LogTable.model_validate(table.model_dump(exclude_none=True)) == table
    assert read_log_table(None) == LogTable()


# real machines


def test_emps_is_read_as_published():
    for name in ("DATA_EMPS.mat", "DATA_EMPS_PULSES.mat"):
        record = read_record(find_recording(f"emps/{name}"), EMPS)
        assert (len(record.time), record.sample_period) == (24841, pytest.approx(1e-3))
        assert record.statistics.sampling.even and record.closed_loop
        assert record.notes == ("There is no theta_s (load position) in this log.",)
        # the published fit: 95.109 kg, 203.5 N s/m, 20.394 N, -3.165 N
        statistics = dict(zip(record.statistics.dynamics.names, record.statistics.dynamics.values, strict=True))
        assert statistics["inertia"] == pytest.approx(95.1, rel=0.03)
        assert statistics["viscous"] == pytest.approx(203.5, rel=0.1)
        assert statistics["coulomb"] == pytest.approx(20.4, rel=0.15)
        assert abs(record.statistics.channels["u"].skew) < 1e-3


def test_emps_with_the_wrong_sign_is_refused():
    with pytest.raises(InputError, match="the torque has the wrong sign"):
        read_record(find_recording("emps/DATA_EMPS.mat"), EMPS | {"u": EMPS["u"] | {"sign": -1}})


def test_xl330_records_are_resampled():
    files = sorted(find_recording("bam_xl330").glob("*.json"))
    assert len(files) == 8
    for file in files:
        record = read_record(file, XL330)
        assert not record.statistics.sampling.even
        assert 3.4e-3 < record.sample_period < 5.4e-3
        assert record.statistics.channels["theta_e"].resolution == pytest.approx(2.0 * math.pi / 4096, rel=1e-6)
        assert record.statistics.channels["theta_e"].jumps == 0
        assert np.abs(record.torque).max() <= 1.0
        np.testing.assert_allclose(np.diff(record.time), record.sample_period, rtol=1e-6)
        if record.torque.min() < 0.0:
            with pytest.raises(InputError, match="set signed_bits = 16"):
                read_record(file, XL330 | {"u": {"column": "load", "unit": "counts", "factor": 1e-3}})
    free = read_record(files[1], XL330 | {"where": {"torque_enable": False}})
    assert len(free.segments) == 1 and not free.torque.any()


def test_servoproject_has_two_encoders_and_no_torque():
    path = find_recording("servoproject_dual_encoder/outputEncoderData.txt")
    record = read_record(path, SERVO, gear_ratio=1.0)
    assert (len(record.time), record.torque) == (42000, None)
    assert record.statistics.gearing.ratio == pytest.approx(1.0, abs=0.01)
    assert abs(record.statistics.gearing.skew) < 4.0 * record.statistics.gearing.skew_error
    # counts of 220/4096 degrees, in parts of 32
    assert record.statistics.channels["theta_s"].resolution == pytest.approx(math.radians(220.0 / 4096.0 / 32.0), rel=1e-6)
    raw = np.loadtxt(path)
    np.testing.assert_allclose(record.positions["motor"], np.radians((raw[:, 1] - raw[:, 2]) * 220.0 / 4096.0), atol=1e-12)
    with pytest.raises(InputError, match="the sign of one of them is wrong"):
        read_record(path, SERVO, gear_ratio=-1.0)


@pytest.mark.parametrize("off", [1.1, 0.92])
def test_a_gear_ratio_that_is_a_little_off_puts_the_log_in_doubt(tmp_path, off):
    path = write_frame(tmp_path, simulate_log())
    warnings = read_record(path, gear_ratio=off * GEAR_RATIO).warnings
    assert warnings[0].startswith(f"{DOUBT}theta_e moves 20 for each 1 of theta_s") and "a little wrong" in warnings[0]
    for gross in (1.4, -1.0, 1.0 / GEAR_RATIO**2):
        with pytest.raises(InputError, match=r"for each 1 of theta_s|times theta_s"):
            read_record(path, gear_ratio=gross * GEAR_RATIO)


def test_the_wind_up_of_a_soft_shaft_is_no_doubt_of_the_gear_ratio(tmp_path):
    """A load with an inertia J that swings at ω is ahead of the motor by J ω² / (N² K) of its motion."""
    t, ratio, stiffness, inertia, frequency = 1e-3 * np.arange(8000), 5.0, 60.0, 7.0, 3.0
    load = np.sin(frequency * t)
    motor = ratio * load * (1.0 - inertia * frequency**2 / (ratio**2 * stiffness))
    torque = 0.1 * np.gradient(np.gradient(motor, t), t) + 0.3 * np.gradient(motor, t)
    path = write_frame(tmp_path, pd.DataFrame({"t": t, "u": torque, "theta_e": motor, "theta_s": load}))
    for nominal, doubted in ((NominalDrive(0.05, 0.1, inertia, 15.0, ratio, stiffness), False), (None, True)):
        warnings = read_record(path, gear_ratio=ratio, nominal=nominal).warnings
        assert any("a little wrong" in warning for warning in warnings) == doubted


@pytest.fixture
def write_and_read(tmp_path):
    def write(name, **options):
        simulate_log(**options).to_csv(tmp_path / name, index=False)
        return read_record(tmp_path / name)

    return write


def test_each_log_is_a_segment_with_its_own_rows(write_and_read):
    first, second = write_and_read("a.csv", count=1500), write_and_read("b.csv", count=2500, seed=1)
    joined = join_records([first, second])
    assert len(joined.time) == 4000
    assert [(part.start, part.stop) for part in joined.segments] == [(0, 1500), (1500, 4000)]
    assert np.all(np.diff(joined.time) > 0.0)
    assert joined.time[1500] > joined.time[1499] + 5.0 * joined.sample_period
    for side in ("motor", "load"):
        np.testing.assert_array_equal(joined.positions[side][1500:], second.positions[side])
    np.testing.assert_array_equal(joined.torque, np.concatenate([first.torque, second.torque]))
    assert joined.notes[0] == "2 logs, one after the other: a.csv, b.csv."
    assert join_records([first]) is first


def test_logs_that_are_not_alike(write_and_read, tmp_path):
    first, slow = write_and_read("a.csv"), write_and_read("slow.csv", period=2e-3)
    with pytest.raises(
        InputError, match=r"slow\.csv: is sampled every 0\.002 s, .*a\.csv every 0\.001 s; set \[log\] resample = "
    ):
        join_records([first, slow])
    simulate_log().drop(columns="u").to_csv(tmp_path / "free.csv", index=False)
    free = read_record(tmp_path / "free.csv", {"absent": ["u"]})
    with pytest.raises(InputError, match=r"free\.csv: has no torque, which .*a\.csv has"):
        join_records([first, free])


def test_a_speed_stands_for_a_position(tmp_path):
    frame = simulate_log()
    rpm = np.gradient(frame["theta_e"], frame["t"]) * 30.0 / math.pi
    path = write_frame(tmp_path, frame.assign(speed=-rpm).drop(columns="theta_e"))
    record = read_record(path, {"omega_e": {"column": "speed", "unit": "rpm", "sign": -1}}, gear_ratio=GEAR_RATIO)
    motion = frame["theta_e"] - frame["theta_e"][0]
    np.testing.assert_allclose(record.positions["motor"], motion, atol=2e-3)
    assert record.warnings[0].startswith("theta_e is the integral of the speed omega_e: its errors add up over time.")
    with pytest.raises(InputError, match="omega_e stands in place of theta_e, which is described"):
        read_record(path, {"omega_e": "speed", "theta_e": "theta_s"})
    with pytest.raises(InputError, match=r"\[log\] theta_e can name the motor position, omega_e its speed"):
        read_record(path, {"absent": ["theta_s"]})


def test_an_export_of_drive_software_is_read_as_it_is():
    """Screw drives (TRO 2021): remarks, names, units, speed in place of a position."""
    log = {"t": {"unit": "ms"}, "omega_e": {"column": 1, "unit": "rpm"}, "u": {"column": 2, "factor": 9.84e-5}}
    record = read_record(find_recording("screw_drives/experiments/driveNo2/start_stop/50.csv"), log)
    assert record.sample_period == pytest.approx(0.04, rel=1e-7) and len(record.time) == 500
    speed = np.diff(record.positions["motor"]) / 0.04 * 30.0 / math.pi
    assert np.abs(speed).max() == pytest.approx(53.0, abs=3.0)


@pytest.mark.parametrize("seed", range(5))
def test_rows_without_a_value_are_left_out(tmp_path, seed):
    """Single rows without a value, and a channel with a longer period."""
    random = np.random.default_rng(seed)
    truth = simulate_log(count=4000)
    every = int(random.integers(1, 5))
    is_empty = (random.random(4000) < 0.01) | (np.arange(4000) % every > 0)
    frame = truth.assign(theta_s=truth["theta_s"].mask(is_empty), unused=truth["u"].mask(np.arange(4000) % 7 > 0))
    record = read_record(write_frame(tmp_path, frame, f"log.{['csv', 'parquet'][seed % 2]}"))
    expected = np.interp(record.time + record.start, truth["t"], truth["theta_s"])
    assert np.isclose(record.sample_period, every * truth["t"][1])
    np.testing.assert_allclose(record.positions["load"], expected, atol=2e-3 * np.ptp(expected))
    assert any(f"{is_empty.sum()} rows without a value of 'theta_s'" in note for note in record.notes)


def test_stamps_that_go_back_are_told_to_the_digit(tmp_path):
    frame = simulate_log().assign(t=lambda f: 1_700_000_000.0 + f["t"].where(f.index != 70, 0.0685))
    with pytest.raises(InputError, match=r"goes back from 1700000000\.069\d* s to 1700000000\.0685\d* s"):
        read_record(write_frame(tmp_path, frame))


@pytest.mark.parametrize("change", [0.5, 0.9, 0.95, 0.99, 0.995, 1.005, 1.01, 1.05, 1.2, 2.0])
def test_parts_with_different_periods_are_resampled(tmp_path, change):
    """The period changes at a gap: all parts are read at their own times."""
    intervals = np.repeat([1e-3, 5e-2, change * 1e-3], [1500, 1, 1000])
    time = np.concatenate([[0.0], np.cumsum(intervals)])
    frame = pd.DataFrame({"t": time, "u": np.cos(20.0 * time), "theta_e": np.sin(15.0 * time) + 0.1 * np.sin(71.0 * time)})
    record = read_record(write_frame(tmp_path, frame), {"absent": ["theta_s"]})
    expected = np.sin(15.0 * record.time) + 0.1 * np.sin(71.0 * record.time)
    assert len(record.segments) == 2 and any("Resampled" in note for note in record.notes)
    np.testing.assert_allclose(record.positions["motor"], expected, atol=1e-6)
    for segment in record.segments:
        np.testing.assert_allclose(np.diff(record.time[segment]), record.sample_period, rtol=1e-9)


def split_log(tmp_path, every=1, shift=0.0):
    """A log whose positions are in a file of their own, with every n-th sample and stamps that are shifted."""
    frame = simulate_log()
    write_frame(tmp_path, frame[["t", "u"]], "drive.csv")
    encoders = frame[["t", "theta_e", "theta_s"]].iloc[::every].rename(columns={"theta_e": "position"})
    write_frame(tmp_path, encoders.assign(t=encoders["t"] + shift), "enc.csv")
    return frame, {"join": ["enc.csv"], "theta_e": "enc/position", "theta_s": "enc/theta_s"}


def test_files_of_one_log_are_joined(tmp_path):
    frame, log = split_log(tmp_path)
    record = read_record(tmp_path / "drive.csv", log, gear_ratio=GEAR_RATIO)
    np.testing.assert_array_equal(record.positions["motor"], frame["theta_e"])
    np.testing.assert_array_equal(record.positions["load"], frame["theta_s"])
    assert not any("times of its own" in note for note in record.notes)


@pytest.mark.parametrize(("every", "shift"), [(2, 0.0), (1, 0.3e-3), (3, -0.2e-3)])
def test_a_joined_file_has_times_of_its_own(tmp_path, every, shift):
    frame, log = split_log(tmp_path, every, shift)
    record = read_record(tmp_path / "drive.csv", log, gear_ratio=GEAR_RATIO)
    assert "enc.csv has times of its own; its columns are read at those of the log." in record.notes
    expected = np.interp(frame["t"] - shift, frame["t"], frame["theta_e"])
    part = slice(10, len(record.time) - 10)
    motor = np.interp(frame["t"], record.start + record.time, record.positions["motor"])
    scale = np.ptp(frame["theta_e"])
    np.testing.assert_allclose(motor[part], expected[part], atol=1e-4 * every**2 * scale)


def test_a_joined_counter_that_wraps_is_never_between_its_ends(tmp_path):
    frame, log = split_log(tmp_path)
    counter = pd.DataFrame({"t": frame["t"] + 0.4e-3, "position": np.mod(np.round(frame["theta_e"] / 1e-4), 4096)})
    write_frame(tmp_path, counter, "enc.csv")
    log |= {"theta_e": {"column": "enc/position", "factor": 1e-4, "wrap": 4096}, "absent": ["theta_s"]}
    record = read_record(tmp_path / "drive.csv", {key: log[key] for key in log if key != "theta_s"})
    motion, truth = record.positions["motor"], frame["theta_e"].to_numpy()
    count = min(len(motion), len(truth)) - 2
    speed = np.abs(np.diff(truth)).max()
    moved = (motion - motion[5])[5:count] - (truth - truth[5])[5:count]
    assert np.abs(moved).max() < 2 * speed + 3e-4


def test_dates_of_joined_files_are_of_one_clock(tmp_path):
    frame, log = split_log(tmp_path)
    start = np.datetime64("2026-03-01T10:00:00")
    for name, first in (("drive.csv", 0), ("enc.csv", 1000)):
        part = pd.read_csv(tmp_path / name).iloc[first:]
        stamps = start + np.round(1e6 * part["t"]).astype(int).to_numpy().astype("timedelta64[us]")
        write_frame(tmp_path, part.assign(t=np.datetime_as_string(stamps)), name)
    record = read_record(tmp_path / "drive.csv", log, gear_ratio=GEAR_RATIO)
    assert any("1000 rows without a value of 'enc/" in note for note in record.notes)
    np.testing.assert_allclose(record.positions["motor"], frame["theta_e"][1000:], rtol=1e-9)


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"join": ["missing.csv"]}, "missing.csv: no such file"),
        ({"join": ["enc.csv", "enc.csv"]}, "join: two files are named enc"),
        ({"theta_e": "enc/positoin"}, "no column 'enc/positoin'.*enc/position"),
    ],
)
def test_files_that_do_not_join_are_refused(tmp_path, changes, fault):
    _, log = split_log(tmp_path)
    with pytest.raises(InputError, match=fault):
        read_record(tmp_path / "drive.csv", log | changes)


def test_files_of_other_times_are_refused(tmp_path):
    _, log = split_log(tmp_path, shift=100.0)
    with pytest.raises(InputError, match=r"enc.csv: its times, 100 to .* do not overlap"):
        read_record(tmp_path / "drive.csv", log)


@pytest.mark.parametrize("rows", [[0, 1, 2, 2], [0, 1, 3], [0, 1, 1, 3]], ids=["repeated", "lost", "both"])
def test_a_row_that_is_lost_or_repeated_does_not_change_the_period(tmp_path, rows):
    frame = simulate_log(count=400)
    order = [*range(200), *(200 + row for row in rows), *range(204, 400)]
    record = read_record(write_frame(tmp_path, frame.iloc[order]), gear_ratio=GEAR_RATIO)
    assert record.sample_period == pytest.approx(1e-3, rel=1e-6)
    motion = np.interp(record.start + record.time, frame["t"], frame["theta_e"])
    np.testing.assert_allclose(record.positions["motor"], motion, atol=2e-4 * np.ptp(motion))


def test_stamps_rounded_to_a_period_are_even(tmp_path):
    frame = simulate_log(count=2000, period=0.99e-3)
    record = read_record(write_frame(tmp_path, frame.assign(t=np.round(frame["t"], 3))), gear_ratio=GEAR_RATIO)
    assert record.sample_period == pytest.approx(0.99e-3, rel=1e-4)
    assert record.statistics.sampling.even
