"""Goldens: what the working tree computes beside what a base commit did, and what moved.

    python benchmarks/goldens.py                             # all of them: the base's results are kept in .cache/goldens
    python benchmarks/goldens.py --only gain_map export_code
    python benchmarks/goldens.py --list

The table of commands is golden/table.py. Both sides are run by the same script, with the same inputs, one golden a process.
A difference that golden/expected.toml lists is no move, and neither is a sentence in other words (they are counted). Exit
code 1: something moved. The tree's results are left in results/goldens, those of the base in .cache/goldens/COMMIT.
"""

import argparse
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from fnmatch import fnmatchcase
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from golden.comparison import Difference, compare_folders
from golden.table import GOLDENS

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = Path(__file__).resolve().parent / "golden"
BASE = "7025ffb"
STANDS_ON = ("equinox", "jax", "jaxlib", "lineax", "llvmlite", "matplotlib", "numpy", "optimistix", "pandas", "scipy")
"""Packages whose versions may change numbers."""
SHOWN = 12
"""Differences of a golden that are printed."""


class Side(NamedTuple):
    """A source tree, and the folder that its results go to."""

    tree: Path
    results: Path


def git(*arguments: str) -> str:
    return subprocess.run(("git", *arguments), cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


def hash_of(*texts: str) -> str:
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:12]


def environment() -> str:
    """Versions, processor and Python: what else may change a number."""
    versions = [f"{package} {version(package)}" for package in STANDS_ON]
    try:
        flags = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith(("flags", "Features"))][
            :1
        ]
    except OSError:
        flags = []
    return " ".join([sys.version, platform.machine(), *versions, *flags])


def extract(commit: str, folder: Path) -> Path:
    """Write the files of a commit into a folder, unless they are there."""
    if not folder.exists():
        draft = folder.with_name(f"{folder.name}.{os.getpid()}")
        draft.mkdir(parents=True)
        archive = subprocess.run(("git", "archive", commit), cwd=ROOT, check=True, capture_output=True).stdout
        subprocess.run(("tar", "-x", "-C", str(draft)), input=archive, check=True)
        draft.replace(folder)
    return folder


