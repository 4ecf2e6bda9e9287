"""Frames of a burst that repeat another one, as recorders write where their camera is slower than they are.

A copy tells nothing new, and harms: its noise is in both halves of the burst, so that the noise passes for detail.
"""

from hashlib import blake2b

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.data.burst import Burst
from napari_fiberburst.io.doubled import are_doubled


def find_repeated(burst: Burst) -> NDArray[np.int64]:
    """Return frames that repeat another one, and that one, (K, 2): the first of those that are alike.

    Their pixels are those of one before them, or in 8 bits nearly those of the one just before. None where fewer than
    two frames would be left: an object that never moves is no fault of the recorder.
    """
    first: dict[bytes, int] = {}
    original = np.arange(len(burst.frames))
    differences = np.zeros(len(burst.frames))
    levels = burst.white_level - burst.black_level
    for number, frame in enumerate(burst.frames):
        original[number] = first.setdefault(blake2b(frame).digest(), number)
        if number > 0 and original[number] == number:
            change = np.sqrt(np.mean(np.square(frame - burst.frames[number - 1])))
            differences[number] = max(levels * float(change), np.finfo(float).tiny)
    for number in np.flatnonzero(are_doubled(differences, burst.dtype)).tolist():
        if original[number] == number:
            original[number] = original[number - 1]
    copies = np.flatnonzero(original != np.arange(len(original)))
    if len(original) - len(copies) < 2:
        copies = copies[:0]
    return np.stack([copies, original[copies]], axis=1)
