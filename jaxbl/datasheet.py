"""A first study from what a drive's data sheet says: the function behind `jaxbl init`.

Numbers are read in the units of data sheets and written in SI, each beside what was given. Observer gains are the usual rule
(:func:`jaxbl.gains.gain_search.usual_rule`) at the bound f⁺ that a pilot run of the study finds.
"""

import math
import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from .errors import InputError
from .units import on_a_line

Unit = float | Callable[[float], float]
"""A factor to SI, or a function that gives the SI value."""

_DEGREE = math.pi / 180.0
_RPM = math.pi / 30.0
_ANGLE: dict[str, Unit] = {
    "rad": 1.0, "mrad": 1e-3, "deg": _DEGREE, "arcmin": _DEGREE / 60.0, "arcsec": _DEGREE / 3600.0,
}  # fmt: skip
_TORQUE: dict[str, Unit] = {"N m": 1.0, "mN m": 1e-3, "N cm": 1e-2, "N mm": 1e-3}
_INERTIA: dict[str, Unit] = {"kg m²": 1.0, "kg cm²": 1e-4, "kg mm²": 1e-6, "g cm²": 1e-7}
_VISCOUS: dict[str, Unit] = {
    "N m s/rad": 1.0, "mN m s/rad": 1e-3, "N m/rpm": 1.0 / _RPM, "mN m/rpm": 1e-3 / _RPM, "mN m/krpm": 1e-6 / _RPM,
}  # fmt: skip
_STIFFNESS: dict[str, Unit] = {
    "N m/rad": 1.0, "kN m/rad": 1e3, "N m/deg": 1.0 / _DEGREE, "N m/arcmin": 60.0 / _DEGREE,
}  # fmt: skip
_LENGTH: dict[str, Unit] = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9}
_FORCE: dict[str, Unit] = {"N": 1.0, "kN": 1e3}
_MASS: dict[str, Unit] = {"kg": 1.0, "g": 1e-3, "t": 1e3}
_DRAG: dict[str, Unit] = {"N s/m": 1.0, "N s/mm": 1e3, "N/(m/min)": 60.0}
_AXIAL: dict[str, Unit] = {"N/m": 1.0, "N/mm": 1e3, "kN/mm": 1e6, "N/um": 1e6}
_VELOCITY: dict[str, Unit] = {"m/s": 1.0, "mm/s": 1e-3, "m/min": 1.0 / 60.0}
_LEAD: dict[str, Unit] = {
    "m": lambda travel: 2.0 * math.pi / travel, "mm": lambda travel: 2e3 * math.pi / travel,
}  # fmt: skip
"""Travel of a load for one turn of the motor: it becomes a gear ratio, rad/m."""
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


NONE = "none"
"""The answer that there is no such part."""


