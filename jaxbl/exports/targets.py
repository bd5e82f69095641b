"""What a study can be exported to: a table of targets, and the call that writes one into a folder."""

import re
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxbl.config import Config, read_config
from jaxbl.errors import InputError
from jaxbl.files import is_empty, json_with_checksum, make_folder, read_json, remove_if_empty_on_error, write_atomic
from jaxbl.fused import Unsupported
from jaxbl.sweeps.store import identity

from .block import Program, Quantity, program_of
from .c import c_code
from .chain import observer_chain
from .filter import columns, filter_code
from .fmu import FMI, fmu
from .lowering import operations_of
from .mjcf import MUJOCO, by_answer, mjcf
from .plant import plant_program
from .st import st_code

SUMMARY = "export.json"
PRECISIONS = {"double": "float64", "float": "float32"}
"""Types of numbers, as the options name them."""
_LONGEST_NAME = 23
"""Letters; with what is added to it, a name has the 31 that compilers have to tell apart."""


class Request(NamedTuple):
    """What is asked for: a study, its name in the code, the type of its numbers, the sides that move along a line, the
    version of FMI, and the file that the study came from ("" for none)."""

    config: Config
    name: str
    precision: str
    linear: tuple[str, ...]
    fmi: int
    file: str


class Files(NamedTuple):
    """What a target makes: contents by file name, what it says of itself in `export.json`, and lines for the terminal."""

    contents: Mapping[str, str | bytes]
    summary: Mapping[str, Any]
    lines: list[str]


class Target(NamedTuple):
    """A target: what it is, what makes its files, which options it has, and the name of what comes from no file. `make`
    raises `Unsupported` where a study has what the target cannot say."""

    about: str
    make: Callable[[Request], Files]
    options: tuple[str, ...]
    unnamed: str = "observer"


class Export(NamedTuple):
    """What was written.

    Attributes:
        folder: where it is.
        files: names of the files in it.
        summary: what `export.json` says.
        lines: the same in a few words.
    """

    folder: Path
    files: tuple[str, ...]
    summary: Mapping[str, Any]
    lines: list[str]


def _c(request: Request) -> Files:
    program, name = _program(request), request.name
    code = c_code(program, _about(request, program, _c_call(program)))
    texts = {f"{name}.c": code.source, f"{name}.h": code.header, f"{name}_filter.c": filter_code(program)}
    summary = _summary(program) | {"state_bytes": state_bytes(program)}
    lines = [
        f"{name}.c, {name}.h: {_cost(program)}, and a state of {summary['state_bytes']} bytes.",
        f"{name}_filter.c: an example that reads {','.join(columns(program))} as CSV:",
        f"  cc -std=c99 -O2 {name}.c {name}_filter.c -lm -o {name}_filter",
    ]
    return Files(texts, summary, lines)


def _st(request: Request) -> Files:
    program, name = _program(request), request.name
    about = [
        "How to call: an instance of the function block once a sample, the first one included. restart begins anew.",
        "Divisions by zero give zero. Where a controller computes as IEEE 754 asks, the numbers are those of --target c.",
    ]
    lines = [f"{name}.st: function block {name}, {_cost(program)}."]
    return Files({f"{name}.st": st_code(program, _about(request, program, about))}, _summary(program), lines)


def _mjcf(request: Request) -> Files:
    text, step, said = mjcf(request.config, linear=request.linear)
    lists = by_answer(said)
    lines = [f"model.xml: MuJoCo {MUJOCO} or later, steps of {step:.3g} s."]
    lines += [f"{how}: {path}: {why}" for how in ("approximated", "not said") for path, why in lists[how].items()]
    return Files({"model.xml": text}, {"mujoco": MUJOCO, "time_step": step} | lists, lines)


def _fmu(request: Request) -> Files:
    name, fmi = request.name, FMI[request.fmi]
    plant = plant_program(request.config, name, np.dtype(PRECISIONS[request.precision]))
    call = ["Called by the functions of FMI. Functions touch nothing but their arguments."]
    made = fmu(request.config, plant, _head(request, f"{name}: the drive, from sample to sample.", call), request.fmi)
    period, count = request.config.run.sample_period, sum(one.causality == "parameter" for one in made.variables)
    what = f"{name}.fmu: FMI {fmi}, co-simulation, steps of {period:g} s, {count} parameters"
    places, why = " and ".join(made.binaries), "; ".join(made.why)
    if made.binaries:
        lines = [f"{what}; {'binaries' if made.binaries[1:] else 'a binary'} for {places}, and the sources."]
        lines += [f"One more binary is missing: {why}."] if why else []
    else:
        lines = [f"{what}; the sources alone: {why}."]
    summary = {
        "precision": request.precision,
        "sample_period": period,
        "fmi": fmi,
        "token": made.token,
        "binaries": made.binaries,
        "variables": [dict(one._asdict()) for one in made.variables],
    }
    return Files({f"{name}.fmu": made.content}, summary, lines)


