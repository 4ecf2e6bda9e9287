"""Video files: their frames, exactly, in grey or in colour, with their times."""

import logging
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.errors import BurstError
from napari_fiberburst.io.lazy import Handle, Parts
from napari_fiberburst.io.pyav import import_av
from napari_fiberburst.io.recording import Recording
from napari_fiberburst.io.video_decoder import Decoder
from napari_fiberburst.io.video_index import VideoIndex, index_video

logger = logging.getLogger(__name__)

# The end of a file is decoded to see whether it is whole, where its last group has at most so many frames.
_LONGEST_GROUP = 2000
# Whether colours are seen is told by so many frames, any of those of a file that has no more than so many.
_SAMPLED, _SHORT = 16, 4000
# A video is grey where its channels differ by no more than this part of full scale: chroma off by 2 of 255 from
# neutral, as rounding leaves it, makes them differ by 4.
_NEUTRAL = 4 / 255
# Depths of grey that FFmpeg has formats for.
_DEPTHS = (8, 9, 10, 12, 14, 16)


@dataclass(frozen=True, slots=True)
class _Pixels:
    """How the pixels of a frame are taken: in which of FFmpeg's formats, and which of its channels."""

    format: str
    dtype: str
    channels: int
    is_grey: bool

    @classmethod
    def of(cls, av: Any, name: str, *, is_grey: bool) -> "_Pixels":
        """Return how pixels are taken from frames of a format, in the depth that they have."""
        known = av.VideoFormat(name)
        bits = max((part.bits for part in known.components), default=8)
        depth = next((depth for depth in _DEPTHS if depth >= bits), _DEPTHS[-1])
        if is_grey and not (known.is_rgb or known.has_palette):
            return cls("gray" if depth == 8 else f"gray{depth}le", "u1" if depth == 8 else "<u2", 1, True)
        return cls("rgb24" if depth == 8 else "rgb48le", "u1" if depth == 8 else "<u2", 3, is_grey)

    def array(self, frame: Any) -> NDArray[Any]:
        """Return the pixels of a frame, (H, W) in grey or (H, W, 3)."""
        plane = (frame if frame.format.name == self.format else frame.reformat(format=self.format)).planes[0]
        stored = np.frombuffer(plane, self.dtype)
        line = plane.line_size // stored.itemsize
        rows = stored[: line * frame.height].reshape(frame.height, line)[:, : frame.width * self.channels]
        pixels = rows.reshape(frame.height, frame.width, self.channels)
        # Of colours that are all alike, one is the light; the sum of all that makes luma would be rounded.
        return pixels[..., self.channels // 2].copy() if self.is_grey else pixels.copy()


@dataclass(frozen=True, slots=True, eq=False)
class _Frames:
    """Reads frames of a video by their numbers."""

    path: Path
    handle: Handle[Decoder]
    pixels: _Pixels
    shape: tuple[int, int]

    def __call__(self, number: int) -> NDArray[Any]:
        with self.handle.use() as decoder:
            frame = decoder.frame(number)
            if (frame.height, frame.width) != self.shape:
                raise BurstError(
                    f"frame {number} of {self.path} has {frame.height} x {frame.width} pixels where the first has "
                    f"{self.shape[0]} x {self.shape[1]}; leave it and those after it out, such as by "
                    f'frames="0:{number}", or cut the file there'
                )
            return self.pixels.array(frame)


def read_video(path: Path) -> Recording:
    """Open a video. Its frames are decoded when the pixels are sliced.

    Grey formats, and colours that are neutral in 16 frames spread over the file (of a long file, key frames), make grey
    frames. Grey values have the
    depth that they are recorded in, up to 16 bits; colours have 8, or 16 where they are deeper. Luma of the narrow
    range of television is stretched to full scale.

    Raises
    ------
    BurstError
        It is no video that can be decoded.
    """
    index = find_frames(path)
    handle = Handle(partial(Decoder, index))
    pixels = _seen_in(index, handle)
    if index.lost:
        logger.warning("%d frames of %s cannot be decoded, because parts of the file are missing", index.lost, path)
    part = index.shape if pixels.is_grey else (*index.shape, 3)
    times = index.times
    return Recording(
        pixels=Parts(_Frames(path, handle, pixels, index.shape), (len(index.order),), part, np.dtype(pixels.dtype)),
        axes="TYX" if pixels.is_grey else "TYXC",
        times=None if times is None else times.tolist(),
    )


def find_frames(path: Path) -> VideoIndex:
    """Find the frames of a video that can be decoded; those at the end of a file that was cut short may not.

    Raises
    ------
    BurstError
        It is no video that can be decoded.
    """
    index = index_video(path)
    last = int(index.keys[-1])
    if len(index.packets) - last > _LONGEST_GROUP:
        return index
    decoder = Decoder(index)
    try:
        # From the key frame before, because frames may be shown before a key frame and be made from both.
        whole = decoder.whole_from(int(index.keys[-2:][0]))
    finally:
        decoder.close()
    lost = [int(packet) for packet in index.order if packet >= last and packet not in whole]
    # Frames after one that is damaged may be made from it.
    return replace(index, order=index.order[index.order < min(lost)]) if lost else index


def _seen_in(index: VideoIndex, handle: Handle[Decoder]) -> _Pixels:
    """Return how pixels are taken: in grey where the format, or a sample of frames, has no colours."""
    av = import_av(f"reading {index.path}")
    if all(part.is_luma for part in av.VideoFormat(index.pixels).components):
        return _Pixels.of(av, index.pixels, is_grey=True)
    colours = _Pixels.of(av, index.pixels, is_grey=False)
    most = _NEUTRAL * np.iinfo(colours.dtype).max
    for number in _sample(index):
        with handle.use() as decoder:
            pixels = colours.array(decoder.frame(number))
        if np.ptp(pixels, axis=2).max() > most:
            return colours
    return _Pixels.of(av, index.pixels, is_grey=True)


def _sample(index: VideoIndex) -> list[int]:
    """Return the numbers of some frames, spread over the file: key frames where there are many."""
    keys = np.sort(index.numbers[index.keys])
    among = keys[keys >= 0] if len(keys) >= _SAMPLED or len(index.order) > _SHORT else np.arange(len(index.order))
    places = np.linspace(0, len(among) - 1, min(_SAMPLED, len(among))).round().astype(int)
    return [int(number) for number in among[places]]
