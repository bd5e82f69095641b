"""The whole study: its tables, what they ask of each other, and the experiment that they describe.

What the config says is found again in the experiment under the same dotted path.
"""

# pyright: reportInvalidTypeForm=false
# types of keys are made as the module is imported

import difflib
import math
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import tomli_w
from pydantic import Field, model_validator

from jaxbl.chain import Experiment, Run
from jaxbl.drive import DRIVES, AbstractDrive
from jaxbl.drive.effects import EFFECTS
from jaxbl.drive.excitation import EXCITATIONS
from jaxbl.drive.parameters import Parameter, as_arrays, parameters
from jaxbl.errors import InputError
from jaxbl.observer import OBSERVERS
from jaxbl.records import NominalDrive
from jaxbl.records.table import LogTable
from jaxbl.validation import table_error

from .experiment import (
    ControllerTable,
    DriveTable,
    EffectTable,
    EncodersTable,
    EquivalentControlTable,
    ExcitationTable,
    IdentifierTable,
    InitialTable,
    ObserverTable,
    ReferenceTable,
    RunTable,
    TransmissionTable,
)
from .gains import TuneTable, VerifyTable
from .logs import IdentifyTable, UncertaintyTable
from .sweep import AxisTable, FigureTable, SweepTable
from .tables import Table, declare_key


class Config(Table):
    """A study: everything that a run needs, validated."""

    include: str | list[str] = declare_key(
        "TOML files, relative to this one, whose tables are merged in key by key: keys of this file win, those "
        "of later files over those of earlier ones; arrays, and tables of another kind or law, are replaced as a whole",
        [],
        exclude=True,
    )
    title: str = declare_key("headline of the report", "", max_length=500)
    notes: list[str] = declare_key("remarks of the author, repeated in summary and report", [])
    drive: DriveTable = declare_key("what is driven")
    transmission: TransmissionTable | None = declare_key("law of the gear; none on a rigid drive", None)
    effects: list[EffectTable] = declare_key("effects beyond the nominal drive", [], max_length=100)
    initial: InitialTable = declare_key("state at t = 0", default_factory=InitialTable)
    excitation: ExcitationTable = declare_key(
        "input torque; with a controller it is added to that one's, and may be left out"
    )
    encoders: EncodersTable = declare_key("position sensors", default_factory=EncodersTable)
    observer: ObserverTable
    equivalent_control: EquivalentControlTable = declare_key(
        "low-pass on the equivalent control", default_factory=EquivalentControlTable
    )
    identifier: IdentifierTable = declare_key("recursive least squares", default_factory=IdentifierTable)
    controller: ControllerTable | None = declare_key("what closes the loop", None)
    reference: ReferenceTable | None = declare_key("position that the controlled side is to follow", None)
    run: RunTable = Field(default_factory=RunTable)
    sweep: SweepTable = Field(default_factory=SweepTable)
    uncertainty: UncertaintyTable = Field(default_factory=UncertaintyTable)
    tune: TuneTable | None = None
    log: LogTable = Field(default_factory=LogTable)
    identify: IdentifyTable = Field(default_factory=IdentifyTable)
    verify: VerifyTable = Field(default_factory=VerifyTable)
    axes: list[AxisTable] = Field([], max_length=50)
    figures: list[FigureTable] = Field([], max_length=200)

    @model_validator(mode="before")
    @classmethod
    def _without_input(cls, study: Any) -> Any:
        """A controller needs no further input."""
        if isinstance(study, Mapping) and "controller" in study and "excitation" not in study:
            return dict(study) | {"excitation": {"kind": "sine", "amplitude": 0.0, "frequency": 0.0}}
        return study

    @model_validator(mode="after")
    def _consistent(self) -> "Config":
        if self.include:
            raise table_error("include is for read_config, which merges the files in")
        _check_sides(self)
        _check_effects(self)
        _check_input(self)
        if (self.controller is None) != (self.reference is None):
            missing = "[controller]" if self.controller is None else "[reference]"
            raise table_error(f"{missing} is missing: a controller and the reference that it follows belong together")
        paths = numeric_paths(self)
        for path in self.uncertainty.exact:
            if path not in paths and path != "drive.gear_ratio" and path not in EFFECTS:
                raise table_error(f"uncertainty.exact: unknown path '{path}'; {suggest_path(path, paths)}")
        return self

    @property
    def sides(self) -> tuple[str, ...]:
        """The sides of the drive that have an encoder and an observer."""
        return DRIVES[self.drive.kind].sides

    @property
    def is_geared(self) -> bool:
        """True if a transmission acts between motor and load that both have encoders."""
        return self.transmission is not None and "load" in self.sides

    @property
    def axis_paths(self) -> list[str]:
        """Paths of the axes, in their order."""
        return [axis.path for axis in self.axes]

    def parts(self) -> dict[str, Table]:
        """The tables of what this study's experiment consists of beside effects, by name."""
        names = ("drive", "transmission", "initial", "excitation", "encoders", "observer", "equivalent_control",
                 "identifier", "run", "controller", "reference")  # fmt: skip
        tables = {name: getattr(self, name) for name in names if name != "identifier" or self.is_geared}
        return {name: table for name, table in tables.items() if table is not None}

    def build(self) -> Experiment:
        """Build the experiment that the config describes, with Python numbers as leaves.

        Raises:
            InputError: a recorded input or reference cannot be read, or ends before the run.
        """
        run = self.run
        for table in (self.excitation, self.reference):
            if table is None or table.kind != "recorded":
                continue
            # half a sample for the rounding of times, one for the last value's own hold
            if table.length < run.duration - 2.0 * run.sample_period:
                raise InputError(
                    f"{table.file}: ends after {table.length:g} s, and the run only after {run.duration:g} s; "
                    f"run.duration should be at most {table.length:g}"
                )
        effects = tuple(effect.build() for effect in self.effects)
        return Experiment(effects=effects, **{name: table.build() for name, table in self.parts().items()})

    def nominal_drive(self) -> NominalDrive:
        """Return the nominal numbers that a log of the drive is checked against."""
        # those of the drive have the same names
        numbers = self.drive.model_dump(exclude={"kind"})
        law = None if self.transmission is None else self.transmission.build()
        effects = [effect.build() for effect in self.effects]
        # what remembers its input acts late
        acts_late = any(effect.place == "actuator" and jax.tree.leaves(effect.init()) for effect in effects)
        if law is not None:
            numbers |= {"stiffness": float(getattr(law, "stiffness", None) or math.inf), "half_gap": float(law.half_gap)}
        return NominalDrive(**numbers, dead_time="modelled" if acts_late else "no")

    def to_dict(self) -> dict[str, Any]:
        """Return the config as plain data with defaults filled in."""
        # what is wrong in a config whose attributes were set is for read_config to say
        return self.model_dump(by_alias=True, exclude_none=True, warnings=False)

    def with_keys(self, table: str, **keys: Any) -> "Config":
        """Return a copy with other keys in a table; they are not checked."""
        return self.model_copy(update={table: getattr(self, table).model_copy(update=keys)})

    def to_toml(self) -> str:
        """The whole config as TOML that :func:`.reading.read_config` takes."""
        return tomli_w.dumps(self.to_dict())


