"""The example notebook runs from top to bottom, and is kept without outputs."""

import nbformat
import pytest
from nbclient import NotebookClient
from support.problems.springs import ROOT

PATH = ROOT / "cluster_est" / "docs" / "first_fit.ipynb"


@pytest.fixture(scope="module")
def stored() -> nbformat.NotebookNode:
    return nbformat.read(PATH, as_version=4)


def test_it_is_stored_without_outputs(stored):
    cells = [cell for cell in stored.cells if cell.cell_type == "code"]
    assert all(cell.outputs == [] and cell.execution_count is None for cell in cells)


def test_its_cells_run_one_after_the_other(stored, monkeypatch, capsys):
    monkeypatch.chdir(PATH.parent)
    known = {}
    for cell in stored.cells:
        if cell.cell_type == "code":
            exec(cell.source, known)
    assert "True converged" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of Jupyter's own parts
def test_it_runs_and_shows_what_its_text_says(stored):
    run = NotebookClient(stored, timeout=120, resources={"metadata": {"path": str(PATH.parent)}})
    shown = [cell.outputs for cell in run.execute().cells if cell.cell_type == "code"]
    assert "Problem: mass_spring_damper.fmu" in shown[0][0].data["text/html"]
    assert "Result: converged" in shown[1][0].data["text/html"]
    assert shown[2][0].text.startswith("True converged")
    by_scipy, by_fit = (float(number) for number in shown[4][0].text.split()[:2])
    assert by_scipy == pytest.approx(by_fit, rel=1e-6)
