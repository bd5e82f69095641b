"""A number with its uncertainty and its unit, as text, and as an entry of a JSON file."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

from .json_types import JsonObject

_DECIMALS = 5
"""Most decimals, or zeros before the point, that are written out: beyond, an exponent is easier to read."""


@dataclass(frozen=True)
class Quantity:
    """A number with its uncertainty and unit. NaN is a number that is not known; None one that there is not.

    Attributes:
        value: in `unit`, as are all others.
        standard_error: 0 of a number that was not estimated.
        interval: ends of the 95 % interval.
        unit: SI, or that of the log's channel; "" of a ratio.
        nominal: the number before it was estimated.

    Example:
        >>> print(Quantity(0.38512, 0.0043, unit="rad"))
        0.385 ± 0.004 rad
    """

    value: float
    standard_error: float
    interval: Sequence[float] | None = None
    unit: str | None = None
    nominal: float | None = None

    @classmethod
    def read(cls, entry: JsonObject) -> "Quantity":
        """Return the quantity of an entry as :meth:`to_dict` makes it, which may hold more."""
        return cls(**{field.name: _read_number(entry[field.name]) for field in fields(cls) if field.name in entry})

    def to_dict(self) -> JsonObject:
        """Return the entry of a JSON file: attributes by name, but for those that are None."""
        return {name: content for name, content in vars(self).items() if content is not None}

    def ends(self) -> list[float]:
        """Return the ends of the interval; where one is not known, the value itself."""
        return [end if math.isfinite(end) else self.value for end in self.interval or ()]

    @property
    def is_finite(self) -> bool:
        """True if value and standard error are known."""
        return math.isfinite(self.value) and math.isfinite(self.standard_error)

    @property
    def factor(self) -> float:
        """The value over its nominal; NaN without one."""
        return self.value / self.nominal if self.nominal else math.nan

    def __str__(self) -> str:
        """Return value, standard error and unit: of the error the first digit, or two if that is a 1; no error where the
        ends of the interval are not known."""
        # of a fit that is rejected a standard error says nothing
        unknown = bool(self.interval) and all(map(math.isnan, self.interval or ()))
        texts = [f"{self.value:.{3 if unknown else 5}g}"]
        if self.standard_error and self.is_finite and not unknown:
            texts.append(f"{self.standard_error:.2g}")
            place = math.floor(math.log10(self.standard_error))
            decimals = (self.standard_error < 2.0 * 10.0**place) - place
            if abs(decimals) <= _DECIMALS:
                numbers = self.value, self.standard_error
                texts = [f"{round(number, decimals):.{max(decimals, 0)}f}" for number in numbers]
        return f"{' ± '.join(texts)} {self.unit or ''}".rstrip() + ", no interval" * unknown


def _read_number(content: Any) -> Any:
    if isinstance(content, list):
        return tuple(map(_read_number, content))
    return math.nan if content is None else content


def read_quantities(entries: JsonObject) -> dict[str, Quantity]:
    """Return the quantities of entries of a JSON file, by path."""
    return {path: Quantity.read(entry) for path, entry in entries.items()}
