"""A video file to look at, of an OME-Zarr video: 8 bits, at a contrast that shows it well."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import zarr
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.picture import as_picture, limits_of
from napari_fiberburst.io.pyav import import_av
from napari_fiberburst.io.results import check_place
from napari_fiberburst.io.video_writer import VIDEO_ENDINGS, write_video

# The contrast is told by so many frames, spread over the video.
_TOLD_BY = 24
# A scale bar is at most this part of the width, and this part of the height high, a bar's height from the corner.
_BAR_WIDTH, _BAR_HEIGHT = 0.25, 0.015


def check_movie(path: str | Path) -> Path:
    """Refuse a path that no video file can be written to, before long work rather than after it.

    Raises
    ------
    OutputError
        The ending is unknown, PyAV is missing, or the folder cannot be written.
    """
    target = Path(path)
    if target.suffix.lower() not in VIDEO_ENDINGS:
        raise OutputError(f"a video file ends in {', '.join(VIDEO_ENDINGS)}; got {target}")
    import_av(f"writing {target}", OutputError)
    check_place(target)
    return target


def write_movie(path: Path, target: Path, acquisition: Acquisition, *, scale_bar: bool) -> Path:
    """Write an OME-Zarr video as a video file.

    Parameters
    ----------
    path : Path
        The OME-Zarr video.
    target : Path
        Ending in one of `VIDEO_ENDINGS`.
    acquisition : Acquisition
        Of the recording that it was made of: its times and the size of a pixel.
    scale_bar : bool
        Whether to draw one, where the size of a pixel is known.
    """
    level = zarr.open_array(path / "0", mode="r")
    count, (height, width) = level.shape[0], level.shape[-2:]
    some = np.unique(np.linspace(0, count - 1, _TOLD_BY).astype(int)).tolist()
    limits = limits_of(np.stack([np.asarray(level[number]) for number in some]))
    channels = 3 if level.ndim == 4 and level.shape[1] == 3 else 1
    size = acquisition.pixel_size
    bar = _bar_of(size[1], width) if scale_bar and size is not None else 0
    known = replace(
        Acquisition.from_dict(acquisition.to_dict()),
        shape=(count, height, width, channels),
        axes="TYX" if channels == 1 else "TYXC",
        dtype=np.dtype(np.uint8),
        black_level=0.0,
        white_level=255.0,
        channel_names=(),
    )
    reader = _Frames(str(path), limits, bar)
    return write_video(FrameSource(acquisition=known, reader=reader, name=str(path), fingerprint=str(path)), target)


@dataclass(frozen=True, slots=True)
class _Frames:
    """Reads frames of an OME-Zarr video as pictures to look at; black where nothing is known.

    Attributes
    ----------
    path : str
        Of the video.
    limits : (float, float)
        What is shown black and white.
    bar : int
        Pixels of the scale bar; 0 for none.
    """

    path: str
    limits: tuple[float, float]
    bar: int

    def __call__(self, numbers: Sequence[int]) -> NDArray[np.uint8]:
        """Return frames (n, H, W, 1 or 3)."""
        level = zarr.open_array(Path(self.path) / "0", mode="r")
        return np.stack([self._drawn(np.asarray(level[number])) for number in numbers])

    def _drawn(self, frame: NDArray[np.float32]) -> NDArray[np.uint8]:
        image = frame if frame.ndim == 2 else np.moveaxis(frame, 0, -1)
        image = image.mean(axis=2) if image.ndim == 3 and image.shape[2] != 3 else image
        shown = as_picture(np.nan_to_num(image, nan=self.limits[0]), self.limits)
        if self.bar:
            shown = _with_bar(shown, self.bar)
        return shown if shown.ndim == 3 else shown[..., None]


def _bar_of(pixel: float, width: int) -> int:
    """Return the pixels of a scale bar: of 1, 2 or 5 times a power of ten, a quarter of the width at most."""
    most = _BAR_WIDTH * width * pixel
    power = 10.0 ** np.floor(np.log10(most))
    length = max(step * power for step in (1, 2, 5) if step * power <= most)
    return int(np.rint(length / pixel))


def _with_bar(shown: NDArray[np.uint8], bar: int) -> NDArray[np.uint8]:
    picture = Image.fromarray(shown)
    high = max(2, round(_BAR_HEIGHT * picture.height))
    right, bottom = picture.width - 3 * high, picture.height - 3 * high
    white = 255 if picture.mode == "L" else (255, 255, 255)
    ImageDraw.Draw(picture).rectangle((right - bar + 1, bottom - high + 1, right, bottom), fill=white)
    return np.asarray(picture)