_OF_CODE = "precision", "name"
TARGETS: dict[str, Target] = {
    "c": Target("C99: observers, equivalent control and identifier, one source file and one header", _c, _OF_CODE),
    "st": Target("structured text (IEC 61131-3): the same as a function block", _st, _OF_CODE),
    "mjcf": Target("a MuJoCo model of the drive, its gap and its effects", _mjcf, ("linear",)),
    "fmu": Target("the drive as a Functional Mock-up Unit for co-simulation", _fmu, (*_OF_CODE, "fmi"), "drive"),
}
"""By the names of --target."""


def export(
    config: str | Path | Mapping[str, Any] | Config,
    folder: str | Path,
    target: str = "c",
    *,
    precision: str | None = None,
    name: str | None = None,
    linear: Sequence[str] = (),
    fmi: int | None = None,
) -> Export:
    """Write a study for another system: as code what `jaxbl.simulate.step` does with a recorded input and measured
    positions, or the drive as a model for simulators.

    Args:
        config: the study.
        folder: new or empty, or one that holds an export of this target and name, which is written anew.
        target: one of `TARGETS`.
        precision: "double" or "float"; left out, that of the study.
        name: of functions and files, a C identifier of small letters; left out, that of the study's file, or `observer`
            (of an FMU: `drive`).
        linear: of a MuJoCo model, the sides (`motor`, `load`) that move along a line: in kg, N, m.
        fmi: version of an FMU, 2 or 3; left out, 3.

    Raises:
        InputError: of these, or the study has what the target cannot say.
    """
    file = Path(config).name if isinstance(config, str | Path) else ""
    study = read_config(config)
    if target not in TARGETS:
        raise InputError(f"--target {target}: should be one of {', '.join(TARGETS)}")
    given = {"precision": precision, "name": name, "linear": linear, "fmi": fmi}
    for option, value in given.items():
        if value not in (None, (), []) and option not in TARGETS[target].options:
            raise InputError(f"--{option}: --target {target} has no such option; leave it out")
    chosen = {long: short for short, long in PRECISIONS.items()}[study.run.precision] if precision is None else precision
    if chosen not in PRECISIONS:
        raise InputError(f"--precision {chosen}: should be one of {', '.join(PRECISIONS)}")
    if fmi is not None and fmi not in FMI:
        raise InputError(f"--fmi {fmi}: should be one of {', '.join(map(str, FMI))}")
    known = _name(file, TARGETS[target].unnamed) if name is None else checked_name(name)
    request = Request(study, known, chosen, tuple(linear), fmi or max(FMI), file)
    try:
        made = TARGETS[target].make(request)
    except Unsupported as why:
        raise InputError(f"--target {target}: {file or 'the study'} has what it cannot say: {why}") from None
    head = {
        "target": target,
        "name": request.name,
        "title": study.title,
        "study": file,
        "identity": identity(study, "simulate"),
        "jaxbl": version("jaxbl"),
        "files": list(made.contents),
    }
    summary = head | dict(made.summary)
    where = Path(folder)
    with remove_if_empty_on_error(where):
        _claim(where, request.name, target)
        for file_name, content in made.contents.items():
            write_atomic(where / file_name, content)
        write_atomic(where / SUMMARY, json_with_checksum(summary))
    return Export(where, (*made.contents, SUMMARY), summary, made.lines)


def _claim(folder: Path, name: str, target: str) -> None:
    """Make the folder, or see that it holds the same export."""
    make_folder(folder)
    if is_empty(folder):
        return
    if not (folder / SUMMARY).exists():
        raise InputError(f"{folder}: is not empty and holds no export; choose another folder with --out")
    found = read_json(folder / SUMMARY)
    if (found.get("name"), found.get("target")) != (name, target):
        other = f"{found.get('name')} for --target {found.get('target')}"
        raise InputError(f"{folder}: holds another export ({other}); choose another folder with --out")


