"""The drive as a Functional Mock-up Unit for co-simulation, FMI 3.0 or 2.0: the code of :mod:`.plant` in an archive.

Reference: Modelica Association, Functional Mock-up Interface Specification, versions 2.0.5 and 3.0.2.
"""

import hashlib
import io
import platform
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from jaxbl.config import Config
from jaxbl.errors import NoResult, escape_unprintable
from jaxbl.sweeps.store import identity

from .block import Port
from .c import c_type, write_c_code
from .plant import PlantProgram
from .writer import add_element

FMI = {2: "2.0", 3: "3.0"}
"""Versions by their numbers in options."""
_FLAGS = "-std=c99", "-O2", "-ffp-contract=off", "-shared"


class Platform(NamedTuple):
    """Its names in FMI 2 (None: it has none) and 3, the ending of its binaries, compiler, and flags."""

    of_2: str | None
    of_3: str
    ending: str
    compiler: str = "cc"
    flags: tuple[str, ...] = ("-fPIC", "-fvisibility=hidden")


# the same bytes for the same sources; nothing but Windows needed where it runs
_WINDOWS_FLAGS = "-s", "-static-libgcc", "-Wl,--no-insert-timestamp"
_WINDOWS = Platform("win64", "x86_64-windows", "dll", "x86_64-w64-mingw32-gcc", _WINDOWS_FLAGS)
_HOST_PLATFORMS = {
    ("Linux", "x86_64"): Platform("linux64", "x86_64-linux", "so"),
    ("Linux", "aarch64"): Platform(None, "aarch64-linux", "so"),
    ("Darwin", "x86_64"): Platform("darwin64", "x86_64-darwin", "dylib"),
    ("Darwin", "arm64"): Platform("darwin64", "aarch64-darwin", "dylib"),
    ("Windows", "AMD64"): _WINDOWS,
}
"""This machine's platform by its system and processor."""
_LONGEST_COMPILATION = 300.0
"""s."""


class Scalar(NamedTuple):
    """A variable of the model: name, causality, variability, unit, description, start value (None: computed) and range, of
    which `above` is the lower end where that is excluded."""

    name: str
    causality: str
    variability: str
    unit: str
    about: str
    start: float | None = None
    least: float | None = None
    above: float | None = None
    most: float | None = None


class Archive(NamedTuple):
    """An FMU.

    Attributes:
        content: of the file.
        variables: in the order of their value references.
        token: instantiation token (FMI 2: guid).
        binaries: platforms of those in it.
        missing: why there is no binary for this machine, or for Windows: a line each.
    """

    content: bytes
    variables: list[Scalar]
    token: str
    binaries: list[str]
    missing: list[str]


def build_fmu(config: Config, plant: PlantProgram, head_lines: Sequence[str], fmi: int) -> Archive:
    """Build the archive of a drive.

    Args:
        config: the study.
        plant: its drive as a program.
        head_lines: lines for the beginning of the code.
        fmi: 2 or 3.
    """
    block = plant.program.block
    name = block.name
    variables = _list_variables(plant)
    code, fmi_folder = write_c_code(plant.program, head_lines), Path(__file__).parent / "fmi"
    # a name has no hyphen: these files have their own
    fmi_files = {file: (fmi_folder / file).read_text(encoding="utf-8") for file in ("fmi-instance.h", f"fmi-{fmi}.c")}
    sources = {f"{name}.c": code.source, f"{name}.h": code.header} | fmi_files
    # the same study need not have the same code: that of another version, or with an effect that was changed
    content = hashlib.sha256(repr((sources, variables)).encode()).hexdigest()[:16]
    token = f"{identity(config, 'simulate')}-{content}"
    sources["fmi-model.h"] = _write_model_header(plant, variables, token, config.run.sample_period)
    c_files = [file_name for file_name in sources if file_name.endswith(".c")]
    files: dict[str, str | bytes] = {
        "modelDescription.xml": _write_description(config, plant, variables, token, fmi, c_files)
    }
    if fmi == 3:
        files["sources/buildDescription.xml"] = _write_build_description(name, c_files)
    files |= {f"sources/{file}": text for file, text in sources.items()}
    binaries, missing_binaries = _compile_binaries(name, fmi, sources)
    files |= {f"binaries/{place}/{file}": content for place, (file, content) in binaries.items()}
    return Archive(_pack_archive(files), variables, token, [*binaries], missing_binaries)


