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
from .writer import add_element, format_numbers, separate, set_attributes

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
            text = format_numbers(*value) if isinstance(value, tuple) else format_numbers(value)
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
    add_element(root, "compiler", angle="radian", inertiafromgeom="false")
    _add_comments(root, f"run.sample_period = {format_numbers(experiment.run.sample_period)} s: {steps} steps")
    option = add_element(root, "option", timestep=step, integrator="RK4", gravity=f"0 0 {-_GRAVITY}")
    add_element(option, "flag", contact="disable")
    world = add_element(root, "worldbody")
    add_element(world, "light", pos="0 -1 2", dir="0 0.5 -1")
    for i, (side, side_parts) in enumerate(parts.sides.items()):
        numbers = _describe_numbers(experiment.drive, side_parts.slides)
        _add_comments(world, *(f"drive.{number}" for number in numbers if number.startswith(side)))
        _add_comments(world, *notes.get(side, ()))
        _add_side(world, side, side_parts, 0.25 * i, step)
    _add_tendons(root, parts, notes.get("transmission", []))
    _add_actuators(root, parts, notes.get("actuator", []), step)
    _add_sensors(root, parts)
    _add_keyframe(root, experiment, parts)
    ET.indent(root, "  ")
    return ET.tostring(root, encoding="unicode") + "\n"


def _add_side(world: ET.Element, side: str, parts: SideParts, offset: float, step: float) -> None:
    """Add the body of a side, with its joint."""
    body = add_element(world, "body", name=side, pos=(offset, 0, 0))
    # the inertia of eccentric masses is part of the side's: half of it at most
    arms = [min(_ARM, 0.5 * parts.inertia / len(parts.pendulums) * _GRAVITY / mass.torque) for mass in parts.pendulums]
    round_off = 1e-6 * parts.inertia
    inertia_of_masses = sum(
        mass.torque / _GRAVITY * arm + round_off for mass, arm in zip(parts.pendulums, arms, strict=True)
    )
    _add_inertia(body, parts.inertia - inertia_of_masses, parts.slides)
    moves = {"type": "slide", "axis": "1 0 0"} if parts.slides else {"type": "hinge", "axis": "0 1 0"}
    joint = add_element(
        body, "joint", name=side, **moves, damping=(parts.viscous, parts.drag) if parts.drag else parts.viscous
    )
    if parts.dry:
        # as hard as the steps allow: MuJoCo's defaults are softer
        set_attributes(
            joint, frictionloss=parts.dry, solreffriction=(2.0 * step, 1), solimpfriction=f"{IMPEDANCE} {IMPEDANCE} 0.001"
        )
    appearance = {"contype": "0", "conaffinity": "0", "rgba": _COLOURS[side]}
    if parts.slides:
        add_element(body, "geom", **appearance, type="box", size="0.06 0.04 0.04")
    else:
        add_element(body, "geom", **appearance, type="cylinder", size="0.08 0.02", euler=(math.pi / 2, 0, 0))
        pointer = appearance | {"rgba": "1 1 1 1"}
        add_element(body, "geom", **pointer, type="box", size="0.01 0.022 0.03", pos="0 0 -0.05")
    for i, (mass, arm) in enumerate(zip(parts.pendulums, arms, strict=True)):
        place = arm * math.sin(mass.phase), 0, -arm * math.cos(mass.phase)
        eccentric = add_element(body, "body", name=f"{side}_mass{i}", pos=place)
        _add_inertia(eccentric, round_off, mass=mass.torque / _GRAVITY / arm)
        add_element(eccentric, "geom", **appearance, type="sphere", size=0.02)
    for i, flexible in enumerate(parts.flexible_inertias):
        name = f"{side}_behind_spring{i}"
        flexible_body = add_element(body, "body", name=name)
        _add_inertia(flexible_body, flexible.inertia, parts.slides)
        add_element(flexible_body, "joint", name=name, **moves, stiffness=flexible.stiffness, damping=flexible.damping)


def _add_inertia(body: ET.Element, inertia: float, slides: bool = False, mass: float = 1.0) -> None:
    """Add an inertia to a body: a mass along a line, a moment about the axis."""
    add_element(body, "inertial", pos="0 0 0", mass=inertia if slides else mass, diaginertia=[inertia] * 3)


