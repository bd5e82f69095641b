"""Exported MuJoCo models against `jaxbl simulate`: free runs of 50 drawn drives, and of one drive with each effect.

`python benchmarks/mjcf.py [drives per kind]` prints the figures of docs/mujoco.md. Needs the extra `mujoco`.
"""

import dataclasses
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from effect_values import VALUES
from small_study import small_study

from jaxbl.chain import Experiment, plant_trajectory
from jaxbl.config import Config, precision, prepare, read_config
from jaxbl.exports.mjcf import write_mjcf

DURATION = 10.0
DETERMINED = 2e-3
"""Largest difference of a run from itself with a quarter of the step, at which its motion is taken to be determined."""

Study = dict[str, Any]


class Drawn(NamedTuple):
    """A drive's own scales: what its other numbers are drawn from.

    `torque` (N m) is the input's amplitude, `speed` (rad/s) what the motor reaches by it; `inertia` (kg m²) is the motor's,
    `reduced` that of the gear's swings, `ratio` and `stiffness` (N m/rad) are the gear's, `gap` (rad) half of its free play.
    """

    random: np.random.Generator
    torque: float
    find_speed: float
    inertia: float
    reduced: float
    ratio: float
    stiffness: float
    gap: float

    def within(self, low: float, high: float) -> float:
        """A number drawn by its logarithm."""
        return float(np.exp(self.random.uniform(np.log(low), np.log(high))))


Effects = Callable[[Drawn], list[Study]]


def _effect(kind: str, **numbers: Any) -> Study:
    return {"kind": kind, **numbers}


def _draw_damping(d: Drawn) -> Study:
    """A gear whose swings have a damping ratio of 1 to 10 %."""
    return _effect("transmission.damping", damping=2.0 * d.within(0.01, 0.1) * math.sqrt(d.stiffness * d.reduced))


def _coulomb(d: Drawn, side: str = "motor") -> Study:
    torque = d.torque * (1.0 if side == "motor" else d.ratio)
    return _effect(f"{side}.coulomb_friction", torque=torque * d.within(0.03, 0.2))


KINDS: dict[str, tuple[str | None, tuple[str, ...], Effects]] = {
    "linear shaft": ("linear_shaft", (), lambda d: [_draw_damping(d)]),
    "gap without damping": ("dead_zone", (), lambda d: []),
    "gap, damping, dry friction": (
        "dead_zone",
        (),
        lambda d: [_draw_damping(d), _coulomb(d), _coulomb(d, "load")],
    ),
    "gap, damping, eccentric mass": (
        "dead_zone",
        (),
        lambda d: [
            _draw_damping(d),
            _effect("load.gravity", torque=d.torque * d.ratio * d.within(0.02, 0.2), phase=d.random.uniform(-3.0, 3.0)),
        ],
    ),
    "smooth gap, drag": (
        "sigmoid_backlash",
        (),
        lambda d: [_effect("motor.quadratic_drag", drag=d.torque / d.find_speed**2 * d.within(0.03, 0.3))],
    ),
    "hardening gear with a gap, damping": (
        "linear_shaft",
        (),
        lambda d: [
            _effect("transmission.backlash", half_gap=d.gap),
            _draw_damping(d),
            # as much again at the deflection under the whole torque
            _effect("transmission.hardening", cubic_stiffness=d.stiffness**3 / d.torque**2 * d.within(0.1, 1.0)),
        ],
    ),
    "screw, damping, dry friction, lag, limit": (
        "dead_zone",
        ("load",),
        lambda d: [
            _draw_damping(d),
            _coulomb(d, "load"),
            _effect("actuator.lag", time_constant=d.within(5e-4, 5e-3)),
            _effect("actuator.saturation", limit=d.torque * d.within(0.5, 1.0)),
        ],
    ),
    "linear motor, dry friction, cogging": (
        None,
        ("motor",),
        lambda d: [
            _coulomb(d),
            _effect("motor.cogging", amplitude=d.torque * d.within(0.01, 0.04), harmonic=float(d.random.integers(4, 40))),
        ],
    ),
    "direct drive, pre-sliding, back-EMF": (
        None,
        (),
        lambda d: [
            _effect(
                "motor.presliding_friction",
                torque=d.torque * d.within(0.03, 0.2),
                length=d.within(0.01, 0.1),
                breakaway_ratio=d.within(1.0, 1.6),
                stribeck_velocity=d.find_speed * d.within(0.01, 0.1),
            ),
            _effect("actuator.back_emf", resistance=1.0, torque_constant=1.0),
        ],
    ),
    "gap, damping, flexible load, delay": (
        "dead_zone",
        (),
        lambda d: [
            _draw_damping(d),
            _effect("load.flexibility", inertia=d.inertia * d.ratio**2 * 0.2, frequency=d.within(5.0, 30.0)),
            _effect("actuator.delay", delay=d.within(5e-4, 5e-3)),
        ],
    ),
    "Stribeck friction, gap, damping": (
        "dead_zone",
        (),
        lambda d: [
            _draw_damping(d),
            _effect(
                "load.stribeck_friction",
                torque=d.torque * d.ratio * 0.1,
                breakaway_torque=d.torque * d.ratio * d.within(0.1, 0.2),
                stribeck_velocity=d.find_speed / d.ratio * d.within(0.02, 0.2),
            ),
        ],
    ),
}
"""Kinds of drives: transmission law, sides that move along a line, and effects."""
COARSE = "Stribeck friction, gap, damping"
"""The kind with a friction that MuJoCo has only nearly: it is not among the fifty."""


