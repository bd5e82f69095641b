"""Reliability of `jaxbl watch`: false alarms, coverage of its intervals, and delay of the alarm on simulated drives
whose gap stays or grows; and how many samples a second it takes.

    python benchmarks/watch.py alarms [--runs 100]     # constant gaps, several noise levels
    python benchmarks/watch.py growth [--runs 10]      # gaps that double, at several rates
    python benchmarks/watch.py wrong [--runs 10]       # the model's inertias and frictions are off
    python benchmarks/watch.py damping [--runs 10]     # the gear has damping, the model none
    taskset -c 0 python benchmarks/watch.py speed      # samples a second on one core, from memory and by UDP

Drives: `sweeps/geared_axis.toml` (hard gap, dry friction on the load that the observers do not know) and
`sweeps/dead_zone_noise.toml` (the paper's law). The plant is `jaxbl.chain.step` with another gap at each sample.
"""

import argparse
import socket
import threading
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.chain import Sample, initial_state, replay, step, unit_noise
from jaxbl.config import Config, prepare, read_config, with_values
from jaxbl.drive.parameters import get_leaf, leaf_paths, set_leaves
from jaxbl.monitoring.watch import INTERVAL, Watcher, read_watch_task, run_watch
from jaxbl.records.live import Rows

SWEEPS = Path(__file__).parent.parent / "sweeps"
STUDIES = {"hard gap": "geared_axis.toml", "law (3)": "dead_zone_noise.toml"}
ADDRESS = "udp://127.0.0.1:0"
"""Address of a task without a log; nothing listens there."""


def simulate_rows(config: Config, gaps: np.ndarray, seeds: np.ndarray, noise: float) -> list[np.ndarray]:
    """Input, motor and load position, each (runs, samples), of a drive whose gap is `gaps` times its own at each sample."""
    with jax.enable_x64(True):
        experiment = prepare(config)
        ratio = experiment.drive.ratio("load")
        experiment = set_leaves(
            experiment, {"encoders.noise": jnp.asarray(noise), "encoders.load_noise": jnp.asarray(noise / ratio)}
        )
        law: Any = experiment.transmission
        key = "dead_zone" if law.name == "sigmoid_backlash" else "half_gap"
        size = getattr(law, key)
        period = experiment.run.sample_period

        def run(seed: jax.Array) -> Any:
            indices = jnp.arange(len(gaps), dtype=jnp.int32)
            noises = unit_noise(seed, indices, experiment.sides)

            def sample(state: Any, sample_inputs: Any) -> Any:
                index, gap, noise = sample_inputs
                changed = eqx.tree_at(lambda e: getattr(e.transmission, key), experiment, size * gap)
                state, signals = step(changed, state, Sample(index.astype(float) * period, noise=noise))
                return state, (signals.input, *(signals.side(side).measured for side in experiment.sides))

            return jax.lax.scan(sample, initial_state(experiment), (indices, jnp.asarray(gaps), noises))[1]

        return [np.asarray(column) for column in jax.jit(jax.vmap(run))(jnp.asarray(seeds))]


def watch_rows(model: Config, rows: list[np.ndarray], window: float) -> Any:
    """Values over time of one run."""
    with jax.enable_x64(True):
        task = read_watch_task(ADDRESS, model, window=window)
        watcher = Watcher(task, lambda values: None)
        watcher.take(Rows(0.0, rows[0], {"motor": rows[1], "load": rows[2]}, True))
    return {name: np.array([window_values[name] for window_values in watcher.values]) for name in task.columns}


def half_gap_of(config: Config) -> float:
    return float(config.build().transmission.half_gap)  # type: ignore[union-attr]


def study(name: str, **tables: Any) -> Config:
    data = read_config(SWEEPS / STUDIES[name]).to_dict()
    for table in ("axes", "figures", "sweep"):
        data.pop(table, None)
    for path, value in tables.items():
        table, key = path.split("__")
        data[table][key] = value
    return read_config(data)


