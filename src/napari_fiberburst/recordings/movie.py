"""A video file to look at, of any stack: 8 bits, at a contrast that shows it well."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import OutputError
from napari_fiberburst.io import open_recording
from napari_fiberburst.io.picture import as_picture, limits_of
from napari_fiberburst.io.pyav import import_av
from napari_fiberburst.io.results import check_free, check_place
from napari_fiberburst.io.video_writer import VIDEO_ENDINGS, write_video

# The contrast is told by so many frames, spread over the video.
_TOLD_BY = 24
# A scale bar is at most this part of the width, and this part of the height high, a bar's height from the corner.
_BAR_WIDTH, _BAR_HEIGHT = 0.25, 0.015


def check_movie(path: str | Path, *, may_replace: bool = False) -> Path:
    """Refuse a path that no video file can be written to, before long work rather than after it.

    Parameters
    ----------
    path : str or Path
        Where to write.
    may_replace : bool
        Whether a file that is there may be replaced.

    Raises
    ------
    OutputError
        The ending is unknown, PyAV is missing, the folder cannot be written, or the file is there and must not be
        replaced.
    """
    target = Path(path)
    if target.suffix.lower() not in VIDEO_ENDINGS:
        raise OutputError(f"a video file ends in {', '.join(VIDEO_ENDINGS)}; got {target}")
    import_av(f"writing {target}", OutputError)
    check_place(target)
    if not may_replace:
        check_free(target)
    return target


def film_source(path: Path, acquisition: Acquisition) -> FrameSource:
    """Return the frames of an OME-Zarr video, at the exact times of the recording that it was made of."""
    source = open_recording(path, black_level=0, white_level=1)  # no level is looked for: frames may be NaN
    known = Acquisition.from_dict(source.acquisition.to_dict())
    return replace(source, acquisition=replace(known, times=acquisition.times))


def write_movie(
    source: FrameSource,
    target: Path,
    *,
    scale_bar: bool,
    limits: tuple[float, float] | None = None,
    on_frame: Callable[[], object] = lambda: None,
) -> Path:
    """Write a stack as a video file; one that is there is replaced.

    Parameters
    ----------
    source : FrameSource
        Any that `open_recording` opens, (T, H, W, C). NaN is shown black.
    target : Path
        Ending in one of `VIDEO_ENDINGS`.
    scale_bar : bool
        Whether to draw one, where the size of a pixel is known.
    limits : (float, float), optional
        What is shown black and white, as recorded; by default as some frames of the stack tell.
    on_frame : callable, optional
        Called after each frame; what it raises ends the writing, and no file is left.

    Raises
    ------
    OutputError
        There is one frame alone, or the file cannot be written.
    """
    count, height, width, channels = source.shape
    if count < 2:
        raise OutputError(f"{source.name} has one frame; a film needs a time axis of two or more")
    if limits is None:
        some = np.unique(np.linspace(0, count - 1, _TOLD_BY).astype(int)).tolist()
        limits = limits_of(source.recorded(some).astype(np.float32))
    size = source.acquisition.pixel_size
    known = replace(
        Acquisition.from_dict(source.acquisition.to_dict()),
        shape=(count, height, width, 3 if channels == 3 else 1),
        axes="TYXC" if channels == 3 else "TYX",
        dtype=np.dtype(np.uint8),
        black_level=0.0,
        white_level=255.0,
        channel_names=(),
    )
    bar = _bar_of(size[1], width) if scale_bar and size is not None else 0
    shown = replace(source, acquisition=known, reader=_Frames(source, limits, bar))
    return write_video(shown, target, on_frame=on_frame)


@dataclass(frozen=True, slots=True)
class _Frames:
    """Reads frames of a stack as pictures to look at; black where nothing is known.

    Attributes
    ----------
    source : FrameSource
        The stack.
    limits : (float, float)
        What is shown black and white.
    bar : int
        Pixels of the scale bar; 0 for none.
    """

    source: FrameSource
    limits: tuple[float, float]
    bar: int

    def __call__(self, numbers: Sequence[int]) -> NDArray[np.uint8]:
        """Return frames (n, H, W, 1 or 3)."""
        return np.stack([self._drawn(self.source.recorded([number])[0].astype(np.float32)) for number in numbers])

    def _drawn(self, frame: NDArray[np.float32]) -> NDArray[np.uint8]:
        image = frame if frame.shape[2] == 3 else frame.mean(axis=2)
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
