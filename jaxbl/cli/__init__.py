"""The command line: parse, call, print. JAX is imported only once a command has work for it."""

import sys
from collections.abc import Callable
from itertools import chain
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from jaxbl.errors import InputError, NoResult
from jaxbl.terminal import INTERRUPTED

from . import exporting, logs, setup, studies
from .outcome import print_outcome

_GROUPS = {
    "Start": (setup.demo, setup.init),
    "From a data sheet or a study": (studies.simulate, studies.sweep, studies.tune, studies.verify, exporting.export),
    "From a log": (logs.inspect, logs.identify, logs.diagnose, logs.watch),
    "Results": (studies.plot, studies.explore, studies.compare, studies.status, studies.repair),
    "This machine": (setup.doctor, setup.bench, setup.schema),
}


class _Groups(TyperGroup):
    """Commands by what a user has, each with its whole first sentence."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list of commands into the help."""
        for heading, functions in _GROUPS.items():
            with formatter.section(heading):
                names = [function.__name__ for function in functions]
                formatter.write_dl([(name, str(self.commands[name].help).partition("\n")[0]) for name in names])


app = typer.Typer(
    cls=_Groups,
    context_settings={"help_option_names": ["-h", "--help"]},
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Motor drives with gear backlash: simulate them, choose observer gains, find numbers and missing effects in logs.",
)


def _say_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"jaxbl {version('jaxbl')}")
        raise typer.Exit


@app.callback()
def _main(
    version: Annotated[
        bool, typer.Option("--version", callback=_say_version, is_eager=True, help="say which version this is, and stop")
    ] = False,
) -> None:
    pass


for _command in chain(*_GROUPS.values()):
    # what `schema` prints is JSON in any case
    app.command()(_command if _command is setup.schema else print_outcome(_command))


def main(run: Callable[[], object] = app) -> None:
    """Run a command: exit 0 done, 1 failed, 2 bad input (one line), 3 alarm of a watch, 4 blind, 130 interrupted."""
    try:
        run()
    except (InputError, NoResult) as error:
        typer.echo(f"jaxbl: {error}", err=True)
        sys.exit(2 if isinstance(error, InputError) else 1)
    except KeyboardInterrupt:
        typer.echo("interrupted", err=True)
        sys.exit(INTERRUPTED)
