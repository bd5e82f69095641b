"""Files as drives, robots and scopes write them, with the truth beside each: does `inspect --write` make a first model?

    python benchmarks/vendor_layouts.py --seed 1 [--apart] [--folder DIR]

Ten layouts, and with --apart ten others that nothing was developed with. A seed draws the motion, names, units, ratios and
stamps. A file counts if a model is proposed without a hand and the channels are the true ones: the right columns, in SI
units where the file gives the unit (else up to a factor that the proposal calls assumed or a placeholder). The rule: 8 of
10, and no whole ratio above 100 that the log contradicts.
"""

import argparse
import json
import re
import traceback
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from jaxbl.errors import InputError
from jaxbl.records.proposal import propose_study

TURN = 2.0 * np.pi


class Motion(NamedTuple):
    """A motion of a geared drive: period and t in s, torque at the motor in N m, angles in rad, speed in rad/s."""

    period: float
    t: np.ndarray
    torque: np.ndarray
    motor: np.ndarray
    load: np.ndarray
    speed: np.ndarray
    ratio: float
    reference: np.ndarray


class Layout(NamedTuple):
    """A file, its channels in SI units by name, those whose unit the file gives, and the ratio of the gear."""

    path: Path
    channels: dict[str, np.ndarray]
    with_unit: tuple[str, ...] = ("theta_e", "theta_s")
    ratio: float = 0.0


def draw_motion(random: np.random.Generator, turns: float = 1.0) -> Motion:
    """Draw a motion of about `turns` of the motor, with the torque that inertia and friction take."""
    period, count = float(random.choice([1e-3, 2e-3, 4e-3, 5e-3])), int(random.integers(2000, 4000))
    t = period * np.arange(count)
    frequency = random.uniform(0.3, 1.0) * np.array([1.0, 2.3, 4.1]) * 2e-3 / period
    size, phase = TURN * turns * np.array([0.7, 0.2, 0.05]) * random.uniform(0.7, 1.3, 3), random.uniform(0, 6.28, 3)
    angle = TURN * frequency * t[:, None] + phase
    motor = (size * np.sin(angle)).sum(axis=1)
    speed = (size * TURN * frequency * np.cos(angle)).sum(axis=1)
    acceleration = (-size * (TURN * frequency) ** 2 * np.sin(angle)).sum(axis=1)
    inertia = random.uniform(1e-4, 1e-3)
    drive = inertia * acceleration
    rms = float(np.std(drive))
    torque = drive + 0.4 * rms * speed / np.std(speed) + 0.3 * rms * np.tanh(10 * speed / np.std(speed))
    torque = torque + 0.02 * rms * random.standard_normal(count)
    ratio = float(random.choice([5.0, 36.5, 50.0, 100.0, 161.37, 256.9, 121.0, 9.0, 107.25]))
    gap = 2e-3 * turns * TURN
    load = (motor - gap * np.tanh(3 * np.roll(torque, 2) / rms)) / ratio
    lag = round(0.02 / period)
    reference = np.interp(t + lag * period, t, motor)
    return Motion(period, t, torque, motor, load, speed, ratio, reference)


def _round_counts(angle: np.ndarray, counts: float) -> np.ndarray:
    return np.floor(angle / TURN * counts).astype(int)


def _write_rows(path: Path, head: list[str], columns: list[Any], separator: str, decimal: str = ".") -> Path:
    rows = [separator.join(str(cell).replace(".", decimal) for cell in row) for row in zip(*columns, strict=True)]
    path.write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")
    return path


# layouts to develop with


def write_german_csv(folder: Path, random: np.random.Generator) -> Layout:
    """Semicolons, decimal commas and a row of units below the names."""
    m = draw_motion(random)
    motor = random.choice(["Winkel Motor", "Motorwinkel", "Lage Motor", "Rotorlage"])
    load = random.choice(["Winkel Abtrieb", "Lage Last", "Abtriebswinkel", "Lastlage"])
    names = [str(random.choice(["Zeit", "Messzeit"])), str(random.choice(["Drehmoment", "Motormoment"])), motor, load]
    columns = [np.round(m.t, 4), np.round(m.torque, 6), np.round(np.degrees(m.motor), 4), np.round(np.degrees(m.load), 5)]
    path = _write_rows(folder / "messung.csv", [";".join(names), "s;Nm;°;°"], columns, ";", ",")
    return Layout(path, {"u": m.torque, "theta_e": m.motor, "theta_s": m.load}, ("u", "theta_e", "theta_s"), m.ratio)