def alarms(drives: list[str], runs: int, duration: float = 40.0, window: float = 10.0) -> None:
    """Constant gaps: how often is a limit passed that the gap does not pass? And how good are the numbers?"""
    print("| drive | noise (rad) | values | determined | gap: rms error | 95 % interval holds the gap | ", end="")
    print("runs with an alarm, limit 1.00 | 1.02 | 1.05 | 1.25 times the gap |")
    friction: list[list[str]] = []
    for name in drives:
        model = study(name)
        true = half_gap_of(model)
        for noise in (0.0, 1e-5, 1e-4, 3e-4):
            count = round(duration / model.run.sample_period)
            rows = simulate_rows(model, np.ones(count), np.arange(runs), noise)
            watched = [watch_rows(model, [columns[i] for columns in rows], window) for i in range(runs)]
            gap, low, high, least = (
                np.stack([columns[f"half_gap{end}"] for columns in watched]) for end in ("", "_from", "_to", "_least")
            )
            finite = np.isfinite(gap)
            error = float(np.sqrt(np.mean((gap[finite] / true - 1.0) ** 2)))
            inside = float(np.mean((low[finite] <= true) & (true <= high[finite])))
            limits = (1.0, 1.02, 1.05, 1.25)
            raised = [int(np.sum(np.any(np.nan_to_num(least) > limit * true, axis=1))) for limit in limits]
            friction.append([name, f"{noise:g}", *frictions(watched, model)])
            print(
                f"| {name} | {noise:g} | {gap.size} | {100 * finite.mean():.1f} % | {100 * error:.2g} % | "
                f"{100 * inside:.1f} % | " + " | ".join(f"{columns} of {runs}" for columns in raised) + " |",
                flush=True,
            )
    print(
        "\n| drive | noise (rad) | mean error of Coulomb friction, motor (N m) | load (N m) | of viscous, motor | load | ",
        end="",
    )
    print("95 % intervals that hold the truth: Coulomb, motor | load | viscous, motor | load |")
    for row in friction:
        print("| " + " | ".join(row) + " |")


def frictions(watched: Any, model: Config) -> list[str]:
    """Mean errors of friction, and how often its interval holds the truth."""
    drive: Any = model.drive
    dry = {effect.kind: float(effect.build().torque) for effect in model.effects if effect.kind.endswith("coulomb_friction")}  # type: ignore[attr-defined]
    truths = {f"{side}.coulomb": dry.get(f"{side}.coulomb_friction", 0.0) for side in ("motor", "load")}
    truths |= {f"{side}.viscous": getattr(drive, f"{side}_viscous") for side in ("motor", "load")}
    errors, inside = [], []
    for key, truth in truths.items():
        value, error = (np.concatenate([effect[f"{key}{end}"] for effect in watched]) for end in ("", "_error"))
        finite = np.isfinite(value)
        mean = float(np.mean(value[finite] - truth))
        errors.append(f"{100 * mean / truth:+.2g} %" if key.endswith("viscous") else f"{mean:+.2g}")
        inside.append(f"{100 * np.mean(np.abs(value[finite] - truth) <= INTERVAL * error[finite]):.0f} %")
    return [*errors, *inside]


def growth(drives: list[str], runs: int, noise: float = 1e-4) -> None:
    """Gaps that double: how late is the alarm at 1.5 times the gap, and how near are the values?"""
    print("| drive | time to double (s) | window (s) | value - gap at the window's middle, rms | ", end="")
    print("alarm after the gap passed the limit (s), median | worst | gap over the limit then, median | ", end="")
    print("alarms before | sums over all time pass it after (s), median |")
    for name in drives:
        model = study(name)
        true = half_gap_of(model)
        for rise in (20.0, 60.0, 180.0):
            period = model.run.sample_period
            times = np.arange(round((rise + 60.0) / period)) * period
            gaps = 1.0 + np.clip((times - 20.0) / rise, 0.0, 1.0)
            passed = 20.0 + 0.5 * rise
            rows = simulate_rows(model, gaps, np.arange(runs), noise)
            of_sums = [sums_over_all_time(model, [columns[i] for columns in rows], 1.5 * true) - passed for i in range(runs)]
            for window in (5.0, 10.0):
                delays, errors = [], []
                for i in range(runs):
                    watched = watch_rows(model, [columns[i] for columns in rows], window)
                    raised = watched["t"][np.nan_to_num(watched["half_gap_least"]) > 1.5 * true]
                    delays.append(raised[0] - passed if len(raised) else np.inf)
                    middle = np.interp(watched["t"] - 0.5 * window, times, gaps) * true
                    errors.append((watched["half_gap"] / middle - 1.0)[np.isfinite(watched["half_gap"])])
                rms = float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))
                size = np.interp(passed + np.median(delays), times, gaps) / 1.5
                print(
                    f"| {name} | {rise:g} | {window:g} | {100 * rms:.2g} % | {np.median(delays):.0f} | "
                    f"{np.max(delays):.0f} | {size:.3f} | {sum(columns < 0.0 for columns in delays)} of {runs} | "
                    f"{np.median(of_sums):.0f} |",
                    flush=True,
                )


