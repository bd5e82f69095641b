"""Rows that arrive one by one: the numbers of a log that is read whole. What is unfit is counted, and ends nothing."""

import os
import socket
import threading
import time
from collections import Counter

import numpy as np
import pandas as pd
import pytest

from jaxbl.errors import InputError
from jaxbl.records import LogTable, read_record
from jaxbl.records.live import (
    DISORDERED,
    GAPS,
    LOST,
    MALFORMED,
    OTHER_COLUMNS,
    OTHER_FILES,
    OTHER_PERIOD,
    OUTLIERS,
    RESTARTS,
    UNREADABLE,
    Datagrams,
    FollowedFile,
    Stream,
    check_stream_table,
    stream_columns,
)

PERIOD = 1e-3
NAMES = ["t", "u", "theta_e", "theta_s"]


class BlockSource:
    """A source of what it is given, block by block."""

    name, fault = "given", ""

    def __init__(self, *blocks, columns=NAMES):
        self.blocks, self.counts, self.columns = [*blocks], Counter(), columns

    def poll(self, seconds):
        return (self.columns, self.blocks.pop(0)) if self.blocks else None

    def close(self):
        pass


def make_rows(count, start=0.0):
    time = start + np.arange(count) * PERIOD
    return np.stack([time, np.cos(time), np.sin(5.0 * time), np.sin(3.0 * time)], axis=1)


def poll_blocks(*blocks, table=None, columns=NAMES):
    """All rows of some blocks, and what was counted."""
    source = BlockSource(*blocks, columns=columns)
    stream = Stream(source, table or LogTable(), PERIOD)
    rows_of_blocks = [rows for _ in blocks for rows in stream.poll(0.0)]
    return rows_of_blocks, dict(source.counts)


def test_blocks_of_any_size_give_the_rows_as_they_are():
    rows = make_rows(1000)
    parts, counts = poll_blocks(rows[:1], rows[1:300], rows[300:301], rows[301:])
    assert [part.starts_segment for part in parts] == [True, False, False, False]
    assert [part.time for part in parts] == pytest.approx([0.0, 0.001, 0.3, 0.301])
    np.testing.assert_array_equal(np.concatenate([part.torque for part in parts]), rows[:, 1])
    for i, side in enumerate(("motor", "load")):
        np.testing.assert_array_equal(np.concatenate([part.positions[side] for part in parts]), rows[:, 2 + i])
    assert counts == {}


@pytest.mark.parametrize("cut", [7, 500, 501])
def test_lost_samples_are_interpolated_and_counted(cut):
    """Two in a row, wherever blocks end; the input is held."""
    rows = make_rows(1000)
    kept_rows = np.delete(rows, [500, 501], axis=0)
    parts, counts = poll_blocks(kept_rows[:cut], kept_rows[cut:])
    assert counts == {LOST: 2}
    assert not any(part.starts_segment for part in parts[1:])
    torque = np.concatenate([part.torque for part in parts])
    np.testing.assert_array_equal(torque[500:502], rows[499, 1])
    motor = np.concatenate([part.positions["motor"] for part in parts])
    np.testing.assert_allclose(motor, rows[:, 2], atol=5e-5)


def test_a_gap_in_time_begins_anew():
    rows = make_rows(1000)
    kept_rows = np.delete(rows, np.arange(500, 510), axis=0)
    for blocks in ((kept_rows,), (kept_rows[:500], kept_rows[500:])):
        parts, counts = poll_blocks(*blocks)
        assert counts == {GAPS: 1}
        assert [(part.starts_segment, len(part.torque)) for part in parts] == [(True, 500), (True, 490)]
        assert parts[1].time == pytest.approx(0.51)


def test_late_repeated_and_unreadable_rows_are_left_out():
    rows = make_rows(400)
    order = np.r_[0:100, 99, 98, 100:400]
    disordered = rows[order]
    disordered[250, 2] = np.nan
    disordered[300, 0] = np.inf
    parts, counts = poll_blocks(disordered[:101], disordered[101:])
    assert counts == {DISORDERED: 2, UNREADABLE: 2, LOST: 2}
    assert sum(len(part.torque) for part in parts) == 400


