"""The TOML study: its tables, their validation, and the experiment they describe.

Tables of physical things are generated from the modules that compute with them, so that a key, its unit and its range are
written once. What the config says is found again in the experiment under the same dotted path.
"""

import copy
import dataclasses
import difflib
import math
import tomllib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Union

import jax
import jax.numpy as jnp
import numpy as np
import tomli_w
from pydantic import Field, ValidationError, create_model, model_validator
from pydantic_core import PydanticCustomError

from jaxbl.drive.effects import EFFECTS, make_effect
from jaxbl.drive.encoders import Encoders
from jaxbl.drive.excitation import EXCITATIONS, Recorded
from jaxbl.drive.parameters import Parameter, as_arrays, key_of, parameters
from jaxbl.drive.plant import DRIVES, Initial
from jaxbl.drive.transmission import TRANSMISSIONS
from jaxbl.errors import InputError
from jaxbl.observer.equivalent_control import EquivalentControl
from jaxbl.observer.recursive import Identifier
from jaxbl.observer.super_twisting import OBSERVERS, AbstractSuperTwisting, Observers
from jaxbl.records.reader import read_log_table
from jaxbl.records.table import Key, LogTable, StrictTable, brief, describe, nearest
from jaxbl.simulate import Experiment, Run

TOLERANCE = 0.1
"""Relative difference of a numeric metric beyond which neighbours disagree, unless the study says otherwise."""


def is_boolean(column: str) -> bool:
    """Whether a metric column is true or false."""
    return column.rpartition(".")[2] in ("converged", "finite")


class Table(StrictTable):
    """A table that may build what it describes."""

    factory: ClassVar[Callable[..., Any]]
    """What the table builds (generated tables)."""

    def build(self) -> Any:
        """The module that a generated table stands for."""
        names = {name for name in type(self).model_fields if name not in ("kind", "law")}
        return self.factory(**{name: getattr(self, name) for name in names})


def table_for(module: type, factory: Callable[..., Any] | None = None, **tag: str) -> type[Table]:
    """Generate the config table of a module class from its declared parameters; `tag` adds a fixed key (`kind="sine"`)."""
    fields: dict[str, Any] = {key: (Literal[value], ...) for key, value in tag.items()}
    for field, known in parameters(module):
        kind: Any = field.type if field.metadata.get("static") else float
        optional = field.default is None
        fields[field.name] = (
            kind | None if optional else kind,
            Field(
                default=... if field.default is dataclasses.MISSING else field.default,
                alias=key_of(field.name) if key_of(field.name) != field.name else None,
                description=known.doc,
                json_schema_extra={"unit": known.unit} if known.unit else None,
                ge=known.minimum,
                gt=known.above,
                le=known.maximum,
            ),
        )
    model = create_model(module.__name__, __base__=Table, __doc__=module.__doc__, **fields)
    model.factory = factory or module
    return model


class RecordedTable(Table):
    """Input from a CSV or Parquet file, played back with zero-order hold."""

    kind: Literal["recorded"]
    file: str = Field(description="CSV or Parquet file; relative to the config file")
    time_column: str = Field(default="t", description="column of times in s")
    torque_column: str = Field(default="u", description="column of torques in N m")
    gain: float = Field(default=1.0, description="factor on the recorded torque")

    def build(self) -> Recorded:
        import pandas as pd

        path = Path(self.file)
        try:
            frame = pd.read_parquet(path) if path.suffix == ".parquet" else pd.read_csv(path)
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: cannot be read as CSV or Parquet: {str(error).splitlines()[0]}") from None
        columns = []
        for column in (self.time_column, self.torque_column):
            if column not in frame:
                raise InputError(f"{path}: no column '{column}'; {nearest(column, map(str, frame.columns))}")
            values = np.asarray(pd.to_numeric(frame[column], errors="coerce"), dtype=float)
            if len(values) == 0 or not np.isfinite(values).all():
                row = 0 if len(values) == 0 else int(np.argmin(np.isfinite(values)))
                raise InputError(f"{path}: column '{column}', row {row}: should be a finite number")
            columns.append(values)
        times, torques = columns
        if (np.diff(times) <= 0.0).any():
            row = int(np.argmax(np.diff(times) <= 0.0)) + 1
            raise InputError(f"{path}: column '{self.time_column}', row {row}: times should increase")
        return Recorded(times=times - times[0], torques=torques, gain=self.gain)  # type: ignore[arg-type]


