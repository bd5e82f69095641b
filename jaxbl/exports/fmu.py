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
from typing import NamedTuple

from jaxbl.config import Config
from jaxbl.sweeps.store import identity

from .block import Quantity
from .c import c_code, c_type
from .plant import PlantProgram
from .writer import plain_text

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
_OF_WINDOWS = "-s", "-static-libgcc", "-Wl,--no-insert-timestamp"
_WINDOWS = Platform("win64", "x86_64-windows", "dll", "x86_64-w64-mingw32-gcc", _OF_WINDOWS)
_HERE = {
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
        why: there is none for this machine, or for Windows, in a line each.
    """

    content: bytes
    variables: list[Scalar]
    token: str
    binaries: list[str]
    why: list[str]


def fmu(config: Config, plant: PlantProgram, about: Sequence[str], fmi: int) -> Archive:
    """The archive of a drive.

    Args:
        config: the study.
        plant: its drive as a program.
        about: lines for the beginning of the code.
        fmi: 2 or 3.
    """
    block = plant.program.block
    name = block.name
    variables = _variables(plant)
    code, here = c_code(plant.program, about), Path(__file__).parent / "fmi"
    # a name has no hyphen: these files have their own
    own = {file: (here / file).read_text(encoding="utf-8") for file in ("fmi-instance.h", f"fmi-{fmi}.c")}
    sources = {f"{name}.c": code.source, f"{name}.h": code.header} | own
    # the same study need not have the same code: that of another version, or with an effect that was changed
    content = hashlib.sha256(repr((sources, variables)).encode()).hexdigest()[:16]
    token = f"{identity(config, 'simulate')}-{content}"
    sources["fmi-model.h"] = _model(plant, variables, token, config.run.sample_period)
    compiled = [one for one in sources if one.endswith(".c")]
    files: dict[str, str | bytes] = {"modelDescription.xml": _description(config, plant, variables, token, fmi, compiled)}
    if fmi == 3:
        files["sources/buildDescription.xml"] = _build_description(name, compiled)
    files |= {f"sources/{file}": text for file, text in sources.items()}
    binaries, why = _binaries(name, fmi, sources)
    files |= {f"binaries/{place}/{file}": content for place, (file, content) in binaries.items()}
    return Archive(_archive(files), variables, token, [*binaries], why)


def _archive(files: Mapping[str, str | bytes]) -> bytes:
    """A zip file, the same bytes for the same content."""
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            about = zipfile.ZipInfo(name)
            about.compress_type = zipfile.ZIP_DEFLATED
            about.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
            archive.writestr(about, content)
    return made.getvalue()


# binaries


def _binaries(name: str, fmi: int, sources: Mapping[str, str]) -> tuple[dict[str, tuple[str, bytes]], list[str]]:
    """By platform, name and content of its binary; and why there are not more.

    One is for this machine, and one for Windows if a compiler for it is here.
    """
    system = platform.system(), platform.machine()
    found, why = {}, []
    across = [_WINDOWS] if shutil.which(_WINDOWS.compiler) else []
    for one in dict.fromkeys([_HERE.get(system), *across]):
        place = one and (one.of_2 if fmi == 2 else one.of_3)
        if one is None or place is None:
            why.append(f"for {' on '.join(system)} none is compiled in FMI {FMI[fmi]}")
            continue
        content, fault = _binary(name, one, sources)
        if fault:
            why.append(fault)
        else:
            found[place] = f"{name}.{one.ending}", content
    return found, why


def _binary(name: str, of: Platform, sources: Mapping[str, str]) -> tuple[bytes, str]:
    """The sources compiled for a platform, or why they are not."""
    compiler = shutil.which(of.compiler)
    if compiler is None:
        return b"", f"no C compiler ({of.compiler}) was found"
    with TemporaryDirectory() as folder:
        for file, text in sources.items():
            (Path(folder) / file).write_text(text, encoding="utf-8")
        names = [file for file in sources if file.endswith(".c")]
        made = f"{name}.{of.ending}"
        try:
            done = subprocess.run(
                [compiler, *_FLAGS, *of.flags, *names, "-o", made, "-lm"],
                cwd=folder,
                capture_output=True,
                text=True,
                check=False,
                timeout=_LONGEST_COMPILATION,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            return b"", f"{compiler} did not run ({error})"
        if done.returncode:
            said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
            return b"", f"{compiler} failed: {said[0]}"
        return (Path(folder) / made).read_bytes(), ""


# variables


def _variables(plant: PlantProgram) -> list[Scalar]:
    """All variables in the order of their value references: time, input, outputs, parameters."""
    block = plant.program.block
    torque = block.inputs[0]
    found = [
        Scalar("time", "independent", "continuous", "s", "time of the simulation"),
        Scalar(torque.name, "input", "continuous", torque.unit, torque.about, 0.0),
    ]
    found += [Scalar(plant.outputs[one.name], "output", "continuous", one.unit, one.about) for one in block.outputs]
    for path, (value, known) in plant.about.items():
        kind = "tunable" if path in plant.tunable else "fixed"
        least = known.minimum if known.above is None else known.above
        found.append(
            Scalar(_structured(path), "parameter", kind, known.unit, known.doc, value, least, known.above, known.maximum)
        )
    return found


def _structured(path: str) -> str:
    """A config path by the naming convention "structured": of two effects of one kind, places in square brackets."""
    return re.sub(r"\.(\d+)(?=\.)", r"[\1]", path)


_BASES: dict[str, dict[str, int]] = {
    **{one: {one: 1} for one in ("kg", "m", "s", "A", "K", "mol", "cd", "rad")},
    "N": {"kg": 1, "m": 1, "s": -2},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "ohm": {"kg": 1, "m": 2, "s": -3, "A": -2},
    "Hz": {"s": -1},
}
"""Exponents of base units."""
_POWERS = {"²": "2", "³": "3", "^": "", " ": "."}


def unit_name(unit: str) -> str:
    """A unit as FMI's tools write it: `N.m.s2/rad2`."""
    for letter, other in _POWERS.items():
        unit = unit.replace(letter, other)
    return unit


def base_unit(unit: str) -> dict[str, int] | None:
    """Exponents of base units of a unit of :func:`unit_name`; None where a symbol in it is unknown."""
    found: dict[str, int] = {}
    above, *below = unit.split("/")
    for sign, part in ((1, above), *((-1, one) for one in below)):
        for factor in part.split("."):
            match = re.fullmatch(r"([A-Za-z]+)(\d*)", factor)
            if factor == "1":
                continue
            if match is None or match[1] not in _BASES:
                return None
            for base, power in _BASES[match[1]].items():
                found[base] = found.get(base, 0) + sign * power * int(match[2] or 1)
    return {base: power for base, power in found.items() if power}


# texts


def _description(
    config: Config, plant: PlantProgram, variables: Sequence[Scalar], token: str, fmi: int, sources: Sequence[str]
) -> str:
    """modelDescription.xml."""
    name, run = plant.program.block.name, config.run
    period = _n(run.sample_period)
    about = {
        "fmiVersion": FMI[fmi],
        "modelName": name,
        "guid" if fmi == 2 else "instantiationToken": token,
        **({"description": config.title} if config.title else {}),
        "generationTool": f"jaxbl {version('jaxbl')}",
        "variableNamingConvention": "structured",
    }
    root = ET.Element("fmiModelDescription", about)
    # FMI cannot say that steps have to be multiples of a period: of what it can, that they are all alike is nearest
    kind = {"modelIdentifier": name, "canHandleVariableCommunicationStepSize": "false"}
    if fmi == 3:
        kind |= {"canGetAndSetFMUState": "true", "canSerializeFMUState": "true", "fixedInternalStepSize": period}
    else:
        kind |= {"canGetAndSetFMUstate": "true", "canSerializeFMUstate": "true"}
        kind |= {"canNotUseMemoryManagementFunctions": "true"}
    simulation = ET.SubElement(root, "CoSimulation", kind)
    if fmi == 2:
        files = ET.SubElement(simulation, "SourceFiles")
        for one in sources:
            ET.SubElement(files, "File", name=one)
    units = ET.SubElement(root, "UnitDefinitions")
    for unit in dict.fromkeys(unit_name(one.unit) for one in variables if one.unit):
        element = ET.SubElement(units, "Unit", name=unit)
        if (base := base_unit(unit)) is not None:
            ET.SubElement(element, "BaseUnit", {key: str(power) for key, power in base.items()})
    categories = ET.SubElement(root, "LogCategories")
    ET.SubElement(categories, "Category", name="logStatusError", description="what was refused, and why")
    ET.SubElement(root, "DefaultExperiment", startTime="0", stopTime=_n(run.duration), stepSize=period)
    places = ET.SubElement(root, "ModelVariables")
    structure = ET.SubElement(root, "ModelStructure")
    # FMI 2 does not need the time, and the FMI Library misses a start value of it
    declared = [(i, one) for i, one in enumerate(variables) if fmi == 3 or one.causality != "independent"]
    for i, one in declared:
        _variable(places, i, one, fmi)
    outputs = [i for i, one in enumerate(variables) if one.causality == "output"]
    if fmi == 3:
        for i in outputs:
            ET.SubElement(structure, "Output", valueReference=str(i), dependencies="")
        for i in outputs:
            ET.SubElement(structure, "InitialUnknown", valueReference=str(i))
    else:
        for group, more in (("Outputs", {"dependencies": ""}), ("InitialUnknowns", {})):
            parent = ET.SubElement(structure, group)
            for place, (i, _) in enumerate(declared, 1):
                if i in outputs:
                    ET.SubElement(parent, "Unknown", {"index": str(place)} | more)
    return _xml(root)


def _variable(parent: ET.Element, reference: int, one: Scalar, fmi: int) -> None:
    about = {"name": one.name, "valueReference": str(reference), "causality": one.causality, "variability": one.variability}
    if one.causality != "independent":
        about |= (
            {"initial": "calculated"} if one.start is None else {"initial": "exact"} if one.causality == "parameter" else {}
        )
    number = {"unit": unit_name(one.unit)} if one.unit else {}
    number |= {
        key: _n(value) for key, value in (("min", one.least), ("max", one.most), ("start", one.start)) if value is not None
    }
    text = {"description": one.about} if one.about else {}
    if fmi == 3:
        ET.SubElement(parent, "Float64", about | text | number)
    else:
        ET.SubElement(ET.SubElement(parent, "ScalarVariable", about | text), "Real", number)


def _build_description(name: str, sources: Sequence[str]) -> str:
    root = ET.Element("fmiBuildDescription", fmiVersion=FMI[3])
    build = ET.SubElement(root, "BuildConfiguration", modelIdentifier=name)
    files = ET.SubElement(build, "SourceFileSet", language="C99")
    for one in sources:
        ET.SubElement(files, "SourceFile", name=one)
    return _xml(root)


def _xml(root: ET.Element) -> str:
    ET.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(root, encoding="unicode")}\n'


