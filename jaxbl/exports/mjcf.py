"""A MuJoCo model (MJCF) of a study's drive, with its gap and its effects, and what of the study it does not have.

Two joints without a parent between them, coupled by tendons of length z = theta_e - N_0 theta_s: a tendon's spring with a
dead band is the gear with its gap. :mod:`.to_mujoco` says what an effect or a law is in MuJoCo.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from typing import Any

from jaxbl.config import Config
from jaxbl.drive.parameters import parameters
from jaxbl.errors import InputError
from jaxbl.simulate import Experiment
from jaxbl.units import on_a_line

from .mujoco_parts import IMPEDANCE, RESOLUTION, Answer, MujocoParts, SideParts, Spring, exactly, unsaid
from .to_mujoco import to_mujoco

MUJOCO = "4.0"
"""The version for which models are written."""
_LEAST_STEPS = 10
"""A sample, at least: friction and contacts begin and end within a step."""
_GRAVITY = 9.81
_ARM = 0.06
"""Longest arm of an eccentric mass, m."""
_COLOURS = {"motor": "0.35 0.45 0.60 1", "load": "0.75 0.55 0.30 1"}


def by_answer(said: dict[str, Answer]) -> dict[str, dict[str, str]]:
    """What the model has `exactly`, `approximated` or `not said`, by config path."""
    answers = ("exactly", "approximated", "not said")
    return {how: {path: one.text for path, one in said.items() if one.fidelity == how} for how in answers}


def mjcf(config: Config, *, linear: Iterable[str] = ()) -> tuple[str, float, dict[str, Answer]]:
    """A study's model as text, its time step in s, and how well it has each part, by config path.

    Args:
        config: the study; its axes are not used.
        linear: the sides (`motor`, `load`) that move along a line; they have slide joints, and kg, N, m.

    Raises:
        InputError: no such side, or a transmission law that MuJoCo cannot say.
    """
    experiment, slides = config.build(), tuple(linear)
    for side in slides:
        if side not in experiment.sides:
            raise InputError(f"linear: the drive has no side '{side}'; it should be among {', '.join(experiment.sides)}")
    parts, said, notes = _collected(experiment, slides)
    period = float(experiment.run.sample_period)
    steps = _whole(period / min(parts.step, parts.longest_step))
    title = config.title or "A drive"
    return _text(title, experiment, parts, said, notes, steps), period / steps, said


def _whole(steps: float) -> int:
    """Steps, as many whole ones; rounding adds none."""
    return math.ceil(steps * (1.0 - 1e-9))


def _collected(
    experiment: Experiment, slides: tuple[str, ...]
) -> tuple[MujocoParts, dict[str, Answer], dict[str, list[str]]]:
    """All parts of the model, how well it has each part of the study, and comments by place."""
    plant, run, drive, law = experiment.plant, experiment.run, experiment.drive, experiment.transmission
    sides = {side: SideParts(float(plant.inertia(side)), side in slides, float(drive.viscous(side))) for side in drive.sides}
    parts = MujocoParts(sides, None if law is None else float(drive.ratio("load")), float(run.sample_period))
    fastest = 0.0 if law is None else math.sqrt(float(law.stiffness) * parts.mobility)
    parts.step /= max(run.substeps, _LEAST_STEPS, _whole(float(run.sample_period) * fastest / RESOLUTION))
    said = {"drive": exactly("bodies, and their joints with damping")}
    notes: dict[str, list[str]] = {}
    if law is not None:
        said["transmission"] = answer = to_mujoco(law, parts)
        if answer.fidelity == "not said":
            raise InputError(f"transmission.law: MuJoCo cannot say '{law.name}': {answer.text}; another law is needed")
        notes["transmission"] = [_note("transmission", law, answer)]
    names = [effect.name for effect in experiment.effects]
    # first those that make the gap: what others are depends on it
    for i, effect in sorted(enumerate(experiment.effects), key=lambda one: float(one[1].free_play()) == 0.0):
        path, place = f"effects.{effect.name if names.count(effect.name) == 1 else i}", drive.resolve_place(effect.place)
        said[path] = answer = to_mujoco(effect, parts, place if place in sides else "motor")
        if answer.fidelity != "not said":
            notes.setdefault(place, []).append(_note(path, effect, answer, place in slides))
    said["initial"] = exactly("the keyframe 'initial'")
    said["excitation"] = unsaid("the model has an input: set data.ctrl[0] at each sample and hold it until the next")
    if any(getattr(experiment.encoders, field.name) for field, _ in parameters(experiment.encoders)):
        said["encoders"] = unsaid("the sensors of a model read without noise and counts")
    said["observer"] = unsaid("the model is that of the drive alone")
    return parts, said, notes


def _note(path: str, part: Any, said: Answer, slides: bool = False) -> str:
    """A comment: a part's config path, its numbers and units, and what it is in the model."""
    numbers = []
    for field, about in parameters(part):
        value = getattr(part, field.name)
        if value == () or isinstance(value, bool):
            continue
        unit = on_a_line(about.unit) if slides else about.unit
        value = " ".join(map(_n, value)) if isinstance(value, tuple) else _n(value)
        numbers.append(f"{field.name} = {value} {unit}".rstrip())
    return f"{path}: {', '.join(numbers)}; {said.text}"