def _tagged(tables: list[type[Table]], key: str) -> Any:
    return Annotated[Union[tuple(tables)], Field(discriminator=key)]  # noqa: UP007


_Drive = _tagged([table_for(cls, kind=name) for name, cls in DRIVES.items()], "kind")
_Transmission = _tagged([table_for(cls, law=name) for name, cls in TRANSMISSIONS.items()], "law")
_Excitation = _tagged(
    [RecordedTable if name == "recorded" else table_for(cls, kind=name) for name, cls in EXCITATIONS.items()], "kind"
)
_Effect = _tagged([table_for(cls, partial(make_effect, name), kind=name) for name, cls in EFFECTS.items()], "kind")
_Gains = table_for(AbstractSuperTwisting)
_Initial = table_for(Initial)
_Encoders = table_for(Encoders)
_EquivalentControl = table_for(EquivalentControl)
_Identifier = table_for(Identifier)


class ObserverTable(Table):
    """Super-twisting observers (7)-(8) of both sides."""

    discretisation: Literal["implicit", "explicit"] = Field(
        default="implicit", description="implicit: proximal backward Euler; explicit: forward Euler of (7)"
    )
    motor: _Gains = Field(description="gains of the motor observer")  # type: ignore[valid-type]
    load: _Gains | None = Field(default=None, description="gains of the load observer; none on a rigid drive")  # type: ignore[valid-type]

    def build(self) -> Observers:
        cls = OBSERVERS[self.discretisation]
        return Observers(cls(**dict(self.motor)), None if self.load is None else cls(**dict(self.load)))


_MOST_STEPS = 2e9
"""Samples are counted in 32 bits."""


class RunTable(Table):
    """Time grid, precision and tolerances."""

    duration: float = Field(default=20.0, gt=0.0, description="length of the run", json_schema_extra={"unit": "s"})
    sample_period: float = Field(
        default=1e-3, gt=0.0, description="period of encoders, observers, identifier", json_schema_extra={"unit": "s"}
    )
    substeps: int = Field(default=10, ge=1, description="plant steps per sample")
    precision: Literal["float64", "float32"] = Field(default="float64", description="floating-point type of the run")
    position_tolerance: float = Field(
        default=1e-3,
        gt=0.0,
        description="largest position error of a converged observer (load: divided by the gear ratio)",
        json_schema_extra={"unit": "rad"},
    )
    velocity_tolerance: float = Field(
        default=0.05,
        gt=0.0,
        description="largest velocity error of a converged observer (load: divided by the gear ratio)",
        json_schema_extra={"unit": "rad/s"},
    )

    @property
    def steps(self) -> int:
        """Number of samples."""
        return round(self.duration / self.sample_period)

    @model_validator(mode="after")
    def _long_enough(self) -> "RunTable":
        if self.sample_period > self.duration:
            raise PydanticCustomError(
                "period",
                "sample_period {period} s is longer than duration {duration} s; it should be a small part of it",
                {"period": self.sample_period, "duration": self.duration},
            )
        if self.duration / self.sample_period > _MOST_STEPS:
            raise PydanticCustomError(
                "period",
                "duration {duration} s holds more than {most} samples of {period} s; it should hold fewer",
                {"period": self.sample_period, "duration": self.duration, "most": f"{_MOST_STEPS:.0e}"},
            )
        if self.steps < 8:
            raise PydanticCustomError(
                "period",
                "duration {duration} s holds only {steps} samples of {period} s; at least 8 are needed",
                {"period": self.sample_period, "duration": self.duration, "steps": self.steps},
            )
        return self

    def build(self) -> Run:
        return Run(self.sample_period, self.steps, self.substeps, self.position_tolerance, self.velocity_tolerance)