def draw_study(kind: str, seed: int) -> Study:
    """A study of a kind: a motor of 1e-5 to 1e-3 kg m² that accelerates at 200 to 2000 rad/s², a gear that swings at 20 to
    80 Hz, with a gap of up to three times its deflection, viscous time constants of 0.1 to 1 s."""
    law, linear, effects = KINDS[kind]
    random = np.random.default_rng([list(KINDS).index(kind), seed])

    def within(low: float, high: float) -> float:
        return float(np.exp(random.uniform(np.log(low), np.log(high))))

    inertia, acceleration, slowest = within(1e-5, 1e-3), within(200.0, 2000.0), within(0.1, 1.0)
    # rad for one m of a screw with a lead of 5 to 20 mm
    ratio = 1.0 if law is None else 2.0 * math.pi / within(5e-3, 2e-2) if linear else within(3.0, 100.0)
    load = within(0.3, 5.0) * inertia * ratio**2
    total_inertia = inertia if law is None else inertia + load / ratio**2
    torque, frequency = total_inertia * acceleration, within(0.3, 1.0)
    reduced = inertia if law is None else 1.0 / (1.0 / inertia + ratio**2 / load)
    stiffness = reduced * (2.0 * math.pi * within(20.0, 80.0)) ** 2
    gap = torque / stiffness * within(0.3, 3.0)
    speed = acceleration / math.hypot(1.0 / slowest, 2.0 * math.pi * frequency)
    draw = Drawn(random, torque, speed, inertia, reduced, ratio, stiffness, gap)
    study: Study = {
        "drive": {"kind": "rigid", "motor_inertia": inertia, "motor_viscous": inertia / slowest},
        "transmission": None,
        "excitation": {"kind": "multisine", "amplitude": torque, "frequency": frequency, "count": 5},
        "effects": effects(draw),
    }
    if law is not None:
        study["drive"] |= {"kind": "two_inertia", "load_inertia": load, "load_viscous": load / slowest, "gear_ratio": ratio}
        study["transmission"] = {"law": law, "stiffness": stiffness}
        if law == "dead_zone":
            study["transmission"]["half_gap"] = gap
        if law == "sigmoid_backlash":
            # K (1 - 2 gamma j_0) at z = 0: softer there, or unstable
            study["transmission"] |= {"dead_zone": 0.25 * gap, "slope": 2.0 * within(0.5, 2.0) / gap}
    if kind.startswith("direct"):
        # the input is a voltage there, 1 V for 1 N m: as slow by the back-EMF as by friction
        study["effects"][1]["torque_constant"] = inertia / slowest
        study["effects"][1]["resistance"] = inertia / slowest
    without = {path: None for path in ("transmission", "observer.load") if law is None}
    return small_study({"run.duration": DURATION, "run.substeps": 10} | without, **study)


