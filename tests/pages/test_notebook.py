"""The notebook runs from top to bottom, and what is committed of it was run."""

import nbformat
from nbclient import NotebookClient

from tests.pages.blocks import ROOT, check_shown

NOTEBOOK = ROOT / "docs" / "tutorials" / "notebook.ipynb"
FEWER = {
    "ITERATIONS = 14 ": "ITERATIONS = 1 ",
    "os.chdir(work)": (
        "os.chdir(work)\nfrom visthrow.training import trainer\ntrainer.EVALUATED = 4"
    ),
}
"""What is smaller than on the page: iterations of training, and throws that evaluate it."""
SAME = ('visthrow("fly', 'visthrow(f"diagnose')
"""Commands of the cells whose output the test compares."""
PATIENCE = 300
"""For one cell [s]."""


def streams(cell) -> str:
    """Return what a cell printed."""
    return "".join(output.text for output in cell.outputs if output.output_type == "stream")


def test_the_notebook_runs_and_prints_what_it_shows(tmp_path, monkeypatch):
    monkeypatch.setenv("VISTHROW_NOTEBOOK_OUT", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    shown_outputs = [streams(cell) for cell in notebook.cells if cell.cell_type == "code"]
    for shown, run in FEWER.items():
        assert shown in notebook.cells[1].source
        notebook.cells[1].source = notebook.cells[1].source.replace(shown, run)
    NotebookClient(
        notebook, timeout=PATIENCE, resources={"metadata": {"path": str(NOTEBOOK.parent)}}
    ).execute()
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    same = [any(command in cell.source for command in SAME) for cell in cells]
    assert sum(same) == 3
    for cell, shown, compared in zip(cells, shown_outputs, same, strict=True):
        if compared:
            check_shown(shown, streams(cell), cell.source.splitlines()[-1])
    assert list(tmp_path.glob("laptop/policy.npz"))
    assert list(tmp_path.glob("fly/throw.png"))


def test_its_outputs_are_committed():
    cells = [
        cell for cell in nbformat.read(NOTEBOOK, as_version=4).cells if cell.cell_type == "code"
    ]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert any("image/png" in output.get("data", {}) for cell in cells for output in cell.outputs)
    assert not any(output.output_type == "error" for cell in cells for output in cell.outputs)
