"""The command line: parse, call, print. JAX is imported only once a command has work for it."""

import dataclasses
import json
import math
import os
import shlex
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from .errors import InputError, NoResult

if TYPE_CHECKING:
    from jaxbl.gains.tune import Tuning
    from jaxbl.gains.verify import Verdict
    from jaxbl.sweeps.sweep import StudyResult
    from jaxbl.workers import Progress

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Drives with backlash, thousands at once: sliding-mode observation, gain maps, identification.",
)

ConfigArgument = Annotated[Path, typer.Argument(metavar="CONFIG", help="TOML study", show_default=False)]
OutOption = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="folder for the results [default: results/<config name>]")
]
LogArgument = Annotated[Path, typer.Argument(metavar="LOG", help="CSV, Parquet, MATLAB or JSON file", show_default=False)]
LogOutOption = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="folder for the results [default: results/<log name>]")
]
LogOverwriteOption = Annotated[bool, typer.Option("--overwrite", help="replace the results of another log")]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="remove the results of another study from the folder")]
BackendOption = Annotated[
    str | None,
    typer.Option("--backend", metavar="NAME", help="fused: a loop in registers; scan: XLA's [default: the faster here]"),
]


@app.callback()
def _main() -> None:
    """Needed by typer to keep subcommands with their names."""


@app.command()
def simulate(
    config: ConfigArgument,
    out: OutOption = None,
    seed: Annotated[int, typer.Option(help="seed of the encoder noise", min=0, max=2**31 - 1)] = 0,
    every: Annotated[int, typer.Option(help="keep every N-th sample of the trace", min=1, metavar="N")] = 1,
    overwrite: OverwriteOption = False,
) -> None:
    """Run the experiment of a study once: trace, figures, summary."""
    _start_jax()
    from jaxbl.sweeps.store import claim
    from jaxbl.sweeps.trial import run

    from .config import read_config
    from .report.reports import write_trial_report

    study = read_config(config)
    folder = _folder(config, out)
    claim(folder, study, "simulate", overwrite=overwrite)
    trial = run(study, seed=seed, every=every)
    _tell(write_trial_report(trial, folder), folder)
    if not trial.summary["metrics"]["finite"]:
        raise typer.Exit(1)


@app.command()
def sweep(
    config: ConfigArgument,
    out: OutOption = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="say what it will cost, and stop")] = False,
    overwrite: OverwriteOption = False,
    backend: BackendOption = None,
) -> None:
    """Run all points of a study: table of metrics, maps, report. Goes on where an interrupted run stopped."""
    _start_jax()
    from jaxbl.sweeps.metrics import metric_columns
    from jaxbl.sweeps.points import Points
    from jaxbl.sweeps.programs import backend_of
    from jaxbl.sweeps.sweep import dry_run as estimate_cost
    from jaxbl.sweeps.sweep import sweep as run_sweep

    from .config import read_config
    from .report.maps import check_figures
    from .report.reports import write_sweep_report

    chosen = backend_of(backend, "--backend")
    study = read_config(config)
    if not study.axes and study.sweep.seeds == 1:
        raise InputError(f"{config}: axes: the study has none; add [[axes]], or use 'jaxbl simulate'")
    with _naming(config):
        Points(study)
        check_figures(study, study.figures, metric_columns(study.build()))
        if dry_run:
            cost = estimate_cost(study, backend=chosen)
            refined = study.sweep.refine is not None
            coarse = " on the coarse grid" if refined else ""
            typer.echo(f"points       {cost.points}{coarse} ({cost.rows} runs with all seeds)")
            if refined:
                typer.echo(
                    f"refinement   at most {cost.most_points} points; as many as the boundaries need, not counted below"
                )
            typer.echo(f"chunks       {cost.chunks} of {cost.lanes_a_chunk} lanes")
            typer.echo(f"memory       {cost.megabytes:.1f} MB a chunk")
            typer.echo(f"compilation  about {_duration(cost.compile_seconds)}")
            rate = f"{cost.lane_steps_per_second:.2g} lane-steps/s measured, backend {cost.backend}"
            typer.echo(f"run          about {_duration(cost.run_seconds)} ({rate})")
            return
    folder = _folder(config, out)
    with _running(_words("sweep", config, chosen), config, folder) as progress:
        result = run_sweep(study, folder, progress=progress, overwrite=overwrite, backend=chosen)
    _tell(write_sweep_report(result, folder), folder, result)


