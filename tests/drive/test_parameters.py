"""Numbers as leaves: declared once, found by dotted path, changed without touching their neighbours."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from hypothesis import given, settings, strategies as st

from jaxbl.drive import (
    DRIVES,
    EFFECTS,
    EXCITATIONS,
    TRANSMISSIONS,
    Encoders,
    Plant,
    Rigid,
    SigmoidBacklash,
    TwoInertia,
    as_arrays,
    config_key,
    get_leaf,
    leaf_paths,
    parameters,
    set_leaves,
)
from jaxbl.drive.effects import CoulombFriction, Hardening
from jaxbl.drive.parameters import option, parameter


class Gains(eqx.Module):
    lambda_: float = parameter("rad^½/s", "a Python keyword as key", minimum=0.0)
    order: int = option("fixed at compile time", default=3)


class Whole(eqx.Module):
    plant: Plant
    gains: Gains
    encoders: Encoders


def Study(*effects):
    law = SigmoidBacklash(stiffness=1.0, dead_zone=0.02, slope=20.0)
    drive = TwoInertia(motor_inertia=0.05, motor_viscous=0.15, load_inertia=7.0, load_viscous=16.0, gear_ratio=5.0)
    return Whole(Plant(drive, law, effects), Gains(lambda_=2.0), Encoders())


FRICTION = CoulombFriction(side="load", torque=0.1)
TREE = Study(FRICTION, CoulombFriction(side="motor", torque=0.2), Hardening(cubic_stiffness=3.0))
PATHS = sorted(leaf_paths(TREE))


def test_paths_name_the_numbers_that_an_axis_may_vary():
    assert set(PATHS) == {
        *(f"plant.drive.{key}" for key in ("motor_inertia", "motor_viscous", "load_inertia", "load_viscous", "gear_ratio")),
        *(f"plant.transmission.{key}" for key in ("stiffness", "dead_zone", "slope")),
        "plant.effects.load.coulomb_friction.torque",
        "plant.effects.motor.coulomb_friction.torque",
        "plant.effects.transmission.hardening.cubic_stiffness",
        "gains.lambda",  # neither `lambda_` nor the static `order`
        *(f"encoders.{key}" for key in ("noise", "motor_resolution", "load_resolution")),  # load_noise is None
    }
    assert leaf_paths(TREE)["plant.drive.motor_inertia"].unit == "kg m²"


def test_members_that_share_a_name_go_by_position():
    twice = Study(FRICTION, Hardening(cubic_stiffness=3.0), CoulombFriction(side="load", torque=0.3))
    assert get_leaf(twice, "plant.effects.2.torque") == 0.3
    assert get_leaf(twice, "plant.effects.transmission.hardening.cubic_stiffness") == 3.0
    with pytest.raises(KeyError):
        get_leaf(twice, "plant.effects.load.coulomb_friction.torque")


@settings(deadline=None)
@given(st.dictionaries(st.sampled_from(PATHS), st.floats(allow_nan=False)))
def test_set_leaves_sets_those_and_no_others(values):
    changed = set_leaves(TREE, values)
    assert {path: get_leaf(changed, path) for path in PATHS} == {path: get_leaf(TREE, path) for path in PATHS} | values
    assert jax.tree.structure(changed) == jax.tree.structure(TREE)


@pytest.mark.parametrize("path", ["plant.drive.mass", "gains.gamma", "plant.effects.load.gravity.torque", "plant.effects.9"])
def test_an_unknown_path_is_a_key_error(path):
    with pytest.raises(KeyError, match=path):
        get_leaf(TREE, path)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_as_arrays_casts_numbers_and_leaves_the_rest(dtype):
    tree = as_arrays(TREE, dtype)
    assert {leaf.dtype for leaf in jax.tree.leaves(tree)} == {jnp.dtype(dtype)}
    assert tree.gains.order == 3 and tree.encoders.load_noise is None
    assert as_arrays(jnp.arange(3), dtype).dtype == jnp.arange(3).dtype


def test_a_leaf_with_a_batch_dimension_is_a_grid_axis():
    tree = as_arrays(TREE, jnp.float64)
    inertias = jnp.asarray([0.05, 0.5])
    accelerations = jax.vmap(
        lambda inertia: set_leaves(tree, {"plant.drive.motor_inertia": inertia}).plant.drive.acceleration("motor", 0.0, 1.0)
    )(inertias)
    assert accelerations.tolist() == pytest.approx([20.0, 2.0])


@pytest.mark.parametrize(("field", "key"), [("lambda_", "lambda"), ("torque_", "torque_"), ("slope", "slope")])
def test_keys_of_fields(field, key):
    assert config_key(field) == key


def test_every_number_of_the_package_is_declared_with_a_text():
    modules = {
        *DRIVES.values(),
        *TRANSMISSIONS.values(),
        *EXCITATIONS.values(),
        Encoders,
        *EFFECTS.values(),
    }
    for module in modules:
        declared = {field.name: declaration for field, declaration in parameters(module)}
        numbers = {name for name, kind in module.__annotations__.items() if "Scalar" in str(kind) or kind in (float, int)}
        assert numbers <= set(declared), module
        assert all(declaration.doc for declaration in declared.values()), module
    assert {field.name for field, _ in parameters(Rigid)} == {"motor_inertia", "motor_viscous"}
