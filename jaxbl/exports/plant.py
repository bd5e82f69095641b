"""The drive as it moves, as one block: plant and integrator of :func:`jaxbl.simulate.move_plant`, from sample to sample."""

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxbl.config import Config
from jaxbl.drive.parameters import Parameter, as_arrays, get_leaf, leaf_paths, set_leaves
from jaxbl.drive.plant import PlantState
from jaxbl.fused import Unsupported
from jaxbl.simulate import Experiment, move_plant

from .block import Program, Quantity, program_of, traced_block
from .chain import LAST, PERIOD, known_numbers
from .lowering import read_by, with_x64

_INPUT = "u"
_PARTS = "drive.", "transmission.", "effects.", "initial."


class Moving(NamedTuple):
    """State of the drive, and the sample's index, which stays at the largest number once it has reached it."""

    plant: PlantState
    samples: Any


class PlantProgram(NamedTuple):
    """The drive as a program whose numbers are given at each call.

    Attributes:
        program: `start` and `step` are given those parameters that they read, `step` the input torque before them.
        parameters: numbers of the study that the program reads, by the name that they have in it: their config paths.
        about: the same by config path: value, unit, range, description.
        tunable: config paths of those that `step` reads.
        outputs: names of the columns of `trace.parquet`, by the names of the outputs.
    """

    program: Program
    parameters: Mapping[str, str]
    about: Mapping[str, tuple[float, Parameter]]
    tunable: frozenset[str]
    outputs: Mapping[str, str]


def plant_program(config: Config, name: str, dtype: np.dtype) -> PlantProgram:
    """The drive of a study.

    Outputs are true quantities at the sample that a step leads to, or at t = 0: nothing of them is measured.

    Args:
        config: the study.
        name: of the program, a C identifier.
        dtype: of its numbers.

    Raises:
        Unsupported: some law or effect has an operation that code cannot say.
    """
    with with_x64(dtype):
        experiment = as_arrays(config.build(), dtype)
    about = {path: one for path, one in leaf_paths(experiment).items() if path.startswith(_PARTS)}
    # a number that the motion does not read is no parameter: those of encoders
    every = _traced(experiment, name, dtype, about, about)
    first, later = (
        {path: one for path, one in about.items() if _identifier(path) in {variable.name for variable in read_by(routine)}}
        for routine in (every.start, every.step)
    )
    program = _traced(experiment, name, dtype, first, later)
    source = config.build()
    read = {path: one for path, one in about.items() if path in first or path in later}
    return PlantProgram(
        program,
        {_identifier(path): path for path in read},
        {path: (float(get_leaf(source, path)), one) for path, one in read.items()},
        frozenset(later),
        {one.name: one.name.replace("motor_", "motor.").replace("load_", "load.") for one in program.block.outputs},
    )


def _identifier(path: str) -> str:
    """A name in code for a config path."""
    return re.sub(r"\W", "_", path, flags=re.ASCII)


def _traced(
    experiment: Experiment, name: str, dtype: np.dtype, first: dict[str, Parameter], later: dict[str, Parameter]
) -> Program:
    """The program whose start is given some numbers by config path, and whose step others."""
    numbers = {path: _identifier(path) for path in (first | later)}
    if len(set(numbers.values())) < len(numbers):
        raise Unsupported("two numbers that have one name in code")
    begins, steps = (
        [Quantity(numbers[path], one.unit, one.doc, dtype) for path, one in some.items()] for some in (first, later)
    )
    unit = experiment.plant.input_unit
    torque = Quantity(_INPUT, unit, f"input{' torque' * (unit == 'N m')}, held from this sample to the next", dtype)

    def own(known: dict[str, Any], given: dict[str, Any]) -> Experiment:
        return set_leaves(experiment, known | {path: given[one] for path, one in numbers.items() if one in given})

    def start(known: dict[str, Any], given: dict[str, Any]) -> Moving:
        mine = own(known, given)
        return Moving(mine.plant.init(mine.initial), jnp.zeros((), jnp.int32))

    def begin(known: dict[str, Any], state: Moving, given: dict[str, Any]) -> dict[str, Any]:
        found = _outputs(own(known, given), None, state.plant, jnp.zeros((), dtype))
        return {key: value for key, (value, _, _) in found.items()}

    def step(known: dict[str, Any], state: Moving, given: dict[str, Any]) -> tuple[Moving, dict[str, Any]]:
        mine = own(known, given)
        time = state.samples.astype(dtype) * mine.run.sample_period
        moved = move_plant(mine.plant, mine.run, state.plant, given[_INPUT], time)
        samples = jnp.minimum(state.samples, LAST - 1) + 1
        return Moving(moved, samples), _outputs(mine, state.plant, moved, given[_INPUT])

    known = {PERIOD: known_numbers(experiment)[PERIOD]}
    return program_of(traced_block(name, dtype, known, begins, [torque, *steps], start, step, begin))


def _outputs(
    experiment: Experiment, before: PlantState | None, state: PlantState, torque: Any
) -> dict[str, tuple[Any, str, str]]:
    """Value, unit and description: those of :func:`jaxbl.simulate.step`, but for means over a sample, which are over the one
    that ends here, and 0 where none has."""
    drive, plant, period = experiment.drive, experiment.plant, experiment.run.sample_period
    out: dict[str, tuple[Any, str, str]] = {}
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
    about = "what resists beyond the nominal model: mean over the sample that ends here; 0 at the start"
    resisting = jnp.zeros_like(period)
    if before is not None:
        expected = drive.acceleration("motor", before.velocity["motor"], torque)
        resisting = drive.inertia("motor") * (expected - acceleration["motor"])
    out["torque"] = resisting, "N m", about
    return out
