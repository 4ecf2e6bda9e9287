"""Parts of a scene that are solved one by one, each with enough about it that its neighbours fit without a seam."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.recordings.track import Track


@dataclass(frozen=True, slots=True)
class Tile:
    """A part of a picture of one pixel to a node.

    Attributes
    ----------
    rows, columns : (int, int)
        The part [first, last) that is its own.
    grid : Grid
        Its nodes and those about it, in the piece's scene.
    halo : (int, int, int, int)
        So many nodes lie above, below, left and right of its own.
    """

    rows: tuple[int, int]
    columns: tuple[int, int]
    grid: Grid
    halo: tuple[int, int, int, int]

    def of_frames(self, track: Track, piece: int) -> NDArray[np.int64]:
        """Return the numbers of a piece's frames whose middle lies in the tile's own part."""
        frames = track.frames_of(piece)
        middle = track.corners(frames).mean(axis=1)
        above, _, left, _ = self.halo
        x0, y0 = self.grid.x0 + (left - 0.5) * self.grid.spacing, self.grid.y0 + (above - 0.5) * self.grid.spacing
        sides = np.array([self.columns[1] - self.columns[0], self.rows[1] - self.rows[0]]) * self.grid.spacing
        place = middle - (x0, y0)
        inside: NDArray[np.bool_] = ((place >= 0) & (place < sides)).all(axis=1)
        return frames[inside]

    @property
    def inner(self) -> tuple[slice, slice]:
        """Its own part of the nodes."""
        above, below, left, right = self.halo
        rows, columns = self.grid.shape
        return slice(above, rows - below), slice(left, columns - right)


def tiles_over(whole: Grid, side: int, halo: int, *, is_even: bool = False) -> Iterator[Tile]:
    """Return the tiles of a picture, row by row.

    Parameters
    ----------
    whole : Grid
        Of the picture.
    side : int
        Of a tile, nodes, at most.
    halo : int
        Nodes about each that are solved with it, where there are any.
    is_even : bool
        Whether tiles are of one size, rather than all but the last of this side.
    """
    rows, columns = whole.shape
    height, width = (_even(count, side) if is_even else side for count in whole.shape)
    for top in range(0, rows, height):
        for left in range(0, columns, width):
            bottom, right = min(top + height, rows), min(left + width, columns)
            first_row, first_column = max(0, top - halo), max(0, left - halo)
            last_row, last_column = min(rows, bottom + halo), min(columns, right + halo)
            grid = Grid(
                whole.x0 + first_column * whole.spacing,
                whole.y0 + first_row * whole.spacing,
                whole.spacing,
                (last_row - first_row, last_column - first_column),
            )
            yield Tile(
                (top, bottom),
                (left, right),
                grid,
                (top - first_row, last_row - bottom, left - first_column, last_column - right),
            )


def _even(count: int, most: int) -> int:
    """Return the side of as few parts of one size as make up a count."""
    return math.ceil(count / math.ceil(count / most))


def picture_of(track: Track, piece: int) -> Grid:
    """Return the nodes of all that a piece's frames see, one to a pixel of its first frame, at whole pixels."""
    x0, y0, x1, y1 = track.bounds(piece)
    left, top = math.floor(x0), math.floor(y0)
    return Grid(float(left), float(top), 1.0, (max(2, math.ceil(y1) - top + 1), max(2, math.ceil(x1) - left + 1)))


def pieces_tiled(track: Track, side: int, halo: int, *, is_even: bool = False) -> list[tuple[int, Tile]]:
    """Return the tiles of all pieces, as `tiles_over` has them, each with the number of its piece."""
    return [
        (piece, tile)
        for piece in range(track.pieces)
        if (track.piece == piece).any()
        for tile in tiles_over(picture_of(track, piece), side, halo, is_even=is_even)
    ]
