"""Two of the package's studies as they stand, by this package's own program: float64, implicit observers, ten plant steps a
sample, several seeds, every metric of the run. Gain conditions, which follow from the metrics, are left out.
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from jaxbl.config import Config, precision, prepare, read_config
from jaxbl.simulate import Experiment
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.programs import Layout, Program, compile_program

from .workload import DRIVE

_LAW = {"law": "sigmoid_backlash", "stiffness": 1.0, "dead_zone": 0.02, "slope": 20.0}
STUDIES: dict[str, dict[str, Any]] = {
    "gain_map": {
        "drive": {"kind": "two_inertia", **DRIVE},
        "transmission": _LAW,
        "excitation": {"kind": "sine", "amplitude": 0.1, "frequency": 0.16},
        "encoders": {"noise": 1e-4},
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
        "drive": {"kind": "two_inertia", **DRIVE},
        "transmission": _LAW,
        "excitation": {"kind": "multisine", "amplitude": 0.12, "frequency": 0.05, "count": 6},
        "encoders": {"noise": 1e-4},
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


class Study(NamedTuple):
    """One of them, with runs of so many samples: what is shared, and each lane's values `(lanes,)` by path."""

    name: str
    config: Config
    experiment: Experiment
    values: dict[str, np.ndarray]

    @property
    def seeds(self) -> int:
        return self.config.sweep.seeds

    @property
    def lanes(self) -> int:
        """Of each seed."""
        return len(next(iter(self.values.values())))

    @property
    def lane_steps(self) -> int:
        """Of a call."""
        return self.lanes * self.seeds * self.config.run.steps


def study(name: str, steps: int, lanes: int | None = None, start: float | None = None) -> Study:
    """One of :data:`STUDIES` with runs of so many samples, all of its lanes or so many spread over all, and identifiers that
    begin at another time (s)."""
    config = read_config(STUDIES[name])
    shortened = {"run": config.run.model_copy(update={"duration": steps * config.run.sample_period})}
    if start is not None:
        assert config.identifier is not None
        shortened["identifier"] = config.identifier.model_copy(update={"start": start})
    config = config.model_copy(update=shortened)
    points = Points(config)
    with precision(config):
        chosen = (
            np.arange(points.group_size)
            if lanes is None
            else np.linspace(0, points.group_size - 1, lanes).round().astype(int)
        )
        return Study(name, config, prepare(config), points.columns(chosen))


class FusedStudy:
    """By the program of a sweep on all cores, all of a study in one chunk; other seeds at each call."""

    def __init__(self, of: Study):
        self._study, self._round = of, 0
        devices, layout = jax.local_devices(backend="cpu"), Layout(of.seeds, of.lanes)
        with precision(of.config):
            self._program: Program = compile_program(
                of.experiment, layout, devices, "fused", of.values, require_backend=True
            )

    def __call__(self) -> dict[str, np.ndarray]:
        """Figures `(seeds, lanes)` by name."""
        first = self._round * self._study.seeds
        self._round += 1
        with precision(self._study.config):
            figures, _ = self._program.run(self._study.values, np.arange(first, first + self._study.seeds))
        return figures
