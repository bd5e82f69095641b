"""The `[log]` table of a study: which columns a measured log has, and how they become SI units."""

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from jaxbl.validation import Positive, StrictTable, table_error

from .libraries import ColumnName


def _require(is_valid: Callable[[Any], Any], text: str) -> BeforeValidator:
    """Return a validator that refuses other values with a text."""

    def check(value: Any) -> Any:
        if not is_valid(value):
            raise PydanticCustomError("kind", "{text}", {"text": text})
        return value

    return BeforeValidator(check)


_NUMBERS = int, float
_COLUMN_TEXT = "should be a column's name, or its number counted from 0"
_Column = Annotated[ColumnName, _require(lambda v: type(v) is str or (type(v) is int and v >= 0), _COLUMN_TEXT)]
_Skew = Annotated[
    float | Literal["estimate"],
    _require(lambda v: type(v) in _NUMBERS or v == "estimate", "should be a number of seconds or 'estimate'"),
]
_Sign = Annotated[int, _require(lambda v: type(v) in _NUMBERS and v in (1, -1), "should be 1 or -1")]

_SECONDS: Any = {"unit": "s"}


def _optional(description: str, **keywords: Any) -> Any:
    """Return the field of a key that may be left out."""
    return Field(default=None, description=description, **keywords)


class _ColumnTable(StrictTable):
    """Keys common to time and channels; a column's name or number alone stands for a table with only that key."""

    column: _Column | None = _optional("name of the column, or its number counted from 0; left out: the channel's own name")

    @model_validator(mode="before")
    @classmethod
    def _expand_column(cls, data: Any) -> Any:
        if isinstance(data, str) or (isinstance(data, int) and not isinstance(data, bool)):
            return {"column": data}
        return data

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: Any, handler: Any) -> dict[str, Any]:
        return {"anyOf": [{"type": ["string", "integer"]}, handler(schema)], "description": (cls.__doc__ or "").strip()}

    def column_or(self, name: str) -> ColumnName:
        """Return the `column` key, or `name` if it is left out."""
        return name if self.column is None else self.column


class TimeTable(_ColumnTable):
    """The time stamps of a log."""

    unit: Literal["s", "ms", "us", "ns"] = Field(default="s", description="unit of the stamps")
    period: Positive | None = _optional("sampling period of a log without stamps", gt=0.0, json_schema_extra=_SECONDS)

    @model_validator(mode="after")
    def _check_source(self) -> "TimeTable":
        if self.period is not None and self.column is not None:
            raise table_error("has both column and period; period is for logs without time stamps")
        return self


class _ChannelTable(_ColumnTable):
    """Keys common to measured channels."""

    sign: _Sign = Field(default=1, description="-1 if the column counts the other way; 1 or -1")
    signed_bits: int | None = _optional("word length of two's complement numbers that were logged as unsigned", ge=2, le=63)
    sign_bit: int | None = _optional("bit, counted from 0, that is the sign of sign-magnitude words", ge=1, le=62)

    @model_validator(mode="after")
    def _check_words(self) -> Any:
        if self.signed_bits is not None and self.sign_bit is not None:
            raise table_error("has both signed_bits and sign_bit; two's complement words have no bit for the sign alone")
        return self


class _MotionTable(_ChannelTable):
    """Keys common to positions and speeds."""

    unit: Any

    @property
    def si_unit(self) -> str:
        """Unit of the position: m on a linear axis, else rad."""
        return "m" if self.unit in ("m", "mm", "m/s", "mm/s") else "rad"


class PositionTable(_MotionTable):
    """An encoder's column."""

    unit: Literal["rad", "deg", "turn", "counts", "m", "mm"] = Field(default="rad", description="unit of the column")
    counts_per_turn: Positive | None = _optional("counts of one turn; for unit counts", gt=0.0)
    factor: float = Field(default=1.0, gt=0.0, description="units in one number of the column")
    minus: _Column | None = _optional("column to be subtracted, in the same unit")
    wrap: Positive | None = _optional("period, in numbers of the column, after which it starts again; undone", gt=0.0)
    offset: float | None = _optional("added last, in SI units; left out: 0, of theta_e less an offset that is sure")
    skew: _Skew | None = _optional(
        "by how much the stamps are later than the readings, undone; 'estimate' (theta_s only): as found "
        "against theta_e; left out: 0, of theta_s a skew that is sure",
        json_schema_extra=_SECONDS,
    )
    drift: float | None = _optional(
        "by how much the skew grows in each second, undone; `skew` is then that at the first stamp; left out: "
        "0, of theta_s a drift that is sure",
        ge=-0.1,
        le=0.1,
        json_schema_extra={"unit": "s/s"},
    )

    @model_validator(mode="after")
    def _check_counts(self) -> "PositionTable":
        if self.unit == "counts" and self.counts_per_turn is None:
            raise table_error("unit counts needs counts_per_turn")
        if self.unit != "counts" and self.counts_per_turn is not None:
            raise table_error(f"counts_per_turn is for unit counts, not for {self.unit}")
        return self

    @property
    def given_skew(self) -> float:
        """The skew, s; 0 where it is left out or to be estimated."""
        return self.skew if isinstance(self.skew, float) else 0.0