@app.command()
def tune(
    config: ConfigArgument, out: OutOption = None, overwrite: OverwriteOption = False, backend: BackendOption = None
) -> None:
    """Choose lambda and alpha of both observers: gains.toml, comparison, report. Goes on where it was interrupted."""
    _start_jax()
    from jaxbl.gains.tune import tune as run_tune
    from jaxbl.sweeps.programs import backend_of

    from .config import read_config
    from .report.tuning import write_tune_report

    chosen = backend_of(backend, "--backend")
    study = read_config(config)
    folder = _folder(config, out)
    with _running(_words("tune", config, chosen), config, folder) as progress:
        result = run_tune(study, folder, progress=progress, overwrite=overwrite, backend=chosen)
    _tell(write_tune_report(result, folder), folder, result)


@app.command()
def verify(
    config: ConfigArgument, out: OutOption = None, overwrite: OverwriteOption = False, backend: BackendOption = None
) -> None:
    """Check the gain conditions on three levels: verdict, counterexamples, atlas. Goes on where it was interrupted."""
    _start_jax()
    from jaxbl.gains.verify import verify as run_verify
    from jaxbl.sweeps.programs import backend_of

    from .config import read_config
    from .report.atlas import write_verify_report

    chosen = backend_of(backend, "--backend")
    study = read_config(config)
    folder = _folder(config, out)
    with _running(_words("verify", config, chosen), config, folder) as progress:
        verdict = run_verify(study, folder, progress=progress, overwrite=overwrite, backend=chosen)
    _tell(write_verify_report(verdict, folder), folder, verdict)


@app.command()
def inspect(
    log: LogArgument,
    model: Annotated[
        Path | None, typer.Option("--model", metavar="TOML", help="study, or a file with nothing but [log]: how to read it")
    ] = None,
    out: LogOutOption = None,
    overwrite: LogOverwriteOption = False,
) -> None:
    """Say what a measured log holds and what it can identify: channels, sampling, noise, figures."""
    from .config import read_log_config
    from .records import inspect as inspect_log
    from .report.inspected import write_inspection_report

    table, gear_ratio = (None, None) if model is None else read_log_config(model)
    found = inspect_log(log, table, gear_ratio=gear_ratio)
    folder = _folder(log, out)
    _claim_for_log(folder, log, overwrite=overwrite)
    for line in write_inspection_report(found, folder):
        typer.echo(line)
    typer.echo(f"{folder / 'report.html'}")


@app.command()
def identify(
    log: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="CSV, Parquet, MATLAB or JSON files of one machine", show_default=False),
    ],
    model: Annotated[
        Path, typer.Option("--model", metavar="TOML", help="study with nominal numbers, and [log]", show_default=False)
    ],
    holdout: Annotated[
        Path | None, typer.Option("--holdout", metavar="LOG2", help="log of the same machine to try the numbers out on")
    ] = None,
    profile: Annotated[
        bool | None, typer.Option("--profile", help="profile-likelihood intervals as well", show_default=False)
    ] = None,
    out: LogOutOption = None,
    overwrite: LogOverwriteOption = False,
) -> None:
    """Find a machine's numbers in its logs, with intervals: stiffness, gap, inertias, frictions."""
    _start_jax()
    from jaxbl.identification.identify import read_task, run_task

    from .report.identified import identification_lines, write_identification_report

    task = read_task(log, model, holdout=holdout, profile=profile)
    folder = _folder(log[0], out)
    _claim_for_log(folder, log[0], overwrite=overwrite)
    finished = _finished(folder / "identification.json", task.identity)
    if finished is not None:
        _tell(identification_lines(finished), folder)
        return
    again = ["identify", *map(str, log), "--model", str(model)]
    again += ["--holdout", str(holdout)] if holdout is not None else []
    again += ["--profile"] * bool(profile) + ["--overwrite"] * overwrite
    with _leaving_nothing(folder), _running(again, model, folder, unit="steps", kept=False) as progress:
        lines = write_identification_report(run_task(task, progress), folder)
    _tell(lines, folder)