def test_a_clock_that_is_set_back_begins_anew():
    parts, counts = poll_blocks(np.concatenate([make_rows(300, start=50.0), make_rows(200)]))
    assert counts == {RESTARTS: 1}
    assert [(part.time, len(part.torque), part.starts_segment) for part in parts] == [(50.0, 300, True), (0.0, 200, True)]


def test_stamps_may_jitter():
    rows = make_rows(2000)
    rows[:, 0] += np.random.default_rng(0).uniform(-0.2, 0.2, 2000) * PERIOD
    parts, counts = poll_blocks(rows)
    assert counts == {}
    np.testing.assert_array_equal(parts[0].torque, rows[:, 1])


@pytest.mark.parametrize("factor", [2.0, 0.5, 1.05, 1e3])
def test_another_period_than_the_models_is_one_line(factor):
    rows = make_rows(300)
    rows[:, 0] *= factor
    with pytest.raises(InputError, match=r"given: samples are .* ms apart, \[run\] sample_period of the model is 1 ms"):
        poll_blocks(rows)


def test_stamps_rounded_to_more_than_a_period_are_refused():
    rows = make_rows(400)
    rows[:, 0] = np.floor(rows[:, 0] / (4 * PERIOD)) * 4 * PERIOD
    with pytest.raises(InputError, match="most rows have the time stamp of the row before"):
        poll_blocks(rows)


TABLES = {
    "units": {
        "t": {"column": "ms", "unit": "ms"},
        "u": {"column": "amps", "unit": "A", "factor": 0.05, "sign": -1},
        "theta_e": {"column": "counts", "unit": "counts", "counts_per_turn": 4096, "wrap": 65536},
        "theta_s": {"column": "deg", "unit": "deg", "offset": 0.25},
    },
    "difference, words": {
        "t": {"column": "ms", "unit": "ms"},
        "u": {"column": "word", "factor": 0.01, "signed_bits": 16},
        "theta_e": {"column": "sum", "minus": "deg", "unit": "deg"},
        "theta_s": {"column": "deg", "unit": "deg"},
    },
    "sign and magnitude": {
        "t": {"column": "ms", "unit": "ms"},
        "u": {"column": "magnitude", "factor": 0.01, "sign_bit": 10},
        "theta_e": {"column": "sum", "minus": "deg", "unit": "deg"},
        "theta_s": {"column": "deg", "unit": "deg"},
    },
    "numbers, without stamps": {"t": {"period": PERIOD}, "u": 1, "theta_e": {"column": 5, "unit": "deg"}, "theta_s": 3},
    "speed": {
        "t": {"column": "ms", "unit": "ms"},
        "u": "amps",
        "omega_e": {"column": "rpm", "unit": "rpm"},
        "theta_s": {"column": "deg", "unit": "deg"},
    },
}


def make_columns(count=2000):
    time = np.arange(count) * PERIOD
    motor, load = 40.0 * np.sin(3.0 * time), 8.0 * np.sin(3.0 * time + 0.05)
    return pd.DataFrame(
        {
            "ms": 1e3 * time,
            "amps": np.cos(3.0 * time),
            "counts": np.round(motor * 4096 / (2 * np.pi)) % 65536,
            "deg": np.rad2deg(load),
            "word": np.round(100.0 * np.cos(3.0 * time)) % 65536,
            "sum": np.rad2deg(motor + load),
            "rpm": 120.0 * np.cos(3.0 * time) * 30.0 / np.pi,
            "magnitude": np.abs(np.round(100.0 * np.cos(3.0 * time))) + 1024 * (np.cos(3.0 * time) < 0.0),
        }
    )


