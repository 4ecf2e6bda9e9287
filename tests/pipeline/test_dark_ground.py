"""Bright cells on a dark ground, as fluorescence shows them: most cores see nothing, and nothing is made up there."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from napari_fiberburst import reconstruct
from napari_fiberburst.bundle.mount import find_mount
from napari_fiberburst.bundle.placement import find_bundle
from napari_fiberburst.errors import BundleError
from napari_fiberburst.pipeline.reconstruct import as_bundle
from napari_fiberburst.quality import psnr
from napari_fiberburst.simulation import Scene, simulate

SHAPE = (141, 173)


def cells(count, seed):
    """Return a scene of round cells, dark between them."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((400, 440))
    image = np.zeros(y.shape)
    for _ in range(count):
        row, column, radius = rng.uniform(0, 400), rng.uniform(0, 440), rng.uniform(9, 18)
        image = np.maximum(image, rng.uniform(0.4, 1) * (np.hypot(y - row, x - column) < radius))
    return Scene(gaussian_filter(image, 1.5)[..., None].astype(np.float32), (130, 120))


def seen(seed, pitch=5.0):
    return simulate(cells(60, seed), shape=SHAPE, frames=12, channels=1, pitch=pitch, physics="core", seed=seed)


@pytest.fixture(scope="module")
def burst():
    return seen(1)


def test_what_is_dark_is_filled_in_with_black(burst):
    image = reconstruct(burst.burst, fill=True).image / 255
    dark = gaussian_filter(burst.truth[0, ..., 0], 3) < 0.002
    assert dark.mean() > 0.25
    # It is 0.02 to 0.5 where the scene goes on as it ends.
    assert np.quantile(np.abs(image[dark]), 0.99) < 0.02
    assert psnr(image[..., None], burst.truth[0]) > 26


def test_without_filling_the_dark_is_empty(burst):
    result = reconstruct(burst.burst, smoothness=0.1)
    assert np.isnan(result.image).any()
    np.testing.assert_array_equal(result.coverage[np.isnan(result.image)], 0)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_known_bundle_is_told_by_the_cores_that_are_lit(seed):
    made = seen(seed)
    grey = torch.from_numpy(made.burst.frames).mean(dim=3)
    bundle = as_bundle(made.transmission * 255.0).fitted_to(made.burst)
    assert np.hypot(*find_bundle(bundle, grey, made.burst).shift) < 0.2
    turned = as_bundle(made.transmission[::-1, ::-1] * 255.0).fitted_to(made.burst)
    with pytest.raises(BundleError, match="another bundle"):
        find_bundle(turned, grey, made.burst)


def test_cells_that_move_are_not_taken_for_the_bundle():
    assert find_mount(torch.from_numpy(seen(7, pitch=7.0).burst.frames).mean(dim=3)) is None
