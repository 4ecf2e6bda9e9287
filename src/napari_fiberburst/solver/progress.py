"""What a running fit reports."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Progress:
    """One report of a running fit: plain numbers and numpy arrays, safe to keep and to hand to another thread.

    Attributes
    ----------
    step : int
        Steps done in this run.
    iterations : int
        Steps this run will do if nothing stops it.
    loss : float
        Latest mean squared error over the step's samples, intensities in [-1, 1], and the motion's prior if any.
    seconds : float
        Time spent in this run, pauses left out.
    rate : float
        Steps per second since the run's first step ended; 0 until the second step.
    homographies : numpy.ndarray
        (T, 3, 3) float64, frame-t pixel to frame-0 pixel, as of now.
    preview : numpy.ndarray or None
        The picture as of now, in the burst's intensity units, (H, W) or (H, W, C) float32; None where this
        report has none.
    """

    step: int
    iterations: int
    loss: float
    seconds: float
    rate: float
    homographies: NDArray[np.float64]
    preview: NDArray[np.float32] | None = None

    @property
    def remaining(self) -> float | None:
        """Seconds until the run ends at this rate; None while the rate is unknown."""
        return (self.iterations - self.step) / self.rate if self.rate > 0 else None
