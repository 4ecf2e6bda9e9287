"""What numbers a camera gives without light and at most, while its frames come in."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.data.burst import choose_levels


@dataclass(frozen=True, slots=True)
class Levels:
    """Intensities that stand at 0 and 1.

    Attributes
    ----------
    black, white : float
        Intensities.
    """

    black: float
    white: float

    @classmethod
    def of(cls, frames: NDArray[Any], black: float | None, white: float | None) -> "Levels":
        """Return the levels of frames: those that are given, or else by their type and values.

        Raises
        ------
        BurstError
            Those given are no levels.
        """
        finite = frames[np.isfinite(frames)] if frames.dtype.kind == "f" else frames
        low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
        return cls(*choose_levels(frames.dtype, low, high, black, white))

    @property
    def span(self) -> float:
        """From black to white."""
        return self.white - self.black
