"""What a study can be exported to: a table of targets, and the call that writes one into a folder."""

import re
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxbl.config import Config, ConfigSource, read_config
from jaxbl.errors import InputError
from jaxbl.files import Subject, open_results, write_atomic, write_json
from jaxbl.fused import Unsupported
from jaxbl.json_types import JsonObject
from jaxbl.sweeps.store import identity

from .block import Port, Program, lower_block, widen_positions
from .c import write_c_code
from .chain import build_observer_chain
from .filter import input_columns, write_filter_code
from .fmu import FMI, build_fmu
from .lowering import count_operations
from .mjcf import MUJOCO, group_by_fidelity, write_mjcf
from .plant import build_plant_program
from .st import write_st_code

SUMMARY = "export.json"
PRECISIONS = {"double": "float64", "float": "float32"}
"""Types of numbers, as the options name them."""
_LONGEST_NAME = 23
"""Letters; with what is added to it, a name has the 31 that compilers have to tell apart."""


class Request(NamedTuple):
    """A study to export and the options.

    Attributes:
        config: the study.
        name: of functions and files in the code.
        precision: of its numbers, a key of `PRECISIONS`.
        linear: sides that move along a line.
        fmi: version of FMI.
        file: name of the file that the study came from, "" for none.
    """

    config: Config
    name: str
    precision: str
    linear: tuple[str, ...]
    fmi: int
    file: str


class Files(NamedTuple):
    """Contents by file name, entries for `export.json`, and lines for the terminal."""

    contents: Mapping[str, str | bytes]
    summary: JsonObject
    lines: list[str]


class Target(NamedTuple):
    """A target of `jaxbl export`.

    Attributes:
        description: for the help.
        make: writes the files; raises `Unsupported` where the target cannot express something in the study.
        options: options of the command that the target has.
        unnamed: name in the code for a study that comes from no file.
    """

    description: str
    make: Callable[[Request], Files]
    options: tuple[str, ...]
    unnamed: str = "observer"


class Export(NamedTuple):
    """The files that an export wrote.

    Attributes:
        folder: where it is.
        files: names of the files in it.
        summary: what `export.json` says.
        lines: the summary for the terminal.
    """

    folder: Path
    files: tuple[str, ...]
    summary: JsonObject
    lines: list[str]


def _export_c(request: Request) -> Files:
    program, name = _lower_observers(request), request.name
    code = write_c_code(program, _write_head_of_code(request, program, _write_c_call(program)))
    texts = {f"{name}.c": code.source, f"{name}.h": code.header, f"{name}_filter.c": write_filter_code(program)}
    # of a struct, where numbers are aligned to their own size
    state = np.dtype([(quantity.name, quantity.dtype) for quantity in program.state], align=True)
    summary = _summarise(request, program) | {"state_bytes": state.itemsize}
    lines = [
        f"{name}.c, {name}.h: {_describe_cost(request, program)}, and a state of {summary['state_bytes']} bytes.",
        f"{name}_filter.c: an example that reads {','.join(input_columns(program))} as CSV:",
        f"  cc -std=c99 -O2 {name}.c {name}_filter.c -lm -o {name}_filter",
    ]
    return Files(texts, summary, lines)


def _export_st(request: Request) -> Files:
    program, name = _lower_observers(request), request.name
    call_lines = [
        "How to call: an instance of the function block once a sample, the first one included. restart begins anew.",
        "Divisions by zero give zero. Where a controller computes as IEEE 754 asks, the numbers are those of --target c.",
    ]
    lines = [f"{name}.st: function block {name}, {_describe_cost(request, program)}."]
    code = write_st_code(program, _write_head_of_code(request, program, call_lines))
    return Files({f"{name}.st": code}, _summarise(request, program), lines)


def _export_mjcf(request: Request) -> Files:
    text, step, notes = write_mjcf(request.config, linear=request.linear)
    lists = group_by_fidelity(notes)
    lines = [f"model.xml: MuJoCo {MUJOCO} or later, steps of {step:.3g} s."]
    lines += [
        f"{answer}: {path}: {reason}" for answer in ("approximated", "not said") for path, reason in lists[answer].items()
    ]
    return Files({"model.xml": text}, {"mujoco": MUJOCO, "time_step": step} | lists, lines)


