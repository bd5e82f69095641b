"""Recordings of real machines: files, splits, nominal models, and what is published of them.

Nominal numbers are those of a catalogue or publication where there is one, else rough ones; `[uncertainty]` says how rough.
No file of the recordings is part of the project: each is found by name and checked by SHA-256. Where they come from:

- emps: A. Janot, M. Gautier, M. Brunot, Data set and reference models of EMPS, Workshop on Nonlinear System Identification
  Benchmarks (2019);
- servo_1khz: GitHub, TeacherRock/Lorenz_Friction at 105c789;
- bam_xl330: Rhoban, Better Actuator Models, recordings of a Dynamixel XL330;
- flexible_link: GitHub, gleylaz/Optimal_SysID at 6eacf84;
- screw_drives: GitHub, RViMLab/TRO2021-Dynamic-Modelling at c3b758b;
- servoproject_dual_encoder: Adam Baeckstroem, ServoProject.
"""

import hashlib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat

_SCREW_FILES = tuple(f"screw_drives/experiments/driveNo2/start_stop/{rpm}.csv" for rpm in (200, 50))
SHA256 = {
    "emps/DATA_EMPS.mat": "6cf6814ae14618795da0101aae2bb97ff0c6351b0501b5492751b02b07facf7e",
    "emps/DATA_EMPS_PULSES.mat": "0eab75bb1f6b16228ee78791343a88bf9bfd9a51036ac9807d7b5fc11c0e1704",
    "servo_1khz/data_1.txt": "98337e795f5d05bbb74fddc55b8e9356ecc69d42769e15fe6715369a4e3cf524",
    "servo_1khz/data_10.txt": "828c9c175d670cd58fac4e302f72a877e802eccf2c6cbdbf24a62a3d57da955c",
    "servo_1khz/data_2.txt": "922ffc6588d40eadb081bb7b43c12cd8d769841b17b99d99e842187386d26ec0",
    "servo_1khz/data_S1_1.txt": "8717329742366fece1d9895773c35d72a17db3df9040fb5f6907fc800433bfce",
    "servo_1khz/data_S1_2.txt": "628c770a18b97fcf6691e01dbb67f81ed576194f47689e4f7e623483e860715d",
    "servo_1khz/data_S2_1.txt": "c7a4c8f3ef55d2ac5320476ef40ec47c17c998b880d2c751ec09eeddf0f14775",
    "servo_1khz/data_S3_1.txt": "f672c4780536ece6362d2055ce0c44531557bde97225b1625af96730fa74f7e3",
    "servo_1khz/data_S4_1.txt": "e80e9f1a355c746a452cb4804a14ec22ef2934330d216497e04b14261e341636",
    "bam_xl330/2026-01-15_10h28m17.json": "ef6507934ba465eb31529d7d98715ecc70bd5c87be049fd4618a94ce39290569",
    "bam_xl330/2026-01-15_10h29m21.json": "fe68cff62e976c87a2fcab925a517fbff83be16c862693310fdc1eff743eddab",
    "flexible_link/data_vm.mat": "b0657ef64eefa83955009884994049786cc8294b6b5fb6b3628d45928ecd21b9",
    "flexible_link/data_theta.mat": "e45d369d68dbd1271ff44adb39a31f78757829c65dc0a03401deaa8e897c986a",
    "flexible_link/data_alpha.mat": "43c1d7d835cdb09df640d0d8645628e64093ada71bf65fda897aa2eb47e3b347",
    "servoproject_dual_encoder/outputEncoderData.txt": "82f64be21646c013c7bc3b3632ed65994a47b8673021ff3c193e123e2a99a71f",
    _SCREW_FILES[0]: "f43d81126a67742ccf27828f851034d0e47e36f592923e7c6d2120f1626846cc",
    _SCREW_FILES[1]: "8b43f38057ab1d6c92e78fa87dd7787055af51434b3e354540964c58b31668f5",
}


@dataclass(frozen=True)
class Case:
    """A machine and a split of its recordings.

    Attributes:
        name: of the row.
        model: the nominal model, a study in TOML.
        fit: files that are fitted, below the folder of the recordings.
        holdout: file that is held out; "" for the last quarter of the log.
        published: what is known of the machine.
        cutoff: of the low-pass behind which torques are compared, Hz.
        readable: whether the package can read it now.
    """

    name: str
    model: str
    fit: tuple[str, ...]
    holdout: str = ""
    published: str = ""
    cutoff: float = 40.0
    readable: bool = True
    study: Mapping[str, Any] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "study", tomllib.loads(self.model))

    @property
    def files(self) -> tuple[str, ...]:
        """All of them."""
        return (*self.fit, *([self.holdout] if self.holdout else []))

    @property
    def split(self) -> str:
        """In words."""
        fit = " + ".join(Path(file).stem for file in self.fit)
        return f"{fit}; held out: {Path(self.holdout).stem if self.holdout else 'last quarter'}"


