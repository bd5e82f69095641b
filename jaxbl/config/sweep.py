"""Tables of a sweep: its axes, how they are combined and refined, and the figures of its report."""

from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from jaxbl.validation import table_error

from .tables import Table

DEFAULT_TOLERANCE = 0.1
"""Relative difference of a numeric metric beyond which neighbours disagree, unless the study says otherwise."""


def is_boolean(column: str) -> bool:
    """Return True if the values of a metric column are true or false."""
    return column.rpartition(".")[2] in ("converged", "finite")


class SweepTable(Table):
    """Combination and repetition of the axes."""

    seeds: int = Field(
        default=1, ge=1, le=1_000_000_000, description="noise seeds first_seed, first_seed + 1, ..., each run at every point"
    )
    first_seed: int = Field(default=0, ge=0, le=2**31 - 1, description="first of the noise seeds")
    design: Literal["grid", "sobol", "latin_hypercube"] = Field(
        default="grid", description="grid: all combinations; else quasi-random points over the axes without num or values"
    )
    points: int | None = Field(default=None, ge=1, le=100_000_000, description="number of quasi-random points")
    design_seed: int = Field(default=0, ge=0, description="seed of the quasi-random design")
    metrics: list[str] | None = Field(
        default=None,
        description="metrics to compute and store, by their names without side, e.g. ['converged', 'convergence_time']; "
        "left out: all; `finite` then counts what overflowed before all of these were known",
    )
    chunk: int | None = Field(default=None, ge=1, description="lanes computed at once; left out: chosen for the machine")
    refine: int | None = Field(
        default=None,
        ge=1,
        le=30,
        description="how often to halve the grid where neighbours disagree, along the axes with start, stop and num; "
        "left out: never",
    )
    refine_metric: str | None = Field(
        default=None,
        description="metric that decides where to refine; left out: converged, of the observer whose gains vary, otherwise "
        "of both",
    )
    refine_tolerance: float | None = Field(
        default=None,
        gt=0.0,
        description="relative difference beyond which they disagree in a numeric refine_metric; "
        f"left out: {DEFAULT_TOLERANCE:g}",
    )

    @model_validator(mode="after")
    def _complete(self) -> "SweepTable":
        for key in ("refine_metric", "refine_tolerance"):
            if self.refine is None and getattr(self, key) is not None:
                raise table_error(f"{key} needs refine, the number of times that the grid is halved")
        if self.refine_tolerance is not None and (self.refine_metric is None or is_boolean(self.refine_metric)):
            raise table_error("refine_tolerance needs a numeric refine_metric, e.g. 'motor.velocity_rmse'")
        if self.metrics is not None and not self.metrics:
            raise table_error("metrics should name at least one, e.g. 'converged'; leave it out for all")
        for name in self.metrics or ():
            if self.metrics is not None and self.metrics.count(name) > 1:
                raise table_error(f"metrics names '{name}' twice; once is enough")
        if self.refine is not None and self.design != "grid":
            raise table_error(f"refine needs design = 'grid'; points of a {self.design} design have no neighbours")
        return self

    @property
    def requested_metrics(self) -> tuple[str, ...] | None:
        """The metrics asked for, whatever their order in the file; None for all."""
        return None if self.metrics is None else tuple(sorted(self.metrics))


