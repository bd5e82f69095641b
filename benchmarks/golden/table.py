"""The table of goldens: commands of `jaxbl`, the studies that they read, and how near their numbers must be.

Commands, config keys, names of result files and JSON keys are all that is used in here: they stay where Python names change.
Each golden has a folder of its own, with its studies, `sweeps` (of the side's tree), `inputs` (made once, by the base; see
inputs.py) and `recordings` (of real machines).
"""

from collections.abc import Mapping
from typing import NamedTuple

BITS = 0.0
"""Numbers are the same."""
IDENTIFIED, DIAGNOSED = 1e-9, 1e-6
"""Numbers differ by at most that, relative to the larger of both."""


class Golden(NamedTuple):
    """Results that are compared.

    Attributes:
        commands: arguments of `jaxbl`, in their order.
        tolerance: relative, of all numbers in the results; code and other text is compared as it is.
        inputs: what they read of `inputs`, by the names of inputs.py.
        studies: TOML texts by file name.
        recordings: whether they read recordings of real machines.
        minutes: about how much processor time they take; those with the most begin first.
    """

    commands: tuple[str, ...]
    tolerance: float = BITS
    inputs: tuple[str, ...] = ()
    studies: Mapping[str, str] = {}
    recordings: bool = False
    minutes: float = 0.5


# Sweeps

_SMALL_MAP = """
include = "sweeps/gain_map.toml"
sweep = { seeds = 1 }
run = { duration = 3.0 }
axes = [
  { path = "encoders.noise", values = [1e-5, 1e-4] },
  { path = "observer.motor.lambda", start = 0.1, stop = 30.0, num = 4, scale = "log" },
  { path = "observer.motor.alpha", start = 0.5, stop = 100.0, num = 4, scale = "log" },
]
"""
_SMALL_BOUNDARY = """
include = "sweeps/gain_boundary.toml"
sweep = { refine = 2 }
run = { duration = 4.0 }
axes = [
  { path = "observer.motor.lambda", start = 0.1, stop = 40.0, num = 9, scale = "log" },
  { path = "observer.motor.alpha", start = 0.5, stop = 100.0, num = 9, scale = "log" },
]
"""
_SMALL_LAWS = """
include = "sweeps/accuracy_laws.toml"
run = { duration = 4.0 }
sweep = { seeds = 1 }
axes = [
  { path = "observer.discretisation", values = ["explicit", "implicit"] },
  { path = "run.sample_period", values = [1e-3, 2.5e-3, 6.25e-3], zip = "period" },
  { path = "run.substeps", values = [10, 25, 63], zip = "period" },
  { path = "encoders.noise", values = [0.0, 1e-6, 1e-5, 1e-4, 1e-3] },
]
"""

# Gains

_SMALL_ATLAS = """
include = "sweeps/condition_atlas.toml"
axes = [
  { path = "excitation.amplitude", values = [0.04, 0.16] },
  { path = "excitation.frequency", values = [0.16, 1.6] },
  { path = "observer.motor.lambda", start = 0.005, stop = 50.0, num = 8, scale = "log" },
  { path = "observer.motor.alpha", start = 0.5, stop = 50.0, num = 6, scale = "log" },
]
[verify]
alpha_ratio = { num = 48 }
lambda_ratio = { num = 48 }
"""
_SMALL_TUNING = """
include = "sweeps/tune_paper_drive.toml"
sweep = { seeds = 2 }
run = { duration = 8.0 }
"""
_SMALL_CHOICE = """
include = "sweeps/observer_choice.toml"
sweep = { seeds = 1 }
run = { duration = 4.0 }
[tune]
trials = 8
refine = 1
observers = ["super_twisting", "luenberger", "differentiator_3"]
axes = [{ path = "encoders.noise", values = [1e-5, 1e-3] }]
"""

# Exports

