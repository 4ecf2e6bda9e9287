"""The tutorials as notebooks: what a page says in cells of text, and the code of its script in cells of code.

MkDocs calls `on_page_markdown` and `on_post_build`; each page of the tutorials gets a link to its notebook.
"""

import re
from pathlib import Path
from typing import Any

import nbformat
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

ROOT = Path(__file__).parents[1]
TUTORIALS = ROOT / "docs" / "tutorials"

_CODE = re.compile(r'```python\n--8<-- "(?P<script>[^":]+):(?P<section>\w+)"\n```\n')
_MARK = re.compile(r"^# --8<-- \[(?P<edge>start|end):(?P<section>\w+)\]\n", re.MULTILINE)
# Pictures lie beside the page, and so do other pages.
_COMPARED = re.compile(r'<div class="compare" markdown>\n.*?</div>\n+(\*[^\n]*\*\n)?', re.DOTALL)
_PICTURE = re.compile(r"^!\[[^\]]*\]\([^)]*\)\n", re.MULTILINE)
_LINK = re.compile(r"\[([^\]]*)\]\((?!https?:)[^)]*\)")


def notebook_of(markdown: str) -> nbformat.NotebookNode:
    """Return a tutorial as a notebook.

    Each cell of code begins where the one before it has ended in the script, so that nothing of the script is missing.

    Parameters
    ----------
    markdown : str
        The page, with the sections of one script in the order in which the script has them.
    """
    cells, at, done = [], 0, 0
    for code in _CODE.finditer(markdown):
        cells += _words(markdown[at : code.start()])
        script = (ROOT / code["script"]).read_text(encoding="utf-8")
        end = next(
            mark for mark in _MARK.finditer(script) if mark["edge"] == "end" and mark["section"] == code["section"]
        )
        cells.append(new_code_cell(_MARK.sub("", script[done : end.start()]).strip()))
        at, done = code.end(), end.end()
    cells += _words(markdown[at:])
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number}"  # the same in every build
    return new_notebook(cells=cells, metadata={"kernelspec": {"name": "python3", "display_name": "Python 3"}})


def _words(markdown: str) -> list[Any]:
    text = _LINK.sub(r"\1", _PICTURE.sub("", _COMPARED.sub("", markdown))).strip()
    return [new_markdown_cell(text)] if text else []


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Offer the notebook at the end of a tutorial."""
    path = Path(page.file.src_path)
    if path.parts[0] != TUTORIALS.name:
        return markdown
    return f'{markdown}\n\n<a href="../{path.stem}.ipynb" download>This page as a notebook</a>\n'


def on_post_build(config: Any, **_: Any) -> None:
    """Write the notebooks beside the pages."""
    for page in TUTORIALS.glob("*.md"):
        notebook = notebook_of(page.read_text(encoding="utf-8"))
        nbformat.write(notebook, Path(config["site_dir"]) / TUTORIALS.name / f"{page.stem}.ipynb")
