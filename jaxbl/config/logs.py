"""Tables of the commands that hold a study against measured logs: how well its numbers are known, and what is sought."""

from typing import Literal

from pydantic import Field

from .tables import Table


class UncertaintyTable(Table):
    """Uncertainty of the drive's numbers. Accepted in every study; simulate and sweep do not use it, tune can."""

    relative: float = Field(default=0.02, gt=0.0, description="relative standard deviation of every number not in exact")
    exact: list[str] = Field(
        default=["drive.gear_ratio"],
        description="dotted paths of numbers that are known exactly, and names of effects that are surely not missing",
    )


class IdentifyTable(Table):
    """Settings of `jaxbl identify`."""

    parameters: list[str] | None = Field(
        default=None,
        description="dotted paths of the numbers to find; left out: all of drive, transmission and effects that are not in "
        "uncertainty.exact and have a value to start from",
    )
    method: Literal["output_error", "prediction_error"] = Field(
        default="output_error",
        description="output_error: the model runs freely over each window; prediction_error: each reading corrects it, "
        "which is better where disturbances act that the model does not know",
    )
    window: float | None = Field(
        default=None,
        gt=0.0,
        description="length of the windows that the model runs over; left out: chosen by the width of the intervals",
        json_schema_extra={"unit": "s"},
    )
    starts: int = Field(default=8, ge=1, le=1000, description="starts of the fit, the first at the nominal numbers")
    spread: float = Field(default=2.0, gt=1.0, le=100.0, description="the others lie within this factor of them")
    seed: int = Field(default=0, ge=0, description="seed of the starts")
    profile: bool = Field(default=False, description="whether to compute profile-likelihood intervals as well")
    bandwidth: float | None = Field(
        default=None,
        gt=0.0,
        description="of the torques in the equations of motion; left out: a twentieth of the sampling rate",
        json_schema_extra={"unit": "Hz"},
    )
