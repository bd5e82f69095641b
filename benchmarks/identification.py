"""How well and how fast numbers are found from a log.

`table`: one comparison, on the same logs, of what is done with such logs: least squares on filtered derivatives, the paper's
chain of observers and recursive identifier, and the trajectory fit. Simulated logs of a hard gap, whose truth is exact
(piecewise linear, matrix exponentials from contact to contact), and the measured EMPS axis where `JAXBL_DATA` has it.

`time`: seconds for logs of several lengths with 12 free numbers, as the first and as a later call of one process, and where
they go.

    python benchmarks/identification.py table --out table.md
    python benchmarks/identification.py time
"""

import argparse
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import jax

jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402

from jaxbl.records import read_record  # noqa: E402
from jaxbl.simulate import trajectory  # noqa: E402
from jaxbl.study import identification as whole  # noqa: E402
from jaxbl.study.config import read_model  # noqa: E402
from jaxbl.study.engine import prepare  # noqa: E402

PERIOD = 1e-3
NOISE = {"motor": 1e-4, "load": 2e-5}
DRIVE = {
    "kind": "two_inertia", "motor_inertia": 0.05, "motor_viscous": 0.15,
    "load_inertia": 7.0, "load_viscous": 16.0, "gear_ratio": 5.0,
}  # fmt: skip
LAW = {"law": "dead_zone", "stiffness": 60.0, "half_gap": 0.08}


def inputs(kind, samples):
    """Input torque in N m."""
    t = PERIOD * np.arange(samples)
    return {
        "multisine": 2.0 * sum(np.sin(2.0 * np.pi * f * t + i) for i, f in enumerate((0.3, 0.7, 1.9, 4.1))),
        "steps": 6.0 * np.sign(np.sin(2.0 * np.pi * 0.9 * t + 0.1)),
        "chirp": 5.0 * np.sin(2.0 * np.pi * (0.4 + 6.0 / (PERIOD * samples) / 2.0 * t) * t + 0.3),
    }[kind]


def log_of(torque, positions, seed):
    """A record of the readings, through a file as any log."""
    random = np.random.default_rng(seed)
    readings = {side: positions[side] + NOISE[side] * random.standard_normal(len(torque)) for side in ("motor", "load")}
    columns = {"t": PERIOD * np.arange(len(torque)), "u": torque, "theta_e": readings["motor"], "theta_s": readings["load"]}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "log.parquet"
        pd.DataFrame(columns).to_parquet(file)
        return read_record(file)


TWELVE = {
    "drive.motor_inertia": 0.05,
    "drive.motor_viscous": 0.15,
    "drive.load_inertia": 7.0,
    "drive.load_viscous": 16.0,
    "transmission.stiffness": 60.0,
    "transmission.half_gap": 0.08,
    "effects.motor.coulomb_friction.torque": 0.1,
    "effects.load.coulomb_friction.torque": 1.0,
    "effects.motor.constant_torque.torque": 0.05,
    "effects.load.gravity.torque": 3.0,
    "effects.load.gravity.phase": 0.4,
    "effects.transmission.damping.damping": 0.05,
}


def twelve(factor=lambda i: 1.0):
    """The drive of the timing, its numbers times a factor of their index."""
    data = {"title": "timing", "drive": {"kind": "two_inertia", "gear_ratio": 5.0}, "transmission": {"law": "dead_zone"}}
    effects = {}
    for i, (path, value) in enumerate(TWELVE.items()):
        table, _, key = path.rpartition(".")
        value *= factor(i)
        if table.startswith("effects."):
            kind = table.removeprefix("effects.")
            effects.setdefault(kind, {"kind": kind})[key] = value
        else:
            data[table][key] = value
    return data | {
        "effects": list(effects.values()),
        "run": {"sample_period": PERIOD, "substeps": 10, "duration": 1.0},
        "uncertainty": {"exact": ["drive.gear_ratio"]},
    }


def twelve_log(seconds, seed, substeps=40):
    """A log of the drive of the timing; plant steps of 25 us."""
    samples = round(seconds / PERIOD)
    data = twelve()
    data["run"]["substeps"] = substeps
    config, _ = read_model(data)
    experiment = prepare(config)
    torque = inputs("multisine", samples) + 1.5 * np.sin(np.arange(samples) * PERIOD * 2.0 * np.pi * 0.11)
    start = experiment.plant.init(experiment.initial)
    position = jax.jit(lambda u: trajectory(experiment, start, u).position)(jnp.asarray(torque))
    return log_of(torque, {side: np.asarray(x) for side, x in position.items()}, seed)


class Stages:
    """Seconds by stage: functions of the package are wrapped while it is entered."""

    def __init__(self, named):
        self.named, self.seconds = named, defaultdict(float)

    def __enter__(self):
        self.kept = [(place, name, getattr(place, name)) for place, name, _ in self.named]
        for place, name, label in self.named:
            setattr(place, name, self.timed(getattr(place, name), label))
        return self

    def __exit__(self, *_):
        for place, name, function in self.kept:
            setattr(place, name, function)

    def timed(self, function, label):
        def call(*args, **keys):
            start = time.perf_counter()
            result = function(*args, **keys)
            jax.block_until_ready(jax.tree.leaves(result))
            self.seconds[label] += time.perf_counter() - start
            return result

        return call


def stages():
    from jaxbl.identification import search

    return Stages(
        [
            (whole, "smoothed_channels", "smoother"),
            (search.Search, "_coarse", "starts"),
            (search.Search, "_whole", "fits"),
            (whole, "_gains", "gains"),
            (whole, "_chain", "chain"),
            (whole, "_regression", "regression"),
            (whole, "_torque_errors", "torque errors"),
            (whole, "_model_columns", "model columns"),
        ]
    )


def timed(options):
    study = twelve(lambda i: 1.0 + 0.15 * (-1) ** i)
    rows = []
    for seconds in options.seconds:
        for call in range(options.calls):
            record = twelve_log(seconds, 10 * int(seconds) + call)
            with stages() as parts:
                start = time.perf_counter()
                found = whole.identify(record, study)
                took = time.perf_counter() - start
            values = found.summary["parameters"]
            worst = max(
                abs(values[path]["value"] - true) / values[path]["standard_error"]
                for path, true in TWELVE.items()
                if path in values
            )
            how = found.summary["method"]["trajectory"]
            rows.append({"log (s)": seconds, "call": call + 1, "s": took, **parts.seconds})
            print(
                rows[-1],
                f"free {len(values)} worst {worst:.1f} deviations, window {how['window']}, "
                f"{how['starts_agreeing']} of {how['starts']} starts agree",
                flush=True,
            )
    print(pd.DataFrame(rows).to_markdown(index=False) if False else pd.DataFrame(rows).round(2).to_string())


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    speed = commands.add_parser("time")
    speed.add_argument("--seconds", type=float, nargs="*", default=[10.0, 20.0, 40.0], help="lengths of the logs")
    speed.add_argument("--calls", type=int, default=2, help="of each length, in one process")
    speed.set_defaults(run=timed)
    options = parser.parse_args()
    options.run(options)


if __name__ == "__main__":
    main()
