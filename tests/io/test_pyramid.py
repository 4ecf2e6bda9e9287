"""OME-Zarr images and videos that are written a part at a time."""

import numpy as np
import pytest
import zarr
from ome_zarr_models.v05.image import Image

from napari_fiberburst.io.pyramid import coarsen, create_pyramid, write_frames, write_tile


def levels_of(path):
    group = zarr.open_group(path, mode="r")
    return [zarr.open_array(path / name, mode="r")[:] for name in sorted(group.array_keys())]


def validated(path):
    return Image.from_zarr(zarr.open_group(path, mode="r")).ome_attributes.multiscales[0]


@pytest.mark.parametrize("lead", [(), (3,)])
def test_a_mosaic_is_a_valid_image(tmp_path, rng, lead):
    shape = (*lead, 531, 700)
    create_pyramid(tmp_path / "a", shape, name="a", pixel_size=(0.5, 0.25), unit="micrometer")
    picture = rng.random(shape).astype(np.float32)
    write_tile(tmp_path / "a", (0, 512), (0, 700), picture[..., :512, :])
    write_tile(tmp_path / "a", (512, 531), (0, 700), picture[..., 512:, :])
    coarsen(tmp_path / "a")
    image = validated(tmp_path / "a")
    assert [axis.name for axis in image.axes] == ["c"] * len(lead) + ["y", "x"]
    assert image.datasets[1].coordinateTransformations[0].scale[-2:] == [1.0, 0.5]
    fine, half, quarter = levels_of(tmp_path / "a")
    np.testing.assert_array_equal(fine, picture)
    assert half.shape == (*lead, 266, 350)
    np.testing.assert_allclose(half[..., 3, 5], picture[..., 6:8, 10:12].mean(axis=(-2, -1)), rtol=1e-6)
    assert quarter.shape == (*lead, 133, 175)


@pytest.mark.parametrize("lead", [(), (3,)])
def test_a_video_is_a_valid_image_with_seconds(tmp_path, rng, lead):
    shape = (19, *lead, 61, 300)
    times = 2.0 + 0.04 * np.arange(19)
    create_pyramid(tmp_path / "a", shape, name="a", times=times, is_video=True)
    frames = rng.random(shape).astype(np.float32)
    frames[..., :2, 10] = np.nan
    write_frames(tmp_path / "a", 0, frames[:16])
    write_frames(tmp_path / "a", 16, frames[16:])
    image = validated(tmp_path / "a")
    assert [axis.name for axis in image.axes] == ["t", *["c"] * len(lead), "y", "x"]
    assert image.axes[0].unit == "second"
    for dataset in image.datasets:
        scale, translation = dataset.coordinateTransformations
        assert scale.scale[0] == pytest.approx(0.04)
        assert translation.translation[0] == pytest.approx(2.0)
    fine, half = levels_of(tmp_path / "a")
    np.testing.assert_array_equal(fine, frames)
    assert half.shape == (19, *lead, 31, 150)
    np.testing.assert_allclose(half[..., 0, 5], frames[..., :2, 11].mean(axis=-1), rtol=1e-6)


def test_a_video_without_times_claims_none(tmp_path):
    create_pyramid(tmp_path / "a", (5, 31, 43), name="a", is_video=True)
    assert validated(tmp_path / "a").axes[0].unit is None
