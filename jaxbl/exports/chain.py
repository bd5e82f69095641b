"""The chain that runs in real time beside a drive: observers, equivalent control, identifier, as one block."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.config import Config
from jaxbl.drive.parameters import as_arrays, get_leaf, leaf_paths, parameters, set_leaves
from jaxbl.simulate import LONGEST_BLOCK, Experiment, Run, Sample, State, end_block, initial_state, step

from .block import Block, Known, Quantity, traced_block
from .lowering import with_x64

PERIOD = "run.sample_period"
LAST = np.iinfo(np.int32).max
"""Largest index of a sample."""


class _Chain(NamedTuple):
    """State of the chain (of :class:`jaxbl.simulate.State`); the sample's index, which stays at the largest number once it
    has reached it, and how many samples the sums of the identifier have taken in since they were settled."""

    observer: Any
    equivalent_control: Any
    identifier: Any
    samples: Any
    unsettled: Any


def _chain(state: State, samples: Any, unsettled: Any) -> _Chain:
    return _Chain(state.observer, state.equivalent_control, state.identifier, samples, unsettled)


def observer_chain(config: Config, name: str, dtype: np.dtype) -> Block:
    """What `jaxbl.simulate.step` does with a recorded input and measured positions.

    The identifier counts samples from `identifier.start` on; its sums are settled every `LONGEST_BLOCK` samples, as in
    :func:`jaxbl.simulate.replay`.

    Args:
        config: the study.
        name: of the block, a C identifier.
        dtype: of its numbers.
    """
    with with_x64(dtype):
        experiment = as_arrays(config.build(), dtype)
    known = known_numbers(experiment)
    sides = experiment.sides
    positions = [Quantity(f"{side}_position", "rad", f"measured position of the {side}", dtype) for side in sides]
    torque = Quantity("input", "N m", "input torque, held from this sample to the next", dtype)

    def start(numbers: dict[str, Any], given: dict[str, Any]) -> _Chain:
        measured = {side: given[f"{side}_position"] for side in sides}
        zero = jnp.zeros((), jnp.int32)
        return _chain(initial_state(set_leaves(experiment, numbers), measured), zero, zero)

    def sample(numbers: dict[str, Any], state: _Chain, given: dict[str, Any]) -> tuple[_Chain, dict[str, Any]]:
        own = set_leaves(experiment, numbers)
        measured = {side: given[f"{side}_position"] for side in sides}
        time = state.samples.astype(dtype) * own.run.sample_period
        before = State(None, state.observer, state.equivalent_control, state.identifier)
        new, signals = step(own, before, Sample(time, input=given["input"], measured=measured))
        out: dict[str, Any] = {}
        for side in sides:
            one = signals.side(side)
            out |= {
                f"{side}_position_estimate": (one.position_estimate, "rad", f"position of the {side}"),
                f"{side}_velocity_estimate": (one.velocity_estimate, "rad/s", f"velocity of the {side}"),
                f"{side}_equivalent_control": (
                    one.equivalent_control,
                    "rad/s^2",
                    f"acceleration of the {side} beyond the nominal model, filtered",
                ),
                f"{side}_torque_estimate": (one.torque_estimate, "N m", f"transmitted torque by the {side}'s observer"),
            }
        out |= _identified(own, new)
        # sums lose nothing over some hundred samples
        full = state.unsettled >= LONGEST_BLOCK - 1
        settled = jax.lax.cond(full, lambda state: end_block(own, (state, ()))[0], lambda state: state, new)
        samples = jnp.minimum(state.samples, LAST - 1) + 1
        return _chain(settled, samples, jnp.where(full, 0, state.unsettled + 1).astype(jnp.int32)), out

    return traced_block(name, dtype, known, positions, [torque, *positions], start, sample)


def known_numbers(experiment: Experiment) -> dict[str, Known]:
    """Numbers of the study by config path; the sampling period is one, too."""
    about = leaf_paths(experiment)
    about[PERIOD] = next(one for field, one in parameters(Run) if field.name == "sample_period")
    return {path: Known(float(get_leaf(experiment, path)), one.unit, one.doc) for path, one in about.items()}


def _identified(experiment: Experiment, state: State) -> dict[str, tuple[Any, str, str]]:
    """Identified numbers of the transmission law by each side, 0 while nothing determines them, and whether it does."""
    identifier, law = experiment.identifier, experiment.transmission
    if identifier is None or law is None or state.identifier is None:
        return {}
    units = {key.rpartition(".")[2]: one.unit for key, one in leaf_paths(law).items()} | {"half_gap": "rad"}
    out: dict[str, tuple[Any, str, str]] = {}
    solved = identifier.solution(state.identifier)
    for side in experiment.sides:
        determined, theta = solved[side]
        found = law.from_theta(tuple(jnp.where(determined, x, 1.0) for x in theta))
        for value in found.values():
            determined = determined & jnp.isfinite(value)
        out[f"{side}_identified"] = determined, "", f"whether the {side}'s side determines the numbers below"
        for key, value in found.items():
            out[f"{side}_{key}"] = (
                jnp.where(determined, value, 0.0),
                units.get(key, ""),
                f"identified {key} by the {side}'s side",
            )
    return out
