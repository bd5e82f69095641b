"""The frame around a command's work: progress bar, interrupts, and names in front of messages of bad input."""

import math
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

import typer

from .errors import InputError, escape_unprintable
from .lines import command_line, format_duration
from .workers import subscribe

if TYPE_CHECKING:
    from .workers import Progress

INTERRUPTED = 130
"""Exit code of an interrupted command: 128 and the signal's number."""
_REQUESTS = (signal.SIGINT, signal.SIGTERM)
"""Signals that ask a process to end."""
_EVERY, _LOOK, _WINDOW = 10.0, 1.0, 60.0
"""Seconds between lines of progress in a pipe, between looks at what is done, and back to the look that gives the speed."""
STEPS = "steps"
"""Unit of progress through parts of unlike length, of which nothing is kept before the last."""


@contextmanager
def name_config_in_errors(config: Path, folder: Path | None = None) -> Iterator[None]:
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
def run_with_progress(
    context: typer.Context, config: Path, folder: Path, *, unit: str = "runs", first: str = "compiling"
) -> "Iterator[Progress]":
    """Around a long computation: messages name the config, progress in `unit` is shown, `first` being done at the beginning,
    and an interrupt (exit 130) says how to go on: what is finished is in the folder, but for `STEPS`.

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
        with name_config_in_errors(config, folder), progress_bar(unit, quiet=is_quiet(context), first=first) as show:

            def progress(done: int, total: int) -> None:
                if interrupted:
                    raise KeyboardInterrupt
                if show is not None:
                    show(done, total)

            yield progress
    except BaseException as error:
        if not (interrupted or isinstance(error, KeyboardInterrupt)):
            raise
        keeps_results = unit != STEPS
        state = "what is finished is kept. Go on with" if keeps_results else "nothing was written. Start again with"
        again = command_line(*repeat_call(context, folder, keeps_results=keeps_results))
        typer.echo(escape_unprintable(f"interrupted; {state}: {again}"), err=True)
        raise typer.Exit(INTERRUPTED) from None
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def watch_for_end_request(*, interrupts: bool = False) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns True once the user or the system has asked the process to end; with `interrupts`, this
    raises `KeyboardInterrupt` as well.

    A second request ends the process at once.
    """
    asked = threading.Event()

    def ask(number: int, frame: FrameType | None) -> None:
        asked.set()
        for request in _REQUESTS:
            signal.signal(request, signal.SIG_DFL)
        if interrupts:
            raise KeyboardInterrupt

    before = {request: signal.signal(request, ask) for request in _REQUESTS}
    try:
        yield asked.is_set
    finally:
        for request, handler in before.items():
            signal.signal(request, handler)


def repeat_call(context: typer.Context, folder: Path, *, keeps_results: bool = True) -> list[str]:
    """The words of this call, with the folder of its results; what is `keeps_results` there is not to be overwritten."""
    words, left_out = [str(context.info_name)], ["out"] + ["overwrite"] * keeps_results
    for parameter in context.command.params:
        name = str(parameter.name)
        source, value = context.get_parameter_source(name), context.params.get(name)
        if name in left_out or source is None or source.name != "COMMANDLINE":
            continue
        for part in value if isinstance(value, list | tuple) else [value]:
            words += parameter.opts[:1] if parameter.param_type_name == "option" else []
            words += [] if part is True else [str(part)]
    return [*words, "--out", str(folder)]


@contextmanager
def progress_bar(unit: str, *, quiet: bool = False, first: str = "compiling") -> "Iterator[Progress | None]":
    """Show the present task, its progress in `unit`, and the remaining time: on a terminal one line that changes, in a pipe
    lines now and then. Without a unit nothing is counted."""
    if quiet:
        yield None
        return
    with ExitStack() as stack:
        say, pause = partial(typer.echo, err=True), _EVERY
        if sys.stderr.isatty():
            from rich.console import Console

            # what is printed meanwhile goes above this line
            say, pause = stack.enter_context(Console(stderr=True).status(first)).update, 0.0
        lines, ended = ProgressLines(unit, first, time.monotonic(), pause), threading.Event()

        def speak() -> None:
            while not ended.wait(_LOOK):
                if line := lines.look(time.monotonic()):
                    say(escape_unprintable(line))

        speaker = threading.Thread(target=speak, name="jaxbl-progress", daemon=True)
        speaker.start()
        stack.callback(speaker.join)
        stack.callback(ended.set)
        stack.enter_context(subscribe(lines.hear))
        yield lines.update


@contextmanager
def show_task(context: typer.Context, task: str) -> Iterator[None]:
    """Show what is being done around work that has no parts to count."""
    with progress_bar("", quiet=is_quiet(context), first=task):
        yield


def is_quiet(context: typer.Context) -> bool:
    """Return True if the command should print errors alone."""
    return bool(context.params.get("quiet"))


class ProgressLines:
    """Lines of text about progress: the present task, the share that is done, the remaining time.

    Once all that is counted is done, or while nothing is, a line says how long the task takes so far.

    Args:
        unit: of what is counted; `STEPS` are of unlike length, so that no time is left to be told from their number.
        task: is being done at first.
        now: time of the beginning, s.
        pause: seconds between lines.
    """

    def __init__(self, unit: str, task: str, now: float, pause: float = _EVERY):
        self._unit, self._task, self._pause, self._said = unit, task, pause, now
        self._first, self._done, self._total = task, 0, 0
        self._seen = deque([(now, 0)], maxlen=round(_WINDOW / _LOOK))
        self._began, self._state = now, (task, 0)

    def update(self, done: int, total: int) -> None:
        """Hear how much is done."""
        if done < self._done:
            # another count begins
            self._seen.clear()
        self._done, self._total = done, total
        if self._task == self._first:
            self._task = "running"

    def hear(self, task: str) -> None:
        """Hear what is being done."""
        self._task = task

    def look(self, now: float) -> str | None:
        """Return a line if it is time for one."""
        done, total = self._done, self._total
        self._seen.append((now, done))
        if self._state != (state := (self._task, done)):
            self._began, self._state = now, state
        if now - self._said < self._pause:
            return None
        self._said = now
        lead, lasts = f"jaxbl: {self._task}, ", f"for {format_duration(now - self._began)} so far"
        if done >= total:
            return lead + lasts
        if self._unit == STEPS:
            return f"{lead}step {done + 1} of {total}, {lasts}"
        since, before = self._seen[0]
        left = ""
        # parts of an earlier call are counted within a moment: what happened lately says how fast it goes
        if before < done:
            left = f", about {format_duration((total - done) * (now - since) / (done - before))} left"
        return f"{lead}{done} of {total} {self._unit} ({math.floor(100 * done / total)} %){left}"


def can_ask_user() -> bool:
    """Return True if a user can be asked on a terminal."""
    return sys.stdin is not None and sys.stdin.isatty()
