"""Resolution by Fourier ring correlation (Saxton & Baumeister, 1982): to what period two images agree."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import laplace

# The correlation below which detail is noise (Rosenthal & Henderson, 2003).
THRESHOLD = 1 / 7


@dataclass(frozen=True, slots=True, eq=False)
class RingCorrelation:
    """Agreement of two images, frequency by frequency.

    Attributes
    ----------
    frequency : numpy.ndarray
        (F,) cycles per pixel, up to one half.
    correlation : numpy.ndarray
        (F,) from -1 to 1.
    resolution : float
        Pixels, the period at which the correlation first falls below one seventh; 2 where it never does; NaN where
        it is below from the start.
    """

    frequency: NDArray[np.float64]
    correlation: NDArray[np.float64]
    resolution: float


def ring_correlation(
    first: NDArray[np.floating], second: NDArray[np.floating], weight: NDArray[np.floating] | None = None
) -> RingCorrelation:
    """Correlate two images of one object, made from independent data, over rings of their spectra.

    Parameters
    ----------
    first, second : numpy.ndarray
        (H, W).
    weight : numpy.ndarray, optional
        (H, W) how much each place counts; it should fall off softly.

    Raises
    ------
    ValueError
        The images differ in shape.
    """
    if first.shape != second.shape or first.ndim != 2:
        raise ValueError(f"expected two images (H, W) of one shape; got {first.shape} and {second.shape}")
    height, width = first.shape
    window = np.hanning(height)[:, None] * np.hanning(width)[None, :]
    window = window if weight is None else window * weight
    # Filtering both leaves their correlation as it is. The Laplacian flattens their spectra, whose low frequencies
    # would leak through the window into the high ones.
    spectra = [np.fft.fft2(laplace(image.astype(np.float64), mode="nearest") * window) for image in (first, second)]
    radius = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None, :])
    rings = max(4, min(height, width) // 4)
    number = np.minimum((radius * 2 * rings).astype(int), rings)
    cross, power, power_second = (
        np.bincount(number.ravel(), part.ravel(), rings + 1)[:rings]
        for part in (
            (spectra[0] * spectra[1].conj()).real,
            np.abs(spectra[0]) ** 2,
            np.abs(spectra[1]) ** 2,
        )
    )
    correlation = cross / np.sqrt(np.maximum(power * power_second, np.finfo(float).tiny))
    frequency = (np.arange(rings) + 0.5) / (2 * rings)
    return RingCorrelation(frequency, correlation, _first_crossing(frequency, correlation))


def _first_crossing(frequency: NDArray[np.float64], correlation: NDArray[np.float64]) -> float:
    below = np.flatnonzero(correlation < THRESHOLD)
    if below.size == 0:
        return 2.0
    index = int(below[0])
    if index == 0:
        return float("nan")
    before, after = correlation[index - 1], correlation[index]
    part = (before - THRESHOLD) / (before - after)
    return float(1 / (frequency[index - 1] + part * (frequency[index] - frequency[index - 1])))
