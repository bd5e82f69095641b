"""Tables of a sweep: its axes, how they are combined and refined, and the figures of its report."""

from typing import Literal

import numpy as np
from pydantic import model_validator

from jaxbl.validation import table_error

from .tables import Table, check_distinct, declare_key

DEFAULT_TOLERANCE = 0.1
"""Relative difference of a numeric metric beyond which neighbours disagree, unless the study says otherwise."""


def is_boolean(column: str) -> bool:
    """Return True if the values of a metric column are true or false."""
    return column.rpartition(".")[2] in ("converged", "finite")


class SweepTable(Table):
    """Combination and repetition of the axes."""

    seeds: int = declare_key(
        "noise seeds first_seed, first_seed + 1, ..., each run at every point", 1, ge=1, le=1_000_000_000
    )
    first_seed: int = declare_key("first of the noise seeds", 0, ge=0, le=2**31 - 1)
    design: Literal["grid", "sobol", "latin_hypercube", "saltelli"] = declare_key(
        "grid: all combinations; else quasi-random points over the axes without num or values (saltelli: for total indices)",
        "grid",
    )
    points: int | None = declare_key("number of quasi-random points", None, ge=1, le=100_000_000)
    design_seed: int = declare_key("seed of the quasi-random design", 0, ge=0)
    metrics: list[str] | None = declare_key(
        "metrics to compute and store, by their names without side, e.g. ['converged', 'convergence_time']; "
        "left out: all; `finite` then counts what overflowed before all of these were known",
        None,
    )
    chunk: int | None = declare_key("lanes computed at once; left out: chosen for the machine", None, ge=1)
    refine: int | None = declare_key(
        "how often to halve the grid where neighbours disagree, along the axes with start, stop and num; left out: never",
        None,
        ge=1,
        le=30,
    )
    refine_metric: str | None = declare_key(
        "metric that decides where to refine; left out: converged, of the observer whose gains vary, otherwise of both", None
    )
    refine_tolerance: float | None = declare_key(
        f"relative difference beyond which they disagree in a numeric refine_metric; left out: {DEFAULT_TOLERANCE:g}",
        None,
        gt=0.0,
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
        check_distinct(self.metrics or [], "metrics names '{value}' twice; once is enough")
        if self.refine is not None and self.design != "grid":
            raise table_error(f"refine needs design = 'grid'; points of a {self.design} design have no neighbours")
        return self

    @property
    def requested_metrics(self) -> tuple[str, ...] | None:
        """The metrics asked for, whatever their order in the file; None for all."""
        return None if self.metrics is None else tuple(sorted(self.metrics))


class AxisTable(Table):
    """One axis: a dotted path and its values."""

    path: str = declare_key("dotted path of the number to vary, e.g. observer.motor.alpha")
    values: list[float | int | str] | None = declare_key("listed values", None)
    start: float | None = declare_key("first value", None)
    stop: float | None = declare_key("last value", None)
    num: int | None = declare_key("number of values; left out in quasi-random designs", None, ge=1, le=10_000_000)
    scale: Literal["linear", "log"] = declare_key("spacing", "linear")
    zip: str | None = declare_key("axes with the same label advance together", None)

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

    kind: Literal["heatmap", "line"] = declare_key("heatmap over two axes, or lines over one")
    x: str = declare_key("axis path")
    y: str | None = declare_key("axis path (heatmap)", None)
    value: str = declare_key("metric, e.g. motor.velocity_rmse")
    facet: str | None = declare_key("axis path: one panel for each value", None)
    series: str | None = declare_key("axis path: one line for each value (line)", None)
    where: dict[str, float | int | str] | None = declare_key(
        "axis path -> value: only these points (line); a value of the axis, or 'least' or 'largest' of them", None
    )
    theory: float | None = declare_key(
        "exponent of x that theory gives; asks for the fitted one (line; report, laws.json)", None
    )
    scale: Literal["auto", "linear", "log"] = declare_key("scale of the value", "auto")
    overlays: list[Literal["davila_fridman", "levant", "seeber_horn", "moreno_osorio", "exact"]] = declare_key(
        "gain conditions drawn over a map of alpha and lambda", []
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
        check_distinct(paths, "{value} is used twice; x, y, facet and series should be different axes")
        for path in paths:
            if path in (self.where or {}):
                raise table_error(f"{path} is drawn and cannot be fixed by where; leave it out of one of them")
        observer = self.x.rpartition(".")[0]
        is_of_gains = observer.startswith("observer.") and {self.x, self.y} == {f"{observer}.alpha", f"{observer}.lambda"}
        if self.overlays and not is_of_gains:
            raise table_error("overlays need a map over alpha and lambda of one observer; leave overlays out here")
        return self
