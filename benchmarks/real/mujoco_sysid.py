"""MuJoCo's system identification on the same logs: the numbers of a joint, by its own simulation over short windows.

It is given what its joints have: inertia, damping, dry friction (`frictionloss`), the torque of gravity on a rotary axis
that stands alone, and of two inertias the spring between them. It names nothing; what it leaves is compared as that of the
others.
"""

import contextlib
import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxbl.config import Config

from .derivatives import Part, driving
from .rivals import Found

_WINDOW = 0.5
"""Length of the windows, s, each from the filtered state at its beginning: an open loop drifts over longer ones."""
_MOST = 80
"""Windows at most, spread over the log."""
_STEP = 1e-3
"""Longest step of the simulation, s."""
_AWAY = 30.0
"""Factor by which a number may differ from its nominal value."""
_LIGHT = 1e-4
"""Mass on a lever of 1 m that gravity acts on, over the inertia: its own inertia is then none."""

# dry friction is a soft constraint there: as hard as a step allows
_ONE = """
<mujoco><compiler angle="radian"/><option integrator="implicitfast" timestep="{step}"/>
<worldbody><body><inertial pos="{lever} 0 0" mass="{mass}" diaginertia="{tiny} {tiny} {tiny}"/>
<joint name="motor" type="{kind}" axis="0 1 0" solreffriction="{hard} 1" solimpfriction="0.99 0.9999 0.001"/>
{more}</body></worldbody>
<actuator><motor joint="motor" name="u"/></actuator>
<sensor><jointpos name="motor" joint="motor"/>{sensor}</sensor></mujoco>"""
_OTHER = """<body><inertial pos="0 0 0" mass="1e-6" diaginertia="{inertia} {inertia} {inertia}"/>
<joint name="twist" type="hinge" axis="0 1 0"/></body>"""


def sysid(fitted: Sequence[Part], held: Sequence[Part], model: Config, linear: bool) -> Found:
    """Numbers of a joint fitted to the positions; the torque that is then missing on held-out derivatives."""
    try:
        import mujoco  # type: ignore[import-not-found]
        from mujoco import sysid as tool  # type: ignore[import-not-found]

        tool.optimize  # noqa: B018 (without what it needs its names are missing)
    except (ImportError, AttributeError):
        return Found([], note="mujoco[sysid] is not installed")
    drive, rigid, period = model.drive, model.drive.kind == "rigid", fitted[0].period
    if not rigid and float(drive.gear_ratio) != 1.0:
        return Found([], note="a gear is no joint of MuJoCo")
    inertia = float(drive.motor_inertia)
    spec = _spec(model, linear, period / np.ceil(period / _STEP))
    names = ["motor"] if rigid else ["motor", "twist"]
    built = spec.compile()
    states = [np.stack(_states(estimate, rigid), axis=-1) for estimate in fitted]
    length = max(round(_WINDOW / period), 2)
    rows = [
        (part, state, first)
        for part, state in zip(fitted, states, strict=True)
        for first in range(0, len(state) - length, length)
    ]
    scale = np.std(np.concatenate([estimate[:, :, 0] for estimate in states]), axis=0)
    chosen = [rows[i] for i in np.unique(np.linspace(0, len(rows) - 1, _MOST).astype(int))]
    starts, inputs, readings = [], [], []
    for part, state, first in chosen:
        window = slice(first, first + length)
        time = period * np.arange(length)
        torque = np.asarray(part.kinematics.torque)[window, None]
        starts.append(tool.create_initial_state(built, state[first, :, 0], state[first, :, 1]))
        inputs.append(tool.TimeSeries.from_control_names(time, torque, built))
        readings.append(tool.TimeSeries.from_names(time, state[window, :, 0], built, names))
    sequences = tool.ModelSequences("log", spec, [str(i) for i in range(len(chosen))], starts, inputs, readings)

    def residuals(_params: Any, simulated: Any, measured: Any, *_arguments: Any, **_options: Any) -> tuple[Any, Any, Any]:
        simulated = simulated.resample(measured.times)
        return (simulated.data - measured.data) / scale, simulated, measured

    size = driving(fitted, inertia)
    fastest = max(float(np.max(np.abs(estimate[:, 0, 1]))) for estimate in states)
    params = tool.ParameterDict()
    for name, (start, least, most, change) in _numbers(model, linear, size, fastest).items():
        params.add(tool.Parameter(name, start, least, most, modifier=change))
    function = tool.build_residual_fn(models_sequences=[sequences], modify_residual=residuals, n_threads=2)
    with contextlib.redirect_stdout(io.StringIO()):
        estimates, _ = tool.optimize(params, function, optimizer="scipy", verbose=False, x_scale="jac", max_iters=60)
    values = {name: float(estimate.value[0]) for name, estimate in estimates.items()}
    best = tool.apply_param_modifiers(estimates, spec)
    best.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS)
    missing = np.concatenate([_missing(mujoco, best, estimate, rigid, values["dry friction"]) for estimate in held])
    return Found(list(values), {name: [estimate] for name, estimate in values.items()}, _units(values, linear), {}, missing)


