"""Tables of what is simulated: drive, transmission, effects, input, sensors, observers, and the run."""

# pyright: reportInvalidTypeForm=false
# types of keys are made as the module is imported

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, ConfigDict, create_model, model_validator

from jaxbl.chain import Run
from jaxbl.control import CONTROLLERS, REFERENCES, RecordedReference
from jaxbl.drive import DRIVES, Initial
from jaxbl.drive.effects import EFFECTS, make_effect
from jaxbl.drive.encoders import Encoders
from jaxbl.drive.excitation import EXCITATIONS, Recorded
from jaxbl.drive.parameters import config_key, parameters
from jaxbl.drive.transmission import TRANSMISSIONS
from jaxbl.errors import InputError
from jaxbl.observer import DISCRETISATIONS, OBSERVERS, AbstractObserver, EquivalentControl, Identifier, Observers
from jaxbl.records.files import read_log_file
from jaxbl.validation import table_error

from .tables import Table, declare_key, table_for, tagged_union


class _FileTable(Table):
    """A signal over time in a file."""

    kind: Literal["recorded"]
    file: str = declare_key("CSV or Parquet file; relative to the config file")
    time_column: str = declare_key("column of times in s", "t")

    @property
    def length(self) -> float:
        """Time from the first to the last value, s."""
        times, _ = self._load_columns()
        return float(times[-1])

    def _load_columns(self) -> tuple[np.ndarray, np.ndarray]:
        """Load times from the first one on, s, and the signal, shape (rows,). Raises `InputError`."""
        path = Path(self.file)
        (column,) = (value for name, value in self if name.endswith("_column") and name != "time_column")
        file = read_log_file(path, (self.time_column, column))
        times = file.load_numbers(self.time_column)
        file.check_length(file.find_column(column), len(times))
        signal = file.load_numbers(column)
        if (np.diff(times) <= 0.0).any():
            row = int(np.argmax(np.diff(times) <= 0.0)) + 2
            raise InputError(f"{path}: column '{self.time_column}', data row {row}: times should increase")
        return times - times[0], signal


class RecordedTable(_FileTable):
    """Input from a CSV or Parquet file (or a log file of another kind), played back with zero-order hold."""

    torque_column: str = declare_key("column of torques in N m", "u")
    gain: float = declare_key("factor on the recorded torque", 1.0)

    def build(self) -> Recorded:
        return Recorded(*self._load_columns(), gain=self.gain)  # type: ignore[arg-type]


class RecordedReferenceTable(_FileTable):
    """Reference from a file as that of a recorded input; a cubic spline joins its positions."""

    position_column: str = declare_key("column of positions in rad, of the controlled side", "reference")
    gain: float = declare_key("factor on the recorded position", 1.0)

    def build(self) -> RecordedReference:
        return RecordedReference.through(*self._load_columns(), gain=self.gain)


_FILE_TABLES = {Recorded: RecordedTable, RecordedReference: RecordedReferenceTable}


def _signal_table(kind: str, cls: type) -> type[Table]:
    return _FILE_TABLES.get(cls) or table_for(cls, kind=kind)


DriveTable = tagged_union(DRIVES)
TransmissionTable = tagged_union(TRANSMISSIONS, lambda law, cls: table_for(cls, law=law), "law")
ExcitationTable = tagged_union(EXCITATIONS, _signal_table)
EffectTable = tagged_union(EFFECTS, lambda kind, cls: table_for(cls, partial(make_effect, kind), kind=kind))
ControllerTable = tagged_union(CONTROLLERS)
ReferenceTable = tagged_union(REFERENCES, _signal_table)
InitialTable = table_for(Initial)
EncodersTable = table_for(Encoders)
EquivalentControlTable = table_for(EquivalentControl)
IdentifierTable = table_for(Identifier)


def _list_keys(schema: Any, table: Any) -> None:
    schema["propertyNames"] = {"enum": [*schema["properties"], *table.further_keys()]}


