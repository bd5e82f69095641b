"""The documentation says what the code does: names that exist, commands and Python that run as written."""

import importlib
import importlib.util
import json
import os
import re
import shutil
import sys
import tomllib
from itertools import chain
from pathlib import Path

import pytest
from command_server import run_python
from markdown_blocks import read_blocks, zero_numbers
from progress_lines import without_progress
from test_public import FLOORS
from typer.main import get_command

import jaxbl
from jaxbl.cli import app
from jaxbl.config import read_config
from jaxbl.records import read_log_table

ROOT = Path(__file__).parents[1]
TEXTS = [*sorted(ROOT.glob("*.md")), *sorted(ROOT.glob("docs/*.md")), ROOT / "benchmarks" / "NOTES.md"]
SCRIPTS = [*sorted(ROOT.glob("docs/*.py")), *sorted(ROOT.glob("benchmarks/**/*.py"))]


def page_name(path):
    return str(path.relative_to(ROOT))


def load_script(name):
    """A program of docs as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_reference_is_generated_from_this_code():
    generate = load_script("generate")
    assert generate.PAGE.read_text(encoding="utf-8") == generate.page(), "run: python docs/generate.py"


def test_pictures_are_what_is_drawn_today():
    """Each picture was drawn anew since what it is made of changed: studies, programs, and what draws panels in minutes."""
    inputs = load_script("picture_inputs")
    table = inputs.read_table()
    assert set(table) == {file.stem for file in inputs.FIGURES.glob("*.png")}
    old = [name for name, entry in table.items() if inputs.hash_inputs(entry["inputs"]) != entry["hash"]]
    assert old == [], "draw them anew by their command, look at them, and run: python docs/picture_inputs.py NAME ..."


def test_tutorial_configs_are_valid():
    # blocks that begin with a file's name are files of their own, which include the others
    text = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```toml\n(?!# \w+\.toml)(.*?)```", text, re.S)
    assert len(blocks) == 3
    study = tomllib.loads("".join(blocks))
    assert [axis.num for axis in read_config(study).axes] == [32, 32]
    (certified,) = re.findall(r"```toml\n# certified\.toml\ninclude = \"axis.toml\"\n(.*?)```", text, re.S)
    study["tune"]["certificate"] = tomllib.loads(certified)["tune"]["certificate"]
    tune = read_config(study).tune
    assert tune is not None and tune.certificate is not None and tune.certificate.motor.accuracy == 0.5


def test_gallery_studies_are_valid():
    text = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    studies = re.findall(r"^```\{study\} \w+\n((?::[^\n]*\n)+)(.*?)^```", text, re.S | re.M)
    assert len(studies) == text.count("```{study}") >= 5
    for options, study in studies:
        config = read_config(tomllib.loads(study))
        assert bool(config.axes) == (":command: sweep\n" in options)


def test_api_has_every_public_name():
    entries = re.findall(r"^\.\. auto\w+:: (\w+)$", (ROOT / "docs" / "api.md").read_text(encoding="utf-8"), re.M)
    assert sorted(entries) == dir(jaxbl)


def test_every_page_is_in_the_site():
    index = ROOT / "docs" / "index.md"
    listed = re.findall(r"^(?:\w+ <)?([\w./]+)>?$", index.read_text(encoding="utf-8"), re.M)
    # notes are for whoever changes the code
    pages = {page.resolve().with_suffix("") for page in TEXTS if page.name != "NOTES.md"}
    assert {(index.parent / page).resolve() for page in listed} == pages - {index.with_suffix("")}


def test_citation_has_this_version():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_log_examples_are_valid():
    blocks = re.findall(r"```toml\n(.*?)```", (ROOT / "docs" / "logs.md").read_text(encoding="utf-8"), re.S)
    assert len(blocks) >= 5
    for block in blocks:
        read_log_table(tomllib.loads(block)["log"])


def heading_anchors(page):
    """Anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.M)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", TEXTS, ids=page_name)
def test_links_lead_somewhere(page):
    for target, anchor in re.findall(r"\]\(([^)#]*)#?([^)]*)\)", page.read_text(encoding="utf-8")):
        if "://" not in target:
            file = page.parent / target if target else page
            assert file.exists(), target
            assert not anchor or anchor in heading_anchors(file), f"{target}#{anchor}"


# names


