"""A study whose folder is in an object store: the same parts as on a disk, restart, damage, stores that do not answer."""

import boto3
import pandas as pd
import pytest
from moto.server import ThreadedMotoServer
from small_study import ALPHA, listed_axis, read_parts, thirty_run_study

from jaxbl.errors import InputError
from jaxbl.files import MANIFEST, to_path
from jaxbl.report.results import write_report
from jaxbl.sweeps.status import status
from jaxbl.sweeps.sweep import open_study, repair, share, sweep

pytestmark = pytest.mark.usefixtures("compiled_once")


@pytest.fixture(scope="module")
def bucket():
    """Address of an empty one, in a store of this process."""
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    names = {
        "ACCESS_KEY_ID": "a",
        "SECRET_ACCESS_KEY": "b",
        "ENDPOINT_URL": f"http://{host}:{port}",
        "DEFAULT_REGION": "us-east-1",
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in names.items():
            patch.setenv(f"AWS_{name}", value)
        boto3.client("s3").create_bucket(Bucket="bucket")
        yield "s3://bucket"
    server.stop()


@pytest.fixture(scope="module")
def disk_study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("alone") / "study"
    return folder, sweep(thirty_run_study(), folder)


def read_objects(address):
    """Names below an address, with their content."""
    bucket, _, prefix = address.removeprefix("s3://").partition("/")
    client = boto3.client("s3")
    names = [stored["Key"] for stored in client.list_objects_v2(Bucket=bucket, Prefix=prefix).get("Contents", [])]
    return {name.removeprefix(f"{prefix}/"): client.get_object(Bucket=bucket, Key=name)["Body"].read() for name in names}


def test_a_study_in_a_store_is_that_of_a_disk(bucket, disk_study, computed_chunks):
    folder, result = disk_study
    address = f"{bucket}/a/study"
    first = share(thirty_run_study(), address, (1, 2))
    assert (first.parts, first.finished) == (4, False)
    study = sweep(thirty_run_study(), address)
    assert sorted(computed_chunks) == list(range(8))
    pd.testing.assert_frame_equal(study.frame, result.frame, check_exact=True)
    stored = read_objects(address)
    assert {name for name in stored if not name.startswith("points/")} == {MANIFEST, "study.toml"}
    assert {name.removeprefix("points/"): stored[name] for name in stored if name.startswith("points/")} == read_parts(
        folder
    )
    # again: only read
    assert sweep(thirty_run_study(), address).cost["lanes"] == 0
    assert read_objects(address) == stored
    assert status(address).finished
    pd.testing.assert_frame_equal(open_study(address).frame, result.frame, check_exact=True)
    with pytest.raises(InputError, match="holds results of another study"):
        sweep(thirty_run_study(sweep={"seeds": 3, "chunk": 4}), address)
    sweep(thirty_run_study(axes=[listed_axis(ALPHA, 5.0, 9.0)]), address, overwrite=True)
    assert set(read_objects(address)) == {
        MANIFEST,
        "study.toml",
        *(f"points/part-0000{seed}.parquet" for seed in (0, 1)),
    }


def test_damage_in_a_store_is_noticed_and_healed(bucket, disk_study, computed_chunks):
    address = f"{bucket}/b"
    sweep(thirty_run_study(), address)
    computed_chunks.clear()
    damaged, lost = (to_path(address) / "points" / f"part-0000{index}.parquet" for index in (2, 5))
    damaged.write_bytes(damaged.read_bytes()[:-1000])
    lost.unlink()
    with pytest.raises(InputError, match=r"part-00002\.parquet: is damaged"):
        _ = open_study(address).frame
    assert len(sweep(thirty_run_study(), address).damaged) == 1
    assert sorted(computed_chunks) == [2, 5]
    assert "damaged/part-00002.parquet" in read_objects(address)
    (to_path(address) / MANIFEST).unlink()
    with pytest.raises(InputError, match="has lost its manifest"):
        open_study(address)
    assert repair(address)[0] == 8
    pd.testing.assert_frame_equal(open_study(address).frame, disk_study[1].frame, check_exact=True)


def test_a_report_in_a_store(bucket):
    address = f"{bucket}/c"
    figure = {"kind": "line", "x": ALPHA, "value": "motor.velocity_rmse"}
    write_report(sweep(thirty_run_study(figures=[figure]), address), address)
    stored = read_objects(address)
    (name,) = [name for name in stored if name.startswith("figures/")]
    assert stored[name].startswith(b"\x89PNG") and b"velocity error" in stored["report.html"]


def test_bad_addresses(bucket, monkeypatch):
    with pytest.raises(InputError, match=r"s3://none/x: cannot be written to \(.*bucket.*\); name another folder"):
        sweep(thirty_run_study(), "s3://none/x")
    with pytest.raises(InputError, match=r"s3://none/x: holds no study"):
        open_study("s3://none/x")
    with pytest.raises(InputError, match=r"foo://a: is no place for results"):
        sweep(thirty_run_study(), "foo://a")