_MOST_SUBSTEPS = next(parameter.maximum for field, parameter in parameters(Run) if field.name == "substeps")


def _check_sides(config: Config) -> None:
    """Require a law where two sides are connected by one, an observer of each side, and steps that resolve the gear."""
    kind, cls, rigid = config.drive.kind, DRIVES[config.drive.kind], "load" not in config.sides
    tune = config.tune or TuneTable()
    if config.transmission is not None and "load" not in (*cls.sides, *cls.hidden):
        raise table_error(f"[transmission] has no meaning on a {kind} drive; remove it, or use drive.kind = 'two_inertia'")
    if config.transmission is None and not rigid and cls.body_torques is AbstractDrive.body_torques:
        raise table_error(f"[transmission] is missing: a {kind} drive needs one, such as law = 'dead_zone'")
    gains = {"observer": config.observer} | {f"tune.compare[{i}]": other for i, other in enumerate(tune.compare)}
    for name, table in gains.items():
        with_table = {"motor", *(table.model_extra or {})} | (set() if table.load is None else {"load"})
        for side in sorted(with_table - {*config.sides}):
            raise table_error(f"{name}.{side} has no meaning on a {kind} drive; remove it")
        for side in sorted({*config.sides} - with_table):
            raise table_error(f"{name}.{side} is missing: a {kind} drive has a {side} observer; give its lambda and alpha")
    marks = {f"verify.marks[{i}]": mark for i, mark in enumerate(config.verify.marks)}
    for name, table in ({"controller": config.controller} | marks).items():
        if rigid and getattr(table, "side", "") == "load":
            raise table_error(f"{name}.side: 'load' has no meaning on a {kind} drive; it should be 'motor'")
    if rigid and getattr(config.controller, "gap_from", None) == "twist":
        raise table_error(f"controller.gap_from: a {kind} drive has no twist; it should be 'reference'")
    if rigid and tune.certificate is not None and tune.certificate.load is not None:
        raise table_error(f"tune.certificate.load has no meaning on a {kind} drive; remove it")
    if config.transmission is not None:
        drive, rate = config.drive.build(), config.transmission.build().stiffness
        rate *= 1.0 / drive.inertia("motor") + drive.ratio("load") ** 2 / drive.inertia("load")
        # the scheme is stable while step * frequency < 2
        least_substeps = math.floor(config.run.sample_period * math.sqrt(rate) / 2.0) + 1
        if least_substeps > _MOST_SUBSTEPS:
            raise table_error(
                f"drive, transmission: inertias and stiffness make an oscillation of {math.sqrt(rate):.3g} rad/s, which "
                f"{_MOST_SUBSTEPS} plant steps a sample cannot resolve; check their units"
            )
        if config.run.substeps < least_substeps:
            raise table_error(
                f"run.substeps: {config.run.substeps} plant steps a sample are unstable for this stiffness and "
                f"sample_period; at least {least_substeps} are needed, ten times as many for accuracy"
            )