# XML


def _text(
    title: str,
    experiment: Experiment,
    parts: MujocoParts,
    said: dict[str, Answer],
    notes: dict[str, list[str]],
    steps: int,
) -> str:
    """The model as XML."""
    root, step = ET.Element("mujoco", model="drive"), float(experiment.run.sample_period) / steps
    _comment(root, f"{title}. Written by jaxbl for MuJoCo {MUJOCO} or later")
    units = (f"{side} {'kg, N, m' if one.slides else 'kg m², N m, rad'}" for side, one in parts.sides.items())
    _comment(root, f"Units: {'; '.join(units)}; times in s. Shapes and masses of what turns are for the eye alone")
    for how, heading in (("approximated", "Approximated"), ("not said", "Not in this model")):
        for path, one in said.items():
            if one.fidelity == how:
                _comment(root, f"{heading}: {path}: {one.text}")
    ET.SubElement(root, "compiler", angle="radian", inertiafromgeom="false")
    _comment(root, f"run.sample_period = {_n(experiment.run.sample_period)} s: {steps} steps")
    option = ET.SubElement(root, "option", timestep=_n(step), integrator="RK4", gravity=f"0 0 {-_GRAVITY}")
    ET.SubElement(option, "flag", contact="disable")
    world = ET.SubElement(root, "worldbody")
    ET.SubElement(world, "light", pos="0 -1 2", dir="0 0.5 -1")
    for i, (side, one) in enumerate(parts.sides.items()):
        for field, about in parameters(experiment.drive):
            if field.name.startswith(side):
                unit = on_a_line(about.unit) if one.slides else about.unit
                _comment(world, f"drive.{field.name} = {_n(getattr(experiment.drive, field.name))} {unit}")
        _comment(world, *notes.get(side, ()))
        _side(world, side, one, 0.25 * i, step)
    root.append(_tendons(parts, notes.get("transmission", [])))
    root.append(_actuators(parts, notes.get("actuator", []), step))
    root.append(_sensors(parts))
    root.append(_keyframe(experiment, parts))
    for empty in [one for one in root if one.tag == "tendon" and not len(one)]:
        root.remove(empty)
    ET.indent(root, "  ")
    return ET.tostring(root, encoding="unicode") + "\n"


