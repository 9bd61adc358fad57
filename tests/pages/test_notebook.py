"""The notebook runs from top to bottom, and what is committed of it was run."""

import nbformat
from nbclient import NotebookClient

from tests.pages.blocks import ROOT

NOTEBOOK = ROOT / "docs" / "tutorials" / "notebook.ipynb"
FEWER = {
    "SECONDS = 15 ": "SECONDS = 1 ",
    "os.chdir(work)": (
        "os.chdir(work)\nfrom visthrow.training import trainer\ntrainer.EVALUATED = 20"
    ),
}
"""What is smaller than on the page: seconds of training, and throws that evaluate it."""
PATIENCE = 300
"""For one cell [s]."""


def test_the_notebook_runs(tmp_path, monkeypatch):
    monkeypatch.setenv("VISTHROW_NOTEBOOK_OUT", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    for shown, run in FEWER.items():
        assert shown in notebook.cells[1].source
        notebook.cells[1].source = notebook.cells[1].source.replace(shown, run)
    NotebookClient(
        notebook, timeout=PATIENCE, resources={"metadata": {"path": str(NOTEBOOK.parent)}}
    ).execute()
    assert list(tmp_path.glob("laptop/policy.npz"))
    assert list(tmp_path.glob("fly/throw.png"))


def test_its_outputs_are_committed():
    cells = [
        cell for cell in nbformat.read(NOTEBOOK, as_version=4).cells if cell.cell_type == "code"
    ]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert any("image/png" in output.get("data", {}) for cell in cells for output in cell.outputs)
    assert not any(output.output_type == "error" for cell in cells for output in cell.outputs)
