"""Commands around the work: bench."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbl import workers
from jaxbl.errors import InputError
from jaxbl.terminal import running

from .outcome import Outcome


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
