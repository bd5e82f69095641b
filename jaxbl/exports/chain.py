"""The chain that runs in real time beside a drive: observers, equivalent control, identifier, as one block."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.config import Config
from jaxbl.drive.parameters import as_arrays, get_leaf, leaf_paths, parameters, set_leaves
from jaxbl.simulate import LONGEST_BLOCK, Experiment, Run, Sample, State, end_block, initial_state, step

from .block import Block, Outputs, Port, StudyNumber, Values, trace_block
from .lowering import default_precision

PERIOD = "run.sample_period"
LAST_SAMPLE = np.iinfo(np.int32).max
"""Largest index of a sample."""


class _ChainState(NamedTuple):
    """State of the chain.

    Attributes:
        observer, equivalent_control, identifier: as in :class:`jaxbl.simulate.State`.
        samples: index of the sample; it stays at the largest integer once it has reached it.
        unsettled: samples since the identifier's sums were compensated last.
    """

    observer: Any
    equivalent_control: Any
    identifier: Any
    samples: Any
    unsettled: Any


def _make_chain_state(state: State, samples: Any, unsettled: Any) -> _ChainState:
    return _ChainState(state.observer, state.equivalent_control, state.identifier, samples, unsettled)


def build_observer_chain(config: Config, name: str, dtype: np.dtype) -> Block:
    """Trace what `jaxbl.simulate.step` does with a recorded input and measured positions.

    The identifier counts samples from `identifier.start` on; its sums are compensated every `LONGEST_BLOCK` samples, as in
    :func:`jaxbl.simulate.replay`.

    Args:
        config: the study.
        name: of the block, a C identifier.
        dtype: of its numbers.
    """
    with default_precision(dtype):
        experiment = as_arrays(config.build(), dtype)
    study_numbers = read_study_numbers(experiment)
    sides = experiment.sides
    positions = [Port(f"{side}_position", "rad", f"measured position of the {side}", dtype) for side in sides]
    torque = Port("input", "N m", "input torque, held from this sample to the next", dtype)

    def start(numbers: Values, inputs: Values) -> _ChainState:
        measured = {side: inputs[f"{side}_position"] for side in sides}
        zero = jnp.zeros((), jnp.int32)
        return _make_chain_state(initial_state(set_leaves(experiment, numbers), measured), zero, zero)

    def sample(numbers: Values, state: _ChainState, inputs: Values) -> tuple[_ChainState, Outputs]:
        lane = set_leaves(experiment, numbers)
        measured = {side: inputs[f"{side}_position"] for side in sides}
        time = state.samples.astype(dtype) * lane.run.sample_period
        before = State(None, state.observer, state.equivalent_control, state.identifier)
        new, signals = step(lane, before, Sample(time, input=inputs["input"], measured=measured))
        out: Outputs = {}
        for side in sides:
            estimates = signals.side(side)
            out |= {
                f"{side}_position_estimate": (estimates.position_estimate, "rad", f"position of the {side}"),
                f"{side}_velocity_estimate": (estimates.velocity_estimate, "rad/s", f"velocity of the {side}"),
                f"{side}_equivalent_control": (
                    estimates.equivalent_control,
                    "rad/s^2",
                    f"acceleration of the {side} beyond the nominal model, filtered",
                ),
                f"{side}_torque_estimate": (
                    estimates.torque_estimate,
                    "N m",
                    f"transmitted torque by the {side}'s observer",
                ),
            }
        out |= _identified_outputs(lane, new)
        # sums lose nothing over some hundred samples
        full = state.unsettled >= LONGEST_BLOCK - 1
        compensated = jax.lax.cond(full, lambda state: end_block(lane, (state, ()))[0], lambda state: state, new)
        samples = jnp.minimum(state.samples, LAST_SAMPLE - 1) + 1
        return _make_chain_state(compensated, samples, jnp.where(full, 0, state.unsettled + 1).astype(jnp.int32)), out

    return trace_block(name, dtype, study_numbers, positions, [torque, *positions], start, sample)


def read_study_numbers(experiment: Experiment) -> dict[str, StudyNumber]:
    """Read all numbers of the study by config path, the sampling period among them."""
    leaves = leaf_paths(experiment)
    leaves[PERIOD] = next(parameter for field, parameter in parameters(Run) if field.name == "sample_period")
    return {
        path: StudyNumber(float(get_leaf(experiment, path)), parameter.unit, parameter.doc)
        for path, parameter in leaves.items()
    }


def _identified_outputs(experiment: Experiment, state: State) -> Outputs:
    """Return what each side identifies of the law (0 while it is not determined), and whether it is determined."""
    identifier, law = experiment.identifier, experiment.transmission
    if identifier is None or law is None or state.identifier is None:
        return {}
    units = {key.rpartition(".")[2]: parameter.unit for key, parameter in leaf_paths(law).items()} | {"half_gap": "rad"}
    out: Outputs = {}
    solutions = identifier.solution(state.identifier)
    for side in experiment.sides:
        determined, theta = solutions[side]
        law_numbers = law.from_theta(tuple(jnp.where(determined, x, 1.0) for x in theta))
        for value in law_numbers.values():
            determined = determined & jnp.isfinite(value)
        out[f"{side}_identified"] = determined, "", f"whether the {side}'s side determines the numbers below"
        for key, value in law_numbers.items():
            out[f"{side}_{key}"] = (
                jnp.where(determined, value, 0.0),
                units.get(key, ""),
                f"identified {key} by the {side}'s side",
            )
    return out
