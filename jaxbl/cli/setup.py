"""Commands before the work: init, schema, doctor, demo, bench."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from jaxbl import workers
from jaxbl.datasheet import KINDS, NONE, Given, Item, first_study, named_items, option_of, remark
from jaxbl.errors import InputError
from jaxbl.files import write_atomic
from jaxbl.lines import format_descriptions
from jaxbl.terminal import answers, running, working

from .next_steps import after_demo, after_init
from .options import BackendOption, OutOption, check_new
from .outcome import Outcome, with_options
from .studies import compute, read_study

T = TypeVar("T")
NewArgument = Annotated[Path, typer.Argument(metavar="[NEW.toml]", help="file to be written", show_default="drive.toml")]

_KINDS_SAID = "; ".join(f"{name}: {kind.about}" for name, kind in KINDS.items()) + " [default: asked for, or geared]"


def init(
    context: typer.Context,
    file: NewArgument = Path("drive.toml"),
    kind: Annotated[str | None, typer.Option(metavar="KIND", help=_KINDS_SAID, show_default=False)] = None,
    title: Annotated[str, typer.Option(metavar="TEXT", help="headline of its report")] = "",
    **given: str | None,
) -> Outcome:
    """Write a first study from a drive's data sheet: what no option says is asked for.

    Numbers have units, as in the examples. A unit that is not known here is answered with those that are.
    """
    check_new(file, "init")
    asking, said = answers(), {name: text for name, text in given.items() if text is not None}
    name = (_asked_kind() if asking else next(iter(KINDS))) if kind is None else _kind(kind)
    items = KINDS[name].items
    if others := [option_of(one) for one in said if one not in {item.name for item in items}]:
        has, rest = ", ".join(item.option for item in items), ", ".join(kind for kind in KINDS if kind != name)
        raise InputError(f"{', '.join(others)}: not asked of --kind {name}, which has: {has}; other kinds: {rest}")
    values = {one.name: one.read(said[one.name]) for one in items if one.name in said}
    if asking:
        if len(values) < len(items):
            typer.echo("Numbers of the data sheet with their units; Enter takes what is in brackets.", err=True)
        values = {one.name: values.get(one.name) or _asked_number(one) for one in items}
    elif missing := [one for one in items if one.name not in values and not one.default]:
        wanted = ", ".join(f"{one.option} '{one.example}'" for one in missing)
        other = "" if kind else f"; another kind of drive: --kind {', '.join(list(KINDS)[1:])}"
        raise InputError(
            f"init: these numbers are missing, here with examples: {wanted}; on a terminal they are asked for{other}"
        )
    values = {one.name: values.get(one.name) or one.left_out() for one in items}
    workers.start_jax()
    with working(context, "running a pilot for the gains"):
        text, found = first_study(KINDS[name], values, title or file.stem)
    check_new(file, "init")
    write_atomic(file, text)
    bounds = {side: one["f_plus"] for side, one in found.items()}
    largest = ", ".join(f"{bound:.3g} {KINDS[name].unit(side, 'rad/s²')} ({side})" for side, bound in bounds.items())
    lines = [
        f"{file}: a study with comments. Gains by the usual rule, for unknown accelerations up to {largest}.",
        *([rest] if (rest := remark(KINDS[name], values, found)) else []),
    ]
    data = {
        "file": str(file),
        "kind": name,
        "given": {name: one._asdict() for name, one in values.items()},
        "f_plus": bounds,
    }
    return Outcome(lines, summary=data, steps=after_init(file))


def _kind(text: str) -> str:
    """The name of a kind of drive."""
    name = text.strip().lower()
    if name not in KINDS:
        raise InputError(f"--kind '{text}': should be one of {', '.join(KINDS)}; jaxbl init --help says what they are")
    return name


def _asked_kind() -> str:
    """The kind of drive that the user names; asked again where there is no such kind."""
    typer.echo("Kinds of drives:", err=True)
    for line in format_descriptions((f"  {name}", kind.about) for name, kind in KINDS.items()):
        typer.echo(line, err=True)
    return _asked("kind of this drive", next(iter(KINDS)), _kind)


def _asked_number(item: Item) -> Given:
    """The number that the user says."""
    other = f", or {NONE}" * item.absent
    question = f"{item.asked}, such as {item.example}{other}"
    return _asked(question, item.default, lambda text: item.left_out() if text == item.default else item.read(text))


def _asked(question: str, default: str, read: Callable[[str], T]) -> T:
    """What the user answers; asked again where it cannot be read."""
    while True:
        try:
            return read(typer.prompt(question, default=default or None, err=True))
        except InputError as error:
            typer.echo(f"  {error}", err=True)


def _option(items: list[tuple[str, Item]]) -> object:
    """The option of items of one name: what each kind of drive understands by it."""
    said: dict[str, list[str]] = {}
    for kind, item in items:
        default = f" [default: {item.default}]" if item.default else ""
        other = f" or '{NONE}'" * item.absent
        said.setdefault(f"{item.asked}, such as '{item.example}'{other}{default}", []).append(kind)
    every = len(said) == 1 and len(items) == len(KINDS)
    about = ". ".join(text if every else f"{', '.join(kinds)}: {text}" for text, kinds in said.items())
    return Annotated[str | None, typer.Option(items[0][1].option, metavar="VALUE", help=about, show_default=False)]


with_options(init, init, {name: _option(items) for name, items in named_items().items()}, None)


def schema(
    out: Annotated[Path | None, typer.Option(metavar="NEW.json", help="file to be written [default: stdout]")] = None,
) -> None:
    """Print the JSON schema of a study, by which editors complete and check its keys."""
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
    """Say what is installed here and where it keeps things, and test that it computes, in some seconds."""
    workers.start_jax()
    with working(context, "looking at versions and devices"):
        from jaxbl.doctor import examine

        findings = examine()
    bad = [one.name for one in findings if not one.good]
    lines = format_descriptions((one.name, one.found if one.good else f"FAILED: {one.found}") for one in findings)
    lines.append(f"Not in order: {', '.join(bad)}." if bad else "All in order.")
    return Outcome(lines, summary={"findings": [one._asdict() for one in findings]}, code=1 if bad else 0)


def demo(
    context: typer.Context,
    out: OutOption = None,
    backend: BackendOption = None,
) -> Outcome:
    """Run the gain map of the README: 49 152 runs of a geared drive, some seconds to a minute."""
    config = _shipped("gain_map.toml")
    study, chosen = read_study(config, backend)
    from jaxbl.sweeps.sweep import sweep

    return compute(context, config, study, out, False, chosen, sweep, "sweep", after_demo)


def _shipped(name: str) -> Path:
    """A study that comes with the package; in a clone it is beside it."""
    package = Path(__file__).parents[1]
    places = package / "studies" / name, package.parent / "sweeps" / name
    for file in places:
        if file.is_file():
            return file
    raise InputError(f"{places[0]}: no such file; install jaxbl anew, it comes with it")


def bench(
    context: typer.Context,
    quick: Annotated[
        bool, typer.Option("--quick", help="take less than a minute: shorter runs, the others in one precision")
    ] = False,
    out: Annotated[Path, typer.Option(metavar="DIR", help="folder for the results")] = Path("results/bench"),
) -> Outcome:
    """Time the same work by jaxbl, C++, numba, diffrax, NumPy, SciPy and OpenSMC: table, chart, bench.json."""
    workers.start_jax()
    import jax

    from jaxbl.files import make_folder, remove_if_empty_on_error
    from jaxbl.report.bench import write_bench_report
    from jaxbl.throughput import bench as run_bench

    # the time of compiling is measured, so that nothing may come from the cache
    jax.config.update("jax_enable_compilation_cache", False)
    make_folder(out)
    if any(out.iterdir()) and not (out / "bench.json").exists():
        raise InputError(f"{out}: is not empty and holds no benchmark; choose another folder with --out")
    with remove_if_empty_on_error(out), running(context, out, out, unit="parts", kept=False) as progress:
        result = run_bench(quick=quick, progress=progress)
    return Outcome(write_bench_report(result, out), out, "", "bench.json", code=1 if result.failures else 0)
