"""Where live frames come from: a small protocol, and a recording that is replayed at its own rate."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from threading import Event
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import BurstError
from napari_fiberburst.live.clocks import Clock, RealClock

# Parts of a frame's time by which sums of times may be off.
_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Latest:
    """The newest frames of a source.

    Attributes
    ----------
    frames : numpy.ndarray
        (n, H, W, C) as the camera gave them, the newest last; n = 0 where the source has come to its end.
    indices : numpy.ndarray
        (n,) int64, their numbers since the source began.
    times : numpy.ndarray
        (n,) float64, when they were taken, seconds on the source's clock.
    dropped : int
        How many frames between those handed out before and these were passed over, because newer ones had come.
    """

    frames: NDArray[Any]
    indices: NDArray[np.int64]
    times: NDArray[np.float64]
    dropped: int

    @classmethod
    def of(
        cls, frames: Sequence[NDArray[Any]], first: int, seconds: float | Sequence[float], dropped: int = 0
    ) -> "Latest":
        """Return frames (H, W, C) in a row, numbered from `first` on and taken at these times, or all at one."""
        return cls(
            frames=np.stack(frames) if frames else np.empty((0, 0, 0, 1), np.uint8),
            indices=np.arange(first, first + len(frames)),
            times=np.broadcast_to(np.asarray(seconds, np.float64), (len(frames),)).copy(),
            dropped=dropped,
        )


class LiveSource(Protocol):
    """Gives frames while they are taken. The newest wins: whoever comes late gets it, and not what was missed."""

    @property
    def clock(self) -> Clock:
        """What the times of frames are read on."""
        ...

    def latest(self, n: int = 1) -> Latest:
        """Wait for a frame that was not handed out before, and return it after up to n - 1 others of that kind."""
        ...

    def close(self) -> None:
        """End: whoever waits for a frame, and whoever asks later, gets none. May be called from another thread."""
        ...


class Replay:
    """Replays a recording as if it were taken now, the first frame when it is first asked for.

    Parameters
    ----------
    source : FrameSource
        As `open_recording` gives it.
    rate : float, optional
        Frames a second. Default, that of the recording.
    clock : Clock, optional
        Default, the machine's.

    Attributes
    ----------
    rate : float
        Frames a second.
    clock : Clock
        That the times of frames are read on.

    Raises
    ------
    BurstError
        The rate is not positive; or none is given, and the recording does not tell its own.
    """

    def __init__(self, source: FrameSource, rate: float | None = None, clock: Clock | None = None) -> None:
        self.rate = _rate_of(source) if rate is None else rate
        if not 0 < self.rate < math.inf:
            raise BurstError(f"a replay needs a rate above 0 frames a second; got {rate}")
        self.clock: Clock = RealClock() if clock is None else clock
        self._source = source
        self._began: float | None = None
        self._next = 0
        self._closed = Event()

    def close(self) -> None:
        """End before the recording does."""
        self._closed.set()

    def latest(self, n: int = 1) -> Latest:
        """Wait for the next frame, and return up to n of those that have come; none after the recording's last.

        Raises
        ------
        BurstError
            Less than one frame is asked for, or a frame cannot be read.
        """
        if n < 1:
            raise BurstError(f"ask for 1 frame or more; got {n}")
        if self._began is None:
            self._began = self.clock.now()
        come = self._wait(self._began)
        first = max(self._next, come - n)
        dropped, self._next = first - self._next, come
        indices = np.arange(first, come)
        frames = self._source.recorded(indices.tolist()) if come > first else self._none()
        return Latest(frames=frames, indices=indices, times=self._began + indices / self.rate, dropped=dropped)

    def _wait(self, began: float) -> int:
        """Return how many frames have come, once the next one has; at the end, all."""
        while self._next < len(self._source) and not self._closed.is_set():
            since = (self.clock.now() - began) * self.rate + _ROUNDING
            if since >= self._next:
                return min(len(self._source), int(since) + 1)
            self.clock.wait((self._next - since) / self.rate)
        return self._next

    def _none(self) -> NDArray[Any]:
        return np.empty((0, *self._source.shape[1:]), self._source.acquisition.dtype)


def _rate_of(source: FrameSource) -> float:
    times = source.acquisition.times
    if times is None or len(times) < 2 or not times[-1] > times[0]:
        raise BurstError(f"{source.name} does not tell how many frames it has a second; give a rate")
    return float((len(times) - 1) / (times[-1] - times[0]))
