"""Importing is cheap, and the public names are there."""

import subprocess
import sys

import napari_fiberburst


def modules_after(statement: str) -> set[str]:
    code = f"{statement}; import sys; print(' '.join(sys.modules))"
    return set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split())


def test_importing_the_package_loads_neither_torch_nor_qt_nor_napari():
    loaded = modules_after("import napari_fiberburst")
    assert not loaded & {"torch", "qtpy", "PyQt6", "PySide6", "napari", "numpy", "skimage", "pydantic"}


def test_opening_a_burst_needs_no_torch():
    loaded = modules_after("from napari_fiberburst import Burst, Settings, Control, Reconstruction, read_burst")
    assert not loaded & {"torch", "qtpy", "napari", "pydantic"}


def test_numba_waits_for_a_live_engine_to_be_made():
    assert "numba" not in modules_after("from napari_fiberburst import Bundle, LiveEngine, reconstruct")


def test_every_public_name_is_there():
    for name in napari_fiberburst.__all__:
        assert getattr(napari_fiberburst, name).__doc__
    assert set(napari_fiberburst.__all__) <= set(dir(napari_fiberburst))
    assert not hasattr(napari_fiberburst, "no_such_name")