def simulate(study: Config, finer: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Simulate by jaxbl: the input, and a row of positions and velocities for each sample; `substeps` are multiplied."""
    with precision(study):
        experiment = prepare(study)
        run = dataclasses.replace(experiment.run, substeps=finer * experiment.run.substeps)
        return tuple(map(np.asarray, _run_plant(dataclasses.replace(experiment, run=run))))  # type: ignore[return-value]


@eqx.filter_jit
def _run_plant(experiment: Experiment) -> tuple[jax.Array, jax.Array]:
    inputs = jax.vmap(experiment.excitation)(jnp.arange(experiment.run.steps) * experiment.run.sample_period)
    states = plant_trajectory(experiment, experiment.plant.init(experiment.initial), inputs)
    columns = [quantity[side] for side in experiment.sides for quantity in (states.position, states.velocity)]
    return inputs, jnp.stack(columns, axis=1)


def play(model: str, inputs: np.ndarray, period: float) -> np.ndarray:
    """Simulate by MuJoCo: the same columns, under the same inputs (period in s)."""
    compiled = mujoco.MjModel.from_xml_string(model)
    data = mujoco.MjData(compiled)
    mujoco.mj_resetDataKeyframe(compiled, data, 0)
    steps, full_state = round(period / compiled.opt.timestep), mujoco.mjtState.mjSTATE_FULLPHYSICS
    start = np.zeros(mujoco.mj_stateSize(compiled, full_state))
    mujoco.mj_getState(compiled, data, start, full_state)
    held = np.repeat(inputs, steps)[None, :-steps, None]
    states, _ = rollout.rollout(compiled, data, start[None], held)
    # a state begins with the time, then positions and velocities
    sampled = np.vstack([start, states[0, steps - 1 :: steps]])
    joints = [compiled.joint(i).name for i in range(compiled.njnt)]
    columns = [1 + joints.index(side) + k * compiled.nq for side in ("motor", "load") if side in joints for k in (0, 1)]
    return sampled[:, columns]


def difference(columns: np.ndarray, expected: np.ndarray) -> float:
    """Largest over the columns: rms of a difference, over rms of the signal."""
    with np.errstate(invalid="ignore"):
        return float(np.max(np.sqrt(np.mean((columns - expected) ** 2, axis=0) / np.mean(expected**2, axis=0))))


def model_difference(kind: str, config: Config, inputs: np.ndarray, expected: np.ndarray) -> float:
    """Difference of the exported model of a drive from the study's own run, relative as in :func:`difference`."""
    model, _, _ = write_mjcf(config, linear=KINDS[kind][1])
    return difference(play(model, inputs, config.run.sample_period), expected)


def free_runs(kind: str, count: int) -> tuple[list[float], list[float]]:
    """Differences of exported models from the studies' own runs, for `count` drives of a kind with determined motion.

    Also returned are differences of drives that were drawn before them and whose motion is not determined: their own runs
    against those with a quarter of the step.
    If these are large, the motion is chaotic: contacts make large differences of small ones, and no simulator's run is true.
    """
    differences: list[float] = []
    chaotic: list[float] = []
    for seed in range(20 * count):
        if len(differences) == count:
            break
        config = read_config(draw_study(kind, seed))
        inputs, expected = simulate(config)
        step_difference = difference(expected, simulate(config, 4)[1])
        if step_difference < DETERMINED:
            differences.append(model_difference(kind, config, inputs, expected))
        else:
            chaotic.append(step_difference)
    return differences, chaotic


def single_effects() -> Iterator[tuple[str, Study]]:
    """The paper's drive with each effect by itself, swung through its gap."""
    yield "none", _swung([])
    for name, numbers in VALUES.items():
        yield name, _swung([_effect(name, **{key: _plain(value) for key, value in numbers.items()})])


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _swung(effects: list[Study]) -> Study:
    excitation = {"kind": "multisine", "amplitude": 3.0, "frequency": 0.3, "count": 5}
    # a delay of that size is a few samples
    changes = {"run.duration": DURATION, "run.sample_period": 5e-3, "run.substeps": 50}
    return small_study(changes, excitation=excitation, effects=effects)


def main(count: int) -> None:
    """Print the figures."""
    everything: list[float] = []
    for kind in KINDS:
        differences, chaotic = free_runs(kind, count)
        if kind != COARSE:
            everything += differences
        left = f"{len(chaotic)} left out, {min(chaotic):.1e} to {max(chaotic):.1e} from themselves" if chaotic else ""
        print(f"{kind:40} median {np.median(differences):.1e}, worst {max(differences):.1e}; {left}", flush=True)
    print(f"{len(everything)} drives but {COARSE}: median {np.median(everything):.1e}, worst {max(everything):.1e}")
    for name, study in single_effects():
        config = read_config(study)
        model, _, report = write_mjcf(config)
        inputs, expected = simulate(config)
        apart = difference(play(model, inputs, config.run.sample_period), expected)
        print(f"{name:32} {report.get(f'effects.{name}', report['transmission']).fidelity:12} {apart:.1e}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
