"""The package as others see it: public names, direction of imports, docstrings, and the studies that come with it."""

import ast
import builtins
import dis
import functools
import graphlib
import importlib
import inspect
import re
from pathlib import Path

import pytest

import jaxbl
from jaxbl.config import read_config
from jaxbl.report.checks import check_figures
from jaxbl.sweeps.metrics import metric_columns
from jaxbl.sweeps.points import Points

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / "jaxbl").rglob("*.py"))


def module_name(file, root=ROOT):
    return ".".join(file.relative_to(root).with_suffix("").parts).removesuffix(".__init__")


MODULES = [module_name(file) for file in FILES]

# the floors of the house: a part imports from those below it, and nothing from beside it
FLOORS = [
    {"json_types"},
    {"errors", "registry", "units"},
    {"lines", "quantity"},
    {"result"},
    {"files", "validation", "workers"},
    {"cluster", "drive"},
    {"control", "observer", "records"},
    {"chain"},
    {"config", "fused"},
    {"sweeps", "estimation"},
    {"gradients"},
    {"functions"},
    {"gains", "diagnosis", "exports"},
    {"monitoring"},
    {"throughput"},
    {"report"},
    {"datasheet", "doctor"},
    {"batch", "terminal"},
    {"cli"},
]
LOWER_FLOORS = {part: set().union(*FLOORS[:i]) for i, floor in enumerate(FLOORS) for part in floor}


def test_public_names_resolve_and_are_documented():
    assert {"run", "sweep", "open_study", "read_config", "Config", "InputError"} <= set(dir(jaxbl))
    for name in dir(jaxbl):
        assert inspect.getdoc(getattr(jaxbl, name)), name
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = jaxbl.nothing
    # names for type checkers are those that load
    tree = ast.parse((ROOT / "jaxbl" / "__init__.py").read_text())
    declared = {
        alias.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.level for alias in node.names
    }
    assert declared == set(dir(jaxbl))


@functools.cache
def list_imports(file, root=ROOT):
    """Return dotted names that a file imports: at its head, inside functions, and for type checkers only."""
    package, names = file.relative_to(root).parent.parts, []
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else ()
            names += [".".join([*base, *filter(None, [node.module]), alias.name]) for alias in node.names]
    return names


def find_import_circle(root, *folders):
    """Modules of a circle of imports among the files of some folders, or an empty list."""
    files = {module_name(file, root): file for folder in folders for file in sorted((root / folder).rglob("*.py"))}
    graph = {}
    for module, file in files.items():
        # an imported name is a module, or something in one
        names = [name if name in files else name.rpartition(".")[0] for name in list_imports(file, root)]
        graph[module] = {name for name in names if name in files}
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return error.args[1]
    return []


def test_no_imports_run_in_a_circle():
    assert find_import_circle(ROOT, "jaxbl") == []
    assert find_import_circle(ROOT / "benchmarks", ".") == []


@pytest.mark.parametrize("late", ["def f():\n    from .first import f", "if TYPE_CHECKING:\n    import package.first"])
def test_the_check_for_circles_sees_late_imports(tmp_path, late):
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "first.py").write_text("from . import second")
    (tmp_path / "package" / "second.py").write_text(late)
    assert {"package.first", "package.second"} == set(find_import_circle(tmp_path, "package"))


def test_imports_run_downward():
    faults = []
    for file in FILES:
        part = file.relative_to(ROOT / "jaxbl").with_suffix("").parts[0]
        if part not in ("__init__", "__main__"):
            targets = [name.split(".")[1] for name in list_imports(file, ROOT) if name.startswith("jaxbl.")]
            faults += [
                f"{file}: {part} imports {name}" for name in targets if name != part and name not in LOWER_FLOORS[part]
            ]
    assert not faults, "\n".join(faults)


def test_the_import_check_sees_imports():
    assert "jaxbl.errors.InputError" in list_imports(ROOT / "jaxbl" / "sweeps" / "store.py")
    assert "jaxbl.sweeps.sweep.StudyResult" in list_imports(ROOT / "jaxbl" / "report" / "sweep.py")


def globals_of(code):
    """Names that functions take from their module."""
    yield from (instruction.argval for instruction in dis.get_instructions(code) if instruction.opname == "LOAD_GLOBAL")
    for constant in filter(inspect.iscode, code.co_consts):
        yield from globals_of(constant)


def test_every_name_is_defined():
    """Linters are told to pass over undefined names, since shapes of arrays are written as strings."""
    faults = set()
    for name in MODULES:
        module = importlib.import_module(name)
        code = compile(Path(module.__file__).read_text(encoding="utf-8"), name, "exec")
        used = set(globals_of(code))
        faults |= {f"{name}: {word}" for word in used if not hasattr(module, word) and not hasattr(builtins, word)}
    assert not faults, "\n".join(sorted(faults))


def test_the_check_of_names_sees_undefined_names():
    code = compile("def f():\n    return [missing for _ in range(2)]", "", "exec")
    assert set(globals_of(code)) == {"missing", "range"}


def test_every_public_module_class_and_function_has_a_docstring():
    faults = []
    for name in MODULES:
        module = importlib.import_module(name)
        faults += [name] * (not module.__doc__)
        for member, value in vars(module).items():
            documented = (inspect.isclass(value) or inspect.isfunction(value)) and value.__module__ == name
            if documented and not member.startswith("_") and not value.__doc__:
                faults.append(f"{name}.{member}")
    assert not faults, "\n".join(faults)


def test_cross_references_lead_somewhere():
    faults = []
    for name in MODULES:
        module = importlib.import_module(name)
        source = Path(module.__file__).read_text(encoding="utf-8")
        references = re.findall(r":(?:mod|func|class|meth|data):`([^`]+)`", source)
        faults += [f"{name}: {reference}" for reference in references if not leads_somewhere(reference, module)]
    assert not faults, "\n".join(faults)


def leads_somewhere(reference, module):
    """True if a reference in a module names a module, something in one, or a name of this one or of its classes."""
    package = module.__name__ if hasattr(module, "__path__") else module.__name__.rpartition(".")[0]
    path = package + reference if reference.startswith(".") else reference
    if not path.startswith("jaxbl."):
        first = path.partition(".")[0]
        classes = [
            value for value in vars(module).values() if inspect.isclass(value) and value.__module__ == module.__name__
        ]
        return any(hasattr(owner, first) for owner in (module, *classes))
    parts = path.split(".")
    for i in range(len(parts), 0, -1):
        if ".".join(parts[:i]) in MODULES:
            target = importlib.import_module(".".join(parts[:i]))
            for part in parts[i:]:
                target = getattr(target, part, None)
            return target is not None
    return False


@pytest.mark.parametrize("file", sorted((ROOT / "sweeps").glob("*.toml")), ids=lambda f: f.stem)
def test_every_study_is_valid_with_its_axes_and_figures(file):
    config = read_config(file)
    assert config.title
    assert len(Points(config)) >= 1
    check_figures(config, config.figures, metric_columns(config.build()))


def test_public_functions_stay_functions_once_their_packages_are_imported():
    for name in dir(jaxbl):
        getattr(jaxbl, name)
    importlib.import_module("jaxbl.estimation.identify")
    assert all(callable(getattr(jaxbl, name)) for name in ("identify", "inspect", "run", "sweep", "verify", "tune"))
