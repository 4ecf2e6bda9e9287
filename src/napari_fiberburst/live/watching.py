"""A live source watched through an engine: a picture for every frame that there is time for, and how late it is."""

from collections.abc import Iterator
from dataclasses import dataclass

from napari_fiberburst.live.engine import LiveEngine
from napari_fiberburst.live.sources import LiveSource
from napari_fiberburst.live.view import LiveView


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Watched:
    """One picture of a live source.

    Attributes
    ----------
    view : LiveView
        The picture, and what to make of it.
    index : int
        Number of the frame.
    lag : float
        Seconds from when the frame was taken to its picture.
    dropped : int
        Frames passed over between the one before and this one.
    """

    view: LiveView
    index: int
    lag: float
    dropped: int


def watch(source: LiveSource, engine: LiveEngine) -> Iterator[Watched]:
    """Make a picture of the newest frame, again and again until the source ends.

    Raises
    ------
    BurstError
        As `LiveEngine.push`.
    """
    while len((got := source.latest()).frames):
        seconds = float(got.times[-1])
        view = engine.push(got.frames[-1], seconds)
        yield Watched(view=view, index=int(got.indices[-1]), lag=source.clock.now() - seconds, dropped=got.dropped)
