"""The drive as it moves, as one block: plant and integrator of :func:`jaxbl.chain.move_plant`, from sample to sample."""

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxbl.chain import Experiment, move_plant
from jaxbl.config import Config
from jaxbl.drive.parameters import Parameter, as_arrays, get_leaf, leaf_paths, set_leaves
from jaxbl.drive.plant import PlantState
from jaxbl.fused import Unsupported

from .block import Block, Outputs, Port, Program, Values, lower_block, trace_block
from .chain import LAST_SAMPLE, PERIOD, read_study_numbers
from .lowering import default_precision, drop_unread

_INPUT = "u"
_PARTS = "drive.", "transmission.", "effects.", "initial."


class MovingDrive(NamedTuple):
    """State of the drive, and the index of the sample; it stays at the largest integer once it has reached it."""

    plant: PlantState
    samples: Any


class PlantNumber(NamedTuple):
    """A number of the study that the drive's program reads: path, value, what it may be, and whether `step` reads it."""

    path: str
    value: float
    parameter: Parameter
    tunable: bool


class PlantProgram(NamedTuple):
    """The drive as a program whose numbers are given at each call.

    Attributes:
        program: `start` and `step` are given those parameters that they read, `step` the input torque before them.
        parameters: numbers of the study that the program reads, by the name that they have in it.
        outputs: names of the columns of `trace.parquet`, by the names of the outputs.
    """

    program: Program
    parameters: Mapping[str, PlantNumber]
    outputs: Mapping[str, str]


def build_plant_program(config: Config, name: str, dtype: np.dtype) -> PlantProgram:
    """Build the program of a study's drive.

    Outputs are true quantities at the sample that a step leads to, or at t = 0: nothing of them is measured.

    Args:
        config: the study.
        name: of the program, a C identifier.
        dtype: of its numbers.

    Raises:
        Unsupported: a law or effect has an operation that cannot be written as code.
    """
    with default_precision(dtype):
        experiment = as_arrays(config.build(), dtype)
    candidates = {path: parameter for path, parameter in leaf_paths(experiment).items() if path.startswith(_PARTS)}
    # a number that the motion does not read is no parameter: those of encoders
    program = lower_block(_trace_plant(experiment, name, dtype, candidates, candidates))
    start_parameters, step_parameters = (
        {
            path: parameter
            for path, parameter in candidates.items()
            if _make_identifier(path) in {variable.name for variable in drop_unread(routine)[1]}
        }
        for routine in (program.start, program.step)
    )
    # the same operations: none of them reads the others
    program = program._replace(block=_trace_plant(experiment, name, dtype, start_parameters, step_parameters))
    source = config.build()
    return PlantProgram(
        program,
        {
            _make_identifier(path): PlantNumber(path, float(get_leaf(source, path)), parameter, path in step_parameters)
            for path, parameter in candidates.items()
            if path in start_parameters | step_parameters
        },
        {
            parameter.name: re.sub(rf"^({'|'.join(experiment.sides)})_", r"\1.", parameter.name)
            for parameter in program.block.outputs
        },
    )


def _make_identifier(path: str) -> str:
    """Make a name in code of a config path."""
    return re.sub(r"\W", "_", path, flags=re.ASCII)


def _trace_plant(
    experiment: Experiment,
    name: str,
    dtype: np.dtype,
    start_parameters: dict[str, Parameter],
    step_parameters: dict[str, Parameter],
) -> Block:
    """Trace the drive as a block whose `start` and `step` take the numbers at these config paths as arguments."""
    numbers = {path: _make_identifier(path) for path in (start_parameters | step_parameters)}
    if len(set(numbers.values())) < len(numbers):
        raise Unsupported("two numbers that have one name in code")
    start_inputs, step_inputs = (
        [Port(numbers[path], parameter.unit, parameter.doc, dtype) for path, parameter in group.items()]
        for group in (start_parameters, step_parameters)
    )
    unit = experiment.plant.input_unit
    torque = Port(_INPUT, unit, f"input{' torque' * (unit == 'N m')}, held from this sample to the next", dtype)

    def place_numbers(study_values: Values, arguments: Values) -> Experiment:
        return set_leaves(
            experiment, study_values | {path: arguments[name] for path, name in numbers.items() if name in arguments}
        )

    def start(study_values: Values, arguments: Values) -> tuple[MovingDrive, Outputs]:
        placed = place_numbers(study_values, arguments)
        state = MovingDrive(placed.plant.init(placed.initial), jnp.zeros((), jnp.int32))
        return state, _read_outputs(placed, None, state.plant, jnp.zeros((), dtype))

    def step(study_values: Values, state: MovingDrive, arguments: Values) -> tuple[MovingDrive, Outputs]:
        placed = place_numbers(study_values, arguments)
        time = state.samples.astype(dtype) * placed.run.sample_period
        moved = move_plant(placed.plant, placed.run, state.plant, arguments[_INPUT], time)
        samples = jnp.minimum(state.samples, LAST_SAMPLE - 1) + 1
        return MovingDrive(moved, samples), _read_outputs(placed, state.plant, moved, arguments[_INPUT])

    study_numbers = {PERIOD: read_study_numbers(experiment)[PERIOD]}
    return trace_block(name, dtype, study_numbers, start_inputs, [torque, *step_inputs], start, step)


def _read_outputs(experiment: Experiment, before: PlantState | None, state: PlantState, torque: Any) -> Outputs:
    """Value, unit and description: those of :func:`jaxbl.chain.step`, but for means over a sample, which are over the one
    that ends here, and 0 where none has."""
    drive, plant, period = experiment.drive, experiment.plant, experiment.run.sample_period
    out: Outputs = {}
    acceleration = {side: jnp.zeros_like(period) for side in drive.sides}
    if before is not None:
        acceleration = {side: (state.velocity[side] - before.velocity[side]) / period for side in drive.sides}
    for side in drive.sides:
        mean = "mean acceleration over the sample that ends here"
        out |= {
            f"{side}_position": (state.position[side], "rad", f"{side}: position"),
            f"{side}_velocity": (state.velocity[side], "rad/s", f"{side}: velocity"),
            f"{side}_acceleration": (acceleration[side], "rad/s²", f"{side}: {mean}; 0 at the start"),
        }
    if experiment.transmission is not None:
        out["z"] = plant.twist(state.position), "rad", "twist: motor position less gear ratio times load position"
        out["torque"] = (
            plant.transmitted_torque(state.position, state.velocity, state.effects)[0],
            "N m",
            "transmitted torque",
        )
        return out
    torque_description = "what resists beyond the nominal model: mean over the sample that ends here; 0 at the start"
    resisting = jnp.zeros_like(period)
    if before is not None:
        expected = drive.acceleration("motor", before.velocity["motor"], torque)
        resisting = drive.inertia("motor") * (expected - acceleration["motor"])
    out["torque"] = resisting, "N m", torque_description
    return out