def _pack_archive(files: Mapping[str, str | bytes]) -> bytes:
    """Pack files into a zip archive: the same bytes for the same content."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
            archive.writestr(entry, content)
    return stream.getvalue()


# binaries


def _compile_binaries(name: str, fmi: int, sources: Mapping[str, str]) -> tuple[dict[str, tuple[str, bytes]], list[str]]:
    """Compile a binary for this machine, and one for Windows where a compiler for it is here.

    Returns:
        File name and content of each binary by its folder in the archive, and the reasons for binaries that are missing.
    """
    system = platform.system(), platform.machine()
    binaries, missing = {}, []
    other_targets = [_WINDOWS] if shutil.which(_WINDOWS.compiler) else []
    for target in dict.fromkeys([_HOST_PLATFORMS.get(system), *other_targets]):
        folder = target and (target.of_2 if fmi == 2 else target.of_3)
        if target is None or folder is None:
            missing.append(f"for {' on '.join(system)} none is compiled in FMI {FMI[fmi]}")
            continue
        try:
            binaries[folder] = f"{name}.{target.ending}", _compile_binary(name, target, sources)
        except NoResult as error:
            missing.append(str(error))
    return binaries, missing


def _compile_binary(name: str, target: Platform, sources: Mapping[str, str]) -> bytes:
    """Compile the sources for a platform. Raises `NoResult` with the reason why there is no binary."""
    compiler = shutil.which(target.compiler)
    if compiler is None:
        raise NoResult(f"no C compiler ({target.compiler}) was found")
    with TemporaryDirectory() as folder:
        for file, text in sources.items():
            (Path(folder) / file).write_text(text, encoding="utf-8")
        names = [file for file in sources if file.endswith(".c")]
        library = f"{name}.{target.ending}"
        try:
            process = subprocess.run(
                [compiler, *_FLAGS, *target.flags, *names, "-o", library, "-lm"],
                cwd=folder,
                capture_output=True,
                text=True,
                check=False,
                timeout=_LONGEST_COMPILATION,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise NoResult(f"{compiler} did not run ({error})") from None
        if process.returncode:
            errors = process.stderr.strip().splitlines() or [f"exit code {process.returncode}"]
            raise NoResult(f"{compiler} failed: {errors[0]}")
        return (Path(folder) / library).read_bytes()


# variables


def _list_variables(plant: PlantProgram) -> list[Scalar]:
    """List all variables in the order of their value references: time, input, outputs, parameters."""
    block = plant.program.block
    torque = block.inputs[0]
    variables = [
        Scalar("time", "independent", "continuous", "s", "time of the simulation"),
        Scalar(torque.name, "input", "continuous", torque.unit, torque.description, 0.0),
    ]
    variables += [
        Scalar(plant.outputs[quantity.name], "output", "continuous", quantity.unit, quantity.description)
        for quantity in block.outputs
    ]
    for path, value, parameter, tunable in plant.parameters.values():
        minimum = parameter.minimum if parameter.above is None else parameter.above
        variables.append(
            Scalar(
                # by FMI's "structured" naming convention
                re.sub(r"\.(\d+)(?=\.)", r"[\1]", path),
                "parameter",
                "tunable" if tunable else "fixed",
                parameter.unit,
                parameter.doc,
                value,
                minimum,
                parameter.above,
                parameter.maximum,
            )
        )
    return variables


_BASES: dict[str, dict[str, int]] = {
    **{base: {base: 1} for base in ("kg", "m", "s", "A", "K", "mol", "cd", "rad")},
    "N": {"kg": 1, "m": 1, "s": -2},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "ohm": {"kg": 1, "m": 2, "s": -3, "A": -2},
    "Hz": {"s": -1},
}
"""Exponents of base units."""
_POWERS = str.maketrans({"²": "2", "³": "3", "^": "", " ": "."})


def write_unit(unit: str) -> str:
    """Write a unit as FMI tools do: `N.m.s2/rad2`."""
    return unit.translate(_POWERS)


def find_base_units(unit: str) -> dict[str, int] | None:
    """Exponents of base units of a unit of :func:`write_unit`; None where a symbol in it is unknown."""
    exponents = dict[str, int]()
    numerator, *divisors = unit.split("/")
    for sign, part in ((1, numerator), *((-1, divisor) for divisor in divisors)):
        for factor in part.split("."):
            match = re.fullmatch(r"([A-Za-z]+)(\d*)", factor)
            if factor == "1":
                continue
            if match is None or match[1] not in _BASES:
                return None
            for base, power in _BASES[match[1]].items():
                exponents[base] = exponents.get(base, 0) + sign * power * int(match[2] or 1)
    return {base: power for base, power in exponents.items() if power}


# texts


def _write_description(
    config: Config, plant: PlantProgram, variables: Sequence[Scalar], token: str, fmi: int, sources: Sequence[str]
) -> str:
    """Write modelDescription.xml."""
    name, run = plant.program.block.name, config.run
    period = _write_number(run.sample_period)
    attributes = {
        "fmiVersion": FMI[fmi],
        "modelName": name,
        "guid" if fmi == 2 else "instantiationToken": token,
        **({"description": escape_unprintable(config.title)} if config.title else {}),
        "generationTool": f"jaxbl {version('jaxbl')}",
        "variableNamingConvention": "structured",
    }
    root = ET.Element("fmiModelDescription", attributes)
    # FMI cannot say that steps have to be multiples of a period: of what it can, that they are all alike is nearest
    capabilities = {"modelIdentifier": name, "canHandleVariableCommunicationStepSize": "false"}
    if fmi == 3:
        capabilities |= {"canGetAndSetFMUState": "true", "canSerializeFMUState": "true", "fixedInternalStepSize": period}
    else:
        capabilities |= {"canGetAndSetFMUstate": "true", "canSerializeFMUstate": "true"}
        capabilities |= {"canNotUseMemoryManagementFunctions": "true"}
    simulation = add_element(root, "CoSimulation", **capabilities)
    if fmi == 2:
        files = add_element(simulation, "SourceFiles")
        for variable in sources:
            add_element(files, "File", name=variable)
    units = add_element(root, "UnitDefinitions")
    for unit in dict.fromkeys(write_unit(variable.unit) for variable in variables if variable.unit):
        element = add_element(units, "Unit", name=unit)
        if (base := find_base_units(unit)) is not None:
            add_element(element, "BaseUnit", **base)
    categories = add_element(root, "LogCategories")
    add_element(categories, "Category", name="logStatusError", description="what was refused, and why")
    add_element(root, "DefaultExperiment", startTime="0", stopTime=_write_number(run.duration), stepSize=period)
    model_variables = add_element(root, "ModelVariables")
    structure = add_element(root, "ModelStructure")
    # FMI 2 does not need the time, and the FMI Library misses a start value of it
    declared = [(i, variable) for i, variable in enumerate(variables) if fmi == 3 or variable.causality != "independent"]
    for i, variable in declared:
        _write_variable(model_variables, i, variable, fmi)
    for tag, more in (("Output", {"dependencies": ""}), ("InitialUnknown", {})):
        parent = structure if fmi == 3 else add_element(structure, f"{tag}s")
        for place, (i, variable) in enumerate(declared, 1):
            if variable.causality == "output":
                element_name, key, number = (tag, "valueReference", i) if fmi == 3 else ("Unknown", "index", place)
                add_element(parent, element_name, **{key: number}, **more)
    return _write_xml(root)


def _write_variable(parent: ET.Element, reference: int, variable: Scalar, fmi: int) -> None:
    attributes: dict[str, Any] = {
        "name": variable.name,
        "valueReference": reference,
        "causality": variable.causality,
        "variability": variable.variability,
    }
    if variable.causality == "parameter":
        attributes["initial"] = "exact"
    elif variable.causality != "independent" and variable.start is None:
        attributes["initial"] = "calculated"
    if variable.about:
        attributes["description"] = variable.about
    number = {"unit": write_unit(variable.unit)} if variable.unit else {}
    limits = {"min": variable.least, "max": variable.most, "start": variable.start}
    number |= {key: _write_number(value) for key, value in limits.items() if value is not None}
    if fmi == 3:
        add_element(parent, "Float64", **attributes, **number)
    else:
        add_element(add_element(parent, "ScalarVariable", **attributes), "Real", **number)


def _write_build_description(name: str, sources: Sequence[str]) -> str:
    root = ET.Element("fmiBuildDescription", fmiVersion=FMI[3])
    build = add_element(root, "BuildConfiguration", modelIdentifier=name)
    files = add_element(build, "SourceFileSet", language="C99")
    for source in sources:
        add_element(files, "SourceFile", name=source)
    return _write_xml(root)


def _write_xml(root: ET.Element) -> str:
    ET.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(root, encoding="unicode")}\n'


def _write_number(value: float) -> str:
    """Write a number with all its digits."""
    return repr(float(value) + 0.0)


def _write_model_header(plant: PlantProgram, variables: Sequence[Scalar], token: str, period: float) -> str:
    """Write `fmi-model.h`: variables by value reference, and calls of the code with them."""
    block = plant.program.block
    name, real = block.name, c_type(block.dtype)
    double = "" if real == "double" else "(double)"
    single = "" if real == "double" else "(float)"
    # the names in code, in the order of `variables`
    names = "time", block.inputs[0].name, *(port.name for port in block.outputs), *plant.parameters
    reference = {name: i for i, name in enumerate(names)}
    change_rules = {"input": "ALWAYS", "fixed": "FIXED", "tunable": "ALWAYS"}
    rows = []
    for variable in variables:
        change_rule = change_rules.get(variable.causality, change_rules.get(variable.variability, "NEVER"))
        low, high = (
            f"{sign}ANY" if value is None else _write_number(value)
            for value, sign in ((variable.least, "-"), (variable.most, ""))
        )
        start, is_open = _write_number(variable.start or 0.0), int(variable.above is not None)
        rows.append(f'    {{"{variable.name}", {change_rule}, {start}, {low}, {high}, {is_open}}},')

    def write_arguments(quantities: Sequence[Port]) -> str:
        values = (f"{single}model->values[{reference[quantity.name]}]" for quantity in quantities)
        arguments = ["&model->state", *values, "&outputs"]
        # four a line
        return ",\n        ".join(", ".join(arguments[i : i + 4]) for i in range(0, len(arguments), 4))

    start_arguments, step_arguments = map(write_arguments, (block.start_inputs, block.inputs))

    outputs = [
        f"    model->values[{reference[variable.name]}] = {double}outputs.{variable.name};" for variable in block.outputs
    ]
    longest_name = max(len(variable.name) for variable in variables)
    row_lines, output_lines = "\n".join(rows), "\n".join(outputs)
    return f"""/*
 * Variables of {name} by value reference, and the calls of its code with them.
 */