class AxisTable(Table):
    """One axis: a dotted path and its values."""

    path: str = Field(description="dotted path of the number to vary, e.g. observer.motor.alpha")
    values: list[float | int | str] | None = Field(default=None, description="listed values")
    start: float | None = Field(default=None, description="first value")
    stop: float | None = Field(default=None, description="last value")
    num: int | None = Field(
        default=None, ge=1, le=10_000_000, description="number of values; left out in quasi-random designs"
    )
    scale: Literal["linear", "log"] = Field(default="linear", description="spacing")
    zip: str | None = Field(default=None, description="axes with the same label advance together")

    @model_validator(mode="after")
    def _complete(self) -> "AxisTable":
        if self.values is not None:
            if self.start is not None or self.stop is not None or self.num is not None:
                raise table_error(f"axis {self.path} has both values and start/stop/num; give one of them")
            if not self.values:
                raise table_error(f"axis {self.path} is empty: values should list at least one value")
            if self.zip is None and len(set(self.values)) < len(self.values):
                raise table_error(f"axis {self.path} lists a value twice; values should differ")
            return self
        if self.start is None or self.stop is None:
            raise table_error(f"axis {self.path} should have values, or start and stop")
        if self.start >= self.stop:
            raise table_error(f"axis {self.path}: start {self.start} should be less than stop {self.stop}")
        if self.scale == "log" and self.start <= 0.0:
            raise table_error(f"axis {self.path}: a log scale needs start > 0, not {self.start}")
        if self.num == 1:
            raise table_error(f"axis {self.path}: num = 1 cannot span start ... stop; use values = [...] or num >= 2")
        return self

    def grid(self, depth: int = 0) -> np.ndarray:
        """The values of the axis, in its order; not for an axis that is sampled quasi-randomly (neither num nor values).

        Halved `depth` times: every 2^depth-th is then, to the bit, what it is without halving.
        """
        if self.values is not None:
            return np.array(self.values, dtype=object if any(isinstance(v, str) for v in self.values) else None)
        assert self.start is not None and self.stop is not None and self.num is not None
        space = np.geomspace if self.scale == "log" else np.linspace
        return space(self.start, self.stop, self.size(depth))

    def size(self, depth: int = 0) -> int:
        """Return the number of values of :meth:`grid`."""
        if self.values is not None:
            return len(self.values)
        assert self.num is not None
        return (self.num - 1 << depth) + 1


class FigureTable(Table):
    """One figure of the report."""

    kind: Literal["heatmap", "line"] = Field(description="heatmap over two axes, or lines over one")
    x: str = Field(description="axis path")
    y: str | None = Field(default=None, description="axis path (heatmap)")
    value: str = Field(description="metric, e.g. motor.velocity_rmse")
    facet: str | None = Field(default=None, description="axis path: one panel for each value")
    series: str | None = Field(default=None, description="axis path: one line for each value (line)")
    where: dict[str, float | int | str] | None = Field(
        default=None,
        description="axis path -> value: only these points (line); a value of the axis, or 'least' or 'largest' of them",
    )
    theory: float | None = Field(
        default=None, description="exponent of x that theory gives; asks for the fitted one (line; report, laws.json)"
    )
    scale: Literal["auto", "linear", "log"] = Field(default="auto", description="scale of the value")
    overlays: list[Literal["davila_fridman", "levant", "seeber_horn", "moreno_osorio", "exact"]] = Field(
        default=[], description="gain conditions drawn over a map of alpha and lambda"
    )

    @model_validator(mode="after")
    def _complete(self) -> "FigureTable":
        if self.kind == "heatmap" and self.y is None:
            raise table_error("a heatmap needs y, the path of its second axis")
        idle = {"series": "use facet", "where": "use facet", "theory": "use a line"}
        for key, hint in (idle if self.kind == "heatmap" else {"y": "use series or facet"}).items():
            if getattr(self, key) is not None:
                raise table_error(f"a {self.kind} has no {key}; {hint}")
        paths = [path for path in (self.x, self.y, self.facet, self.series) if path is not None]
        for path in paths:
            if paths.count(path) > 1:
                raise table_error(f"{path} is used twice; x, y, facet and series should be different axes")
            if path in (self.where or {}):
                raise table_error(f"{path} is drawn and cannot be fixed by where; leave it out of one of them")
        gains = [{f"observer.{side}.alpha", f"observer.{side}.lambda"} for side in ("motor", "load")]
        if self.overlays and {self.x, self.y} not in gains:
            raise table_error("overlays need a map over alpha and lambda of one observer; leave overlays out here")
        return self
