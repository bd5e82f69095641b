"""Loops for one plant do what the scan and `jax.jvp` do, with all effects."""

import gc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from effect_values import VALUES

from jaxbl.chain import Experiment, Run, move_plant, plant_trajectory
from jaxbl.drive import LinearShaft, Rigid, SigmoidBacklash, TwoInertia, as_arrays, leaf_paths, set_leaves
from jaxbl.drive.effects import SideEffect, make_effect
from jaxbl.drive.excitation import Recorded, Sine
from jaxbl.fused import single_plant as module
from jaxbl.fused.compiled_loop import ScannedLoop
from jaxbl.fused.llvm import Loop
from jaxbl.fused.single_plant import Direction, simulate_plant, step_derivatives

STEPS = 250
OTHER_EFFECTS = ["transmission.backlash", "motor.stribeck_friction", "load.quadratic_drag"]


def make_experiment(names, rigid=False, substeps=1, extra=()):
    drive = Rigid(0.02, 0.03) if rigid else TwoInertia(0.05, 0.15, 7.0, 16.0, 5.0)
    effects = (*(make_effect(name, **VALUES[name]) for name in names), *extra)
    law = LinearShaft(60.0) if "transmission.backlash" in names else SigmoidBacklash(1.0, 0.02, 20.0)
    result = Experiment(
        drive=drive,
        transmission=None if rigid else law,
        effects=effects,
        excitation=Sine(1.0, 1.0),
        observer=None,
        run=Run(1e-3, STEPS, substeps),
    )
    return as_arrays(result, np.float64)


MODELS = {
    "most": lambda: make_experiment([name for name in VALUES if name not in OTHER_EFFECTS], substeps=5),
    "others": lambda: make_experiment(OTHER_EFFECTS),
    "rigid": lambda: make_experiment(
        ["motor.presliding_friction", "motor.cogging", "motor.inertia", "actuator.lag"], rigid=True
    ),
}


def draw_inputs(model):
    rng = np.random.default_rng(1)
    torque = 2.0 + np.cumsum(rng.normal(0.0, 0.1, STEPS))
    start = eqx.tree_at(lambda s: s.velocity, model.plant.init(model.initial), dict.fromkeys(model.sides, jnp.asarray(0.3)))
    return start, torque, rng


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64():
        yield


@pytest.mark.parametrize(("name", "observed"), [("most", True), ("others", False), ("rigid", True)])
def test_the_path_is_that_of_the_scan(name, observed):
    model = MODELS[name]()
    start, torque, rng = draw_inputs(model)
    more = {}
    if observed:
        measured = {side: 0.05 * np.cumsum(rng.normal(0.0, 0.01, STEPS)) for side in model.sides}
        more = {"measured": measured, "gain": {side: np.array([0.3, 20.0 + i]) for i, side in enumerate(model.sides)}}
    expected = eqx.filter_jit(plant_trajectory)(model, start, jnp.asarray(torque), 0.7, **jax.tree.map(jnp.asarray, more))
    structure, observed_sides = module._PlantStructure.of(model, start), tuple(sorted(more.get("gain", ())))
    assert isinstance(module._trajectory_loop(structure, observed_sides), Loop)
    plant = simulate_plant(model, start, torque, 0.7, **more)
    assert jax.tree.structure(plant) == jax.tree.structure(expected)
    for computed, reference in zip(jax.tree.leaves(plant), jax.tree.leaves(expected), strict=True):
        assert computed.shape == (STEPS,)
        assert np.ptp(reference) > 0.0
        assert computed == pytest.approx(np.asarray(reference), rel=1e-9, abs=1e-10)


def list_directions(model, start):
    """Each state, the input, each number of the plant."""
    result = [Direction(state=row) for row in np.eye(len(jax.tree.leaves(start))).tolist()]
    result.append(Direction(torque=1.0))
    numbers = [path for path in leaf_paths(model) if path.split(".")[0] in ("drive", "transmission", "effects")]
    return result + [Direction({path: 1.0}) for path in numbers]


@pytest.mark.parametrize("name", MODELS)
def test_slopes_are_those_of_differences(name):
    """Central ones of the step itself; where a step has a kink between the two, they differ."""
    model = MODELS[name]()
    start, torque, _ = draw_inputs(model)
    time = 1e-3 * np.arange(STEPS)
    states = simulate_plant(model, start, torque)
    tangents = list_directions(model, start)
    assert isinstance(module._derivatives_loop(module._PlantStructure.of(model, start)), Loop)
    changes, new = step_derivatives(model, states, torque, time, tangents)
    assert changes.shape == (len(tangents), len(jax.tree.leaves(start)), STEPS)

    def expand_direction(tangent):
        """A direction as changes of all numbers."""
        zeros, shape = jax.tree.map(lambda _: 0.0, model), jax.tree.structure(start)
        return set_leaves(zeros, tangent.numbers), shape.unflatten(tangent.state or [0.0] * shape.num_leaves), tangent.torque

    @jax.jit
    @jax.vmap
    def move_samples(tangent, steps):
        changed, *arguments = jax.tree.map(lambda x, c: x + steps * c, (model, states, torque), tangent)
        return jnp.stack(jax.tree.leaves(jax.vmap(lambda *x: move_plant(changed.plant, changed.run, *x))(*arguments, time)))

    numbers, tree = jax.tree.leaves((model, states, torque)), [expand_direction(tangent) for tangent in tangents]
    # of the size of the number itself
    sizes = [np.max(np.abs(numbers[jax.tree.leaves(tangent).index(1.0)])) + 1e-3 for tangent in tree]
    steps, tree = 3e-5 * np.array(sizes), jax.tree.map(lambda *x: np.array(x, float), *tree)
    expected = (move_samples(tree, steps) - move_samples(tree, -steps)) / (2.0 * steps[:, None, None])
    error = np.abs(changes - expected) / (np.max(np.abs(expected), axis=(1, 2), keepdims=True) + 1e-9)
    assert (np.median(error, axis=(1, 2)) < 1e-6).all()
    assert (np.mean(error > 1e-3, axis=(1, 2)) < 0.02).all()
    # the saturation is not reached everywhere
    assert np.count_nonzero(np.any(expected, axis=(1, 2))) >= len(tangents) - 1
    assert new == pytest.approx(np.asarray(move_samples(tree, 0.0 * steps)[0]), rel=1e-10, abs=1e-12)


