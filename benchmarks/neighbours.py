"""Neighbours of logs that were once read wrongly: ten machines of each kind, and the truth beside them.

    python benchmarks/neighbours.py                       # all kinds, ten of each
    python benchmarks/neighbours.py --kind zeros --count 3 --seed 2

- contradiction: three logs of one pendulum whose model lacks the dry friction: they do not contradict each other;
- wrong_units: a slow drive with dry friction in the model: nothing is said of units or a friction that is off;
- refused: a model without the friction or the gravity that moves the machine: the diagnosis begins;
- late: a current loop with a lag of some samples: the diagnosis ends, and names it;
- deaf: slow turns forth and back in closed loop: the diagnosis ends, and names the friction and the cogging;
- zeros: two logs of a drive with cogging that count from other zeros: the second is turned to the zero of the first by less
  than a hundredth of a period from the truth, and the diagnosis names the cogging.
Needs numba (the extra `bench`); an hour of one core.
"""

import argparse
import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from hidden.bristle import Axis, Drive, simulate

from jaxbl.errors import InputError


class Machine(NamedTuple):
    """An axis, its controller, the model as a study, and what the diagnosis should name."""

    axis: Axis
    drive: Drive
    model: dict[str, Any]
    lacking: tuple[str, ...]


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def draw_machine(rng: np.random.Generator, period: float, **special: float) -> Machine:
    """A direct drive with viscous and dry friction, and its exact numbers as a model without the latter."""
    inertia = _between(rng, 3e-5, 3e-2)
    friction = inertia * _between(rng, 20.0, 200.0)
    axis = Axis(inertia, 0.02 * friction, friction, length=1e-5, **{key: value * friction for key, value in special.items()})
    bandwidth = _between(rng, 15.0, 60.0)
    gain, step = inertia * bandwidth, 2.0 * math.pi / 2 ** int(rng.choice([14, 16, 18]))
    most = 4.0 * friction + axis.gravity + axis.amplitude + 20.0 * gain
    drive = Drive(period, bandwidth / 4.0, gain, gain * bandwidth / 4.0, min(1.0, 6.0 * bandwidth * period), most,
                  motor_step=step)  # fmt: skip
    table = {"kind": "rigid", "motor_inertia": inertia, "motor_viscous": axis.viscous}
    model = {"drive": table, "log": {"absent": ["theta_s"], "closed_loop": True}, "uncertainty": {"relative": 0.1}}
    return Machine(axis, drive, model, ("motor.coulomb_friction",))


def wave(speed: float, seconds: float, frequency: float, period: float) -> np.ndarray:
    """Speeds of a sine, rad/s."""
    return speed * np.sin(2.0 * math.pi * frequency * np.arange(round(seconds / period)) * period)


def write_log(machine: Machine, rates: np.ndarray, path: Path, seed: int) -> Path:
    """Run a machine at the speeds asked for, and write its log."""
    period = machine.drive.period
    run = simulate(
        machine.axis, machine.drive, np.cumsum(rates) * period, rates, np.ones(len(rates), bool), seed=seed
    )  # fmt: skip
    rows = np.column_stack([np.arange(len(rates)) * period, run.command, run.readings[:, 0]])
    np.savetxt(path, rows, "%.9g", ",", header="t,u,theta_e", comments="")
    return path


def _named(summary: dict[str, Any]) -> list[str]:
    return [finding["effect"] for finding in summary["findings"]]


def _answer(machine: Machine, logs: list[Path], holdout: Path | None) -> tuple[bool, str]:
    """Whether all that is lacking is named and nothing that is not there with more than 0.95, and what is named.

    The truth's friction bends before it slides: where an encoder sees that, presliding is its name, and a model with
    Coulomb friction lacks it.
    """
    import jaxbl

    summary = jaxbl.diagnose(logs if len(logs) > 1 else logs[0], machine.model, holdout=holdout).summary
    lacking = {name.replace("presliding", "coulomb") for name in machine.lacking}
    named = {finding["effect"].replace("presliding", "coulomb"): finding["confidence"] for finding in summary["findings"]}
    sure = {name for name, confidence in named.items() if confidence > 0.95}
    right = sure <= lacking | {"motor.coulomb_friction"} and lacking <= set(named)
    return right, f"{summary['verdict']}: {', '.join(_named(summary)) or 'nothing'}"


def try_contradiction(rng: np.random.Generator, folder: Path) -> tuple[bool, str]:
    import jaxbl

    period = 2e-3
    machine = draw_machine(rng, period, gravity=_between(rng, 0.5, 3.0))
    machine.model["effects"] = [{"kind": "load.gravity", "torque": machine.axis.gravity, "phase": 0.0}]
    speeds = rng.uniform(0.5, 6.0, 4)
    logs = [
        write_log(machine, wave(float(speed), 8.0, float(rng.uniform(0.15, 0.6)), period), folder / f"log{i}.csv", i)
        for i, speed in enumerate(speeds)
    ]
    summary = jaxbl.diagnose(logs[:3], machine.model, holdout=logs[3]).summary
    apart = [entry["parameter"] for entry in summary["contradictions"]]
    return not apart, f"contradictions: {', '.join(apart) or 'none'}; {summary['verdict']}: {', '.join(_named(summary))}"


