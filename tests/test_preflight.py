"""The check before the tests names what is missing."""

import runpy
from pathlib import Path

PREFLIGHT = runpy.run_path(str(Path(__file__).with_name("preflight.py")))


def test_a_missing_library_is_named_with_its_package():
    error = ImportError("libEGL.so.1: cannot open shared object file: No such file or directory")
    assert "sudo apt-get install libegl1" in PREFLIGHT["advice"](error)


def test_an_unknown_library_says_how_to_find_it():
    assert "apt-file search libodd.so.3" in PREFLIGHT["advice"](ImportError("libodd.so.3: cannot open"))


def test_ci_installs_all_that_is_named():
    listed = set(Path(__file__).parents[1].joinpath(".ci/apt-packages").read_text().split())
    assert {*PREFLIGHT["X11_PACKAGES"].values(), "chromium"} <= listed


def test_a_missing_browser_is_named(monkeypatch, capsys):
    monkeypatch.setitem(PREFLIGHT["main"].__globals__, "find_browser", lambda: None)
    assert PREFLIGHT["main"]() == 1
    assert "sudo apt-get install chromium" in capsys.readouterr().err


def test_all_loads_here():
    assert PREFLIGHT["main"]() == 0