@app.command()
def diagnose(
    log: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[LOG...]", help="CSV, Parquet, MATLAB or JSON files of one machine", show_default=False),
    ] = None,
    model: Annotated[
        Path | None, typer.Option("--model", metavar="TOML", help="study with nominal numbers, [uncertainty] and [log]")
    ] = None,
    holdout: Annotated[
        Path | None,
        typer.Option(
            "--holdout", metavar="LOG2", help="log of the same machine for the proof [default: the log's last quarter]"
        ),
    ] = None,
    batch: Annotated[
        Path | None,
        typer.Option(
            "--batch", metavar="FOLDER", help="diagnose every log of a folder; NAME.toml beside NAME.csv is its model"
        ),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option("--jobs", metavar="N", min=1, help="processes that share a batch [default: one a core]"),
    ] = None,
    next_experiment: Annotated[
        Path | None,
        typer.Option("--next-experiment", metavar="FILE.csv", help="write the input that would part tied effects"),
    ] = None,
    max_torque: Annotated[
        float | None,
        typer.Option("--max-torque", metavar="N·m", help="that the next experiment may ask for [default: the log's]"),
    ] = None,
    max_travel: Annotated[
        float | None,
        typer.Option(
            "--max-travel",
            metavar="RAD",
            help="of its motor (m on a linear axis) [default: the log's]",
        ),
    ] = None,
    out: LogOutOption = None,
    overwrite: LogOverwriteOption = False,
) -> None:
    """Find what a model lacks, name it, add it, and prove on held-out data that the gap shrinks."""
    for name, limit in (("--max-torque", max_torque), ("--max-travel", max_travel)):
        if limit is not None and next_experiment is None:
            raise InputError(f"{name} limits what --next-experiment FILE.csv asks for; give both")
        if limit is not None and not 0.0 < limit < math.inf:
            raise InputError(f"{name} is {limit:g}; it has to be positive")
    if batch is not None:
        if log or holdout is not None or next_experiment is not None:
            raise InputError("--batch FOLDER takes no logs, --holdout or --next-experiment; give these one by one")
        _start_jax()
        _diagnose_batch(batch, model, out if out is not None else Path("results") / batch.name, jobs, overwrite)
        return
    if jobs is not None:
        raise InputError("--jobs goes with --batch: one log is one process's work")
    if not log:
        raise InputError("diagnose: no log; give one or several of one machine, or a folder with --batch")
    if model is None:
        raise InputError("diagnose: no model; give a study with nominal numbers: --model TOML")
    _start_jax()
    from jaxbl.diagnosis.diagnose import read_task, run_task

    from .report.diagnosed import diagnosis_lines, write_diagnosis_report

    task = read_task(log, model, holdout=holdout)
    folder = _folder(log[0], out)
    _claim_for_log(folder, log[0], overwrite=overwrite)
    finished = _finished(folder / "diagnosis.json", task.identity)
    if finished is None:
        again = ["diagnose", *map(str, log), "--model", str(model)]
        again += ["--holdout", str(holdout)] if holdout is not None else []
        again += ["--next-experiment", str(next_experiment)] if next_experiment is not None else []
        again += ["--max-torque", f"{max_torque:g}"] if max_torque is not None else []
        again += ["--max-travel", f"{max_travel:g}"] if max_travel is not None else []
        with (
            _leaving_nothing(folder),
            _running(again + ["--overwrite"] * overwrite, model, folder, unit="steps", kept=False) as progress,
        ):
            found = run_task(task, progress)
            lines, finished = write_diagnosis_report(found, folder), found.summary
    else:
        lines = diagnosis_lines(finished)
    if next_experiment is not None:
        from jaxbl.diagnosis.next_experiment import Limits, write_next_experiment

        lines += write_next_experiment(folder, finished, task.record, next_experiment, Limits(max_torque, max_travel))
    _tell(lines, folder)


_LOGS = (".csv", ".parquet", ".mat")


class _Job(NamedTuple):
    """A log of a batch, its model and its hold-out log, and the folder of its results."""

    log: Path
    model: Path
    holdout: Path | None
    folder: Path
    overwrite: bool