_OBSERVERS = (
    *("super_twisting", "luenberger", "extended_state", "kalman", "dirty_derivative"),
    *(f"differentiator_{order}" for order in range(1, 6)),
)
_GAINS = (
    "{ lambda = 4.0, alpha = 9.0, bandwidth = 150.0, damping = 0.8, position_noise = 1e-4, disturbance_noise = 100.0, "
    "time_constant = 0.004, lipschitz = 50.0 }"
)
_OBSERVED = """
include = "sweeps/paper_table1.toml"
[observer]
kind = "{kind}"
discretisation = "{discretisation}"
motor = {gains}
load = {gains}
"""
_KINDS = {f"{kind}.toml": _OBSERVED.format(kind=kind, discretisation="implicit", gains=_GAINS) for kind in _OBSERVERS} | {
    "explicit.toml": _OBSERVED.format(kind="super_twisting", discretisation="explicit", gains=_GAINS)
}
_LAWS = {
    "shaft.toml": 'include = "sweeps/gain_map.toml"\ntransmission = { law = "linear_shaft", stiffness = 1.0 }\n',
    "dead_zone.toml": 'include = "sweeps/geared_axis.toml"\n',
    "sigmoid.toml": 'include = "sweeps/gain_map.toml"\n',
    "rigid.toml": 'include = "sweeps/direct_drive.toml"\n',
}
_INPUTS = "inputs"
"""Folder of the input files, the same for both sides."""
_EFFECTS = {"geared_effects": f"{_INPUTS}/effects/geared.toml", "rigid_effects": f"{_INPUTS}/effects/rigid.toml"}
_DRIVES = {file.removesuffix(".toml"): file for file in _LAWS} | _EFFECTS


def _code(file: str) -> tuple[str, ...]:
    """Commands that export the observers of a study to all languages, with numbers of both types."""
    name = file.removesuffix(".toml")
    return tuple(
        f"export {file} --target {target} --precision {precision} --name drive --out {target}/{name}_{precision}"
        for target in ("c", "st")
        for precision in ("double", "float")
    )


_CODE = tuple(command for file in _KINDS for command in _code(file))
_MODELS = (
    *(f"export {file} --target fmu --fmi 3 --name drive --out fmu/{name}" for name, file in _DRIVES.items()),
    *(f"export {file} --target fmu --fmi 2 --name drive --out fmu2/{name}" for name, file in _EFFECTS.items()),
    "export sigmoid.toml --target fmu --precision float --name drive --out fmu/sigmoid_float",
    *(f"export {file} --target mjcf --out mjcf/{name}" for name, file in _DRIVES.items()),
    *(
        f"export {file} --target mjcf --linear load --out mjcf/{name}_linear"
        for name, file in _EFFECTS.items()
        if "geared" in name
    ),
    "export rigid.toml --target mjcf --linear motor --out mjcf/rigid_linear",
)

# Logs

_TUTORIAL = """
[drive]
kind = "rigid"
motor_inertia = 0.051
motor_viscous = 0.145
[[effects]]
kind = "motor.coulomb_friction"
torque = 0.21
[uncertainty]
relative = 0.03
"""
_MOTOR_ALONE = """
include = "sweeps/geared_axis_nominal.toml"
[log]
absent = ["theta_s"]
"""
_ELEMENT = """
[log]
kind = "element"
"""
_MACHINES = {
    "emps": "recordings/emps/DATA_EMPS.mat --holdout recordings/emps/DATA_EMPS_PULSES.mat",
    "servo": "recordings/servo_1khz/data_S1_1.txt --holdout recordings/servo_1khz/data_S1_2.txt",
    "swing": "recordings/bam_xl330/2026-01-15_10h28m17.json --holdout recordings/bam_xl330/2026-01-15_10h29m21.json",
    "link": "inputs/recorded/flexible_link.csv",
    "screw": " ".join(f"recordings/screw_drives/experiments/driveNo2/start_stop/{speed}.csv" for speed in (200, 50)),
}
"""Recordings by the name of their nominal model."""


def _hidden(part: str) -> Golden:
    """A fourth of the hidden cases."""
    return Golden((f"diagnose --batch inputs/{part} --jobs 1 --out {part}",), DIAGNOSED, inputs=("hidden",), minutes=4.0)


