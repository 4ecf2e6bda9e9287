"""Fourier ring correlation of images whose shared detail ends at a known period."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from napari_fiberburst.quality import ring_correlation


def test_detail_that_is_shared_up_to_a_period_gives_that_resolution(rng):
    frequency = np.hypot(np.fft.fftfreq(181)[:, None], np.fft.fftfreq(203)[None, :])
    shared = np.fft.fft2(rng.normal(size=(181, 203))) * (frequency < 1 / 6)
    first, second = (np.fft.ifft2(shared).real + rng.normal(0, 0.1, (181, 203)) for _ in range(2))
    assert ring_correlation(first, second).resolution == pytest.approx(6, rel=0.1)


def test_an_image_agrees_with_itself_and_noise_with_nothing(rng):
    first, second = rng.normal(size=(2, 90, 70))
    assert ring_correlation(first, first).resolution == 2
    assert not ring_correlation(first, second).resolution < 20


def test_a_steep_spectrum_does_not_leak(rng):
    """Smooth images of independent noise share nothing at high frequencies, whatever the window lets through."""
    slope = np.linspace(0, 50, 120)[:, None] * np.ones(130)
    first, second = (slope + gaussian_filter(rng.normal(size=(120, 130)), 1) for _ in range(2))
    assert not ring_correlation(first, second).resolution < 10


def test_images_of_two_sizes_are_refused():
    with pytest.raises(ValueError, match="one shape"):
        ring_correlation(np.zeros((20, 30)), np.zeros((30, 20)))