@pytest.mark.parametrize("table", TABLES.values(), ids=list(TABLES))
def test_rows_are_what_the_reader_makes_of_the_whole_log(table, tmp_path):
    log, table = tmp_path / "log.csv", LogTable.model_validate(table)
    make_columns().to_csv(log, index=False)
    record = read_record(log, table)
    check_stream_table(table, "log")
    stream = Stream(FollowedFile(log), table, PERIOD)
    parts = [rows for _ in range(100) for rows in stream.poll(0.0)]
    stream.source.close()
    assert stream.counts == {}
    np.testing.assert_allclose(np.concatenate([part.torque for part in parts]), record.torque, atol=1e-12)
    for side, positions in record.positions.items():
        np.testing.assert_allclose(np.concatenate([part.positions[side] for part in parts]), positions, atol=1e-9)


def test_only_rows_with_a_mode_are_read():
    rows = np.c_[make_rows(600), np.ones(600)]
    rows[200:300, 4] = 0.0
    table = LogTable.model_validate({"where": {"on": True}})
    parts, counts = poll_blocks(rows, table=table, columns=[*NAMES, "on"])
    assert counts == {GAPS: 1}
    assert [len(part.torque) for part in parts] == [200, 300]


REFUSED = {
    "theta_s.skew": {"theta_s": {"skew": 1e-3}},
    "resample": {"resample": 1e-3},
    "start": {"start": 1.0},
    "where.mode": {"where": {"mode": "auto"}},
    "absent: theta_s": {"absent": ["theta_s"]},
}


@pytest.mark.parametrize(("key", "table"), REFUSED.items(), ids=list(REFUSED))
def test_what_needs_the_whole_log_is_refused(key, table):
    with pytest.raises(InputError, match=rf"log.csv: \[log\] {key}"):
        check_stream_table(LogTable.model_validate(table), "log.csv")


def test_a_file_is_followed_from_its_beginning_line_by_line(tmp_path):
    """Written in pieces that end anywhere, with remarks, a line of another form, and a header that comes again."""
    log, rows = tmp_path / "log.csv", make_rows(50)
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    text = "\n".join(["# a remark", ",".join(NAMES), *lines[:20], "1,2", ",".join(NAMES), *lines[20:]]) + "\n"
    log.write_text("")
    source, blocks = FollowedFile(log), []
    with log.open("a") as file:
        for i in range(0, len(text), 37):
            file.write(text[i : i + 37])
            file.flush()
            read = source.poll(0.0)
            blocks += [] if read is None else [read[1]]
    np.testing.assert_array_equal(np.concatenate(blocks), rows)
    assert source.counts == {MALFORMED: 1}
    assert source.fault == "; a line should have 4 cells"
    # cut off and written anew, as programs do that keep files short
    log.write_text("\n".join([",".join(NAMES), *lines[:5]]) + "\n")
    read = source.poll(0.0)
    assert read is not None
    np.testing.assert_array_equal(read[1], rows[:5])
    assert source.poll(0.0) is None
    source.close()


