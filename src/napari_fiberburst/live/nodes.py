"""Nodes a pixel apart, and bilinear interpolation between them, in numpy: a few thousand points cost little there."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Nodes:
    """Where nodes are.

    Attributes
    ----------
    x0, y0 : int
        The first node, pixels.
    rows, columns : int
        How many.
    """

    x0: int
    y0: int
    rows: int
    columns: int

    def holds(self, low: complex, high: complex, margin: float) -> bool:
        """Return whether all nodes from one corner (x + i y) to the other are there, and so many about them."""
        return (
            self.x0 <= low.real - margin
            and self.y0 <= low.imag - margin
            and high.real + margin <= self.x0 + self.columns - 1
            and high.imag + margin <= self.y0 + self.rows - 1
        )

    def about(self, middle: complex) -> "Nodes":
        """Return as many nodes about another middle."""
        x0 = round(middle.real - (self.columns - 1) / 2)
        y0 = round(middle.imag - (self.rows - 1) / 2)
        return Nodes(x0, y0, self.rows, self.columns)

    def corners(self, points: NDArray[np.complex128]) -> "Corners":
        """Return the nodes about points (N,), x + i y."""
        x, y = (points.real - self.x0).astype(np.float32), (points.imag - self.y0).astype(np.float32)
        inside = (x >= 0) & (x < self.columns - 1) & (y >= 0) & (y < self.rows - 1)
        if not inside.all():
            x, y = np.where(inside, x, np.float32(0)), np.where(inside, y, np.float32(0))
        column, row = x.astype(np.int32), y.astype(np.int32)
        first = row.astype(np.int64) * self.columns + column
        return Corners(self, first, x - column.astype(np.float32), y - row.astype(np.float32), inside)


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """The four nodes about points (N,).

    Attributes
    ----------
    nodes : Nodes
        Of which.
    first : numpy.ndarray
        (N,) int64, number of the upper left one.
    x, y : numpy.ndarray
        (N,) float32, from there to the point, 0 to 1.
    inside : numpy.ndarray
        (N,) bool, which points lie between nodes; the others are said to lie at the first node.
    """

    nodes: Nodes
    first: NDArray[np.int64]
    x: Floats
    y: Floats
    inside: NDArray[np.bool_]

    def read(self, image: Floats) -> Floats:
        """Return an image (rows, columns) at the points, (N,)."""
        a, b, c, d = self._values(image)
        top, bottom = a + (b - a) * self.x, c + (d - c) * self.x
        read: Floats = top + (bottom - top) * self.y
        return read

    def read_with_slopes(self, image: Floats) -> tuple[Floats, Floats, Floats]:
        """Return an image (rows, columns) at the points, and its slopes along x and y there, (N,) each."""
        a, b, c, d = self._values(image)
        above, below = b - a, d - c
        top, bottom = a + above * self.x, c + below * self.x
        along_y = bottom - top
        along_x: Floats = np.asarray(above + (below - above) * self.y, np.float32)
        return np.asarray(top + along_y * self.y, np.float32), along_x, np.asarray(along_y, np.float32)

    def _values(self, image: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        flat, step = image.reshape(-1), self.nodes.columns
        first = self.first
        return flat[first], flat[first + 1], flat[first + step], flat[first + step + 1]
