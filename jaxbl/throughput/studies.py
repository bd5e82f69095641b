"""Two of the package's studies as they stand, by this package's own program: float64, implicit observers, ten plant steps a
sample, several seeds, every metric of the run. Gain conditions, which follow from the metrics, are left out.
"""

from typing import NamedTuple

import jax
import numpy as np

from jaxbl.chain import Experiment, NamedArrays
from jaxbl.config import Config, precision, prepare, read_config
from jaxbl.files import find_shipped_study
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.programs import Layout, Program, compile_program

from .workload import Metrics

STUDIES = "gain_map", "dead_zone_noise"
"""Names of the studies, which come with the package."""


class BenchStudy(NamedTuple):
    """One of the studies, with runs of so many samples: what is shared, and each lane's values `(lanes,)` by path."""

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


def prepare_study(name: str, steps: int, lanes: int | None = None, identifier_start: float | None = None) -> BenchStudy:
    """Prepare one of :data:`STUDIES` with runs of `steps` samples.

    Args:
        name: of the study.
        steps: samples of a run.
        lanes: number of lanes, spread over all of the study; None for all.
        identifier_start: time at which identifiers begin, s; None for that of the study.
    """
    config = read_config(find_shipped_study(f"{name}.toml"))
    config = config.with_keys("run", duration=steps * config.run.sample_period)
    if identifier_start is not None:
        assert config.identifier is not None
        config = config.with_keys("identifier", start=identifier_start)
    points = Points(config)
    with precision(config):
        indices = np.linspace(0, points.group_size - 1, lanes or points.group_size).round().astype(int)
        return BenchStudy(config, prepare(config), points.columns(indices))


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
