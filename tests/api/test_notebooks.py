"""The notebooks run from the first cell to the last, and show what their text says."""

import os
import shutil
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

REPO = Path(__file__).resolve().parents[2]
NOTEBOOKS = REPO / "service/docs/notebooks"


def executed(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[str, int]:
    """All text that a copy of a notebook prints, and the number of its pictures; run in its folder."""
    shutil.copytree(NOTEBOOKS, folder, dirs_exist_ok=True)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(REPO / "service"), os.environ.get("PYTHONPATH", "")]))
    for variable in ("IPYTHONDIR", "JUPYTER_RUNTIME_DIR", "JUPYTER_CONFIG_DIR"):
        monkeypatch.setenv(variable, str(folder / variable.lower()))  # nothing of the user's
    book = nbformat.read(folder / name, 4)
    NotebookClient(book, timeout=120, kernel_name="python3", resources={"metadata": {"path": str(folder)}}).execute()
    outputs = [output for cell in book.cells if cell.cell_type == "code" for output in cell.outputs]
    data = [output.get("data", {}) for output in outputs]
    texts = [output.get("text", "") for output in outputs] + [each.get("text/plain", "") for each in data]
    return "\n".join(texts), sum("image/png" in each for each in data)


@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.name)
def test_they_are_kept_without_outputs(path):
    book = nbformat.read(path, 4)
    nbformat.validate(book)
    assert [cell.outputs for cell in book.cells if cell.cell_type == "code" and cell.outputs] == []


def test_a_table_becomes_two_soils_and_the_missing_effect_is_named(tmp_path, monkeypatch):
    text, pictures = executed("test-rig.ipynb", tmp_path, monkeypatch)
    assert pictures == 3
    assert "degraded (model_mismatch)" in text
    assert "named: an effect is missing, and the data tell which" in text
    assert "1. slip_sinkage" in text
    assert "status             = valid" in text
    off = [abs(float(cell)) for line in text.splitlines()[-6:] for cell in line.split()[1:]]
    assert len(off) == 12
    assert max(off) < 3.0


def test_a_recording_becomes_a_named_effect_that_closes_the_gap_of_another(tmp_path, monkeypatch):
    text, pictures = executed("diagnosis.ipynb", tmp_path, monkeypatch)
    assert pictures == 1
    assert "an effect is missing, and the data tell which: slip_sinkage" in text
    assert "\nnone: " in text


def test_the_papers_figures_are_drawn_and_their_text_agrees_with_their_numbers(tmp_path, monkeypatch):
    text, pictures = executed("paper.ipynb", tmp_path, monkeypatch)
    assert pictures == 4
    rows = [line.split() for line in text.splitlines()]
    names = next(row for row in rows if row[:2] == ["parameter", "K"])[1:]
    pull = next(row for row in rows if "drawbar_pull" in row and "clay" in row)
    moved = dict(zip(names, map(float, pull[-len(names) :]), strict=True))
    assert sorted(moved, key=lambda name: -abs(moved[name]))[:2] == ["n", "c"]
