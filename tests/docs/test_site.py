"""The documentation, as a reader's browser shows it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.browser import faults_of

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    """Build the site; what is wrong in it is an error."""
    folder = tmp_path_factory.mktemp("site")
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    built = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return folder


def test_every_page_is_shown_as_it_was_meant(site):
    """No raw marks, no missing pictures, nothing cut off, nothing said by the console, nothing asked of the network."""
    pages = sorted(path.relative_to(site).as_posix() for path in site.rglob("*.html"))
    assert len(pages) > 10
    faults = faults_of(site, pages)
    assert not faults, "\n".join(faults)


# What may be wrong with a page, and what must be said of it.
FAULTY = {
    '<p>=== "In napari"</p>': "raw mark",
    "<p>of $x_n$</p>": "raw mark",
    '<pre>--8&lt;-- "a.py"</pre>': "raw mark",
    '<span class="arithmatex">\\(x\\)</span>': "is not set",
    '<img src="nowhere.png">': "no picture at nowhere.png",
    '<script src="nowhere.js"></script>': "not there: http://127.0.0.1",
    f'<pre style="overflow-x: auto">{"x" * 900}</pre>': "cut off",
    '<div style="width: 3000px">wide</div>': "wider than the window",
    "<script>missing()</script>": "missing is not defined",
    '<link rel="stylesheet" href="https://example.org/a.css">': "asks for https://example.org/a.css",
}
FLAWLESS = '<p>An <code>=== "a"</code>.</p><pre>x = 1  # $x$</pre>'


def test_what_is_wrong_with_a_page_is_found(tmp_path):
    for number, body in enumerate([*FAULTY, FLAWLESS]):
        (tmp_path / f"{number}.html").write_text(f"<!doctype html><title>page</title>{body}", encoding="utf-8")
    faults = faults_of(tmp_path, [f"{number}.html" for number in range(len(FAULTY) + 1)])
    for number, said in enumerate(FAULTY.values()):
        assert any(said in fault and f"{number}.html" in fault for fault in faults), (said, faults)
    assert not [fault for fault in faults if f"{len(FAULTY)}.html" in fault]