_RESERVED = (
    "auto break case char const continue default do double else enum extern float for goto if inline int long register "
    "restrict return short signed sizeof static struct switch typedef union unsigned void volatile while bool true false "
    "main and or not xor mod then elsif end_if to by repeat until exit function program var type array of at real lreal "
    "dint udint lint ulint "
    "assert complex ctype errno fenv inttypes limits locale math setjmp signal stdarg stdbool stddef stdint stdio stdlib "
    "string tgmath time wchar wctype"
)
"""Keywords of the languages, and headers of C: a build may look for those where the code's own header is."""


def checked_name(name: str) -> str:
    """A name that every target can use. Raises `InputError`."""
    if not re.fullmatch(r"[a-z](_?[a-z0-9])*", name) or len(name) > _LONGEST_NAME or name in _RESERVED.split():
        raise InputError(
            f"--name {name}: should be small letters, digits and single underscores, begin with a letter, have at most "
            f"{_LONGEST_NAME} letters, and be no keyword and no header of C"
        )
    return name


def _name(file: str, unnamed: str) -> str:
    """A name from that of a file; the other one where there is none."""
    plain = re.sub(r"[^a-z0-9]+", "_", Path(file).stem.lower()).strip("_")
    plain = plain if plain[:1].isalpha() else f"study_{plain}"
    plain = plain[:_LONGEST_NAME].strip("_") if file else unnamed
    return f"{plain}_code" if plain in _RESERVED.split() else plain


def _program(request: Request) -> Program:
    return program_of(observer_chain(request.config, request.name, np.dtype(PRECISIONS[request.precision])))


def _cost(program: Program) -> str:
    return f"{operations_of(program.step).total()} operations a step in {_precision(program)}"


def _precision(program: Program) -> str:
    return next(short for short, long in PRECISIONS.items() if program.block.dtype == long)


def _about(request: Request, program: Program, call: list[str]) -> list[str]:
    """Lines for the beginning of a file."""
    sides = [one.name.removesuffix("_position") for one in program.block.first]
    parts = f"{'observers' if len(sides) > 1 else 'observer'} of {' and '.join(sides)}, equivalent control"
    identifier = ", identifier" if any(one.name.endswith("_identified") for one in program.block.outputs) else ""
    return _head(request, f"{request.name}: {parts}{identifier}, from sample to sample.", call)


def _head(request: Request, what: str, call: list[str]) -> list[str]:
    config = request.config
    said = f" ({config.title})" if config.title else ""
    return [
        what,
        "",
        f"Made by jaxbl {version('jaxbl')} from {request.file or 'a study'}{said},",
        f"whose numbers have the hash {identity(config, 'simulate')}. To change one, change the study and export it again.",
        f"Numbers: {request.precision}. Sampling period: {config.run.sample_period:g} s. SI units: s, rad, N m.",
        "",
        *call,
    ]


def _c_call(program: Program) -> list[str]:
    block, name = program.block, program.block.name
    first, inputs = (", ".join(one.name for one in some) for some in (block.first, block.inputs))
    period = program.block.known["run.sample_period"].value
    return [
        "How to call:",
        f"    static {name}_state state;",
        f"    {name}_outputs outputs;",
        f"    {name}_init(&state, {first});           once, with the first measured positions",
        f"    {name}_step(&state, {inputs}, &outputs);  every {period:g} s, the first sample included",
        "",
        "Functions touch nothing but their arguments. Each operation is rounded once, and numbers are the same on every",
        "machine, if the compiler contracts no products with sums: gcc with -std=c99 or -ffp-contract=off, clang with",
        "-ffp-contract=off or on; never -ffast-math. Of libm, sqrt and fabs are called alone.",
    ]


def _summary(program: Program) -> dict[str, Any]:
    block = program.block
    counts = operations_of(program.step)
    return {
        "precision": _precision(program),
        "sample_period": block.known["run.sample_period"].value,
        "first": [_said(one) for one in block.first],
        "inputs": [_said(one) for one in block.inputs],
        "outputs": [_said(one) for one in block.outputs],
        "state": [{"name": one.name, "type": str(one.dtype)} for one in program.state],
        "operations_per_step": dict(sorted(counts.items())),
        "operations": counts.total(),
    }


def _said(one: Quantity) -> dict[str, str]:
    return {"name": one.name, "unit": one.unit, "about": one.about, "type": str(one.dtype)}


def state_bytes(program: Program) -> int:
    """Size of the state's struct where numbers are aligned to their own size."""
    sizes = [one.dtype.itemsize for one in program.state] or [4]
    end = 0
    for size in sizes:
        end = -(-end // size) * size + size
    return -(-end // max(sizes)) * max(sizes)