class _GainsTable(Table):
    """Gains of an observer. Those of other kinds may stand beside them, for studies over `observer.kind`."""

    model_config = ConfigDict(extra="allow", json_schema_extra=_list_keys)
    __pydantic_extra__: dict[str, float]

    @classmethod
    def further_keys(cls) -> list[str]:
        keys = (config_key(field.name) for observer in OBSERVERS.values() for field, _ in parameters(observer))
        own_keys = {field.alias for field in cls.model_fields.values()}
        return [key for key in dict.fromkeys(keys) if key not in own_keys]


class _ObserverTable(Table):
    """Observers of both sides, and of further ones that a drive of one's own has."""

    discretisation: Literal[tuple(DISCRETISATIONS)] = declare_key(
        "of kind super_twisting. implicit: proximal backward Euler; explicit: forward Euler of (7)", "implicit"
    )

    @property
    def observer(self) -> type[AbstractObserver]:
        """Class of the observers."""
        return OBSERVERS[self.kind].select_discretisation(self.discretisation)

    def build(self) -> Observers:
        """The observers, without gains of other kinds."""
        names = [field.name for field, _ in parameters(self.observer)]
        sides = {"motor": self.motor, "load": self.load, **(self.model_extra or {})}
        return Observers.of(
            **{
                side: gains and self.observer(**{name: getattr(gains, name) for name in names})
                for side, gains in sides.items()
            }
        )

    @classmethod
    def further_keys(cls) -> set[str]:
        return {side for drive in DRIVES.values() for side in drive.sides} - {*cls.model_fields}


def _observer_table(kind: str, cls: type[AbstractObserver]) -> type[Table]:
    """The table of observers of a kind."""
    gains = table_for(cls, base=_GainsTable)
    sides: dict[str, Any] = {
        "motor": (gains, declare_key("gains of the motor observer")),
        "load": (gains | None, declare_key("gains of the load observer; none on a rigid drive", None)),
    }
    tag: Any = (Literal[kind], declare_key("kind of observer", kind if kind == _USUAL else ...))

    class WithFurther(_ObserverTable):
        model_config = ConfigDict(extra="allow")
        __pydantic_extra__: dict[str, gains]

    return create_model(f"{cls.__name__}Table", __base__=WithFurther, __doc__=cls.__doc__, kind=tag, **sides)


_USUAL = "super_twisting"
ObserverTable = Annotated[
    tagged_union(OBSERVERS, _observer_table),
    BeforeValidator(lambda table: {"kind": _USUAL} | dict(table) if isinstance(table, Mapping) else table),
]


_MOST_STEPS = 2e9
"""Samples are counted in 32 bits."""


class _RunTable(Table):
    """The keys of a run from which its number of samples and the type of its numbers follow."""

    duration: float = declare_key("length of the run", 20.0, unit="s", gt=0.0)
    precision: Literal["float64", "float32"] = declare_key("floating-point type of the run", "float64")

    @property
    def steps(self) -> int:
        """Number of samples."""
        return round(self.duration / self.sample_period)

    @model_validator(mode="after")
    def _long_enough(self) -> "_RunTable":
        if self.sample_period > self.duration:
            raise table_error(
                f"sample_period {self.sample_period} s is longer than duration {self.duration} s; "
                "it should be a small part of it"
            )
        if self.duration / self.sample_period > _MOST_STEPS:
            raise table_error(
                f"duration {self.duration} s holds more than {_MOST_STEPS:.0e} samples of {self.sample_period} s; "
                "it should hold fewer"
            )
        if self.steps < 8:
            raise table_error(
                f"duration {self.duration} s holds only {self.steps} samples of {self.sample_period} s; "
                "at least 8 are needed"
            )
        return self

    def build(self) -> Run:
        return Run(steps=self.steps, **{field.name: getattr(self, field.name) for field, _ in parameters(Run)})


RunTable = table_for(Run, base=_RunTable)
