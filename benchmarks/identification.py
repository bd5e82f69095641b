"""Accuracy and time of methods that estimate a drive's numbers from a log.

`table`: one comparison, on the same logs, of what is done with such logs: least squares on filtered derivatives, the paper's
chain of observers and recursive identifier, and the trajectory fit. Simulated logs of a hard gap, whose truth is exact
(piecewise linear, matrix exponentials from contact to contact), and the measured EMPS axis where `JAXBL_DATA` has it.

`time`: seconds for logs of several lengths with 12 free numbers, as the first and as a later call of one process, and where
they go.

    python benchmarks/identification.py table --out table.md
    python benchmarks/identification.py time
"""

import argparse
import os
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
from filtered_derivatives import differentiate  # noqa: E402
from inverse_dynamics import regress  # noqa: E402
from scipy.linalg import expm  # noqa: E402
from scipy.optimize import brentq  # noqa: E402

from jaxbl.chain import plant_trajectory  # noqa: E402
from jaxbl.config import prepare, read_model  # noqa: E402
from jaxbl.drive.parameters import set_leaves  # noqa: E402
from jaxbl.estimation import identify as identify_module, log_columns  # noqa: E402
from jaxbl.estimation.free_parameters import make_free_parameters  # noqa: E402
from jaxbl.estimation.identification_summary import torque_errors  # noqa: E402
from jaxbl.estimation.intervals import spread  # noqa: E402
from jaxbl.estimation.logs import arrays, on_record  # noqa: E402
from jaxbl.estimation.observer_gains import gains_for  # noqa: E402
from jaxbl.estimation.search import ParameterSearch  # noqa: E402
from jaxbl.estimation.segments import segments_of  # noqa: E402
from jaxbl.records import read_record  # noqa: E402

PERIOD = 1e-3
NOISE = {"motor": 1e-4, "load": 2e-5}
RATIO = 5.0
SIX = {
    "drive.motor_inertia": 0.05,
    "drive.motor_viscous": 0.15,
    "drive.load_inertia": 7.0,
    "drive.load_viscous": 16.0,
    "transmission.stiffness": 60.0,
    "transmission.half_gap": 0.08,
}
NAMES = {
    "transmission.stiffness": "K",
    "transmission.half_gap": "half gap",
    "drive.motor_inertia": "J_e",
    "drive.load_inertia": "J_s",
    "drive.motor_viscous": "f_e",
    "drive.load_viscous": "f_s",
}


def inputs(kind, samples):
    """Input torque in N m."""
    t = PERIOD * np.arange(samples)
    return {
        "multisine": 2.0 * sum(np.sin(2.0 * np.pi * f * t + i) for i, f in enumerate((0.3, 0.7, 1.9, 4.1))),
        "steps": 6.0 * np.sign(np.sin(2.0 * np.pi * 0.9 * t + 0.1)),
        "chirp": 5.0 * np.sin(2.0 * np.pi * (0.4 + 6.0 / (PERIOD * samples) / 2.0 * t) * t + 0.3),
    }[kind]


