"""The watch of a drive: a gap that grows is followed and raises an alarm, one that stays does not; from logs, files that
grow, and datagrams; as a command, with bad input, and interrupted."""

import json
import re
import signal
import socket
import threading
import time
from types import SimpleNamespace

import jax
import numpy as np
import pandas as pd
import pytest
import tomli_w
from command_server import start_command
from growing import HALF_GAP, STIFFNESS, axis, simulate_log
from hidden_log import FRICTIONS, GAP, simulate_geared_drive
from mcap_log import write_mcap
from small_study import multisine_study, rigid_study, small_study

import jaxbl
from jaxbl.cli import app, main
from jaxbl.errors import InputError
from jaxbl.files import read_result
from jaxbl.monitoring.watch import Watcher, read_watch_task, run_watch
from jaxbl.quantity import Quantity

LIMIT = 1.25 * HALF_GAP
WINDOW = {"window": 4.0, "interval": 0.5}
OPTIONS = ("--window", "4", "--every", "0.5")
SECONDS = 16.0
GROWING_GAPS = 1.0 + np.clip((np.arange(0.0, SECONDS, 1e-3) - 5.0) / 4.0, 0.0, 1.0)
"""The half gap over its size at the start: it doubles from 5 s to 9 s."""


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """A model, and logs of its drive whose gap stays, and whose gap grows."""
    folder = tmp_path_factory.mktemp("logs")
    model = folder / "axis.toml"
    model.write_text(tomli_w.dumps(axis()))
    with jax.enable_x64(True):
        for name, gaps in (("same", np.ones(10_000)), ("grown", GROWING_GAPS)):
            simulate_log(axis(), gaps).to_csv(folder / f"{name}.csv", index=False)
    return folder


@pytest.fixture(scope="module")
def growing_watch(logs):
    """The watch of the gap that grows, and the values it told of."""
    values = []
    watch = jaxbl.watch(logs / "grown.csv", logs / "axis.toml", alarm_gap=LIMIT, on_values=values.append, **WINDOW)
    return watch, values


@pytest.fixture(scope="module")
def steady_watch(logs):
    """The watch of the gap that stays."""
    return jaxbl.watch(logs / "same.csv", logs / "axis.toml", alarm_gap=1.02 * HALF_GAP, **WINDOW)


def end_after_looks(count):
    """Return a function that ends a stream after `count` looks, more than it takes to read its file."""
    left = iter(range(count))
    return lambda: next(left, None) is None


def run_command(*words):
    """The exit code of a command."""
    with pytest.raises(SystemExit) as end:
        main(lambda: app([*map(str, words)]))
    return end.value.code or 0


def test_a_gap_that_grows_is_followed_and_raises_an_alarm(growing_watch):
    result, told_values = growing_watch
    values = result.values
    assert list(values.columns) == result.task.columns
    assert [row["t"] for row in told_values] == values["t"].tolist() == pytest.approx(np.arange(4.0, SECONDS, 0.5))
    before, after = values[values["t"] <= 5.0], values[values["t"] >= 13.5]
    for part, size in ((before, HALF_GAP), (after, 2.0 * HALF_GAP)):
        assert np.abs(part["half_gap"] / size - 1.0).max() < 0.01
        assert np.abs(part["stiffness"] / STIFFNESS - 1.0).max() < 0.01
        assert (part["half_gap_from"] < part["half_gap"]).all()
        assert (part["half_gap_least"] < part["half_gap_from"]).all()
    # while it grows, a gap that was there within the window
    first, last = (
        np.interp(values["t"] - delay, np.arange(0.0, SECONDS, 1e-3), GROWING_GAPS * HALF_GAP) for delay in (4.0, 0.0)
    )
    assert (values["half_gap"] > 0.99 * first).all()
    assert (values["half_gap"] < 1.01 * last).all()
    crossing_time, alarm_times = 6.0, values["t"][values["alarm"]]
    assert crossing_time < alarm_times.iloc[0] < crossing_time + 6.0
    assert len(alarm_times) == (values["t"] >= alarm_times.iloc[0]).sum()
    assert result.summary["alarm"]["t"] == alarm_times.iloc[0]
    assert result.summary["alarm"]["half_gap"] > LIMIT


