"""The package only shrinks, and its names say a thing: ceilings for each folder and the sum (`make size`)."""

import subprocess
import sys

import pytest
import size
from size import ROOT, Size, measure_file, measure_folders

# tokens; percent of vague names, of functions named by a participle, of docstrings without a subject.
# Lowered to what is reached; raised only where an issue names a new sum, in the commit that says why. 395 804 in all is
# 393 921 and what the engine as functions takes: for it and for the loop closed a sum of 10 000 more is named. `report` and
# `records` are above what they were, by the explorer and by logs as people write them; `gains`, `throughput` and `sweeps`
# pay for these.
CEILINGS = {
    "all": (395804, 0.03, 0.27, 0.0),
    "report": (62006, 0.11, 0.95, 0.0),
    "diagnosis": (59529, 0.0, 0.0, 0.0),
    "records": (49434, 0.0, 0.0, 0.0),
    "gains": (36899, 0.0, 0.0, 0.0),
    "estimation": (34386, 0.0, 0.0, 0.0),
    "sweeps": (28408, 0.07, 0.0, 0.0),
    "exports": (22708, 0.02, 0.0, 0.0),
    "fused": (24243, 0.0, 0.0, 0.0),
    ".": (21351, 0.02, 0.0, 0.0),
    "drive": (12893, 0.0, 1.67, 0.0),
    "throughput": (10661, 0.0, 0.0, 0.0),
    "cli": (9462, 0.09, 0.0, 0.0),
    "config": (9334, 0.0, 0.0, 0.0),
    "observer": (8962, 0.0, 0.0, 0.0),
    "monitoring": (5528, 0.0, 0.0, 0.0),
}


@pytest.fixture(scope="module")
def sizes() -> dict[str, Size]:
    return measure_folders(ROOT / "jaxbl")


def test_every_folder_has_a_ceiling(sizes):
    assert set(sizes) == set(CEILINGS)


def test_no_folder_exceeds_its_ceiling(sizes):
    excesses = [
        f"{folder}: {name} {measured:.2f} exceeds {ceiling}"
        for folder, counts in sizes.items()
        for name, measured, ceiling in zip(
            ("tokens", "vague names (%)", "participle functions (%)", "docstrings without a subject (%)"),
            (counts.tokens, counts.vague_percent, counts.participle_percent, counts.without_subject_percent),
            CEILINGS[folder],
            strict=True,
        )
        if measured > ceiling
    ]
    assert not excesses, "\n".join(excesses)


def test_sizes_count_tokens_and_words(tmp_path):
    file = tmp_path / "example.py"
    file.write_text(
        '"""Of things."""\n\n\ndef settled(one, motor):\n    """Whether it is."""\n'
        '    # a comment\n    return f"{one:.3f} of {motor}" + one\n'
    )
    assert measure_file(file) == Size(
        lines=7,
        code_lines=2,
        # def settled ( one , motor ) : / return f"..." + one
        tokens=8 + 4,
        names=5,
        vague_names=3,
        functions=1,
        participle_functions=1,
        docstrings=1,
        docstrings_without_subject=1,
    )


def test_the_script_prints_a_row_a_folder():
    command = [sys.executable, ROOT / "benchmarks" / "size.py", ROOT / "jaxbl" / "drive"]
    table = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert {line.split()[0] for line in table.splitlines()[1:]} == {"effects", ".", "all"}


def test_the_script_measures_the_package(sizes, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["size.py"])
    monkeypatch.setattr(size, "measure_folders", {ROOT / "jaxbl": sizes}.__getitem__)
    size.main()
    assert len(capsys.readouterr().out.splitlines()) == 1 + len(sizes)
