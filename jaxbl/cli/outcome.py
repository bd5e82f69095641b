"""The outcome of a command, printed as text, as one JSON object, or not at all."""

import functools
import inspect
import json as json_format
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from jaxbl.errors import InputError, NoResult, escape_unprintable
from jaxbl.files import list_paths, read_result, to_jsonable
from jaxbl.json_types import JsonObject
from jaxbl.result import Result, format_result
from jaxbl.terminal import INTERRUPTED

from .options import GainsOption, SetOption, flag

QuietOption = Annotated[bool, flag("--quiet", "print neither progress nor what was found, errors alone")]
JsonOption = Annotated[bool, flag("--json", "print what was found as one JSON object")]
_COLOURS = {"✓ ": "green", "! ": "yellow", "✗ ": "red", "? ": "yellow"}
"""Of lines that begin with the symbol of a verdict."""


class Outcome(NamedTuple):
    """The outcome of a command.

    Attributes:
        content: what was found, or lines for the terminal where there is no page.
        folder: of the results, if there are any.
        page: file in the folder to open; "" for none.
        summary: the outcome as data, or the name of the file in the folder that holds it.
        code: exit code.
    """

    content: Result | list[str]
    folder: Path | None = None
    page: str = "report.html"
    summary: JsonObject | str | None = None
    code: int = 0

    def text(self) -> list[str]:
        """Return what was found, and the file to open."""
        opened = [str(self.folder / self.page)] if self.folder is not None and self.page else []
        lines = [*self.content, *opened] if isinstance(self.content, list) else format_result(self.content, opened)
        return [escape_unprintable(part) for line in lines for part in line.split("\n")]

    def data(self) -> JsonObject:
        """Return the outcome as plain data, with the files in the folder but for a sweep's parts (there may be millions)."""
        fields: JsonObject = {"exit": self.code, "found": self.content}
        if isinstance(self.content, Result):
            steps = [step._asdict() for step in self.content.next_steps]
            fields |= {"verdict": self.content.verdict, "found": self.content.sentences, "next": steps}
        if self.folder is not None:
            files = [file for pattern in ("*.*", "figures/*.*") for file in list_paths(self.folder, pattern)]
            fields |= {
                "folder": str(self.folder),
                "open": str(self.folder / self.page) if self.page else None,
                "files": [str(file) for file in files if not file.name.startswith(".")],
            }
        if self.summary is not None:
            folder = self.folder or Path()
            fields["summary"] = read_result(folder / self.summary) if isinstance(self.summary, str) else self.summary
        return fields


def print_outcome(command: Callable[..., Outcome]) -> Callable[..., None]:
    """Give a command the options --quiet and --json; it then prints its outcome and ends with its exit code."""

    @functools.wraps(command)
    def run(*, quiet: bool, json: bool, **arguments: Any) -> None:
        report: JsonObject = {}
        try:
            outcome = command(**arguments)
        except (InputError, NoResult) as error:
            report = {"exit": 2 if isinstance(error, InputError) else 1, "error": str(error)}
            raise
        except (typer.Exit, KeyboardInterrupt) as end:
            report = {"exit": getattr(end, "exit_code", INTERRUPTED), "error": "interrupted"}
            raise
        else:
            if json:
                report = outcome.data()
            elif not quiet:
                for line in outcome.text():
                    # colours are left out where it is no terminal
                    typer.secho(line, fg=_COLOURS.get(line[:2]))
        finally:
            if json and report:
                typer.echo(json_format.dumps(to_jsonable({"command": command.__name__} | report), ensure_ascii=False))
        if outcome.code:
            raise typer.Exit(outcome.code)

    return with_options(run, command, {"quiet": QuietOption, "json": JsonOption}, False)


def with_changes(command: Callable[..., Outcome]) -> Callable[..., Outcome]:
    """Give a command on a study the options --set and --gains, which :func:`.studies.read_study` finds in the context."""

    @functools.wraps(command)
    def run(*, changes: object, gains: object, **arguments: Any) -> Outcome:
        return command(**arguments)

    return with_options(run, command, {"changes": SetOption, "gains": GainsOption}, None)


def with_options(
    run: Callable[..., Any], command: Callable[..., Any], options: JsonObject, default: Any
) -> Callable[..., Any]:
    """Give a function the arguments of a command, and further options that have one default."""
    signature = inspect.signature(command)
    added = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
        for name, kind in options.items()
    ]
    parameters = [
        parameter for parameter in signature.parameters.values() if parameter.kind is not inspect.Parameter.VAR_KEYWORD
    ]
    run.__signature__ = signature.replace(parameters=[*parameters, *added])  # type: ignore[attr-defined]
    run.__annotations__ = {**command.__annotations__, **options}
    return run