def test_a_gap_that_stays_raises_none(steady_watch):
    assert steady_watch.summary["alarm"] is None
    assert steady_watch.summary["determined"] == steady_watch.summary["values"] == 12
    assert steady_watch.summary["samples"] == 10_000
    assert steady_watch.summary["contradictions"] == 0
    last = steady_watch.summary["last"]
    assert last["half_gap_from"] < HALF_GAP * 1.001
    assert last["half_gap_to"] > HALF_GAP * 0.999
    assert steady_watch.summary["units"]["load"] == {
        "half_gap": "rad", "stiffness": "N m/rad", "coulomb": "N m", "viscous": "N m s/rad",
    }  # fmt: skip


def test_the_paper_s_law_is_watched(tmp_path):
    """Its half gap is 4 j_0."""
    data = multisine_study(
        6.0, transmission={"law": "sigmoid_backlash", "stiffness": 60.0, "dead_zone": 0.02, "slope": 40.0}
    )
    jaxbl.run(data).trace[["t", "u", "theta_e", "theta_s"]].to_csv(tmp_path / "log.csv", index=False)
    watch = jaxbl.watch(tmp_path / "log.csv", data, **WINDOW)
    assert watch.summary["last"]["half_gap"] == pytest.approx(0.08, rel=0.02)
    assert watch.summary["last"]["stiffness"] == pytest.approx(60.0, rel=0.02)


def test_a_law_without_a_gap_has_its_stiffness_watched(tmp_path):
    data = multisine_study(6.0, transmission={"law": "linear_shaft", "stiffness": 60.0})
    jaxbl.run(data).trace[["t", "u", "theta_e", "theta_s"]].to_csv(tmp_path / "log.csv", index=False)
    watch = jaxbl.watch(tmp_path / "log.csv", data, **WINDOW)
    assert watch.summary["last"]["stiffness"] == pytest.approx(60.0, rel=0.02)
    assert "half_gap" not in watch.values
    assert [drawing.name for drawing in jaxbl.draw(watch)] == ["watch", "watch_friction"]
    with pytest.raises(InputError, match="law linear_shaft has no gap for --alarm-gap"):
        jaxbl.watch(tmp_path / "log.csv", data, alarm_gap=0.1, **WINDOW)


def test_friction_beyond_the_model_is_found(tmp_path):
    """Coulomb friction of the load, of which the observers know nothing, and viscous friction that has changed."""
    data = axis(10.0, effects=[{"kind": "load.coulomb_friction", "torque": 3.0}], encoders={"noise": 1e-5})
    jaxbl.run(data).trace[["t", "u", "theta_e", "theta_s"]].to_csv(tmp_path / "log.csv", index=False)
    model = axis(10.0)
    model["drive"]["motor_viscous"] = 0.1
    watch = jaxbl.watch(tmp_path / "log.csv", model, window=8.0, interval=2.0)
    last = watch.summary["last"]
    assert last["load.coulomb"] == pytest.approx(3.0, rel=0.05)
    assert last["motor.viscous"] == pytest.approx(0.15, rel=0.05)
    assert last["half_gap"] == pytest.approx(HALF_GAP, rel=0.01)


def test_an_inertia_that_is_wrong_is_seen_and_leaves_the_gap_as_it_is(logs):
    """The load's stiffness is half as large again then, and the motor's observer has the gap."""
    data = axis()
    data["drive"]["load_inertia"] *= 1.5
    watch = jaxbl.watch(logs / "same.csv", data, alarm_gap=1.05 * HALF_GAP, **WINDOW)
    assert watch.summary["contradictions"] == 12
    assert watch.summary["alarm"] is None
    assert watch.summary["last"]["side"] == "motor"
    assert watch.summary["last"]["half_gap"] == pytest.approx(HALF_GAP, rel=0.01)
    assert watch.summary["last"]["load.stiffness"] == pytest.approx(1.5 * STIFFNESS, rel=0.02)


