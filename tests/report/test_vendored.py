"""Libraries of others that pages need: what their hashes say, with licence and version, and in the package."""

import hashlib
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
VENDORED = ROOT / "jaxbl" / "report" / "vendored"


def test_each_library_is_as_its_hash_says_and_how_it_is_made_is_written():
    lines = (VENDORED / "SHA256SUMS").read_text().splitlines()
    sums = {name: digest for digest, name in map(str.split, lines)}
    assert {file.name for file in VENDORED.iterdir()} == {*sums, "SHA256SUMS", "uPlot.LICENSE.txt", "hyparquet.LICENSE.txt"}
    assert {name: hashlib.sha256((VENDORED / name).read_bytes()).hexdigest() for name in sums} == sums
    contributing = (ROOT / "CONTRIBUTING.md").read_text()
    for name, version in (("hyparquet", "1.31.5"), ("uPlot", "1.6.32")):
        assert version in (VENDORED / f"{name}.js").read_text()[:100] and f"{name} {version}" in contributing
        assert (VENDORED / f"{name}.LICENSE.txt").read_text().startswith("The MIT License")


def test_their_licences_are_the_packages_too():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["license"] == "Apache-2.0 AND MIT"
    assert {file for pattern in project["license-files"] for file in ROOT.glob(pattern)} == {
        ROOT / "LICENSE", *VENDORED.glob("*.LICENSE.txt")
    }  # fmt: skip
