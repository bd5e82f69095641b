"""What a command does around its work: progress bar, interrupts, messages of bad input, exit codes."""

import os
import shlex
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

import typer

from .errors import InputError, NoResult

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
        raise InputError(message if named else f"{config}: {message}") from None


@contextmanager
def running(words: list[str], config: Path, folder: Path, *, unit: str = "runs", kept: bool = True) -> "Iterator[Progress]":
    """Around a long computation: messages name the config, progress is shown, and an interrupt says how to go on.

    Foreign code may swallow an interrupt, or turn it into another error: it is remembered, and raised at the next progress
    or error.

    Args:
        words: the command line, without the folder.
        config: the study.
        folder: of the results.
        unit: what the progress counts.
        kept: whether what is finished stays in the folder.

    Raises:
        Exit: with 130 after an interrupt.
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
        resume = shlex.join(["jaxbl", *words, "--out", str(folder)])
        state = "what is finished is kept. Go on with" if kept else "nothing was written. Start again with"
        typer.echo(f"interrupted; {state}: {resume}", err=True)
        raise typer.Exit(130) from None
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def progress_bar(unit: str) -> "Iterator[Progress | None]":
    """A bar with the remaining time on a terminal, nothing in a pipe."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn(unit), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("compiling", total=None)

        def update(done: int, total: int) -> None:
            bar.update(task, description="running", completed=done, total=total)

        yield update


def duration(seconds: float) -> str:
    """A time for the reader, in s, min or h."""
    if seconds < 100.0:
        return f"{seconds:.1f} s"
    if seconds < 6000.0:
        return f"{seconds / 60.0:.0f} min"
    return f"{seconds / 3600.0:.1f} h"


def with_exit_code(run: Callable[[], object]) -> None:
    """Run a command: exit 0 done, 1 failed, 2 bad input (one line), 130 interrupted."""
    try:
        run()
    except (InputError, NoResult) as error:
        typer.echo(f"jaxbl: {error}", err=True)
        sys.exit(2 if isinstance(error, InputError) else 1)
    except KeyboardInterrupt:
        typer.echo("interrupted", err=True)
        sys.exit(130)


def end_at_once_if_interrupted(run: Callable[[], object]) -> None:
    """Run a command; after an interrupt end the process without taking down the interpreter.

    Threads of XLA may still compute then, and would crash when their memory is freed.
    """
    try:
        run()
    except SystemExit as end:
        if end.code != 130:
            raise
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(130)
