"""Correlation over the overlap: shifts of crops of one world, which are known exactly."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from scipy.ndimage import shift as shift_image

from napari_fiberburst.motion.correlation import OverlapCorrelation

SHAPE = (41, 57)
# Pixels: what both see, at half of the frame, is not alike on both sides of the best shift.
NEAR = 0.1


@pytest.fixture
def world(rng):
    drawn = gaussian_filter(rng.normal(size=(160, 190)), 1.5)
    return (drawn / drawn.std()).astype(np.float32)


def crop(world, row, column):
    return torch.from_numpy(world[row : row + SHAPE[0], column : column + SHAPE[1]].copy())


def correlation(images, masks=None):
    everything = torch.ones(SHAPE, dtype=torch.bool)
    return OverlapCorrelation(lambda n: (images[n], everything if masks is None else masks[n]), SHAPE, kept=8)


def direct(first, second, shift):
    """Return the correlation coefficient of what both see, by definition."""
    x, y = shift
    rows, columns = SHAPE
    one = first[max(0, y) : rows + min(0, y), max(0, x) : columns + min(0, x)].double().numpy()
    other = second[max(0, -y) : rows - max(0, y), max(0, -x) : columns - max(0, x)].double().numpy()
    return np.corrcoef(one.ravel(), other.ravel())[0, 1]


@pytest.mark.parametrize("shift", [(0, 0), (13, -7), (-21, 4), (5, 19), (-30, -2)])
def test_shift_of_what_both_see(world, shift):
    x, y = shift
    images = [crop(world, 60, 60), crop(world, 60 + y, 60 + x)]
    assert direct(*images, shift) == pytest.approx(1)
    found, score = correlation(images).best(0, 1)
    np.testing.assert_allclose(found, shift, atol=NEAR)
    back, _ = correlation(images).best(1, 0)
    np.testing.assert_allclose(back, -found, atol=1e-3)
    assert 0.8 < score <= 1


@pytest.mark.parametrize("part", [(0.3, -0.4), (-0.5, 0.2)])
def test_shifts_are_found_to_a_part_of_a_pixel(world, part):
    x, y = part
    moved = torch.from_numpy(shift_image(world, (-y, -x), order=5))
    images = [crop(world, 60, 60), moved[66 : 66 + SHAPE[0], 55 : 55 + SHAPE[1]]]
    found, _ = correlation(images).best(0, 1)
    np.testing.assert_allclose(found, [x - 5, y + 6], atol=0.1)


def test_brightness_and_contrast_do_not_matter(world):
    images = [crop(world, 60, 60), 0.2 * crop(world, 53, 71) + 40]
    found, score = correlation(images).best(0, 1)
    np.testing.assert_allclose(found, [11, -7], atol=NEAR)
    assert score > 0.8


def test_score_follows_the_correlation_coefficient_of_noisy_images(world, rng):
    clean = [crop(world, 60, 60), crop(world, 55, 67)]
    scores, coefficients = [], []
    for noise in (0.3, 0.6, 1.0):
        images = [image + noise * torch.from_numpy(rng.normal(size=SHAPE).astype(np.float32)) for image in clean]
        found, score = correlation(images).best(0, 1)
        np.testing.assert_allclose(found, [7, -5], atol=NEAR)
        scores.append(score)
        coefficients.append(direct(*images, (7, -5)))
    # The overlap makes it a little less, and so does what steadies it.
    ratio = np.array(scores) / coefficients
    np.testing.assert_allclose(ratio, ratio[0], rtol=0.02)
    assert 0.9 < ratio[0] <= 1


def test_what_is_masked_has_no_part(world, rng):
    rows, columns = np.indices(SHAPE)
    circle = torch.from_numpy((rows - 20) ** 2 + (columns - 28) ** 2 < 19**2)
    images = [crop(world, 60, 60), crop(world, 56, 66)]
    clean = correlation(images, [circle, circle]).best(0, 1)
    # The same mark at the same place of both frames, as a vendor's logo is: brighter than all else.
    mark = torch.from_numpy(50 + 20 * rng.normal(size=SHAPE).astype(np.float32))
    marked = [torch.where(circle, image, mark) for image in images]
    found, score = correlation(marked, [circle, circle]).best(0, 1)
    np.testing.assert_allclose(found, [6, -4], atol=NEAR)
    assert score == pytest.approx(clean[1], rel=1e-3)
    np.testing.assert_allclose(
        correlation(marked).best(0, 1)[0], [0, 0], atol=NEAR
    )  # without the masks, the mark stands still


def test_masks_that_differ(world):
    masks = [torch.ones(SHAPE, dtype=torch.bool) for _ in range(2)]
    masks[0][:, :20], masks[1][28:] = False, False
    images = [crop(world, 60, 60), crop(world, 64, 55)]
    images = [torch.where(mask, image, 9.0) for image, mask in zip(images, masks, strict=True)]
    np.testing.assert_allclose(correlation(images, masks).best(0, 1)[0], [-5, 4], atol=NEAR)


def test_near_looks_no_farther(world):
    images = [crop(world, 60, 60), crop(world, 60, 72)]
    free = correlation(images)
    near, score = free.best(0, 1, (np.array([0.0, 3.0]), 5.0))
    assert np.hypot(*(near - [0, 3])) <= 5
    assert score < free.best(0, 1)[1]
    np.testing.assert_allclose(free.best(0, 1, (np.array([10.0, 1.0]), 5.0))[0], [12, 0], atol=NEAR)


def test_different_places_and_empty_images_score_low(world):
    images = [crop(world, 0, 0), crop(world, 90, 120), torch.zeros(SHAPE)]
    assert correlation(images).best(0, 1)[1] < 0.6
    assert correlation(images).best(0, 2)[1] == pytest.approx(0, abs=1e-3)
    nothing = [torch.ones(SHAPE, dtype=torch.bool), torch.zeros(SHAPE, dtype=torch.bool)]
    assert correlation(images, nothing).best(0, 1)[1] == 0
