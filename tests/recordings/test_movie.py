"""Any stack as a film to look at."""

import numpy as np
import pytest
import tifffile

from napari_fiberburst import open_recording
from napari_fiberburst.cli import main


@pytest.fixture
def stack(tmp_path):
    """Return a stack of odd sides, with NaN at an edge, whose brightness rises to the right and in time."""
    frames = np.linspace(0, 900, 83) + 100 * np.arange(5)[:, None, None] + np.zeros((5, 61, 83))
    frames[:, :, :4] = np.nan
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, frames.astype(np.float32), metadata={"axes": "TYX"})
    return path, frames


def test_a_stack_with_nan_and_odd_sides_becomes_a_film(stack, tmp_path):
    path, frames = stack
    assert main(["film", str(path), "-o", str(tmp_path / "a.mp4")]) == 0
    film = open_recording(tmp_path / "a.mp4").recorded(range(5))[..., 0]
    assert film.shape == (5, 62, 84)  # H.264 has even sides
    assert film[:, :, :3].max() < 16
    assert np.corrcoef(film[:, :61, 8:83].ravel(), frames[:, :, 8:].ravel())[0, 1] > 0.99


def test_what_makes_no_film_is_said(stack, tmp_path, capsys):
    path, frames = stack
    single = tmp_path / "single.tif"
    tifffile.imwrite(single, frames[:1].astype(np.float32), metadata={"axes": "TYX"})
    there = tmp_path / "there.mp4"
    there.write_bytes(b"mine")
    for given, output, said in (
        (path, there, "is there already; choose another name"),
        (path, tmp_path / "a.gif", "a video file ends in .avi, .mkv, .mp4"),
        (single, tmp_path / "a.mp4", "has one frame; a film needs a time axis"),
    ):
        assert main(["film", str(given), "-o", str(output)]) == 2
        assert said in capsys.readouterr().err
    assert there.read_bytes() == b"mine"