def test_of_two_gaps_that_differ_the_smaller_one_counts(logs):
    watcher = Watcher(
        read_watch_task("udp://127.0.0.1:1", logs / "axis.toml", alarm_gap=LIMIT, **WINDOW), lambda values: None
    )
    for motor, load, alarm, contrary in ((0.13, 0.131, True, False), (0.13, 0.09, False, True), (0.09, 0.13, False, True)):
        result = {
            side: SimpleNamespace(numbers={"half_gap": Quantity(gap, 1e-3 + i * 1e-4), "stiffness": Quantity(60.0, 1.0)})
            for i, (side, gap) in enumerate((("motor", motor), ("load", load)))
        }
        values = watcher._judge_gap(result)
        assert (values["alarm"], values["contradiction"], values["side"]) == (alarm, contrary, "motor")
        assert values["half_gap"] == motor


def test_a_file_that_is_followed_gives_what_it_gives_as_a_log(logs, growing_watch):
    log, _ = growing_watch
    task = read_watch_task(logs / "grown.csv", logs / "axis.toml", follow=True, alarm_gap=LIMIT, **WINDOW)
    live = run_watch(task, ended=end_after_looks(12))
    assert live.summary["samples"] == log.summary["samples"]
    assert live.summary["left_out"] == {}
    pd.testing.assert_frame_equal(live.values, log.values, rtol=1e-6, atol=1e-9)


def test_datagrams_give_what_the_log_gives_and_bad_ones_end_nothing(logs, steady_watch):
    rows = pd.read_csv(logs / "same.csv").to_numpy()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    sent, sender = threading.Event(), []

    def send_rows():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.sendto(b"hello", ("127.0.0.1", port))
            for i in range(0, len(rows), 100):
                out.sendto(rows[i : i + 100].astype("<f8").tobytes(), ("127.0.0.1", port))
                out.sendto(b"\x00\x01", ("127.0.0.1", port))
                time.sleep(0.002)
        time.sleep(0.5)
        sent.set()

    def start_sender():
        # called first when the address is open
        if not sender:
            sender.append(threading.Thread(target=send_rows))
            sender[0].start()
        return sent.is_set()

    live = jaxbl.watch(
        f"udp://127.0.0.1:{port}", logs / "axis.toml", alarm_gap=1.02 * HALF_GAP, ended=start_sender, **WINDOW
    )
    sender[0].join()
    assert live.summary["left_out"] == {"malformed datagrams or lines": 101}
    pd.testing.assert_frame_equal(live.values, steady_watch.values, rtol=1e-6, atol=1e-9)


def test_values_are_the_same_whatever_pieces_rows_come_in(logs):
    task = read_watch_task("udp://127.0.0.1:1", logs / "axis.toml", **WINDOW)
    rows = pd.read_csv(logs / "same.csv")
    result = []
    with jax.enable_x64(True):
        for size in (10_000, 333):
            watcher = Watcher(task, lambda values: None)
            for i in range(0, len(rows), size):
                part = rows[i : i + size]
                positions = {"motor": part["theta_e"].to_numpy(), "load": part["theta_s"].to_numpy()}
                watcher.take(jaxbl.records.live.Rows(float(part["t"].iloc[0]), part["u"].to_numpy(), positions, i == 0))
            result.append(pd.DataFrame(watcher.values))
    pd.testing.assert_frame_equal(*result, rtol=1e-6, atol=1e-9)


def test_a_drive_that_stands_still_determines_nothing(logs, tmp_path):
    """Lines say so, and it is no error."""
    rows = pd.read_csv(logs / "same.csv")
    standstill = rows.copy()
    standstill[["u", "theta_e", "theta_s"]] = [0.0, 0.3, 0.05]
    log = tmp_path / "log.csv"
    standstill.to_csv(log, index=False)
    task = read_watch_task(log, logs / "axis.toml", follow=True, alarm_gap=LIMIT, **WINDOW)
    result = run_watch(task, ended=end_after_looks(8))
    assert (result.summary["values"], result.summary["determined"], result.summary["alarm"]) == (12, 0, None)
    assert jaxbl.write_report(result, tmp_path).headline.startswith("Nothing was determined (12 values)")


