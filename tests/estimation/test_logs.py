"""Several logs of one machine as one record."""

from pathlib import Path

import equinox as eqx
import numpy as np
import pandas as pd
import pytest
from measured import NOMINAL, simulate_axis, simulate_late_log

from jaxbl.config import read_model
from jaxbl.errors import InputError
from jaxbl.estimation.logs import on_record, read_logs, read_with_holdout
from jaxbl.records import Record, read_record

MODEL = {"drive": {"kind": "rigid", "motor_inertia": 4e-5, "motor_viscous": 1e-4}}


def write_log(path: Path, seed: int, zero: float) -> Path:
    """A log of a motor with cogging of 5 a turn, whose encoder has a zero of its own."""
    time = 1e-3 * np.arange(6000)
    position = 20.0 * np.sin(1.5 * time + seed)
    speed, change = 30.0 * np.cos(1.5 * time + seed), -45.0 * np.sin(1.5 * time + seed)
    torque = 4e-5 * change + 1e-4 * speed + 2e-3 * np.sin(5.0 * position)
    noise = np.random.default_rng(seed).standard_normal((2, len(time)))
    pd.DataFrame({"t": time, "u": torque + 3e-4 * noise[0], "theta_e": position - zero + 1e-4 * noise[1]}).to_csv(path)
    return path


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("logs")
    return [write_log(folder / f"{seed}.csv", seed, zero) for seed, zero in ((0, 0.0), (1, 0.3), (2, -0.2))]


def turned_angles(record: Record, paths: list[Path]) -> list[float]:
    """Angles by which the positions of each log of a record were turned, rad."""
    read = np.concatenate([pd.read_csv(part)["theta_e"] for part in paths])
    return [float(np.mean(part)) for part in np.split(record.positions["motor"] - read, len(paths))]


def test_logs_with_other_zeros_are_turned_to_that_of_the_first(paths: list[Path]):
    config, _ = read_model(MODEL)
    record = read_logs(config, paths[:2])
    np.testing.assert_allclose(turned_angles(record, paths[:2]), [0.0, 0.3], atol=0.02)
    (warning,) = record.warnings
    assert warning.startswith(
        "1.csv: theta_e counts from another zero than in 0.csv, by the torque that repeats 5 times a turn"
    )
    holdout = read_logs(config, paths[2], like=record)
    np.testing.assert_allclose(turned_angles(holdout, paths[2:]), [-0.2], atol=0.02)


def test_a_late_torque_of_one_log_is_late_in_the_others(tmp_path: Path):
    config, _ = read_model({"drive": {"kind": "rigid", "motor_inertia": 4e-4, "motor_viscous": 8e-3}})
    for name, frame in (("sure", simulate_late_log(1.5)), ("short", simulate_late_log(1.5).iloc[:150])):
        frame.to_csv(tmp_path / f"{name}.csv")
    assert read_logs(config, tmp_path / "short.csv").corrections == {}
    record = read_logs(config, [tmp_path / "short.csv", tmp_path / "sure.csv"])
    assert len(record.warnings) == 1 and record.warnings[0].startswith("sure.csv: u is 15")
    rows = record.logs[0][1]
    expected = simulate_late_log(0.0, noise=0.0)["u"][rows]
    np.testing.assert_allclose(record.torque[rows][:140], expected[:140], atol=1e-2)
    assert read_logs(config, tmp_path / "short.csv", like=record).corrections == record.corrections
    early = simulate_late_log(-1.0)
    early.to_csv(tmp_path / "early.csv")
    assert read_logs(config, tmp_path / "early.csv", seeks_delay=True).corrections == {}
    assert set(read_logs(config, tmp_path / "early.csv").corrections) == {"u.skew", "u.sampled"}


def test_an_offset_that_is_given_stands(paths: list[Path]):
    config, _ = read_model(MODEL | {"log": {"theta_e": {"column": "theta_e", "offset": 0.0}}})
    record = read_logs(config, paths[:2])
    assert turned_angles(record, paths[:2]) == [0.0, 0.0] and not record.warnings