def _export_fmu(request: Request) -> Files:
    name, fmi = request.name, FMI[request.fmi]
    plant = build_plant_program(request.config, name, np.dtype(PRECISIONS[request.precision]))
    call = ["Called by the functions of FMI. Functions touch nothing but their arguments."]
    archive = build_fmu(
        request.config, plant, _write_head(request, f"{name}: the drive, from sample to sample.", call), request.fmi
    )
    period, count = (
        request.config.run.sample_period,
        sum(variable.causality == "parameter" for variable in archive.variables),
    )
    headline = f"{name}.fmu: FMI {fmi}, co-simulation, steps of {period:g} s, {count} parameters"
    platforms, reasons = " and ".join(archive.binaries), "; ".join(archive.missing)
    if archive.binaries:
        lines = [f"{headline}; {'binaries' if archive.binaries[1:] else 'a binary'} for {platforms}, and the sources."]
        lines += [f"One more binary is missing: {reasons}."] if reasons else []
    else:
        lines = [f"{headline}; the sources alone: {reasons}."]
    summary = {
        "precision": request.precision,
        "sample_period": period,
        "fmi": fmi,
        "token": archive.token,
        "binaries": archive.binaries,
        "variables": [dict(variable._asdict()) for variable in archive.variables],
    }
    return Files({f"{name}.fmu": archive.content}, summary, lines)


_OF_CODE = "precision", "name"
TARGETS: dict[str, Target] = {
    "c": Target(
        "C99: observers, equivalent control, identifier and controller, a source file and a header", _export_c, _OF_CODE
    ),
    "st": Target("structured text (IEC 61131-3): the same as a function block", _export_st, _OF_CODE),
    "mjcf": Target("a MuJoCo model of the drive, its gap and its effects", _export_mjcf, ("linear",)),
    "fmu": Target("the drive as a Functional Mock-up Unit for co-simulation", _export_fmu, (*_OF_CODE, "fmi"), "drive"),
}
"""Targets by the values of --target."""


def export(
    config: ConfigSource,
    folder: str | Path,
    target: str = "c",
    *,
    precision: str | None = None,
    name: str | None = None,
    linear: Sequence[str] = (),
    fmi: int | None = None,
) -> Export:
    """Write a study for another system: as code what `jaxbl.chain.step` does with a recorded input and measured
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
    options = {"precision": precision, "name": name, "linear": linear, "fmi": fmi}
    for option, value in options.items():
        if value not in (None, (), []) and option not in TARGETS[target].options:
            raise InputError(f"--{option}: --target {target} has no such option; leave it out")
    precision_name = (
        {long: short for short, long in PRECISIONS.items()}[study.run.precision] if precision is None else precision
    )
    if precision_name not in PRECISIONS:
        raise InputError(f"--precision {precision_name}: should be one of {', '.join(PRECISIONS)}")
    if fmi is not None and fmi not in FMI:
        raise InputError(f"--fmi {fmi}: should be one of {', '.join(map(str, FMI))}")
    code_name = _make_code_name(file, TARGETS[target].unnamed) if name is None else check_name(name)
    request = Request(study, code_name, precision_name, tuple(linear), fmi or max(FMI), file)
    try:
        files = TARGETS[target].make(request)
    except Unsupported as error:
        raise InputError(f"--target {target}: {file or 'the study'} has what it cannot say: {error}") from None
    head = {
        "target": target,
        "name": request.name,
        "title": study.title,
        "study": file,
        "identity": identity(study, "simulate"),
        "jaxbl": version("jaxbl"),
        "files": list(files.contents),
    }
    summary = head | dict(files.summary)
    out, exported = Path(folder), f"{request.name} for --target {target}"
    with open_results(out, Subject("export", exported, exported)) as results, results.write_files(SUMMARY) as draft:
        for file_name, content in files.contents.items():
            write_atomic(draft / file_name, content)
        write_json(draft / SUMMARY, summary)
    return Export(out, (*files.contents, SUMMARY), summary, files.lines)


_RESERVED = (
    "auto break case char const continue default do double else enum extern float for goto if inline int long register "
    "restrict return short signed sizeof static struct switch typedef union unsigned void volatile while bool true false "
    "main and or not xor mod then elsif end_if to by repeat until exit function program var type array of at real lreal "
    "dint udint lint ulint "
    "assert complex ctype errno fenv inttypes limits locale math setjmp signal stdarg stdbool stddef stdint stdio stdlib "
    "string tgmath time wchar wctype"
)
"""Keywords of the languages, and headers of C: a build may look for those where the code's own header is."""