class SpeedTable(_MotionTable):
    """A speed that was recorded in place of a position; the position is its integral."""

    unit: Literal["rad/s", "deg/s", "rpm", "turn/s", "m/s", "mm/s"] = Field(
        default="rad/s", description="unit of the column"
    )
    factor: float = Field(default=1.0, gt=0.0, description="units in one number of the column")
    offset: float = Field(default=0.0, description="added to the speed, in rad/s (m/s)", json_schema_extra={"unit": "rad/s"})
    skew: float | None = _optional(
        "by how much the stamps are later than the readings, undone; left out: 0, of omega_s one that is sure",
        json_schema_extra=_SECONDS,
    )


class TorqueTable(_ChannelTable):
    """A torque's column (force on a linear axis), or that of a voltage, current or duty that stands for it."""

    unit: Literal["N m", "N", "V", "A", "counts"] | None = _optional(
        "unit of the column: N m, N, V, A or counts; left out: N m, or N on a linear axis"
    )
    factor: float | None = _optional(
        "N m (N on a linear axis) in one number of the column; needed for V, A and counts; else 1", gt=0.0
    )
    offset: float = Field(default=0.0, description="added last, in SI units")
    saturation: Positive | None = _optional("magnitude, in numbers of the column, at which it saturates", gt=0.0)
    skew: float | None = _optional(
        "by how much the stamps are later than the torque, undone; left out: 0, of u a lateness that is sure",
        json_schema_extra=_SECONDS,
    )

    @model_validator(mode="after")
    def _check_factor(self) -> "TorqueTable":
        if self.unit in ("V", "A", "counts") and self.factor is None:
            raise table_error(f"unit {self.unit} needs factor, the torque in N m (or force in N) of one {self.unit}")
        return self


ChannelTable = PositionTable | SpeedTable | TorqueTable
"""Table of a measured channel."""
_ChannelName = Literal["u", "theta_e", "theta_s"]
POSITION_CHANNELS = {"motor": "theta_e", "load": "theta_s"}
"""Side of the drive -> the channel of its encoder."""

SPEED_CHANNELS = {"theta_e": "omega_e", "theta_s": "omega_s"}
"""Channel of a position -> that of the speed which may stand in its place."""

ELEMENT_NEEDS = "an element is found from its displacement theta_e and the torque u; both are needed"
"""Message that refuses an incomplete log of a transmission on a test rig."""

_Scalar = Annotated[
    bool | int | float | str, _require(lambda v: isinstance(v, (*_NUMBERS, str)), "should be a number, text, true or false")
]


