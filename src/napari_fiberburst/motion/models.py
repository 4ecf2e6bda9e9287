"""The motion of frames: one plane projective transform each, moved along the generators of a chosen model."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.coordinates import half_frame_from_pixel, transform_points

# Generators of sl(3) in coordinates of the half frame, in the order in which models grow.
_GENERATORS = torch.tensor(
    [
        [[0, 0, 1], [0, 0, 0], [0, 0, 0]],  # shift along x
        [[0, 0, 0], [0, 0, 1], [0, 0, 0]],  # shift along y
        [[0, -1, 0], [1, 0, 0], [0, 0, 0]],  # turn
        [[1 / 3, 0, 0], [0, 1 / 3, 0], [0, 0, -2 / 3]],  # scale
        [[1, 0, 0], [0, -1, 0], [0, 0, 0]],  # stretch along x against y
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],  # stretch along the diagonals
        [[0, 0, 0], [0, 0, 0], [1, 0, 0]],  # perspective along x
        [[0, 0, 0], [0, 0, 0], [0, 1, 0]],  # perspective along y
    ],
    dtype=torch.float64,
)


def generators(dof: int) -> Tensor:
    """Return the first generators of sl(3), (k, 3, 3) float64, in coordinates of the half frame."""
    return _GENERATORS[:dof].clone()


class FrameMotion:
    """One transform per frame, on the manifold of its model (compositional, as in Lucas-Kanade 20 years on, 2004).

    Transforms are kept in float64 on the host, whatever the device; the points move on theirs.

    Parameters
    ----------
    count : int
        T.
    shape : (int, int)
        Height and width of a frame.

    Attributes
    ----------
    scene_from_frame : Tensor
        (T, 3, 3) float64 in pixels.
    """

    def __init__(self, count: int, shape: tuple[int, int]) -> None:
        height, width = shape
        self.half = max(height, width) / 2
        self.centre = torch.tensor([(width - 1) / 2, (height - 1) / 2])
        self.scene_from_frame = torch.eye(3, dtype=torch.float64).repeat(count, 1, 1)
        self._unit = torch.from_numpy(half_frame_from_pixel(shape))

    def shift(self, translations: NDArray[np.float64]) -> None:
        """Set pure translations (T, 2), pixels."""
        self.scene_from_frame[:, :2, 2] = torch.from_numpy(translations)

    def apply(self, points: Tensor) -> Tensor:
        """Map frame points (N, 2) into the scene, by every frame: (T, N, 2)."""
        return transform_points(self.scene_from_frame.to(device=points.device, dtype=points.dtype), points)

    def tangent(self, points: Tensor, dof: int) -> tuple[Tensor, Tensor]:
        """Return how scene points (..., 2) move, in pixels along x and y, per unit of each generator: (..., k)."""
        x, y = ((points - self.centre.to(points)) / self.half).unbind(dim=-1)
        one, zero = torch.ones_like(x), torch.zeros_like(x)
        along_x = torch.stack([one, zero, -y, x, x, y, -x * x, -x * y][:dof], dim=-1)
        along_y = torch.stack([zero, one, x, y, -y, x, -x * y, -y * y][:dof], dim=-1)
        return along_x * self.half, along_y * self.half

    def move(self, steps: Tensor) -> Tensor:
        """Move each frame by its step (T, k) along the generators; return how far its centre goes, pixels (T,)."""
        steps = steps.detach().cpu().double()
        change = torch.linalg.matrix_exp(torch.einsum("tk,kij->tij", steps, _GENERATORS[: steps.shape[1]]))
        moved = torch.linalg.inv(self._unit) @ change @ self._unit @ self.scene_from_frame
        self.scene_from_frame = moved / moved[:, 2:, 2:]
        moved_by: Tensor = steps[:, :2].norm(dim=1) * self.half
        return moved_by

    def has_left(self, shifts: NDArray[np.float64], most: float) -> NDArray[np.bool_]:
        """Return which frames' transforms have run away, (T,).

        Parameters
        ----------
        shifts : numpy.ndarray
            (T, 2), where they were first found; a frame that goes farther than its own size from there has left.
        most : float
            So has one whose area has grown or shrunk by more than this factor.
        """
        width, height = (2 * self.centre + 1).tolist()
        corners = torch.tensor([[0, 0], [width, 0], [width, height], [0, height]], dtype=torch.float64)
        places = transform_points(self.scene_from_frame, corners).numpy()
        x, y = places[..., 0], places[..., 1]
        area = (x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y).sum(axis=1) / 2 / (height * width)
        way = np.abs(places.mean(axis=1) - [width / 2, height / 2] - shifts).max(axis=1)
        left: NDArray[np.bool_] = ~((area > 1 / most) & (area < most) & (way < max(width, height)))  # NaN has left
        return left