def _side(world: ET.Element, side: str, one: SideParts, at: float, step: float) -> None:
    """The body of a side, with its joint."""
    body = ET.SubElement(world, "body", name=side, pos=f"{_n(at)} 0 0")
    # the inertia of eccentric masses is part of the side's: half of it at most
    arms = [min(_ARM, 0.5 * one.inertia / len(one.pendulums) * _GRAVITY / mass.torque) for mass in one.pendulums]
    round_off = 1e-6 * one.inertia
    apart = sum(mass.torque / _GRAVITY * arm + round_off for mass, arm in zip(one.pendulums, arms, strict=True))
    _inertial(body, one, one.inertia - apart)
    joint = {"name": side, "type": "slide" if one.slides else "hinge", "axis": "1 0 0" if one.slides else "0 1 0"}
    joint["damping"] = f"{_n(one.viscous)} {_n(one.drag)}" if one.drag else _n(one.viscous)
    if one.dry:
        # as hard as the steps allow: MuJoCo's defaults are softer
        joint |= {"frictionloss": _n(one.dry), "solreffriction": f"{_n(2.0 * step)} 1"}
        joint |= {"solimpfriction": f"{IMPEDANCE} {IMPEDANCE} 0.001"}
    ET.SubElement(body, "joint", joint)
    look = {"contype": "0", "conaffinity": "0", "rgba": _COLOURS[side]}
    if one.slides:
        ET.SubElement(body, "geom", look | {"type": "box", "size": "0.06 0.04 0.04"})
    else:
        ET.SubElement(body, "geom", look | {"type": "cylinder", "size": "0.08 0.02", "euler": f"{_n(math.pi / 2)} 0 0"})
        ET.SubElement(body, "geom", look | {"type": "box", "size": "0.01 0.022 0.03", "pos": "0 0 -0.05", "rgba": "1 1 1 1"})
    for i, (mass, arm) in enumerate(zip(one.pendulums, arms, strict=True)):
        where = f"{_n(arm * math.sin(mass.phase))} 0 {_n(-arm * math.cos(mass.phase))}"
        eccentric = ET.SubElement(body, "body", name=f"{side}_mass{i}", pos=where)
        ET.SubElement(
            eccentric, "inertial", pos="0 0 0", mass=_n(mass.torque / _GRAVITY / arm), diaginertia=_three(round_off)
        )
        ET.SubElement(eccentric, "geom", look | {"type": "sphere", "size": "0.02"})
    for i, flexible in enumerate(one.flexible_inertias):
        further = ET.SubElement(body, "body", name=_behind(side, i))
        _inertial(further, one, flexible.inertia)
        about = {"name": _behind(side, i), "type": joint["type"], "axis": joint["axis"]}
        ET.SubElement(further, "joint", about | {"stiffness": _n(flexible.stiffness), "damping": _n(flexible.damping)})


def _inertial(body: ET.Element, one: SideParts, inertia: float) -> None:
    """What resists acceleration: a mass along a line, a moment about the axis."""
    ET.SubElement(body, "inertial", pos="0 0 0", mass=_n(inertia) if one.slides else "1", diaginertia=_three(inertia))


def _three(inertia: float) -> str:
    return " ".join([_n(inertia)] * 3)


def _behind(side: str, i: int) -> str:
    return f"{side}_behind_spring{i}"


def _tendons(parts: MujocoParts, notes: list[str]) -> ET.Element:
    """The gear, and springs on one joint."""
    found, gap, limits = ET.Element("tendon"), parts.half_gap, {}
    springs = [one._replace(low=one.low - gap, high=one.high + gap) for one in parts.springs]
    if springs:
        _comment(found, f"The twist z = theta_e - N_0 theta_s, drive.gear_ratio N_0 = {_n(parts.ratio)}", *notes)
    if parts.damping and gap:
        # the limits are springs with dampers as well, being weak constraints: they act from the gap on, and do not pull
        stiffness = sum(one.linear for one in springs)
        springs[0] = springs[0]._replace(linear=springs[0].linear - stiffness)
        limits = {
            "range": f"{_n(-gap)} {_n(gap)}",
            "limited": "true",
            "solreflimit": f"{_n(-stiffness * parts.mobility)} {_n(-parts.damping * parts.mobility)}",
            "solimplimit": "0.0001 0.0001 0.001",
        }
    elif parts.damping:
        limits = {"damping": _n(parts.damping)}
    for i, one in enumerate(springs):
        tendon = ET.SubElement(found, "fixed", {"name": f"gear{i}"} | _spring(one) | ({} if i else limits))
        ET.SubElement(tendon, "joint", joint="motor", coef="1")
        ET.SubElement(tendon, "joint", joint="load", coef=_n(-float(parts.ratio or 0.0)))
    for side, its in parts.sides.items():
        for i, one in enumerate(its.springs):
            tendon = ET.SubElement(found, "fixed", {"name": f"{side}_spring{i}"} | _spring(one))
            ET.SubElement(tendon, "joint", joint=side, coef="1")
    return found


