"""Two of the package's studies as they stand, by this package's own program: float64, implicit observers, ten plant steps a
sample, several seeds, every metric of the run. Gain conditions, which follow from the metrics, are left out.
"""

from typing import NamedTuple

import jax
import numpy as np

from jaxbl.chain import Experiment, NamedArrays
from jaxbl.config import Config, precision, prepare, read_config
from jaxbl.json_types import JsonObject
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.programs import Layout, Program, compile_program

from .workload import DRIVE, Metrics

_PLANT = {
    "drive": {"kind": "two_inertia", **DRIVE},
    "transmission": {"law": "sigmoid_backlash", "stiffness": 1.0, "dead_zone": 0.02, "slope": 20.0},
    "encoders": {"noise": 1e-4},
}
STUDIES: dict[str, JsonObject] = {
    "gain_map": {
        **_PLANT,
        "excitation": {"kind": "sine", "amplitude": 0.1, "frequency": 0.16},
        "observer": {
            "discretisation": "implicit",
            "motor": {"lambda": 4.0, "alpha": 9.0, "velocity_error": 0.5},
            "load": {"lambda": 0.5, "alpha": 0.2},
        },
        "equivalent_control": {"time_constant": 0.01},
        "identifier": {"start": 5.0},
        "run": {
            "duration": 20.0,
            "sample_period": 1e-3,
            "substeps": 10,
            "position_tolerance": 5e-3,
            "velocity_tolerance": 0.1,
        },
        "sweep": {"seeds": 4},
        "axes": [
            {"path": "encoders.noise", "values": [1e-6, 1e-5, 1e-4]},
            {"path": "observer.motor.lambda", "start": 0.1, "stop": 30.0, "num": 64, "scale": "log"},
            {"path": "observer.motor.alpha", "start": 0.5, "stop": 100.0, "num": 64, "scale": "log"},
        ],
    },
    "dead_zone_noise": {
        **_PLANT,
        "excitation": {"kind": "multisine", "amplitude": 0.12, "frequency": 0.05, "count": 6},
        "observer": {"motor": {"lambda": 4.0, "alpha": 9.0}, "load": {"lambda": 0.5, "alpha": 0.4}},
        "equivalent_control": {"time_constant": 0.02},
        "identifier": {"start": 5.0, "regressor_filter": "matched"},
        "run": {"duration": 40.0, "sample_period": 1e-3},
        "sweep": {"seeds": 8},
        "axes": [
            {"path": "transmission.dead_zone", "start": 0.001, "stop": 0.04, "num": 16, "scale": "log"},
            {"path": "encoders.noise", "start": 1e-6, "stop": 1e-3, "num": 16, "scale": "log"},
        ],
    },
}
"""As in the repository's `sweeps/`, without what is drawn."""


class BenchStudy(NamedTuple):
    """One of them, with runs of so many samples: what is shared, and each lane's values `(lanes,)` by path."""

    name: str
    config: Config
    experiment: Experiment
    values: NamedArrays

    @property
    def seeds(self) -> int:
        return self.config.sweep.seeds

    @property
    def lanes(self) -> int:
        """Number of lanes of each seed."""
        return len(next(iter(self.values.values())))

    @property
    def lane_steps(self) -> int:
        """Number of lane-steps of a call."""
        return self.lanes * self.seeds * self.config.run.steps


def prepare_study(name: str, steps: int, lanes: int | None = None, identifier_start: float | None = None) -> BenchStudy:
    """Prepare one of :data:`STUDIES` with runs of `steps` samples.

    Args:
        name: of the study.
        steps: samples of a run.
        lanes: number of lanes, spread over all of the study; None for all.
        identifier_start: time at which identifiers begin, s; None for that of the study.
    """
    config = read_config(STUDIES[name])
    config = config.with_keys("run", duration=steps * config.run.sample_period)
    if identifier_start is not None:
        assert config.identifier is not None
        config = config.with_keys("identifier", start=identifier_start)
    points = Points(config)
    with precision(config):
        indices = (
            np.arange(points.group_size)
            if lanes is None
            else np.linspace(0, points.group_size - 1, lanes).round().astype(int)
        )
        return BenchStudy(name, config, prepare(config), points.columns(indices))


class FusedStudy:
    """The program of a sweep on all cores, with a study in one chunk; each call takes other seeds."""

    def __init__(self, study: BenchStudy):
        self._study, self._round = study, 0
        devices, layout = jax.local_devices(backend="cpu"), Layout(study.seeds, study.lanes)
        with precision(study.config):
            self._program: Program = compile_program(
                study.experiment, layout, devices, "fused", study.values, require_backend=True
            )

    def __call__(self) -> Metrics:
        """Figures `(seeds, lanes)` by name."""
        first_seed = self._round * self._study.seeds
        self._round += 1
        with precision(self._study.config):
            metrics, _ = self._program.run(self._study.values, np.arange(first_seed, first_seed + self._study.seeds))
        return metrics
