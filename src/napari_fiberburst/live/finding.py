"""How far the newest frame lies from the last one, found coarsely."""

from math import ceil

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import uniform_filter
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from napari_fiberburst.live.peak import beyond

Floats = NDArray[np.float32]

# A cell of the small images, pitches, and over how many cells they are evened out.
_CELL, _EVENED = 0.8, 9
# Gaussian that they are smoothed by, cells.
_SMOOTHED = 0.7
# Frames must have this part of the field in common.
_LEAST_OVERLAP = 0.25


class Finder:
    """Finds how far one frame lies from another by small images of both.

    Parameters
    ----------
    positions : numpy.ndarray
        (N, 2) of the cores, pixels.
    shape : (int, int)
        Height and width of a frame.
    pitch : float
        Distance of neighbouring cores, pixels.
    """

    def __init__(self, positions: NDArray[np.float64], shape: tuple[int, int], pitch: float) -> None:
        self._cell = _CELL * pitch
        rows, columns = (int(np.ceil(side / self._cell)) for side in shape)
        y, x = np.indices((rows, columns))
        cells = (np.stack([x.ravel(), y.ravel()], axis=1) + 0.5) * self._cell - 0.5
        distance, number = cKDTree(positions).query(cells, k=3, distance_upper_bound=1.5 * pitch)
        near = np.isfinite(distance)
        weight = np.where(near, np.exp(-((np.where(near, distance, 0) / pitch) ** 2)), 0)
        weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-9)
        row, column = np.nonzero(near)
        entries = (weight[near].astype(np.float32), (row, np.asarray(number)[row, column]))
        self._read = csr_array(entries, shape=(len(cells), len(positions)))
        self._size = rows, columns
        self._known = near.any(axis=1).reshape(rows, columns).astype(np.float32)
        self._mass = np.maximum(uniform_filter(self._known, _EVENED), np.float32(1e-3))
        # Room for every shift with enough overlap.
        self._padded = tuple(int(next_fast_len(ceil((2 - _LEAST_OVERLAP) * side), real=True)) for side in self._size)
        mask = rfft2(self._known, s=self._padded)
        overlap = irfft2(mask.conj() * mask, s=self._padded) / max(float(self._known.sum()), 1.0)
        scale = np.where(overlap > _LEAST_OVERLAP, 1 / np.maximum(overlap, _LEAST_OVERLAP) ** 0.75, 0)
        self._scale = scale.astype(np.float32)
        along_y, along_x = np.fft.fftfreq(self._padded[0]), np.fft.rfftfreq(self._padded[1])
        power = (along_y[:, None] ** 2 + along_x**2) * (2 * np.pi * _SMOOTHED) ** 2
        self._smooth = np.exp(-power / 2).astype(np.float32)

    def spectrum(self, grey: Floats, weights: Floats) -> NDArray[np.complex64]:
        """Return the spectrum of the small image of a frame's light (N,), whose weights (N,) are 0 where unknown."""
        is_known = weights > 0
        if not is_known.all():  # holes stay in place while the object moves
            grey = np.where(is_known, grey, np.float32(grey[is_known].mean()))
        image: Floats = np.asarray(self._read @ grey, np.float32).reshape(self._size)
        image = np.asarray(image - uniform_filter(image, _EVENED) / self._mass, np.float32) * self._known
        spectrum: NDArray[np.complex64] = rfft2(image, s=self._padded) * self._smooth
        return spectrum

    def shift(self, first: NDArray[np.complex64], second: NDArray[np.complex64]) -> complex:
        """Return the shift (x + i y, pixels) that takes points of the second image to the first."""
        score = irfft2(second.conj() * first, s=self._padded) * self._scale
        place = divmod(int(score.argmax()), score.shape[1])
        y, x = (int(at) - (side if at > side // 2 else 0) for at, side in zip(place, self._padded, strict=True))
        finer = complex(_peak(score[place[0]], place[1]), _peak(score[:, place[1]], place[0]))
        return (complex(x, y) + finer) * self._cell


def _peak(line: Floats, place: int) -> float:
    """Return how far beyond the highest value of a line that closes on itself its peak is."""
    return beyond(*(float(line[at % len(line)]) for at in (place - 1, place, place + 1)))
