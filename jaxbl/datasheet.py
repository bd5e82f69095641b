"""A first study from what a drive's data sheet says: the function behind `jaxbl init`.

Numbers are read in the units of data sheets and written in SI, each beside what was given. Observer gains are the usual rule
(:func:`jaxbl.gains.tune.usual_rule`) at the bound f⁺ that a pilot run of the study finds.
"""

import math
import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from .errors import InputError

Unit = float | Callable[[float], float]
"""A factor to SI, or a function that gives the SI value."""

_DEGREE = math.pi / 180.0
_RPM = math.pi / 30.0
_ANGLE: dict[str, Unit] = {
    "rad": 1.0, "mrad": 1e-3, "deg": _DEGREE, "arcmin": _DEGREE / 60.0, "arcsec": _DEGREE / 3600.0,
}  # fmt: skip
_TORQUE: dict[str, Unit] = {"N m": 1.0, "mN m": 1e-3, "N cm": 1e-2}
_INERTIA: dict[str, Unit] = {"kg m²": 1.0, "kg cm²": 1e-4, "kg mm²": 1e-6, "g cm²": 1e-7}
_VISCOUS: dict[str, Unit] = {
    "N m s/rad": 1.0, "mN m s/rad": 1e-3, "N m/rpm": 1.0 / _RPM, "mN m/rpm": 1e-3 / _RPM, "mN m/krpm": 1e-6 / _RPM,
}  # fmt: skip
_STIFFNESS: dict[str, Unit] = {
    "N m/rad": 1.0, "kN m/rad": 1e3, "N m/deg": 1.0 / _DEGREE, "N m/arcmin": 60.0 / _DEGREE,
}  # fmt: skip
_STEP: dict[str, Unit] = _ANGLE | {
    "counts": lambda count: 2.0 * math.pi / count,
    "lines": lambda count: 0.5 * math.pi / count,  # of which each makes four counts
    "bit": lambda bits: 2.0 * math.pi / 2.0**bits,
}
_PERIOD: dict[str, Unit] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "Hz": lambda rate: 1.0 / rate, "kHz": lambda rate: 1e-3 / rate}
_SPEED: dict[str, Unit] = {"rad/s": 1.0, "rpm": _RPM, "deg/s": _DEGREE}
_WAYS = {
    "²": "2", "µ": "u", "μ": "u", "°": "deg", "′": "arcmin", "″": "arcsec", "1/min": "rpm", "min-1": "rpm", "bits": "bit",
    ":1": "",
}  # fmt: skip
"""Other ways to write parts of units."""


