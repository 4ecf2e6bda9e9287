"""Every example runs, on a burst small enough for a test."""

import runpy
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))
# They open the real window on a whole sample; what they do there is asserted by tests/plugin.
ON_SCREEN = {"record_live", "record_the_plugin", "show_the_plugin"}


def test_there_are_examples():
    assert EXAMPLES


@pytest.mark.parametrize("path", [path for path in EXAMPLES if path.stem not in ON_SCREEN], ids=lambda path: path.stem)
def test_example_runs(path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FIBERBURST_EXAMPLE_SCALE", "tiny")
    runpy.run_path(str(path), run_name="__main__")
    assert capsys.readouterr().out