def write_servo_scope(folder: Path, random: np.random.Generator) -> Layout:
    """Scope export of a servo drive: a block of remarks, then names with units in brackets."""
    m = draw_motion(random)
    separator = str(random.choice([",", ";", "\t"]))
    actual, current = (("Actual position", "Actual current"), ("Position actual value", "Current actual value"))[
        int(random.integers(2))
    ]
    names = ["Time [ms]", f"{actual} [inc]", f"{current} [mA]", "Demand position [inc]"]
    counts = float(random.choice([4000, 8192, 20000]))
    head = [
        "Servo Scope Export",
        "Drive: SD-400",
        f"Sampling time: {m.period * 1e6:.0f} us",
        "Channels: 4",
        separator.join(names),
    ]
    columns = [
        np.round(m.t * 1e3, 3), _round_counts(m.motor, counts), np.round(m.torque / 0.05 * 1e3).astype(int),
        _round_counts(m.reference, counts),
    ]  # fmt: skip
    return Layout(_write_rows(folder / "scope.csv", head, columns, separator), {"u": m.torque, "theta_e": m.motor}, ())


def write_joint_states(folder: Path, random: np.random.Generator) -> Layout:
    """JointState as CSV, as `rostopic echo -p` or a bag's converter write it; the first joint."""
    m, other = draw_motion(random), draw_motion(random)
    count = min(len(m.t), len(other.t))
    stamps = (1.7e18 + np.round(m.t * 1e9)).astype(np.int64)
    values = [m.load, other.load, m.speed / m.ratio, other.speed / other.ratio, m.torque, other.torque]
    frame: dict[str, Any] = {"%time": stamps, "field.header.seq": np.arange(len(m.t)), "field.header.stamp": stamps}
    frame["field.header.frame_id"] = [""] * len(m.t)
    kinds = ("position", "velocity", "effort")
    frame |= {f"field.name{i}": [f"joint_{i + 1}"] * len(m.t) for i in range(2)}
    names = [f"field.{kind}{i}" for kind in kinds for i in range(2)]
    if random.random() < 0.5:
        names = [f"/joint_states/joint_{i + 1}/{kind}" for kind in kinds for i in range(2)]
        frame = {"__time": np.round(1.7e9 + m.t, 6)}
    frame |= dict(zip(names, values, strict=True))
    path = folder / "joint_states.csv"
    pd.DataFrame({name: column[:count] for name, column in frame.items()}).to_csv(path, index=False)
    return Layout(path, {"u": m.torque, "theta_s": m.load}, ())


def write_degrees_and_rpm(folder: Path, random: np.random.Generator) -> Layout:
    """Degrees and rpm, units at the end of the names, commanded values beside the actual ones."""
    m = draw_motion(random)
    style = int(random.integers(3))
    names = (
        ["time_s", "cmd_angle_deg", "motor_angle_deg", "motor_speed_rpm", "motor_torque_nm"],
        ["Time (s)", "Position Setpoint (deg)", "Position Actual (deg)", "Velocity Actual (rpm)", "Torque Actual (Nm)"],
        ["t", "AngleRef[deg]", "AngleFbk[deg]", "SpeedFbk[rpm]", "TorqueFbk[Nm]"],
    )[style]
    columns = [
        np.round(m.t, 5), np.round(np.degrees(m.reference), 4), np.round(np.degrees(m.motor), 4),
        np.round(m.speed * 60 / TURN, 3), np.round(m.torque, 6),
    ]  # fmt: skip
    path = _write_rows(folder / "run.csv", [",".join(names)], columns, ",")
    return Layout(path, {"u": m.torque, "theta_e": m.motor}, ("u", "theta_e"))


