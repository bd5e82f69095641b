"""Tables of the commands that hold a study against measured logs: how well its numbers are known, and what is sought."""

from typing import Literal

from .tables import Table, declare_key


class UncertaintyTable(Table):
    """Uncertainty of the drive's numbers. Accepted in every study; simulate and sweep do not use it, tune can."""

    relative: float = declare_key("relative standard deviation of every number not in exact", 0.02, gt=0.0)
    exact: list[str] = declare_key(
        "paths of numbers that are known exactly, and effects that are surely not missing, by name", ["drive.gear_ratio"]
    )
    expected: list[str] = declare_key(
        "effects that surely act, by name: diagnose fits them from the first, and keeps them", []
    )


class IdentifyTable(Table):
    """Settings of `jaxbl identify`."""

    parameters: list[str] | None = declare_key(
        "paths of the numbers to find; left out: all that are not in uncertainty.exact and have a value to start from", None
    )
    method: Literal["output_error", "prediction_error"] = declare_key(
        "output_error: free runs over each window; prediction_error: each reading corrects the model, "
        "which is better where disturbances act that it does not know",
        "output_error",
    )
    window: float | None = declare_key(
        "length of the windows that the model runs over; left out: chosen by the width of the intervals",
        None,
        unit="s",
        gt=0.0,
    )
    starts: int = declare_key("starts of the fit, the first at the nominal numbers", 8, ge=1, le=1000)
    spread: float = declare_key("the others lie within this factor of them", 2.0, gt=1.0, le=100.0)
    seed: int = declare_key("seed of the starts", 0, ge=0)
    profile: bool = declare_key("whether to compute profile-likelihood intervals as well", False)
    bandwidth: float | None = declare_key(
        "of the torques in the equations of motion; left out: a twentieth of the sampling rate", None, unit="Hz", gt=0.0
    )