class SweepTable(Table):
    """How the axes are combined and repeated."""

    seeds: int = Field(
        default=1, ge=1, le=1_000_000_000, description="noise seeds first_seed, first_seed + 1, ..., each run at every point"
    )
    first_seed: int = Field(default=0, ge=0, le=2**31 - 1, description="first of the noise seeds")
    design: Literal["grid", "sobol", "latin_hypercube"] = Field(
        default="grid", description="grid: all combinations; else quasi-random points over the axes without num or values"
    )
    points: int | None = Field(default=None, ge=1, le=100_000_000, description="number of quasi-random points")
    design_seed: int = Field(default=0, ge=0, description="seed of the quasi-random design")
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
        description="metric in which neighbours are compared; left out: converged, of observers whose gains are refined, "
        "else of all",
    )
    refine_tolerance: float | None = Field(
        default=None,
        gt=0.0,
        description=f"relative difference beyond which they disagree in a numeric refine_metric; left out: {TOLERANCE:g}",
    )

    @model_validator(mode="after")
    def _complete(self) -> "SweepTable":
        def wrong(message: str, **context: Any) -> PydanticCustomError:
            return PydanticCustomError("sweep", message, context)  # type: ignore[arg-type]

        for key in ("refine_metric", "refine_tolerance"):
            if self.refine is None and getattr(self, key) is not None:
                raise wrong("{key} needs refine, the number of times that the grid is halved", key=key)
        if self.refine_tolerance is not None and (self.refine_metric is None or is_boolean(self.refine_metric)):
            raise wrong("refine_tolerance needs a numeric refine_metric, e.g. 'motor.velocity_rmse'")
        if self.refine is not None and self.design != "grid":
            raise wrong("refine needs design = 'grid'; points of a {design} design have no neighbours", design=self.design)
        return self


class UncertaintyTable(Table):
    """How well the drive's numbers are known. Accepted in every study; simulate and sweep do not use it, tune can."""

    relative: float = Field(default=0.02, gt=0.0, description="relative standard deviation of every number not in exact")
    exact: list[str] = Field(default=["drive.gear_ratio"], description="dotted paths of numbers that are known exactly")


class AlphaRatioTable(Table):
    """Range of alpha / f⁺ that is searched, in equal ratios."""

    start: float = Field(default=1.1, gt=1.0, le=1e9, description="least alpha / f⁺; no observer converges below 1")
    stop: float = Field(default=100.0, gt=1.0, le=1e9, description="largest alpha / f⁺")


class LambdaRatioTable(Table):
    """Range of lambda / √f⁺ that is searched, in equal ratios."""

    start: float = Field(default=0.3, gt=0.0, le=1e9, description="least lambda / √f⁺")
    stop: float = Field(default=50.0, gt=0.0, le=1e9, description="largest lambda / √f⁺")


class GainPairTable(Table):
    """Gains of one observer."""

    lambda_: float = Field(alias="lambda", ge=0.0, description="gain lambda", json_schema_extra={"unit": "√rad/s"})
    alpha: float = Field(ge=0.0, description="gain alpha", json_schema_extra={"unit": "rad/s²"})


class CompareTable(Table):
    """Other gains that tuned ones are compared with."""

    name: str = Field(min_length=1, description="how tables and figures call them")
    motor: GainPairTable = Field(description="gains of the motor observer")
    load: GainPairTable | None = Field(default=None, description="gains of the load observer; none on a rigid drive")


class TuneTable(Table):
    """How `jaxbl tune` chooses lambda and alpha; f⁺ is the bound that a pilot run of the study finds."""

    objective: Literal["velocity", "torque"] = Field(
        default="velocity", description="rms error over the last quarter of the run that is made least, worst over the seeds"
    )
    worst_over_uncertainty: bool = Field(
        default=False,
        description="worst also over the corners of inertias and viscous frictions (1 ± uncertainty.relative)",
    )
    margin_exact: float = Field(
        default=1.1, ge=1.0, description="least lambda over what the exact condition asks at the true f⁺ along each run"
    )
    margin_alpha: float = Field(default=1.1, gt=1.0, description="least alpha over the true f⁺ along each run")
    longest_convergence: float | None = Field(
        default=None, gt=0.0, description="convergence time allowed; left out: the first three quarters of the run",
        json_schema_extra={"unit": "s"},
    )  # fmt: skip
    alpha_ratio: AlphaRatioTable = Field(default_factory=AlphaRatioTable)
    lambda_ratio: LambdaRatioTable = Field(default_factory=LambdaRatioTable)
    num: int = Field(default=16, ge=3, le=1000, description="values of each gain in the coarse map and in each zoom")
    refine: int = Field(default=2, ge=0, le=10, description="zooms around the best cell; each spans two cells of the last")
    holdout: _Excitation | None = Field(  # type: ignore[valid-type]
        default=None,
        description="a table as [excitation]: input that gains are compared on; left out: the study's, with other noise",
    )
    compare: list[CompareTable] = Field(default=[], description="named gains to compare with")

    @model_validator(mode="after")
    def _consistent(self) -> "TuneTable":
        def wrong(message: str, **context: Any) -> PydanticCustomError:
            return PydanticCustomError("consistency", message, context)  # type: ignore[arg-type]

        for key in ("alpha_ratio", "lambda_ratio"):
            span = getattr(self, key)
            if span.start >= span.stop:
                raise wrong(
                    "{key}: start {start} should be less than stop {stop}", key=key, start=span.start, stop=span.stop
                )
        if self.alpha_ratio.stop < self.margin_alpha:
            raise wrong(
                "alpha_ratio: stop {stop} is below margin_alpha {margin}; it should be above it",
                stop=self.alpha_ratio.stop,
                margin=self.margin_alpha,
            )
        names = [other.name for other in self.compare]
        for i, name in enumerate(names):
            if name in names[:i] or name in TUNE_NAMES:
                raise wrong("compare[{i}].name: '{name}' is taken; choose another one", i=i, name=name)
        return self


