"""Bright cells on a dark ground, as fluorescence shows them: most cores see nothing, and nothing is made up there."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from napari_fiberburst import reconstruct
from napari_fiberburst.bundle.field import find_field
from napari_fiberburst.bundle.mount import find_mount
from napari_fiberburst.bundle.pitch import find_pitch
from napari_fiberburst.bundle.placement import find_bundle
from napari_fiberburst.errors import BundleError
from napari_fiberburst.pipeline.reconstruct import as_bundle
from napari_fiberburst.quality import psnr
from napari_fiberburst.simulation import simulate

SHAPE = (141, 173)


def seen(seed, pitch=5.0):
    return simulate("cells", shape=SHAPE, frames=12, channels=1, pitch=pitch, physics="core", seed=seed)


@pytest.mark.parametrize("seed", [3, 6])
def test_what_is_dark_is_filled_in_with_black(seed):
    made = seen(seed)
    result = reconstruct(made.burst, fill=True)
    image = result.image / 255
    dark = gaussian_filter(made.truth[0, ..., 0], 3) < 0.01
    assert dark.mean() > 0.4
    # It is 0.14 to 0.18 where the scene goes on as it ends.
    assert np.quantile(np.abs(image[dark]), 0.99) < 0.02
    assert psnr(image[..., None], made.truth[0]) > 31
    assert result.quality == "good"


def test_without_filling_the_dark_is_empty():
    result = reconstruct(seen(1).burst, smoothness=0.1)
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


@pytest.mark.parametrize("seed", [2, 6, 12])
def test_cells_that_stand_apart_belong_to_the_field(seed):
    grey = torch.from_numpy(seen(seed).burst.frames).mean(dim=3)
    assert find_field(grey, find_pitch(grey.mean(dim=0))).all()
