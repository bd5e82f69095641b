"""The numbers that decide what `jaxbl diagnose` names and says; what else is a constant sets how thoroughly it looks."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager

from jaxbl.drive.parameters import parameter


@dataclasses.dataclass(frozen=True)
class Thresholds:
    """States each of them with its unit, its meaning and its reason."""

    difference: float = parameter(
        "standard errors",
        "by which a single channel shows a difference: what a stepwise regression by blocks asks",
        default=1.0,
    )
    sure: float = parameter("standard errors", "that count as a difference between two models: 2 % by chance", default=2.0)
    noise_structure: float = parameter(
        "nats a sample", "that structure in the noise may bring, such as quantisation: 1.2 % of its variance", default=0.006
    )
    effect_odds: float = parameter(
        "nats", "log prior odds of each effect to be missing: a probability of 0.12, of some twenty effects two or three",
        default=-2.0,
    )  # fmt: skip
    general_odds: float = parameter(
        "nats",
        "the same of a finer law over the plain one, as of Stribeck friction over Coulomb: one to twenty",
        default=-3.0,
    )
    effect_size: float = parameter(
        "driving torque", "prior size of an effect: a good part of the torque that drives the machine", default=0.3
    )
    number_error: float = parameter(
        "nominal value",
        "prior size of the error of a number that is further off than stated: nominal ones are right within a factor of two",
        default=0.5,
    )
    least_torque: float = parameter(
        "driving torque",
        "of an effect that is named: drives know their current, and so their torque, to half a percent at best",
        default=5e-3,
    )
    slow_torque: float = parameter(
        "driving torque",
        "that slow torques may leave: smoothing rounds jumps of friction on the other side of a spring, which leaves up to "
        "0.016 beside complete models of generated drives",
        default=0.02,
    )
    unknown: float = parameter(
        "nats", "that a free function gains where something unknown is missing: far beyond quantisation and time stepping",
        default=100.0,
    )  # fmt: skip
    far: float = parameter(
        "standard deviations",
        "of its prior, beyond which a number of the model hardly lies, and from which on blocks show an effect beyond "
        "doubt: one in a million",
        default=5.0,
    )
    failing: float = parameter(
        "probability", "that a complete model fails the test on held-out data, in any channel", default=0.01
    )
    least_explained: float = parameter(
        "missing torque", "that an explanation takes away: with less it passes only as its numbers are open", default=0.5
    )
    significant: float = parameter(
        "standard deviations", "from which on a torque is beyond noise: several hundred regions are looked at", default=4.5
    )
    contradicting: float = parameter(
        "standard errors", "by which two logs contradict each other: of pairs with errors by twelve blocks one in a hundred",
        default=6.0,
    )  # fmt: skip


LIMITS = Thresholds()
"""Those that hold."""


@contextmanager
def use_thresholds(**changes: float) -> Iterator[None]:
    """Change some of :data:`LIMITS` within a `with` block, for research: all threads of the process see them.

    Example:
        >>> with use_thresholds(sure=2.6):
        ...     LIMITS.sure
        2.6
    """
    before = dataclasses.asdict(LIMITS)
    dataclasses.replace(LIMITS, **changes)  # refuses what there is not
    try:
        vars(LIMITS).update(changes)
        yield
    finally:
        vars(LIMITS).update(before)