TUNE_NAMES = ("tuned", "usual rule", "config")
"""What a comparison of gains always holds."""


class RangeTable(Table):
    """Values between two ends, evenly spaced on a log scale."""

    start: float = Field(gt=0.0, description="first value")
    stop: float = Field(gt=0.0, description="last value")
    num: int = Field(ge=2, le=8192, description="number of values")

    @model_validator(mode="after")
    def _ordered(self) -> "RangeTable":
        if self.start >= self.stop:
            raise PydanticCustomError(
                "range", "start {start} should be less than stop {stop}", {"start": self.start, "stop": self.stop}
            )
        return self

    def values(self) -> np.ndarray:
        """The values, shape (num,)."""
        return np.geomspace(self.start, self.stop, self.num)


class IdentifyTable(Table):
    """What `jaxbl identify` seeks in a log, and how."""

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


class MarkTable(GainPairTable):
    """A pair of gains to be marked in the atlas, run once on the study's drive."""

    name: str = Field(description="label")
    side: Literal["motor", "load"] = Field(default="motor", description="observer that has these gains")


class VerifyTable(Table):
    """What `jaxbl verify` does besides the study's own points: the normalised error system, and marks."""

    q: float | None = Field(default=None, gt=0.0, lt=1.0, description="q of condition (32); left out: its limit q → 0")
    alpha_ratio: RangeTable = Field(
        default_factory=lambda: RangeTable(start=1.02, stop=20.0, num=512), description="alpha / f_plus of the atlas"
    )
    lambda_ratio: RangeTable = Field(
        default_factory=lambda: RangeTable(start=0.002, stop=25.0, num=512), description="lambda / √f_plus of the atlas"
    )
    damping: list[Annotated[float, Field(gt=0.0, le=1000.0)]] = Field(
        default=[0.1, 0.3, 1.0],
        description="dampings (friction / inertia × velocity error / f_plus) whose boundaries are simulated",
    )
    marks: list[MarkTable] = Field(default=[], description="gains to be marked")

    @model_validator(mode="after")
    def _possible(self) -> "VerifyTable":
        if self.alpha_ratio.start <= 1.0:
            raise PydanticCustomError(
                "range",
                "alpha_ratio.start {start} should exceed 1: no lambda converges where alpha is not above f_plus",
                {"start": self.alpha_ratio.start},
            )
        return self


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
        def wrong(message: str, **context: Any) -> PydanticCustomError:
            return PydanticCustomError("axis", message, {"path": self.path, **context})  # type: ignore[arg-type]

        if self.values is not None:
            if self.start is not None or self.stop is not None or self.num is not None:
                raise wrong("axis {path} has both values and start/stop/num; give one of them")
            if not self.values:
                raise wrong("axis {path} is empty: values should list at least one value")
            if self.zip is None and len(set(self.values)) < len(self.values):
                raise wrong("axis {path} lists a value twice; values should differ")
            return self
        if self.start is None or self.stop is None:
            raise wrong("axis {path} should have values, or start and stop")
        if self.start >= self.stop:
            raise wrong("axis {path}: start {start} should be less than stop {stop}", start=self.start, stop=self.stop)
        if self.scale == "log" and self.start <= 0.0:
            raise wrong("axis {path}: a log scale needs start > 0, not {start}", start=self.start)
        if self.num == 1:
            raise wrong("axis {path}: num = 1 cannot span start ... stop; use values = [...] or num >= 2")
        return self

    def grid(self, depth: int = 0) -> np.ndarray:
        """The values of the axis, in its order; not for an axis that is sampled quasi-randomly (neither num nor values).

        Halved `depth` times: every 2^depth-th is then, to the bit, what it is without halving.
        """
        if self.values is not None:
            return np.array(self.values, dtype=object if any(isinstance(v, str) for v in self.values) else None)
        assert self.start is not None and self.stop is not None and self.num is not None
        space = np.geomspace if self.scale == "log" else np.linspace
        return space(self.start, self.stop, (self.num - 1 << depth) + 1)


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
            raise PydanticCustomError("figure", "a heatmap needs y, the path of its second axis", {})
        idle = {"series": "use facet", "where": "use facet", "theory": "use a line"}
        for key, hint in (idle if self.kind == "heatmap" else {"y": "use series or facet"}).items():
            if getattr(self, key) is not None:
                raise PydanticCustomError(
                    "figure", "a {kind} has no {key}; {hint}", {"kind": self.kind, "key": key, "hint": hint}
                )
        paths = [path for path in (self.x, self.y, self.facet, self.series) if path is not None]
        for path in paths:
            if paths.count(path) > 1:
                raise PydanticCustomError(
                    "figure", "{path} is used twice; x, y, facet and series should be different axes", {"path": path}
                )
            if path in (self.where or {}):
                raise PydanticCustomError(
                    "figure", "{path} is drawn and cannot be fixed by where; leave it out of one of them", {"path": path}
                )
        gains = [{f"observer.{side}.alpha", f"observer.{side}.lambda"} for side in ("motor", "load")]
        if self.overlays and {self.x, self.y} not in gains:
            raise PydanticCustomError(
                "figure", "overlays need a map over alpha and lambda of one observer; leave overlays out here", {}
            )
        return self


