"""Which packet of a video holds which frame: its packets are read once, and hardly any is decoded.

Frames are numbered in the order in which they are shown.
"""

from collections import Counter
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.errors import BurstError
from napari_fiberburst.io.video_container import decode, open_video, packets_of

# So many frames are decoded to see whether they come in the order of their times.
_TRIED = 64


@dataclass(frozen=True, slots=True)
class Packet:
    """What the container says of a packet.

    Attributes
    ----------
    shown, decoded : int or None
        Times, in ticks.
    content : tuple of int
        Its place in the file, where it is known, its size and a checksum: what it is told by wherever the file is
        entered, because some containers give it another time then.
    is_key : bool
        Whether decoding can begin with it.
    is_whole : bool
        Whether all of it is in the file.
    is_shown : bool
        Whether its frame is one of the recording, and not there for the sake of others only.
    """

    shown: int | None
    decoded: int | None
    content: tuple[int | None, int, int]
    is_key: bool
    is_whole: bool
    is_shown: bool

    @classmethod
    def of(cls, packet: Any) -> "Packet":
        """Return what is said of a packet of PyAV's."""
        return cls(packet.pts, packet.dts, packet.pos, packet.is_keyframe, not packet.is_corrupt, not packet.is_discard)


@dataclass(frozen=True, slots=True, eq=False)
class VideoIndex:
    """The frames of a video file.

    Attributes
    ----------
    path : Path
        The file.
    packets : tuple of Packet
        In the order of decoding.
    order : numpy.ndarray
        (T,) packets of the frames, in the order of showing.
    tick : float
        What times are multiples of, seconds.
    rate : float
        Frames per second as the file gives it; 0 where it does not.
    codec, pixels : str
        Names of the codec, and of the format of its pixels.
    shape : (int, int)
        Height and width of the first frame.
    """

    path: Path
    packets: tuple[Packet, ...]
    order: NDArray[np.int64]
    tick: float
    rate: float
    codec: str
    pixels: str
    shape: tuple[int, int]
    numbers: NDArray[np.int64] = field(init=False)
    keys: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        numbers = np.full(len(self.packets), -1, np.int64)
        numbers[self.order] = np.arange(len(self.order))
        object.__setattr__(self, "numbers", numbers)
        object.__setattr__(self, "keys", np.array(_keys(self.packets), np.int64))

    def starts(self, number: int) -> list[int]:
        """Return the packets from which a frame may be decoded, the nearest first."""
        before = self.keys[self.numbers[self.keys] <= number]
        return [int(key) for key in before[np.argsort(-self.numbers[before], kind="stable")]]

    @property
    def marks(self) -> dict[tuple[int | None, int, int], int]:
        """Key frames by their contents, without those that are not the only ones of theirs."""
        contents = [packet.content for packet in self.packets]
        often = Counter(contents)
        return {contents[key]: key for key in self.keys.tolist() if often[contents[key]] == 1}

    @property
    def times(self) -> NDArray[np.float64] | None:
        """When frames are shown, seconds; evenly where the file has no times of its own."""
        shown = [self.packets[number].shown for number in self.order]
        decoded = sorted(packet.decoded for packet in self.packets if packet.decoded is not None)
        for times in (shown, decoded):
            if len(times) == len(shown) and None not in times and np.all(np.diff(np.array(times, float)) > 0):
                return np.array(times, np.float64) * self.tick
        return np.arange(len(shown)) / self.rate if self.rate > 0 else None

    @property
    def lost(self) -> int:
        """How many frames are in the file of which nothing can be seen."""
        return sum(packet.is_shown for packet in self.packets) - len(self.order)


def index_video(path: Path) -> VideoIndex:
    """Find the frames of a video file.

    Raises
    ------
    BurstError
        It is no video that can be decoded, or has no key frame.
    """
    container, stream = open_video(path)
    with container:
        packets = tuple(Packet.of(packet) for packet in packets_of(container, stream))
        tick, rate = float(stream.time_base or 0), float(stream.average_rate or 0)
    if not packets:
        raise BurstError(f"{path} holds no frames; it may have been cut short, so copy or export it again")
    keys = _keys(packets)
    if not keys:
        raise BurstError(
            f"{path} has no key frame, with which decoding could begin; record or export it again with key frames"
        )
    by_time = _by_time(packets, keys[0])
    order, codec, first = _decoded(path, packets, keys[0], _TRIED)
    if by_time[: len(order)] != order:
        # Its times are wrong, or there are packets without a frame: the decoder alone knows the order of all of them.
        by_time, codec, first = _decoded(path, packets, keys[0], None)
    return VideoIndex(
        path=path,
        packets=packets,
        order=np.array(by_time, np.int64),
        tick=tick,
        rate=rate,
        codec=codec,
        pixels=first.format.name,
        shape=(first.height, first.width),
    )


def _keys(packets: tuple[Packet, ...]) -> list[int]:
    return [number for number, packet in enumerate(packets) if packet.is_key and packet.is_whole]


def _by_time(packets: tuple[Packet, ...], key: int) -> list[int]:
    """Return packets in the order of their times, from the first key frame on; none where not all have one."""
    used = [n for n, packet in enumerate(packets) if packet.is_whole and packet.is_shown and n >= key]
    times = {n: packets[n].shown for n in (key, *used)}
    if None in times.values() or len(set(times.values())) < len(times):
        return []
    # What is shown before the first key frame is made from frames before it.
    return sorted((n for n in used if times[n] >= times[key]), key=lambda n: times[n] or 0)  # type: ignore[operator]


def _decoded(path: Path, packets: tuple[Packet, ...], key: int, most: int | None) -> tuple[list[int], str, Any]:
    """Return packets in the order in which a decoder makes frames of them, the codec, and the first frame."""
    container, stream = open_video(path)
    with container:
        fed = enumerate(packets_of(container, stream))
        frames = decode(stream, ((n, packet) for n, packet in fed if n >= key and packets[n].is_whole))
        order, first = [], None
        for number, frame in islice(((n, frame) for n, frame in frames if not frame.is_corrupt), most):
            first = frame if first is None else first
            order.append(number)
        if first is None:
            raise BurstError(f"no frame of {path} can be decoded; copy or export it again")
        return order, stream.codec_context.name, first
