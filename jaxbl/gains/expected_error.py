"""What the error of a study's observers is due to: its encoders, its gap, and the sampling period."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from jaxbl.config import Config, read_config
from jaxbl.sweeps.sweep import sweep

from .pilot import Scenarios, list_axes


class Causes(NamedTuple):
    """Runs of a study without one cause of the observers' error after the other.

    Attributes:
        names: the causes that the study has: `encoder`, `gap`. What is left without them is due to the `period`.
        columns: values of the numbers that change, by path, one for each run; the first is the study as it is.
    """

    names: list[str]
    columns: dict[str, list[float]]

    def split(self, frame: pd.DataFrame, metric: str) -> tuple[float, dict[str, float]]:
        """Return the worst error of the study as it is, and the share of its square that each cause has.

        Args:
            frame: the runs, with the columns.
            metric: the column of the errors.
        """
        errors = []
        for i in range(len(self.names) + 1):
            is_run = [frame[path] == values[i] for path, values in self.columns.items()]
            errors.append(float(frame.loc[np.logical_and.reduce([np.ones(len(frame), bool), *is_run]), metric].max()))
        # without a disturbance the error may be larger by chance
        squares = np.minimum.accumulate(np.square(errors))
        with np.errstate(invalid="ignore", divide="ignore"):
            shares = np.append(-np.diff(squares), squares[-1]) / squares[0]
        return errors[0], dict(zip([*self.names, "period"], map(float, shares), strict=True))


def list_causes(config: Config) -> Causes:
    """List the causes of the observers' error that a study has."""
    data = config.to_dict()
    encoders = {f"encoders.{name}": value for name, value in data["encoders"].items() if value > 0.0}
    half_gap = data.get("transmission", {}).get("half_gap", 0.0)
    numbers = {"encoder": encoders, "gap": {"transmission.half_gap": half_gap} if half_gap > 0.0 else {}}
    names = [name for name, values in numbers.items() if values]
    columns = {
        path: [value] * (1 + i) + [0.0] * (len(names) - i)
        for i, name in enumerate(names)
        for path, value in numbers[name].items()
    }
    return Causes(names, columns)


class ExpectedError(NamedTuple):
    """The error of an observer in a run of a study.

    Attributes:
        velocity: rms over the last quarter of the run, rad/s; the worst of the noise seeds.
        position: the same of the position, rad.
        shares: share of each cause in the square of `velocity`.
    """

    velocity: float
    position: float
    shares: dict[str, float]


def expect_errors(scenarios: Scenarios, sides: Sequence[str], seeds: int = 4) -> dict[str, ExpectedError]:
    """Expect the largest errors of a study's observers, by side, from runs of drives with the study's own gains.

    Raises:
        InputError: the study cannot run.
    """
    data, causes = scenarios.config.to_dict(), list_causes(scenarios.config)
    for key in ("figures", "tune", "uncertainty", "axes"):
        data.pop(key, None)
    data["axes"] = list_axes({"scenario": scenarios.columns, "causes": causes.columns})
    result = sweep(read_config(data | {"sweep": {"seeds": seeds}}))
    frame = result.read([*causes.columns, *(f"{side}.{name}_rmse" for side in sides for name in ("velocity", "position"))])
    expected = {}
    for side in sides:
        velocity, shares = causes.split(frame, f"{side}.velocity_rmse")
        expected[side] = ExpectedError(velocity, causes.split(frame, f"{side}.position_rmse")[0], shares)
    return expected
