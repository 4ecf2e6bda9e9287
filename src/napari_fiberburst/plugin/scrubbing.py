"""The frames of a recording as a layer's data: each is read when it is shown, and those about it are at hand."""

import threading
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import BurstError

# Frames that were shown stay at hand in so many bytes.
_MOST_BYTES = 2**27
# Who steps on is likely to go on: so many frames are read ahead. Who steps back in a compressed video would have each
# frame decoded from the key frame before it, so that many are taken on that way at once.
_AHEAD, _BACK = 8, 16
# One thread reads ahead for all recordings, because there is one hand that scrubs.
_READER = ThreadPoolExecutor(1, thread_name_prefix="frames ahead")


class Frames:
    """An array of a recording's frames, as napari takes it, none of which is in memory before it is asked for.

    Parameters
    ----------
    source : FrameSource
        The recording.
    is_colour : bool
        Whether its channels are red, green and blue, and come last; by default other channels come before height.

    Attributes
    ----------
    source : FrameSource
        The recording.
    axes : str
        "TYX", "TYXC" or "TCYX".
    """

    def __init__(self, source: FrameSource, *, is_colour: bool = False) -> None:
        self.source = source
        count, height, width, channels = source.shape
        self.shape: tuple[int, ...]
        if "C" not in source.acquisition.axes:
            self.axes, self.shape = "TYX", (count, height, width)
        elif is_colour:
            self.axes, self.shape = "TYXC", (count, height, width, channels)
        else:
            self.axes, self.shape = "TCYX", (count, channels, height, width)
        self.dtype = source.acquisition.dtype
        self._kept: OrderedDict[int, NDArray[Any]] = OrderedDict()
        self._most = max(2 * _BACK, _MOST_BYTES // (int(np.prod(self.shape[1:])) * self.dtype.itemsize))
        self._lock = threading.Lock()
        self._last = -1
        self._ahead: Future[None] | None = None

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """Number of values."""
        return int(np.prod(self.shape))

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> NDArray[Any]:
        places = key if isinstance(key, tuple) else (key,)
        first, rest = (slice(None), places) if places[:1] == (...,) else (places[0], places[1:])
        if isinstance(first, int | np.integer):
            frame: NDArray[Any] = self._shown(range(len(self))[int(first)])[rest]
            return frame
        numbers = np.arange(len(self))[first].tolist()
        several = rest if rest[:1] == (...,) else (slice(None), *rest)
        # napari asks for what it shows as a slice of one.
        shown = self._shown(numbers[0])[None] if len(numbers) == 1 else self._arranged(self.source.recorded(numbers))
        frames: NDArray[Any] = shown[several]
        return frames

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(self[:], dtype)

    def take(self, numbers: range) -> "Frames":
        """Return some of the frames, still unread."""
        return Frames(self.source.take(numbers), is_colour=self.axes == "TYXC")

    def _shown(self, number: int) -> NDArray[Any]:
        """Return one frame, and see to it that the next one of somebody who steps is at hand."""
        step, self._last = number - self._last, number
        frame = self._at_hand(number)
        if frame is None and self._ahead is not None and abs(step) <= _BACK:
            self._ahead.result()  # it may be just that
            frame = self._at_hand(number)
        if frame is None:
            self._read(range(max(0, number - _BACK + 1), number + 1) if -_BACK <= step < 0 else [number])
            frame = self._at_hand(number)
        coming = range(0)
        if 0 < step <= _AHEAD:
            coming = range(number + 1, min(number + 1 + _AHEAD, len(self)))
        elif -_BACK <= step < 0:
            last = number - _BACK // 2
            # Not before half of what is at hand has been gone through, because each read begins at a key frame.
            coming = range(max(0, last - _BACK + 1), last + 1) if last >= 0 and self._at_hand(last) is None else coming
        is_idle = self._ahead is None or self._ahead.done()
        if is_idle and any(self._at_hand(one) is None for one in coming):
            self._ahead = _READER.submit(self._read_quietly, coming, at_once=step < 0)
        if frame is None:
            raise BurstError(f"frame {number} of {self.source.name} cannot be read; check the file")
        return frame

    def _at_hand(self, number: int) -> NDArray[Any] | None:
        with self._lock:
            if number in self._kept:
                self._kept.move_to_end(number)
            return self._kept.get(number)

    def _read(self, numbers: Sequence[int]) -> None:
        wanted = [number for number in numbers if self._at_hand(number) is None]
        frames = self._arranged(self.source.recorded(wanted))
        with self._lock:
            self._kept.update(zip(wanted, frames, strict=True))
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)

    def _read_quietly(self, numbers: range, *, at_once: bool) -> None:
        """Read ahead; what cannot be read is said when it is shown."""
        with suppress(BurstError):
            for part in [numbers] if at_once else [[number] for number in numbers]:
                self._read(part)

    def _arranged(self, frames: NDArray[Any]) -> NDArray[Any]:
        """Put frames (n, H, W, C) in the order of the axes."""
        if self.axes == "TYX":
            return frames[..., 0]
        return frames if self.axes == "TYXC" else np.moveaxis(frames, 3, 1)
