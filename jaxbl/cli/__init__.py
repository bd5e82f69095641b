"""The command line: parse, call, print. JAX is imported only once a command has work for it."""

import os
import sys
from collections.abc import Callable
from typing import Annotated

import typer

from jaxbl.errors import InputError, NoResult
from jaxbl.terminal import INTERRUPTED

from . import exporting, logs, setup, studies
from .outcome import print_outcome

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Drives with backlash: sliding-mode observers, gain maps, identification and diagnosis from logs.",
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


for _command in (
    *(setup.demo, setup.init),
    *(studies.simulate, studies.sweep, studies.status, studies.tune, studies.verify, exporting.export),
    *(logs.inspect, logs.identify, logs.diagnose, logs.watch),
    *(studies.plot, studies.explore, studies.compare, studies.repair, setup.bench, setup.doctor),
):
    app.command()(print_outcome(_command))
# what it prints is JSON in any case
app.command()(setup.schema)


def main(run: Callable[[], object] = app) -> None:
    """Run a command: exit 0 done, 1 failed, 2 bad input (one line), 3 alarm of a watch, 130 interrupted."""
    try:
        run()
    except (InputError, NoResult) as error:
        typer.echo(f"jaxbl: {error}", err=True)
        sys.exit(2 if isinstance(error, InputError) else 1)
    except KeyboardInterrupt:
        typer.echo("interrupted", err=True)
        sys.exit(INTERRUPTED)


def program() -> None:
    """Entry point: as :func:`main`, and an interrupt ends the process without taking down the interpreter.

    Threads of XLA may still compute then, and would crash when their memory is freed.
    """
    try:
        main()
    except SystemExit as end:
        if end.code != INTERRUPTED:
            raise
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(INTERRUPTED)