class Config(Table):
    """A study: everything that a run needs, validated."""

    include: str | list[str] = Field(
        default=[],
        exclude=True,
        description="TOML files, relative to this one, whose tables are merged in key by key: keys of this file win, those "
        "of later files over those of earlier ones; arrays, and tables of another kind or law, are replaced as a whole",
    )
    title: str = Field(default="", description="headline of the report")
    notes: list[str] = Field(default=[], description="remarks of the author, repeated in summary and report")
    drive: _Drive = Field(description="what is driven")  # type: ignore[valid-type]
    transmission: _Transmission | None = Field(default=None, description="law of the gear; none on a rigid drive")  # type: ignore[valid-type]
    effects: list[_Effect] = Field(default=[], description="effects beyond the nominal drive")  # type: ignore[valid-type]
    initial: _Initial = Field(default_factory=_Initial, description="state at t = 0")  # type: ignore[valid-type]
    excitation: _Excitation = Field(description="input torque")  # type: ignore[valid-type]
    encoders: _Encoders = Field(default_factory=_Encoders, description="position sensors")  # type: ignore[valid-type]
    observer: ObserverTable
    equivalent_control: _EquivalentControl = Field(  # type: ignore[valid-type]
        default_factory=_EquivalentControl, description="low-pass on the equivalent control"
    )
    identifier: _Identifier = Field(default_factory=_Identifier, description="recursive least squares")  # type: ignore[valid-type]
    run: RunTable = Field(default_factory=RunTable)
    sweep: SweepTable = Field(default_factory=SweepTable)
    uncertainty: UncertaintyTable = Field(default_factory=UncertaintyTable)
    tune: TuneTable | None = Field(default=None)
    log: LogTable = Field(default_factory=LogTable)
    identify: IdentifyTable = Field(default_factory=IdentifyTable)
    verify: VerifyTable = Field(default_factory=VerifyTable)
    axes: list[AxisTable] = Field(default=[])
    figures: list[FigureTable] = Field(default=[])

    @model_validator(mode="after")
    def _consistent(self) -> "Config":
        def wrong(message: str, **context: Any) -> PydanticCustomError:
            return PydanticCustomError("consistency", message, context)  # type: ignore[arg-type]

        if self.include:
            raise wrong("include is for read_config, which merges the files in")
        rigid = self.drive.kind == "rigid"
        if rigid and self.transmission is not None:
            raise wrong("[transmission] has no meaning on a rigid drive; remove it, or use drive.kind = 'two_inertia'")
        if rigid and self.observer.load is not None:
            raise wrong("observer.load has no meaning on a rigid drive; remove it")
        if not rigid and self.transmission is None:
            raise wrong("[transmission] is missing: a two_inertia drive needs a law")
        if not rigid and self.observer.load is None:
            raise wrong("observer.load is missing: a two_inertia drive has a load observer")
        if self.transmission is not None:
            rate = self.transmission.stiffness
            rate *= 1.0 / self.drive.motor_inertia + self.drive.gear_ratio**2 / self.drive.load_inertia
            # the scheme is stable while step * frequency < 2
            least = math.floor(self.run.sample_period * math.sqrt(rate) / 2.0) + 1
            if self.run.substeps < least:
                raise wrong(
                    "run.substeps: {given} plant steps a sample are unstable for this stiffness and sample_period; "
                    "at least {least} are needed, ten times as many for accuracy",
                    given=self.run.substeps,
                    least=least,
                )
        for i, other in enumerate(() if self.tune is None else self.tune.compare):
            if rigid and other.load is not None:
                raise wrong("tune.compare[{i}].load has no meaning on a rigid drive; remove it", i=i)
            if not rigid and other.load is None:
                raise wrong("tune.compare[{i}].load is missing: a two_inertia drive has a load observer", i=i)
        for i, mark in enumerate(self.verify.marks):
            if rigid and mark.side == "load":
                raise wrong("verify.marks[{i}].side: 'load' has no meaning on a rigid drive; it should be 'motor'", i=i)
        for i, effect in enumerate(self.effects):
            place = effect.kind.partition(".")[0]
            if rigid and (place == "transmission" or (place == "load" and "motor" in EFFECTS[effect.kind].places)):
                raise wrong(
                    "effects[{i}]: {kind} has no meaning on a rigid drive; motor.* and actuator.* effects act on it",
                    i=i,
                    kind=effect.kind,
                )
        for side in ("motor",) if rigid else ("motor", "load"):
            nominal = getattr(self.drive, f"{side}_inertia")
            heavier = [effect for effect in self.effects if effect.kind.partition(".")[0] == side]
            total = nominal + sum(float(effect.build().added_inertia()) for effect in heavier)
            if total <= 0.0:
                raise wrong(
                    "effects: {kind} leaves a total inertia of {total} on the {side}; it should stay above -{nominal}",
                    kind=next(one.kind for one in heavier if float(one.build().added_inertia()) < 0.0),
                    side=side,
                    total=f"{total:g}",
                    nominal=f"{nominal:g}",
                )
        known = numeric_paths(self)
        for path in self.uncertainty.exact:
            if path not in known and path != "drive.gear_ratio":
                raise wrong("uncertainty.exact: unknown path '{path}'; {hint}", path=path, hint=_nearest_path(path, known))
        return self

    def build(self) -> Experiment:
        """The experiment that the config describes, with Python numbers as leaves."""
        rigid = self.drive.kind == "rigid"
        return Experiment(
            drive=self.drive.build(),
            transmission=None if self.transmission is None else self.transmission.build(),
            effects=tuple(effect.build() for effect in self.effects),
            initial=self.initial.build(),
            excitation=self.excitation.build(),
            encoders=self.encoders.build(),
            observer=self.observer.build(),
            equivalent_control=self.equivalent_control.build(),
            identifier=None if rigid else self.identifier.build(),
            run=self.run.build(),
        )

    def resolved(self) -> dict[str, Any]:
        """The whole config as plain data, defaults filled in."""
        return self.model_dump(by_alias=True, exclude_none=True)

    def to_toml(self) -> str:
        """The whole config as TOML that :func:`read_config` takes."""
        return tomli_w.dumps(self.resolved())