def sums_over_all_time(model: Config, rows: list[np.ndarray], limit: float) -> float:
    """When the identifier of the exported chain, which forgets nothing, finds a half gap beyond a limit on the motor's side
    after its first ten seconds; inf for never."""
    with jax.enable_x64(True):
        experiment: Any = prepare(model)

        def keep(state: Any, signals: Any) -> Any:
            return experiment.identifier.estimate(state.identifier, experiment.transmission)["motor"]["half_gap"]

        inputs = jnp.asarray(rows[0]), {"motor": jnp.asarray(rows[1]), "load": jnp.asarray(rows[2])}
        sums = np.asarray(jax.jit(lambda torque, measured: replay(experiment, torque, measured, record=keep)[1])(*inputs))
    beyond = np.flatnonzero(sums[round(10.0 / model.run.sample_period) :] > limit)
    return 10.0 + float(beyond[0]) * model.run.sample_period if len(beyond) else np.inf


def compare_wrong_models(drives: list[str], runs: int, noise: float = 1e-4) -> None:
    """Compare gap and stiffness under errors of the model's numbers."""
    print("| drive | wrong in the model | side chosen | half gap | by the motor | by the load | stiffness | ", end="")
    print("sides contradict | ", end="")
    print("alarms, limit 1.1 times the gap |")
    changes = {
        "nothing": {},
        "motor inertia + 10 %": {"drive.motor_inertia": 1.1},
        "motor inertia - 10 %": {"drive.motor_inertia": 0.9},
        "load inertia + 10 %": {"drive.load_inertia": 1.1},
        "load inertia - 10 %": {"drive.load_inertia": 0.9},
        "viscous frictions + 30 %": {"drive.motor_viscous": 1.3, "drive.load_viscous": 1.3},
        "half gap half the true one": {"transmission.half_gap": 0.5},
        "motor's alpha a quarter, lambda a half": {"observer.motor.alpha": 0.25, "observer.motor.lambda": 0.5},
    }
    for name in drives:
        config = study(name)
        rows = simulate_rows(config, np.ones(round(40.0 / config.run.sample_period)), np.arange(runs), noise)
        experiment = config.build()
        leaves = leaf_paths(experiment)
        for change, factors in changes.items():
            if not {*factors} <= {*leaves}:
                continue
            model = with_values(
                config, {path: factor * float(get_leaf(experiment, path)) for path, factor in factors.items()}
            )
            watched = [watch_rows(model, [columns[i] for columns in rows], 10.0) for i in range(runs)]
            true, stiffness = half_gap_of(config), float(get_leaf(experiment, "transmission.stiffness"))
            gap, k, contrary, least, side = (
                np.concatenate([columns[key] for columns in watched])
                for key in ("half_gap", "stiffness", "contradiction", "half_gap_least", "side")
            )
            of_side = [np.concatenate([columns[f"{side}.half_gap"] for columns in watched]) for side in ("motor", "load")]
            print(
                f"| {name} | {change} | motor {100 * np.mean(side == 'motor'):.0f} % | "
                f"{100 * (np.nanmean(gap) / true - 1.0):+.2g} % | "
                + " | ".join(f"{100 * (np.nanmedian(columns) / true - 1.0):+.2g} %" for columns in of_side)
                + f" | {100 * (np.nanmean(k) / stiffness - 1.0):+.2g} % | "
                f"{100 * np.mean(contrary):.0f} % | {int(np.sum(np.nan_to_num(least) > 1.1 * true))} of {len(gap)} values |",
                flush=True,
            )