def try_wrong_units(rng: np.random.Generator, folder: Path) -> tuple[bool, str]:
    from jaxbl.config import read_model
    from jaxbl.estimation.logs import read_logs

    period = 5e-3
    machine = draw_machine(rng, period)
    machine.model["effects"] = [{"kind": "motor.coulomb_friction", "torque": machine.axis.friction}]
    machine.model["drive"]["motor_viscous"] *= _between(rng, 0.1, 1.0)
    rates = wave(_between(rng, 0.05, 2.0), 20.0, 0.1, period)
    record = read_logs(read_model(machine.model)[0], write_log(machine, rates, folder / "log.csv", 1))
    remarks = [line for line in record.warnings if "times" in line or "unit" in line or "sign" in line]
    return not remarks, "; ".join(remarks) or "nothing"


def try_refused(rng: np.random.Generator, folder: Path) -> tuple[bool, str]:
    from jaxbl.diagnosis.diagnose import read_diagnosis_task
    from jaxbl.diagnosis.setup import set_up

    period = float(rng.choice([1e-3, 2e-3, 5e-3]))
    machine = draw_machine(rng, period, **({"gravity": _between(rng, 1.0, 5.0)} if rng.random() < 0.5 else {}))
    rates = wave(_between(rng, 0.3, 10.0), 16.0, float(rng.uniform(0.05, 0.4)), period)
    log = write_log(machine, rates, folder / "log.csv", 1)
    import jax

    with jax.enable_x64(True):
        setup = set_up(read_diagnosis_task(log, machine.model))
    return bool(setup.fitted.segments), "begun"


def try_late(rng: np.random.Generator, folder: Path) -> tuple[bool, str]:
    period, lag = 1e-3, float(rng.uniform(8e-3, 25e-3))
    machine = draw_machine(rng, period)
    slow = machine.drive.speed * 0.2 / (lag * machine.drive.speed / machine.axis.inertia)
    drive = Drive(**(vars(machine.drive) | {"lag": lag, "speed": slow, "position": 2.0, "integral": 0.0}))
    machine.model["effects"] = [{"kind": "motor.coulomb_friction", "torque": machine.axis.friction}]
    machine = machine._replace(drive=drive, lacking=("actuator.lag",))
    rates = wave(20.0, 12.0, 0.7, period) + wave(10.0, 12.0, 1.9, period)
    return _answer(machine, [write_log(machine, rates, folder / "log.csv", 1)], None)


def try_deaf(rng: np.random.Generator, folder: Path) -> tuple[bool, str]:
    period = 5e-3
    waves = float(rng.choice([6, 8, 12, 14, 18, 24]))
    machine = draw_machine(rng, period, amplitude=_between(rng, 0.3, 2.0))
    machine = machine._replace(
        axis=Axis(**(vars(machine.axis) | {"waves": waves, "phase": float(rng.uniform(-3.0, 3.0))})),
        lacking=("motor.coulomb_friction", "motor.cogging"),
    )
    speed = _between(rng, 0.5, 2.0)
    rates = [factor * speed * np.sign(wave(1.0, 20.0, 0.11, period) + 1e-12) for factor in (1.0, -0.8)]
    paths = [write_log(machine, part, folder / f"{name}.csv", i) for i, (name, part) in enumerate(
        zip(("log", "holdout"), rates, strict=True))]  # fmt: skip
    return _answer(machine, paths[:1], paths[1])


def try_zeros(rng: np.random.Generator, folder: Path) -> tuple[bool, str]:
    from jaxbl.config import read_model
    from jaxbl.estimation.logs import read_with_holdout

    period = 2e-3
    waves = float(rng.choice([3, 5, 6, 7, 12, 14, 18, 24, 36]))
    machine = draw_machine(rng, period, amplitude=_between(rng, 0.3, 1.0))
    machine = machine._replace(lacking=("motor.coulomb_friction", "motor.cogging"))
    shift, phase = float(rng.uniform(-3.0, 3.0)), float(rng.uniform(-3.0, 3.0))
    paths = []
    # a zero elsewhere is another phase
    for i, (name, added) in enumerate((("log", 0.0), ("holdout", waves * shift))):
        axis = Axis(**(vars(machine.axis) | {"waves": waves, "phase": phase + added}))
        rates = wave(_between(rng, 4.0, 12.0), 20.0, float(rng.uniform(0.1, 0.3)), period)
        paths.append(write_log(machine._replace(axis=axis), rates, folder / f"{name}.csv", i))
    found = read_with_holdout(read_model(machine.model)[0], *paths)[1].corrections.get("zero", 0.0)
    # shifts by a period are one
    error = math.remainder((found - shift) * waves, 2.0 * math.pi) / (2.0 * math.pi)
    right, text = _answer(machine, paths[:1], paths[1])
    return right and abs(error) < 0.01, f"{waves:.0f} waves, zero off by {100.0 * error:.2f} % of a period; {text}"


KINDS: dict[str, Callable[[np.random.Generator, Path], tuple[bool, str]]] = {
    "contradiction": try_contradiction,
    "wrong_units": try_wrong_units,
    "refused": try_refused,
    "late": try_late,
    "deaf": try_deaf,
    "zeros": try_zeros,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=10, help="of each kind")
    parser.add_argument("--kind", choices=KINDS, action="append")
    asked = parser.parse_args()
    for kind in asked.kind or KINDS:
        hits = 0
        for i in range(asked.count):
            rng = np.random.default_rng([asked.seed, list(KINDS).index(kind), i])
            with tempfile.TemporaryDirectory() as folder:
                try:
                    right, text = KINDS[kind](rng, Path(folder))
                except (InputError, ArithmeticError, LookupError) as error:
                    right, text = False, f"{type(error).__name__}: {error}"
            hits += right
            print(f"{kind} {i}: {'right' if right else 'WRONG'} ({text})", flush=True)
        print(f"{kind}: {hits} of {asked.count} right", flush=True)


if __name__ == "__main__":
    main()