GOLDENS: dict[str, Golden] = {
    **{f"hidden_{number}": _hidden(f"hidden/{number}") for number in (1, 2, 3, 4)},
    "condition_atlas": Golden(
        ("verify atlas.toml --backend fused --out atlas",), studies={"atlas.toml": _SMALL_ATLAS}, minutes=1.5
    ),
    "tune": Golden(
        ("tune tune.toml --backend fused --out tuned", "tune choice.toml --backend fused --out choice"),
        studies={"tune.toml": _SMALL_TUNING, "choice.toml": _SMALL_CHOICE},
        minutes=1.5,
    ),
    "export_code": Golden(_CODE, studies=_KINDS, minutes=1.0),
    "export_models": Golden(_MODELS, inputs=("effects",), studies=_LAWS, minutes=1.0),
    "gain_map": Golden(
        (
            "sweep sweeps/gain_map.toml --share 1/48 --backend fused --out gain_map",
            "sweep map.toml --backend scan --out scanned",
        ),
        studies={"map.toml": _SMALL_MAP},
    ),
    "dead_zone_noise": Golden(("sweep sweeps/dead_zone_noise.toml --share 1/4 --backend fused --out dead_zone_noise",)),
    "sweeps": Golden(
        (
            "sweep boundary.toml --backend fused --out boundary",
            "sweep laws.toml --backend fused --out laws",
            "sweep map.toml --backend fused --out map",
            "compare boundary map --out compared",
            "status map",
        ),
        studies={"boundary.toml": _SMALL_BOUNDARY, "laws.toml": _SMALL_LAWS, "map.toml": _SMALL_MAP},
        minutes=1.0,
    ),
    "simulate": Golden(
        (
            f"simulate {_INPUTS}/effects/geared.toml --out geared",
            f"simulate {_INPUTS}/effects/rigid.toml --out rigid",
            "simulate sweeps/paper_table1.toml --every 50 --out paper",
        ),
        inputs=("effects",),
    ),
    "log_tutorial": Golden(
        (
            "inspect inputs/tutorial/log.csv --model model.toml --out inspected",
            "inspect inputs/tutorial/log.csv --write proposed.toml --out proposed",
            "identify inputs/tutorial/log.csv --model model.toml --out identified",
        ),
        IDENTIFIED,
        inputs=("tutorial",),
        studies={"model.toml": _TUTORIAL},
    ),
    "log_tutorial_diagnosed": Golden(
        ("diagnose inputs/tutorial/log.csv --model model.toml --out diagnosed",),
        DIAGNOSED,
        inputs=("tutorial",),
        studies={"model.toml": _TUTORIAL},
    ),
    "recordings": Golden(
        (
            *(f"identify {logs} --model {_INPUTS}/recorded/{name}.toml --out {name}" for name, logs in _MACHINES.items()),
            "inspect recordings/servoproject_dual_encoder/outputEncoderData.txt"
            f" --model {_INPUTS}/recorded/dual.toml --out dual",
        ),
        IDENTIFIED,
        inputs=("recorded",),
        recordings=True,
        minutes=2.0,
    ),
    "simulated_logs": Golden(
        (
            "identify inputs/simulated/geared.parquet --model sweeps/geared_axis_nominal.toml --out geared",
            "identify inputs/simulated/geared.parquet --model motor.toml --out motor_alone",
            "identify inputs/simulated/direct.parquet inputs/simulated/direct_1.parquet --profile"
            " --holdout inputs/simulated/direct_2.parquet --model sweeps/direct_drive.toml --out direct",
            "inspect inputs/simulated/geared.parquet --model sweeps/geared_axis_nominal.toml --out inspected",
            "inspect inputs/simulated/element.csv --model element.toml --out element",
            "watch inputs/simulated/geared.parquet --model sweeps/geared_axis.toml"
            " --window 5 --alarm-gap 0.12 --out watched",
        ),
        IDENTIFIED,
        inputs=("simulated",),
        studies={"motor.toml": _MOTOR_ALONE, "element.toml": _ELEMENT},
        minutes=1.5,
    ),
    "schema": Golden(("schema",)),
}  # fmt: skip
