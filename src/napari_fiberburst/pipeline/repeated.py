"""Frames of a burst that repeat another one, as recorders write where their camera is slower than they are.

A copy tells nothing new, and harms: its noise is in both halves of the burst, so that the noise passes for detail.
"""

from hashlib import blake2b

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.data.burst import Burst
from napari_fiberburst.io.doubled import are_doubled


def find_repeated(burst: Burst) -> NDArray[np.bool_]:
    """Return which frames (T,) have the pixels of one before them, or in 8 bits nearly those of the one just before.

    None of them where fewer than two frames would be left: an object that never moves is no fault of the recorder.
    """
    seen: set[bytes] = set()
    is_copy = np.zeros(len(burst.frames), dtype=bool)
    differences = np.zeros(len(burst.frames))
    levels = burst.white_level - burst.black_level
    for number, frame in enumerate(burst.frames):
        digest = blake2b(frame).digest()
        is_copy[number] = digest in seen
        seen.add(digest)
        if number > 0 and not is_copy[number]:
            change = np.sqrt(np.mean(np.square(frame - burst.frames[number - 1])))
            differences[number] = max(levels * float(change), np.finfo(float).tiny)
    is_copy |= are_doubled(differences, burst.dtype)
    return is_copy if (~is_copy).sum() >= 2 else np.zeros_like(is_copy)
