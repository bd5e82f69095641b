"""Physical numbers as leaves: how modules declare them, and how a dotted config path finds them.

Every number of a drive, effect, sensor or observer is declared once, by :func:`parameter`, with its unit, its range
and a line of text. The config validation, the axis labels of the figures and the reference pages are read from there.
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

Scalar = float | Float[Array, ""]
"""A number of a module: a Python float before, a zero-dimensional array after :func:`as_arrays`."""

Tree = TypeVar("Tree")


class Parameter(NamedTuple):
    """What is known of one number: SI unit, description, the range in which it makes sense, and the part that it plays in
    an effect (:class:`jaxbl.drive.effects.Role`)."""

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
    **about: Any,
) -> Any:
    """Declare a number of a module as an `equinox` field.

    Args:
        unit: SI unit as printed on axes; "" where dimensionless.
        doc: one line for the reference.
        default: value where the config gives none; without it the key is required.
        fixed: what is compiled depends on the number, so that an axis over it has one program a value.
        static: the number is no leaf at all.
        kw_only: given by name alone; numbers of classes derived from this one then come first.
        **about: `minimum` (inclusive), `above` (exclusive), `maximum` (inclusive), `role`.
    """
    metadata = {"parameter": Parameter(unit, doc, **about), "fixed": fixed}
    return eqx.field(static=static, default=default, kw_only=kw_only, metadata=metadata)


def option(doc: str, **about: Any) -> Any:
    """Declare a choice that is fixed at compile time (a count, a seed, a name), not a leaf."""
    return parameter("", doc, fixed=True, static=True, **about)


def parameters(module: Any) -> Iterator[tuple[dataclasses.Field, Parameter]]:
    """The declared fields of a module or module class, in order; those given by name alone last."""
    for field in sorted(dataclasses.fields(module), key=lambda field: field.kw_only is True):
        if "parameter" in field.metadata:
            yield field, field.metadata["parameter"]


def config_key(field_name: str) -> str:
    """Config key of a field: `lambda_` is a Python name for `lambda`."""
    return field_name[:-1] if field_name.endswith("_") and keyword.iskeyword(field_name[:-1]) else field_name


def leaf_paths(tree: Any, prefix: str = "") -> dict[str, Parameter]:
    """Dotted paths of all numeric leaves that an axis may vary, e.g. `observer.motor.alpha`.

    A member of a tuple is named by its `name` attribute (effects: `effects.load.coulomb_friction.torque`), or by its
    position where two members share a name. Leaves that are `None` or static are left out.
    """
    found: dict[str, Parameter] = {}
    for field in dataclasses.fields(tree):
        value, path, known = getattr(tree, field.name), f"{prefix}{config_key(field.name)}", field.metadata
        parts = {f"{path}.{key}": one for key, one in _members(value).items()} if isinstance(value, tuple) else {path: value}
        for path, part in parts.items():
            if dataclasses.is_dataclass(part):
                found |= leaf_paths(part, f"{path}.")
            elif part is not None and "parameter" in known and not known["fixed"]:
                found[path] = known["parameter"]
    return found


def _members(values: tuple) -> dict[str, Any]:
    names = [getattr(value, "name", str(i)) for i, value in enumerate(values)]
    return {
        name if names.count(name) == 1 else str(i): value for i, (name, value) in enumerate(zip(names, values, strict=True))
    }


def get_leaf(tree: Any, path: str) -> Any:
    """The leaf that a dotted path names. Raises `KeyError` where there is none."""
    keys = path.split(".")
    while keys:
        if isinstance(tree, tuple):
            members = _members(tree)
            # a member's own name may hold dots (`load.coulomb_friction`)
            for count in range(1, len(keys) + 1):
                if (name := ".".join(keys[:count])) in members:
                    tree, keys = members[name], keys[count:]
                    break
            else:
                raise KeyError(path)
        else:
            name = f"{keys[0]}_" if keyword.iskeyword(keys[0]) else keys[0]
            if not hasattr(tree, name):
                raise KeyError(path)
            tree, keys = getattr(tree, name), keys[1:]
    return tree


def set_leaves(tree: Tree, values: Mapping[str, Any]) -> Tree:
    """A copy of `tree` in which the leaves named by dotted paths have new values. Raises `KeyError` where there is none."""
    by_member: dict[str, dict[str, Any]] = {}
    members = _members(tree) if isinstance(tree, tuple) else None
    for path, value in values.items():
        if members is None:
            key, _, rest = path.partition(".")
            key = f"{key}_" if keyword.iskeyword(key) else key
            if not hasattr(tree, key):
                raise KeyError(path)
        else:
            # a member's own name may hold dots (`load.coulomb_friction`)
            keys = path.split(".")
            splits = ((".".join(keys[:count]), ".".join(keys[count:])) for count in range(1, len(keys) + 1))
            key, rest = next((one for one in splits if one[0] in members), ("", ""))
            if not key:
                raise KeyError(path)
        by_member.setdefault(key, {})[rest] = value
    if not by_member:
        return tree

    def new(old: Any, inside: Mapping[str, Any]) -> Any:
        return inside[""] if "" in inside else set_leaves(old, inside)

    if members is None:
        changed = {key: new(getattr(tree, key), inside) for key, inside in by_member.items()}
        return dataclasses.replace(tree, **changed)  # type: ignore[type-var]
    return tuple(new(old, by_member[key]) if key in by_member else old for key, old in members.items())  # type: ignore[return-value]


def as_arrays(tree: Tree, dtype: Any) -> Tree:
    """Cast every inexact leaf to `dtype`, so that one compiled program serves all values."""

    def cast(leaf: Any) -> Any:
        if isinstance(leaf, float) or (eqx.is_array(leaf) and jnp.issubdtype(leaf.dtype, jnp.inexact)):
            # of a number known here `jnp.asarray` makes a program
            known = isinstance(leaf, float | np.ndarray | np.generic)
            return jax.device_put(np.asarray(leaf, dtype)) if known else jnp.asarray(leaf, dtype)
        return leaf

    return jax.tree.map(cast, tree)
