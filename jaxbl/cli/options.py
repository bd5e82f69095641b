"""Arguments and options that several commands have."""

from pathlib import Path
from typing import Annotated, Any

import typer

from jaxbl.errors import InputError
from jaxbl.files import to_path


def argument(metavar: str, text: str, *, show_default: bool | str = False, **rules: Any) -> Any:
    """Declare an argument by its name in the usage line and its help; `rules` are typer's."""
    return typer.Argument(metavar=metavar, help=text, show_default=show_default, **rules)


def option(metavar: str, text: str, *names: str, **rules: Any) -> Any:
    """Declare an option with a value: the value's name, and the help; `names` where it is not called as the parameter is."""
    return typer.Option(*names, metavar=metavar, help=text, **rules)


def flag(name: str, text: str) -> Any:
    """Declare an option without a value by its name and its help."""
    return typer.Option(name, help=text)


ConfigArgument = Annotated[Path, argument("CONFIG", "TOML study")]
OutOption = Annotated[
    str | None,
    option("DIR", "folder for the results, or s3://BUCKET/FOLDER [default: results/<config name>_<what it holds>]"),
]
SetOption = Annotated[
    list[str] | None,
    option("PATH=VALUE", "change a value of the study, such as observer.motor.lambda=3; may be given again", "--set"),
]
GainsOption = Annotated[Path | None, option("TOML", "take the observers from another file, such as gains.toml of tune")]
FolderArgument = Annotated[str, argument("DIR", "folder of a sweep, verify or tune")]
OverwriteOption = Annotated[bool, flag("--overwrite", "remove the results of another study from the folder")]
BackendOption = Annotated[
    str | None, option("NAME", "fused: one compiled loop; scan: XLA's own loop [default: the faster here]")
]
SchedulerOption = Annotated[
    str | None, option("ADDRESS", "Dask cluster that computes: tcp://HOST:PORT, its scheduler's .json file, or local:N")
]
FORMATS = "CSV, Parquet, MATLAB or JSON file"
ResultsArgument = Annotated[str, argument("DIR", "folder of results that a command wrote")]
LogArgument = Annotated[Path, argument("LOG", FORMATS)]
LogOutOption = Annotated[Path | None, option("DIR", "folder for the results [default: results/<log name>_<what it holds>]")]
MaxTorqueOption = Annotated[float | None, option("N·m", "limit of the next experiment's input [default: the log's]")]
MaxTravelOption = Annotated[
    float | None, option("RAD", "limit of its motor travel (m on a linear axis) [default: the log's]")
]
ForceOption = Annotated[bool, flag("--force", "search although a unit or a sign of the log is doubtful")]
LogOverwriteOption = Annotated[bool, flag("--overwrite", "write into a folder that holds results of another log")]


def folder_of(source: Path, result: str, out: str | Path | None) -> Path:
    """Return the folder for one kind of result of a study or a log: no two commands share one unless `out` says so."""
    return to_path(out) if out is not None else Path("results") / f"{source.stem}_{result}"


def check_new(file: Path, option: str) -> None:
    """Refuse to write where there is something, or no folder for it."""
    if file.exists():
        raise InputError(f"{file}: is there already; {option} needs a new name")
    if not file.parent.is_dir():
        raise InputError(f"{file}: there is no folder {file.parent}; make it first, or write elsewhere")
