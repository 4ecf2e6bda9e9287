"""Resolution by Fourier ring correlation (Saxton & Baumeister, 1982): to what period two images agree."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import laplace

# The correlation below which detail is noise (Rosenthal & Henderson, 2003).
THRESHOLD = 1 / 7


@dataclass(frozen=True, slots=True, eq=False)
class RingSpectra:
    """Spectra of two images of one object, averaged over rings of equal frequency.

    Attributes
    ----------
    frequency : numpy.ndarray
        (F,) cycles per pixel, up to one half.
    count : numpy.ndarray
        (F,) frequencies of an image's Fourier transform in a ring.
    cross : numpy.ndarray
        (F,) the real part of the cross spectrum: the power of what both show, where the rest of them is independent.
    powers : tuple of numpy.ndarray
        (F,) of either image.
    """

    frequency: NDArray[np.float64]
    count: NDArray[np.float64]
    cross: NDArray[np.float64]
    powers: tuple[NDArray[np.float64], NDArray[np.float64]]

    @property
    def noise(self) -> NDArray[np.float64]:
        """The power of what is in one image alone, (F,): half of that of their difference."""
        return sum(self.powers) / 2 - self.cross


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

    def in_pixels(self, size: float) -> "RingCorrelation":
        """Return the same in pixels of another size, of which one of the images' takes `size`."""
        return RingCorrelation(self.frequency / size, self.correlation, self.resolution * size)


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
    return correlation_of(ring_spectra(first, second, weight))


def correlation_of(spectra: RingSpectra) -> RingCorrelation:
    """Return the agreement of two images from their spectra."""
    first, second = spectra.powers
    correlation = spectra.cross / np.sqrt(np.maximum(first * second, np.finfo(float).tiny))
    return RingCorrelation(spectra.frequency, correlation, _first_crossing(spectra.frequency, correlation))


def ring_spectra(
    first: NDArray[np.floating], second: NDArray[np.floating], weight: NDArray[np.floating] | None = None
) -> RingSpectra:
    """Return the spectra of two images of one object over rings; parameters and errors as of `ring_correlation`."""
    if first.shape != second.shape or first.ndim != 2:
        raise ValueError(f"expected two images (H, W) of one shape; got {first.shape} and {second.shape}")
    height, width = first.shape
    window = np.hanning(height)[:, None] * np.hanning(width)[None, :]
    window = window if weight is None else window * weight
    # The Laplacian flattens spectra, whose low frequencies would leak through the window into the high ones.
    spectra = [np.fft.fft2(laplace(image.astype(np.float64), mode="nearest") * window) for image in (first, second)]
    along_y, along_x = np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None, :]
    flattened = (4 * np.sin(np.pi * along_y) ** 2 + 4 * np.sin(np.pi * along_x) ** 2) ** 2 * np.sum(window**2)
    passed = np.divide(1.0, flattened, out=np.zeros_like(flattened), where=flattened > 0)
    rings = max(4, min(height, width) // 4)
    number = np.minimum((np.hypot(along_y, along_x) * 2 * rings).astype(int), rings)
    count = np.bincount(number.ravel(), minlength=rings + 1)[:rings].astype(float)

    def mean(part: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.bincount(number.ravel(), (part * passed).ravel(), rings + 1)[:rings] / np.maximum(count, 1)

    return RingSpectra(
        frequency=(np.arange(rings) + 0.5) / (2 * rings),
        count=count,
        cross=mean((spectra[0] * spectra[1].conj()).real),
        powers=(mean(np.abs(spectra[0]) ** 2), mean(np.abs(spectra[1]) ** 2)),
    )


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