def read_config(source: str | Path | Mapping[str, Any] | Config) -> Config:
    """Read and validate a study from a TOML file, a mapping, or a config.

    Raises:
        InputError: unreadable file, bad TOML, unknown key, wrong type or range; one line that names file and key.
    """
    return source if isinstance(source, Config) else _validate(*_read(source))


_UNGIVEN = {"lambda": 1.0, "alpha": 1.0}


def read_model(source: str | Path | Mapping[str, Any] | Config) -> tuple[Config, frozenset[str]]:
    """Read a study that is to be held against a log: `[excitation]` and the observers' gains may be missing.

    Returns:
        The study, with something harmless in place of what is missing; and what is: `excitation`, `observer.motor`,
        `observer.load`.

    Raises:
        InputError: as :func:`read_config`.
    """
    if isinstance(source, Config):
        return source, frozenset()
    data, name, origins = _read(source)
    missing = set()
    if "excitation" not in data:
        missing.add("excitation")
        data["excitation"] = {"kind": "sine", "amplitude": 0.0, "frequency": 1.0}
    drive, observer = data.get("drive"), data.setdefault("observer", {})
    rigid = isinstance(drive, dict) and drive.get("kind") == "rigid"
    for side in ("motor",) if rigid else ("motor", "load"):
        if isinstance(observer, dict) and side not in observer:
            missing.add(f"observer.{side}")
            observer[side] = dict(_UNGIVEN)
    return _validate(data, name, origins), frozenset(missing)


