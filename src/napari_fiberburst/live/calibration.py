"""An engine without a bundle takes one from the first frames that differ."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.data.burst import Burst
from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.pipeline.reconstruct import reconstruct

# So many frames calibrate, spread over so many seconds at least where times are known: a fast camera's first twenty
# would hardly differ.
CALIBRATED_BY, _SECONDS = 20, 1.0


def frames_needed(rate: float) -> int:
    """Return how many frames go by until there is a bundle, at so many frames a second."""
    return max(CALIBRATED_BY, int(np.ceil(_SECONDS * rate)) + 1)


class Calibration:
    """Gathers frames until a bundle can be made of them, and tries again with as many more where it cannot.

    Parameters
    ----------
    black_level, white_level : float or None
        As `Burst` takes them.
    """

    def __init__(self, black_level: float | None, white_level: float | None) -> None:
        self._levels = black_level, white_level
        self._frames: list[NDArray[Any]] = []
        self._since = 0.0

    def take(self, pixels: NDArray[Any], seconds: float | None) -> Bundle | None:
        """Take in a frame (H, W) or (H, W, C) and when it was taken; return the bundle once there is one."""
        if seconds is not None:
            if not self._frames or seconds < self._since:  # clocks are set back
                self._frames, self._since = [], seconds
            if seconds - self._since < len(self._frames) * _SECONDS / (CALIBRATED_BY - 1) - 1e-6:
                return None
        self._frames.append(pixels.copy())
        if len(self._frames) < CALIBRATED_BY:
            return None
        black, white = self._levels
        frames, self._frames = np.stack(self._frames), []
        try:
            axes = "TYX" if frames.ndim == 3 else "TYXC"
            # The mean of the frames alone would hold the object for gain, and the frames still.
            return reconstruct(Burst(frames, axes=axes, black_level=black, white_level=white)).bundle
        except FiberBurstError:
            return None  # nothing to be seen yet: the next frames may show more
