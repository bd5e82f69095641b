"""A MuJoCo model (MJCF) of a study's drive, with its gap and its effects, and what of the study it does not have.

Two joints without a parent between them, coupled by tendons of length z = theta_e - N_0 theta_s: a tendon's spring with a
dead band is the gear with its gap. :mod:`.to_mujoco` says what an effect or a law is in MuJoCo.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from typing import Any

from jaxbl.chain import Experiment
from jaxbl.config import Config
from jaxbl.drive import AbstractDrive
from jaxbl.drive.parameters import parameters
from jaxbl.errors import InputError
from jaxbl.units import on_a_line

from .mujoco_parts import IMPEDANCE, RESOLUTION, Answer, MujocoParts, SideParts, Spring, exactly, unsaid
from .to_mujoco import to_mujoco
from .writer import separate

MUJOCO = "4.0"
"""The version for which models are written."""
_LEAST_STEPS = 10
"""A sample, at least: friction and contacts begin and end within a step."""
_GRAVITY = 9.81
_ARM = 0.06
"""Longest arm of an eccentric mass, m."""
_COLOURS = {"motor": "0.35 0.45 0.60 1", "load": "0.75 0.55 0.30 1"}


def group_by_fidelity(answers: dict[str, Answer]) -> dict[str, dict[str, str]]:
    """Group the parts of a study by how well the model has them: `exactly`, `approximated`, `not said`; by config path."""
    fidelities = ("exactly", "approximated", "not said")
    return {
        fidelity: {path: answer.text for path, answer in answers.items() if answer.fidelity == fidelity}
        for fidelity in fidelities
    }


def write_mjcf(config: Config, *, linear: Iterable[str] = ()) -> tuple[str, float, dict[str, Answer]]:
    """Write a study's model. Returns its text, its time step in s, and how well it has each part, by config path.

    Args:
        config: the study; its axes are not used.
        linear: the sides (`motor`, `load`) that move along a line; they have slide joints, and kg, N, m.

    Raises:
        InputError: no such side, or a transmission law or drive of one's own that MuJoCo cannot say.
    """
    experiment, slides = config.build(), tuple(linear)
    if type(experiment.drive).body_torques is not AbstractDrive.body_torques:
        raise InputError(
            f"drive.kind: a MuJoCo model has one or two inertias, unlike {config.drive.kind}; --target fmu has it"
        )
    for side in slides:
        if side not in experiment.sides:
            raise InputError(f"linear: the drive has no side '{side}'; it should be among {', '.join(experiment.sides)}")
    parts, answers, notes = _collect_parts(experiment, slides)
    period = float(experiment.run.sample_period)
    steps = _round_up(period / min(parts.step, parts.longest_step))
    return _write_model(config.title or "A drive", experiment, parts, answers, notes, steps), period / steps, answers


def _round_up(steps: float) -> int:
    """Round a number of steps up; rounding errors add none."""
    return math.ceil(steps * (1.0 - 1e-9))


def _collect_parts(
    experiment: Experiment, slides: tuple[str, ...]
) -> tuple[MujocoParts, dict[str, Answer], dict[str, list[str]]]:
    """Collect the parts of the model, how well it has each part of the study, and comments by place."""
    plant, run, drive, law = experiment.plant, experiment.run, experiment.drive, experiment.transmission
    sides = {side: SideParts(float(plant.inertia(side)), side in slides, float(drive.viscous(side))) for side in drive.sides}
    parts = MujocoParts(sides, None if law is None else float(drive.ratio("load")), float(run.sample_period))
    fastest = 0.0 if law is None else math.sqrt(float(law.stiffness) * parts.mobility)
    parts.step /= max(run.substeps, _LEAST_STEPS, _round_up(parts.step * fastest / RESOLUTION))
    answers = {"drive": exactly("bodies, and their joints with damping")}
    notes = dict[str, list[str]]()
    if law is not None:
        answers["transmission"] = answer = to_mujoco(law, parts)
        if answer.fidelity == "not said":
            raise InputError(f"transmission.law: MuJoCo cannot say '{law.name}': {answer.text}; another law is needed")
        notes["transmission"] = [_write_note("transmission", law, answer)]
    names = [effect.name for effect in experiment.effects]
    # first those that make the gap: what others are depends on it
    for i, effect in sorted(enumerate(experiment.effects), key=lambda numbered: not numbered[1].free_play()):
        path, place = f"effects.{effect.name if names.count(effect.name) == 1 else i}", drive.resolve_place(effect.place)
        answers[path] = answer = to_mujoco(effect, parts, place if place in sides else "motor")
        if answer.fidelity != "not said":
            notes.setdefault(place, []).append(_write_note(path, effect, answer, place in slides))
    answers["initial"] = exactly("the keyframe 'initial'")
    answers["excitation"] = unsaid("the model has an input: set data.ctrl[0] at each sample and hold it until the next")
    if any(getattr(experiment.encoders, field.name) for field, _ in parameters(experiment.encoders)):
        answers["encoders"] = unsaid("the sensors of a model read without noise and counts")
    answers["observer"] = unsaid("the model is that of the drive alone")
    return parts, answers, notes


def _write_note(path: str, part: Any, answer: Answer, slides: bool = False) -> str:
    """Write a comment: config path of a part, its numbers and units, and the element of the model."""
    return f"{path}: {', '.join(_describe_numbers(part, slides))}; {answer.text}"


def _describe_numbers(part: Any, slides: bool) -> Iterable[str]:
    """Write each number of a part with its name and unit."""
    for field, parameter in parameters(part):
        value = getattr(part, field.name)
        if value != () and not isinstance(value, bool):
            unit = on_a_line(parameter.unit) if slides else parameter.unit
            text = _format_numbers(*value) if isinstance(value, tuple) else _format_numbers(value)
            yield f"{field.name} = {text} {unit}".rstrip()


# XML


def _write_model(
    title: str,
    experiment: Experiment,
    parts: MujocoParts,
    answers: dict[str, Answer],
    notes: dict[str, list[str]],
    steps: int,
) -> str:
    """Write the model as XML."""
    root, step = ET.Element("mujoco", model="drive"), float(experiment.run.sample_period) / steps
    _add_comments(root, f"{title}. Written by jaxbl for MuJoCo {MUJOCO} or later")
    units = (f"{side} {'kg, N, m' if side_parts.slides else 'kg m², N m, rad'}" for side, side_parts in parts.sides.items())
    _add_comments(root, f"Units: {'; '.join(units)}; times in s. Shapes and masses of what turns are for the eye alone")
    for fidelity, heading in (("approximated", "Approximated"), ("not said", "Not in this model")):
        for path, answer in answers.items():
            if answer.fidelity == fidelity:
                _add_comments(root, f"{heading}: {path}: {answer.text}")
    ET.SubElement(root, "compiler", angle="radian", inertiafromgeom="false")
    _add_comments(root, f"run.sample_period = {_format_numbers(experiment.run.sample_period)} s: {steps} steps")
    option = ET.SubElement(root, "option", timestep=_format_numbers(step), integrator="RK4", gravity=f"0 0 {-_GRAVITY}")
    ET.SubElement(option, "flag", contact="disable")
    world = ET.SubElement(root, "worldbody")
    ET.SubElement(world, "light", pos="0 -1 2", dir="0 0.5 -1")
    for i, (side, side_parts) in enumerate(parts.sides.items()):
        numbers = _describe_numbers(experiment.drive, side_parts.slides)
        _add_comments(world, *(f"drive.{number}" for number in numbers if number.startswith(side)))
        _add_comments(world, *notes.get(side, ()))
        _add_side(world, side, side_parts, 0.25 * i, step)
    root.append(_make_tendons(parts, notes.get("transmission", [])))
    root.append(_make_actuators(parts, notes.get("actuator", []), step))
    root.append(_make_sensors(parts))
    root.append(_make_keyframe(experiment, parts))
    for empty_element in [element for element in root if element.tag == "tendon" and not len(element)]:
        root.remove(empty_element)
    ET.indent(root, "  ")
    return ET.tostring(root, encoding="unicode") + "\n"


def _add_side(world: ET.Element, side: str, parts: SideParts, offset: float, step: float) -> None:
    """Add the body of a side, with its joint."""
    body = ET.SubElement(world, "body", name=side, pos=f"{_format_numbers(offset)} 0 0")
    # the inertia of eccentric masses is part of the side's: half of it at most
    arms = [min(_ARM, 0.5 * parts.inertia / len(parts.pendulums) * _GRAVITY / mass.torque) for mass in parts.pendulums]
    round_off = 1e-6 * parts.inertia
    inertia_of_masses = sum(
        mass.torque / _GRAVITY * arm + round_off for mass, arm in zip(parts.pendulums, arms, strict=True)
    )
    _add_inertia(body, parts.inertia - inertia_of_masses, parts.slides)
    joint = {"name": side, "type": "slide" if parts.slides else "hinge", "axis": "1 0 0" if parts.slides else "0 1 0"}
    joint["damping"] = _format_numbers(parts.viscous, *([parts.drag] if parts.drag else []))
    if parts.dry:
        # as hard as the steps allow: MuJoCo's defaults are softer
        joint |= {"frictionloss": _format_numbers(parts.dry), "solreffriction": f"{_format_numbers(2.0 * step)} 1"}
        joint |= {"solimpfriction": f"{IMPEDANCE} {IMPEDANCE} 0.001"}
    ET.SubElement(body, "joint", joint)
    appearance = {"contype": "0", "conaffinity": "0", "rgba": _COLOURS[side]}
    if parts.slides:
        ET.SubElement(body, "geom", appearance | {"type": "box", "size": "0.06 0.04 0.04"})
    else:
        ET.SubElement(
            body,
            "geom",
            appearance | {"type": "cylinder", "size": "0.08 0.02", "euler": f"{_format_numbers(math.pi / 2)} 0 0"},
        )
        ET.SubElement(
            body, "geom", appearance | {"type": "box", "size": "0.01 0.022 0.03", "pos": "0 0 -0.05", "rgba": "1 1 1 1"}
        )
    for i, (mass, arm) in enumerate(zip(parts.pendulums, arms, strict=True)):
        mass_position = f"{_format_numbers(arm * math.sin(mass.phase))} 0 {_format_numbers(-arm * math.cos(mass.phase))}"
        eccentric = ET.SubElement(body, "body", name=f"{side}_mass{i}", pos=mass_position)
        _add_inertia(eccentric, round_off, mass=mass.torque / _GRAVITY / arm)
        ET.SubElement(eccentric, "geom", appearance | {"type": "sphere", "size": "0.02"})
    for i, flexible in enumerate(parts.flexible_inertias):
        flexible_body = ET.SubElement(body, "body", name=_name_behind_spring(side, i))
        _add_inertia(flexible_body, flexible.inertia, parts.slides)
        joint_attributes = {"name": _name_behind_spring(side, i), "type": joint["type"], "axis": joint["axis"]}
        ET.SubElement(
            flexible_body,
            "joint",
            joint_attributes
            | {"stiffness": _format_numbers(flexible.stiffness), "damping": _format_numbers(flexible.damping)},
        )


def _add_inertia(body: ET.Element, inertia: float, slides: bool = False, mass: float = 1.0) -> None:
    """Add an inertia to a body: a mass along a line, a moment about the axis."""
    diagonal = _format_numbers(inertia, inertia, inertia)
    ET.SubElement(body, "inertial", pos="0 0 0", mass=_format_numbers(inertia if slides else mass), diaginertia=diagonal)


def _name_behind_spring(side: str, i: int) -> str:
    return f"{side}_behind_spring{i}"


def _make_tendons(parts: MujocoParts, notes: list[str]) -> ET.Element:
    """Make the gear, and springs on one joint."""
    tendons, gap, limits = ET.Element("tendon"), parts.half_gap, {}
    springs = [spring._replace(low=spring.low - gap, high=spring.high + gap) for spring in parts.springs]
    if springs:
        _add_comments(
            tendons, f"The twist z = theta_e - N_0 theta_s, drive.gear_ratio N_0 = {_format_numbers(parts.ratio)}", *notes
        )
    if parts.damping and gap:
        # the limits are springs with dampers as well, being weak constraints: they act from the gap on, and do not pull
        stiffness = sum(spring.linear for spring in springs)
        springs[0] = springs[0]._replace(linear=springs[0].linear - stiffness)
        limits = {
            "range": f"{_format_numbers(-gap)} {_format_numbers(gap)}",
            "limited": "true",
            "solreflimit": _format_numbers(-stiffness * parts.mobility, -parts.damping * parts.mobility),
            "solimplimit": "0.0001 0.0001 0.001",
        }
    elif parts.damping:
        limits = {"damping": _format_numbers(parts.damping)}
    for i, spring in enumerate(springs):
        tendon = ET.SubElement(tendons, "fixed", {"name": f"gear{i}"} | _spring_attributes(spring) | ({} if i else limits))
        ET.SubElement(tendon, "joint", joint="motor", coef="1")
        ET.SubElement(tendon, "joint", joint="load", coef=_format_numbers(-float(parts.ratio or 0.0)))
    for side, side_parts in parts.sides.items():
        for i, spring in enumerate(side_parts.springs):
            tendon = ET.SubElement(tendons, "fixed", {"name": f"{side}_spring{i}"} | _spring_attributes(spring))
            ET.SubElement(tendon, "joint", joint=side, coef="1")
    return tendons


def _spring_attributes(spring: Spring) -> dict[str, str]:
    stiffness = _format_numbers(spring.linear, *([0, spring.cubic] if spring.cubic else []))
    return {"stiffness": stiffness, "springlength": _format_numbers(spring.low, spring.high)}


def _make_actuators(parts: MujocoParts, notes: list[str], step: float) -> ET.Element:
    """Make the input, and passive motors for friction and torques over the position."""
    actuators, chain = ET.Element("actuator"), parts.actuator
    attributes = {"name": "input", "joint": "motor", "gainprm": _format_numbers(chain.gain)}
    if chain.lag is not None:
        attributes |= {"dyntype": "filterexact", "dynprm": _format_numbers(chain.lag)}
    for name, limit in (("ctrl", chain.limit), ("force", chain.torque_limit)):
        if math.isfinite(limit):
            attributes |= {f"{name}range": f"{_format_numbers(-limit)} {_format_numbers(limit)}", f"{name}limited": "true"}
    _add_comments(actuators, "The input u, held from sample to sample", *notes)
    driven = ET.SubElement(actuators, "general", attributes)
    if chain.delay:
        driven.attrib.update(delay=_format_numbers(chain.delay), nsample=str(math.ceil(chain.delay / step) + 2))
    for side, side_parts in parts.sides.items():
        passive = {"joint": side, "input": "none", "motorconst": "0", "resistance": "1"}
        for i, wave in enumerate(side_parts.waves):
            ET.SubElement(actuators, "dcmotor", passive, name=f"{side}_wave{i}", cogging=_format_numbers(*wave))
        for i, bristles in enumerate(side_parts.bristles):
            ET.SubElement(actuators, "dcmotor", passive, name=f"{side}_friction{i}", lugre=_format_numbers(*bristles))
    return actuators


def _make_sensors(parts: MujocoParts) -> ET.Element:
    sensors = ET.Element("sensor")
    for side in parts.sides:
        ET.SubElement(sensors, "jointpos", name=f"{side}_position", joint=side)
        ET.SubElement(sensors, "jointvel", name=f"{side}_velocity", joint=side)
    if parts.ratio is not None:
        ET.SubElement(sensors, "tendonpos", name="twist", tendon="gear0")
    ET.SubElement(sensors, "actuatorfrc", name="motor_torque", actuator="input")
    return sensors


def _make_keyframe(experiment: Experiment, parts: MujocoParts) -> ET.Element:
    """The state at t = 0."""
    keyframe = ET.Element("keyframe")
    positions, velocities = [], []
    for side, side_parts in parts.sides.items():
        start = (getattr(experiment.initial, f"{side}_{name}") for name in ("position", "velocity"))
        for numbers, value in zip((positions, velocities), start, strict=True):
            numbers.append(_format_numbers(value))
        # what is behind a spring stands still: its joint's velocity is that against the side
        positions += ["0"] * len(side_parts.flexible_inertias)
        velocities += [_format_numbers(-getattr(experiment.initial, f"{side}_velocity"))] * len(side_parts.flexible_inertias)
    _add_comments(keyframe, "initial.*: the state at t = 0")
    ET.SubElement(keyframe, "key", name="initial", qpos=" ".join(positions), qvel=" ".join(velocities))
    return keyframe


def _add_comments(parent: ET.Element, *texts: str) -> None:
    for text in texts:
        # two dashes end a comment
        parent.append(ET.Comment(f" {separate(text, '--')} "))


def _format_numbers(*values: Any) -> str:
    """Write numbers with all their digits, with spaces between them."""
    return " ".join(repr(float(value) + 0.0).removesuffix(".0") for value in values)
