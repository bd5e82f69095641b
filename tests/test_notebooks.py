"""Notebooks of the documentation: they run as written, show figures, and say what their texts claim."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
SAID = {
    "gains": ("velocity error of the motor observer: ", "motor: lambda = "),
    "log": ("inertia about 0.05 kg m²", "the model lacks motor.cogging", "amplitude = 0.1 ±", "harmonic = 7"),
}
FIGURES = {"gains": 3, "log": 3}


def test_every_notebook_has_a_test():
    assert {file.stem for file in (ROOT / "docs" / "notebooks").iterdir()} == set(SAID) == set(FIGURES)


@pytest.mark.slow
@pytest.mark.parametrize("name", SAID)
def test_notebook_runs_as_written(name, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    notebook = nbformat.read(ROOT / "docs" / "notebooks" / f"{name}.ipynb", as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in cells), "outputs make large diffs: clear them"
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in cells for output in cell.outputs]
    streams = [(one.name, one.text) for one in outputs if one.output_type == "stream"]
    assert [text for stream, text in streams if stream != "stdout"] == []
    said = "".join(text for _, text in streams)
    assert [text for text in SAID[name] if text not in said] == []
    shown = "".join(one.data.get("text/html", "") for one in outputs if one.output_type == "execute_result")
    assert shown.count("<figure>") == FIGURES[name]