def write_wrapped_counts(folder: Path, random: np.random.Generator) -> Layout:
    """Counts of a word that starts again at 65 536, and a current."""
    m = draw_motion(random, turns=12.0)
    counts = float(random.choice([4096, 16384]))
    names = (["time_ms", "encoder", "current_A"], ["ms", "pos_raw", "iq [A]"], ["t_us", "EncoderCount", "MotorCurrent"])[
        style := int(random.integers(3))
    ]
    stamps = np.round(m.t * 1e6 if style == 2 else m.t * 1e3).astype(int)
    columns = [stamps, _round_counts(m.motor, counts) % 65536, np.round(m.torque / 0.05, 3)]
    path = _write_rows(folder / "counts.csv", [",".join(names)], columns, ",")
    return Layout(path, {"u": m.torque, "theta_e": m.motor}, ())


def write_milliamps(folder: Path, random: np.random.Generator) -> Layout:
    """What a microcontroller prints: tabs, milliseconds, mA, ticks."""
    m = draw_motion(random)
    names = ([["millis", "ticks", "mA"], ["time", "encoder_ticks", "current_mA"], ["ms", "pos", "I (mA)"]])[
        int(random.integers(3))
    ]
    columns = [np.round(m.t * 1e3).astype(int), _round_counts(m.motor, 4096), np.round(m.torque / 0.1 * 1e3, 1)]
    path = _write_rows(folder / "serial.txt", ["\t".join(names)], columns, "\t")
    return Layout(path, {"u": m.torque, "theta_e": m.motor}, ())


def write_two_encoders(folder: Path, random: np.random.Generator) -> Layout:
    """Encoders on both sides of a gear."""
    m = draw_motion(random, turns=float(random.choice([1.0, 20.0])))
    names = (
        ["t [s]", "I_q [A]", "phi_M [rad]", "phi_L [rad]"],
        ["time", "tau_m", "theta_m", "theta_l"],
        ["Time/s", "Torque/Nm", "MotorPosition/rad", "LoadPosition/rad"],
        ["t", "motor_torque", "motor_encoder", "load_encoder"],
    )[style := int(random.integers(4))]
    torque = m.torque / 0.07 if style == 0 else m.torque
    sign = random.choice([1.0, 1.0, -1.0])
    columns = [np.round(m.t, 5), np.round(torque, 7), np.round(m.motor, 6), np.round(sign * m.load, 8)]
    path = _write_rows(folder / "axis.csv", [",".join(names)], columns, ",")
    return Layout(path, {"u": m.torque, "theta_e": m.motor, "theta_s": m.load}, ("theta_e", "theta_s"), m.ratio)


def write_index_column(folder: Path, random: np.random.Generator) -> Layout:
    """An index, time in ms since the start, a torque in percent."""
    m = draw_motion(random)
    names = (
        ["Sample", "Time (ms)", "Position Actual Value (deg)", "Torque Actual Value (%)"],
        ["", "elapsed_ms", "position_deg", "torque_percent"],
        ["No.", "Time[ms]", "ActPos[deg]", "ActTrq[%]"],
    )[int(random.integers(3))]
    columns = [
        np.arange(len(m.t)), np.round(m.t * 1e3, 2), np.round(np.degrees(m.motor), 3),
        np.round(100 * m.torque / np.abs(m.torque).max() * 0.6, 2),
    ]  # fmt: skip
    path = _write_rows(folder / "log.csv", [",".join(names)], columns, ",")
    return Layout(path, {"u": m.torque, "theta_e": m.motor}, ("theta_e",))


def write_iso_stamps(folder: Path, random: np.random.Generator) -> Layout:
    """Dates and times as stamps."""
    m = draw_motion(random)
    stamps = pd.DatetimeIndex(np.datetime64("2026-03-01T10:20:30") + np.round(m.t * 1e6).astype("m8[us]"))
    shape = str(random.choice(["%Y-%m-%dT%H:%M:%S.%fZ", "%Y-%m-%d %H:%M:%S.%f", "%H:%M:%S.%f"]))
    names = (
        ["timestamp", "joint1_pos", "joint1_vel", "joint1_torque"],
        ["Date/Time", "Angle [rad]", "Speed [rad/s]", "Torque [Nm]"],
        ["datetime", "actual_position", "actual_velocity", "actual_torque"],
    )[int(random.integers(3))]
    columns = [stamps.strftime(shape), np.round(m.motor, 6), np.round(m.speed, 5), np.round(m.torque, 7)]
    path = folder / "historian.csv"
    pd.DataFrame(dict(zip(names, columns, strict=True))).to_csv(path, index=False)
    return Layout(path, {"u": m.torque, "theta_e": m.motor}, ())


