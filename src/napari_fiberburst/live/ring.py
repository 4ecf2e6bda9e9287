"""The last seconds of a live source: all frames as they came, for a burst, and the newest, for whoever watches."""

import logging
from collections import deque
from dataclasses import dataclass
from threading import Condition
from typing import Any

from numpy.typing import NDArray

from napari_fiberburst.errors import BurstError, FiberBurstError
from napari_fiberburst.live.clocks import Clock
from napari_fiberburst.live.sources import Latest, LiveSource

logger = logging.getLogger(__name__)

# Frames taken from a source at once.
_MOST_AT_ONCE = 64
MOST_BYTES = 2**30


@dataclass(frozen=True, slots=True, eq=False)
class _Kept:
    frame: NDArray[Any]
    index: int
    seconds: float


class Ring:
    """Keeps the last frames of a source while they are taken, and is a source itself, of the newest of them.

    So the frames that are kept do not depend on how fast pictures are made.

    Parameters
    ----------
    clock : Clock
        That of the source.
    seconds : float
        For how long a frame is kept.
    most_bytes : int
        Of all frames kept; the oldest are forgotten sooner where more come in `seconds`.

    Attributes
    ----------
    clock : Clock
        That the times of frames are read on.
    count, lost : int
        Frames that have come, and those that the source has passed over before they did.
    problem : str
        Why no more frames come, in words for the user; "" while they do, or where the source has come to its end.

    Raises
    ------
    BurstError
        Nothing could be kept.
    """

    def __init__(self, clock: Clock, seconds: float = 10.0, most_bytes: int = MOST_BYTES) -> None:
        if not seconds > 0 or most_bytes < 1:
            raise BurstError(f"a ring keeps frames for more than 0 seconds; got {seconds} s and {most_bytes} bytes")
        self.clock = clock
        self.count = self.lost = 0
        self.problem = ""
        self._seconds, self._most_bytes = seconds, most_bytes
        self._bytes = 0
        self._kept: deque[_Kept] = deque()
        self._is_open = True
        self._handed_out = 0
        self._come = Condition()

    def record(self, source: LiveSource) -> None:
        """Take all frames of a source until it ends, or this is closed; meant for a thread of its own."""
        try:
            while self._is_open and len((got := source.latest(_MOST_AT_ONCE)).frames):
                self.put(got)
        except FiberBurstError as error:
            self.problem = str(error)
        except Exception as error:  # a camera's driver may raise anything, and the window must hear of it
            logger.exception("a live source has failed")
            self.problem = f"{type(error).__name__}: {error}"
        finally:
            self.close()
            source.close()

    def put(self, got: Latest) -> None:
        """Take in frames that have come.

        Raises
        ------
        BurstError
            They are not of the size and type of those before; these stay.
        """
        with self._come:
            self.lost += got.dropped
            for frame, seconds in zip(got.frames, got.times.tolist(), strict=True):
                self._refuse_others(frame)
                self._kept.append(_Kept(frame, self.count, seconds))
                self._bytes += frame.nbytes
                self.count += 1
                while self._kept[0].seconds < seconds - self._seconds or self._bytes > self._most_bytes:
                    self._bytes -= self._kept.popleft().frame.nbytes
            self._come.notify_all()

    def latest(self, n: int = 1) -> Latest:
        """Wait for a frame that was not handed out before, and return it after up to n - 1 others of that kind."""
        with self._come:
            self._come.wait_for(lambda: self.count > self._handed_out or not self._is_open)
            first = max(self._handed_out, self.count - n)
            dropped, self._handed_out = first - self._handed_out, self.count
            return _as_latest([one for one in self._kept if one.index >= first], dropped)

    def last(self, seconds: float) -> Latest:
        """Return the frames of the last seconds, as many of them as are kept."""
        with self._come:
            since = self._kept[-1].seconds - seconds if self._kept else 0.0
            return _as_latest([one for one in self._kept if one.seconds >= since], 0)

    def close(self) -> None:
        """Take no more frames; those kept stay."""
        with self._come:
            self._is_open = False
            self._come.notify_all()

    def _refuse_others(self, frame: NDArray[Any]) -> None:
        if self._kept and (frame.shape, frame.dtype) != (self._kept[-1].frame.shape, self._kept[-1].frame.dtype):
            before = self._kept[-1].frame
            raise BurstError(
                f"the camera has changed from {_told(before)} to {_told(frame)}; the frames before are kept: save them "
                "where you need them, and start again"
            )


def _as_latest(kept: list[_Kept], dropped: int) -> Latest:
    first = kept[0].index if kept else 0
    return Latest.of([one.frame for one in kept], first, [one.seconds for one in kept], dropped)


def _told(frame: NDArray[Any]) -> str:
    return f"{frame.shape[0]} x {frame.shape[1]} pixels of {frame.dtype}"