def run(script: str, *arguments: str, folder: Path, path: Sequence[Path], cache: Path) -> None:
    """Run a script of golden/ in a folder, with packages from `path`; its output goes to FOLDER.log."""
    variables = {
        "PYTHONPATH": os.pathsep.join(map(str, path)),
        "PYTHONHASHSEED": "0",
        "OPENBLAS_NUM_THREADS": "1",
        "JAX_COMPILATION_CACHE_DIR": str(cache / "jax"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PLATFORMS": "cpu",
        # with a store of programs the machine's costs are measured, and decide how studies are cut into chunks
        "JAXBL_PROGRAMS": "",
        # one device and one thread a process: as many processes as cores
        "XLA_FLAGS": "--xla_force_host_platform_device_count=1 --xla_cpu_multi_thread_eigen=false",
        "COLUMNS": "80",
        # messages name the command as a shell finds it
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
    }
    with folder.with_name(f"{folder.name}.log").open("w") as log:
        command = [sys.executable, "-P", str(SCRIPTS / script), *arguments]
        subprocess.run(command, cwd=folder, env=os.environ | variables, check=True, stdout=log, stderr=subprocess.STDOUT)


def make_inputs(name: str, base: Path, cache: Path, recordings: Path) -> Path:
    """Make inputs by the base's own code, unless they are there."""
    key = hash_of((SCRIPTS / "inputs.py").read_text(), str(base), environment())
    folder = cache / "inputs" / f"{name}-{key}"
    if not folder.exists():
        draft = folder.with_name(f"{folder.name}.{os.getpid()}")
        draft.mkdir(parents=True)
        path = [base, base / "benchmarks", base / "tests"]
        run("inputs.py", name, str(draft), str(recordings), folder=draft, path=path, cache=cache)
        draft.replace(folder)
    return folder


def compute(name: str, side: Side, inputs: Mapping[str, Path], recordings: Path, cache: Path) -> float:
    """Run a golden's commands on a side; returns seconds."""
    started = time.perf_counter()
    # beside another process, perhaps, that computes the same base
    draft = side.results / f"{name}.{os.getpid()}"
    (draft / "inputs").mkdir(parents=True)
    (draft / "sweeps").symlink_to(side.tree / "sweeps")
    (draft / "recordings").symlink_to(recordings)
    for kind in GOLDENS[name].inputs:
        (draft / "inputs" / kind).symlink_to(inputs[kind])
    run("runner.py", name, str(side.tree), folder=draft, path=[side.tree], cache=cache)
    for path in sorted(draft.rglob("*.printed.json")):
        if path.read_text(encoding="utf-8").startswith('{"failed"'):
            print(f"{name}: {path.name.partition('.')[0]} crashed in {side.tree}", file=sys.stderr)
    shutil.rmtree(side.results / name, ignore_errors=True)
    draft.replace(side.results / name)
    return time.perf_counter() - started


def base_folder(name: str, commit: str, cache: Path) -> Path:
    """Folder of the base's results of a golden; its name changes with everything that decides them."""
    golden = GOLDENS[name]
    scripts = [(SCRIPTS / script).read_text() for script in ("runner.py", "inputs.py")]
    return cache / commit[:12] / hash_of(repr(golden), *scripts, environment())


def report(name: str, differences: Sequence[Difference], expected: Mapping[str, str], limit: int) -> bool:
    """Print what moved; returns whether something did that is not expected."""
    sentences = [difference for difference in differences if difference.is_sentence]
    moves = [difference for difference in differences if not difference.is_sentence]
    listed = [move for move in moves if any(fnmatchcase(f"{name}/{move.address}", pattern) for pattern in expected)]
    moved = [move for move in moves if move not in listed]
    remarks = [f"{len(sentences)} texts reworded"] if sentences else []
    remarks += [f"{len(listed)} expected differences"] if listed else []
    remark = f" ({', '.join(remarks)})" if remarks else ""
    if not moved:
        print(f"{name}: same{remark}")
        return False
    files = len({move.file for move in moved})
    largest = max(move.relative for move in moved)
    amount = f", numbers by up to {largest:.1e}" if largest else ""
    print(f"{name}: MOVED: {len(moved)} places in {files} files{amount}{remark}")
    for move in moved[:limit]:
        print(f"    {name}/{move}")
    if len(moved) > limit:
        print(f"    and {len(moved) - limit} more (--all)")
    return True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=[*GOLDENS], help="these goldens alone")
    parser.add_argument("--list", action="store_true", help="print the names of all goldens, and stop")
    parser.add_argument("--all", action="store_true", help="print all differences")
    parser.add_argument("--compare", action="store_true", help="compare what the last run of the tree left, and run nothing")
    parser.add_argument("--base", default=BASE, metavar="COMMIT", help=f"the other side [default: {BASE}]")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), metavar="N", help="processes [default: one a core]")
    parser.add_argument("--cache", type=Path, default=ROOT / ".cache" / "goldens", metavar="FOLDER")
    shared = Path(os.environ.get("JAXBL_DATA", ROOT.parent / "shared" / "data"))
    parser.add_argument("--recordings", type=Path, default=shared, metavar="FOLDER", help="recordings of real machines")
    options = parser.parse_args()
    if options.list:
        print("\n".join(GOLDENS))
        return
    names, cache, recordings = options.only or [*GOLDENS], options.cache.resolve(), options.recordings.resolve()
    if not recordings.is_dir():
        skipped = [name for name in names if GOLDENS[name].recordings]
        names = [name for name in names if name not in skipped]
        print("".join(f"{name}: skipped, no recordings in {recordings}\n" for name in skipped), end="")
    names.sort(key=lambda name: -GOLDENS[name].minutes)

    commit = git("rev-parse", f"{options.base}^{{commit}}")
    base_tree = extract(commit, cache / commit[:12] / "tree")
    folders = {name: base_folder(name, commit, cache) for name in names}
    tree = Side(ROOT, ROOT / "results" / "goldens")
    work = [(name, Side(base_tree, folders[name])) for name in names if not (folders[name] / name).exists()]
    work += [] if options.compare else [(name, tree) for name in names]
    kinds = {kind for name, _ in work for kind in GOLDENS[name].inputs}
    failed = []
    with ThreadPoolExecutor(options.jobs) as pool:
        pending = {kind: pool.submit(make_inputs, kind, base_tree, cache, recordings) for kind in kinds}
        inputs = {kind: future.result() for kind, future in pending.items()}
        futures = [(name, side, pool.submit(compute, name, side, inputs, recordings, cache)) for name, side in work]
        for name, side, future in futures:
            where = "tree" if side is tree else f"base, {side.results / name}"
            try:
                print(f"{name}: {future.result():.0f} s ({where})", file=sys.stderr, flush=True)
            except subprocess.CalledProcessError:
                print(f"{name}: failed ({where}): see {side.results / name}.{os.getpid()}.log", file=sys.stderr, flush=True)
                failed.append(name)

    expected = tomllib.loads((SCRIPTS / "expected.toml").read_text())
    moved = list(failed)
    for name in GOLDENS:
        if name in names and name not in failed:
            differences = compare_folders(folders[name] / name, tree.results / name, GOLDENS[name].tolerance)
            if report(name, differences, expected, len(differences) if options.all else SHOWN):
                moved.append(name)
    if moved:
        sys.exit(1)


if __name__ == "__main__":
    main()