def write_bare_numbers(folder: Path, random: np.random.Generator) -> Layout:
    """Numbers without a header: time, position, speed and torque, in any order behind the time."""
    m = draw_motion(random)
    encoder = np.round(m.motor * 4096 / TURN) / 4096 * TURN
    columns = [np.round(m.motor if random.random() < 0.5 else encoder, 6), np.round(m.speed, 5), np.round(m.torque, 7)]
    order = random.permutation(3)
    stamps = [np.round(m.t, 5)] if random.random() < 0.5 else [np.arange(len(m.t)), np.round(m.t, 5)]
    path = folder / "data.txt"
    np.savetxt(path, np.column_stack([*stamps, *(columns[i] for i in order)]), fmt="%.8g")
    return Layout(path, {"u": m.torque, "theta_e": m.motor}, ())


LAYOUTS = (
    write_german_csv, write_servo_scope, write_joint_states, write_degrees_and_rpm, write_wrapped_counts, write_milliamps,
    write_two_encoders, write_index_column, write_iso_stamps, write_bare_numbers,
)  # fmt: skip


# layouts kept apart


def write_matlab_matrix(folder: Path, random: np.random.Generator) -> Layout:
    """A matrix in a MATLAB file: time, command, torque, motor angle, as Simulink's To Workspace leaves it."""
    from scipy.io import savemat

    m = draw_motion(random)
    encoder = np.round(m.motor * 8192 / TURN) / 8192 * TURN
    matrix = np.column_stack([m.t, m.reference, m.torque, encoder])
    path = folder / "scope.mat"
    savemat(path, {str(random.choice(["data", "ScopeData", "ans"])): matrix})
    return Layout(path, {"u": m.torque, "theta_e": m.motor}, ())


def write_robot_json(folder: Path, random: np.random.Generator) -> Layout:
    """Objects line by line of a robot, with arrays of joints."""
    m, other = draw_motion(random), draw_motion(random)
    names = ([["ts", "q", "dq", "tau"], ["time", "joint_positions", "joint_velocities", "joint_torques"]])[
        int(random.integers(2))
    ]
    rows = zip(m.t, m.load, other.load, m.speed / m.ratio, other.speed, m.torque, other.torque, strict=False)
    lines = [
        json.dumps(dict(zip(names, (round(t, 5), [a, b], [c, d], [e, f]), strict=True))) for t, a, b, c, d, e, f in rows
    ]
    path = folder / "robot.jsonl"
    path.write_text("\n".join(lines) + "\n")
    return Layout(path, {"u": m.torque[: len(lines)], "theta_s": m.load[: len(lines)]}, ())


def write_arm_interface(folder: Path, random: np.random.Generator) -> Layout:
    """Real-time interface of an arm: blanks, target and actual values of each joint."""
    m, other = draw_motion(random), draw_motion(random)
    count = min(len(m.t), len(other.t))
    frame = {"timestamp": np.round(5210.0 + m.t, 4)}
    for name, pair in {
        "target_q": (m.reference, other.reference), "actual_q": (m.motor, other.motor), "actual_qd": (m.speed, other.speed),
        "target_current": (m.torque / 0.1, other.torque), "actual_current": (m.torque / 0.1, other.torque),
    }.items():  # fmt: skip
        frame |= {f"{name}_{i}": np.round(values, 6) for i, values in enumerate(pair)}
    path = folder / "robot_data.csv"
    frame = {name: column[:count] for name, column in frame.items()}
    pd.DataFrame(frame).to_csv(path, index=False, sep=str(random.choice([" ", ","])))
    return Layout(path, {"u": m.torque, "theta_e": m.motor}, ())


def write_hobby_controller(folder: Path, random: np.random.Generator) -> Layout:
    """Turns, turns a second and the q current of a brushless controller."""
    m = draw_motion(random)
    names = (
        ["timestamp", "pos_estimate", "vel_estimate", "Iq_measured"],
        ["Time [s]", "Position [rev]", "Velocity [rev/s]", "Q Current [A]"],
    )[style := int(random.integers(2))]
    columns = [np.round(m.t, 5), np.round(m.motor / TURN, 6), np.round(m.speed / TURN, 5), np.round(m.torque / 0.08, 4)]
    path = _write_rows(folder / "odrive.csv", [",".join(names)], columns, ",")
    return Layout(path, {"u": m.torque, "theta_e": m.motor}, ("theta_e",) if style else ())