def check_name(name: str) -> str:
    """Return the name if every target can use it. Raises `InputError` otherwise."""
    if not re.fullmatch(r"[a-z](_?[a-z0-9])*", name) or len(name) > _LONGEST_NAME or name in _RESERVED.split():
        raise InputError(
            f"--name {name}: should be small letters, digits and single underscores, begin with a letter, have at most "
            f"{_LONGEST_NAME} letters, and be no keyword and no header of C"
        )
    return name


def _make_code_name(file: str, unnamed: str) -> str:
    """Make a name in code from that of a file; `unnamed` where there is no file."""
    plain = re.sub(r"[^a-z0-9]+", "_", Path(file).stem.lower()).strip("_")
    plain = plain if plain[:1].isalpha() else f"study_{plain}"
    plain = plain[:_LONGEST_NAME].strip("_") if file else unnamed
    return f"{plain}_code" if plain in _RESERVED.split() else plain


def _lower_observers(request: Request) -> Program:
    block = build_observer_chain(request.config, request.name, np.dtype(PRECISIONS[request.precision]))
    return lower_block(widen_positions(block))


def _describe_cost(request: Request, program: Program) -> str:
    return f"{count_operations(program.step).total()} operations a step in {request.precision}"


def _write_head_of_code(request: Request, program: Program, call: list[str]) -> list[str]:
    """Write the lines at the beginning of a file of observers."""
    sides = [quantity.name.removesuffix("_position") for quantity in program.block.start_inputs]
    parts = f"{'observers' if len(sides) > 1 else 'observer'} of {' and '.join(sides)}, equivalent control"
    identifier = ", identifier" if any(quantity.name.endswith("_identified") for quantity in program.block.outputs) else ""
    controller = "" if request.config.controller is None else ", controller"
    return _write_head(request, f"{request.name}: {parts}{identifier}{controller}, from sample to sample.", call)


def _write_head(request: Request, first_line: str, call: list[str]) -> list[str]:
    config = request.config
    title = f" ({config.title})" if config.title else ""
    return [
        first_line,
        "",
        f"Made by jaxbl {version('jaxbl')} from {request.file or 'a study'}{title},",
        f"whose numbers have the hash {identity(config, 'simulate')}. To change one, change the study and export it again.",
        f"Numbers: {request.precision}. Sampling period: {config.run.sample_period:g} s. SI units: s, rad, N m.",
        "",
        *call,
    ]


def _write_c_call(program: Program) -> list[str]:
    block, name = program.block, program.block.name
    first, inputs = (
        ", ".join(quantity.name for quantity in quantities) for quantities in (block.start_inputs, block.inputs)
    )
    period = block.study_numbers["run.sample_period"].value
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


def _summarise(request: Request, program: Program) -> JsonObject:
    block = program.block
    counts = count_operations(program.step)
    return {
        "precision": request.precision,
        "sample_period": block.study_numbers["run.sample_period"].value,
        "first": [*map(_describe_port, block.start_inputs)],
        "inputs": [*map(_describe_port, block.inputs)],
        "outputs": [*map(_describe_port, block.outputs)],
        "state": [{"name": quantity.name, "type": str(quantity.dtype)} for quantity in program.state],
        "operations_per_step": dict(sorted(counts.items())),
        "operations": counts.total(),
    }


def _describe_port(port: Port) -> dict[str, str]:
    return {"name": port.name, "unit": port.unit, "about": port.description, "type": str(port.dtype)}
