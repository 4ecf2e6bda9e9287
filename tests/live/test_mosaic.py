"""Live pictures pasted together, against the picture they were cut from."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from napari_fiberburst.live import mosaic as module
from napari_fiberburst.live.mosaic import LiveMosaic
from napari_fiberburst.live.view import LiveView


@pytest.fixture
def scene():
    return gaussian_filter(np.random.default_rng(2).normal(size=(300, 340)), 4.0) * 100 + 50


def seen(scene, homography, *, piece=0, state="following", shape=(61, 73)):
    """Return the view of a round field that lies so on the scene."""
    y, x = np.indices(shape)
    there = homography @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    image = map_coordinates(scene, there[[1, 0]], order=3).reshape(shape)
    image[np.hypot((y - 30) / 30, (x - 36) / 36) > 1] = np.nan
    return LiveView(image=image.astype(np.float32), homography=homography, state=state, advice="fine", piece=piece)


def at(x, y, turn=0.0):
    cos, sin = np.cos(turn), np.sin(turn)
    return np.array([[cos, -sin, x], [sin, cos, y], [0, 0, 1]])


def test_the_mosaic_is_the_scene_wherever_a_picture_was(scene):
    mosaic = LiveMosaic()
    for step in range(12):
        mosaic.add(seen(scene, at(40 + 13.3 * step, 150 - 7.7 * step, 0.02 * step)))
    image, (top, left) = mosaic.image[..., 0], mosaic.origin
    y, x = np.nonzero(np.isfinite(image))
    assert len(y) > 3 * 61 * 73 * np.pi / 4
    off = image[y, x] - scene[y + top, x + left]
    assert np.sqrt(np.mean(off**2)) < 0.03 * scene.std()


def test_newer_pictures_show_where_older_ones_were(scene):
    mosaic = LiveMosaic()
    for _ in range(20):
        mosaic.add(seen(scene, at(50, 60)))
    for _ in range(8):
        mosaic.add(seen(scene + 40, at(50, 60)))
    middle = mosaic.image[80 - mosaic.origin[0], 85 - mosaic.origin[1], 0]
    assert middle - scene[80, 85] > 30


def test_another_piece_begins_anew_and_what_could_not_be_placed_is_passed_over(scene):
    mosaic = LiveMosaic()
    mosaic.add(seen(scene, at(50, 60)))
    one = mosaic.image
    mosaic.add(seen(scene, at(200, 200), state="lost"))
    assert np.array_equal(mosaic.image, one, equal_nan=True)
    mosaic.add(seen(scene, at(0, 0), piece=1))
    image, (top, left) = mosaic.image[..., 0], mosaic.origin
    assert abs(image[30 - top, 36 - left] - scene[30, 36]) < 0.05 * scene.std()
    assert np.isfinite(image).sum() < 61 * 73


def test_beyond_its_room_nothing_is_pasted_and_it_says_so(scene, monkeypatch):
    monkeypatch.setattr(module, "MOST_PIXELS", 400 * 400)
    mosaic = LiveMosaic()
    mosaic.add(seen(scene, at(50, 60)))
    assert not mosaic.is_full
    there = np.isfinite(mosaic.image).sum()
    far = seen(scene, at(50, 60))
    mosaic.add(LiveView(image=far.image, homography=at(3000, 60), state="following", advice="fine"))
    assert mosaic.is_full
    assert np.isfinite(mosaic.image).sum() == there


def test_colours_are_pasted_alike(scene):
    view = seen(scene, at(50, 60))
    both = np.stack([view.image, 2 * view.image], axis=2)
    mosaic = LiveMosaic()
    mosaic.add(LiveView(image=both, homography=view.homography, state="following", advice="fine"))
    one, two = np.moveaxis(mosaic.image, 2, 0)
    known = np.isfinite(one)
    assert np.allclose(2 * one[known], two[known], rtol=1e-4)
