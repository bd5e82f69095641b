"""A model with all effects at neutral numbers moves as the model without them does."""

import jax.numpy as jnp
import numpy as np
import pytest
from small_study import rigid_study, small_study

from jaxbl.chain import plant_trajectory
from jaxbl.config import prepare, read_config
from jaxbl.diagnosis.neutral_effects import bucket, candidates, complete, has_state
from jaxbl.drive.effects import EFFECTS, make_effect
from jaxbl.drive.parameters import as_arrays, parameters
from jaxbl.fused.compilation import jit

NEVER_ADDED = {"actuator.back_emf", "motor.tabulated", "load.tabulated"} | {
    name for name in EFFECTS if name.startswith("encoder.")
}
"""Effects that a diagnosis does not seek: the first acts as viscous friction does, a table is no name, and what an encoder
reads beside the position moves no drive."""
MODEL_EFFECTS = [{"kind": "motor.coulomb_friction", "torque": 0.05}]


def prepare_model(sides):
    data = small_study() if sides == 2 else rigid_study()
    return as_arrays(prepare(read_config({**data, "effects": MODEL_EFFECTS})), float)


@pytest.mark.parametrize("sides", [1, 2])
def test_neutral_effects_do_nothing(sides):
    bare = prepare_model(sides)
    full = complete(bare, candidates(bare))
    torque = jnp.asarray(np.random.default_rng(1).normal(0.0, 2.0, 300))
    runs = []
    for experiment in (bare, full):
        start = experiment.plant.init(experiment.initial)
        runs.append(jit(plant_trajectory)(experiment, start, torque))
    for side in bare.sides:
        assert np.ptp(runs[0].position[side]) > 0.0
        for name in ("position", "velocity"):
            actual, expected = (np.asarray(getattr(experiment, name)[side]) for experiment in (runs[1], runs[0]))
            assert actual == pytest.approx(expected, rel=1e-12, abs=1e-14)


@pytest.mark.parametrize("sides", [1, 2])
def test_all_effects_are_there_once(sides):
    bare = prepare_model(sides)
    lacking = candidates(bare)
    stateful = [name for name in lacking if has_state(name)]
    assert "actuator.lag" in stateful and not has_state("motor.cogging")
    names = [effect.name for effect in complete(bare, lacking).effects]
    assert len(set(names)) == len(names)
    assert set(names) == {*lacking, "motor.coulomb_friction"}
    if sides == 2:
        assert set(names) == set(EFFECTS) - NEVER_ADDED
    # those with a state of their own are there if they act, in the same place as if they had been there from the first
    assert [effect.name for effect in complete(bare).effects] == [name for name in names if name not in stateful]
    assert [effect.name for effect in complete(complete(bare), lacking).effects] == names
    # a second time there is nothing to add
    assert candidates(complete(bare)) == stateful and candidates(complete(bare, lacking)) == []


@pytest.mark.parametrize("name", sorted(set(EFFECTS) - NEVER_ADDED))
def test_every_effect_that_is_sought_has_neutral_numbers(name):
    neutral = EFFECTS[name].neutral()
    assert {field.name for field, _ in parameters(make_effect(name, **neutral))} == set(neutral)


def test_buckets_are_few_and_large_enough():
    sizes = [bucket(count, 1024) for count in range(1, 100_000, 77)]
    assert all(size >= count for size, count in zip(sizes, range(1, 100_000, 77), strict=True))
    assert all(size <= max(1.26 * count, 1024) for size, count in zip(sizes, range(1, 100_000, 77), strict=True))
    assert len(set(sizes)) < 32
    assert all(size % 256 == 0 for size in sizes)
    assert [bucket(count, 8) for count in (1, 9, 11, 13, 17, 21)] == [8, 10, 12, 14, 20, 24]


def test_given_effects_keep_their_order():
    data = small_study()
    saturated = [{"kind": "actuator.saturation", "limit": 4.0}, {"kind": "actuator.gain_error", "relative": 0.1}]
    full = complete(as_arrays(prepare(read_config({**data, "effects": saturated})), float), ["actuator.lag"])
    acting = [effect.name for effect in full.effects if effect.place == "actuator"]
    assert acting == ["actuator.saturation", "actuator.gain_error", "actuator.lag"]
    late = complete(complete(as_arrays(prepare(read_config({**data, "effects": saturated[:1]})), float)), ["actuator.lag"])
    acting = [effect.name for effect in late.effects if effect.place == "actuator"]
    assert acting == ["actuator.gain_error", "actuator.saturation", "actuator.lag"]
