"""Frames of a camera that pymmcore-plus knows: of Micro-Manager, or simulated in Python."""

from threading import Event, Lock
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from napari_fiberburst.errors import BurstError
from napari_fiberburst.live.clocks import Clock, RealClock
from napari_fiberburst.live.sources import Latest

if TYPE_CHECKING:
    from napari_fiberburst.live.micromanager import CMMCorePlus

# Seconds between looks for a new frame.
_POLL = 0.002


class CameraSource:
    """The frames of the camera that a core of pymmcore-plus has; it runs from the first time it is asked.

    Parameters
    ----------
    core : pymmcore_plus.CMMCorePlus
        With a camera that is not running.
    clock : Clock, optional
        Default, the machine's.

    Attributes
    ----------
    clock : Clock
        That the times of frames are read on, when they are taken from the camera's buffer.

    Raises
    ------
    BurstError
        The core has no camera, or it is running already: whoever runs it takes its frames.
    """

    def __init__(self, core: "CMMCorePlus", clock: Clock | None = None) -> None:
        if not core.getCameraDevice():
            raise BurstError("no camera is loaded; load a configuration of Micro-Manager with one, and choose it there")
        if core.isSequenceRunning():
            raise BurstError(
                f"camera {core.getCameraDevice()} is running already; stop its live view, or choose the image layer "
                "that it is shown in as the source"
            )
        self.clock: Clock = RealClock() if clock is None else clock
        self._core = core
        self._count = 0
        self._is_running = False
        self._closed = Event()
        self._lock = Lock()

    def latest(self, n: int = 1) -> Latest:
        """Wait for the next frame, and return up to n of those that have come; none where the camera has stopped.

        Raises
        ------
        BurstError
            Its buffer was full before frames were taken from it.
        """
        self._start()
        frames: list[NDArray[Any]] = []
        while not frames and not self._closed.is_set():
            is_over = not self._core.isSequenceRunning()
            while self._core.getRemainingImageCount() > 0:
                frames.append(self._core.popNextImage())
            if self._core.isBufferOverflowed():
                raise BurstError(
                    "the camera's buffer was full, and frames are lost; lower its rate, or make its buffer larger in "
                    "Micro-Manager"
                )
            if is_over and not frames:
                break
            if not frames:
                self.clock.wait(_POLL)
        return self._as_latest(frames, n)

    def close(self) -> None:
        """Stop the camera, and end."""
        with self._lock:
            self._closed.set()
            if self._is_running and self._core.isSequenceRunning():
                self._core.stopSequenceAcquisition()
            self._is_running = False

    def _start(self) -> None:
        with self._lock:
            if not self._is_running and not self._closed.is_set():
                self._core.startContinuousSequenceAcquisition(0)
                self._is_running = True

    def _as_latest(self, frames: list[NDArray[Any]], n: int) -> Latest:
        first, self._count = self._count, self._count + len(frames)
        dropped = max(0, len(frames) - n)
        shown = [frame if frame.ndim == 3 else frame[..., None] for frame in frames[dropped:]]
        return Latest.of(shown, first + dropped, self.clock.now(), dropped)
