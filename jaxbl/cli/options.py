"""Arguments and options that several commands have."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jaxbl.errors import InputError
from jaxbl.files import to_path
from jaxbl.lines import doubts_among

if TYPE_CHECKING:
    from jaxbl.identification.logs import SealedRecord
    from jaxbl.records import Record

ConfigArgument = Annotated[Path, typer.Argument(metavar="CONFIG", help="TOML study", show_default=False)]
OutOption = Annotated[
    str | None,
    typer.Option(
        metavar="DIR", help="folder for the results, or s3://BUCKET/FOLDER [default: results/<config name>_<what it holds>]"
    ),
]
FolderArgument = Annotated[str, typer.Argument(metavar="DIR", help="folder of a sweep, verify or tune", show_default=False)]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="remove the results of another study from the folder")]
BackendOption = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="fused: one compiled loop; scan: XLA's own loop [default: the faster here]"),
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS", help="Dask cluster that computes: tcp://HOST:PORT, its scheduler's .json file, or local:N"
    ),
]
FORMATS = "CSV, Parquet, MATLAB or JSON file"
ResultsArgument = Annotated[
    str, typer.Argument(metavar="DIR", help="folder of a sweep, identify or diagnose", show_default=False)
]
LogArgument = Annotated[Path, typer.Argument(metavar="LOG", help=FORMATS, show_default=False)]
LogOutOption = Annotated[
    Path | None, typer.Option(metavar="DIR", help="folder for the results [default: results/<log name>_<what it holds>]")
]
MaxTorqueOption = Annotated[
    float | None, typer.Option(metavar="N·m", help="limit of the next experiment's input [default: the log's]")
]
MaxTravelOption = Annotated[
    float | None, typer.Option(metavar="RAD", help="limit of its motor travel (m on a linear axis) [default: the log's]")
]
ForceOption = Annotated[bool, typer.Option("--force", help="search although a unit or a sign of the log is doubtful")]
LogOverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="write into a folder that holds results of another log")
]


def folder_of(source: Path, result: str, out: str | Path | None) -> Path:
    """Return the folder for one kind of result of a study or a log: no two commands share one unless `out` says so."""
    return to_path(out) if out is not None else Path("results") / f"{source.stem}_{result}"


def check_doubts(records: "Iterable[Record | SealedRecord]", force: bool) -> None:
    """Refuse a search of minutes on a log of which a unit or a sign is doubtful."""
    for record in records:
        if not force and (doubts := doubts_among(record.warnings)):
            raise InputError(f"{record.path}: {doubts[0]} --force searches all the same")


def check_new(file: Path, option: str) -> None:
    """Refuse to write where there is something, or no folder for it."""
    if file.exists():
        raise InputError(f"{file}: is there already; {option} needs a new name")
    if not file.parent.is_dir():
        raise InputError(f"{file}: there is no folder {file.parent}; make it first, or write elsewhere")