def write_converter_trace(folder: Path, random: np.random.Generator) -> Layout:
    """Trace of a converter: numbers of parameters before the names."""
    m = draw_motion(random)
    names = ["Time [ms]", "r0063 Actual speed [1/min]", "r0080 Actual torque [Nm]", "r0482 Actual position [°]"]
    columns = [
        np.round(m.t * 1e3, 3),
        np.round(m.speed * 60 / TURN, 3),
        np.round(m.torque, 6),
        np.round(np.degrees(m.motor), 4),
    ]
    head = ["Trace;1", "Device;S120", "Cycle;1 ms", ";".join(names)] if random.random() < 0.5 else [";".join(names)]
    decimal = str(random.choice([".", ","]))
    path = _write_rows(folder / "trace.csv", head, columns, ";", decimal)
    return Layout(path, {"u": m.torque, "theta_e": m.motor}, ("u", "theta_e"))


def write_bus_servo(folder: Path, random: np.random.Generator) -> Layout:
    """Registers of a servo on a bus: raw words of position, speed, and load as a signed word read as unsigned."""
    m = draw_motion(random, turns=0.3)
    load = np.round(800 * m.torque / np.abs(m.torque).max()).astype(int) % 65536
    names = ["Time", "Goal Position", "Present Position", "Present Velocity", "Present Load"]
    position = 2048 + _round_counts(m.motor, 4096)
    columns = [
        np.round(m.t, 4), 2048 + _round_counts(m.reference, 4096), position,
        np.round(m.speed / 0.024).astype(int), load,
    ]  # fmt: skip
    if random.random() < 0.5:
        names = [name.lower().replace(" ", "_") for name in names]
    path = _write_rows(folder / "servo.csv", [",".join(names)], columns, ",")
    return Layout(path, {"u": m.torque, "theta_e": m.motor}, ())


def write_plc_dates(folder: Path, random: np.random.Generator) -> Layout:
    """A controller's recorder: days before months, decimal commas, drive variables."""
    m = draw_motion(random)
    stamps = pd.DatetimeIndex(np.datetime64("2026-03-21T10:20:30") + np.round(m.t * 1e6).astype("m8[us]"))
    names = ["Zeitstempel", "Achse1.ActPos", "Achse1.ActVelo", "Achse1.ActTorque"]
    columns = [stamps.strftime("%d.%m.%Y %H:%M:%S,%f").to_numpy(), *(np.round(x, 6) for x in (m.motor, m.speed, m.torque))]
    path = _write_rows(folder / "plc.csv", [";".join(names)], columns, ";", ".")
    return Layout(path, {"u": m.torque, "theta_e": m.motor}, ())


def write_hdf5_groups(folder: Path, random: np.random.Generator) -> Layout:
    """Groups of an HDF5 file, one for each device."""
    import h5py

    m = draw_motion(random)
    path = folder / "run.h5"
    with h5py.File(path, "w") as file:
        file["time"] = m.t
        file[str(random.choice(["motor/torque", "drive/torque_measured"]))] = m.torque
        file["motor/position"], file["load/position"] = m.motor, m.load
        file["motor/temperature"] = 40.0 + 0.01 * m.t
    return Layout(path, {"u": m.torque, "theta_e": m.motor, "theta_s": m.load}, (), m.ratio)


def write_dynamometer(folder: Path, random: np.random.Generator) -> Layout:
    """A test bench's angles before and behind the gear, with temperatures and voltages beside them."""
    m = draw_motion(random)
    names = ["Time (s)", "Temp Motor (°C)", "DC Voltage (V)", "Torque In (Nm)", "Angle In (deg)", "Angle Out (deg)"]
    noise, sign = random.standard_normal(len(m.t)), random.choice([1.0, 1.0, -1.0])
    columns = [
        np.round(m.t, 4), np.round(40 + 0.01 * m.t, 2), np.round(48 + 0.05 * noise, 3), np.round(m.torque, 6),
        np.round(np.degrees(m.motor), 4), np.round(sign * np.degrees(m.load), 5),
    ]  # fmt: skip
    path = _write_rows(folder / "bench.csv", [",".join(names)], columns, ",")
    return Layout(path, {"u": m.torque, "theta_e": m.motor, "theta_s": m.load}, ("u", "theta_e", "theta_s"), m.ratio)


