"""What a command does around its work: progress bar, interrupts, and names in front of messages of bad input."""

import shlex
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

import typer

from .errors import InputError, printable

if TYPE_CHECKING:
    from .workers import Progress


@contextmanager
def naming(config: Path, folder: Path | None = None) -> Iterator[None]:
    """Put the config's name in front of messages that know only the key, and are not about the folder of the results."""
    try:
        yield
    except InputError as error:
        message = str(error)
        named = "/" in message.split(":")[0] or (folder is not None and message.startswith(f"{folder}:"))
        if named:
            raise
        raise InputError(f"{config}: {message}") from None


@contextmanager
def running(
    context: typer.Context, config: Path, folder: Path, *, unit: str = "runs", kept: bool = True
) -> "Iterator[Progress]":
    """Around a long computation: messages name the config, progress in `unit` is shown, and an interrupt (exit 130) says how
    to go on, and whether what is finished is `kept` in the folder.

    Foreign code may swallow an interrupt, or turn it into another error: it is remembered, and raised at the next progress
    or error.
    """
    interrupted = False

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal interrupted
        interrupted = True
        # Python prints and ignores an error that is raised in JAX's part of the garbage collection
        if frame is None or frame.f_code.co_name != "_xla_gc_callback":
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, interrupt)
    try:
        with naming(config, folder), progress_bar(unit) as shown:

            def progress(done: int, total: int) -> None:
                if interrupted:
                    raise KeyboardInterrupt
                if shown is not None:
                    shown(done, total)

            yield progress
    except BaseException as error:
        if not (interrupted or isinstance(error, KeyboardInterrupt)):
            raise
        state = "what is finished is kept. Go on with" if kept else "nothing was written. Start again with"
        typer.echo(printable(f"interrupted; {state}: {_call_again(context, folder, kept=kept)}"), err=True)
        raise typer.Exit(130) from None
    finally:
        signal.signal(signal.SIGINT, before)


def _call_again(context: typer.Context, folder: Path, *, kept: bool) -> str:
    """The command line of this call, with the folder of its results; what is `kept` there is not to be overwritten."""
    words = ["jaxbl", str(context.info_name)]
    for one in context.command.params:
        source, value = context.get_parameter_source(str(one.name)), context.params.get(str(one.name))
        if one.name in ("out", "overwrite" if kept else "out") or source is None or source.name != "COMMANDLINE":
            continue
        if one.param_type_name == "option":
            words.append(one.opts[0])
        if value is not True:
            words += map(str, value if isinstance(value, list | tuple) else [value])
    return shlex.join([*words, "--out", str(folder)])


@contextmanager
def progress_bar(unit: str) -> "Iterator[Progress | None]":
    """A bar with the remaining time on a terminal, nothing in a pipe."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from .workers import listening

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn(unit), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("compiling", total=None)
        heard = False

        def update(done: int, total: int) -> None:
            bar.update(task, description=None if heard else "running", completed=done, total=total)

        def hear(what: str) -> None:
            nonlocal heard
            heard = True
            bar.update(task, description=what)

        with listening(hear):
            yield update


def duration(seconds: float) -> str:
    """A time for the reader, in s, min or h."""
    if seconds < 100.0:
        return f"{seconds:.1f} s"
    if seconds < 6000.0:
        return f"{seconds / 60.0:.0f} min"
    return f"{seconds / 3600.0:.1f} h"