def test_the_command_leaves_files_and_ends_with_3_after_an_alarm(logs, tmp_path, capsys):
    words = ("watch", logs / "grown.csv", "--model", logs / "axis.toml", "--alarm-gap", LIMIT, *OPTIONS)
    assert run_command(*words, "--out", tmp_path / "out") == 3
    output = capsys.readouterr().out.splitlines()
    lines = [line for line in output if re.match(r" *\d+\.\d s ", line)]
    assert len(lines) == 24
    assert all(len(line) <= 100 for line in lines)
    assert sum(line.endswith("ALARM") for line in lines) > 5
    assert any(line.startswith("✗ Failed: ALARM from ") for line in output)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "figures",
        "manifest.json",
        "report.html",
        "watch.csv",
        "watch.json",
    ]
    values = pd.read_csv(tmp_path / "out" / "watch.csv")
    summary = read_result(tmp_path / "out" / "watch.json")
    assert values["t"][values["alarm"]].iloc[0] == summary["alarm"]["t"]
    assert (tmp_path / "out" / "figures" / "watch.png").stat().st_size > 10_000
    # the same log again, and another one
    assert run_command(*words, "--out", tmp_path / "out", "--quiet") == 3
    assert capsys.readouterr().out == ""
    other = ("watch", logs / "same.csv", "--model", logs / "axis.toml", *OPTIONS, "--out", tmp_path / "out")
    assert run_command(*other) == 2
    assert "holds results of another log" in capsys.readouterr().err
    assert run_command(*other, "--overwrite") == 0


def test_json_is_a_line_for_each_row_of_values_and_one_for_the_end(logs, tmp_path, capsys):
    words = ("watch", logs / "grown.csv", "--model", logs / "axis.toml", "--alarm-gap", LIMIT, *OPTIONS)
    assert run_command(*words, "--out", tmp_path / "out", "--json") == 3
    *values, end = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert len(values) == 24
    assert values[-1]["alarm"]
    assert values[-1]["half_gap"] == pytest.approx(2.0 * HALF_GAP, rel=0.02)
    assert (end["command"], end["exit"], end["summary"]["alarms"]) == ("watch", 3, sum(row["alarm"] for row in values))


@pytest.mark.parametrize(("number", "alarm"), [(signal.SIGINT, False), (signal.SIGTERM, True)], ids=["Ctrl+C", "kill"])
def test_a_file_that_grows_is_watched_until_it_is_interrupted(logs, tmp_path, capsys, number, alarm):
    """A user sees values while the file grows, a summary at the end, and what came is kept."""
    log, rows = tmp_path / "log.csv", (logs / "same.csv").read_text().splitlines(keepends=True)
    log.write_text("".join(rows[:6000]))
    limit = ["--alarm-gap", str(0.9 * HALF_GAP)] if alarm else []
    words = ["watch", log, "--model", logs / "axis.toml", "--follow", *OPTIONS, *limit, "--out", tmp_path / "out"]
    with start_command(*words, cwd=tmp_path, PYTHONUNBUFFERED="1") as process:
        lines = [process.stdout.readline()]
        with log.open("a") as file:
            file.writelines(rows[6000:])
        while not lines[-1].lstrip().startswith("9.5 s") and process.poll() is None:
            lines.append(process.stdout.readline())
        values = (tmp_path / "out" / "watch.csv").read_text().splitlines()
        process.send_signal(number)
        final_output, errors = process.communicate(timeout=120)
    assert process.returncode == (3 if alarm else 0), errors
    assert [line.split(" s ")[0].strip() for line in lines] == [f"{4.0 + 0.5 * i:.1f}" for i in range(12)]
    assert len(values) == 13
    assert ("ALARM from 4.0 s on" in final_output) == alarm
    assert "  half gap at 4.0 s (95 %: 0.0" in final_output
    assert errors == f"jaxbl: watching {log}; Ctrl+C ends it\n"
    assert read_result(tmp_path / "out" / "watch.json")["values"] == 12
    # a stream can't be had again: nothing of it is overwritten
    assert run_command(*words) == 2
    assert "holds values of another stream" in capsys.readouterr().err


def drop_tables(data, *tables):
    return {key: value for key, value in data.items() if key not in tables}