def write_bare_load(folder: Path, random: np.random.Generator) -> Layout:
    """Numbers without a header or a speed: time in ms, torque, motor, load."""
    m = draw_motion(random)
    columns = [np.round(m.t * 1e3, 2), m.torque, np.round(m.motor, 6), np.round(m.load, 8)]
    path = folder / "axis.dat"
    np.savetxt(path, np.column_stack(columns), fmt="%.9g", delimiter=str(random.choice([" ", ",", "\t"])))
    return Layout(path, {"u": m.torque, "theta_e": m.motor, "theta_s": m.load}, (), m.ratio)


APART = (
    write_matlab_matrix, write_robot_json, write_arm_interface, write_hobby_controller, write_converter_trace,
    write_bus_servo, write_plc_dates, write_hdf5_groups, write_dynamometer, write_bare_load,
)  # fmt: skip


# judgement


def judge(write: Callable[[Path, np.random.Generator], Layout], seed: int, folder: Path) -> tuple[str, str]:
    """Write a layout and propose a study. Returns "right", "refused", "wrong" or "traceback", and what was said."""
    layout = write(folder, np.random.default_rng([seed, (*LAYOUTS, *APART).index(write)]))
    try:
        study, guesses, inspection = propose_study(layout.path)
    except InputError as error:
        return "refused", str(error).replace(str(layout.path), "FILE")
    except Exception:
        return "traceback", traceback.format_exc(limit=-2)
    record = inspection.record
    found = {"u": record.torque, "theta_e": record.positions.get("motor"), "theta_s": record.positions.get("load")}
    truth = dict(layout.channels)
    if "theta_s" not in truth or "theta_e" not in truth:
        # of one encoder the file does not say the side
        truth["theta_e"] = truth.pop("theta_s") if "theta_s" in truth else truth["theta_e"]
        if found["theta_e"] is None:
            found["theta_e"] = found.pop("theta_s")
    faults = []
    for channel in ("u", "theta_e", "theta_s"):
        values, true = found.get(channel), truth.get(channel)
        if values is None or true is None:
            if (values is None) != (true is None):
                faults.append(f"{channel} {'missing' if values is None else 'invented'}")
            continue
        count = min(len(values), len(true))
        slope, _ = np.polyfit(true[:count], values[:count], 1)
        correlation = np.corrcoef(true[:count], values[:count])[0, 1]
        if correlation < 0.999 - 0.004 * (channel == "u"):
            faults.append(f"{channel} is another signal (correlation {correlation:.3f})")
        elif abs(slope - 1.0) > 0.01 and (
            channel in layout.with_unit or not re.search("assumed|placeholder|taken to be", " ".join(guesses))
        ):
            faults.append(f"{channel} is {slope:.4g} of the truth")
    ratio = study["drive"].get("gear_ratio")
    if ratio is not None and ratio > 100 and ratio == round(ratio) and abs(ratio - layout.ratio) > 1e-6:
        faults.append(f"WHOLE RATIO {ratio:g} for {layout.ratio:.6g}")
    return ("wrong", "; ".join(faults)) if faults else ("right", " ".join(guesses))


def main() -> None:
    """Print a line a layout, then the count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, nargs="+", default=[1])
    parser.add_argument("--apart", action="store_true")
    parser.add_argument("--folder", type=Path, help="keeps the files there")
    parser.add_argument("--all", action="store_true", help="also print what was guessed where it was right")
    arguments = parser.parse_args()
    for seed in arguments.seed:
        outcomes = []
        for write in APART if arguments.apart else LAYOUTS:
            with TemporaryDirectory() as place:
                folder = arguments.folder / f"{seed}" / write.__name__ if arguments.folder else Path(place)
                folder.mkdir(parents=True, exist_ok=True)
                outcome, text = judge(write, seed, folder)
            outcomes.append(outcome)
            said = text if arguments.all or outcome != "right" else ""
            print(f"{seed} {write.__name__.removeprefix('write_')}: {outcome}. {said}".rstrip(), flush=True)
        print(f"seed {seed}: {outcomes.count('right')} of {len(outcomes)} right", flush=True)


if __name__ == "__main__":
    main()