def resolve(dotted):
    """The object of a dotted name in the package."""
    parts = dotted.split(".")
    for i in range(len(parts), 0, -1):
        try:
            target = importlib.import_module(".".join(parts[:i]))
        except ModuleNotFoundError:
            continue
        for part in parts[i:]:
            target = getattr(target, part)
        return target
    raise AssertionError(dotted)


# names of entry-point groups, which packages with effects of their own use
GROUPS = {
    group
    for file in (ROOT / "jaxbl").rglob("*.py")
    for group in re.findall(r'[(=]"(jaxbl\.\w+)"', file.read_text(encoding="utf-8"))
}


@pytest.mark.parametrize("page", TEXTS + SCRIPTS, ids=page_name)
def test_names_of_modules_and_files_exist(page):
    text = page.read_text(encoding="utf-8")
    paths = re.findall(r"(?<![\w./-])(?:jaxbl|benchmarks|docs(?!/_build)|sweeps|tests)/[\w./-]*\w/?", text)
    paths += re.findall(r"(?<![\w./-])(?!my_package|results)\w[\w-]*/[\w./-]+\.(?:py|cu|md|toml)\b", text)
    for path in paths:
        assert (ROOT / path).exists() or (page.parent / path).exists(), path
    for dotted in set(re.findall(r"(?<![\w./-])jaxbl(?:\.[A-Za-z_]\w*)+", text)) - GROUPS:
        resolve(dotted)