def test_a_model_of_a_log_has_no_effects_of_encoders(paths: list[Path]):
    config, _ = read_model(MODEL | {"effects": [{"kind": "encoder.offset", "offset": 0.1}]})
    with pytest.raises(InputError, match=r"0\.csv: encoder\.offset has no place in a model of a log: .* theta_e\.offset"):
        read_logs(config, paths[0])


def test_a_model_along_a_log_has_no_excitation(paths: list[Path]):
    """Programs that are compiled for it are those of any other excitation."""
    sweeping = {"kind": "chirp", "amplitude": 0.1, "start_frequency": 1.0, "stop_frequency": 2.0, "sweep_time": 1.0}
    configs = [read_model(MODEL | more)[0] for more in ({}, {"excitation": sweeping})]
    first, second = (on_record(config, read_logs(config, paths[0])) for config in configs)
    assert eqx.tree_equal(first, second)
    assert first.excitation(np.linspace(0.0, 1.0, 9)).tolist() == [0.0] * 9


GEARED = {
    "drive": {"kind": "two_inertia"}
    | {
        name: getattr(NOMINAL, name)
        for name in ("gear_ratio", "motor_inertia", "motor_viscous", "load_inertia", "load_viscous")
    },
    "transmission": {"law": "linear_shaft", "stiffness": NOMINAL.stiffness},
}


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_clock_that_one_log_is_sure_of_holds_for_all_and_for_the_held_out_log(tmp_path: Path, order: tuple[int, int]):
    """A machine's load has a late clock; one log has too much noise to show it."""
    frames = [simulate_axis(skew=3e-3, seed=seed) for seed in range(3)]
    frames[1]["theta_s"] += 0.1 * np.random.default_rng(0).standard_normal(len(frames[1]))
    for i, frame in enumerate(frames):
        frame.to_parquet(tmp_path / f"{i}.parquet")
    config, _ = read_model(GEARED)
    single_records = [read_logs(config, tmp_path / f"{i}.parquet") for i in range(3)]
    assert [list(record.corrections) for record in single_records] == [["skew"], [], ["skew"]]
    record, holdout = read_with_holdout(config, [tmp_path / f"{i}.parquet" for i in order], tmp_path / "2.parquet")
    assert holdout is not None
    moved = f"theta_s: shifted by its skew of {1e3 * single_records[0].corrections['skew']:.4g} ms."
    assert sum(moved in note for note in record.notes) == 2 and moved in holdout.notes
    assert record.corrections == holdout.corrections == single_records[0].corrections


def test_a_record_is_checked_as_a_file_is(tmp_path: Path):
    """It was read without the study, which may need what it lacks."""
    simulate_axis().drop(columns="u").to_parquet(tmp_path / "free.parquet")
    free = read_record(tmp_path / "free.parquet", {"absent": ["u"]}, gear_ratio=20.0)
    config, _ = read_model(GEARED)
    with pytest.raises(InputError, match=r"free\.parquet: without u a motion shows torques only as multiples"):
        read_logs(config, free)
    config, _ = read_model(GEARED | {"uncertainty": {"exact": ["drive.motor_inertia"]}})
    record = read_logs(config, free)
    assert record.torque is not None and not record.torque.any()
    assert read_logs(config, record).notes == record.notes


def test_a_held_out_log_has_the_positions_of_the_log(tmp_path: Path):
    simulate_axis().to_parquet(tmp_path / "both.parquet")
    simulate_axis(seed=1).drop(columns="theta_s").to_parquet(tmp_path / "motor.parquet")
    config, _ = read_model(GEARED)
    with pytest.raises(InputError, match=r"motor\.parquet: has no load position, which .*both\.parquet has"):
        read_with_holdout(config, tmp_path / "both.parquet", tmp_path / "motor.parquet")
    assert read_with_holdout(config, tmp_path / "motor.parquet", tmp_path / "both.parquet")[1] is not None