BAD = {
    "no gap to watch": (rigid_study(), {}, "drive.kind rigid has no gap to watch"),
    "no gains": (drop_tables(axis(), "observer"), {}, r"\[observer.motor\] has no gains; jaxbl tune"),
    "window too short": (axis(), {"window": 0.1}, "window is 0.1 s; .* at least 0.5 s"),
    "window longer than the log": (axis(), {"window": 100.0}, "has 9.999 s, window is 100 s"),
    "no window": (axis(), {"window": 0.0}, "window is 0; it should be positive"),
    "limit": (axis(), {"alarm_gap": -1.0}, "alarm-gap is -1; it should be positive"),
    "values too often": (axis(), {"interval": 1e-4}, "every is 0.0001 s; it should be at least the sampling period"),
    "period": (
        small_study({"run.sample_period": 2e-3}),
        {},
        r"samples are 1 ms apart, \[run\] sample_period of the model is 2 ms",
    ),
    "whole log": (axis(log={"theta_s": {"skew": 1e-3}}), {"follow": True}, r"\[log\] theta_s.skew is for whole logs"),
    "column": (axis(log={"theta_s": "other"}), {}, "no column 'other'"),
}


@pytest.mark.parametrize(("data", "given", "message"), BAD.values(), ids=list(BAD))
def test_bad_input_is_one_line(logs, data, given, message):
    with pytest.raises(InputError, match=message) as error:
        jaxbl.watch(logs / "same.csv", data, **given)
    assert "\n" not in str(error.value)


def test_bad_logs_are_one_line(logs, tmp_path):
    """A log that is read whole is refused by the reader, as by the other commands."""
    rows = pd.read_csv(logs / "same.csv")
    broken = {
        "no column 'u'": rows.drop(columns="u"),
        "time goes back": rows.iloc[[*range(500), 100, *range(500, 9000)]],
        "data row 301 is 'off'": rows.assign(theta_e=rows["theta_e"].astype(object).where(rows.index != 300, "off")),
        "has no load position": rows.drop(columns="theta_s"),
    }
    for message, log in broken.items():
        log.to_csv(tmp_path / "log.csv", index=False)
        with pytest.raises(InputError, match=message):
            jaxbl.watch(tmp_path / "log.csv", logs / "axis.toml", **WINDOW)


def test_gaps_in_a_log_part_it(logs, tmp_path):
    """Observers begin anew after a gap; the window goes on."""
    rows = pd.read_csv(logs / "same.csv").drop(index=range(5000, 5300))
    rows.to_csv(tmp_path / "log.csv", index=False)
    watch = jaxbl.watch(tmp_path / "log.csv", logs / "axis.toml", **WINDOW)
    assert watch.summary["samples"] == 9700
    assert np.abs(watch.values["half_gap"] / HALF_GAP - 1.0).max() < 0.01
    assert watch.values["t"].tolist() == pytest.approx([4.0, 4.5, 5.3, *np.arange(5.5, 9.9, 0.5)])


def test_remarks_say_that_nothing_comes_and_what_is_left_out(logs, monkeypatch):
    monkeypatch.setattr("jaxbl.monitoring.watch._QUIET", 0.2)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.bind(("127.0.0.1", 0))
        port = out.getsockname()[1]
    heard, calls = [], []

    def send_and_count():
        if not calls:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
                out.sendto(b"1,2,3", ("127.0.0.1", port))
        calls.append(0)
        return len(calls) > 8

    task = read_watch_task(f"udp://127.0.0.1:{port}", logs / "axis.toml", **WINDOW)
    run_watch(task, on_remark=heard.append, ended=send_and_count)
    assert any("nothing that can be read has come for" in remark for remark in heard)
    assert any(
        "1 malformed datagrams or lines; the last: 3 cells in '1,2,3'; there should be 4" in remark for remark in heard
    )


def test_a_drive_by_another_simulator(tmp_path):
    """One that shares nothing with the package: gap, stiffness and dry friction of both sides, which the model lacks."""
    log, _ = simulate_geared_drive()
    log.write(tmp_path / "log.csv")
    data = axis(4.0, transmission=GAP | {"half_gap": 0.06, "stiffness": 50.0})
    data["run"]["sample_period"] = 2e-3
    watch = jaxbl.watch(tmp_path / "log.csv", data, window=3.0, interval=0.5)
    assert watch.summary["determined"] == watch.summary["values"] == 2
    last = watch.summary["last"]
    assert last["half_gap"] == pytest.approx(GAP["half_gap"], rel=0.01)
    assert last["stiffness"] == pytest.approx(GAP["stiffness"], rel=0.01)
    for side, friction in zip(("motor", "load"), FRICTIONS, strict=True):
        assert last[f"{side}.coulomb"] == pytest.approx(friction["torque"], rel=0.15)


