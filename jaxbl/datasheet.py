"""A first study from what a drive's data sheet says: the function behind `jaxbl init`.

Numbers are read in the units of data sheets and written in SI, each beside what was given. Observer gains are the usual rule
(:func:`jaxbl.gains.gain_search.usual_rule`) at the bound f⁺ that a pilot run of the study finds.
"""

import math
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from .errors import InputError
from .json_types import JsonObject
from .lines import percent
from .units import on_a_line

Unit = float | Callable[[float], float]
"""A factor to SI, or a function that gives the SI value."""
Units = Mapping[str, Unit]

_DEGREE = math.pi / 180.0
_RPM = math.pi / 30.0
_ANGLE: Units = {
    "rad": 1.0, "mrad": 1e-3, "deg": _DEGREE, "arcmin": _DEGREE / 60.0, "arcsec": _DEGREE / 3600.0,
}  # fmt: skip
_TORQUE: Units = {"N m": 1.0, "mN m": 1e-3, "N cm": 1e-2, "N mm": 1e-3}
_INERTIA: Units = {"kg m²": 1.0, "kg cm²": 1e-4, "kg mm²": 1e-6, "g cm²": 1e-7}
_VISCOUS: Units = {
    "N m s/rad": 1.0, "mN m s/rad": 1e-3, "N m/rpm": 1.0 / _RPM, "mN m/rpm": 1e-3 / _RPM, "mN m/krpm": 1e-6 / _RPM,
}  # fmt: skip
_STIFFNESS: Units = {
    "N m/rad": 1.0, "kN m/rad": 1e3, "N m/deg": 1.0 / _DEGREE, "N m/arcmin": 60.0 / _DEGREE,
}  # fmt: skip
_LENGTH: Units = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9}
_FORCE: Units = {"N": 1.0, "kN": 1e3}
_MASS: Units = {"kg": 1.0, "g": 1e-3, "t": 1e3}
_DRAG: Units = {"N s/m": 1.0, "N s/mm": 1e3, "N/(m/min)": 60.0}
_AXIAL: Units = {"N/m": 1.0, "N/mm": 1e3, "kN/mm": 1e6, "N/um": 1e6}
_VELOCITY: Units = {"m/s": 1.0, "mm/s": 1e-3, "m/min": 1.0 / 60.0}
_LEAD: Units = {
    "m": lambda travel: 2.0 * math.pi / travel, "mm": lambda travel: 2e3 * math.pi / travel,
}  # fmt: skip
"""Travel of a load for one turn of the motor: it becomes a gear ratio, rad/m."""
_RATIO: Units = {"%": 0.01, "": 1.0}
_STEP: Units = _ANGLE | {
    "counts": lambda count: 2.0 * math.pi / count,
    "lines": lambda count: 0.5 * math.pi / count,  # of which each makes four counts
    "bit": lambda bits: 2.0 * math.pi / 2.0**bits,
}
_PERIOD: Units = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "Hz": lambda rate: 1.0 / rate, "kHz": lambda rate: 1e-3 / rate}
_SPEED: Units = {"rad/s": 1.0, "rpm": _RPM, "deg/s": _DEGREE}
_SPELLINGS = {
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
        question: what it is, in words.
        units: that it may be given in; the first is SI.
        example: as a data sheet may say it.
        default: what is taken if it is left out; "" where it has to be given.
        is_above: whether it has to be larger than 0; otherwise it may be 0, too.
        key: the number that it gives, by the name that it has on a geared drive; "" for the same name.
        absent: whether there may be none of what it describes: the answer is "none".
    """

    name: str
    question: str
    units: Units
    example: str
    default: str = ""
    is_above: bool = True
    key: str = ""
    absent: bool = False

    def read(self, text: str) -> "Answer":
        """Read a number with its unit.

        Raises:
            InputError: no number, a unit that is not known here, or out of range.
        """
        if self.absent and text.strip().lower() == NONE:
            return Answer(0.0, f"given: {NONE}")
        units_by_spelling = {_normalise_unit(unit): (unit, factor) for unit, factor in self.units.items()}
        example = f"'{self.example}'" + (f", or '{NONE}'" if self.absent else "")
        match = re.fullmatch(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*", text)
        if not match or match[2].startswith(","):
            point = ", with a decimal point" if "," in text else ""
            raise InputError(f"{self.option} '{text}': should be a number and its unit{point}, such as {example}")
        number, unit = float(match[1]), _normalise_unit(match[2])
        if not unit and not number:
            # zero of anything
            unit = next(iter(units_by_spelling))
        if unit not in units_by_spelling:
            allowed = ", ".join(filter(None, self.units)) or "none"
            fault = f"the unit '{match[2]}' is not known here; known" if unit else f"has no unit; such as {example}; units"
            raise InputError(f"{self.option} '{text}': {fault}: {allowed}")
        name, factor = units_by_spelling[unit]
        try:
            value = factor(number) if callable(factor) else factor * number
        except (ZeroDivisionError, OverflowError):
            value = math.nan
        if not (0.0 < value < 1e30 or (value == 0.0 and not self.is_above)):
            limit = f"{'more than' if self.is_above else 'at least'} 0 {next(iter(self.units))}".rstrip()
            raise InputError(f"{self.option} '{text}': should be {limit}, such as '{self.example}'")
        return Answer(value, f"given: {match[1]} {name}".rstrip())

    def default_answer(self) -> "Answer":
        """Return the answer for a number that the user leaves out."""
        value = self.read(self.default).value
        return Answer(value, f"not given: {self.default} is assumed" if value else "not given")

    @property
    def option(self) -> str:
        """Name of the option on the command line."""
        return option_name(self.name)


def option_name(name: str) -> str:
    """Return the option for an item's name."""
    return f"--{name.replace('_', '-')}"


class Answer(NamedTuple):
    """A number in SI, and how it was given, in words."""

    value: float
    text: str

    def write(self, key: str, unit: str = "", factor: float = 1.0, how: str = "") -> str:
        """Write a key of a study: `factor` times this number, its unit, and what it follows from; `how` says by what."""
        return f"{key} = {_round(factor * self.value)} # {unit}{', ' * bool(unit)}{self.text}{how}"


Answers = Mapping[str, Answer]
"""What was answered, by the name of the item."""


def _normalise_unit(unit: str) -> str:
    """Return a unit in one spelling."""
    for other, ours in _SPELLINGS.items():
        unit = unit.replace(other, ours)
    unit = re.sub(r"[\s·*^]", "", unit)
    # mega is no milli
    return unit if unit.startswith("MN") else unit.lower()


class DriveKind(NamedTuple):
    """A kind of drive.

    Attributes:
        about: what it is, in words.
        items: what is asked for, in this order.
        linear: the sides that move in m.
        law: whether there is a transmission, and a load behind it.
    """

    description: str
    items: tuple[Item, ...]
    linear: tuple[str, ...] = ()
    law: bool = True

    def unit(self, side: str, unit: str) -> str:
        """A unit of a turning side, or what stands for it where the side moves in m."""
        return on_a_line(unit) if side in self.linear else unit


_item_from_zero = partial(Item, is_above=False)
_END = (
    Item("sample_period", "sampling period of the drive", _PERIOD, "0.25 ms", "1 ms"),
    Item("frequency", "lowest frequency of the test input", {"Hz": 1.0}, "0.5 Hz", "0.5 Hz"),
)
_ENCODER = _item_from_zero("motor_encoder", "one count of the motor's encoder", _STEP, "17 bit", "17 bit")
_LOAD_ENCODER = _item_from_zero("load_encoder", "one count of the load's encoder", _STEP, "20 bit", "17 bit", absent=True)
_SCALE = _item_from_zero("load_encoder", "one count of the linear scale", _LENGTH, "100 nm", "1 um", absent=True)
_DAMPING = _item_from_zero("damping", "damping ratio of the gear's oscillation", _RATIO, "5 %", "3 %")
_MOTOR_VISCOUS = _item_from_zero("motor_viscous", "viscous friction at the motor", _VISCOUS, "2 mN m/krpm", "0 N m s/rad")
_NOISE = _item_from_zero("encoder_noise", "rms noise of the motor's encoder", _ANGLE, "5 arcsec", "0 rad")
_RATED = (
    Item("torque", "rated torque of the motor", _TORQUE, "1.3 N m"),
    Item("speed", "rated speed of the motor", _SPEED, "3000 rpm"),
)

KINDS = {
    "geared": DriveKind(
        "a motor, a gear, and a load that turns",
        (
            Item("motor_inertia", "inertia of the rotor", _INERTIA, "0.48 kg cm²"),
            _MOTOR_VISCOUS,
            _item_from_zero("motor_friction", "dry friction at the motor, with the gear's", _TORQUE, "15 mN m", "0 N m"),
            *_RATED,
            Item("gear_ratio", "gear ratio, motor turns for one turn of the load", {"": 1.0}, "50"),
            Item("stiffness", "torsional stiffness of the gear at its output", _STIFFNESS, "12 N m/arcmin"),
            _item_from_zero("backlash", "backlash of the gear at its output, end to end", _ANGLE, "3 arcmin"),
            _DAMPING,
            Item("load_inertia", "inertia of the load at its own shaft", _INERTIA, "0.4 kg m²"),
            _item_from_zero("load_viscous", "viscous friction at the load", _VISCOUS, "0.5 N m s/rad", "0 N m s/rad"),
            _ENCODER,
            _LOAD_ENCODER,
            _NOISE,
            *_END,
        ),
    ),
    "screw": DriveKind(
        "a motor, a ball screw (or a rack, a belt), and a carriage",
        (
            Item("motor_inertia", "inertia of rotor, coupling and screw", _INERTIA, "1.2 kg cm²"),
            _MOTOR_VISCOUS,
            _item_from_zero("motor_friction", "dry friction at the motor, with the nut's", _TORQUE, "0.1 N m", "0 N m"),
            *_RATED,
            Item("lead", "travel of the carriage for one turn of the motor", _LEAD, "10 mm", key="gear_ratio"),
            Item("stiffness", "axial stiffness of screw, nut and bearings", _AXIAL, "120 N/um"),
            _item_from_zero("backlash", "backlash of the nut, end to end", _LENGTH, "20 um"),
            _DAMPING,
            Item("mass", "mass of the carriage, with what it carries", _MASS, "60 kg", key="load_inertia"),
            _item_from_zero("load_viscous", "viscous friction of the guides", _DRAG, "200 N s/m", "0 N s/m"),
            _ENCODER,
            _SCALE,
            _NOISE,
            *_END,
        ),
        linear=("load",),
    ),
    "direct": DriveKind(
        "a motor that turns its load without a gear",
        (
            Item("motor_inertia", "inertia of rotor and load", _INERTIA, "0.05 kg m²"),
            _MOTOR_VISCOUS,
            Item("motor_friction", "dry friction, with what else disturbs", _TORQUE, "0.2 N m"),
            *_RATED,
            _ENCODER,
            _NOISE,
            *_END,
        ),
        law=False,
    ),
    "linear": DriveKind(
        "a linear motor that moves its load without a gear",
        (
            Item("mass", "mass that moves", _MASS, "8 kg", key="motor_inertia"),
            _item_from_zero("motor_viscous", "viscous friction of the guides", _DRAG, "20 N s/m", "0 N s/m"),
            Item("motor_friction", "dry friction, with what else disturbs", _FORCE, "6 N"),
            Item("force", "rated force of the motor", _FORCE, "200 N", key="torque"),
            Item("speed", "rated speed of the motor", _VELOCITY, "2 m/s"),
            _SCALE._replace(name="motor_encoder", question="one count of the scale", absent=False),
            _item_from_zero("encoder_noise", "rms noise of the scale", _LENGTH, "20 nm", "0 m"),
            *_END,
        ),
        linear=("motor",),
        law=False,
    ),
}
"""What can be asked about, by the name of the kind; the first is what is meant where none is named."""


def items_by_name() -> dict[str, list[tuple[str, Item]]]:
    """Return all items by name, each with the kinds of drives that have it."""
    items: dict[str, list[tuple[str, Item]]] = {}
    for kind, drive_kind in KINDS.items():
        for item in drive_kind.items:
            items.setdefault(item.name, []).append((kind, item))
    return items


_OTHER_OBSERVERS = ["differentiator_3", "kalman"]
"""Kinds that super-twisting is compared with: one for motion that is not known, one for noise."""
_UNCERTAINTY = 0.1
"""Relative uncertainty of a data sheet's numbers: they hold for a series, and depend on temperature and load."""
_HARMONICS, _PERIODS = 6, 5
"""Of the test input: harmonics, and periods of the lowest."""
_LARGE_SHARE = 0.1
"""Of the largest speed: a velocity error from which estimates are poor."""


def write_first_study(kind: DriveKind, answers: Answers, title: str) -> tuple[str, JsonObject]:
    """Write a study with comments that `simulate`, `sweep` and `tune` can run.

    Args:
        kind: of the drive.
        answers: the number of each of its items, by the item's name.
        title: headline of its report.

    Returns:
        The TOML text, and what the pilot run found, by side; with the errors that are `expected` there.

    Raises:
        InputError: numbers that no study can have together.
        NoResult: the drive diverges.
    """
    from .config import read_config
    from .gains.expected_error import expect_errors
    from .gains.gain_search import usual_rule
    from .gains.machine_study import propose_map, propose_tolerances
    from .gains.pilot import Scenarios, list_scenarios, run_pilot

    # by the names that they have on a geared drive
    answers = {item.key or item.name: answers[item.name] for item in kind.items}
    try:
        data = tomllib.loads(_write_drive(kind, answers, title, _choose_amplitude(answers, _HARMONICS)))
        amplitude, pilot_metrics = _limit_input(data, answers)
        _check_motion(kind, pilot_metrics)
        text = _write_drive(kind, answers, title, amplitude)
        chirp = _make_chirp(answers, _choose_amplitude(answers, 1))
        chirp["amplitude"], _ = _limit_input(data | {"excitation": chirp}, answers)
        gains = {side: usual_rule(metrics["f_plus"]) for side, metrics in pilot_metrics.items()}
        observers = {side: {"lambda": lambda_, "alpha": alpha} for side, (lambda_, alpha) in gains.items()}
        config = read_config(tomllib.loads(text) | {"observer": observers})
        expected = expect_errors(list_scenarios(config, worst_over_uncertainty=True))
        for side, metrics in pilot_metrics.items():
            metrics["expected"] = expected[side]._asdict()
        gain_map = propose_map(run_pilot(Scenarios(config))["motor"]["f_plus"])
        tolerances = propose_tolerances(config, expected)
        text += _write_observers(kind, answers, pilot_metrics, gains, usual_rule(1.0), chirp, tolerances, gain_map)
        read_config(tomllib.loads(text))
    except InputError as error:
        raise InputError(
            f"these numbers make no study; look at their units: {str(error).removeprefix('config: ')}"
        ) from None
    return text, pilot_metrics


def _limit_input(data: JsonObject, answers: Answers) -> tuple[float, JsonObject]:
    """Reduce the amplitude of a study's input until the motor stays within its rated torque and speed.

    Returns the amplitude, and the pilot runs with it: of the drive, and of others within the uncertainty of its numbers.
    """
    import jax
    import numpy as np

    from .config import read_model
    from .gains.pilot import list_scenarios, run_pilot

    model, _ = read_model(data)
    rated, friction = answers["speed"].value, answers["motor_friction"].value
    times = np.linspace(0.0, model.run.duration, 20_000)
    peak = float(np.abs(jax.vmap(model.excitation.build())(times)).max())
    amplitude = data["excitation"]["amplitude"] * min(answers["torque"].value / peak, 1.0)
    while True:
        amplitude = _round(0.995 * amplitude, 3)  # rounded, it is not larger
        scenarios = list_scenarios(model.with_keys("excitation", amplitude=amplitude), worst_over_uncertainty=True)
        pilot_metrics = run_pilot(scenarios)
        speed = pilot_metrics["motor"]["largest_velocity"]
        if speed <= rated:
            return amplitude, pilot_metrics
        # what friction leaves moves the motor; a little below, so that few runs suffice
        least = min(friction, 0.9 * amplitude)
        amplitude = least + (amplitude - least) * 0.95 * rated / speed


def _make_chirp(answers: Answers, amplitude: float) -> JsonObject:
    """Make the input that gains are compared on."""
    frequency = answers["frequency"].value
    ends = {"start_frequency": frequency, "stop_frequency": 4.0 * frequency, "sweep_time": _PERIODS / frequency}
    return {"kind": "chirp", "amplitude": amplitude} | {name: _round(end) for name, end in ends.items()}


def _check_motion(kind: DriveKind, pilot_metrics: JsonObject) -> None:
    """Refuse a drive that its rated torque does not move."""
    options = {item.key or item.name: item.option for item in kind.items}
    if not pilot_metrics["motor"]["largest_velocity"] > 0.0:
        raise InputError(
            f"the motor does not move: {options['torque']} should be larger, or {options['motor_friction']} smaller"
        )
    if "load" in pilot_metrics and not pilot_metrics["load"]["f_plus"] > 0.0:
        raise InputError(f"the load does not move: {options['backlash']} should be smaller, or {options['frequency']} lower")


def _round(value: float, digits: int = 6) -> float:
    return float(f"{value:.{digits}g}")


def _write_drive(kind: DriveKind, answers: Answers, title: str, amplitude: float) -> str:
    """The tables of the drive, its input and its sensors; `answers` have the names of a geared drive."""
    import tomli_w

    from .drive.effects import CoulombFriction, Damping
    from .records import NominalDrive
    from .records.proposal import count_plant_steps

    angle, torque = kind.unit("motor", "rad"), kind.unit("motor", "N m")
    rated = "torque" if torque == "N m" else "force"
    limits = ", and ".join(answers[name].text.removeprefix("given: ") for name in ("torque", "speed"))
    notes = _write_notes(kind, answers)
    nominal = NominalDrive(answers["motor_inertia"].value, answers["motor_viscous"].value)
    gear = friction = damping = noise = load = ""
    if answers["motor_friction"].value:
        friction = f"""
[[effects]]
kind = "motor.{CoulombFriction.kind}"
{answers["motor_friction"].write("torque", torque)}
"""
    if kind.law:
        ratio = answers["gear_ratio"].value
        stiffness = ratio**-2 * answers["stiffness"].value
        nominal = replace(nominal, load_inertia=answers["load_inertia"].value, gear_ratio=ratio, stiffness=stiffness)
        gear = _write_transmission(kind, answers)
        if answers["damping"].value:
            inertias = answers["motor_inertia"].value, answers["load_inertia"].value / ratio**2
            shaft = 2.0 * math.sqrt(stiffness * math.prod(inertias) / sum(inertias))
            how = " of the oscillation of both inertias"
            damping = f"""
[[effects]]
kind = "transmission.{Damping.kind}"
{answers["damping"].write("damping", "N m s/rad on the motor's shaft", shaft, how)}
"""
        noise = " (the load's is this divided by the gear ratio; load_noise says otherwise)"
        load = answers["load_encoder"].write("load_resolution", f"{kind.unit('load', 'rad')} a count, 0 is ideal") + "\n"
    substeps = count_plant_steps(nominal, answers["sample_period"].value)
    return f"""\
# Written by jaxbl init from a data sheet. All numbers are in SI units; behind each stands what was given.
# All keys: docs/reference.md, and 'jaxbl schema' for editors that complete them.
{tomli_w.dumps({"title": title} | ({"notes": notes} if notes else {})).strip()}

[drive]
kind = "{"two_inertia" if kind.law else "rigid"}"
{answers["motor_inertia"].write("motor_inertia", kind.unit("motor", "kg m²"))}
{answers["motor_viscous"].write("motor_viscous", kind.unit("motor", "N m s/rad"))}
{gear}{friction}{damping}
# The input: six waves at once. Replace it by a motion of your own: kind = 'recorded' plays a file back.
[excitation]
kind = "multisine"
amplitude = {_round(amplitude, 3)} # {torque}: within the rated {rated} and speed; given: {limits}
{answers["frequency"].write("frequency", "Hz")}
count = {_HARMONICS}

[uncertainty]
relative = {_UNCERTAINTY} # of the numbers above: machines differ from their data sheets

[encoders]
{answers["encoder_noise"].write("noise", f"{angle} rms", how=noise)}
{answers["motor_encoder"].write("motor_resolution", f"{angle} a count, 0 is ideal")}
{load}
[run]
duration = {_round(_PERIODS / answers["frequency"].value)} # s: {_PERIODS} periods of the input
{answers["sample_period"].write("sample_period", "s")}
substeps = {substeps} # steps of the plant a sample, by the stiffness
"""


def _write_notes(kind: DriveKind, answers: Answers) -> list[str]:
    """Write notes for readers of the study's pages on its units and sensors."""
    notes = []
    if kind.linear:
        subject = "The load moves along a line: its numbers are" if kind.law else "A linear axis: its numbers are"
        notes.append(f"{subject} in kg, N and m where it says kg m², N m and rad.")
    if kind.law and answers["load_encoder"].text.endswith(NONE):
        notes.append(
            "This drive has no encoder on its load: the load's observer has an ideal one here, and stands for what such an "
            "encoder would give. jaxbl identify and diagnose take logs of the motor alone."
        )
    return notes


def _write_transmission(kind: DriveKind, answers: Answers) -> str:
    """Write the rest of `[drive]`: load and gear; then `[transmission]`."""
    ratio, gap, half_gap = answers["gear_ratio"].value, answers["backlash"], ""
    at_load, where, unit, turn = ", at the load's shaft", "at the output", "", ""
    if "load" in kind.linear:
        at_load, where, unit, turn = "", "at the carriage", "rad of the motor for 1 m of the carriage", " a turn"
    if gap.value:
        how = f" {where}, end to end; half of it times {ratio:.6g}"
        half_gap = gap.write("half_gap", "rad on the motor's shaft", 0.5 * ratio, how) + "\n"
    how = f" {where}, divided by {ratio:.6g}²"
    return f"""\
{answers["load_inertia"].write("load_inertia", kind.unit("load", "kg m²") + at_load)}
{answers["load_viscous"].write("load_viscous", kind.unit("load", "N m s/rad") + at_load)}
{answers["gear_ratio"].write("gear_ratio", unit, how=turn)}

[transmission]
{'law = "dead_zone" # a hard gap' if half_gap else 'law = "linear_shaft" # no backlash was given'}
{answers["stiffness"].write("stiffness", "N m/rad on the motor's shaft", ratio**-2, how)}
{half_gap}"""


def _choose_amplitude(answers: Answers, waves: int) -> float:
    """Choose the amplitude (N m, N) of an input of several waves: the lowest wave takes the rigid drive to its rated speed.

    It is at most the rated torque.
    """
    value = {name: answer.value for name, answer in answers.items()}
    inertia = value["motor_inertia"]
    if "load_inertia" in value:
        inertia += value["load_inertia"] / value["gear_ratio"] ** 2
    lowest = 2.0 * math.pi * value["frequency"] * inertia * value["speed"]
    return min(value["torque"], lowest * math.sqrt(waves) + value["motor_friction"])


def describe_expectation(kind: DriveKind, pilot_metrics: JsonObject) -> str:
    """Describe in a sentence the error that the motor's observer will have, and what it is due to."""
    expected, unit = pilot_metrics["motor"]["expected"], kind.unit("motor", "rad")
    causes = ", ".join(f"{percent(share)} {cause}" for cause, share in expected["shares"].items())
    error = f"{expected['velocity']:.2g} {unit}/s of velocity error (rms) of the motor with the study's gains"
    worst = f"{expected['largest_velocity']:.2g} where numbers are off by {100.0 * _UNCERTAINTY:g} %"
    return f"Expect about {error}, and {worst}; shares of its square: {causes}."


def compare_observers(kind: DriveKind, text: str, pilot_metrics: JsonObject) -> tuple[str, str]:
    """Compare a study's own observers, super-twisting, with other kinds, each with the gains that suit it best.

    Args:
        kind: of the drive.
        text: the study.
        pilot_metrics: what :func:`write_first_study` found, by side.

    Returns:
        A sentence on the largest errors in drives within the study's uncertainty, and the study with it, and with another
        kind that is better, as a comment.
    """
    import tomli_w

    from .gains.tune import tune
    from .observer import AbstractSuperTwisting

    study, name_of_study = tomllib.loads(text), AbstractSuperTwisting.name
    # one search of each kind, on the study's own input: each further program takes seconds to compile
    study["tune"] = {"observers": _OTHER_OBSERVERS, "trials": 128, "refine": 0, "worst_over_uncertainty": True}
    sides = tune(study).summary["points"][0]["sides"]
    errors = {name_of_study: [metrics["expected"]["largest_velocity"] for metrics in pilot_metrics.values()]}
    for name in _OTHER_OBSERVERS:
        largest = [sides[side]["kinds"][name]["worst"] for side in pilot_metrics]
        # a kind of which no gains work has none
        if None not in largest:
            errors[name] = largest
    best = min(errors, key=lambda name: math.prod(errors[name]))
    units = ", ".join(f"{kind.unit(side, 'rad')}/s of the {side}" for side in pilot_metrics)
    figures = "; ".join(f"{name} {', '.join(f'{error:.2g}' for error in errors[name])}" for name in errors)
    sentence = (
        f"Largest velocity errors (rms) in drives within [uncertainty], {name_of_study} with the study's gains, others with "
        f"those that suit them best ({units}): {figures}."
    )
    lines = [sentence]
    if best != name_of_study:
        gains = {
            side: {key: _round(value, 3) for key, value in summary["kinds"][best]["gains"].items()}
            for side, summary in sides.items()
        }
        table = tomli_w.dumps({"observer": {"kind": best} | gains})
        lines += [f"In place of [observer] above, for {best}:", *table.strip().splitlines()]
    return sentence, text + "\n" + "".join(f"# {line}".rstrip() + "\n" for line in lines)


def describe_obstacle(pilot_metrics: JsonObject) -> str:
    """Describe in a sentence why estimates will be poor; "" if they will not."""
    share = pilot_metrics["motor"]["expected"]["velocity"] / pilot_metrics["motor"]["largest_velocity"]
    if share < _LARGE_SHARE:
        return ""
    return (
        f"Observers may be off by {percent(share)} of the largest speed: the torque changes within few samples, or the "
        "encoders are coarse. A shorter sample period or finer encoders help."
    )


def _write_observers(
    kind: DriveKind,
    answers: Answers,
    pilot_metrics: JsonObject,
    gains: Mapping[str, tuple[float, float]],
    usual: tuple[float, float],
    chirp: JsonObject,
    tolerances: Mapping[str, float],
    gain_map: JsonObject,
) -> str:
    """Write the rest of `[run]`: the accepted errors; then the observers, and the tables for sweep and tune.

    `usual`: the usual rule's gains where f+ is 1; `chirp`: the input to compare gains on; `tolerances`: of errors;
    `gain_map`: axes and figures.
    """
    import tomli_w

    from .gains.machine_study import TOLERANCE_FACTOR

    angle = kind.unit("motor", "rad")
    load = "; on the load both are divided by the gear ratio" if kind.law else ""
    bounds = ", ".join(
        f"{metrics['f_plus']:.3g} {kind.unit(side, 'rad/s²')} ({side})" for side, metrics in pilot_metrics.items()
    )
    speed = pilot_metrics["motor"]["largest_velocity"]
    observers = [
        f"{side} = {{ lambda = {_round(lambda_, 3)}, alpha = {_round(alpha, 3)} }} "
        f"# {kind.unit(side, '√rad/s')}, {kind.unit(side, 'rad/s²')}\n"
        for side, (lambda_, alpha) in gains.items()
    ]
    maps = [f"[[{name}]]\n{tomli_w.dumps(table)}\n" for name, tables in gain_map.items() for table in tables]
    return f"""\
# Errors of the motor observer that are accepted: {TOLERANCE_FACTOR:g} times the largest that is to be expected (rms)
# of either side with the gains below, in drives within [uncertainty]{load}. Put in what you need.
velocity_tolerance = {tolerances["velocity_tolerance"]!r} # {angle}/s
position_tolerance = {tolerances["position_tolerance"]!r} # {angle}

# Gains by the usual rule, lambda = {usual[0]:g} sqrt(f+) and alpha = {usual[1]:g} f+; f+ is the largest
# acceleration that observers do not know, in runs of drives within [uncertainty]: {bounds}.
# 'jaxbl tune' looks for better ones.
# The motor's largest speed in these runs: {speed:.3g} {angle}/s; rated: {answers["speed"].value:.3g}.
[observer]
{"".join(observers)}
# jaxbl tune: gains of the least error, compared on another input
[tune]
objective = "velocity" # or "torque"
worst_over_uncertainty = true
# within the rated torque and speed, too
[tune.holdout]
{tomli_w.dumps(chirp).strip()}

# jaxbl sweep: a map of the motor observer's gains. Any number of this file can be an axis, by its table and key.
{"".join(maps)}# {describe_expectation(kind, pilot_metrics)}
"""