@pytest.mark.parametrize("page", TEXTS, ids=page_name)
def test_commands_in_text_exist_with_their_options(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    commands = get_command(app).commands
    for line in re.findall(r"`jaxbl ([a-z]+[^`]*)`", text):
        command, *words = line.replace("\n", " ").split()
        options = set(chain.from_iterable(option.opts for option in commands[command].params))
        assert {word.strip("[]") for word in words if word.strip("[").startswith("--")} <= options, line
    for script, arguments in re.findall(r"`python (\S+\.py)([^`]*)`", text):
        source = (ROOT / script).read_text(encoding="utf-8")
        assert all(f'"{word}"' in source for word in arguments.split() if word.startswith("--")), f"{script}{arguments}"


def test_every_command_and_study_is_listed():
    text = (ROOT / "docs" / "which_command.md").read_text(encoding="utf-8")
    assert [command for command in get_command(app).commands if not re.search(rf"`jaxbl {command}\b", text)] == []
    assert [file.name for file in ROOT.glob("sweeps/*.toml") if f"`{file.name}`" not in text] == []


def test_the_readme_is_read_in_one_sitting():
    assert len((ROOT / "README.md").read_text(encoding="utf-8")) <= 6000


def test_architecture_shows_the_floors():
    """The diagram names the parts of each floor, top floor first."""
    diagram = re.search(r"```text\n(cli.*?)```", (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8"), re.S)[1]
    parts = set().union(*FLOORS)
    floors = [set(line[:29].split()) & parts for line in diagram.splitlines()]
    assert floors == FLOORS[::-1]


# pages, run as written

# what a block cannot do in a test, and what stands in for it
REPLACED_COMMANDS = {
    "make demo": "jaxbl demo",  # test_demo_is_this_command; the environment is imitated below
    "make test": "",
    r"\. \.venv/bin/activate": "",
    # benchmarks/slurm.sh runs these files by a SLURM
    "sbatch --array=1-20 --cpus-per-task=8 docs/cluster/array.sbatch": (
        "SLURM_ARRAY_TASK_ID=2 SLURM_ARRAY_TASK_MAX=2 sh docs/cluster/array.sbatch"
    ),
    "python docs/cluster/slurm.py .*": "",
    "dask scheduler .*": "",
    "sbatch .* docs/cluster/workers.sbatch .*": "",
    "jaxbl sweep sweeps/gain_map.toml .*--scheduler scheduler.json": "",
}


SMALLER_STUDIES = {
    "gain_map.toml": (
        {"duration = 20.0": "duration = 4.0", "num = 64": "num = 16", "seeds = 4": "seeds = 4\nchunk = 1536"},
        (),
    ),
    "geared_axis.toml": ({"duration = 10.0": "duration = 4.0"}, ("fmu.md", "watch.md")),
}
"""Studies that pages run, lines of them with smaller numbers, and the pages that need the larger ones."""

EXTRAS = {"cluster.md": "distributed", "fmu.md": "fmu", "mujoco.md": "mujoco"}
"""What pages say that it has to be installed."""


# CONTRIBUTING.md's commands run tests; the site runs the tutorials (tests/test_site.py)
PAGES = [
    page
    for page in (ROOT / "README.md", *sorted(ROOT.glob("docs/*.md")))
    if not page.stem.endswith("tutorial") and any(block.language in ("sh", "python") for block in read_blocks(page))
]


def import_name(requirement):
    """A requirement's import name: of those that only development needs."""
    return {"pytest-xdist": "xdist"}.get(package := re.match(r"[\w-]+", requirement)[0], package)


HIDE_MODULES = """import sys
class Hiding:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in hidden:
            raise ModuleNotFoundError("No module named '" + name + "'", name=name)
hidden = {hidden!r}
sys.meta_path.insert(0, Hiding())
# processes of the tests begin with modules loaded
for name in [name for name in sys.modules if name.partition(".")[0] in hidden]:
    del sys.modules[name]
"""


def make_environment(folder, clone, extra=None):
    """Return that of the README's `make demo`: what only tests and benchmarks need, or another extra, cannot be imported."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    optional = project["optional-dependencies"]
    importable = {"jaxbl", *map(import_name, optional[extra] if extra else [])}
    # pages install packages of their own
    hidden = sorted(set(map(import_name, chain.from_iterable(optional.values()))) - importable - {"hatchling"})
    site = folder / "site"
    site.mkdir()
    # a module of None would do for most, but SciPy looks whether sphinx is among those that are loaded
    (site / "sitecustomize.py").write_text(HIDE_MODULES.format(hidden=hidden))
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    # as on the command line, compiled programs are kept; here nothing changes the package while it runs
    programs = str(ROOT / ".cache" / "programs")
    pip = {"TARGET": str(site), "NO_DEPS": "1", "NO_BUILD_ISOLATION": "0", "NO_INDEX": "1", "DISABLE_PIP_VERSION_CHECK": "1"}
    pip["COMPILE"] = "0"  # packages of one module each would share a folder of bytecode, of which pip warns
    return {
        "PATH": path, "PYTHONPATH": os.pathsep.join([str(site), str(clone)]), "JAXBL_PROGRAMS": programs,
        **{f"PIP_{key}": value for key, value in pip.items()},
    }  # fmt: skip


def test_demo_is_this_command():
    recipe = re.search(r"^demo:.*\n\t(.*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)[1]
    assert recipe.replace("$(BIN)/", "") == REPLACED_COMMANDS["make demo"]


@pytest.mark.pages
@pytest.mark.parametrize("page", sorted(PAGES, key=lambda page: -len(read_blocks(page))), ids=page_name)
def test_page_runs_as_written(page, tmp_path):
    """Blocks of one page in order, in a folder with the studies of a clone. A block that begins with a file's name is that
    file."""
    clone = tmp_path / "clone"
    env = make_environment(tmp_path, clone, EXTRAS.get(page.name))
    clone.mkdir()
    shutil.copytree(ROOT / "sweeps", clone / "sweeps")
    shutil.copytree(ROOT / "docs" / "cluster", clone / "docs" / "cluster")
    # the demo runs the study beside the package
    (clone / "jaxbl").symlink_to(ROOT / "jaxbl")
    for study, (lines, pages) in SMALLER_STUDIES.items():
        text = (clone / "sweeps" / study).read_text(encoding="utf-8").split("\n")
        assert lines.keys() <= set(text)
        if page.name not in pages:
            smaller = "\n".join(lines.get(line, line) for line in text)
            (clone / "sweeps" / study).write_text(smaller, encoding="utf-8")
    blocks = []
    for language, text in read_blocks(page):
        file = re.match(r"# (\w+\.(?:toml|py))\n", text)
        if file is not None:
            language = file[1]
        elif language == "sh":
            for command, other in REPLACED_COMMANDS.items():
                text = re.sub(rf"^{command}", other, text, flags=re.M)
        if file or language in ("python", "sh", "output"):
            blocks.append((language, text))
    request = tmp_path / "blocks.json"
    request.write_text(json.dumps(blocks), encoding="utf-8")
    result = run_python(ROOT / "tests" / "page_process.py", request, cwd=clone, timeout=900.0, **env)
    assert (result.returncode, without_progress(result.stderr)) == (0, ""), result.stderr
    for (language, text), output in zip(blocks, json.loads(result.stdout), strict=True):
        if language == "output":
            assert set(zero_numbers(text)) <= set(zero_numbers(output)), output
