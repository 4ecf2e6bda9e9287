"""Where the cores of a frame are, in the order in which their values come."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Cores:
    """Where cores are.

    Attributes
    ----------
    x, y : numpy.ndarray
        (N,) float32, from the middle of the frame, pixels.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]

    @classmethod
    def of(cls, centres: NDArray[np.float64], shape: tuple[int, int]) -> Self:
        """Return cores by their centres (N, 2) in a frame (height, width)."""
        x, y = (centres - [(shape[1] - 1) / 2, (shape[0] - 1) / 2]).T.astype(np.float32)
        return cls(np.ascontiguousarray(x), np.ascontiguousarray(y))

    def every(self, step: int) -> Self:
        """Return every so many-th core."""
        return type(self)(np.ascontiguousarray(self.x[::step]), np.ascontiguousarray(self.y[::step]))