def compare_damped_gears(drives: list[str], runs: int, noise: float = 1e-4) -> None:
    """Compare gap and stiffness of gears with damping, which the model lacks, by side."""
    print("| drive | damping (N m s/rad) | side | determined | half gap | 95 % interval holds it | stiffness | holds it |")
    for name in drives:
        model = study(name)
        truths = half_gap_of(model), float(get_leaf(model.build(), "transmission.stiffness"))
        for damping in (0.0, 0.05, 0.2):
            effects = [*model.to_dict().get("effects", []), {"kind": "transmission.damping", "damping": damping}]
            machine = read_config(model.to_dict() | {"effects": effects})
            rows = simulate_rows(machine, np.ones(round(40.0 / model.run.sample_period)), np.arange(runs), noise)
            watched = [watch_rows(model, [columns[i] for columns in rows], 10.0) for i in range(runs)]
            for side in ("motor", "load"):
                cells = []
                for number, true in zip(("half_gap", "stiffness"), truths, strict=True):
                    values, errors = (
                        np.concatenate([columns[f"{side}.{number}{end}"] for columns in watched]) for end in ("", "_error")
                    )
                    finite = np.isfinite(values)
                    inside = np.abs(values[finite] - true) <= INTERVAL * errors[finite]
                    cells += [] if cells else [f"{100 * finite.mean():.0f} %"]
                    cells += [f"{100 * (values[finite].mean() / true - 1.0):+.2g} %", f"{100 * inside.mean():.0f} %"]
                print(f"| {name} | {damping:g} | {side} | " + " | ".join(cells) + " |", flush=True)


def measure_speed(seconds: float = 20.0) -> None:
    """Samples a second on the cores that this process has: from memory, and by UDP from another thread at 10 kHz."""
    model = study("hard gap", run__sample_period=1e-4, run__substeps=1, run__duration=seconds)
    count = round(seconds / model.run.sample_period)
    rows = [column[0] for column in simulate_rows(model, np.ones(count), np.arange(1), 1e-4)]
    watch_rows(model, [column[: round(11.0 / model.run.sample_period)] for column in rows], 10.0)
    start = time.process_time()
    watch_rows(model, rows, 10.0)
    print(f"10 kHz from memory: {count / (time.process_time() - start):.3g} samples a second of processor time")
    table = np.stack([np.arange(count) * model.run.sample_period, *rows], axis=1)
    by_udp("float64", [column.astype("<f8").tobytes() for column in table], model)
    by_udp("text", [",".join(map(repr, column.tolist())).encode() for column in table], model)


def by_udp(form: str, rows: list[bytes], model: Config) -> None:
    """Send rows from another thread at the model's period, and watch them."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    task = read_watch_task(f"udp://127.0.0.1:{port}", model)
    sent, began, late = threading.Event(), list[float](), list[float]()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            for i, datagram in enumerate(rows):
                if i % 20 == 0 and (wait := began[0] + i * model.run.sample_period - time.perf_counter()) > 0.0:
                    time.sleep(wait)
                out.sendto(datagram, ("127.0.0.1", port))
        time.sleep(0.5)
        sent.set()

    sender = threading.Thread(target=send)

    def has_ended() -> bool:
        # the first call comes once everything is compiled and the address is open
        if not began:
            began.append(time.perf_counter())
            sender.start()
        return sent.is_set()

    def note_values(values: Any) -> None:
        late.append(time.perf_counter() - began[0] - values["t"])

    start = time.process_time()
    watched = run_watch(task, on_values=note_values, ended=has_ended)
    used = time.process_time() - start
    sender.join()
    print(
        f"10 kHz by UDP, {form}, one row a datagram: {watched.summary['samples']} of {len(rows)} samples, {used:.1f} s of "
        f"processor time with sending and compiling for {len(rows) * model.run.sample_period:g} s; values "
        f"{1e3 * np.median(late):.0f} ms after their last sample (worst {1e3 * max(late):.0f} ms); left out: "
        f"{watched.summary['left_out'] or 'nothing'}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    functions = {
        "alarms": (alarms, 100), "growth": (growth, 10), "wrong": (compare_wrong_models, 10),
        "damping": (compare_damped_gears, 10),
    }  # fmt: skip
    parser.add_argument("what", choices=(*functions, "speed"))
    parser.add_argument("--runs", type=int, default=None)
    parser.add_argument("--drive", choices=STUDIES, help="left out: both")
    args = parser.parse_args()
    if args.what == "speed":
        measure_speed()
    else:
        function, runs = functions[args.what]
        function([args.drive] if args.drive else [*STUDIES], args.runs or runs)


if __name__ == "__main__":
    main()
