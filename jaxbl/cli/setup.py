"""Commands before the work: init, schema, doctor, demo, bench."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbl import workers
from jaxbl.datasheet import ITEMS, Given, Item, first_study, remark
from jaxbl.errors import InputError
from jaxbl.files import write_atomic
from jaxbl.terminal import answers, running, two_columns, working

from .next_steps import after_demo, after_init
from .options import BackendOption, OutOption, check_new
from .outcome import Outcome, with_options
from .studies import compute, read_study

NewArgument = Annotated[Path, typer.Argument(metavar="[NEW.toml]", help="file to be written", show_default="drive.toml")]


def init(
    context: typer.Context,
    file: NewArgument = Path("drive.toml"),
    title: Annotated[str, typer.Option(metavar="TEXT", help="headline of its report")] = "",
    **given: str | None,
) -> Outcome:
    """Write a first study from a drive's data sheet: what no option says is asked for."""
    check_new(file, "init")
    values = {one.name: one.read(text) for one in ITEMS if (text := given[one.name]) is not None}
    if answers():
        if len(values) < len(ITEMS):
            typer.echo("Numbers of the data sheet with their units; Enter takes what is in brackets.", err=True)
        values = {one.name: values.get(one.name) or _asked(one) for one in ITEMS}
    elif missing := [one for one in ITEMS if one.name not in values and not one.default]:
        wanted = ", ".join(f"{one.option} '{one.example}'" for one in missing)
        raise InputError(f"init: these numbers are missing, here with examples: {wanted}; on a terminal they are asked for")
    values = {one.name: values.get(one.name) or one.left_out() for one in ITEMS}
    workers.start_jax()
    with working(context, "running a pilot for the gains"):
        text, found = first_study(values, title or file.stem)
    check_new(file, "init")
    write_atomic(file, text)
    bounds = {side: one["f_plus"] for side, one in found.items()}
    said = ", ".join(f"{bound:.3g} rad/s² ({side})" for side, bound in bounds.items())
    lines = [
        f"{file}: a study with comments. Gains by the usual rule, for unknown accelerations up to {said}.",
        *([said] if (said := remark(values, found)) else []),
    ]
    data = {"file": str(file), "given": {name: one._asdict() for name, one in values.items()}, "f_plus": bounds}
    return Outcome(lines, summary=data, steps=after_init(file))


def _asked(item: Item) -> Given:
    """What the user answers; asked again where that is no such number."""
    while True:
        known = ", ".join(unit for unit in item.units if unit)
        question = f"{item.asked}, such as {item.example}{f' (units: {known})' if known else ''}"
        text = typer.prompt(question, default=item.default or None, err=True)
        try:
            return item.left_out() if text == item.default else item.read(text)
        except InputError as error:
            typer.echo(f"  {error}", err=True)


def _option(item: Item) -> object:
    known = ", ".join(unit for unit in item.units if unit)
    default = f" [default: {item.default}]" if item.default else ""
    about = f"{item.asked}, such as '{item.example}'{f'; units: {known}' if known else ''}{default}"
    return Annotated[str | None, typer.Option(item.option, metavar="VALUE", help=about, show_default=False)]


with_options(init, init, {item.name: _option(item) for item in ITEMS}, None)


def schema(
    out: Annotated[Path | None, typer.Option(metavar="NEW.json", help="file to be written [default: stdout]")] = None,
) -> None:
    """Print the JSON schema of a study, by which editors complete and check its keys."""
    import json

    from jaxbl.config.schema import schema as schema_of

    if out is not None:
        check_new(out, "--out")
    text = json.dumps(schema_of(), indent=1, ensure_ascii=False)
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
    lines = two_columns((one.name, one.found if one.good else f"FAILED: {one.found}") for one in findings)
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

    from jaxbl.files import make_folder, removed_if_empty
    from jaxbl.report.bench import write_bench_report
    from jaxbl.throughput import bench as run_bench

    # the time of compiling is measured, so that nothing may come from the cache
    jax.config.update("jax_enable_compilation_cache", False)
    make_folder(out)
    if any(out.iterdir()) and not (out / "bench.json").exists():
        raise InputError(f"{out}: is not empty and holds no benchmark; choose another folder with --out")
    with removed_if_empty(out), running(context, out, out, unit="parts", kept=False) as progress:
        result = run_bench(quick=quick, progress=progress)
    return Outcome(write_bench_report(result, out), out, "", "bench.json")