class LogTable(StrictTable):
    """Table that says how a measured log is read; `theta_e = "x"` is short for `theta_e = { column = "x" }`.

    Accepted in every study; simulate and sweep do not use it.
    """

    kind: Literal["drive", "element"] = Field(
        default="drive",
        description="drive: a machine in motion; element: a transmission alone on a test rig, theta_e the displacement of "
        "one side (against theta_s, the other's, if there is one), u the torque through it",
    )
    hold: Literal["zoh", "sampled"] | None = _optional(
        "u between stamps: zoh: each value holds until the next stamp, as a command does; sampled: a smooth "
        "torque, measured at its stamps, as a drive reports its current; left out: zoh, or sampled where that is sure"
    )
    initial_state: Literal["unknown", "rest"] = Field(default="unknown", description="state at the first sample")
    t: TimeTable | None = _optional("time stamps; left out: column t, in s")
    u: TorqueTable | None = _optional("input torque on the motor shaft; left out: column u, in N m")
    theta_e: PositionTable | None = _optional("motor position; left out: column theta_e, in rad")
    theta_s: PositionTable | None = _optional("load position; left out: column theta_s, in rad")
    omega_e: SpeedTable | None = _optional("motor speed, in place of theta_e; left out: none")
    omega_s: SpeedTable | None = _optional("load speed, in place of theta_s; left out: none")
    transmitted: TorqueTable | None = _optional("measured transmitted torque; left out: none")
    reference: PositionTable | None = _optional(
        "position that a controller was given: with it, identify and diagnose test for bias by feedback; left out: none"
    )
    absent: list[_ChannelName] | None = _optional("channels that were not recorded, of u, theta_e, theta_s; left out: none")
    join: list[str] | None = _optional(
        "files beside the log with more columns, which are then named FILE/COLUMN (FILE without its ending); each has times "
        "of its own, as `t` says; left out: none"
    )
    where: dict[str, _Scalar] | None = _optional(
        "column -> value: only rows that have it (a switch, a mode); left out: all rows"
    )
    start: float | None = _optional("reads from here on, counted from the first stamp", ge=0.0, json_schema_extra=_SECONDS)
    stop: float | None = _optional("reads up to here, counted from the first stamp", gt=0.0, json_schema_extra=_SECONDS)
    resample: Positive | None = _optional(
        "period to resample to; left out: the log's own, uneven stamps to their median", gt=0.0, json_schema_extra=_SECONDS
    )
    closed_loop: bool | None = _optional("whether a controller chose u from the positions; left out: not known")

    @model_validator(mode="after")
    def _check_channels(self) -> "LogTable":
        if self.start is not None and self.stop is not None and self.start >= self.stop:
            raise table_error(f"start {self.start} should be less than stop {self.stop}")
        absent = self.absent or []
        for name in absent:
            if getattr(self, name) is not None:
                raise table_error(f"{name} is described and said to be absent; remove one of them")
        for theta, omega in SPEED_CHANNELS.items():
            if getattr(self, omega) is not None and (getattr(self, theta) is not None or theta in absent):
                raise table_error(
                    f"{omega} stands in place of {theta}, which is described or said to be absent; remove one of them"
                )
        if self.kind == "element":
            if "u" in absent or "theta_e" in absent:
                raise table_error(f"absent: {ELEMENT_NEEDS}")
            if any((self.omega_e, self.omega_s, self.transmitted, self.reference)):
                raise table_error(
                    "an element has a displacement (theta_e, theta_s) and a torque u, no speed, transmitted or reference"
                )
        if "theta_e" in absent and "theta_s" in absent:
            raise table_error("absent: a log without theta_e and theta_s has no position; one of them is needed")
        for name, channel in (("theta_e", self.theta_e), ("reference", self.reference)):
            if channel is not None and channel.skew == "estimate":
                raise table_error(
                    f"{name}.skew: 'estimate' is for theta_s, whose skew is found against theta_e; give that of {name} in s"
                )
        if self.theta_s is not None and self.theta_s.skew == "estimate" and "theta_e" in absent:
            raise table_error("theta_s.skew: 'estimate' needs theta_e, which is said to be absent; give the skew in s")
        return self

    @property
    def channels(self) -> dict[str, TimeTable | ChannelTable | None]:
        """Tables of time and channels; None if they are left out."""
        names = ("t", "u", *POSITION_CHANNELS.values(), *SPEED_CHANNELS.values(), "transmitted", "reference")
        return {name: getattr(self, name) for name in names}

    def list_columns(self) -> set[ColumnName]:
        """Return names and numbers of all columns that may be read."""
        columns: set[ColumnName] = {*(self.where or {})}
        for name, channel in self.channels.items():
            columns.add(name if channel is None else channel.column_or(name))
            if isinstance(channel, PositionTable) and channel.minus is not None:
                columns.add(channel.minus)
        return columns

    def with_corrections(self, corrections: Mapping[str, float]) -> "LogTable":
        """Return the table with skews of theta_s and u and an offset of theta_e that were found, as keys."""
        table = self
        if "u.skew" in corrections:
            u = (self.u or TorqueTable()).model_copy(update={"skew": corrections["u.skew"]})
            table = self.model_copy(update={"u": u, "hold": "sampled" if corrections["u.sampled"] else self.hold})
        for position, key in (("theta_s", "skew"), ("theta_s", "drift"), ("theta_e", "offset")):
            # a speed in place of a position has no key for some of them, and then no need
            name, channel = table.position_source(position)
            if key in corrections and (key != "offset" or name == position) and key in type(channel).model_fields:
                table = table.model_copy(update={name: channel.model_copy(update={key: corrections[key]})})
        return table

    def position_source(self, name: str) -> tuple[str, PositionTable | SpeedTable]:
        """Return channel and table that theta_e or theta_s is read from: itself, or the speed in its place."""
        omega = SPEED_CHANNELS[name]
        speed = getattr(self, omega)
        return (omega, speed) if speed is not None else (name, getattr(self, name) or PositionTable())