#ifndef FMI_MODEL_HEADER
#define FMI_MODEL_HEADER

#include <math.h>

#include "{name}.h"

#define MODEL_TOKEN "{token}"
#define MODEL_PERIOD {_write_number(period)}
#define MODEL_TIME 0u
#define MODEL_VARIABLES {len(variables)}u

/* An end of a range that has none. */
#define ANY ((double)INFINITY)

/* When a variable may be set. */
enum
{{
    NEVER,
    FIXED,
    ALWAYS
}};

typedef struct
{{
    char name[{longest_name + 1}];
    int change;
    double start;
    double least;
    double most;
    int open; /* the least value itself is out of range */
}} Variable;

static const Variable variables[MODEL_VARIABLES] = {{
{row_lines}
}};

typedef struct
{{
    {name}_state state;
    double values[MODEL_VARIABLES];
}} Model;

static void model_found(Model *model, const {name}_outputs outputs)
{{
{output_lines}
}}

static void model_begin(Model *model)
{{
    {name}_outputs outputs;
    {name}_init({start_arguments});
    model_found(model, outputs);
}}

static void model_sample(Model *model)
{{
    {name}_outputs outputs;
    {name}_step({step_arguments});
    model_found(model, outputs);
}}

#endif /* FMI_MODEL_HEADER */
"""
