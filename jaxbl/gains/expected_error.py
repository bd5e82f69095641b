"""What the error of a study's observers is due to: its encoders, its gap, and the sampling period."""

# pandas' own annotations are wider than what its methods return
# pyright: reportArgumentType=false

from typing import NamedTuple

import numpy as np
import pandas as pd

from jaxbl.config import Config
from jaxbl.config.figures import filter_rows
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
        errors = [
            float(filter_rows(frame, {path: values[i] for path, values in self.columns.items()})[metric].max())
            for i in range(len(self.names) + 1)
        ]
        # without a disturbance the error may be larger by chance
        squares = np.minimum.accumulate(np.square(errors))
        with np.errstate(invalid="ignore", divide="ignore"):
            shares = np.append(np.abs(np.diff(squares)), squares[-1]) / squares[0]
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
    """The errors of an observer in runs of a study: rms over the last quarter, the worst of the noise seeds.

    Attributes:
        velocity: of the first of the drives, rad/s.
        shares: share of each cause in its square.
        largest_velocity: of all drives, rad/s.
        largest_position: of all drives, rad.
    """

    velocity: float
    shares: dict[str, float]
    largest_velocity: float
    largest_position: float


def expect_errors(scenarios: Scenarios) -> dict[str, ExpectedError]:
    """Expect the errors of a study's observers, by side, from runs of drives with the study's own gains.

    Raises:
        InputError: the study cannot run.
    """
    data, causes = scenarios.config.to_dict(), list_causes(scenarios.config)
    for key in ("figures", "tune", "uncertainty", "axes"):
        data.pop(key, None)
    data["axes"] = list_axes({"scenario": scenarios.columns, "causes": causes.columns})
    result = sweep(data | {"sweep": {"seeds": 4}})
    paths = [*scenarios.columns, *causes.columns]
    sides = scenarios.config.sides
    frame = result.read([*paths, *(f"{side}.{name}_rmse" for side in sides for name in ("velocity", "position"))])
    first = filter_rows(frame, {path: values[0] for path, values in scenarios.columns.items()})
    return {
        side: ExpectedError(
            *causes.split(first, f"{side}.velocity_rmse"),
            *(causes.split(frame, f"{side}.{name}_rmse")[0] for name in ("velocity", "position")),
        )
        for side in sides
    }
