"""The notebook's cells run from top to bottom, and what is committed of it was run."""

import nbformat

from tests.pages.blocks import ROOT, check_shown
from visthrow.training import trainer

NOTEBOOK = ROOT / "docs" / "tutorials" / "notebook.ipynb"
MANY, FEW = "ITERATIONS = 14 ", "ITERATIONS = 1 "
"""Of the training, on the page and here."""
SAME = ('visthrow("fly', 'visthrow(f"diagnose')
"""Commands of the cells whose output the test compares."""
CELLS = [cell for cell in nbformat.read(NOTEBOOK, as_version=4).cells if cell.cell_type == "code"]


def streams(cell) -> str:
    """Return what a cell printed."""
    return "".join(output.text for output in cell.outputs if output.output_type == "stream")


def test_the_notebook_runs_and_prints_what_it_shows(tmp_path, monkeypatch, capsys):
    """In this process, which has imported and compiled most of what the cells use."""
    monkeypatch.setenv("VISTHROW_NOTEBOOK_OUT", str(tmp_path))
    monkeypatch.setattr(trainer, "EVALUATED", 4)
    monkeypatch.chdir(NOTEBOOK.parent)
    assert MANY in CELLS[0].source
    names, compared = {}, 0
    for cell in CELLS:
        exec(cell.source.replace(MANY, FEW), names)
        printed = "".join(capsys.readouterr())
        if any(command in cell.source for command in SAME):
            check_shown(streams(cell), printed, cell.source.splitlines()[-1])
            compared += 1
    assert compared == 3
    assert list(tmp_path.glob("laptop/policy.npz"))
    assert list(tmp_path.glob("fly/throw.png"))


def test_its_outputs_are_committed():
    assert [cell.execution_count for cell in CELLS] == list(range(1, len(CELLS) + 1))
    assert any("image/png" in output.get("data", {}) for cell in CELLS for output in cell.outputs)
    assert not any(output.output_type == "error" for cell in CELLS for output in cell.outputs)
