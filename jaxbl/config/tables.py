"""Tables of a study: strict TOML tables, generated from the modules that compute with what they hold.

A key, its unit and its range are so written once, in the module.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Union

from pydantic import Field, TypeAdapter, WrapValidator, create_model

from jaxbl.drive.parameters import config_key, parameters
from jaxbl.validation import Positive, StrictTable, table_error


class Table(StrictTable):
    """A table that may build what it describes."""

    factory: ClassVar[Callable[..., Any]]
    """What the table builds (generated tables)."""

    if TYPE_CHECKING:
        # keys of generated tables
        def __getattr__(self, name: str) -> Any: ...

    def build(self) -> Any:
        """The module that a generated table stands for."""
        values = ((name, getattr(self, name)) for name in type(self).model_fields if name not in ("kind", "law"))
        # of the class: an instance would bind a partial function from Python 3.14 on
        return type(self).factory(
            **{name: tuple(element) if isinstance(element, list) else element for name, element in values}
        )


def declare_key(doc: str, default: Any = ..., *, unit: str = "", **rules: Any) -> Any:
    """Declare a key of a table.

    Args:
        doc: what it means, one line.
        default: its value where a study lacks it; left out, the key is required.
        unit: SI unit; "" if it has none.
        **rules: those of pydantic's `Field`: `gt`, `ge`, `le`, `max_length`, `alias`, ...
    """
    return Field(default, description=doc, json_schema_extra={"unit": unit}, **rules)


def check_distinct(values: Sequence[Any], message: str) -> None:
    """Refuse a value that is listed twice by a `message` with its position `{i}` and the `{value}`."""
    for i, value in enumerate(values):
        if value in values[:i]:
            raise table_error(message.format(i=i, value=value))


def table_for(module: type, factory: Callable[..., Any] | None = None, base: type[Table] = Table, **tag: str) -> type[Table]:
    """Generate the config table of a module class from its declared parameters (:mod:`jaxbl.drive.parameters`).

    The table builds the class, or what `factory` makes of its numbers. It has further keys from `base`, and one with a
    single value that tells it from others (`kind="sine"`).
    """
    fields: dict[str, Any] = {key: (Literal[value], ...) for key, value in tag.items()}
    for field, parameter in parameters(module):
        # lists of numbers are empty by default
        number = Positive if parameter.above == 0.0 else float
        kind: Any = field.type if field.metadata.get("static") else list[float] if field.default == () else number
        fields[field.name] = (
            kind | None if field.default is None else kind,
            declare_key(
                parameter.doc,
                ... if field.default is dataclasses.MISSING else [] if field.default == () else field.default,
                unit=parameter.unit,
                alias=config_key(field.name),
                ge=parameter.minimum,
                gt=parameter.above,
                le=parameter.maximum,
            ),
        )
    model = create_model(module.__name__, __base__=base, __doc__=module.__doc__, **fields)
    model.factory = factory or module
    return model


def tagged_union(
    members: Mapping[str, type],
    make_table: Callable[[str, type], type[Table]] = lambda kind, cls: table_for(cls, kind=kind),
    key: str = "kind",
) -> Any:
    """The type of a table that is one of several, told apart by the value of a key (`kind`, `law`).

    Members that are registered later (:func:`jaxbl.register`) are taken as well.
    """
    make_table = functools.cache(make_table)

    def combine() -> Any:
        tables = tuple(make_table(name, cls) for name, cls in members.items())
        return Annotated[Union[tables], Field(discriminator=key)]  # noqa: UP007

    @functools.lru_cache(1)
    def adapt(_: tuple[type, ...]) -> TypeAdapter[Any]:
        return TypeAdapter(combine())

    tables = tuple(members.values())

    def validate(table: Any, validate_known: Callable[[Any], Any]) -> Any:
        now = tuple(members.values())
        return validate_known(table) if now == tables else adapt(now).validate_python(table)

    return Annotated[combine(), WrapValidator(validate)]