def _diagnose_batch(source: Path, model: Path | None, out: Path, jobs: int | None, overwrite: bool) -> None:
    """Diagnose all logs of a folder, each into a folder of its own; go on where an earlier call stopped."""
    from jaxbl.files import make_folder

    from .report.diagnosed import write_batch
    from .workers import each, worth

    if not source.is_dir():
        raise InputError(f"{source}: no such folder; --batch needs one with logs ({', '.join(_LOGS)})")
    logs = sorted(file for file in source.iterdir() if file.suffix.lower() in _LOGS)
    if not logs:
        raise InputError(f"{source}: holds no log ({', '.join(_LOGS)})")
    stems = [file.stem for file in logs]
    for name in stems:
        if stems.count(name) > 1:
            raise InputError(f"{source}: two logs are called {name}; each needs a name of its own for its results")
    held = {file.stem: file for file in (source / "holdout").glob("*") if file.suffix.lower() in _LOGS}
    work = []
    for file in logs:
        own = file.with_suffix(".toml") if file.with_suffix(".toml").exists() else model
        if own is None:
            raise InputError(f"{file}: no model; give --model TOML, or {file.with_suffix('.toml').name} beside it")
        work.append(_Job(file, own, held.get(file.stem), out / file.stem, overwrite))
    make_folder(out)
    words = ["diagnose", "--batch", str(source), *(["--model", str(model)] if model else [])]
    words += [*(["--jobs", str(jobs)] if jobs else []), *["--overwrite"] * overwrite]
    rows = []
    with _running(words, model or source, out, unit="logs") as progress:
        progress(0, len(work))
        for row in each(_diagnosed, work, worth(len(work)) if jobs is None else min(jobs, len(work))):
            rows.append(row)
            progress(len(rows), len(work))
    for line in write_batch(rows, out):
        typer.echo(line)
    typer.echo(f"{out / 'batch.csv'}")
    if all(row["refused"] for row in rows):
        raise typer.Exit(2)


def _diagnosed(job: _Job) -> dict[str, Any]:
    """Row of a batch: a log's diagnosis, or why there is none."""
    from jaxbl.diagnosis.diagnose import read_task, run_task

    from .report.diagnosed import batch_row, write_diagnosis_report
    from .workers import forget_programs

    forget_programs()
    try:
        task = read_task(job.log, job.model, holdout=job.holdout)
        _claim_for_log(job.folder, job.log, overwrite=job.overwrite)
        finished = _finished(job.folder / "diagnosis.json", task.identity)
        if finished is None:
            with _leaving_nothing(job.folder):
                found = run_task(task)
                write_diagnosis_report(found, job.folder)
            finished = found.summary
        return batch_row(job.log, finished)
    except InputError as error:
        return batch_row(job.log, None, str(error))


@contextmanager
def _leaving_nothing(folder: Path) -> Iterator[None]:
    """Remove a folder that is still empty when something goes wrong."""
    try:
        yield
    except BaseException:
        with suppress(OSError):  # not empty: it was there before
            folder.rmdir()
        raise


def _finished(file: Path, identity: str) -> dict[str, Any] | None:
    """What an earlier call found, if it was asked the same."""
    try:
        found = json.loads(file.read_text())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) and found.get("identity") == identity else None


_LOG_MARKERS = ("inspection.json", "identification.json", "diagnosis.json")


def _claim_for_log(folder: Path, log: Path, *, overwrite: bool) -> None:
    """Make the folder; leave other results than those of this log alone."""
    from jaxbl.files import make_folder

    make_folder(folder)
    markers = [folder / name for name in _LOG_MARKERS if (folder / name).exists()]
    if not markers and any(folder.iterdir()):
        raise InputError(f"{folder}: is not empty and holds no results of a log; choose another folder with --out")
    for marker in markers:
        try:
            file = json.loads(marker.read_text(encoding="utf-8"))["file"]
        except (OSError, ValueError, KeyError, TypeError):
            file = "an unreadable one"
        if file != str(log.resolve()) and not overwrite:
            raise InputError(f"{folder}: holds results of another log ({file}); choose another with --out, or --overwrite")


@app.command()
def plot(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="folder of a sweep", show_default=False)],
    config: Annotated[
        Path | None, typer.Option("--config", metavar="CONFIG", help="take the figures from this study, not the stored one")
    ] = None,
) -> None:
    """Redraw figures and report of a sweep from its stored points, without simulating."""
    _start_jax()
    from jaxbl.sweeps.store import Store, identity
    from jaxbl.sweeps.sweep import load

    from .config import read_config
    from .report.reports import write_sweep_report

    result = load(folder)
    if config is not None:
        study = read_config(config)
        if identity(study) != Store.open(folder).manifest["identity"]:
            raise InputError(f"{config}: is not the study in {folder}; only title, notes and figures may differ")
        result = dataclasses.replace(result, config=study)
    _tell(write_sweep_report(result, folder), folder)


