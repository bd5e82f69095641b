"""The study with what was missing."""

from types import SimpleNamespace
from typing import Any

from small_study import rigid_study

from jaxbl.config import read_config
from jaxbl.diagnosis.diagnosis_summary import extended_study


def test_a_model_that_only_the_logs_period_can_simulate_has_that_period():
    """A dead time of 30 ms: six samples of the log, thirty of the study."""
    config = read_config(rigid_study(run={"sample_period": 1e-3, "substeps": 10}))
    task: Any = SimpleNamespace(config=config, record=SimpleNamespace(sample_period=5e-3))
    for delay, period in ((0.03, 5e-3), (0.01, 1e-3)):
        assert extended_study(task, {"actuator.delay": {"delay": delay}}, {}).run.sample_period == period