# Mass rough: the carriage's data sheet gives none. Publication: Janot, Gautier, Brunot (2019), low-pass of 100 Hz.
_EMPS = """
[drive]
kind = "rigid"
motor_inertia = 100.0
motor_viscous = 0.0
[run]
substeps = 2
[uncertainty]
relative = 0.1
[log]
closed_loop = true
u = { column = "vir", unit = "V", factor = 35.1507 }
theta_e = { column = "qm", unit = "m" }
"""

# No data sheet. Rough: what inertia and viscous friction alone come out as, which a person would begin with.
_SERVO = """
[drive]
kind = "rigid"
motor_inertia = 1.5e-4
motor_viscous = 3e-4
[run]
substeps = 2
[uncertainty]
relative = 0.5
[log]
closed_loop = true
t = { period = 1e-3 }
u = { column = 4 }
theta_e = { column = 0 }
"""

# m l^2 = 0.49 kg (0.10 m)^2, the pendulum as a mass point; without torque an inertia must be known, and sets the scale of
# all torques. The servo's own inertia is not known, and no part of it.
_XL330 = """
[drive]
kind = "rigid"
motor_inertia = 0.0049
motor_viscous = 0.0
[run]
substeps = 2
sample_period = 3.5e-3
[uncertainty]
exact = ["drive.motor_inertia"]
[log]
t = "timestamp"
theta_e = "position"
absent = ["u"]
where = { torque_enable = false }
resample = 3.5e-3
"""

# Catalogue of the Quanser SRV02 and its flexible link, all at the servo's output shaft: torque of a volt
# eta_g K_g eta_m k_t / R = 0.9 70 0.69 7.68e-3 / 2.6; viscous friction B_eq = 0.015 N m s/rad and the back-EMF's, that
# torque times K_g k_m = 70 7.68e-3; link m L^2 / 3 = 0.065 0.419^2 / 3. Catalogue numbers are taken to be good to 10 %.
_LOG_OF_LINK = """
[run]
substeps = 4
[uncertainty]
relative = 0.1
exact = ["drive.gear_ratio"]
[log]
closed_loop = true
u = { column = "volt", unit = "V", factor = 0.1284 }
theta_e = { column = "servo", unit = "deg" }
"""
_LINK = (
    _LOG_OF_LINK
    + """
theta_s = { column = "tip", unit = "deg" }
[drive]
kind = "two_inertia"
motor_inertia = 0.0020842
motor_viscous = 0.084
load_inertia = 0.003804
load_viscous = 0.0
gear_ratio = 1.0
[transmission]
law = "linear_shaft"
stiffness = 1.3
"""
)
# the link as if it were stiff: its inertia is the servo's
_STIFF_LINK = (
    _LOG_OF_LINK
    + """
[drive]
kind = "rigid"
motor_inertia = 0.005888
motor_viscous = 0.084
"""
)

# Rough numbers; the motor's torque was not recorded, and nothing but the lost motion (by jaxbl inspect) shows without it.
_DUAL = """
[drive]
kind = "two_inertia"
motor_inertia = 1e-4
motor_viscous = 1e-3
load_inertia = 1e-3
load_viscous = 1e-3
gear_ratio = 1.0
[transmission]
law = "linear_shaft"
stiffness = 10.0
[log]
t = 0
theta_s = { column = 1, unit = "deg", factor = 0.0537109375 }
theta_e = { column = 1, minus = 2, unit = "deg", factor = 0.0537109375 }
absent = ["u"]
"""

# Drive 2, the preloaded screw. Torque in % of 9.84 mN m, by its authors. No inertia is published: that of a motor of such a
# torque, 16 to 22 mm wide, and of a screw, within a factor of two. Friction rough: what viscous friction alone comes out as.
# 25 readings a second show speeds and standstill, and hardly an acceleration.
_SCREW = """
[drive]
kind = "rigid"
motor_inertia = 1e-6
motor_viscous = 2.4e-4
[run]
sample_period = 0.04
substeps = 100
[uncertainty]
relative = 0.5
[log]
closed_loop = true
t = { unit = "ms" }
omega_e = { column = "Velocity actual value averaged", unit = "rpm" }
u = { column = "Torque actual value averaged", factor = 9.84e-5 }
"""

