"""The command that writes code for other systems."""

from typing import Annotated

import typer

import jaxbl
from jaxbl.terminal import STEPS, run_with_progress

from .options import ConfigArgument, folder_of, option
from .outcome import Outcome, with_changes
from .studies import read_study

_TARGETS = (
    "c: C99, one source file and one header; st: structured text (IEC 61131-3); mjcf: a MuJoCo model of the drive; "
    "fmu: the drive for co-simulation"
)


@with_changes
def export(
    context: typer.Context,
    config: ConfigArgument,
    target: Annotated[str, option("TARGET", _TARGETS)] = "c",
    out: Annotated[str | None, option("DIR", "folder for the files [default: results/<config name>_<target>]")] = None,
    precision: Annotated[str | None, option("TYPE", "of code: double or float [default: as the study computes]")] = None,
    name: Annotated[str | None, option("NAME", "of the code's functions and files [default: the config's]")] = None,
    linear: Annotated[
        list[str] | None,
        option("SIDE", "of a MuJoCo model: motor or load, a side that moves along a line; may be given twice"),
    ] = None,
    fmi: Annotated[int | None, option("2|3", "version of an FMU [default: 3]")] = None,
) -> Outcome:
    """Write a study's observers and identifier as code for a controller, or its drive as a model for a simulator.

    Example: jaxbl export axis.toml --target c

    Read on: docs/export.md
    """
    study = read_study(context, config)
    folder = folder_of(config, target, out)
    with run_with_progress(context, config, folder, unit=STEPS, first="exporting"):
        result = jaxbl.export(study, folder, target, precision=precision, name=name, linear=linear or (), fmi=fmi)
    return Outcome(result.lines, result.folder, "", "export.json")