def test_semicolons_and_decimal_commas_are_read(tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("t;u;theta_e;theta_s\n0,001;-1,5;2e-3;0\n0,002;-1;x;0\n")
    source = FollowedFile(log)
    names, values = source.poll(0.0)
    source.close()
    assert names == NAMES
    np.testing.assert_array_equal(values, [[0.001, -1.5, 2e-3, 0.0], [0.002, -1.0, np.nan, 0.0]])


def test_a_missing_column_is_named(tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("t,u,theta_e,thetas\n0,1,2,3\n")
    stream = Stream(FollowedFile(log), LogTable(), PERIOD)
    with pytest.raises(InputError, match=r"log.csv: no column 'theta_s'; did you mean 'thetas'\?; \[log\] theta_s can name"):
        stream.poll(0.0)
    stream.source.close()


def test_what_is_no_text_is_not_followed(tmp_path):
    log = tmp_path / "log.bin"
    log.write_bytes(b"PAR1\0\0\0\0\n")
    source = FollowedFile(log)
    with pytest.raises(InputError, match="only text files are followed"):
        source.poll(0.0)
    source.close()
    (tmp_path / "loge.csv").write_text("")
    with pytest.raises(InputError, match=r"log\.csv: no such file; did you mean .*loge\.csv\?"):
        FollowedFile(tmp_path / "log.csv")
    with pytest.raises(InputError, match="cannot be read: Is a directory; name a text file"):
        FollowedFile(tmp_path)


@pytest.fixture
def datagrams():
    """A source, and a function that sends to it."""
    source = Datagrams("udp://127.0.0.1:0", NAMES)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        yield source, lambda *data: [sender.sendto(part, ("127.0.0.1", source.port)) for part in data]
    source.close()


def test_datagrams_are_rows_of_text_or_of_numbers(datagrams):
    source, send = datagrams
    send(b"0,1,2,3\n", np.arange(8.0).astype("<f8").tobytes(), b"4,5,6,7\n8,9,10,11")
    names, values = source.poll(0.1)
    assert names == NAMES
    np.testing.assert_array_equal(values, [[0, 1, 2, 3], [0, 1, 2, 3], [4, 5, 6, 7], [4, 5, 6, 7], [8, 9, 10, 11]])
    assert source.counts == {}
    assert source.poll(0.01) is None


def test_a_header_says_the_order_and_may_come_with_each_datagram(datagrams):
    source, send = datagrams
    send(b"theta_s,theta_e,u,t,more\n1,2,3,4,5\n", b"theta_s,theta_e,u,t,more\n6,7,8,9,10\n")
    names, values = source.poll(0.1)
    assert names == ["theta_s", "theta_e", "u", "t", "more"]
    np.testing.assert_array_equal(values, [[1, 2, 3, 4, 5], [6, 7, 8, 9, 10]])
    assert source.counts == {}


def test_no_datagram_ends_a_stream(datagrams):
    source, send = datagrams
    bad_datagrams = [b"", b"hello", b"t,u,x,y\n", b"1,2,3", b"\x00" * 9, b"\xff\xfe", bytes(range(256)) + b"!" * 5]
    send(*bad_datagrams)
    assert source.poll(0.1) is None
    assert source.counts == {MALFORMED: len(bad_datagrams) - 1}  # nothing is in the first
    assert source.fault.startswith("; the last: ")
    send(b"0,1,2,3", b"4,5", b"6,7,8,nan")
    np.testing.assert_array_equal(source.poll(0.1)[1], [[0, 1, 2, 3], [6, 7, 8, np.nan]])
    assert source.counts == {MALFORMED: len(bad_datagrams)}


def test_addresses_are_checked():
    for address in ("udp://", "udp://host", "tcp://127.0.0.1:9", "udp://127.0.0.1:99999", "udp://127.0.0.1:9/x"):
        with pytest.raises(InputError, match="should be udp://HOST:PORT"):
            Datagrams(address, NAMES)
    first = Datagrams("udp://127.0.0.1:0", NAMES)
    with pytest.raises(InputError, match="cannot listen there"):
        Datagrams(f"udp://127.0.0.1:{first.port}", NAMES)
    first.close()


def test_fields_without_a_header_follow_the_table():
    assert stream_columns(LogTable()) == NAMES
    table = LogTable.model_validate(TABLES["difference, words"] | {"where": {"on": 1}})
    assert stream_columns(table) == ["ms", "word", "sum", "deg", "on"]
    assert stream_columns(LogTable.model_validate(TABLES["numbers, without stamps"])) == [1, 5, 3]


def test_polling_waits_no_longer_than_asked(datagrams):
    source, send = datagrams
    sender = threading.Timer(0.05, send, (b"0,1,2,3\n",))
    sender.start()
    begin = time.monotonic()
    assert source.poll(0.3) is not None
    assert time.monotonic() - begin < 30.0
    sender.join()


def follow(tmp_path, *writes, table=None):
    """Rows and counts of a file on which `writes` (text to append, or functions of its path) follow one another."""
    log = tmp_path / "log.csv"
    log.write_text("")
    stream = Stream(FollowedFile(log, stream_columns(table or LogTable())), table or LogTable(), PERIOD)
    rows = []
    for write in writes:
        if callable(write):
            write(log)
        else:
            with log.open("a", newline="") as file:
                file.write(write)
        for _ in range(20):
            rows += stream.poll(0.0)
    stream.source.close()
    return rows, dict(stream.counts), stream.source.fault


def make_text(rows, names=NAMES):
    """A header and lines."""
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    return "\n".join([",".join(names), *lines]) + "\n"


ROW = "{t!r},{u!r},{motor!r},{load!r}"
BAD_ROWS = {
    "stamp of 1e308": (ROW.replace("{t!r}", "1e308"), UNREADABLE),
    "stamp of 1e14": (ROW.replace("{t!r}", "1e14"), UNREADABLE),
    "stamp of 1e9": (ROW.replace("{t!r}", "1e9"), OUTLIERS),
    "stamp of -5e4": (ROW.replace("{t!r}", "-5e4"), OUTLIERS),
    "lone CR": (ROW.replace(",{load!r}", "\r,{load!r}"), MALFORMED),
    "cell of 200 kB": (ROW.replace("{u!r}", "x" * 200_000), MALFORMED),
    "line of 3 MB": ("1," * 1_500_000 + "\n" + ROW, MALFORMED),
    "open quote": (ROW.replace("{load!r}", '"{load!r}'), None),
    "quotes around two cells": (ROW.replace("{t!r},{u!r}", '"{t!r},{u!r}"'), MALFORMED),
    "remark within": (ROW.replace(",{load!r}", "#,{load!r}"), MALFORMED),
    "word": (ROW.replace("{motor!r}", "off"), UNREADABLE),
    "underscore": (ROW.replace("{motor!r}", "1_000"), UNREADABLE),
    "NUL": (ROW.replace("{motor!r}", "\0"), UNREADABLE),
    "position of 1e300": (ROW.replace("{motor!r}", "1e300"), UNREADABLE),
    "position of 1e20": (ROW.replace("{motor!r}", "1e20"), OUTLIERS),
    "position of 500": (ROW.replace("{load!r}", "-500.0"), OUTLIERS),
    "torque of 1e9": (ROW.replace("{u!r}", "1e9"), OUTLIERS),
    "header of others": ("t,torque,theta_e,theta_s\n" + ROW, UNREADABLE),
    "words": ("x,x,x,x\n" + ROW, UNREADABLE),
}


@pytest.mark.parametrize(("line", "fault"), BAD_ROWS.values(), ids=list(BAD_ROWS))
def test_one_row_neither_ends_a_stream_nor_blinds_it(line, fault, tmp_path):
    """It is counted as what it is, and all other rows are read."""
    rows = make_rows(900)
    bad_line = line.format(**dict(zip(("t", "u", "motor", "load"), rows[600].tolist(), strict=True)))
    text = make_text(rows[:600]) + bad_line + "\n" + make_text(rows[601:]).partition("\n")[2]
    parts, counts, _ = follow(tmp_path, text[:9000], text[9000:])
    counts.pop(LOST, None)
    assert counts == {} if fault is None else set(counts) == {fault}
    assert not any(part.starts_segment for part in parts[1:])
    np.testing.assert_allclose(np.concatenate([part.positions["motor"] for part in parts]), rows[:, 2], atol=5e-5)


def test_a_wrapped_position_is_no_outlier_where_it_wraps(tmp_path):
    """A turn forth and back at the wrap, and a reading beyond it."""
    table = LogTable.model_validate({"theta_e": {"wrap": 1.0}})
    motor = np.cumsum(np.tile([0.01, -0.01], 300)) + np.where(np.arange(600) < 300, 0.995, 3.995)
    motor[300] = motor[299]
    rows = make_rows(600)
    rows[:, 2] = motor % 1.0
    rows[450, 2] = 1e15
    parts, counts, _ = follow(tmp_path, make_text(rows), table=table)
    assert counts == {UNREADABLE: 1, LOST: 1}
    positions = np.concatenate([part.positions["motor"] for part in parts])
    assert np.abs(np.diff(positions)).max() < 0.02


@pytest.mark.parametrize("replaced", [True, False], ids=["another file", "the same file"])
@pytest.mark.parametrize("order", [[3, 2, 1, 0], [0, 2, 1, 3], [0, 1, 3, 2]])
def test_a_new_header_is_read(order, replaced, tmp_path):
    """Another order of columns, in the same file or in one that takes its place."""
    rows = make_rows(1200)
    text = make_text(rows[600:, order], [NAMES[i] for i in order])

    def replace_file(log):
        (log.parent / "new.csv").write_text(text)
        (log.parent / "new.csv").rename(log)

    parts, counts, _ = follow(tmp_path, make_text(rows[:600]), replace_file if replaced else text)
    assert counts == {}
    assert [part.starts_segment for part in parts if part.starts_segment] == [True, True]
    np.testing.assert_array_equal(np.concatenate([part.positions["load"] for part in parts]), rows[:, 3])


def replace_by_folder(log):
    log.unlink()
    log.mkdir()


def replace_by_pipe(log):
    log.unlink()
    os.mkfifo(log)


def replace_by_link_to_a_device(log):
    log.unlink()
    log.symlink_to("/dev/zero")


def write_other_columns(log):
    log.unlink()
    log.write_text(make_text(make_rows(300), ["t", "u", "a", "b"]))


def write_other_period(log):
    rows = make_rows(900)
    rows[:, 0] = 0.7 * rows[:, 0]
    log.unlink()
    log.write_text(make_text(rows))


def write_nothing_that_is_text(log):
    log.unlink()
    log.write_bytes(bytes(range(256)) * 100)


@pytest.mark.parametrize(
    ("replace_file", "fault"),
    [
        (replace_by_folder, OTHER_FILES),
        (replace_by_pipe, OTHER_FILES),
        (replace_by_link_to_a_device, OTHER_FILES),
        (write_other_columns, OTHER_COLUMNS),
        (write_other_period, OTHER_PERIOD),
        (write_nothing_that_is_text, None),
    ],
)
def test_what_takes_the_place_of_a_file_is_said_and_ends_nothing(replace_file, fault, tmp_path):
    """What can be followed afterwards is."""
    rows = make_rows(600)

    def write_again(log):
        log.rmdir() if log.is_dir() else log.unlink()
        (log.parent / "new.csv").write_text(make_text(rows))
        (log.parent / "new.csv").rename(log)

    parts, counts, said = follow(tmp_path, make_text(rows), replace_file, write_again)
    assert fault is None or fault in counts
    assert said
    np.testing.assert_array_equal(np.concatenate([part.positions["motor"] for part in parts])[-600:], rows[:, 2])


def test_a_file_that_is_cut_off_may_go_on_without_a_header(tmp_path):
    rows = make_rows(1200)
    parts, counts, _ = follow(
        tmp_path,
        make_text(rows[:900]),
        lambda log: log.write_text(make_text(rows[900:1000]).partition("\n")[2]),
        make_text(rows[1000:]).partition("\n")[2],
    )
    assert counts == {}
    np.testing.assert_array_equal(np.concatenate([part.torque for part in parts]), rows[:, 1])


def test_a_burst_is_taken_in_pieces(tmp_path):
    (tmp_path / "log.csv").write_text(make_text(make_rows(20_000)))
    stream = Stream(FollowedFile(tmp_path / "log.csv"), LogTable(), PERIOD)
    sizes = [sum(len(rows.torque) for rows in stream.poll(0.0)) for _ in range(40)]
    assert max(sizes) <= 2048
    assert sum(sizes) == 20_000
    assert stream.poll(0.0) == []
    stream.source.close()


def test_datagrams_with_another_header_are_read_by_it(datagrams):
    source, send = datagrams
    send(b"t,u,theta_e,theta_s\n0,1,2,3\n", b"theta_s,theta_e,u,t\n7,6,5,4\n", b"11,10,9,8\n", b"x,x,x\n")
    blocks = [source.poll(0.1), source.poll(0.0)]
    assert [list(columns) for columns, _ in blocks] == [NAMES, NAMES[::-1]]
    np.testing.assert_array_equal(blocks[0][1], [[0, 1, 2, 3]])
    np.testing.assert_array_equal(blocks[1][1], [[7, 6, 5, 4], [11, 10, 9, 8]])
    assert source.counts == {MALFORMED: 1}