def _spec(model: Config, linear: bool, step: float) -> Any:
    import mujoco  # type: ignore[import-not-found]

    drive, rigid = model.drive, model.drive.kind == "rigid"
    inertia = float(drive.motor_inertia)
    tiny = 1e-9 * inertia
    other = "" if rigid else _OTHER.format(inertia=float(drive.load_inertia))
    text = _ONE.format(
        step=step, hard=2.0 * step, kind="slide" if linear else "hinge", more=other, tiny=max(tiny, 1e-12),
        mass=_LIGHT * inertia,
        lever=0 if linear else 1, sensor="" if rigid else '<jointpos name="twist" joint="twist"/>',
    )  # fmt: skip
    spec = mujoco.MjSpec.from_string(text)
    spec.option.gravity = [0.0, 0.0, 0.0]
    spec.joint("motor").armature, spec.joint("motor").damping = inertia, [float(drive.motor_viscous), 0.0, 0.0]
    if not rigid:
        spec.joint("twist").stiffness = [_stiffness(model), 0.0, 0.0]
    return spec


def _numbers(model: Config, linear: bool, size: float, fastest: float) -> dict[str, tuple]:
    """Fitted numbers by name: start, bounds, and function that sets it in a model; `size` of the torque, `fastest` speed."""
    drive, exact = model.drive, model.uncertainty.exact
    mass = _LIGHT * float(drive.motor_inertia)

    def damping(spec: Any, joint: str, value: float) -> None:
        spec.joint(joint).damping = [value, 0.0, 0.0]

    def gravity(spec: Any, i: int, value: float) -> None:
        field = np.array(spec.option.gravity)
        field[i] = value / mass
        spec.option.gravity = field

    def armature(spec: Any, parameter: Any) -> None:
        spec.joint("motor").armature = parameter.value[0]

    def loss(spec: Any, parameter: Any) -> None:
        spec.joint("motor").frictionloss = parameter.value[0]

    numbers: dict[str, tuple] = {}
    inertia, viscous = float(drive.motor_inertia), float(drive.motor_viscous)
    if "drive.motor_inertia" not in exact:
        numbers["inertia"] = (inertia, inertia / _AWAY, inertia * _AWAY, armature)
    most = max(_AWAY * viscous, 3.0 * size / fastest)
    numbers["viscous"] = (
        max(viscous, 0.01 * most), 0.0, most, lambda spec, parameter: damping(spec, "motor", parameter.value[0]),
    )  # fmt: skip
    numbers["dry friction"] = (0.1 * size, 0.0, 3.0 * size, loss)
    if drive.kind == "rigid" and not linear:
        for i, name in ((0, "gravity, cosine"), (2, "gravity, sine")):
            numbers[name] = (
                0.0, -_AWAY * size, _AWAY * size, lambda spec, parameter, i=i: gravity(spec, i, parameter.value[0]),
            )  # fmt: skip
    if drive.kind != "rigid":
        stiffness, load = _stiffness(model), float(drive.load_inertia)

        def spring(spec: Any, parameter: Any) -> None:
            spec.joint("twist").stiffness = [parameter.value[0], 0.0, 0.0]

        def mass_of(spec: Any, parameter: Any) -> None:
            body = spec.joint("twist").parent
            body.inertia = np.full(3, parameter.value[0])

        numbers["stiffness"] = (stiffness, stiffness / _AWAY, stiffness * _AWAY, spring)
        numbers["load inertia"] = (load, load / _AWAY, load * _AWAY, mass_of)
        numbers["damping of the twist"] = (
            1e-3 * stiffness, 0.0, stiffness, lambda spec, parameter: damping(spec, "twist", parameter.value[0]),
        )  # fmt: skip
    return numbers


def _stiffness(model: Config) -> float:
    assert model.transmission is not None
    return float(model.transmission.stiffness)


def _units(values: dict[str, float], linear: bool) -> dict[str, str]:
    force, inertia = ("N", "kg") if linear else ("N m", "kg m²")
    units = {"viscous": f"{force} s/{'m' if linear else 'rad'}", "damping of the twist": "N m s/rad", "stiffness": "N m/rad"}
    return {name: units.get(name, inertia if "inertia" in name else force) for name in values}


def _states(part: Part, rigid: bool) -> list[np.ndarray]:
    """Positions, velocities and accelerations of MuJoCo's joints; shape (samples, joints) each."""
    k, columns = part.kinematics, []
    for motion in (k.position, k.velocity, k.acceleration):
        motor = np.asarray(motion["motor"])
        columns.append(np.stack([motor] if rigid else [motor, np.asarray(motion["load"]) - motor], axis=1))
    return columns


def _missing(mujoco: Any, model: Any, part: Part, rigid: bool, friction: float) -> np.ndarray:
    """Torque that the input would have to have besides, behind the low-pass: by inverse dynamics, and dry friction."""
    position, velocity, acceleration = _states(part, rigid)
    data = mujoco.MjData(model)
    needed = np.zeros(len(position))
    for i in range(len(position)):
        data.qpos[:], data.qvel[:], data.qacc[:] = position[i], velocity[i], acceleration[i]
        mujoco.mj_inverse(model, data)
        # of two joints the second one's torque should be none: what it is has to come from the load
        needed[i] = data.qfrc_inverse[0] - (0.0 if rigid else data.qfrc_inverse[1])
    needed += friction * np.sign(velocity[:, 0])
    return part.low_passed(np.asarray(part.kinematics.torque) - needed)
