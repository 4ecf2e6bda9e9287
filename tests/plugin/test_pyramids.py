"""An image on disk is shown as far as it is written, at every zoom."""

import numpy as np
import pytest
import zarr
from napari.layers import Image

from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.io.pyramid import create_pyramid
from napari_fiberburst.plugin.placement import Placement
from napari_fiberburst.plugin.pyramids import PyramidLayer


@pytest.fixture
def shown(tmp_path):
    """Return a layer of an image of 163 x 543 pixels that nothing is written to yet, and its levels."""
    path = tmp_path / "a.ome.zarr"
    create_pyramid(path, (163, 543), name="a", pixel_size=None, unit=None, channels=(), times=None)
    known = Acquisition(shape=(5, 97, 121, 1), axes="TYX", dtype=np.dtype("u1"), black_level=0.0, white_level=255.0)
    placement = Placement.of([Image(np.zeros((5, 97, 121)))], "TYX", (0, 0))
    made = PyramidLayer(path, "a", placement, known, {})
    count = sum(1 for _ in zarr.open_group(path, mode="r").array_keys())
    return made, [zarr.open_array(path / str(level), mode="r+") for level in range(count)]


def test_what_has_been_written_since_is_in_the_thumbnail_and_in_the_coarsest_level(viewer, shown):
    made, levels = shown
    viewer.add_layer(made.layer)
    assert len(levels) > 1
    assert not made.layer.thumbnail[..., :3].any()
    for level in levels:
        level[:] = np.linspace(50, 200, level.shape[1]) + np.zeros(level.shape)
    made.refresh()
    middle = made.layer.thumbnail[16, :, :3].mean(axis=1)
    assert middle[0] < 20
    assert middle[-1] > 230
    made.layer.data_level = len(levels) - 1
    made.layer.refresh()
    assert made.layer.get_value((80, 500)) == (len(levels) - 1, pytest.approx(levels[-1][0, 125], rel=0.02))
