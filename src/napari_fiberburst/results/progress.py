"""What a running fit reports."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.settings import Settings


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
        Latest mean squared error over the step's samples, intensities in [-1, 1], and the motion's prior if any; NaN
        while the bundle is calibrated, before anything is fitted.
    seconds : float
        Time since the run began its steps, pauses left out.
    rate : float
        Steps per second since the run's first step ended; 0 until the second step.
    homographies : numpy.ndarray
        (T, 3, 3) float64, frame-t pixel to frame-0 pixel, as of now.
    settings : Settings
        What the run goes on with: what was left open is chosen as far as it has come.
    remaining : float or None
        Seconds until the run ends, by its steps or its time budget; None while neither is known, 0 at the end.
    canvas : Canvas
        Where the preview lies in frame-0 pixels; a union of all frames grows with what is known of their motion.
    preview : numpy.ndarray or None
        The image as of now, in the burst's intensity units, (H, W) or (H, W, C) float32; None where this
        report has none.
    held_out_rmse : float or None
        Root mean square by which samples that were left out of the fit are missed, in the burst's intensity units;
        None while that is not known.
    """

    step: int
    iterations: int
    loss: float
    seconds: float
    rate: float
    remaining: float | None
    homographies: NDArray[np.float64]
    settings: Settings
    canvas: Canvas
    preview: NDArray[np.float32] | None = None
    held_out_rmse: float | None = None
