"""Physical numbers as leaves of a tree: modules declare them, and dotted config paths find them.

Every number of a drive, effect, encoder or observer is declared once, by :func:`parameter`, with its unit, its range
and a line of text. Validation of a config, axis labels of figures and the reference are made from that.
"""

import dataclasses
import keyword
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

ScalarArray = Float[Array, ""]
Scalar = float | ScalarArray
"""A number of a module: a Python float at first, a zero-dimensional array after :func:`as_arrays`."""

Tree = TypeVar("Tree")


class Parameter(NamedTuple):
    """The declaration of one number.

    Attributes:
        unit: SI unit; "" if dimensionless.
        doc: description, one line.
        minimum, above, maximum: its range: inclusive, exclusive, inclusive.
        role: the part that it plays in an effect (:class:`jaxbl.drive.effects.Role`).
    """

    unit: str
    doc: str
    minimum: float | None = None
    above: float | None = None
    maximum: float | None = None
    role: Any = None


def parameter(
    unit: str,
    doc: str,
    *,
    default: Any = dataclasses.MISSING,
    fixed: bool = False,
    static: bool = False,
    kw_only: bool = False,
    **limits: Any,
) -> Any:
    """Declare a number of a module as an `equinox` field.

    Args:
        unit: SI unit as printed on axes; "" if dimensionless.
        doc: one line for the reference.
        default: used if the config lacks the key; without a default the key is required.
        fixed: the compiled program depends on the number, so that an axis over it has one program a value.
        static: the number is no leaf.
        kw_only: passed by name only; numbers of derived classes then come first.
        **limits: `minimum` (inclusive), `above` (exclusive), `maximum` (inclusive), `role`.

    Example:
        >>> class Damper(eqx.Module):
        ...     damping: Scalar = parameter("N m s/rad", "damping D", minimum=0.0)
    """
    metadata = {"parameter": Parameter(unit, doc, **limits), "fixed": fixed}
    return eqx.field(static=static, default=default, kw_only=kw_only, metadata=metadata)


def option(doc: str, **limits: Any) -> Any:
    """Declare a choice that is fixed at compile time (a count, a seed, a name) and no leaf; arguments as of
    :func:`parameter`."""
    return parameter("", doc, fixed=True, static=True, **limits)


def parameters(module: Any) -> Iterator[tuple[dataclasses.Field, Parameter]]:
    """Yield the declared fields of a module or its class with their declarations; fields passed by name only come last."""
    for field in sorted(dataclasses.fields(module), key=lambda field: field.kw_only is True):
        if "parameter" in field.metadata:
            yield field, field.metadata["parameter"]


def config_key(field_name: str) -> str:
    """Return the config key of a field: `lambda` for `lambda_`, as the Python keyword cannot name a field."""
    return field_name[:-1] if field_name.endswith("_") and keyword.iskeyword(field_name[:-1]) else field_name


def units_of(module: Any) -> dict[str, str]:
    """Units of the numbers of a module or of its class, by name."""
    return {field.name: declaration.unit for field, declaration in parameters(module)}


def leaf_paths(tree: Any, prefix: str = "") -> dict[str, Parameter]:
    """Find the dotted paths of all numbers that an axis may vary, e.g. `observer.motor.alpha`, with their declarations.

    A member of a tuple is named by its `name` attribute (effects: `effects.load.coulomb_friction.torque`), or by its
    position if two members share a name. Leaves that are `None`, fixed or static are left out.
    """
    paths: dict[str, Parameter] = {}
    for field in dataclasses.fields(tree):
        path, branch = f"{prefix}{config_key(field.name)}", getattr(tree, field.name)
        branches = {path: branch}
        if isinstance(branch, tuple):
            branches = {f"{path}.{name}": member for name, member in _members_by_name(branch).items()}
        for path, branch in branches.items():
            if dataclasses.is_dataclass(branch):
                paths |= leaf_paths(branch, f"{path}.")
            elif branch is not None and "parameter" in field.metadata and not field.metadata["fixed"]:
                paths[path] = field.metadata["parameter"]
    return paths


def _members_by_name(members: tuple) -> dict[str, Any]:
    names = [getattr(member, "name", str(i)) for i, member in enumerate(members)]
    return {name if names.count(name) == 1 else str(i): members[i] for i, name in enumerate(names)}


def _first_member(tree: Any, path: str) -> tuple[str, Any, str]:
    """Return the member that a dotted path begins with, after its name, and the path within it. Raises `KeyError`."""
    if isinstance(tree, tuple):
        members, keys = _members_by_name(tree), path.split(".")
        # the name of a member may have dots (`load.coulomb_friction`)
        for count in range(1, len(keys) + 1):
            if (name := ".".join(keys[:count])) in members:
                return name, members[name], ".".join(keys[count:])
    else:
        name, _, subpath = path.partition(".")
        name = f"{name}_" if keyword.iskeyword(name) else name
        if hasattr(tree, name):
            return name, getattr(tree, name), subpath
    raise KeyError(path)


def get_leaf(tree: Any, path: str) -> Any:
    """Return the leaf at a dotted path. Raises `KeyError` if there is none."""
    remaining = path
    while remaining:
        try:
            _, tree, remaining = _first_member(tree, remaining)
        except KeyError:
            raise KeyError(path) from None
    return tree


def set_leaves(tree: Tree, values: Mapping[str, Any]) -> Tree:
    """Return a copy of `tree` with new values at some dotted paths. Raises `KeyError` for a path without a leaf.

    Example:
        >>> stiffer = set_leaves(experiment, {"transmission.stiffness": 2.0, "observer.motor.alpha": 30.0})
    """
    members: dict[str, Any] = {}
    by_member: dict[str, dict[str, Any]] = {}
    for path, value in values.items():
        name, member, subpath = _first_member(tree, path)
        members[name] = member
        by_member.setdefault(name, {})[subpath] = value
    if not by_member:
        return tree
    changed = {name: new[""] if "" in new else set_leaves(members[name], new) for name, new in by_member.items()}
    if isinstance(tree, tuple):
        return tuple((_members_by_name(tree) | changed).values())  # type: ignore[return-value]
    return dataclasses.replace(tree, **changed)  # type: ignore[type-var]


def as_arrays(tree: Tree, dtype: Any) -> Tree:
    """Cast every floating-point leaf to an array of `dtype`, so that one compiled program serves all values."""

    def cast(leaf: Any) -> Any:
        if isinstance(leaf, float) or (eqx.is_array(leaf) and jnp.issubdtype(leaf.dtype, jnp.inexact)):
            # `jnp.asarray` would compile a program for a number that is no JAX array yet
            on_host = isinstance(leaf, float | np.ndarray | np.generic)
            return jax.device_put(np.asarray(leaf, dtype)) if on_host else jnp.asarray(leaf, dtype)
        return leaf

    return jax.tree.map(cast, tree)
