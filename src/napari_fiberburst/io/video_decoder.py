"""Frames of a video by their numbers."""

import logging
from collections.abc import Iterable, Iterator
from itertools import chain, islice
from typing import Any

from napari_fiberburst.errors import BurstError
from napari_fiberburst.io.pyav import import_av
from napari_fiberburst.io.video_container import decode, open_video, packets_of
from napari_fiberburst.io.video_index import Packet, VideoIndex

logger = logging.getLogger(__name__)

# A key frame so few frames ahead is not worth a search for it.
_NEAR = 16
# From so many key frames before it a frame is tried to be decoded, and from the first one.
_TRIES = 3
# FFmpeg's kinds of frames that are made from others, P and B.
_FROM_OTHERS = (2, 3)
# Where the file is entered, the key frame is looked for in so many packets more than there should be before it.
_MORE = 50


class Decoder:
    """A video file that is open, and a decoder that stands somewhere in it.

    Reading on from frame to frame decodes each once. A frame elsewhere is decoded from the key frame before it.
    """

    def __init__(self, index: VideoIndex) -> None:
        self._index = index
        self._marks = index.marks
        self._container, self._stream = open_video(index.path)
        self._begin(0)

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def frame(self, number: int) -> Any:
        """Return a frame as PyAV has it.

        Raises
        ------
        BurstError
            It cannot be decoded.
        """
        starts = self._index.starts(number)
        if self._first <= number and self._next <= number and self._index.numbers[starts[0]] <= self._next + _NEAR:
            found = self._go_on_to(number)
            if found is not None:
                return found
        for start in dict.fromkeys([*starts[:_TRIES], starts[-1]]):
            self._begin(start)
            found = self._go_on_to(number)
            if found is not None:
                return found
        raise BurstError(
            f"frame {number} of {self._index.path} cannot be decoded, because the file is damaged there; leave it out, "
            "or copy or export the file again"
        )

    def whole_from(self, key: int) -> set[int]:
        """Return the packets from a key frame to the end of the file of which whole frames can be made."""
        self._begin(key)
        return {packet for packet, frame in self._frames if not frame.is_corrupt}

    def _begin(self, key: int) -> None:
        self._frames = decode(self._stream, self._usable(self._enter(key)))
        self._start = key
        # Some key frames are none: where the container is wrong, or codecs renew frames in parts, one after the other.
        self._is_sure = key == self._index.keys[0]
        self._first = max(0, int(self._index.numbers[key]))
        self._next = self._first

    def _go_on_to(self, number: int) -> Any:
        """Return a frame, or None where it does not come."""
        for packet, frame in self._frames:
            if packet == self._start:
                self._is_sure |= frame.key_frame and int(frame.pict_type) not in _FROM_OTHERS
            current = int(self._index.numbers[packet])
            self._next = max(self._next, current + 1)
            if current == number and self._is_sure:
                if frame.is_corrupt:
                    logger.warning("frame %d of %s is damaged", number, self._index.path)
                return frame
            if current >= number:
                return None
        return None

    def _usable(self, packets: Iterable[tuple[int, Any]]) -> Iterator[tuple[int, Any]]:
        return ((number, packet) for number, packet in packets if self._index.packets[number].is_whole)

    def _enter(self, key: int) -> Iterator[tuple[int, Any]]:
        """Return the packets from a key frame on, with their numbers."""
        if self._marks.get(self._index.packets[key].content) == key:
            earlier = [key, *self._index.keys[self._index.keys < key][-2:][::-1].tolist()]
            entries = [(self._index.packets[key].shown, key), *((self._index.packets[n].decoded, n) for n in earlier)]
            for time, expected in dict.fromkeys(entries):
                found = None if time is None else self._search(key, time, key - expected + _MORE)
                if found is not None:
                    return found
        # Some files cannot be entered but at their beginning.
        self.close()
        self._container, self._stream = open_video(self._index.path)
        packets = enumerate(packets_of(self._container, self._stream))
        return ((number, packet) for number, packet in packets if number >= key)

    def _search(self, key: int, time: int, most: int) -> Iterator[tuple[int, Any]] | None:
        """Enter the file at a time, and return the packets from a key frame on; None where it does not come."""
        try:
            self._container.seek(time, stream=self._stream, backward=True)
        except import_av(f"reading {self._index.path}").error.FFmpegError:
            return None
        packets = packets_of(self._container, self._stream)
        for packet in islice(packets, most):
            number = self._marks.get(Packet.of(packet).content)
            if number == key:
                return enumerate(chain([packet], packets), key)
            if number is not None and number > key:
                return None
        return None
