"""What a command found, and how it is told: as text, as one JSON object, or not at all."""

import functools
import inspect
import json as json_format
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from jaxbl.errors import InputError, NoResult, escape_unprintable
from jaxbl.files import list_paths, read_json
from jaxbl.lines import NextStep, format_steps
from jaxbl.terminal import INTERRUPTED

QuietOption = Annotated[bool, typer.Option("--quiet", help="print neither progress nor what was found, errors alone")]
JsonOption = Annotated[bool, typer.Option("--json", help="print what was found as one JSON object")]


class Outcome(NamedTuple):
    """What a command found.

    Attributes:
        lines: as text.
        folder: of the results, if there are any.
        page: what is to be opened, in the folder; "" for nothing.
        summary: the same as data, or the file in the folder that has it.
        code: exit code.
        steps: what to try next.
        compact: whether its JSON is one line, as lines of JSON came before it.
    """

    lines: list[str]
    folder: Path | None = None
    page: str = "report.html"
    summary: Mapping[str, Any] | str | None = None
    code: int = 0
    steps: Sequence[NextStep] = ()
    compact: bool = False

    def text(self) -> list[str]:
        """The lines, what to try next, and what is to be opened."""
        opened = [str(self.folder / self.page)] if self.folder is not None and self.page else []
        return [
            escape_unprintable(part)
            for line in [*self.lines, *format_steps(self.steps), *opened]
            for part in line.split("\n")
        ]

    def data(self) -> dict[str, Any]:
        """The same as plain data, and the files in the folder; of a sweep's parts there may be millions."""
        found: dict[str, Any] = {"exit": self.code, "found": [line for line in self.lines if line]}
        if self.folder is not None:
            files = [file for pattern in ("*.*", "figures/*.*") for file in list_paths(self.folder, pattern)]
            found["folder"] = str(self.folder)
            found["open"] = str(self.folder / self.page) if self.page else None
            found["files"] = [str(file) for file in files if not file.name.startswith(".")]
        if self.steps:
            found["next"] = [one._asdict() for one in self.steps]
        if self.summary is not None:
            folder = self.folder or Path()
            found["summary"] = read_json(folder / self.summary) if isinstance(self.summary, str) else self.summary
        return found


def told(command: Callable[..., Outcome]) -> Callable[..., None]:
    """A command with the options --quiet and --json, which prints its outcome and ends with its exit code."""

    @functools.wraps(command)
    def run(*, quiet: bool, json: bool, **given: Any) -> None:
        said: dict[str, Any] = {}
        indent: int | None = 1
        try:
            outcome = command(**given)
        except (InputError, NoResult) as error:
            said = {"exit": 2 if isinstance(error, InputError) else 1, "error": str(error)}
            raise
        except typer.Exit as end:
            said = {"exit": end.exit_code, "error": "interrupted"}
            raise
        except KeyboardInterrupt:
            said = {"exit": INTERRUPTED, "error": "interrupted"}
            raise
        else:
            if json:
                said, indent = outcome.data(), None if outcome.compact else 1
            elif not quiet:
                for line in outcome.text():
                    typer.echo(line)
        finally:
            if json and said:
                from jaxbl.files import to_jsonable

                typer.echo(
                    json_format.dumps(to_jsonable({"command": command.__name__} | said), indent=indent, ensure_ascii=False)
                )
        if outcome.code:
            raise typer.Exit(outcome.code)

    return with_options(run, command, {"quiet": QuietOption, "json": JsonOption}, False)


def with_options(
    run: Callable[..., Any], command: Callable[..., Any], options: Mapping[str, Any], default: Any
) -> Callable[..., Any]:
    """A function with the arguments of a command, and with further options of one default."""
    own = inspect.signature(command)
    added = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
        for name, kind in options.items()
    ]
    own_ones = [one for one in own.parameters.values() if one.kind is not inspect.Parameter.VAR_KEYWORD]
    run.__signature__ = own.replace(parameters=[*own_ones, *added])  # type: ignore[attr-defined]
    run.__annotations__ = {**command.__annotations__, **options}
    return run
