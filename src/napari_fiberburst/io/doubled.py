"""Frames that repeat the one before, as recorders write where their camera is slower than they are."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import percentile_filter

from napari_fiberburst.data.source import FrameSource

# A codec with loss writes a doubled frame nearly alike: frames of 8 bits that differ by less than a grey level (rms)
# and by less than this part of what frames near them usually differ by, which noise alone keeps above it.
_LEVEL, _OF_USUAL = 1.0, 0.1
# Usual is what a quarter of the differences exceeds among so many, so that up to three of four frames may be doubled.
_NEAR, _QUARTER = 41, 75
# Bytes of frames that are read at a time.
_AT_ONCE = 2**24


def find_doubled(source: FrameSource) -> NDArray[np.int64]:
    """Find the frames that repeat the one before, reading all frames once, a few at a time.

    A frame is doubled where all its pixels are those of the frame before. A frame of 8 bits, which a codec with loss
    may have changed, is doubled too where it differs from the frame before by less than one grey level (rms) and less
    than a tenth of what the frames around it differ by.

    A codec that writes most frames as changes of others may write a doubled frame anew, as a key frame, which is not
    found then; and of an object that stands still it may write no change at all, which is found as doubled.

    Parameters
    ----------
    source : FrameSource
        Of any length; it is never in memory as a whole.

    Returns
    -------
    numpy.ndarray
        (D,) numbers of the doubled frames.

    Raises
    ------
    BurstError
        A frame cannot be read.

    Examples
    --------
    >>> import numpy as np
    >>> from napari_fiberburst import open_recording
    >>> frames = np.random.default_rng(0).integers(0, 256, (5, 20, 30), np.uint8)
    >>> find_doubled(open_recording(frames[[0, 1, 1, 2, 3, 3]])).tolist()
    [2, 5]
    """
    differences = np.zeros(len(source))
    before = None
    for part in source.in_parts(_AT_ONCE):
        for number, frame in zip(part, source.recorded(part), strict=True):
            if before is not None and not np.array_equal(frame, before):
                difference = np.subtract(frame, before, dtype=np.float32)
                differences[number] = max(np.sqrt(np.mean(np.square(difference))), np.finfo(float).tiny)
            before = frame
    return np.flatnonzero(are_doubled(differences, source.acquisition.dtype))


def are_doubled(differences: NDArray[np.floating], dtype: np.dtype[Any]) -> NDArray[np.bool_]:
    """Return which frames (T,) are doubled, by how far each is from the one before it, root mean square, in levels."""
    doubled: NDArray[np.bool_] = differences == 0
    if dtype.itemsize == 1 and len(doubled) > 1:
        usual = percentile_filter(differences[1:], _QUARTER, size=_NEAR, mode="nearest")
        doubled[1:] |= (differences[1:] < _LEVEL) & (differences[1:] < _OF_USUAL * usual)
    doubled[0] = False
    return doubled
