"""Commands before the work: init, schema, doctor, demo, bench."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeVar

import typer

import jaxbl
from jaxbl import workers
from jaxbl.datasheet import (
    KINDS,
    NONE,
    Answer,
    Item,
    compare_observers,
    describe_expectation,
    describe_obstacle,
    items_by_name,
    option_name,
    write_first_study,
)
from jaxbl.errors import InputError
from jaxbl.files import Subject, find_shipped_study, open_results, write_atomic
from jaxbl.lines import format_descriptions
from jaxbl.result import Result
from jaxbl.terminal import STEPS, can_ask_user, run_with_progress, show_task

from .next_steps import after_demo, after_init
from .options import BackendOption, OutOption, argument, check_new, flag, option
from .outcome import Outcome, with_options
from .studies import compute, read_study

T = TypeVar("T")
NewArgument = Annotated[Path, argument("[NEW.toml]", "file to be written", show_default="drive.toml")]

_KINDS_HELP = "; ".join(f"{name}: {kind.description}" for name, kind in KINDS.items()) + " [default: asked for, or geared]"


def init(
    context: typer.Context,
    file: NewArgument = Path("drive.toml"),
    kind: Annotated[str | None, option("KIND", _KINDS_HELP)] = None,
    title: Annotated[str, option("TEXT", "headline of its report")] = "",
    **options: str | None,
) -> Outcome:
    """Write a first study from a drive's data sheet: what no option says is asked for.

    Numbers have units, as in the examples. A unit that is not known here is answered with those that are.

    Example: jaxbl init axis.toml --kind screw

    Read on: docs/tutorial.md
    """
    check_new(file, "init")
    asking, answered = can_ask_user(), {name: text for name, text in options.items() if text is not None}
    name = (_ask_kind() if asking else next(iter(KINDS))) if kind is None else _check_kind(kind)
    items = KINDS[name].items
    unknown = set(answered) - {item.name for item in items}
    if unknown:
        unknown_options = [option_name(name) for name in answered if name in unknown]
        known_options = ", ".join(item.option for item in items)
        other_kinds = ", ".join(kind for kind in KINDS if kind != name)
        raise InputError(
            f"{', '.join(unknown_options)}: --kind {name} has no such option; it has: {known_options}; "
            f"other kinds: {other_kinds}"
        )
    values = {item.name: item.read(answered[item.name]) for item in items if item.name in answered}
    if asking and len(values) < len(items):
        typer.echo("Numbers of the data sheet with their units; Enter takes what is in brackets.", err=True)
    missing = [item for item in items if item.name not in values and not item.default]
    if missing and not asking:
        missing_options = ", ".join(f"{item.option} '{item.example}'" for item in missing)
        other = "" if kind else f"; another kind of drive: --kind {', '.join(list(KINDS)[1:])}"
        raise InputError(
            f"init: numbers are missing, here with examples: {missing_options}; on a terminal init asks for them{other}"
        )
    answer = _ask_number if asking else Item.default_answer
    values = {item.name: values.get(item.name) or answer(item) for item in items}
    workers.start_jax()
    with show_task(context, "running a pilot for the gains"):
        text, pilot_metrics = write_first_study(KINDS[name], values, title or file.stem)
    with show_task(context, "comparing observers"):
        comparison, text = compare_observers(KINDS[name], text, pilot_metrics)
    check_new(file, "init")
    write_atomic(file, text)
    bounds = {side: item["f_plus"] for side, item in pilot_metrics.items()}
    largest = ", ".join(f"{bound:.3g} {KINDS[name].unit(side, 'rad/s²')} ({side})" for side, bound in bounds.items())
    obstacle = describe_obstacle(pilot_metrics)
    card = Result(
        file.stem,
        "doubtful" if obstacle else "good",
        f"{file} is a study with comments. Gains by the usual rule, for unknown accelerations up to {largest}.",
        remarks=[*([obstacle] if obstacle else []), describe_expectation(KINDS[name], pilot_metrics), comparison],
        next_steps=after_init(file),
    )
    data = {
        "file": str(file),
        "kind": name,
        "given": {name: item._asdict() for name, item in values.items()},
        "f_plus": bounds,
    }
    return Outcome(card, summary=data)


def _check_kind(text: str) -> str:
    """Return the name of a kind of drive. Raises `InputError` where there is no such kind."""
    name = text.strip().lower()
    if name not in KINDS:
        raise InputError(f"--kind '{text}': should be one of {', '.join(KINDS)}; see jaxbl init --help")
    return name


def _ask_kind() -> str:
    """Ask the user for a kind of drive, until there is such a kind."""
    typer.echo("Kinds of drives:", err=True)
    for line in format_descriptions((f"  {name}", kind.description) for name, kind in KINDS.items()):
        typer.echo(line, err=True)
    return _ask("kind of this drive", next(iter(KINDS)), _check_kind)


def _ask_number(item: Item) -> Answer:
    """Ask the user for a number of the data sheet."""
    other = f", or {NONE}" * item.absent
    question = f"{item.question}, such as {item.example}{other}"
    return _ask(question, item.default, lambda text: item.default_answer() if text == item.default else item.read(text))


def _ask(question: str, default: str, read: Callable[[str], T]) -> T:
    """Ask the user a question, until the answer can be read."""
    while True:
        try:
            return read(typer.prompt(question, default=default or None, err=True))
        except InputError as error:
            typer.echo(f"  {error}", err=True)


def _make_option(items: list[tuple[str, Item]]) -> object:
    """Make the option of all items with one name; its help says what each kind of drive means by it."""
    kinds_by_text: dict[str, list[str]] = {}
    for kind, item in items:
        default = f" [default: {item.default}]" if item.default else ""
        other = f" or '{NONE}'" * item.absent
        kinds_by_text.setdefault(f"{item.question}, such as '{item.example}'{other}{default}", []).append(kind)
    is_common = len(kinds_by_text) == 1 and len(items) == len(KINDS)
    help_text = ". ".join(text if is_common else f"{', '.join(kinds)}: {text}" for text, kinds in kinds_by_text.items())
    return Annotated[str | None, option("VALUE", help_text, items[0][1].option)]


with_options(init, init, {name: _make_option(items) for name, items in items_by_name().items()}, None)


def schema(
    out: Annotated[Path | None, option("NEW.json", "file to be written [default: stdout]")] = None,
) -> None:
    """Print the JSON schema of a study, by which editors complete and check its keys.

    Example: jaxbl schema --out study.schema.json

    Read on: docs/which_command.md
    """
    import json

    from jaxbl.config.schema import build_schema

    if out is not None:
        check_new(out, "--out")
    text = json.dumps(build_schema(), indent=1, ensure_ascii=False)
    if out is None:
        typer.echo(text)
    else:
        write_atomic(out, f"{text}\n")


def doctor(context: typer.Context) -> Outcome:
    """Say what is installed here and where it keeps things, and test that it computes, in some seconds.

    Example: jaxbl doctor

    Read on: docs/install.md
    """
    workers.start_jax()
    with show_task(context, "looking at versions and devices"):
        from jaxbl.doctor import examine

        findings = examine()
    failures = [finding.name for finding in findings if not finding.good]
    lines = format_descriptions(
        (finding.name, finding.outcome if finding.good else f"FAILED: {finding.outcome}") for finding in findings
    )
    lines.append(f"Not in order: {', '.join(failures)}." if failures else "All in order.")
    return Outcome(lines, summary={"findings": [finding._asdict() for finding in findings]}, code=1 if failures else 0)


def demo(
    context: typer.Context,
    out: OutOption = "results/gain_map",
    backend: BackendOption = None,
) -> Outcome:
    """Run the gain map of the README: 49 152 runs of a geared drive, some seconds to a minute.

    Example: jaxbl demo

    Read on: README.md
    """
    config = find_shipped_study("gain_map.toml")
    return compute(context, config, read_study(context, config), jaxbl.sweep, "map", after_demo)


def bench(
    context: typer.Context,
    quick: Annotated[bool, flag("--quick", "take less than a minute: shorter runs, the others in one precision")] = False,
    out: Annotated[Path, option("DIR", "folder for the results")] = Path("results/bench"),
) -> Outcome:
    """Time the same work by jaxbl, C++, numba, diffrax and NumPy: table, chart, bench.json.

    Example: jaxbl bench --quick

    Read on: docs/speed.md
    """
    workers.start_jax()
    import jax

    from jaxbl.report.bench import write_bench_report

    # the time of compiling is measured, so that nothing may come from the cache
    jax.config.update("jax_enable_compilation_cache", False)
    with run_with_progress(context, out, out, unit=STEPS) as progress, open_results(out, Subject("bench")) as results:
        result = jaxbl.bench(quick=quick, progress=progress)
        with results.write_files("bench.json") as draft:
            lines = write_bench_report(result, draft)
    return Outcome(lines, out, "", "bench.json", code=1 if result.failures else 0)
