"""Open a burst from whatever it lies in."""

import math
from pathlib import Path

from napari_fiberburst.data.burst import Burst
from napari_fiberburst.errors import BurstError
from napari_fiberburst.io.archive import ARCHIVE_ENDINGS as ARCHIVE_ENDINGS
from napari_fiberburst.io.frames import chosen_frames
from napari_fiberburst.io.sources import about, open_unread

# A video of more frames is a recording that a burst is to be chosen from.
_MOST_UNASKED = 200
# Values of a burst, all of which is in memory: 8 GiB as float32, or 20 frames of 100 million pixels.
_MOST_VALUES = 2**31


def read_burst(
    path: str | Path,
    *,
    axes: str | None = None,
    black_level: float | None = None,
    white_level: float | None = None,
    frames: str | slice | None = None,
) -> Burst:
    """Read a burst from a file, a folder or a pattern.

    Parameters
    ----------
    path : str or Path
        A multi-page TIFF or OME-TIFF; a folder of PNG or TIFF frames, or a pattern such as ``frames/*.png``, taken in
        natural order (2 before 10); a ``.burst`` file of a simulated burst, or a ``.npz`` file with only one
        array, or with an array "frames" (and, where they are known, "axes", "black_level" and "white_level"); an
        OME-Zarr image (needs the extra ``zarr``); a video (needs the extra ``recordings``).
    axes : str, optional
        Order of the axes, where the file does not say it or is wrong.
    black_level, white_level : float, optional
        As in `Burst`.
    frames : str or slice, optional
        The frames that are the burst, as Python slices: "100:120", "100:200:5", "-20:". No others are read. All by
        default, of a video at most 200.

    Returns
    -------
    Burst
        With channel names, pixel size, unit and frame times where the file has them.

    Raises
    ------
    BurstError
        There is nothing at the path, it cannot be read, or its frames are no burst, or more than 8 GiB of one.
    """
    with about(path):
        unread = open_unread(path, axes)
        numbers = chosen_frames(frames, unread.shape[0], unread.name)
        if frames is None and unread.is_video and len(numbers) > _MOST_UNASKED:
            raise BurstError(
                f"{path} has {len(numbers)} frames, which is a recording rather than a burst; choose some 20 of them "
                f'by frames="0:20" (--frames 0:20); fiberburst info {path} offers some that suit'
            )
        values = len(numbers) * math.prod(unread.shape[1:])
        if values > _MOST_VALUES:
            raise BurstError(
                f"{len(numbers)} frames of {path} take {4 * values / 2**30:.0f} GiB of memory, expected "
                f'{4 * _MOST_VALUES / 2**30:.0f} at most; choose fewer of them by frames="0:20" (--frames 0:20)'
            )
        pixels = unread.reader(numbers)
        known = dict(unread.metadata)
        if "times" in known:
            known["times"] = known["times"][list(numbers)]
        black, white = unread.levels
        return Burst(
            pixels if "C" in unread.axes else pixels[..., 0],
            axes=unread.axes,
            black_level=black if black_level is None else black_level,
            white_level=white if white_level is None else white_level,
            **known,
        )
