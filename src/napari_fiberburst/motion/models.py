"""The motion of frames: a plane projective transform each, moved along the generators of a model, and how they bend."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.coordinates import half_frame_from_pixel, transform_points
from napari_fiberburst.motion.displacement import ControlGrid, ControlWeights, Displacement

# Fixed-point iterations that invert a displacement, at most, and the step in pixels at which they end. Each leaves the
# error times the displacement's steepest slope.
_INVERSIONS, _INVERTED = 20, 1e-3
# Generators of sl(3) in coordinates of the half frame, in the order in which models grow.
_GENERATORS = torch.tensor(
    [
        [[0, 0, 1], [0, 0, 0], [0, 0, 0]],  # shift along x
        [[0, 0, 0], [0, 0, 1], [0, 0, 0]],  # shift along y
        [[0, -1, 0], [1, 0, 0], [0, 0, 0]],  # rotation
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


@dataclass(frozen=True, slots=True, eq=False)
class FrameMotion:
    """One transform per frame, on the manifold of its model (compositional, as in Lucas-Kanade 20 years on, 2004).

    A frame's point x lies in the scene at T x + D(x), T being its transform and D its displacement.

    Transforms are kept in float64 on the host, whatever the device; the points move on theirs.

    Attributes
    ----------
    scene_from_frame : Tensor
        (T, 3, 3) float64 in pixels.
    shape : (int, int)
        Height and width of a frame.
    displacement : Displacement or None
        How the frames bend; None for planes.
    """

    scene_from_frame: Tensor
    shape: tuple[int, int]
    displacement: Displacement | None = None

    @classmethod
    def still(cls, count: int, shape: tuple[int, int]) -> "FrameMotion":
        """Return the motion of so many frames that all lie on the scene as they are."""
        return cls(torch.eye(3, dtype=torch.float64).repeat(count, 1, 1), shape)

    @classmethod
    def of_shifts(cls, shifts: NDArray[np.float64], shape: tuple[int, int]) -> "FrameMotion":
        """Return pure translations (T, 2), pixels."""
        matrices = torch.eye(3, dtype=torch.float64).repeat(len(shifts), 1, 1)
        matrices[:, :2, 2] = torch.from_numpy(shifts)
        return cls(matrices, shape)

    @property
    def _half(self) -> float:
        """Half of the longer side, pixels: the unit of the generators."""
        return max(self.shape) / 2

    def apply(self, points: Tensor, controls: ControlWeights | None = None) -> Tensor:
        """Map frame points (N, 2) into the scene, by every frame: (T, N, 2).

        `controls` are the weights of the displacement's control points at these points, where they are known.
        """
        places: Tensor = transform_points(self._matrices(points), points)
        if self.displacement is None:
            return places
        return places + (self.displacement.at(points) if controls is None else controls(self.displacement.control).mT)

    def of_frame(self, number: int) -> "FrameMotion":
        """Return the motion of one frame alone."""
        displacement = None if self.displacement is None else self.displacement.of_frame(number)
        return replace(self, scene_from_frame=self.scene_from_frame[number : number + 1], displacement=displacement)

    def to_reference(self, places: Tensor, reference: int) -> Tensor:
        """Map scene points (..., 2) to the pixels of a reference frame.

        The reference's displacement is inverted by fixed-point iteration, y <- T^-1 (p - D(y)).
        """
        inverse = torch.linalg.inv(self.scene_from_frame[reference]).to(device=places.device, dtype=places.dtype)
        flat = places.reshape(-1, 2)
        found: Tensor = transform_points(inverse, flat)
        if self.displacement is not None:
            displacement = self.displacement.of_frame(reference)
            for _ in range(_INVERSIONS):
                before, found = found, transform_points(inverse, flat - displacement.at(found)[0])
                if float((found - before).abs().max()) < _INVERTED:
                    break
        return found.reshape(places.shape)

    def _matrices(self, like: Tensor) -> Tensor:
        return self.scene_from_frame.to(device=like.device, dtype=like.dtype)

    def cpu(self) -> "FrameMotion":
        """Return the motion with all of it on the host."""
        if self.displacement is None:
            return self
        return replace(self, displacement=replace(self.displacement, control=self.displacement.control.cpu()))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all of frames that bend, by name."""
        assert self.displacement is not None
        grid = self.displacement.grid
        return {
            "scene_from_frame": self.scene_from_frame.numpy(),
            "control": self.displacement.control.cpu().numpy(),
            "control_grid": np.array([grid.spacing, *grid.shape, *self.shape]),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]]) -> "FrameMotion | None":
        """Rebuild the motion from `arrays`; None where it is not among them, because the frames do not bend."""
        if "control" not in arrays:
            return None
        spacing, rows, columns, height, width = arrays["control_grid"].tolist()
        grid = ControlGrid(spacing, (int(rows), int(columns)))
        expected = (len(arrays["scene_from_frame"]), 2, grid.shape[0] * grid.shape[1])
        if arrays["control"].shape != expected or not 0 < spacing < np.inf:
            raise ValueError(f"control points are of shape {arrays['control'].shape}, expected {expected}")
        if arrays["scene_from_frame"].dtype != "float64" or arrays["scene_from_frame"].shape[1:] != (3, 3):
            raise ValueError(f"transforms are of shape {arrays['scene_from_frame'].shape}, expected (T, 3, 3) float64")
        displacement = Displacement(grid, torch.from_numpy(arrays["control"]))
        return cls(torch.from_numpy(arrays["scene_from_frame"]), (int(height), int(width)), displacement)

    def slopes(self, points: Tensor, along_x: Tensor, along_y: Tensor, dof: int) -> Tensor:
        """Return the slopes, per unit of each generator, of what has these slopes per pixel at scene points.

        Points (..., N, 2) and slopes (..., N) along x and y give (..., k, N).
        """
        height, width = self.shape
        x, y = (points[..., 0] - (width - 1) / 2) / self._half, (points[..., 1] - (height - 1) / 2) / self._half
        along_x, along_y = along_x * self._half, along_y * self._half
        radial = x * along_x + y * along_y
        rows = [
            along_x,
            along_y,
            x * along_y - y * along_x,
            radial,
            x * along_x - y * along_y,
            y * along_x + x * along_y,
            -x * radial,
            -y * radial,
        ]
        return torch.stack(rows[:dof], dim=-2)

    def moved(self, steps: Tensor) -> "FrameMotion":
        """Return the motion with each frame moved by its step (T, k) along the generators."""
        steps = steps.detach().cpu().double()
        change = torch.linalg.matrix_exp(torch.einsum("tk,kij->tij", steps, _GENERATORS[: steps.shape[1]]))
        half_from_pixel = torch.from_numpy(half_frame_from_pixel(self.shape))
        matrices = torch.linalg.inv(half_from_pixel) @ change @ half_from_pixel @ self.scene_from_frame
        return replace(self, scene_from_frame=matrices / matrices[:, 2:, 2:])

    def travel(self, steps: Tensor) -> float:
        """Return the largest displacement of a frame's centre by its step (T, k), pixels."""
        return float(steps[:, :2].detach().cpu().double().norm(dim=1).max()) * self._half

    def where(self, chosen: NDArray[np.bool_], other: "FrameMotion") -> "FrameMotion":
        """Return this motion for the frames that are chosen (T,), and the other one for the rest."""
        mask = torch.from_numpy(chosen)[:, None, None]
        return replace(self, scene_from_frame=torch.where(mask, self.scene_from_frame, other.scene_from_frame))

    def has_left(self, shifts: NDArray[np.float64], most: float) -> NDArray[np.bool_]:
        """Return which frames' transforms have run away, (T,).

        Parameters
        ----------
        shifts : numpy.ndarray
            (T, 2), where they were first found; a frame that goes farther than its own size from there has left.
        most : float
            So has one whose area has grown or shrunk by more than this factor.
        """
        height, width = self.shape
        corners = torch.tensor([[0, 0], [width, 0], [width, height], [0, height]], dtype=torch.float64)
        places = transform_points(self.scene_from_frame, corners).numpy()
        x, y = places[..., 0], places[..., 1]
        area = (x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y).sum(axis=1) / 2 / (height * width)
        distance = np.abs(places.mean(axis=1) - [width / 2, height / 2] - shifts).max(axis=1)
        left: NDArray[np.bool_] = ~((area > 1 / most) & (area < most) & (distance < max(width, height)))  # NaN has left
        return left