def _check_effects(config: Config) -> None:
    """Effects act on what the drive has, their numbers agree, and they leave each side some inertia."""
    drive = config.drive.build()
    rigid = "load" not in drive.bodies
    for i, effect in enumerate(config.effects):
        cls, place = EFFECTS[effect.kind], effect.kind.partition(".")[0]
        twice = place == "load" and rigid and "motor" in cls.places
        geared = config.transmission is not None or (rigid and cls.suits(None))
        places = {*drive.bodies, "actuator", "encoder", *(("transmission",) if geared else ())}
        if twice or drive.resolve_place(place) not in places:
            same = f"it should be '{effect.kind.replace('load', 'motor')}'"
            remedy = same if twice else "remove it, or use drive.kind = 'two_inertia'"
            raise table_error(f"effects[{i}]: {effect.kind} has no meaning on a {config.drive.kind} drive; {remedy}")
        if fault := cls.find_fault(effect.model_dump(), config.run.sample_period):
            raise table_error(f"effects[{i}]: {effect.kind}: {fault}")
    for side in drive.bodies:
        nominal = drive.inertia(side)
        effects = [effect for effect in config.effects if effect.kind.startswith(f"{side}.")]
        added = [(float(effect.build().added_inertia()), effect.kind) for effect in effects]
        if (total := nominal + sum(inertia for inertia, _ in added)) <= 0.0:
            raise table_error(
                f"effects: {min(added)[1]} leaves a total inertia of {total:g} on the {side}; "
                f"it should stay above -{nominal:g}"
            )


def _check_input(config: Config) -> None:
    """The samples of an input have to show it."""
    for key, table in (("excitation", config.excitation), ("tune.holdout", (config.tune or TuneTable()).holdout)):
        if table is not None and (fault := EXCITATIONS[table.kind].find_fault(dict(table), config.run.sample_period)):
            raise table_error(f"{key}: {fault}")


def numeric_paths(config: Config) -> dict[str, Parameter]:
    """Return all paths that an axis may vary in this config, with unit and description."""
    parameters_by_path: dict[str, Parameter] = {}
    for name, table in config.parts().items():
        parameters_by_path |= dict(_paths(table, name))
    parameters_by_path[KIND_PATH] = Parameter("", "kind of observer")
    if config.observer.observer is OBSERVERS[config.observer.kind]:
        # there is one discretisation
        del parameters_by_path["observer.discretisation"]
    if "load" not in config.sides:
        parameters_by_path = {
            path: parameter
            for path, parameter in parameters_by_path.items()
            if "load" not in path or path.startswith("drive.")
        }
    kinds = [effect.kind for effect in config.effects]
    for i, effect in enumerate(config.effects):
        label = effect.kind if kinds.count(effect.kind) == 1 else str(i)
        parameters_by_path |= dict(_paths(effect, f"effects.{label}"))
    return parameters_by_path


KIND_PATH = "observer.kind"
"""Path of the kind of observer, which an axis may vary."""
_FIXED = ("kind", "law", "file", "time_column", "torque_column", "position_column", "precision")
"""Keys that no axis varies."""


def _paths(table: Table, prefix: str) -> Iterator[tuple[str, Parameter]]:
    for side, gains in (table.model_extra or {}).items():
        # gains of other kinds of observers are no numbers of this study
        if isinstance(gains, Table):
            yield from _paths(gains, f"{prefix}.{side}")
    for name, field in type(table).model_fields.items():
        value = getattr(table, name)
        path = f"{prefix}.{field.alias or name}"
        if isinstance(value, Table):
            yield from _paths(value, path)
        elif name not in _FIXED and not isinstance(value, (list, bool)):
            extra: Any = field.json_schema_extra
            yield path, Parameter(extra["unit"], field.description or "")


def suggest_path(path: str, paths: Mapping[str, Parameter]) -> str:
    """A hint that names the nearest valid path, or all of them where none is near."""
    close = difflib.get_close_matches(path, list(paths), n=1, cutoff=0.3)
    return f"nearest valid path: '{close[0]}'" if close else f"valid paths: {', '.join(paths)}"


def precision(config: Config) -> Any:
    """Context in which the config's floating-point type is JAX's default."""
    return jax.enable_x64(config.run.precision == "float64")


def prepare(config: Config) -> Experiment:
    """Build the config's experiment with array leaves of its precision; call inside :func:`precision`.

    Raises:
        InputError: JAX computes in float32 here, the study in float64.
    """
    dtype = jnp.dtype(config.run.precision)
    if jax.dtypes.canonicalize_dtype(dtype) != dtype:
        raise InputError("run.precision: is float64, and JAX computes in float32 here; call it inside precision(config)")
    return as_arrays(config.build(), dtype)