_EMPS_PUBLISHED = "M 95.109 kg, F_v 203.50 N s/m, F_c 20.394 N, offset -3.165 N; friction depends on the direction"
_SERVO_SHARED = (
    "by least squares, 20 to 60 Hz: J 0.9e-4 kg m², viscous 1.0e-4 N m s/rad, Coulomb 0.0145 to 0.0153 N m, offset, ripple "
    "of 10 periods a turn 0.0027 N m; more is missing"
)
# By least squares on each record above 6 rad/s, 10 Hz, the column of the torque has
#   S1: J 1.76e-4, viscous 0.86e-4, Coulomb 0.0156;  S2: J 0.08e-4, the rest as S1;  S3: viscous 0.01e-4 as well;
#   S4: Coulomb -0.0008 as well;  data_1, _2, _10 (40 rad/s): J 0.25e-4 to 0.35e-4, viscous 0.7e-4 to 0.9e-4, Coulomb 0.0154
#   to 0.0160;  constant 0.0004 to 0.0010 in all.
# It looks as if a feedforward for inertia (from S2 on), viscous (S3) and Coulomb friction (S4) were not in it. Only S1 then
# shows the whole torque, and records of different kinds are of different machines.
_SERVO_S1 = (
    "S1 alone: J 1.76e-4 kg m², viscous 0.86e-4 N m s/rad, Coulomb 0.0156 N m, constant 0.0010 N m, ripple of 10 a turn"
)
_SERVO_40 = (
    "these alone: J 0.25e-4 to 0.35e-4 kg m², viscous 0.7e-4 to 0.9e-4 N m s/rad, Coulomb 0.0154 to 0.0160 N m, constant "
    "0.0004 to 0.0010 N m, ripple of 10 a turn"
)
_SERVO_MIXED = "S3: Coulomb 0.0157 N m; S4: none; data_10: 0.0154 N m: the logs contradict each other"
_XL330_PUBLISHED = "gravity, viscous and Coulomb friction; no load-dependent friction"
_SCREW_PUBLISHED = "dry friction: support 2.0 mN m at break-away, thread 0.20 of the load, falling with the speed (Stribeck)"
_LINK_PUBLISHED = "Coulomb friction of the servo"


def _turning(name: str) -> str:
    return f"servo_1khz/data_{name}.txt"


def _swing(time: str) -> str:
    return f"bam_xl330/2026-01-15_{time}.json"


_LINK_FILES = ("flexible_link/data_vm.mat", "flexible_link/data_theta.mat", "flexible_link/data_alpha.mat")

CASES = (
    Case("emps", _EMPS, ("emps/DATA_EMPS.mat",), "emps/DATA_EMPS_PULSES.mat", _EMPS_PUBLISHED, 100.0),
    Case("servo_1khz", _SERVO, (_turning("S2_1"), _turning("S1_1"),), _turning("1"), _SERVO_SHARED),
    Case("servo_1khz-S1", _SERVO, (_turning("S1_1"),), _turning("S1_2"), _SERVO_S1),
    Case("servo_1khz-40", _SERVO, (_turning("1"), _turning("2"),), _turning("10"), _SERVO_40),
    Case("servo_1khz-mixed", _SERVO, (_turning("S3_1"), _turning("S4_1"),), _turning("10"), _SERVO_MIXED),
    Case("bam_xl330", _XL330, (_swing("10h28m17"),), _swing("10h29m21"), _XL330_PUBLISHED, 20.0),
    Case("bam_xl330-swapped", _XL330, (_swing("10h29m21"),), _swing("10h28m17"), _XL330_PUBLISHED, 20.0),
    Case("bam_xl330-both", _XL330, (_swing("10h28m17"), _swing("10h29m21")), "", _XL330_PUBLISHED, 20.0),
    Case("flexible_link", _LINK, _LINK_FILES, "", _LINK_PUBLISHED, 30.0),
    Case("flexible_link-stiff", _STIFF_LINK, _LINK_FILES, "", _LINK_PUBLISHED + "; and the link bends", 30.0),
    Case("servoproject_dual_encoder", _DUAL, ("servoproject_dual_encoder/outputEncoderData.txt",), readable=False,
         published="lost motion 0.39 to 0.40 degrees"),
    # each log has one speed, to and fro: viscous and dry friction show only in both together
    Case("screw_drives", _SCREW, _SCREW_FILES, "", _SCREW_PUBLISHED, 5.0),
)  # fmt: skip


def unfit(case: Case, data: Path) -> str:
    """Why a case cannot be run, in one line; "" where all its files are the ones that are meant."""
    for name in case.files:
        path = data / name
        if not path.is_file():
            return f"{path}: no such file"
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        if digest != SHA256[name]:
            return f"{path}: SHA-256 {digest[:12]}..., expected {SHA256[name][:12]}...: another version of the file"
    return ""


def logs_of(case: Case, data: Path, folder: Path) -> tuple[list[Path], Path | None]:
    """Files as the package reads them, fitted and held out; those of the flexible link are made one, in `folder`."""
    if case.fit != _LINK_FILES:
        return [data / file for file in case.fit], data / case.holdout if case.holdout else None
    volts, servo, bend = (loadmat(data / file)[Path(file).stem] for file in case.fit)
    # the last column is the reading; the second of `data_theta` is the reference of the position controller
    table = np.column_stack([volts, servo[:, -1], servo[:, -1] + bend[:, -1]])
    path = folder / "flexible_link.csv"
    np.savetxt(path, table, delimiter=",", header="t,volt,servo,tip", comments="")
    return [path], None
