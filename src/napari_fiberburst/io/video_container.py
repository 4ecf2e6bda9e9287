"""Video files by PyAV: opened, or refused with the reason; packets out, frames out."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from napari_fiberburst.errors import BurstError
from napari_fiberburst.io.bounds import check_file
from napari_fiberburst.io.pyav import import_av

VIDEO_ENDINGS = (
    *(".avi", ".mp4", ".m4v", ".mov", ".mkv", ".webm", ".mpg", ".mpeg", ".m1v", ".m2v", ".ts", ".mts", ".m2ts"),
    *(".wmv", ".asf", ".flv", ".ogv", ".mxf", ".nut", ".y4m", ".3gp", ".h264", ".264", ".hevc", ".265", ".ivf"),
)
# Where containers name a codec (AVI, MP4 and its kin, Matroska), in so many bytes from the beginning or from the end.
_CODEC_NAME = re.compile(rb"strh.{4}vids(.{4})|stsd.{12}(?!mp4a)(\w{4})|(V_[A-Z0-9/_]+)", re.DOTALL)
_SEARCHED = 2**20


def open_video(path: Path) -> tuple[Any, Any]:
    """Return a video file, open, and its first video stream.

    Raises
    ------
    BurstError
        It is empty, no video, without pictures, or of a codec that is missing.
    """
    av = import_av(f"reading {path}")
    check_file(path)
    try:
        container = av.open(str(path))
    except av.error.FFmpegError as error:
        raise BurstError(
            f"{path} cannot be read as video ({error.strerror}); it is none, or was cut short and has lost its index; "
            "copy or export it again"
        ) from error
    if not container.streams.video:
        found = ", ".join(f"{count} {kind}" for kind, count in Counter(s.type for s in container.streams).items())
        container.close()
        raise BurstError(f"{path} holds no pictures (streams: {found or 'none'}); choose a file with a video stream")
    stream = container.streams.video[0]
    if stream.codec_context is None:
        container.close()
        raise BurstError(
            f"{path} is coded as {_codec_name(path)}, which PyAV {av.__version__} does not decode; install the newest "
            f"by: pip install --upgrade av, or convert the file by: ffmpeg -i {path.name} -c:v ffv1 {path.stem}.mkv"
        )
    return container, stream


def packets_of(container: Any, stream: Any) -> Iterator[Any]:
    """Return the packets of a stream that hold something, from where the file stands to its end or its first hole."""
    av = import_av(f"reading {container.name}")
    try:
        for packet in container.demux(stream):
            if packet.size:
                yield packet
    except av.error.FFmpegError:
        return


def decode(stream: Any, packets: Iterable[tuple[int, Any]]) -> Iterator[tuple[int, Any]]:
    """Return frames, each with the number of its packet, in the order of showing; what is damaged is passed over.

    Decoders hand back with a frame the time of the packet that they made it of. They are told a number in its place,
    because times are wrong in some containers and missing in others.
    """
    for number, packet in packets:
        packet.pts = packet.dts = number
        yield from _frames(stream, packet)
    yield from _frames(stream, None)


def _frames(stream: Any, packet: Any) -> Iterator[tuple[int, Any]]:
    av = import_av("reading a video")
    try:
        frames = stream.decode(packet)
    except av.error.FFmpegError:
        return
    for frame in frames:
        if frame.pts is not None:
            yield int(frame.pts), frame


def _codec_name(path: Path) -> str:
    """Return what the container calls the codec, as FFmpeg does not tell where it does not know it."""
    with path.open("rb") as file:
        parts = [file.read(_SEARCHED)]
        file.seek(max(_SEARCHED, path.stat().st_size - _SEARCHED))
        parts.append(file.read())
    for found in filter(None, map(_CODEC_NAME.search, parts)):
        name: bytes = next(filter(None, found.groups()))
        return name.decode("ascii", "replace")
    return "something unknown"