class Item(NamedTuple):
    """A number of a data sheet.

    Attributes:
        name: as an option, with _ for -.
        asked: what it is, in words.
        units: that it may be given in; the first is SI.
        example: as a data sheet may say it.
        default: what is taken if it is left out; "" where it has to be given.
        least: smallest possible SI value; `above`: whether it has to be larger than that.
        key: the number that it gives, by the name that it has on a geared drive; "" for the same name.
        absent: whether there may be none of what it describes: the answer is "none".
    """

    name: str
    asked: str
    units: Mapping[str, Unit]
    example: str
    default: str = ""
    least: float = 0.0
    above: bool = True
    key: str = ""
    absent: bool = False

    def read(self, text: str) -> "Given":
        """The number in SI.

        Raises:
            InputError: no number, a unit that is not known here, or out of range.
        """
        known = {_spelt(unit): (unit, factor) for unit, factor in self.units.items()}
        likely = f"'{self.example}'" + (f", or '{NONE}'" if self.absent else "")
        if self.absent and text.strip().lower() == NONE:
            return Given(0.0, f"given: {NONE}")
        found = re.fullmatch(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*", text)
        units = ", ".join(unit for unit in self.units if unit) or "none"
        if not found or found[2].startswith(","):
            point = ", with a decimal point" if "," in text else ""
            raise InputError(f"{self.option} '{text}': should be a number and its unit{point}, such as {likely}")
        number, unit = float(found[1]), _spelt(found[2])
        if not unit and not number:
            # zero of anything
            unit = next(iter(known))
        if not unit and "" not in known:
            raise InputError(f"{self.option} '{text}': has no unit; such as {likely}; units: {units}")
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
        return option_of(self.name)


def option_of(name: str) -> str:
    """The option of an item's name."""
    return f"--{name.replace('_', '-')}"


class Given(NamedTuple):
    """A number in SI, and how it was given, in words."""

    value: float
    text: str


def _spelt(unit: str) -> str:
    """A unit in one spelling."""
    for other, ours in _WAYS.items():
        unit = unit.replace(other, ours)
    unit = re.sub(r"[\s·*^]", "", unit)
    # mega is no milli
    return unit if unit.startswith("MN") else unit.lower()


class Kind(NamedTuple):
    """A kind of drive.

    Attributes:
        about: what it is, in words.
        items: what is asked for, in this order.
        linear: the sides that move in m.
        law: whether there is a transmission, and a load behind it.
    """

    about: str
    items: tuple[Item, ...]
    linear: tuple[str, ...] = ()
    law: bool = True

    def unit(self, side: str, unit: str) -> str:
        """A unit of a turning side, or what stands for it where the side moves in m."""
        return on_a_line(unit) if side in self.linear else unit


_END = (
    Item("sample_period", "sampling period of the drive", _PERIOD, "0.25 ms", "1 ms"),
    Item("frequency", "lowest frequency of the test input", {"Hz": 1.0}, "0.5 Hz", "0.5 Hz"),
)
_ENCODER = Item("motor_encoder", "one count of the motor's encoder", _STEP, "17 bit", "0 rad", above=False)
_NOISE = Item("encoder_noise", "rms noise of the motor's encoder", _ANGLE, "5 arcsec", "0 rad", above=False)
_RATED = (
    Item("torque", "rated torque of the motor", _TORQUE, "1.3 N m"),
    Item("speed", "rated speed of the motor", _SPEED, "3000 rpm"),
)

KINDS = {
    "geared": Kind(
        "a motor, a gear, and a load that turns",
        (
            Item("motor_inertia", "inertia of the rotor", _INERTIA, "0.48 kg cm²"),
            Item("motor_viscous", "viscous friction at the motor", _VISCOUS, "2 mN m/krpm", "0 N m s/rad", above=False),
            Item("motor_friction", "dry friction at the motor, with the gear's", _TORQUE, "15 mN m", "0 N m", above=False),
            *_RATED,
            Item("gear_ratio", "gear ratio, motor turns for one turn of the load", {"": 1.0}, "50"),
            Item("stiffness", "torsional stiffness of the gear at its output", _STIFFNESS, "12 N m/arcmin"),
            Item("backlash", "backlash of the gear at its output, end to end", _ANGLE, "3 arcmin", above=False),
            Item("load_inertia", "inertia of the load at its own shaft", _INERTIA, "0.4 kg m²"),
            Item("load_viscous", "viscous friction at the load", _VISCOUS, "0.5 N m s/rad", "0 N m s/rad", above=False),
            _ENCODER,
            Item("load_encoder", "one count of the load's encoder", _STEP, "20 bit", "0 rad", above=False, absent=True),
            _NOISE,
            *_END,
        ),
    ),
    "screw": Kind(
        "a motor, a ball screw (or a rack, a belt), and a carriage",
        (
            Item("motor_inertia", "inertia of rotor, coupling and screw", _INERTIA, "1.2 kg cm²"),
            Item("motor_viscous", "viscous friction at the motor", _VISCOUS, "2 mN m/krpm", "0 N m s/rad", above=False),
            Item("motor_friction", "dry friction at the motor, with the nut's", _TORQUE, "0.1 N m", "0 N m", above=False),
            *_RATED,
            Item("lead", "travel of the carriage for one turn of the motor", _LEAD, "10 mm", key="gear_ratio"),
            Item("stiffness", "axial stiffness of screw, nut and bearings", _AXIAL, "120 N/um"),
            Item("backlash", "backlash of the nut, end to end", _LENGTH, "20 um", above=False),
            Item("mass", "mass of the carriage, with what it carries", _MASS, "60 kg", key="load_inertia"),
            Item("load_viscous", "viscous friction of the guides", _DRAG, "200 N s/m", "0 N s/m", above=False),
            _ENCODER,
            Item("load_encoder", "one count of the linear scale", _LENGTH, "100 nm", "0 m", above=False, absent=True),
            _NOISE,
            *_END,
        ),
        linear=("load",),
    ),
    "direct": Kind(
        "a motor that turns its load without a gear",
        (
            Item("motor_inertia", "inertia of rotor and load", _INERTIA, "0.05 kg m²"),
            Item("motor_viscous", "viscous friction at the motor", _VISCOUS, "2 mN m/krpm", "0 N m s/rad", above=False),
            Item("motor_friction", "dry friction, with what else disturbs", _TORQUE, "0.2 N m"),
            *_RATED,
            _ENCODER,
            _NOISE,
            *_END,
        ),
        law=False,
    ),
    "linear": Kind(
        "a linear motor that moves its load without a gear",
        (
            Item("mass", "mass that moves", _MASS, "8 kg", key="motor_inertia"),
            Item("motor_viscous", "viscous friction of the guides", _DRAG, "20 N s/m", "0 N s/m", above=False),
            Item("motor_friction", "dry friction, with what else disturbs", _FORCE, "6 N"),
            Item("force", "rated force of the motor", _FORCE, "200 N", key="torque"),
            Item("speed", "rated speed of the motor", _VELOCITY, "2 m/s"),
            Item("motor_encoder", "one count of the scale", _LENGTH, "100 nm", "0 m", above=False),
            Item("encoder_noise", "rms noise of the scale", _LENGTH, "20 nm", "0 m", above=False),
            *_END,
        ),
        linear=("motor",),
        law=False,
    ),
}
"""What can be asked about, by the name of the kind; the first is what is meant where none is named."""


def named_items() -> dict[str, list[tuple[str, Item]]]:
    """All items by their names, each with the kinds that have it."""
    found: dict[str, list[tuple[str, Item]]] = {}
    for kind, about in KINDS.items():
        for item in about.items:
            found.setdefault(item.name, []).append((kind, item))
    return found


_HARMONICS, _PERIODS = 6, 5
"""Of the test input: harmonics, and periods of the lowest."""
_PART = 0.05
"""Of the largest speed: the velocity error that an observer may have."""


def first_study(kind: Kind, given: Mapping[str, Given], title: str) -> tuple[str, dict[str, Any]]:
    """A study with comments that `simulate`, `sweep` and `tune` can run.

    Args:
        kind: of the drive.
        given: the number of each of its items, by the item's name.
        title: headline of its report.

    Returns:
        The TOML text, and what the pilot run found, by side.

    Raises:
        InputError: numbers that no study can have together.
        NoResult: the drive diverges.
    """
    from .config import TuneTable, read_config, read_model
    from .gains.gain_search import usual_rule
    from .gains.pilot import Scenarios, pilot

    given = by_key(kind, given)
    text = _drive(kind, given, title)
    try:
        model, _ = read_model(_data(text))
        found = pilot(Scenarios(model, ["nominal"], {}), TuneTable())
        _check_motion(kind, found)
        gains = {side: usual_rule(one["f_plus"]) for side, one in found.items()}
        text += _observers(kind, given, found, gains, usual_rule(1.0))
        read_config(_data(text))
    except InputError as error:
        raise InputError(
            f"these numbers make no study; look at their units: {str(error).removeprefix('config: ')}"
        ) from None
    return text, found


def _check_motion(kind: Kind, found: Mapping[str, Any]) -> None:
    """Refuse a drive that its rated torque does not move."""
    options = {item.key or item.name: item.option for item in kind.items}
    if not found["motor"]["largest_velocity"] > 0.0:
        raise InputError(
            f"the motor does not move: {options['torque']} should be larger, or {options['motor_friction']} smaller"
        )
    if "load" in found and not found["load"]["f_plus"] > 0.0:
        raise InputError(f"the load does not move: {options['backlash']} should be smaller, or {options['frequency']} lower")


def by_key(kind: Kind, given: Mapping[str, Given]) -> dict[str, Given]:
    """Numbers of a data sheet by the names that they have on a geared drive."""
    return {item.key or item.name: given[item.name] for item in kind.items}


def _data(text: str) -> dict[str, Any]:
    import tomllib

    return tomllib.loads(text)


def _number(value: float, digits: int = 6) -> str:
    return repr(float(f"{value:.{digits}g}"))


def _drive(kind: Kind, given: Mapping[str, Given], title: str) -> str:
    """The tables of the drive, its input and its sensors; numbers are :func:`by_key`."""
    import tomli_w

    from .drive.effects import CoulombFriction
    from .records import NominalDrive
    from .records.proposal import plant_steps

    value = {name: one.value for name, one in given.items()}

    def line(key: str, name: str, unit: str = "", factor: float = 1.0, how: str = "") -> str:
        """A key, its SI unit, and what was given."""
        return f"{key} = {_number(factor * value[name])} # {unit}{', ' * bool(unit)}{given[name].text}{how}"

    def numbers(side: str, where: str = "") -> list[str]:
        units = (("inertia", "kg m²"), ("viscous", "N m s/rad"))
        return [line(f"{side}_{key}", f"{side}_{key}", kind.unit(side, unit) + where) for key, unit in units]

    angle, torque = kind.unit("motor", "rad"), kind.unit("motor", "N m")
    amplitude = _amplitude(given, _HARMONICS)
    rated = f"the rated {'torque' if torque == 'N m' else 'force'}"
    limit = rated if amplitude == value["torque"] else "what takes its lowest wave to the rated speed"
    limits = ", and ".join(given[name].text.removeprefix("given: ") for name in ("torque", "speed"))
    lines = [
        "# Written by jaxbl init from a data sheet. All numbers are in SI units; behind each stands what was given.",
        "# All keys: docs/reference.md, and 'jaxbl schema' for editors that complete them.",
        tomli_w.dumps({"title": title} | ({"notes": notes} if (notes := _notes(kind, given)) else {})).strip(),
        "",
        "[drive]",
        f'kind = "{"two_inertia" if kind.law else "rigid"}"',
        *numbers("motor"),
        *(_transmitted(kind, given, numbers, line) if kind.law else []),
    ]
    if value["motor_friction"]:
        lines += ["", "[[effects]]", f'kind = "motor.{CoulombFriction.kind}"', line("torque", "motor_friction", torque)]
    noise, load = "", []
    if kind.law:
        noise = " (the load's is this divided by the gear ratio; load_noise says otherwise)"
        load = [line("load_resolution", "load_encoder", f"{kind.unit('load', 'rad')} a count, 0 is ideal")]
        load_numbers = value["load_inertia"], value["load_viscous"]
        ratio = value["gear_ratio"]
        at_motor = (factor * value[name] for factor, name in zip(_to_motor(ratio), ("stiffness", "backlash"), strict=True))
        nominal = NominalDrive(value["motor_inertia"], value["motor_viscous"], *load_numbers, ratio, *at_motor)
    else:
        nominal = NominalDrive(value["motor_inertia"], value["motor_viscous"])
    lines += [
        "",
        "# The input: six waves at once. Replace it by a motion of your own: kind = 'recorded' plays a file back.",
        "[excitation]",
        'kind = "multisine"',
        f"amplitude = {_number(amplitude, 3)} # {torque}: {limit}; given: {limits}",
        line("frequency", "frequency", "Hz"),
        f"count = {_HARMONICS}",
        "",
        "[encoders]",
        line("noise", "encoder_noise", f"{angle} rms", how=noise),
        line("motor_resolution", "motor_encoder", f"{angle} a count, 0 is ideal"),
        *load,
        "",
        "[run]",
        f"duration = {_number(_PERIODS / value['frequency'])} # s: {_PERIODS} periods of the input",
        line("sample_period", "sample_period", "s"),
        f"substeps = {plant_steps(nominal, value['sample_period'])} # steps of the plant a sample, by the stiffness",
    ]
    return "\n".join(lines) + "\n"


def _to_motor(ratio: float) -> tuple[float, float]:
    """Factors from stiffness and backlash at the output to stiffness and half of the gap on the motor's shaft."""
    return ratio**-2, 0.5 * ratio


def _notes(kind: Kind, given: Mapping[str, Given]) -> list[str]:
    """What readers of the study's pages have to know of its units and sensors."""
    notes = []
    if kind.linear:
        which = "The load moves along a line: its numbers are" if kind.law else "A linear axis: its numbers are"
        notes.append(f"{which} in kg, N and m where it says kg m², N m and rad.")
    if kind.law and given["load_encoder"].text.endswith(NONE):
        notes.append(
            "This drive has no encoder on its load: the load's observer has an ideal one here, and stands for what such an "
            "encoder would give. jaxbl identify and diagnose take logs of the motor alone."
        )
    return notes


def _transmitted(
    kind: Kind, given: Mapping[str, Given], numbers: Callable[..., list[str]], line: Callable[..., str]
) -> list[str]:
    """What goes on with `[drive]`: the load, the gear and its law."""
    ratio, gap = given["gear_ratio"].value, given["backlash"].value
    stiff, half = _to_motor(ratio)
    turning = "load" not in kind.linear
    at_motor, where = "on the motor's shaft", "at the output" if turning else "at the carriage"
    if turning:
        gear = line("gear_ratio", "gear_ratio")
    else:
        gear = line("gear_ratio", "gear_ratio", "rad of the motor for 1 m of the carriage", how=" a turn")
    lines = [
        *numbers("load", ", at the load's shaft" if turning else ""),
        gear,
        "",
        "[transmission]",
        'law = "dead_zone" # a hard gap' if gap else 'law = "linear_shaft" # no backlash was given',
        line("stiffness", "stiffness", f"N m/rad {at_motor}", stiff, f" {where}, divided by {ratio:.6g}²"),
    ]
    if gap:
        how = f" {where}, end to end; half of it times {ratio:.6g}"
        lines.append(line("half_gap", "backlash", f"rad {at_motor}", half, how))
    return lines


def _amplitude(given: Mapping[str, Given], waves: int) -> float:
    """Amplitude (N m, N) of an input of so many waves, at most the rated torque: the lowest takes the rigid drive to its
    rated speed."""
    value = {name: one.value for name, one in given.items()}
    inertia = value["motor_inertia"]
    if "load_inertia" in value:
        inertia += value["load_inertia"] / value["gear_ratio"] ** 2
    lowest = 2.0 * math.pi * value["frequency"] * inertia * value["speed"]
    return min(value["torque"], lowest * math.sqrt(waves) + value["motor_friction"])


def _accepted(given: Mapping[str, Given], found: Mapping[str, Any]) -> tuple[float, float]:
    """Velocity and position error (rad/s, rad; m/s, m) that the motor's observer may have.

    A part of the largest speed; twice what the largest unknown acceleration makes of the speed in a sample; and what
    readings off by e cost a differentiator of such signals, in proportion to sqrt(f+ e).
    Reference: A. Levant, Automatica 34 (1998).
    """
    period, noise = given["sample_period"].value, 4.0 * given["encoder_noise"].value
    costs, offs = [], []
    for side, one in found.items():
        # on the motor's shaft
        ratio = given["gear_ratio"].value if side == "load" else 1.0
        bound, off = ratio * one["f_plus"], ratio * given[f"{side}_encoder"].value + noise
        costs.append(2.0 * bound * period + 4.0 * math.sqrt(bound * off))
        offs.append(off)
    velocity = _PART * found["motor"]["largest_velocity"] + max(costs)
    return velocity, velocity * period + 4.0 * max(offs)


def remark(kind: Kind, given: Mapping[str, Given], found: Mapping[str, Any]) -> str:
    """What stands in the way of good estimates, in a sentence; "" if nothing does."""
    velocity, _ = _accepted(by_key(kind, given), found)
    share = velocity / found["motor"]["largest_velocity"]
    if share < 2.0 * _PART:
        return ""
    return (
        f"Observers may be off by {100.0 * share:.2g} % of the largest speed: the torque changes within few samples, or the "
        "encoders are coarse. A shorter sample period or finer encoders help."
    )


def _observers(
    kind: Kind,
    given: Mapping[str, Given],
    found: Mapping[str, Any],
    gains: Mapping[str, tuple[float, float]],
    usual: tuple[float, float],
) -> str:
    """What goes on with `[run]`: the errors that are accepted, then the observers, and what sweep and tune need.

    `usual`: the usual rule's gains where f+ is 1.
    """
    velocity, position = _accepted(given, found)
    bound = {side: float(one["f_plus"]) for side, one in found.items()}
    frequency, angle = given["frequency"].value, kind.unit("motor", "rad")
    load = "; on the load both are divided by the gear ratio" if kind.law else ""
    bounds = ", ".join(f"{one:.3g} {kind.unit(side, 'rad/s²')} ({side})" for side, one in bound.items())
    rated = f"the rated {'torque' if angle == 'rad' else 'force'}"
    lines = [
        f"# Errors of the motor observer that are accepted: {100 * _PART:g} % of the largest speed, and what period, counts",
        f"# and noise cost any observer{load}. Put in what you need.",
        f"velocity_tolerance = {_number(velocity, 2)} # {angle}/s",
        f"position_tolerance = {_number(position, 2)} # {angle}",
        "",
        f"# Gains by the usual rule, lambda = {usual[0]:g} sqrt(f+) and alpha = {usual[1]:g} f+; f+ is the largest",
        f"# acceleration in a run of this study that observers do not know: {bounds}.",
        "# 'jaxbl tune' looks for better ones.",
        f"# The motor's largest speed in that run: {found['motor']['largest_velocity']:.3g} {angle}/s; rated: "
        f"{given['speed'].value:.3g}. Change excitation.amplitude if that is too fast.",
        "[observer]",
    ]
    for side, (lambda_, alpha) in gains.items():
        units = ", ".join(kind.unit(side, unit) for unit in ("√rad/s", "rad/s²"))
        lines.append(f"{side} = {{ lambda = {_number(lambda_, 3)}, alpha = {_number(alpha, 3)} }} # {units}")
    lines += [
        "",
        "# jaxbl tune: gains of the least error, compared on another input",
        "[tune]",
        'objective = "velocity" # or "torque"',
        "[tune.holdout]",
        'kind = "chirp"',
        f"amplitude = {_number(_amplitude(given, 1), 3)} # {kind.unit('motor', 'N m')}: {rated}, or what takes it to the "
        "rated speed",
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
