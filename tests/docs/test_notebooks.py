"""The tutorials run as the notebooks that the documentation offers."""

import importlib.util
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

DOCS = Path(__file__).parents[2] / "docs"
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))
_SPEC = importlib.util.spec_from_file_location("notebooks", DOCS / "notebooks.py")
notebooks = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(notebooks)


def test_there_are_tutorials():
    assert len(TUTORIALS) >= 3


@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_a_tutorial_runs_as_a_notebook(page, tmp_path, monkeypatch):
    monkeypatch.setenv("FIBERBURST_EXAMPLE_SCALE", "tiny")
    notebook = notebooks.notebook_of(page.read_text(encoding="utf-8"))
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert len(code) == page.read_text(encoding="utf-8").count("--8<--")
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert any(output.output_type == "stream" and output.name == "stdout" for cell in code for output in cell.outputs)


def test_text_keeps_its_words_and_loses_what_only_the_site_has():
    page = 'Look [here](../method.md), or [there](https://example.org).\n\n![A frame](images/a.png)\n\nEnd.\n'
    (cell,) = notebooks.notebook_of(page).cells
    assert cell.source == "Look here, or [there](https://example.org).\n\n\nEnd."