@app.command()
def bench(
    quick: Annotated[
        bool, typer.Option("--quick", help="in less than a minute: shorter runs, rivals in one precision")
    ] = False,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="folder for the results")] = Path("results/bench"),
) -> None:
    """Measure this machine: the same work by jaxbl, C++, numba, diffrax, NumPy, SciPy, OpenSMC; table, chart, bench.json."""
    _start_jax()
    import jax

    from jaxbl.files import make_folder

    from .report.throughput import write_bench_report
    from .throughput import bench as run_bench

    # what was compiled before does not count
    jax.config.update("jax_enable_compilation_cache", False)
    make_folder(out)
    if any(out.iterdir()) and not (out / "bench.json").exists():
        raise InputError(f"{out}: is not empty and holds no benchmark; choose another folder with --out")
    with _leaving_nothing(out), _running(["bench", *["--quick"] * quick], out, out, unit="parts", kept=False) as progress:
        result = run_bench(quick=quick, progress=progress)
    for line in write_bench_report(result, out):
        typer.echo(line)


def _words(command: str, config: Path, backend: str | None) -> list[str]:
    """Of a command that goes on, without its folder."""
    return [command, str(config), *(["--backend", backend] if backend else [])]


def _folder(config: Path, out: Path | None) -> Path:
    return out if out is not None else Path("results") / config.stem


def _start_jax() -> None:
    """Use every core as a device, and keep compiled programs between runs."""
    import jax

    from .workers import cores

    if "xla_force_host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        jax.config.update("jax_num_cpu_devices", cores())
    if jax.config.values["jax_compilation_cache_dir"] is None:
        cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "jaxbl"
        jax.config.update("jax_compilation_cache_dir", str(cache))
        # also what takes less than a second: a study has several of them
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


@contextmanager
def _naming(config: Path, folder: Path | None = None) -> Iterator[None]:
    """Put the config's name in front of messages that know only the key, and are not about the folder of the results."""
    try:
        yield
    except InputError as error:
        message = str(error)
        named = "/" in message.split(":")[0] or (folder is not None and message.startswith(f"{folder}:"))
        raise InputError(message if named else f"{config}: {message}") from None


@contextmanager
def _running(words: list[str], config: Path, folder: Path, *, unit: str = "runs", kept: bool = True) -> "Iterator[Progress]":
    """Around a long computation: messages name the config, progress is shown, and an interrupt says how to go on.

    `words` are the command's, without the folder; `kept` says whether what is finished stays in it. An interrupt may be
    lost in foreign code, or come out of it as another error: it is remembered, and heeded at the next progress or error.
    """
    interrupted = False

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal interrupted
        interrupted = True
        # an error out of JAX's part of the garbage collection would be printed and ignored
        if frame is None or frame.f_code.co_name != "_xla_gc_callback":
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, interrupt)
    try:
        with _naming(config, folder), _progress(unit) as shown:

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
        told = "what is finished is kept. Go on with" if kept else "nothing was written. Start again with"
        typer.echo(f"interrupted; {told}: {resume}", err=True)
        raise typer.Exit(130) from None
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _progress(unit: str) -> "Iterator[Progress | None]":
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


def _tell(lines: list[str], folder: Path, computed: "StudyResult | Tuning | Verdict | None" = None) -> None:
    """Print the headline of a report, what it took to compute, and where the report lies."""
    for line in lines:
        typer.echo(line)
    cost = getattr(computed, "cost", None)
    if cost and cost["lanes"]:
        compiling, running = _duration(cost["compile_seconds"]), _duration(cost["run_seconds"])
        typer.echo(f"Compiled in {compiling}, ran {cost['lanes']:.0f} lanes in {running}.")
    for what in computed.scanned if computed is not None else ():
        typer.echo(f"Scanned, and slower for it: the fused loop does not know {what}.")
    typer.echo(f"{folder / 'report.html'}")


def _duration(seconds: float) -> str:
    if seconds < 100.0:
        return f"{seconds:.1f} s"
    if seconds < 6000.0:
        return f"{seconds / 60.0:.0f} min"
    return f"{seconds / 3600.0:.1f} h"


def main(run: Callable[..., object] = app) -> None:
    """Run a command: exit 0 done, 1 failed, 2 bad input (one line), 130 interrupted."""
    try:
        run()
    except InputError as error:
        typer.echo(f"jaxbl: {error}", err=True)
        sys.exit(2)
    except NoResult as error:
        typer.echo(f"jaxbl: {error}", err=True)
        sys.exit(1)
    except KeyboardInterrupt:
        typer.echo("interrupted", err=True)
        sys.exit(130)


def program() -> None:
    """Entry point: as :func:`main`, and what was interrupted ends at once.

    Threads of XLA may still compute then, and crash the process when the interpreter takes down what they work on.
    """
    try:
        main()
    except SystemExit as end:
        if end.code != 130:
            raise
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(130)


if __name__ == "__main__":
    program()