def truth(torque, true, pieces=4):
    """Positions of both sides at the samples: exact between contacts, which are located to 1e-12 s."""
    j_e, f_e, j_s, f_s, k, gap = (true[path] for path in SIX)
    ratio, step = RATIO, PERIOD / pieces

    def system(contact, u):
        """Matrix of d/dt [theta_e, omega_e, theta_s, omega_s, 1] with the gap closed at +1 or -1, or open (0)."""
        m = np.zeros((5, 5))
        m[0, 1] = m[2, 3] = 1.0
        m[1, 1], m[3, 3], m[1, 4] = -f_e / j_e, -f_s / j_s, u / j_e
        if contact:
            c = k * np.array([1.0, 0.0, -ratio, 0.0, -contact * gap])
            m[1] -= c / j_e
            m[3] += ratio * c / j_s
        return m

    def contact_of(x):
        z = x[0] - ratio * x[2]
        return 0 if abs(z) <= gap else int(np.sign(z))

    # the input enters linearly: two exponentials give all of them
    solutions = {}
    for contact in (-1, 0, 1):
        exponentials = [expm(system(contact, u) * step) for u in (0.0, 1.0)]
        solutions[contact] = exponentials[0], exponentials[1] - exponentials[0]
    x, states = np.array([0.0, 0.0, 0.0, 0.0, 1.0]), np.zeros((len(torque), 4))
    for i, u in enumerate(torque):
        states[i] = x[:4]
        for _ in range(pieces):
            contact, left = contact_of(x), step
            fixed, by_input = solutions[contact]
            end = (fixed + u * by_input) @ x
            while contact_of(end) != contact:
                edge = contact * gap if contact else contact_of(end) * gap
                matrix, before = system(contact, u), x

                def beyond(t, matrix=matrix, before=before, edge=edge):
                    exponentials = expm(matrix * t) @ before
                    return exponentials[0] - ratio * exponentials[2] - edge

                if beyond(0.0) * beyond(left) > 0.0:
                    break
                exponentials = brentq(beyond, 0.0, left, xtol=1e-12)
                x, left = expm(matrix * exponentials) @ before, left - exponentials
                contact = 0 if contact else int(np.sign(edge))
                end = expm(system(contact, u) * left) @ x
            x = end
    return {"motor": states[:, 0], "load": states[:, 2]}


def six(discretisation="implicit"):
    """The study of the table, its numbers 10 to 20 % off."""
    off = (1.1, 0.8, 0.9, 1.15, 0.85, 1.2)
    values = {path: factor * SIX[path] for path, factor in zip(SIX, off, strict=True)}
    data = {
        "title": "table",
        "drive": {"kind": "two_inertia", "gear_ratio": RATIO},
        "transmission": {"law": "dead_zone"},
        "observer": {"discretisation": discretisation},
        "equivalent_control": {"time_constant": 0.01},
        "identifier": {"start": 2.0},
        "run": {"sample_period": PERIOD, "substeps": 10, "duration": 1.0},
        "uncertainty": {"exact": ["drive.gear_ratio"]},
    }
    for path, value in values.items():
        table, key = path.split(".")
        data[table][key] = value
    return data


def by_derivatives(experiment, paths, record):
    """Value, half-width of the 95 % interval, and theta, by filtered derivatives and least squares."""
    free = make_free_parameters(experiment, paths, float(np.std(record.torque)))
    kinematics = differentiate(record.time, record.torque, record.positions, 100.0)
    fit = regress(experiment, free, [kinematics], 10)
    reach = 1.96 * np.sqrt(np.diag(np.asarray(spread(fit).covariance)))
    return {
        parameter.path: (float(parameter.value(fit.theta[i])), abs(float(parameter.slope(fit.theta[i]))) * reach[i])
        for i, parameter in enumerate(free)
    }


def by_trajectories(study, record):
    estimates = identify_module.identify(record, study).summary["parameters"]
    return {path: (estimate["value"], 1.96 * estimate["standard_error"]) for path, estimate in estimates.items()}


def by_observers(study, record):
    """The paper's chain, inertias and viscous frictions given as they are; the motor's side."""
    config, missing = read_model(study)
    nominal = set_leaves(on_record(config, record), arrays(SIX))
    segments = segments_of(record, nominal.sides)
    _, gains = gains_for(missing, nominal, segments)
    estimates = log_columns.observer_chain(set_leaves(nominal, arrays(gains)), segments, len(record.time))[1]
    return {f"transmission.{name}": (value["motor"], np.nan) for name, value in estimates.items()}


METHODS = {
    "derivatives, least squares": lambda r: by_derivatives(on_record(read_model(six())[0], r), list(SIX), r),
    "observers, recursive, explicit": lambda r: by_observers(six("explicit"), r),
    "observers, recursive, implicit": lambda r: by_observers(six(), r),
    "trajectories, output error": lambda r: by_trajectories(six(), r),
    "trajectories, prediction error": lambda r: by_trajectories(six() | {"identify": {"method": "prediction_error"}}, r),
}


