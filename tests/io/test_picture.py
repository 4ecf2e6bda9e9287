"""Pictures of images: their contrast, and what is seen through."""

import numpy as np
from PIL import Image

from napari_fiberburst.io.picture import as_picture, write_png


def test_the_darkest_thousandth_is_black_and_the_brightest_white(rng):
    image = rng.permutation(np.linspace(100, 300, 100 * 101)).reshape(100, 101)
    image[3, 5] = 9000  # a hot pixel does not make the rest dark
    picture = as_picture(image)
    assert picture.dtype == np.uint8
    assert picture.shape == (100, 101)
    middle = (image > 199) & (image < 201)
    np.testing.assert_allclose(picture[middle], 127.5, atol=2)
    assert 5 < (picture == 0).sum() < 50
    assert 5 < (picture == 255).sum() < 50


def test_colours_keep_their_balance():
    image = np.zeros((16, 17, 3))
    image[..., 0] = np.linspace(0, 200, 17)
    image[..., 1] = image[..., 0] / 2
    picture = as_picture(image, limits=(0, 200))
    np.testing.assert_allclose(picture[..., 1], picture[..., 0] / 2, atol=1)
    assert not picture[..., 2].any()


def test_what_is_not_known_is_seen_through(tmp_path):
    for shape, mode in (((16, 17), "LA"), ((16, 17, 3), "RGBA")):
        image = np.full(shape, 5.0)
        image[:4] = np.nan
        with Image.open(write_png(tmp_path / "a.png", as_picture(image))) as picture:
            assert picture.mode == mode
            alpha = np.asarray(picture)[..., -1]
        assert not alpha[:4].any()
        assert (alpha[4:] == 255).all()


def test_channels_that_are_no_colours_are_shown_as_their_mean(rng):
    image = rng.random((16, 17, 5))
    np.testing.assert_array_equal(as_picture(image), as_picture(image.mean(axis=2)))


def test_an_image_without_any_contrast_or_any_value_is_a_picture():
    assert as_picture(np.full((3, 4), 7.0)).shape == (3, 4)
    assert as_picture(np.full((3, 4), np.nan)).shape == (3, 4, 2)
