"""The layers of a run by themselves, in a viewer without a window."""

import numpy as np
import pytest
from napari.components import ViewerModel
from napari.layers import Image

from napari_fiberburst.data.burst import Burst
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.io.picture import limits_of
from napari_fiberburst.plugin.layers import RunLayers
from napari_fiberburst.plugin.placement import Placement

CANVAS = Canvas.over((0, 0, 37, 31))


def layers_over(burst_layer, axes):
    """Return the layers of a run over a burst's layer, and the burst's acquisition."""
    viewer = ViewerModel()
    placement = Placement.of([burst_layer], axes, (0, 0))
    return RunLayers(viewer, "run 1", placement, {}), Burst(burst_layer.data, axes=axes).acquisition


@pytest.mark.parametrize(("colours", "axes"), [((), "TYX"), ((3,), "TYXC")])
def test_an_image_that_began_nearly_even_is_seen_when_it_resolves(rng, colours, axes):
    """A network's first preview is nearly even: contrast that was guessed from it would show all else as black."""
    frames = rng.random((5, 31, 37, *colours), dtype=np.float32)
    layers, acquisition = layers_over(Image(frames, rgb=bool(colours)), axes)
    resolved = 0.4 * rng.random((31, 37, *colours), dtype=np.float32)
    layers.show_image(np.float32(0.7) + np.float32(0.01) * resolved, acquisition, CANVAS)
    layers.show_image(resolved, acquisition, CANVAS)
    (shown,) = layers.images
    low, high = shown.contrast_limits
    assert low <= 0.01
    assert 0.39 <= high <= 1
    assert shown.contrast_limits_range[0] <= low
    assert shown.contrast_limits_range[1] >= high


def test_contrast_that_a_user_has_set_stays(rng):
    layers, acquisition = layers_over(Image(rng.random((5, 31, 37), dtype=np.float32)), "TYX")
    layers.show_image(rng.random((31, 37), dtype=np.float32), acquisition, CANVAS)
    (shown,) = layers.images
    shown.contrast_limits = (0.25, 0.5)
    layers.show_image(3 * rng.random((31, 37), dtype=np.float32), acquisition, CANVAS)
    assert tuple(shown.contrast_limits) == (0.25, 0.5)


@pytest.mark.parametrize("nothing", [np.nan, 0.0, 0.5])
def test_an_image_without_contrast_is_shown_and_the_next_one_seen(rng, nothing):
    """Limits that are alike are refused by napari."""
    layers, acquisition = layers_over(Image(rng.random((5, 31, 37), dtype=np.float32)), "TYX")
    even = np.full((31, 37), nothing, np.float32)
    resolved = 0.1 * rng.random((31, 37), dtype=np.float32)
    for image in (even, resolved, even, resolved):
        layers.show_image(image, acquisition, CANVAS)
        (shown,) = layers.images
        assert shown.contrast_limits[0] < shown.contrast_limits[1]
        np.testing.assert_array_equal(shown.data, image)
    assert tuple(shown.contrast_limits) == pytest.approx((0, 0.1), abs=0.002)


def test_a_layer_shows_what_a_picture_of_the_same_image_shows(rng):
    layers, acquisition = layers_over(Image(rng.random((5, 31, 37), dtype=np.float32)), "TYX")
    image = rng.random((31, 37), dtype=np.float32)
    image[3, 4], image[5, 6] = 1e6, np.nan
    layers.show_image(image, acquisition, CANVAS)
    assert tuple(layers.images[0].contrast_limits) == limits_of(image)
