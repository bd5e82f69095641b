"""The chain that runs in real time beside a drive: observers, equivalent control, identifier, controller, as one block."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbl.chain import LONGEST_BLOCK, Experiment, Run, Sample, State, end_block, find_missed, initial_state, step
from jaxbl.config import Config
from jaxbl.control import Target
from jaxbl.drive.parameters import as_arrays, get_leaf, leaf_paths, parameters, set_leaves
from jaxbl.errors import InputError

from .block import Block, Outputs, Port, Reference, StudyNumber, Values, trace_block
from .lowering import default_precision

PERIOD = "run.sample_period"
_LARGEST_STEP = 64.0
"""Largest step of a reference, rad: floats there are 4e-6 rad apart, a small part of an encoder's count."""
LAST_SAMPLE = np.iinfo(np.int32).max
"""Largest index of a sample."""


class _ChainState(State):
    """State of the chain without the plant.

    Attributes:
        samples: index of the sample; from the largest integer on, that of the last block again and again.
        missed: count of missed samples by side, up to the largest integer.
    """

    samples: Any
    missed: Any


def build_observer_chain(config: Config, name: str, dtype: np.dtype) -> Block:
    """Trace what `jaxbl.chain.step` does with a recorded input and measured positions; a controller is given its target.

    The identifier counts samples from `identifier.start` on; its sums are compensated every `LONGEST_BLOCK` samples, as in
    :func:`jaxbl.chain.replay`.

    Args:
        config: the study.
        name: of the block, a C identifier.
        dtype: of its numbers.

    Raises:
        InputError: float, and the controller feeds effects forward.
    """
    with default_precision(dtype):
        experiment = as_arrays(config.build(), dtype)
    # code in float knows positions only beside references that move along
    if dtype == np.float32 and getattr(experiment.controller, "effects_feedforward", None) is not None:
        raise InputError("precision: controller.effects_feedforward takes waves at whole angles; use 'double'")
    study_numbers = read_study_numbers(experiment)
    sides = experiment.sides
    positions = [Port(f"{side}_position", "rad", f"measured position of the {side}", dtype) for side in sides]
    torque = Port("input", "N m", "input torque, held from this sample to the next", dtype)
    targets = []
    if experiment.controller is not None:
        units = zip(Target._fields, ("rad", "rad/s", "rad/s^2"), strict=True)
        owner = f"that the {experiment.controller.side} is to have"
        targets = [Port(f"target_{name}", unit, f"{name} {owner}", dtype) for name, unit in units]

    def start(numbers: Values, inputs: Values) -> tuple[_ChainState, Outputs]:
        readings = {side: inputs[f"{side}_position"] for side in sides}
        measured = {side: jnp.where(jnp.isfinite(reading), reading, 0.0) for side, reading in readings.items()}
        zero, lane = jnp.zeros((), jnp.int32), set_leaves(experiment, numbers)
        state = vars(initial_state(lane, measured))
        if lane.controller is not None:
            state |= {"controller": lane.controller.start(measured)}
        return _ChainState(**state, samples=zero, missed=dict.fromkeys(sides, zero)), {}

    def sample(numbers: Values, state: _ChainState, inputs: Values) -> tuple[_ChainState, Outputs]:
        lane = set_leaves(experiment, numbers)
        measured = {side: inputs[f"{side}_position"] for side in sides}
        time = state.samples.astype(dtype) * lane.run.sample_period
        target = Target(*(inputs[port.name] for port in targets)) if targets else None
        new, signals = step(lane, state, Sample(time, input=inputs["input"], measured=measured, target=target))
        out: Outputs = {}
        if new.controller is not None:
            out["controller_torque"] = new.controller.torque, "N m", "input torque from the next sample on"
        missed = find_missed(measured, inputs["input"])
        counts = jax.tree.map(lambda count, more: jnp.minimum(count, LAST_SAMPLE - 1) + more, state.missed, missed)
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
                f"{side}_missed": (missed[side], "", f"whether the {side}'s position or the input is not finite"),
                f"{side}_missed_samples": (counts[side], "", f"count of the {side}'s missed samples"),
            }
        out |= _identified_outputs(lane, new)
        # sums lose nothing over some hundred samples
        full = jax.lax.rem(state.samples, jnp.int32(LONGEST_BLOCK)) == LONGEST_BLOCK - 1
        compensated = jax.lax.cond(full, lambda state: end_block(lane, (state, ()))[0], lambda state: state, new)
        samples = jnp.where(state.samples == LAST_SAMPLE, LAST_SAMPLE - LONGEST_BLOCK, state.samples) + 1
        return _ChainState(**vars(compensated), samples=samples, missed=counts), out

    block = trace_block(name, dtype, study_numbers, positions, [torque, *positions, *targets], start, sample)

    def begin(unit: float) -> Any:
        numbers = {path: jnp.asarray(number.value, dtype) for path, number in study_numbers.items()}
        inputs = {position.name: jnp.asarray(i * unit, dtype) for i, position in enumerate(positions, 1)}
        return np.array([*map(float, jax.tree.leaves(jax.jit(start)(numbers, inputs)))])

    with default_precision(dtype):
        # a state that is a position begins with the first one
        sources = np.rint(begin(1.0) - begin(0.0))
    drive, references = config.build().drive, []
    # a power of two for the last side, and what belongs to it for the others
    shares = [float(drive.ratio(sides[-1])) / float(drive.ratio(side)) for side in sides]
    step_size = 2.0 ** math.floor(math.log2(_LARGEST_STEP / max(shares)))
    for i, (position, share) in enumerate(zip(positions, shares, strict=True), 1):
        states = {state.name for state, source in zip(block.state, sources, strict=True) if source == i}
        inputs = [position.name]
        if experiment.controller is not None and position.name == f"{experiment.controller.side}_position":
            inputs.append(targets[0].name)
        references.append(Reference(inputs, f"{position.name}_reference", states, step_size * share))
    return block._replace(references=references)


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
        # laws divide by the stiffness
        determined = determined & (theta[0] != 0.0)
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