def test_a_recording_in_mcap_is_watched_as_the_same_log_in_csv(growing_watch, logs, tmp_path):
    log = pd.read_csv(logs / "grown.csv")
    write_mcap(tmp_path / "grown.mcap", {"axis": zip(log.pop("t"), log.to_dict("records"), strict=True)})
    columns = {name: f"/axis.{name}" for name in ("u", "theta_e", "theta_s")}
    data = axis(log=columns)
    watch = jaxbl.watch(tmp_path / "grown.mcap", data, alarm_gap=LIMIT, **WINDOW)
    pd.testing.assert_frame_equal(watch.values, growing_watch[0].values, rtol=1e-6)
    with pytest.raises(InputError, match=r"grown\.mcap: .*follow"):
        jaxbl.watch(tmp_path / "grown.mcap", data, follow=True, **WINDOW)


def blind_logs(logs):
    """Ways in which a drive is not seen in the second half of a log: text for its rows, by name."""
    rows = pd.read_csv(logs / "same.csv")
    still = rows.copy()
    still.loc[still.index >= 5000, ["u", "theta_e", "theta_s"]] = [0.0, 0.3, 0.05]
    stuck = rows.copy()
    stuck.loc[stuck.index >= 5000, "theta_s"] = 0.05
    return {"stands still": still, "an encoder stands still": stuck}


@pytest.mark.parametrize("way", ["stands still", "an encoder stands still"])
@pytest.mark.parametrize("follow", [True, False])
def test_a_watch_that_does_not_see_says_so(way, follow, logs, tmp_path):
    """In its values while it runs, in the summary, and on the page."""
    log = tmp_path / "log.csv"
    blind_logs(logs)[way].to_csv(log, index=False)
    values = []
    task = read_watch_task(log, logs / "axis.toml", follow=follow, alarm_gap=LIMIT, window=1.0, interval=0.5, blind=2.0)
    result = run_watch(task, on_values=values.append, ended=end_after_looks(12))
    first_blind = next(row["t"] for row in values if row["blind"])
    assert 7.0 < first_blind < 9.0
    assert result.summary["blind"]["limit"] == 2.0
    assert 2.0 < result.summary["blind"]["longest"] < 5.0
    card = jaxbl.write_report(result, tmp_path / "out")
    assert (card.verdict, card.headline[:6]) == ("failed", "BLIND:")
    longer = jaxbl.watch(log, logs / "axis.toml", window=1.0, interval=0.5, blind=6.0)
    assert longer.summary["blind"]["longest"] == 0.0


def test_a_stream_that_stops_is_said_to_be_blind_and_the_code_is_4(logs, tmp_path):
    """The file says so while the watch runs."""
    log = tmp_path / "log.csv"
    log.write_text("".join((logs / "same.csv").read_text().splitlines(keepends=True)[:6000]))
    words = ["watch", log, "--model", logs / "axis.toml", "--follow", *OPTIONS, "--blind", "1.5", "--out", tmp_path / "out"]
    with start_command(*words, cwd=tmp_path, PYTHONUNBUFFERED="1") as process:
        line = ""
        while "BLIND: no number for more than 1.5 s" not in line and process.poll() is None:
            line = process.stdout.readline()
        assert pd.read_csv(tmp_path / "out" / "watch.csv")["blind"].tolist()[-1]
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=120)
    assert process.returncode == 4, errors
    assert "BLIND: no number for" in output


@pytest.mark.parametrize("jump", [-4.0, 1.7e9, -1.7e9])
def test_a_clock_that_is_set_does_not_blind_a_watch(jump, logs, tmp_path):
    """Values go on by the new time."""
    rows = pd.read_csv(logs / "same.csv")
    rows.loc[rows.index >= 5000, "t"] += jump
    rows.to_csv(tmp_path / "log.csv", index=False)
    task = read_watch_task(tmp_path / "log.csv", logs / "axis.toml", follow=True, **WINDOW)
    values = run_watch(task, ended=end_after_looks(12)).values
    after = values[(values["t"] >= 5.0 + jump - 0.1) if jump > 0.0 else values.index > 2]
    assert len(after) >= 8
    assert (after["side"] != "").all()
    assert np.abs(after["half_gap"] / HALF_GAP - 1.0).max() < 0.02
