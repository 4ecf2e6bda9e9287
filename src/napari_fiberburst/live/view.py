"""What a live engine says after each frame."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

State = Literal["calibrating", "following", "lost", "frozen"]
Advice = Literal[
    "fine",
    "wait",
    "move a little",
    "hold still",
    "too fast",
    "out of contact",
    "too bright",
    "another bundle",
    "the bundle has moved",
    "the camera has stopped",
]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LiveView:
    """The picture after a frame, and what to make of it.

    Attributes
    ----------
    image : numpy.ndarray
        (H, W) or (H, W, C) float32 in the camera's intensities, over the pixels of the newest frame that could be
        placed; NaN beyond the bundle. While the engine calibrates itself, the newest frame, blurred so that it shows no
        honeycomb.
    homography : numpy.ndarray
        (3, 3) float64: pixel (x, y) of that frame to pixel of the first one; of the first one since contact was found
        elsewhere, or the recording was cut.
    state : str
        "calibrating"; "following": this frame is in the picture; "lost": it is not, because it could not be placed;
        "frozen": it is the same as the one before.
    advice : str
        What to do.
    piece : int
        How many times the scene was begun anew.
    alike : float
        Correlation of what the cores show with the scene, 0 to 1.
    brightness : float
        Of this frame, relative to the scene.
    speed : float
        Pixels that the probe has gone since the frame before.
    covered : float
        Part of the field's pixels that cores have looked at of late, 0 to 1.
    half_life : float
        Frames after which one counts half as much in the picture.
    seconds : float or None
        When the newest frame was taken, as it was pushed.
    """

    image: NDArray[np.float32]
    homography: NDArray[np.float64]
    state: State
    advice: Advice
    piece: int = 0
    alike: float = 0.0
    brightness: float = 1.0
    speed: float = 0.0
    covered: float = 0.0
    half_life: float = 0.0
    seconds: float | None = None
