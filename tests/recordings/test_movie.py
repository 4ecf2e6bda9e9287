"""Any stack as a film to look at."""

import numpy as np
import pytest
import tifffile
import zarr

from napari_fiberburst import open_recording
from napari_fiberburst.cli import main
from napari_fiberburst.io.pyramid import create_pyramid


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


def test_a_video_with_nan_has_a_scale_bar_where_a_pixel_has_a_size(stack, tmp_path):
    frames = stack[1].astype(np.float32)
    for name, size in (("known", (0.5, 0.5)), ("unknown", None)):
        path = tmp_path / f"{name}.ome.zarr"
        create_pyramid(
            path, frames.shape, name=name, pixel_size=size, unit="micrometer", channels=(), times=None, is_video=True
        )
        zarr.open_array(path / "0", mode="r+")[:] = frames
        assert main(["film", str(path), "-o", str(tmp_path / f"{name}.mkv")]) == 0
    known, unknown = (
        open_recording(tmp_path / f"{name}.mkv").recorded([2])[0, ..., 0] for name in ("known", "unknown")
    )
    # A quarter of 83 pixels of 0.5 is 10.4: the bar is 10 long, 20 pixels, and 2 high.
    rows, columns = np.nonzero(known != unknown)
    assert (np.ptp(rows) + 1, np.ptp(columns) + 1) == (2, 20)
    assert (known[known != unknown] == 255).all()


def test_what_makes_no_film_is_said(stack, tmp_path, capsys):
    path, frames = stack
    single = tmp_path / "single.tif"
    tifffile.imwrite(single, frames[0].astype(np.float32), metadata={"axes": "YX"})
    there = tmp_path / "there.mp4"
    there.write_bytes(b"mine")
    for given, output, said in (
        (path, there, "is there already; choose another name, remove it, or replace it by --overwrite"),
        (path, tmp_path / "a.gif", "a video file ends in .avi, .mkv, .mp4"),
        (single, tmp_path / "a.mp4", "has one frame; a film needs a time axis"),
    ):
        assert main(["film", str(given), "-o", str(output)]) == 2
        assert said in capsys.readouterr().err
    assert there.read_bytes() == b"mine"


def test_a_film_is_replaced_where_that_is_asked_for_but_not_the_stack_itself(stack, tmp_path, capsys):
    there = tmp_path / "there.mkv"
    assert main(["film", str(stack[0]), "-o", str(there)]) == 0
    before = there.read_bytes()
    assert main(["film", str(there), "-o", str(there), "--overwrite"]) == 2
    assert "there.mkv is what the result is made from, and would be lost" in capsys.readouterr().err
    assert there.read_bytes() == before
    there.write_bytes(b"old")
    assert main(["film", str(stack[0]), "-o", str(there), "--overwrite"]) == 0
    assert len(open_recording(there)) == 5
