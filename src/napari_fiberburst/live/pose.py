"""Where a frame lies: a shift, a turn and a zoom, about the middle of the frame."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Pose:
    """A similarity: the pixel x of a frame lies at ``place + turn (x - middle)``, as complex numbers.

    Attributes
    ----------
    place : complex
        Where the middle of the frame lies, x + i y, pixels.
    turn : complex
        Zoom times exp(i angle).
    middle : complex
        Of the frame, pixels.
    """

    place: complex
    turn: complex
    middle: complex

    @classmethod
    def at_rest(cls, shape: tuple[int, int]) -> "Pose":
        """Return the pose of a frame (height, width) that lies on its own pixels."""
        middle = complex((shape[1] - 1) / 2, (shape[0] - 1) / 2)
        return cls(middle, 1 + 0j, middle)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The pose as a matrix (3, 3) of points (x, y)."""
        a, b = self.turn.real, self.turn.imag
        start = self.place - self.turn * self.middle
        return np.array([[a, -b, start.real], [b, a, start.imag], [0, 0, 1]])

    def points(self, positions: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return where points (N,) of the frame lie, as complex numbers."""
        placed: NDArray[np.complex128] = self.turn * positions + (self.place - self.turn * self.middle)
        return placed

    def moved(self, shift: complex, turn: complex = 1 + 0j) -> "Pose":
        """Return the pose of a frame that has turned about its middle, and then been shifted."""
        return Pose(self.place + shift, self.turn * turn, self.middle)

    def corner_motion(self) -> float:
        """Return by how many pixels turn and zoom alone move the corner of the frame."""
        return abs(self.turn - 1) * abs(self.middle)