class _Tabled(SideEffect):
    kind = "tabled"
    table: jax.Array

    def resist(self, state, motion):
        return self.table[jnp.clip(jnp.floor(motion.time * 100.0).astype(int), 0, len(self.table) - 1)]


def test_what_a_loop_cannot_do_is_left_to_the_scan():
    model = make_experiment(["motor.viscous_friction"], extra=(_Tabled(side="motor", table=jnp.linspace(0.0, 1.0, 30)),))
    start, torque, _ = draw_inputs(model)
    plant = module._PlantStructure.of(model, start)
    assert isinstance(module._trajectory_loop(plant, ()), ScannedLoop)
    assert isinstance(module._derivatives_loop(plant), ScannedLoop)
    expected = eqx.filter_jit(plant_trajectory)(model, start, jnp.asarray(torque))
    actual = simulate_plant(model, start, torque)
    for side in model.sides:
        assert actual.position[side] == pytest.approx(np.asarray(expected.position[side]), rel=1e-12)
    changes, new = step_derivatives(model, actual, torque, 1e-3 * np.arange(STEPS), [Direction(torque=1.0)])
    assert changes.shape == (1, 4, STEPS)
    inertia = float(model.drive.motor_inertia)
    motor = sorted(model.sides).index("motor") + 2
    assert changes[0, motor] == pytest.approx(1e-3 / inertia, rel=0.05)
    assert new[motor, :-1] == pytest.approx(actual.velocity["motor"][1:], rel=1e-10)


def test_tables_that_no_step_reads_are_no_obstacle():
    """A recorded excitation is part of the experiment, and the input is given."""
    model = make_experiment(["motor.viscous_friction"])
    start, torque, _ = draw_inputs(model)
    recorded = as_arrays(Recorded(np.arange(3.0), np.arange(3.0)), np.float64)
    other = eqx.tree_at(lambda e: e.excitation, model, recorded)
    assert isinstance(module._trajectory_loop(module._PlantStructure.of(other, start), ()), Loop)
    assert isinstance(module._derivatives_loop(module._PlantStructure.of(other, start)), Loop)
    expected, plant = simulate_plant(model, start, torque), simulate_plant(other, start, torque)
    assert np.array_equal(plant.position["motor"], expected.position["motor"])
    tangents = [list_directions(e, start)[:6] for e in (model, other)]
    pair = [
        step_derivatives(e, expected, torque, 1e-3 * np.arange(STEPS), tangent)[0]
        for e, tangent in zip((model, other), tangents, strict=True)
    ]
    assert np.array_equal(*pair)


def test_columns_of_other_lengths_are_refused():
    model = make_experiment([])
    start, torque, _ = draw_inputs(model)
    states = simulate_plant(model, start, torque)
    with pytest.raises(ValueError, match="must have the same shape"):
        step_derivatives(model, states, torque[:-1], 1e-3 * np.arange(STEPS - 1), list_directions(model, start))
    gain = dict.fromkeys(model.sides, np.array([0.3, 20.0]))
    with pytest.raises(ValueError, match="sample_inputs of a loop: 250 contiguous numbers"):
        simulate_plant(model, start, torque, 0.0, dict.fromkeys(model.sides, torque[:-5]), gain)


def test_other_numbers_need_no_other_loop_and_loops_come_and_go():
    model = make_experiment(["motor.viscous_friction"], rigid=True)
    start, torque, _ = draw_inputs(model)
    runs = []
    for inertia in (0.02, 0.04):
        other = set_leaves(model, {"drive.motor_inertia": jnp.asarray(inertia)})
        before = module._trajectory_loop.cache_info().misses
        runs.append(simulate_plant(other, start, torque).position["motor"])
    assert module._trajectory_loop.cache_info().misses == before
    assert np.ptp(runs[0] - runs[1]) > 0.0
    # made, used and dropped many times in one process
    for _ in range(2):
        module._trajectory_loop.cache_clear()
        gc.collect()
        assert np.array_equal(simulate_plant(model, start, torque).position["motor"], runs[0])
