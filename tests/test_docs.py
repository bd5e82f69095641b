"""The documentation says what the code does."""

import importlib.util
import re
import tomllib
from pathlib import Path

import pytest

from jaxbl.config import read_config
from jaxbl.records import read_log_table

ROOT = Path(__file__).parents[1]


def test_reference_is_generated_from_this_code():
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    generate = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generate)
    assert generate.PAGE.read_text(encoding="utf-8") == generate.page(), "run: python docs/generate.py"


def test_tutorial_configs_are_valid():
    blocks = re.findall(r"```toml\n(.*?)```", (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8"), re.S)
    assert len(blocks) == 3
    config = read_config(tomllib.loads("".join(blocks)))
    assert [axis.num for axis in config.axes] == [32, 32]


def test_log_examples_are_valid():
    blocks = re.findall(r"```toml\n(.*?)```", (ROOT / "docs" / "logs.md").read_text(encoding="utf-8"), re.S)
    assert len(blocks) >= 5
    for block in blocks:
        read_log_table(tomllib.loads(block)["log"])


@pytest.mark.parametrize("page", [*sorted(ROOT.glob("docs/*.md")), ROOT / "README.md"], ids=lambda p: p.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target