def _add_tendons(root: ET.Element, parts: MujocoParts, notes: list[str]) -> None:
    """Add the gear, and springs on one joint."""
    tendons, gap, limits = ET.Element("tendon"), parts.half_gap, dict[str, Any]()
    springs = [spring._replace(low=spring.low - gap, high=spring.high + gap) for spring in parts.springs]
    if springs:
        _add_comments(
            tendons, f"The twist z = theta_e - N_0 theta_s, drive.gear_ratio N_0 = {format_numbers(parts.ratio)}", *notes
        )
    if parts.damping and gap:
        # the limits are springs with dampers as well, being weak constraints: they act from the gap on, and do not pull
        stiffness = sum(spring.linear for spring in springs)
        springs[0] = springs[0]._replace(linear=springs[0].linear - stiffness)
        limits = {
            "range": (-gap, gap),
            "limited": "true",
            "solreflimit": (-stiffness * parts.mobility, -parts.damping * parts.mobility),
            "solimplimit": "0.0001 0.0001 0.001",
        }
    elif parts.damping:
        limits = {"damping": parts.damping}
    for i, spring in enumerate(springs):
        tendon = _add_spring(tendons, f"gear{i}", spring, "motor", **({} if i else limits))
        add_element(tendon, "joint", joint="load", coef=-float(parts.ratio or 0.0))
    for side, side_parts in parts.sides.items():
        for i, spring in enumerate(side_parts.springs):
            _add_spring(tendons, f"{side}_spring{i}", spring, side)
    if len(tendons):
        root.append(tendons)


def _add_spring(tendons: ET.Element, name: str, spring: Spring, joint: str, **more: Any) -> ET.Element:
    stiffness = (spring.linear, 0, spring.cubic) if spring.cubic else spring.linear
    tendon = add_element(tendons, "fixed", name=name, stiffness=stiffness, springlength=(spring.low, spring.high), **more)
    add_element(tendon, "joint", joint=joint, coef=1)
    return tendon


def _add_actuators(root: ET.Element, parts: MujocoParts, notes: list[str], step: float) -> None:
    """Add the input, and passive motors for friction and torques over the position."""
    actuators, chain = add_element(root, "actuator"), parts.actuator
    _add_comments(actuators, "The input u, held from sample to sample", *notes)
    driven = add_element(actuators, "general", name="input", joint="motor", gainprm=chain.gain)
    if chain.lag is not None:
        set_attributes(driven, dyntype="filterexact", dynprm=chain.lag)
    for name, limit in (("ctrl", chain.limit), ("force", chain.torque_limit)):
        if math.isfinite(limit):
            set_attributes(driven, **{f"{name}range": (-limit, limit), f"{name}limited": "true"})
    if chain.delay:
        set_attributes(driven, delay=chain.delay, nsample=math.ceil(chain.delay / step) + 2)
    for side, side_parts in parts.sides.items():
        passive = {"joint": side, "input": "none", "motorconst": "0", "resistance": "1"}
        for i, wave in enumerate(side_parts.waves):
            add_element(actuators, "dcmotor", **passive, name=f"{side}_wave{i}", cogging=wave)
        for i, bristles in enumerate(side_parts.bristles):
            add_element(actuators, "dcmotor", **passive, name=f"{side}_friction{i}", lugre=bristles)


def _add_sensors(root: ET.Element, parts: MujocoParts) -> None:
    sensors = add_element(root, "sensor")
    for side in parts.sides:
        add_element(sensors, "jointpos", name=f"{side}_position", joint=side)
        add_element(sensors, "jointvel", name=f"{side}_velocity", joint=side)
    if parts.ratio is not None:
        add_element(sensors, "tendonpos", name="twist", tendon="gear0")
    add_element(sensors, "actuatorfrc", name="motor_torque", actuator="input")


def _add_keyframe(root: ET.Element, experiment: Experiment, parts: MujocoParts) -> None:
    """Add the state at t = 0."""
    keyframe, positions, velocities = add_element(root, "keyframe"), [], []
    for side, side_parts in parts.sides.items():
        position, velocity = (getattr(experiment.initial, f"{side}_{name}") for name in ("position", "velocity"))
        # what is behind a spring stands still: its joint's velocity is that against the side
        count = len(side_parts.flexible_inertias)
        positions += [position, *[0] * count]
        velocities += [velocity, *[-velocity] * count]
    _add_comments(keyframe, "initial.*: the state at t = 0")
    add_element(keyframe, "key", name="initial", qpos=positions, qvel=velocities)


def _add_comments(parent: ET.Element, *texts: str) -> None:
    for text in texts:
        # two dashes end a comment
        parent.append(ET.Comment(f" {separate(text, '--')} "))
