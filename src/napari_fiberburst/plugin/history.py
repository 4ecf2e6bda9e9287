"""The images that a run has shown, to go back through."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.data.canvas import Canvas

_MOST_BYTES = 128 * 2**20


@dataclass(frozen=True, eq=False)
class HistoryEntry:
    """The image of a run at one time.

    Attributes
    ----------
    seconds : float
        Since the run's first step.
    image : numpy.ndarray
        (H, W) or (H, W, C) float32 in intensity units.
    canvas : Canvas
        Where it lies.
    """

    seconds: float
    image: NDArray[np.float32]
    canvas: Canvas


class History:
    """Keeps the first image, the newest, and as many between as memory allows, evenly.

    Parameters
    ----------
    most_bytes : int
        Of all images together.
    """

    def __init__(self, most_bytes: int = _MOST_BYTES) -> None:
        self._most = most_bytes
        self._every, self._offered = 1, 0
        self._kept: list[tuple[int, HistoryEntry]] = []

    @property
    def entries(self) -> list[HistoryEntry]:
        """The images kept, oldest first."""
        return [entry for _, entry in self._kept]

    def add(self, entry: HistoryEntry) -> None:
        """Keep an image; where memory is full, every second one is let go, now and from now on."""
        if self._kept and self._kept[-1][0] % self._every:
            self._kept.pop()  # it was there as the newest alone
        self._kept.append((self._offered, entry))
        self._offered += 1
        while len(self._kept) > 2 and sum(kept.image.nbytes for _, kept in self._kept) > self._most:
            self._every *= 2
            *older, newest = self._kept
            self._kept = [*(item for item in older if item[0] % self._every == 0), newest]