def _read(source: str | Path | Mapping[str, Any]) -> tuple[dict[str, Any], str, dict[Key, str]]:
    """Data of a study with what it includes, how messages call it, and the file that each key came from."""
    if isinstance(source, Mapping):
        name, data, folder = "config", copy.deepcopy(dict(source)), Path()
    else:
        path = Path(source)
        name, data, folder = str(path), _load(path), path.parent
        _localise(data, folder)
    origins: dict[Key, str] = {}
    chain = [] if isinstance(source, Mapping) else [Path(source).resolve()]
    return _included(data, name, folder, chain, origins), name, origins


def read_log_config(path: Path) -> tuple[LogTable, float | None]:
    """The `[log]` table of a TOML file and the gear ratio, if it has one: a whole study, or nothing but `[log]`.

    Raises:
        InputError: unreadable file, bad TOML, unknown key, wrong type or range; one line that names file and key.
    """
    data = _included(_load(path), str(path), path.parent, [path.resolve()], {})
    if set(data) <= {"title", "notes", "log"}:
        return read_log_table(data.get("log"), str(path)), None
    config, _ = read_model(path)
    return config.log, None if config.drive.kind == "rigid" else config.drive.gear_ratio


def _load(path: Path) -> dict[str, Any]:
    """A TOML file as it stands."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; a TOML file is needed") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not text in UTF-8; a TOML file is needed") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None


def _localise(data: dict[str, Any], folder: Path) -> None:
    """Make files that a config names relative to the folder it lies in."""
    tune = data.get("tune")
    for table in (data.get("excitation"), tune.get("holdout") if isinstance(tune, dict) else None):
        if isinstance(table, dict) and isinstance(table.get("file"), str):
            table["file"] = str((folder / table["file"]).resolve())


def _included(data: dict[str, Any], name: str, folder: Path, chain: list[Path], origins: dict[Key, str]) -> dict[str, Any]:
    """The data with the files that it includes merged in.

    Args:
        data: a config, of which `include` is taken out.
        name: how messages call it.
        folder: where the included files are looked for.
        chain: files that led here.
        origins: gets the file that each key of an included file came from.
    """
    files = data.pop("include", [])
    files = [files] if isinstance(files, str) else files
    if not isinstance(files, list) or not all(isinstance(file, str) for file in files):
        raise InputError(f"{name}: include: should be a file name or an array of them, not {brief(files)}")
    merged: dict[str, Any] = {}
    for file in files:
        path = folder / file
        if not path.exists():
            raise InputError(f"{name}: include: {path}: no such file")
        if path.resolve() in chain:
            raise InputError(f"{name}: include: {path} includes this file in turn; files should not include one another")
        inner = _load(path)
        _localise(inner, path.parent)
        found: dict[Key, str] = {}
        inner = _included(inner, str(path), path.parent, [*chain, path.resolve()], found)
        _merge(merged, inner, origins, {key: str(path) for key in _keys(inner)} | found)
    _merge(merged, data, origins, dict.fromkeys(_keys(data), name))
    return merged


def _keys(data: Any, key: Key = ()) -> Iterator[Key]:
    """Places of everything in a config."""
    pairs = data.items() if isinstance(data, Mapping) else enumerate(data) if isinstance(data, list) else ()
    for name, value in pairs:
        yield (*key, name)
        yield from _keys(value, (*key, name))


def _merge(into: dict[str, Any], data: dict[str, Any], origins: dict[Key, str], new: dict[Key, str], key: Key = ()) -> None:
    """Put the keys of `data` over those of `into`, and `new` over their `origins`."""
    for name, value in data.items():
        here, old = (*key, name), into.get(name)
        origins[here] = new[here]
        # a table of another kind is another table
        if (
            isinstance(old, dict)
            and isinstance(value, dict)
            and all(value.get(tag, old.get(tag)) == old.get(tag) for tag in ("kind", "law"))
        ):
            _merge(old, value, origins, new, here)
        else:
            into[name] = copy.deepcopy(value)
            origins |= {place: file for place, file in new.items() if place[: len(here)] == here}


def _validate(data: dict[str, Any], name: str = "", origins: Mapping[Key, str] | None = None) -> Config:
    try:
        return Config.model_validate(data)
    except ValidationError as error:
        place, text = _describe(error)
        # the file that the key came from, where that is not the one asked for
        while place and origins is not None and place not in origins:
            place = place[:-1]
        name = name if origins is None else origins.get(place, name)
        raise InputError(f"{name}: {text}" if name else text) from None


_UNIONS = {("drive",): 1, ("transmission",): 1, ("excitation",): 1, ("effects",): 2, ("tune", "holdout"): 2}
"""Unions, and how far into a location pydantic puts the tag of their member."""


def _describe(error: ValidationError) -> tuple[Key, str]:
    """The first error: the key that is wrong, and one line that says so."""
    location = list(error.errors()[0]["loc"])
    for union, tag in _UNIONS.items():
        if tuple(location[: len(union)]) == union and len(location) > tag:
            del location[tag]
    if location[:1] == ["axes"] and "values" in location:
        del location[4:]  # the member of the union that came last
    if location[:1] == ["figures"] and "where" in location:
        del location[4:]
    return describe(error, location)


def numeric_paths(config: Config) -> dict[str, Parameter]:
    """Dotted paths of everything that an axis may vary in this config, with unit and description."""
    found: dict[str, Parameter] = {}
    for section in ("drive", "transmission", "initial", "excitation", "encoders", "observer", "equivalent_control",
                    "identifier", "run"):  # fmt: skip
        table = getattr(config, section)
        if table is not None:
            found |= dict(_paths(table, section))
    kinds = [effect.kind for effect in config.effects]
    for i, effect in enumerate(config.effects):
        label = effect.kind if kinds.count(effect.kind) == 1 else str(i)
        found |= dict(_paths(effect, f"effects.{label}"))
    found.pop("run.precision", None)
    if config.drive.kind == "rigid":
        return {
            path: known
            for path, known in found.items()
            if path.startswith("effects.") or ("load" not in path and not path.startswith("identifier."))
        }
    return found


_NOT_NUMBERS = ("kind", "law", "file", "time_column", "torque_column")


def _paths(table: Table, prefix: str) -> Iterator[tuple[str, Parameter]]:
    for name, field in type(table).model_fields.items():
        value = getattr(table, name)
        path = f"{prefix}.{field.alias or name}"
        if isinstance(value, Table):
            yield from _paths(value, path)
        elif name not in _NOT_NUMBERS:
            extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
            yield path, Parameter(str(extra.get("unit", "")), field.description or "")


def with_values(config: Config, values: Mapping[str, Any]) -> Config:
    """A copy of the config with other values at some dotted paths.

    Raises:
        InputError: a path that does not exist (the nearest valid one is named), or a value out of range.
    """
    data = config.resolved()
    known = numeric_paths(config)
    for path, value in values.items():
        if path not in known:
            raise InputError(f"unknown path '{path}'; {_nearest_path(path, known)}")
        section, *keys = path.split(".")
        if section == "effects":
            kind, _, key = path.removeprefix("effects.").rpartition(".")
            kinds = [effect.kind for effect in config.effects]
            target = data["effects"][int(kind) if kind.isdigit() else kinds.index(kind)]
        else:
            *tables, key = keys
            target = data.setdefault(section, {})
            for table in tables:
                target = target.setdefault(table, {})
        if type(target.get(key)) is int and isinstance(value, float) and value.is_integer():
            value = int(value)  # a whole number from start, stop and num
        target[key] = value
    return _validate(data)


def _nearest_path(path: str, known: Mapping[str, Parameter]) -> str:
    close = difflib.get_close_matches(path, list(known), n=1, cutoff=0.3)
    return f"nearest valid path: '{close[0]}'" if close else f"valid paths: {', '.join(known)}"


def precision(config: Config) -> Any:
    """Context in which the config's floating-point type is JAX's default."""
    return jax.enable_x64(config.run.precision == "float64")


def prepare(config: Config) -> Experiment:
    """The config's experiment with array leaves of its precision; call inside :func:`precision`."""
    return as_arrays(config.build(), jnp.dtype(config.run.precision))
