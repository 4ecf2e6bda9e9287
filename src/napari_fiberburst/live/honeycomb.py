"""Whether frames show the bundle that is looked through, and where: by the honeycomb in their raw pixels."""

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.live.peak import beyond

Floats = NDArray[np.float32]
Seen = Literal["this", "moved", "another", "unclear"]

# Pixels to a side of the middle of the frames that is looked at; it holds hundreds of cores.
_MOST_SIDE = 192
# In pitches: over this much slow changes are divided out; and the part of the usual light that a place has at least.
_ENVELOPE, _LEAST_LIGHT = 0.6, 0.05
# What differs from its surroundings by more than so many times what is usual is cut off: bright points are no cores.
_MOST_OF_USUAL = 3.0
# Pixels by which a bundle may have moved.
_REACH = 4
# Part of a frame's say that is left when the next one is looked at, and how many must say that all is not well.
_KEPT, _LEAST_FRAMES = 0.7, 3
# While all is well, one frame in so many is looked at.
_EVERY = 4
# Cores must show this part of full scale on average; in the dark there is noise alone.
_LEAST_MEAN = 0.01
# The honeycomb of frames in parts of the bundle's own: above the first this is the bundle. Below the second it is
# another one, if frames have at least so much contrast of that kind as the bundle has.
_IS_THIS, _IS_ANOTHER, _LEAST_CONTRAST = 0.4, 0.25, 0.6
# Pixels, and by how many times better the honeycomb then fits: less is no move.
_LEAST_MOVE, _BETTER = 0.7, 1.15


class Honeycomb:
    """Looks at frames now and then.

    Parameters
    ----------
    bundle : Bundle
        That frames are to show.

    Attributes
    ----------
    shift : (float, float)
        How far along x and y the bundle has moved, where it has, pixels.
    """

    def __init__(self, bundle: Bundle) -> None:
        self._pitch, self._black = bundle.pitch, bundle.black
        self._rows, self._columns = (_middle(side) for side in bundle.shape)
        self._padded = tuple(next_fast_len(side + _REACH, real=True) for side in self._part(bundle.transmission).shape)
        pattern = self._flat(self._part(bundle.transmission))
        self._contrast = float(pattern.std())
        self._spectrum = rfft2(pattern, s=self._padded).conj() / max(float((pattern**2).sum()), 1e-9)
        self.shift = (0.0, 0.0)
        self._told: Seen = "unclear"
        self._passed = 0
        self._forget()

    def watch(self, pixels: NDArray[Any], light: Floats, *, is_placed: bool) -> Seen:
        """Look at a frame where there is reason to, or its turn has come, and say what the last ones have shown.

        Parameters
        ----------
        pixels : numpy.ndarray
            (H, W) or (H, W, C).
        light : numpy.ndarray
            (N,), what its cores show, full scale 1.
        is_placed : bool
            Whether the frame could be placed.
        """
        self._passed += 1
        is_known = self._told == "this" or (self._told == "unclear" and self._count >= _LEAST_FRAMES)
        is_well = is_placed and is_known
        if light.mean() < _LEAST_MEAN or (is_well and self._passed < _EVERY):
            return self._told
        self._passed = 0
        if self._told == "this":
            # What was seen before does not count, so that a move is seen at once, and known to a part of a pixel.
            self._forget()
        told = self._look(pixels)
        self._told = told if told == "this" or self._count >= _LEAST_FRAMES else "unclear"
        return self._told

    def _forget(self) -> None:
        self._mean, self._spread, self._weight = np.zeros(self._padded, np.float32), 0.0, 0.0
        self._count = 0

    def _look(self, pixels: NDArray[Any]) -> Seen:
        """Look at a frame (H, W) or (H, W, C), and say what this and those before have shown, together."""
        part = self._part(pixels)
        grey = part.reshape(*part.shape[:2], -1).mean(axis=2, dtype=np.float32) - np.float32(self._black)
        flat = self._flat(np.nan_to_num(grey, posinf=0, neginf=0))
        score = irfft2(rfft2(flat, s=self._padded) * self._spectrum, s=self._padded)
        self._mean = np.asarray(_KEPT * self._mean + score, np.float32)
        self._spread = _KEPT * self._spread + float(flat.std())
        self._weight = _KEPT * self._weight + 1
        self._count += 1
        return self._verdict()

    def _verdict(self) -> Seen:
        near = np.roll(self._mean, (_REACH, _REACH), (0, 1))[: 2 * _REACH + 1, : 2 * _REACH + 1] / self._weight
        row, column = (int(at) for at in np.unravel_index(int(near.argmax()), near.shape))
        here, best = float(near[_REACH, _REACH]), float(near[row, column])
        self.shift = (
            column - _REACH + _peak(near[row], column),
            row - _REACH + _peak(near[:, column], row),
        )
        if best < _IS_ANOTHER and self._spread / self._weight > _LEAST_CONTRAST * self._contrast:
            return "another"
        if best < _IS_THIS:
            return "unclear"
        return "moved" if best > _BETTER * here and np.hypot(*self.shift) > _LEAST_MOVE else "this"

    def _part(self, image: NDArray[Any]) -> NDArray[Any]:
        return image[self._rows, self._columns]

    def _flat(self, image: Floats) -> Floats:
        """Return what an image has beside its slow changes, relative to these; bright points count for little."""
        slow = gaussian_filter(image, _ENVELOPE * self._pitch)
        floor = np.float32(_LEAST_LIGHT * max(float(slow.mean()), 1e-6))
        flat = np.where(slow > floor, image / np.maximum(slow, floor) - 1, np.float32(0))
        most = _MOST_OF_USUAL * float(np.median(np.abs(flat)))
        return np.asarray(np.clip(flat, -most, most), np.float32)


def _middle(side: int) -> slice:
    start = max(0, (side - _MOST_SIDE) // 2)
    return slice(start, min(side, start + _MOST_SIDE))


def _peak(line: Floats, place: int) -> float:
    """Return how far beyond the highest value of a line its peak is; at an end of the line that is not known."""
    return beyond(*map(float, line[place - 1 : place + 2])) if 0 < place < len(line) - 1 else 0.0