def _n(value: float) -> str:
    """A number with all its digits."""
    return repr(float(value) + 0.0)


def _model(plant: PlantProgram, variables: Sequence[Scalar], token: str, period: float) -> str:
    """`fmi-model.h`: variables by value reference, and calls of the code with them."""
    block = plant.program.block
    name, real = block.name, c_type(block.dtype)
    double = "" if real == "double" else "(double)"
    single = "" if real == "double" else "(float)"
    place = {one.name: i for i, one in enumerate(variables)}
    change = {"input": "ALWAYS", "fixed": "FIXED", "tunable": "ALWAYS"}
    rows = []
    for one in variables:
        when = change.get(one.causality, change.get(one.variability, "NEVER"))
        low, high = (_limit(value, sign) for value, sign in ((one.least, "-"), (one.most, "")))
        rows.append(f'    {{"{one.name}", {when}, {_n(one.start or 0.0)}, {low}, {high}, {int(one.above is not None)}}},')

    def given(quantities: Sequence[Quantity]) -> list[str]:
        places = (place[_structured(plant.parameters.get(one.name, one.name))] for one in quantities)
        return [f"{single}model->values[{i}]" for i in places]

    outputs = [f"    model->values[{place[plant.outputs[one.name]]}] = {double}outputs.{one.name};" for one in block.outputs]
    lines = [
        "/*",
        f" * Variables of {name} by value reference, and the calls of its code with them.",
        " */",
        "",
        "#ifndef FMI_MODEL_HEADER",
        "#define FMI_MODEL_HEADER",
        "",
        "#include <math.h>",
        "",
        f'#include "{name}.h"',
        "",
        f'#define MODEL_TOKEN "{token}"',
        f"#define MODEL_PERIOD {_n(period)}",
        "#define MODEL_TIME 0u",
        f"#define MODEL_VARIABLES {len(variables)}u",
        "",
        "/* An end of a range that has none. */",
        "#define ANY ((double)INFINITY)",
        "",
        "/* When a variable may be set. */",
        "enum",
        "{",
        "    NEVER,",
        "    FIXED,",
        "    ALWAYS",
        "};",
        "",
        "typedef struct",
        "{",
        f"    char name[{max(len(one.name) for one in variables) + 1}];",
        "    int change;",
        "    double start;",
        "    double least;",
        "    double most;",
        "    int open; /* the least value itself is out of range */",
        "} Variable;",
        "",
        "static const Variable variables[MODEL_VARIABLES] = {",
        *rows,
        "};",
        "",
        "typedef struct",
        "{",
        f"    {name}_state state;",
        "    double values[MODEL_VARIABLES];",
        "} Model;",
        "",
        f"static void model_found(Model *model, const {name}_outputs outputs)",
        "{",
        *outputs,
        "}",
        "",
        "static void model_begin(Model *model)",
        "{",
        f"    {name}_outputs outputs;",
        f"    {name}_init({_wrapped(['&model->state', *given(block.first), '&outputs'])});",
        "    model_found(model, outputs);",
        "}",
        "",
        "static void model_sample(Model *model)",
        "{",
        f"    {name}_outputs outputs;",
        f"    {name}_step({_wrapped(['&model->state', *given(block.inputs), '&outputs'])});",
        "    model_found(model, outputs);",
        "}",
        "",
        "#endif /* FMI_MODEL_HEADER */",
    ]
    return plain_text("\n".join(lines) + "\n")


def _wrapped(arguments: Sequence[str]) -> str:
    """Arguments of a call, four a line."""
    rows = (", ".join(arguments[i : i + 4]) for i in range(0, len(arguments), 4))
    return ",\n        ".join(rows)


def _limit(value: float | None, sign: str) -> str:
    """An end of a range."""
    return f"{sign}ANY" if value is None else _n(value)
