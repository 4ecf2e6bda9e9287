"""Recordings out: video files, one frame in memory at a time."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.pyav import import_av
from napari_fiberburst.io.results import write_whole

# Frames per second where nothing is known of their times.
_RATE = 25.0
# By how much the time between frames may differ from its mean, in parts of it, and frames still count as even.
_UNEVEN = 1e-3
# A second, in the steps that uneven times are written in: what MPEG counts in.
_TICKS = 90_000


@dataclass(frozen=True, slots=True, kw_only=True)
class _Codec:
    """How frames are encoded.

    Attributes
    ----------
    encoder : str
        As ffmpeg names it.
    options : dict
        The encoder's own.
    layouts : dict
        By number of channels and bytes of a value: the layout that frames are encoded in.
    """

    encoder: str
    options: dict[str, str]
    layouts: dict[tuple[int, int], str]


_CODECS = {
    # Version 3 is what splits a frame, so that several processors can decode it.
    "ffv1": _Codec(
        encoder="ffv1",
        options={"level": "3", "g": "1"},
        layouts={(1, 1): "gray", (3, 1): "bgr0", (1, 2): "gray16le", (3, 2): "rgb48le"},
    ),
    # A quality of 2 is the best that the encoder has; it counts in units of 118.
    "mjpeg": _Codec(
        encoder="mjpeg",
        options={"flags": "+qscale", "global_quality": str(2 * 118)},
        layouts={(1, 1): "yuvj444p", (3, 1): "yuvj444p"},
    ),
    "h264": _Codec(
        encoder="libx264", options={"crf": "17", "preset": "fast"}, layouts={(1, 1): "yuv420p", (3, 1): "yuv420p"}
    ),
}
# Layouts of arrays, by number of channels and bytes of a value.
_LAYOUTS = {(1, 1): "gray", (3, 1): "rgb24", (1, 2): "gray16le", (3, 2): "rgb48le"}
# By ending: the container, and the codec where none is named.
_CONTAINERS = {".avi": ("avi", "ffv1"), ".mkv": ("matroska", "ffv1"), ".mp4": ("mp4", "h264")}
VIDEO_ENDINGS = tuple(_CONTAINERS)
VIDEO_CODECS = tuple(_CODECS)


def write_video(
    source: FrameSource,
    path: str | Path,
    *,
    codec: str | None = None,
    rate: float | None = None,
    on_frame: Callable[[], object] = lambda: None,
) -> Path:
    """Write a recording as a video file.

    Parameters
    ----------
    source : FrameSource
        Grey or RGB frames. Those of 16 bits stay so in FFV1; others, and all in other codecs, become 8 bits.
    path : str or Path
        Ending in ``.avi`` or ``.mkv``, or in ``.mp4``.
    codec : str, optional
        "ffv1" loses nothing, "mjpeg" little; both let a reader begin at any frame. "h264" makes small files; frames of
        odd sides get another row or column, a copy of the last. Default, FFV1, and H.264 in ``.mp4``.
    rate : float, optional
        Frames per second. Default, the source's own times, or 25 where it has none.
    on_frame : callable, optional
        Called after each frame.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    OutputError
        PyAV is not installed, the ending or the codec is unknown, they or the frames do not go together, or the file
        cannot be written.
    """
    target = Path(path)
    container, chosen = _container(target, codec, source)
    av = import_av(f"writing {target}", OutputError)
    shown = _times(source, rate, container)
    with write_whole(target) as file:
        try:
            with av.open(file, "w", format=container) as output:
                _encode(output, source, chosen, shown, on_frame)
        except av.FFmpegError as error:
            raise OutputError(f"{target} cannot be written ({error}); choose another ending or codec") from error
    return target


def _container(target: Path, codec: str | None, source: FrameSource) -> tuple[str, _Codec]:
    """Return the container and the codec of a file.

    Raises
    ------
    OutputError
        They are unknown, or do not go together, or with the frames.
    """
    if target.suffix.lower() not in _CONTAINERS:
        raise OutputError(f"a video is written to a file ending in {', '.join(_CONTAINERS)}; got {target}")
    container, usual = _CONTAINERS[target.suffix.lower()]
    name = codec or usual
    if name not in _CODECS:
        raise OutputError(f"unknown codec {name!r}; known: {', '.join(_CODECS)}")
    if name == "ffv1" and container == "mp4":
        raise OutputError(f"FFV1 does not go into .mp4; name a file ending in .avi or .mkv instead of {target}")
    if source.shape[3] not in (1, 3):
        raise OutputError(f"a video has 1 or 3 channels; {source.name} has {source.shape[3]}: write some of them")
    return container, _CODECS[name]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Times:
    """When frames are shown: `at` (T,), in a unit of seconds, and how many there are in a second."""

    at: NDArray[np.int64]
    unit: Fraction
    rate: Fraction


def _times(source: FrameSource, rate: float | None, container: str) -> _Times:
    """Return when frames are shown.

    Raises
    ------
    OutputError
        The rate is not positive; or frames lie at uneven times, and the container cannot say so.
    """
    times = source.acquisition.times
    if rate is not None and not 0 < rate < math.inf:
        raise OutputError(f"rate must be above 0 frames per second; got {rate!r}")
    is_timed = rate is None and times is not None and len(times) > 1
    steps = np.diff(times) if is_timed and times is not None else np.array([1 / (rate or _RATE)])
    if steps.min() <= 0:
        raise OutputError(f"the times of {source.name} do not rise from frame to frame; give a rate")
    mean = Fraction(float(1 / steps.mean())).limit_denominator(10_000)
    if (np.abs(steps / steps.mean() - 1) <= _UNEVEN).all():
        return _Times(at=np.arange(len(source)), unit=1 / mean, rate=mean)
    if container == "avi":
        raise OutputError(
            f"an .avi file cannot hold the uneven times of {source.name}; name one ending in .mkv or .mp4, or give a "
            "rate"
        )
    at = np.rint(np.concatenate([[0.0], np.cumsum(steps)]) * _TICKS).astype(np.int64)
    return _Times(at=at, unit=Fraction(1, _TICKS), rate=mean)


def _encode(output: Any, source: FrameSource, codec: _Codec, shown: "_Times", on_frame: Callable[[], object]) -> None:
    """Encode all frames into an open container."""
    av = import_av("writing a video", OutputError)
    _, height, width, channels = source.shape
    depth = 2 if (channels, 2) in codec.layouts and source.acquisition.dtype.itemsize > 1 else 1
    even = 2 if codec.layouts[channels, depth] == "yuv420p" else 1
    stream = output.add_stream(
        codec.encoder,
        rate=shown.rate,
        options=codec.options,
        width=-(-width // even) * even,
        height=-(-height // even) * even,
        pix_fmt=codec.layouts[channels, depth],
        time_base=shown.unit,
    )
    for number in range(len(source)):
        values = _padded(_as_integers(source, number, depth), even)
        frame = av.VideoFrame.from_ndarray(values, format=_LAYOUTS[channels, depth])
        frame.pts, frame.time_base = int(shown.at[number]), shown.unit
        output.mux(stream.encode(frame))
        on_frame()
    output.mux(stream.encode(None))


def _as_integers(source: FrameSource, number: int, depth: int) -> NDArray[Any]:
    """Return a frame (H, W) or (H, W, 3) in integers of so many bytes: as recorded where it is, or by its levels."""
    wanted, most = (np.uint8, 255) if depth == 1 else (np.uint16, 65535)
    if source.acquisition.dtype == wanted:
        frame: NDArray[Any] = source.recorded([number])[0]
    else:
        frame = np.rint(source.values([number])[0] * np.float32(most)).astype(wanted)
    return np.ascontiguousarray(frame[..., 0] if frame.shape[2] == 1 else frame)


def _padded(frame: NDArray[Any], even: int) -> NDArray[Any]:
    """Return a frame whose sides are whole multiples of `even`; its last row and column are repeated."""
    more = [(0, -side % even) for side in frame.shape[:2]] + [(0, 0)] * (frame.ndim - 2)
    return np.pad(frame, more, mode="edge")
