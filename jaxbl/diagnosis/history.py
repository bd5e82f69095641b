"""How a name was found: every model that was tried, what it gained, and what became of it."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from jaxbl.drive.effects import EFFECTS, Numbers
from jaxbl.json_types import JsonObject


class Step(NamedTuple):
    """A model that was tried.

    Attributes:
        change: what was changed, such as `add motor.cogging`.
        nats: gain in log-evidence on the log, or in log-likelihood where numbers alone differ; None where it was not asked.
        standard_errors: by which the change makes the model better, by blocks of the log; as `nats`.
        accepted: whether the change was made.
        reason: why, in words.
    """

    change: str
    nats: float | None
    standard_errors: float | None
    accepted: bool
    reason: str


def describe_history(history: Sequence[Step]) -> list[JsonObject]:
    """Write the steps as `diagnosis.json` has them."""
    return [dict(zip(("tried", "nats", "standard_errors", "kept", "why"), step, strict=True)) for step in history]


def describe_change(before: Mapping[str, Numbers], after: Mapping[str, Numbers]) -> str:
    """Say which effects one model has that another has not, or numbers that are held by default: `add A`, `remove A`,
    `replace A by B`."""
    common = before.keys() & after.keys()
    parts = [
        {*model, *(f"{name}.{leaf}" for name in common for leaf in EFFECTS[name].list_released(model[name]))}
        for model in (before, after)
    ]
    gone, new = (" and ".join(sorted(a - b)) for a, b in (parts, parts[::-1]))
    if gone and new:
        return f"replace {gone} by {new}"
    return f"add {new}" if new else f"remove {gone}"