def simulate_record(options):
    """One row a log, method and number."""
    rows = []
    for kind in options.excitations:
        torque = inputs(kind, round(options.duration / PERIOD))
        positions = truth(torque, SIX)
        for seed in range(options.seeds):
            record = log_of(torque, positions, seed)
            for method, find in METHODS.items():
                for path, (value, reach) in find(record).items():
                    row = {"excitation": kind, "seed": seed, "method": method, "path": path, "value": value}
                    rows.append(row | {"error": value / SIX[path] - 1.0, "reach": reach / SIX[path]})
            print(f"{kind}, seed {seed}", flush=True)
    return pd.DataFrame(rows)


def percent(value):
    return "" if not np.isfinite(value) else f"{100.0 * value:.2g}"


def simulated_table(frame):
    lines = [f"| excitation | method | {' | '.join(NAMES.values())} | truth within |"]
    lines.append("| --- | --- |" + " ---: |" * (len(NAMES) + 1))
    for (kind, method), part in frame.groupby(["excitation", "method"], sort=False):
        cells = []
        for path in NAMES:
            rows = part[part["path"] == path]
            error = np.sqrt(np.mean(rows["error"] ** 2)) if len(rows) else np.nan
            reach = percent(rows["reach"].mean()) if len(rows) else ""
            cells.append(percent(error) + (f" (± {reach})" if reach else ""))
        bounded = part[np.isfinite(part["reach"])]
        covered = (
            f"{int((bounded['error'].abs() <= bounded['reach']).sum())} of {len(bounded)}" if len(bounded) else "no interval"
        )
        lines.append(f"| {kind} | {method} | {' | '.join(cells)} | {covered} |")
    return lines


EMPS_LOG = {
    "u": {"column": "vir", "unit": "V", "factor": 35.1507},
    "theta_e": {"column": "qm", "unit": "m"},
    "closed_loop": True,
}
PUBLISHED = {
    "drive.motor_inertia": 95.109,
    "drive.motor_viscous": 203.50,
    "effects.motor.coulomb_friction.torque": 20.394,
    "effects.motor.constant_torque.torque": -3.165,
}


def emps_study(**identify):
    return {
        "title": "EMPS",
        "drive": {"kind": "rigid", "motor_inertia": 80.0, "motor_viscous": 150.0},
        "effects": [{"kind": "motor.coulomb_friction", "torque": 15.0}, {"kind": "motor.constant_torque", "torque": 0.0}],
        "log": EMPS_LOG,
        "run": {"sample_period": 1e-3, "substeps": 2, "duration": 1.0},
        "identify": identify,
    }


def emps_table():
    folder = Path(os.environ.get("JAXBL_DATA", Path(__file__).parents[1] / ".." / "shared" / "data")) / "emps"
    if not folder.exists():
        return ["EMPS: no recordings (the folder with them is named by JAXBL_DATA)."]
    estimation, validation = (read_record(folder / f"DATA_EMPS{x}.mat", EMPS_LOG) for x in ("", "_PULSES"))
    experiment = on_record(read_model(emps_study())[0], estimation)
    parts = [
        differentiate(recording.time, recording.torque, recording.positions, 100.0) for recording in (estimation, validation)
    ]
    estimates = {
        "published": {path: (value, np.nan) for path, value in PUBLISHED.items()},
        "derivatives, least squares": by_derivatives(experiment, list(PUBLISHED), estimation),
        "trajectories, output error": by_trajectories(emps_study(), estimation),
        "trajectories, prediction error": by_trajectories(emps_study(method="prediction_error"), estimation),
    }
    lines = ["| method | M (kg) | F_v (N s/m) | F_c (N) | offset (N) | force error (%) | on validation (%) |"]
    lines.append("| --- |" + " ---: |" * 6)
    for method, values in estimates.items():
        fitted = set_leaves(experiment, {path: jnp.asarray(value) for path, (value, _) in values.items()})
        left = [100.0 * torque_errors(estimation, fitted, [part], 10)["motor"]["relative"] for part in parts]
        cells = [
            f"{values[path][0]:.2f}" + (f" ± {values[path][1]:.2f}" if np.isfinite(values[path][1]) else "")
            if path in values
            else "refused"
            for path in PUBLISHED
        ]
        lines.append(f"| {method} | {' | '.join(cells)} | {left[0]:.2f} | {left[1]:.2f} |")
    return lines