def _spring(one: Spring) -> dict[str, str]:
    stiffness = f"{_n(one.linear)} 0 {_n(one.cubic)}" if one.cubic else _n(one.linear)
    return {"stiffness": stiffness, "springlength": f"{_n(one.low)} {_n(one.high)}"}


def _actuators(parts: MujocoParts, notes: list[str], step: float) -> ET.Element:
    """The input, and passive motors that have friction and torques over the position."""
    found, chain = ET.Element("actuator"), parts.actuator
    about = {"name": "input", "joint": "motor", "gainprm": _n(chain.gain)}
    if chain.lag is not None:
        about |= {"dyntype": "filterexact", "dynprm": _n(chain.lag)}
    for name, limit in (("ctrl", chain.limit), ("force", chain.torque_limit)):
        if math.isfinite(limit):
            about |= {f"{name}range": f"{_n(-limit)} {_n(limit)}", f"{name}limited": "true"}
    _comment(found, "The input u, held from sample to sample", *notes)
    driven = ET.SubElement(found, "general", about)
    if chain.delay:
        driven.attrib.update(delay=_n(chain.delay), nsample=str(math.ceil(chain.delay / step) + 2))
    for side, one in parts.sides.items():
        passive = {"joint": side, "input": "none", "motorconst": "0", "resistance": "1"}
        for i, wave in enumerate(one.waves):
            ET.SubElement(found, "dcmotor", passive, name=f"{side}_wave{i}", cogging=" ".join(map(_n, wave)))
        for i, rub in enumerate(one.bristles):
            ET.SubElement(found, "dcmotor", passive, name=f"{side}_friction{i}", lugre=" ".join(map(_n, rub)))
    return found


def _sensors(parts: MujocoParts) -> ET.Element:
    found = ET.Element("sensor")
    for side in parts.sides:
        ET.SubElement(found, "jointpos", name=f"{side}_position", joint=side)
        ET.SubElement(found, "jointvel", name=f"{side}_velocity", joint=side)
    if parts.ratio is not None:
        ET.SubElement(found, "tendonpos", name="twist", tendon="gear0")
    ET.SubElement(found, "actuatorfrc", name="motor_torque", actuator="input")
    return found


def _keyframe(experiment: Experiment, parts: MujocoParts) -> ET.Element:
    """The state at t = 0."""
    found = ET.Element("keyframe")
    positions, velocities = [], []
    for side, one in parts.sides.items():
        start = (getattr(experiment.initial, f"{side}_{name}") for name in ("position", "velocity"))
        for numbers, value in zip((positions, velocities), start, strict=True):
            numbers.append(_n(value))
        # what is behind a spring stands still: its joint's velocity is that against the side
        positions += ["0"] * len(one.flexible_inertias)
        velocities += [_n(-getattr(experiment.initial, f"{side}_velocity"))] * len(one.flexible_inertias)
    _comment(found, "initial.*: the state at t = 0")
    ET.SubElement(found, "key", name="initial", qpos=" ".join(positions), qvel=" ".join(velocities))
    return found


def _comment(parent: ET.Element, *texts: str) -> None:
    for text in texts:
        # two dashes end a comment
        while "--" in text:
            text = text.replace("--", "- -")
        parent.append(ET.Comment(f" {text} "))


def _n(value: Any) -> str:
    """A number with all its digits."""
    return repr(float(value) + 0.0).removesuffix(".0")
