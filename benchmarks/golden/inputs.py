"""Make what both sides read: logs, models and studies. Run with the base's package, benchmarks and tests on the path.

    python inputs.py NAME FOLDER [RECORDINGS]

The Python names in here are those of the base, whatever the working tree calls them.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import tomli_w

PARTS_OF_HIDDEN = 4


def simulated_log(study: str, path: Path, columns: list[str], seed: int = 0) -> None:
    """Write what encoders would record of a simulated study."""
    folder = path.with_suffix("")
    command = ("simulate", study, "--seed", str(seed), "--quiet", "--out", str(folder))
    subprocess.run([sys.executable, "-P", "-m", "jaxbl", *command], check=True)
    trace = pd.read_parquet(folder / "trace.parquet")[columns]
    if path.suffix == ".csv":
        trace.to_csv(path, index=False)
    else:
        trace.to_parquet(path)


def tutorial(folder: Path) -> None:
    """The log of docs/log_tutorial.md."""
    machine = folder / "machine.toml"
    machine.write_text(
        f'include = "{SWEEPS}/direct_drive.toml"\n'
        '[[effects]]\nkind = "motor.coulomb_friction"\ntorque = 0.2\n'
        '[[effects]]\nkind = "motor.cogging"\namplitude = 0.1\nharmonic = 7\n'
    )
    simulated_log(str(machine), folder / "log.csv", ["t", "u", "theta_e"])


def write_simulated(folder: Path) -> None:
    """A geared axis with both encoders, a direct drive three times, and a transmission on a test rig."""
    simulated_log(f"{SWEEPS}/geared_axis.toml", folder / "geared.parquet", ["t", "u", "theta_e", "theta_s"])
    for seed, name in enumerate(("direct", "direct_1", "direct_2")):
        simulated_log(f"{SWEEPS}/direct_drive.toml", folder / f"{name}.parquet", ["t", "u", "theta_e"], seed)
    from records import test_element

    # its name at the base
    positions, torques = getattr(test_element, "loaded")()  # noqa: B009
    times = test_element.PERIOD * np.arange(len(positions))
    table = {"t": times, "u": torques, "theta_e": positions}
    pd.DataFrame(table).to_csv(folder / "element.csv", index=False)


def hidden(folder: Path) -> None:
    """Forty machines with hidden effects, in four folders as `jaxbl diagnose --batch` reads them."""
    from hidden.cases import cases, save

    hidden_cases = cases(41, 40, "all")
    for part in range(PARTS_OF_HIDDEN):
        save(hidden_cases[part::PARTS_OF_HIDDEN], folder / str(part + 1))
        (folder / str(part + 1) / "truth.json").unlink()


def effects(folder: Path) -> None:
    """A geared and a direct drive with all effects that they can have."""
    from effect_values import ENCODERS, VALUES
    from small_study import rigid, small

    # of the values' own size a delay takes many samples
    values = VALUES | ENCODERS | {"actuator.delay": {"delay": 2.3e-3}}
    tables = [
        {"kind": kind, **{key: list(number) if isinstance(number, tuple) else number for key, number in numbers.items()}}
        for kind, numbers in values.items()
    ]
    on_one_side = [table for table in tables if str(table["kind"]).startswith(("motor.", "actuator.", "encoder."))]
    tables_beside = {
        "excitation": {"kind": "multisine", "amplitude": 5.0, "frequency": 0.7},
        "encoders": {"noise": 1e-3, "motor_resolution": 1e-3},
    }
    moved = {"motor_position": 0.3, "motor_velocity": -1.0, "load_position": 0.02, "load_velocity": 0.4}
    length = {"run.duration": 1.5, "run.substeps": 4}
    (folder / "geared.toml").write_text(tomli_w.dumps(small(length, effects=tables, initial=moved, **tables_beside)))
    (folder / "rigid.toml").write_text(tomli_w.dumps(rigid(length, effects=on_one_side, **tables_beside)))


def write_recorded(folder: Path) -> None:
    """Nominal models of real machines, and one log that is put together from three files."""
    from real.machines import CASES, logs_of

    case_names = {
        "emps": "emps",
        "servo": "servo_1khz-S1",
        "swing": "bam_xl330",
        "link": "flexible_link",
        "screw": "screw_drives",
        "dual": "servoproject_dual_encoder",
    }
    machines = {case.name: case for case in CASES}
    for name, case_name in case_names.items():
        (folder / f"{name}.toml").write_text(machines[case_name].model)
    logs_of(machines["flexible_link"], Path(sys.argv[3]), folder)


if __name__ == "__main__":
    name, place = sys.argv[1:3]
    import jaxbl

    SWEEPS = Path(jaxbl.__file__).parents[1] / "sweeps"
    {"tutorial": tutorial, "simulated": write_simulated, "hidden": hidden, "effects": effects, "recorded": write_recorded}[
        name
    ](Path(place))