def table(options):
    frame = simulate_record(options)
    lines = [
        f"{options.duration:g} s at {1.0 / PERIOD:g} Hz, {options.seeds} noise seeds; encoder noise {NOISE['motor']:g} rad",
        f"(motor), {NOISE['load']:g} rad (load). Relative errors in %, rms over seeds; in brackets the half-width of the",
        "95 % interval.",
        "",
        *simulated_table(frame),
        "",
    ]
    fits = frame[(frame["method"] == "trajectories, output error") & (frame["path"] == "transmission.half_gap")]
    worst = 100.0 * fits["error"].abs().max()
    lines += [f"Half gap by trajectories, output error: at worst {worst:.2g} % off in {len(fits)} logs (goal: 0.5 %).", ""]
    lines += emps_table()
    text = "\n".join(lines) + "\n"
    print(text)
    if options.out:
        options.out.write_text(text)


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
    data = {"title": "timing", "drive": {"kind": "two_inertia", "gear_ratio": RATIO}, "transmission": {"law": "dead_zone"}}
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
    position = jax.jit(lambda u: plant_trajectory(experiment, start, u).position)(jnp.asarray(torque))
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

    def time_stages(self, function, label):
        def call(*args, **keys):
            start = time.perf_counter()
            result = function(*args, **keys)
            jax.block_until_ready(jax.tree.leaves(result))
            self.seconds[label] += time.perf_counter() - start
            return result

        return call


def stages():
    return Stages(
        [
            (identify_module, "segments_of", "smoother"),
            (ParameterSearch, "_coarse", "starts"),
            (ParameterSearch, "_whole", "fits"),
            (identify_module, "gains_for", "gains"),
            (identify_module, "observer_chain", "chain"),
            (identify_module, "torque_errors", "torque errors"),
            (identify_module, "columns_of", "columns of the trace"),
        ]
    )


def time_stages(options):
    study = twelve(lambda i: 1.0 + 0.15 * (-1) ** i)
    rows = []
    for seconds in options.seconds:
        for call in range(options.calls):
            record = twelve_log(seconds, 10 * int(seconds) + call)
            with stages() as parts:
                start = time.perf_counter()
                identification = identify_module.identify(record, study)
                identify_seconds = time.perf_counter() - start
            values = identification.summary["parameters"]
            worst = max(
                abs(values[path]["value"] - true) / values[path]["standard_error"]
                for path, true in TWELVE.items()
                if path in values
            )
            search = identification.summary["method"]["trajectory"]
            rows.append({"log (s)": seconds, "call": call + 1, "s": identify_seconds, **parts.seconds})
            print(
                rows[-1],
                f"free {len(values)} worst {worst:.1f} deviations, window {search['window']}, "
                f"{search['starts_agreeing']} of {search['starts']} starts agree",
                flush=True,
            )
    print(pd.DataFrame(rows).round(2).to_string(index=False))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    comparison = commands.add_parser("table")
    comparison.add_argument("--seeds", type=int, default=5, help="noise realisations of each log")
    comparison.add_argument("--duration", type=float, default=10.0, help="of the simulated logs, s")
    comparison.add_argument("--excitations", nargs="*", default=["multisine", "steps", "chirp"])
    comparison.add_argument("--out", type=Path, help="file for the Markdown")
    comparison.set_defaults(run=table)
    speed = commands.add_parser("time")
    speed.add_argument("--seconds", type=float, nargs="*", default=[10.0, 20.0, 40.0], help="lengths of the logs")
    speed.add_argument("--calls", type=int, default=2, help="of each length, in one process")
    speed.set_defaults(run=time_stages)
    options = parser.parse_args()
    options.run(options)


if __name__ == "__main__":
    main()
