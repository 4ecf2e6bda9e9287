"""The frames about one frame, and their normal equations, which move on with it.

Normal equations are sums over frames, so a window adds those of the frame that comes and takes away those of the one
that goes: it costs the same for five frames and for fifty.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.recordings.track import Track
from napari_fiberburst.scene.spline import NormalEquations

# A window that sets itself has seen each place by cores as far apart as this part of the pitch: so many pitches of way
# are needed, and so many frames at least and at most.
_WAY, _FEWEST, _MOST = 4.0, 9, 31
# Sides of grids are whole multiples of this, so that filters made for one serve many.
_EVEN = 8


def window_for(track: Track, pitch: float) -> int:
    """Return how many frames a window needs so that what moves between cores is seen; an odd number."""
    middle = track.corners(np.arange(len(track))).mean(axis=1)
    follows = (track.piece[1:] == track.piece[:-1]) & (track.piece[1:] >= 0)
    steps = np.linalg.norm(np.diff(middle, axis=0), axis=1)[follows]
    if not len(steps):
        return _FEWEST
    needed = _WAY * pitch / max(float(np.median(steps)), 1e-3)
    return int(np.clip(math.ceil(needed) // 2 * 2 + 1, _FEWEST, _MOST))


def frames_about(track: Track, number: int, width: int) -> NDArray[np.int64]:
    """Return the numbers of a frame and those nearest to it in time that see some of what it sees.

    As many as `width`, of the same piece: also at its ends, where they lie on one side.
    """
    frames = track.frames_of(int(track.piece[number]))
    place = int(np.searchsorted(frames, number))
    first = int(np.clip(place - width // 2, 0, max(0, len(frames) - width)))
    frames = frames[first : first + width]
    # Those about a gap are no neighbours.
    frames = frames[np.abs(frames - number) <= 2 * width]
    middle = track.corners(frames).mean(axis=1)
    own = middle[int(np.searchsorted(frames, number))]
    height, across = track.shape
    near: NDArray[np.bool_] = (np.abs(middle - own) < (across, height)).all(axis=1)
    return frames[near]


def view_of(track: Track, number: int, margin: float) -> Grid:
    """Return the nodes of what a frame sees and of a margin about it, one to a pixel of its scene, at whole pixels."""
    corners = track.corners(np.array([number]))[0]
    x0, y0 = (math.floor(edge) for edge in corners.min(axis=0) - margin)
    x1, y1 = corners.max(axis=0) + margin
    rows, columns = (math.ceil((math.ceil(end) - start + 2) / _EVEN) * _EVEN for start, end in ((y0, y1), (x0, x1)))
    return Grid(float(x0), float(y0), 1.0, (rows, columns))


def union(grids: list[Grid]) -> Grid:
    """Return the nodes of all of some grids, a pixel apart, at whole pixels."""
    x0, y0 = min(grid.x0 for grid in grids), min(grid.y0 for grid in grids)
    rows = max(grid.y0 + grid.shape[0] for grid in grids) - y0
    columns = max(grid.x0 + grid.shape[1] for grid in grids) - x0
    return Grid(x0, y0, 1.0, (round(rows), round(columns)))


class Window:
    """The normal equations of some frames, which come and go.

    Parameters
    ----------
    assembled : callable
        Gives the equations of one frame by its number, on a grid of its own.
    """

    def __init__(self, assembled: Callable[[int], NormalEquations]) -> None:
        self._assembled = assembled
        self._held: dict[int, NormalEquations] = {}
        self._total: NormalEquations | None = None

    def about(self, frames: NDArray[np.int64], grid: Grid) -> NormalEquations:
        """Return the equations of frames on a grid; those that were there before are not added again."""
        wanted = frames.tolist()
        gone = [self._held.pop(number) for number in set(self._held) - set(wanted)]
        new = {number: self._assembled(number) for number in wanted if number not in self._held}
        if self._total is None or not self._held:
            # Nothing is left of what was: nor are the errors of its sums.
            some = next(iter(new.values())) if not self._held else next(iter(self._held.values()))
            gone, self._total = [], _nothing_like(some)
        # All that is held, so that a frame can be taken away as it was added, wherever the window has moved since.
        held = union([part.grid for part in (*self._held.values(), *new.values())])
        around = union([held, *(part.grid for part in gone)])
        total = self._total.on(around)
        for part in gone:
            total = total - part.on(around)
        for part in new.values():
            total = total + part.on(around)
        self._held |= new
        self._total = total.on(held)
        return self._total.on(grid)


def _nothing_like(some: NormalEquations) -> NormalEquations:
    return NormalEquations.empty(some.grid, some.radius, len(some.rhs), torch.device("cpu"))
