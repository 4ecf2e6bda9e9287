"""A live view in the making, to be looked at from the window. Knows nothing of Qt."""

import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.live.ring import Ring
from napari_fiberburst.live.sources import Latest, LiveSource
from napari_fiberburst.plugin.drivers import without_clash
from napari_fiberburst.streaming import Latest as Mailbox

if TYPE_CHECKING:
    from napari_fiberburst.live.engine import LiveEngine
    from napari_fiberburst.live.mosaic import LiveMosaic
    from napari_fiberburst.live.watching import Watched

logger = logging.getLogger(__name__)

# Pictures a second are told of so many seconds; a mosaic takes a picture this often.
_TOLD_OF, _PASTED_EVERY = 2.0, 0.25


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shown:
    """A picture, and how it goes.

    Attributes
    ----------
    watched : Watched
        The picture and what to make of it.
    rate : float
        Pictures a second, of late.
    skipped, lost : int
        Frames since the start that were not made a picture of, because newer ones had come, and those that the source
        has lost.
    """

    watched: "Watched"
    rate: float
    skipped: int
    lost: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pasted:
    """A mosaic as it stands, (rows, columns, C), and row and column of its first pixel in pixels of the first frame."""

    image: NDArray[np.float32]
    origin: tuple[int, int]
    is_full: bool


class LiveJob:
    """Watches a source through an engine, and keeps its last frames, until it is stopped.

    Parameters
    ----------
    open_source : callable
        Returns the source; called in the worker's thread.
    bundle : object
        As `reconstruct` takes it; None where there is none.
    seconds : float
        For how long frames are kept.

    Attributes
    ----------
    shown : Latest of Shown
        The newest picture, for whoever looks.
    pasted : Latest of Pasted
        The newest mosaic, where `wants_mosaic`.
    wants_mosaic : bool
        Whether pictures are pasted together; may be changed at any time.
    is_running, is_stopped : bool
        Whether the worker is at it, and whether it was told to stop.
    problem : str
        Why it has ended, in words for the user; "" where it was stopped, or the source has come to its end.
    """

    def __init__(self, open_source: Callable[[], LiveSource], bundle: Any, seconds: float) -> None:
        self._open, self._bundle, self._seconds = open_source, bundle, seconds
        self._lock = threading.Lock()
        self._source: LiveSource | None = None
        self._ring: Ring | None = None
        self.shown: Mailbox[Shown] = Mailbox()
        self.pasted: Mailbox[Pasted] = Mailbox()
        self.wants_mosaic = False
        self.problem = ""
        self.is_running = self.is_stopped = False

    @property
    def is_waiting(self) -> float | None:
        """Seconds since the last frame has come; None before the first."""
        if self._ring is None:
            return None
        newest = self._ring.last(0)
        return self._ring.clock.now() - float(newest.times[-1]) if len(newest.times) else None

    def stop(self) -> None:
        """End; may be called from any thread, and more than once."""
        self.is_stopped = True
        self._close()

    def _close(self) -> None:
        with self._lock:
            if self._source is not None:
                self._source.close()
            if self._ring is not None:
                self._ring.close()

    def last(self, seconds: float) -> Latest | None:
        """Return the frames of the last seconds; None where none have come."""
        got = None if self._ring is None else self._ring.last(seconds)
        return got if got is not None and len(got.frames) else None

    def run(self) -> None:
        """Do the work. Raises nothing, because a worker's errors reach the window by more than one way."""
        self.is_running = True
        try:
            with without_clash():
                self._watch()
        except FiberBurstError as error:
            self.problem = str(error)
        except ImportError as error:
            self.problem = f'{error.name} is not installed; pip install "napari-fiberburst[camera]" brings it'
        except Exception as error:  # whatever it is, the window must hear of it and be ready again
            logger.exception("a live view has failed")
            self.problem = f"{type(error).__name__}: {error}"
        finally:
            self._close()
            self.is_running = False

    def _watch(self) -> None:
        from napari_fiberburst.live.engine import LiveEngine  # torch takes seconds to load
        from napari_fiberburst.pipeline.reconstruct import as_bundle

        with LiveEngine(None if self._bundle is None else as_bundle(self._bundle)) as engine:
            self._show_all(self._open(), engine)

    def _show_all(self, source: LiveSource, engine: "LiveEngine") -> None:
        from napari_fiberburst.live.mosaic import LiveMosaic
        from napari_fiberburst.live.watching import watch

        with self._lock:
            self._source, self._ring = source, Ring(source.clock, self._seconds)
            if self.is_stopped:
                source.close()
        recording = threading.Thread(target=self._ring.record, args=(source,), daemon=True)
        recording.start()
        mosaic, pasted_at, times, skipped = LiveMosaic(), -np.inf, deque[float](), 0
        for watched in watch(self._ring, engine):
            now = source.clock.now()
            times.append(now)
            while times[0] < now - _TOLD_OF:
                times.popleft()
            skipped += watched.dropped
            rate = (len(times) - 1) / (now - times[0]) if len(times) > 1 else 0.0
            self.shown.put(Shown(watched=watched, rate=rate, skipped=skipped, lost=self._ring.lost))
            if self.wants_mosaic and now - pasted_at > _PASTED_EVERY:
                pasted_at = now
                self._paste(mosaic, watched)
        recording.join()
        self.problem = self._ring.problem

    def _paste(self, mosaic: "LiveMosaic", watched: "Watched") -> None:
        mosaic.add(watched.view)
        image = mosaic.image
        if image.size:
            self.pasted.put(Pasted(image=image, origin=mosaic.origin, is_full=mosaic.is_full))