class Item(NamedTuple):
    """A number of a data sheet.

    Attributes:
        name: as an option, with _ for -.
        asked: what it is, in words.
        units: that it may be given in; the first is SI, and what a number alone is in.
        example: as a data sheet may say it.
        default: what is taken if it is left out; "" where it has to be given.
        least: smallest possible SI value; `above`: whether it has to be larger than that.
    """

    name: str
    asked: str
    units: Mapping[str, Unit]
    example: str
    default: str = ""
    least: float = 0.0
    above: bool = True

    def read(self, text: str) -> "Given":
        """The number in SI.

        Raises:
            InputError: no number, a unit that is not known here, or out of range.
        """
        known = {_spelt(unit): (unit, factor) for unit, factor in self.units.items()}
        found = re.fullmatch(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*", text)
        units = ", ".join(unit for unit in self.units if unit) or "none"
        if not found:
            raise InputError(f"{self.option} '{text}': should be a number and its unit, such as '{self.example}'")
        number, unit = float(found[1]), _spelt(found[2]) or next(iter(known))
        if unit not in known:
            raise InputError(f"{self.option} '{text}': the unit '{found[2]}' is not known here; known: {units}")
        name, factor = known[unit]
        try:
            value = factor(number) if callable(factor) else factor * number
        except (ZeroDivisionError, OverflowError):
            value = math.nan
        if not (self.least < value < 1e30 or (value == self.least and not self.above)):
            raise InputError(
                f"{self.option} '{text}': should be {'more than' if self.above else 'at least'} {self.least:g} "
                f"{next(iter(self.units))}".rstrip()
                + f", such as '{self.example}'"
            )
        return Given(value, f"given: {found[1]} {name}".rstrip())

    def left_out(self) -> "Given":
        """What stands for a number that is not given."""
        return Given(self.read(self.default).value, "not given")

    @property
    def option(self) -> str:
        """Its name on the command line."""
        return f"--{self.name.replace('_', '-')}"


class Given(NamedTuple):
    """A number in SI, and how it was given, in words."""

    value: float
    text: str


def _spelt(unit: str) -> str:
    """A unit in one spelling."""
    for other, ours in _WAYS.items():
        unit = unit.replace(other, ours)
    return re.sub(r"[\s·*^]", "", unit).lower()


ITEMS = (
    Item("motor_inertia", "inertia of the rotor", _INERTIA, "0.48 kg cm²"),
    Item("motor_viscous", "viscous friction at the motor", _VISCOUS, "2 mN m/krpm", "0 N m s/rad", above=False),
    Item("motor_friction", "dry friction at the motor, with the gear's", _TORQUE, "15 mN m", "0 N m", above=False),
    Item("torque", "rated torque of the motor", _TORQUE, "1.3 N m"),
    Item("speed", "rated speed of the motor", _SPEED, "3000 rpm"),
    Item("gear_ratio", "gear ratio, motor turns for one turn of the load", {"": 1.0}, "50"),
    Item("stiffness", "torsional stiffness of the gear at its output", _STIFFNESS, "12 N m/arcmin"),
    Item("backlash", "backlash of the gear at its output, end to end", _ANGLE, "3 arcmin", above=False),
    Item("load_inertia", "inertia of the load at its own shaft", _INERTIA, "0.4 kg m²"),
    Item("load_viscous", "viscous friction at the load", _VISCOUS, "0.5 N m s/rad", "0 N m s/rad", above=False),
    Item("motor_encoder", "one count of the motor's encoder", _STEP, "17 bit", "0 rad", above=False),
    Item("load_encoder", "one count of the load's encoder", _STEP, "20 bit", "0 rad", above=False),
    Item("encoder_noise", "rms noise of the motor's encoder", _ANGLE, "5 arcsec", "0 rad", above=False),
    Item("sample_period", "sampling period of the drive", _PERIOD, "0.25 ms", "1 ms"),
    Item("frequency", "lowest frequency of the test input", {"Hz": 1.0}, "0.5 Hz", "0.5 Hz"),
)
"""What is asked for, in this order."""

_HARMONICS, _PERIODS = 6, 5
"""Of the test input: harmonics, and periods of the lowest."""
_PART = 0.05
"""Of the largest speed: the velocity error that an observer may have."""


def first_study(given: Mapping[str, Given], title: str) -> tuple[str, dict[str, Any]]:
    """A study with comments that `simulate`, `sweep` and `tune` can run.

    Args:
        given: the number of each of :data:`ITEMS`, by its name.
        title: headline of its report.

    Returns:
        The TOML text, and what the pilot run found, by side.

    Raises:
        InputError: numbers that no study can have together.
        NoResult: the drive diverges.
    """
    from .config import TuneTable, read_config, read_model
    from .gains.pilot import Scenarios, pilot
    from .gains.tune import usual_rule

    text = _drive(given, title)
    model, _ = read_model(_data(text))
    found = pilot(Scenarios(model, ["nominal"], {}), TuneTable())
    gains = {side: usual_rule(one["f_plus"]) for side, one in found.items()}
    text += _observers(given, found, gains)
    read_config(_data(text))
    return text, found


def _data(text: str) -> dict[str, Any]:
    import tomllib

    return tomllib.loads(text)


def _number(value: float, digits: int = 6) -> str:
    return repr(float(f"{value:.{digits}g}"))


def _drive(given: Mapping[str, Given], title: str) -> str:
    """The tables of the drive, its input and its sensors."""
    import tomli_w

    from .drive.effects import CoulombFriction
    from .records import NominalDrive
    from .records.proposal import plant_steps

    value = {name: one.value for name, one in given.items()}

    def line(key: str, name: str, factor: float = 1.0, unit: str = "", how: str = "") -> str:
        """A key, its SI unit, and what was given."""
        return f"{key} = {_number(factor * value[name])} # {unit}{', ' * bool(unit)}{given[name].text}{how}"

    ratio, gap = value["gear_ratio"], 0.5 * value["gear_ratio"] * value["backlash"]
    stiffness = value["stiffness"] / ratio**2
    amplitude = _amplitude(given, _HARMONICS)
    limit = "the rated torque" if amplitude == value["torque"] else "what takes its lowest wave to the rated speed"
    drive = NominalDrive(
        value["motor_inertia"], value["motor_viscous"], value["load_inertia"], value["load_viscous"], ratio, stiffness, gap
    )
    at_motor = "on the motor's shaft"
    lines = [
        "# Written by jaxbl init from a data sheet. All numbers are in SI units; behind each stands what was given.",
        "# All keys: docs/reference.md, and 'jaxbl schema' for editors that complete them.",
        tomli_w.dumps({"title": title}).strip(),
        "",
        "[drive]",
        'kind = "two_inertia"',
        line("motor_inertia", "motor_inertia", unit="kg m²"),
        line("motor_viscous", "motor_viscous", unit="N m s/rad"),
        line("load_inertia", "load_inertia", unit="kg m², at the load's shaft"),
        line("load_viscous", "load_viscous", unit="N m s/rad, at the load's shaft"),
        line("gear_ratio", "gear_ratio"),
        "",
        "[transmission]",
        'law = "dead_zone" # a hard gap' if gap else 'law = "linear_shaft" # no backlash was given',
        line("stiffness", "stiffness", ratio**-2, f"N m/rad {at_motor}", f" at the output, divided by {ratio:g}²"),
    ]
    if gap:
        how = f" at the output, end to end; half of it times {ratio:g}"
        lines.append(line("half_gap", "backlash", 0.5 * ratio, f"rad {at_motor}", how))
    if value["motor_friction"]:
        lines += ["", "[[effects]]", f'kind = "motor.{CoulombFriction.kind}"', line("torque", "motor_friction", unit="N m")]
    noise = " (the load's is this divided by the gear ratio; load_noise says otherwise)"
    lines += [
        "",
        "# The input: six waves at once. Replace it by a motion of your own: kind = 'recorded' plays a file back.",
        "[excitation]",
        'kind = "multisine"',
        f"amplitude = {_number(amplitude, 3)} # N m: {limit}; {given['torque'].text}, and {given['speed'].text[7:]}",
        line("frequency", "frequency", unit="Hz"),
        f"count = {_HARMONICS}",
        "",
        "[encoders]",
        line("noise", "encoder_noise", unit="rad rms", how=noise),
        line("motor_resolution", "motor_encoder", unit="rad a count, 0 is ideal"),
        line("load_resolution", "load_encoder", unit="rad a count, 0 is ideal"),
        "",
        "[run]",
        f"duration = {_number(_PERIODS / value['frequency'])} # s: {_PERIODS} periods of the input",
        line("sample_period", "sample_period", unit="s"),
        f"substeps = {plant_steps(drive, value['sample_period'])} # steps of the plant a sample, by the stiffness",
    ]
    return "\n".join(lines) + "\n"


def _amplitude(given: Mapping[str, Given], waves: int) -> float:
    """Amplitude (N m) of an input of so many waves, at most the rated torque: the lowest takes the rigid drive to its rated
    speed."""
    value = {name: one.value for name, one in given.items()}
    inertia = value["motor_inertia"] + value["load_inertia"] / value["gear_ratio"] ** 2
    lowest = 2.0 * math.pi * value["frequency"] * inertia * value["speed"]
    return min(value["torque"], lowest * math.sqrt(waves) + value["motor_friction"])


def _accepted(given: Mapping[str, Given], found: Mapping[str, Any]) -> tuple[float, float]:
    """Velocity and position error (rad/s, rad) that the motor's observer may have.

    A part of the largest speed; twice what the largest unknown acceleration makes of the speed in a sample; and what
    readings off by e cost a differentiator of such signals, in proportion to sqrt(f+ e).
    Reference: A. Levant, Automatica 34 (1998).
    """
    period, ratio = given["sample_period"].value, given["gear_ratio"].value
    off = given["motor_encoder"].value + 4.0 * given["encoder_noise"].value
    load_off = ratio * given["load_encoder"].value + 4.0 * given["encoder_noise"].value
    costs = [
        2.0 * bound * period + 4.0 * math.sqrt(bound * error)
        for bound, error in ((found["motor"]["f_plus"], off), (ratio * found["load"]["f_plus"], load_off))
    ]
    velocity = _PART * found["motor"]["largest_velocity"] + max(costs)
    return velocity, velocity * period + 4.0 * max(off, load_off)


def remark(given: Mapping[str, Given], found: Mapping[str, Any]) -> str:
    """What stands in the way of good estimates, in a sentence; "" if nothing does."""
    velocity, _ = _accepted(given, found)
    share = velocity / found["motor"]["largest_velocity"]
    if share < 2.0 * _PART:
        return ""
    return (
        f"Observers may be off by {100.0 * share:.2g} % of the largest speed: the torque changes within few samples, or the "
        "encoders are coarse. A shorter sample period or finer encoders help."
    )


def _observers(given: Mapping[str, Given], found: Mapping[str, Any], gains: Mapping[str, tuple[float, float]]) -> str:
    """What goes on with `[run]`: the errors that are accepted, then the observers, and what sweep and tune need."""
    velocity, position = _accepted(given, found)
    bound = {side: float(one["f_plus"]) for side, one in found.items()}
    frequency = given["frequency"].value
    lines = [
        f"# Errors of the motor observer that are accepted: {100 * _PART:g} % of the largest speed, and what period, counts",
        "# and noise cost any observer; on the load both are divided by the gear ratio. Put in what you need.",
        f"velocity_tolerance = {_number(velocity, 2)} # rad/s",
        f"position_tolerance = {_number(position, 2)} # rad",
        "",
        "# Gains by the usual rule, lambda = 1.5 sqrt(f+) and alpha = 1.1 f+; f+ is the largest acceleration in a run of",
        f"# this study that observers do not know: {bound['motor']:.3g} rad/s² (motor), {bound['load']:.3g} rad/s² (load).",
        "# 'jaxbl tune' looks for better ones.",
        "[observer]",
    ]
    for side, (lambda_, alpha) in gains.items():
        lines.append(f"{side} = {{ lambda = {_number(lambda_, 3)}, alpha = {_number(alpha, 3)} }} # √rad/s, rad/s²")
    lines += [
        "",
        "# jaxbl tune: gains of the least error, compared on another input",
        "[tune]",
        'objective = "velocity" # or "torque"',
        "[tune.holdout]",
        'kind = "chirp"',
        f"amplitude = {_number(_amplitude(given, 1), 3)} # N m: the rated torque, or what takes it to the rated speed",
        f"start_frequency = {_number(frequency)} # Hz",
        f"stop_frequency = {_number(4.0 * frequency)}",
        f"sweep_time = {_number(_PERIODS / frequency)} # s",
        "",
        "# jaxbl sweep: a map of the motor observer's gains. Any number of this file can be an axis, by its table and key.",
    ]
    for gain, scale, (least, largest) in (
        ("lambda", math.sqrt(bound["motor"]), (0.3, 50.0)),
        ("alpha", bound["motor"], (0.5, 100.0)),
    ):
        lines += [
            "[[axes]]",
            f'path = "observer.motor.{gain}"',
            f"start = {_number(least * scale, 3)}",
            f"stop = {_number(largest * scale, 3)}",
            "num = 32",
            'scale = "log"',
            "",
        ]
    lines += [
        "[[figures]]",
        'kind = "heatmap"',
        'x = "observer.motor.alpha"',
        'y = "observer.motor.lambda"',
        'value = "motor.velocity_rmse"',
        'overlays = ["davila_fridman", "seeber_horn", "exact"] # gain conditions drawn over the map',
    ]
    return "\n".join(lines) + "\n"
