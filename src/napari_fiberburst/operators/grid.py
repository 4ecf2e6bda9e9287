"""An image as a linear spline: values on a regular grid of nodes, bilinear between them."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from napari_fiberburst.errors import SettingsError
from napari_fiberburst.operators.stencil import Stencil

# Grids beyond this are a sign of a motion gone wrong, not of an image.
_MOST_NODES = 2**27


@dataclass(frozen=True, slots=True)
class Grid:
    """Where the nodes lie: node (row i, column j) at (x0 + j spacing, y0 + i spacing), in frame-0 pixels.

    Attributes
    ----------
    x0, y0 : float
        The first node.
    spacing : float
        Pixels from node to node.
    shape : (int, int)
        Rows and columns of nodes.
    """

    x0: float
    y0: float
    spacing: float
    shape: tuple[int, int]

    @classmethod
    def over(cls, bounds: tuple[float, float, float, float], spacing: float) -> "Grid":
        """Cover x0, y0, x1, y1 with nodes; the first one at (x0, y0)."""
        x0, y0, x1, y1 = bounds
        rows, columns = (max(2, math.ceil((stop - start) / spacing) + 1) for start, stop in ((y0, y1), (x0, x1)))
        if not rows * columns <= _MOST_NODES:
            raise SettingsError(
                f"a scene over {bounds} at {1 / spacing:g} nodes a pixel is too large; use a smaller upsample or crop"
            )
        return cls(x0, y0, spacing, (rows, columns))

    @classmethod
    def around(cls, points: Tensor, spacing: float, margin: float) -> "Grid":
        """Cover all finite points (..., 2) and a margin about them, pixels."""
        flat = points.reshape(-1, 2)
        flat = flat[torch.isfinite(flat).all(dim=1)]
        x0, y0 = (flat.amin(dim=0) - margin).tolist()
        x1, y1 = (flat.amax(dim=0) + margin).tolist()
        return cls.over((x0, y0, x1, y1), spacing)

    def nodes(self, device: torch.device | None = None) -> Tensor:
        """Return the position (x, y) of every node, (rows, columns, 2)."""
        rows, columns = (torch.arange(count, device=device) * self.spacing for count in self.shape)
        y, x = torch.meshgrid(rows + self.y0, columns + self.x0, indexing="ij")
        return torch.stack([x, y], dim=-1)

    def at(self, points: Tensor) -> "Sampling":
        """Return the operator that samples images at points (..., 2)."""
        return Sampling(self, points)


class Sampling:
    """Bilinear interpolation at fixed points: calling it samples an image, its adjoint splats values onto the nodes.

    Parameters
    ----------
    grid : Grid
        The nodes.
    points : Tensor
        (..., 2) as (x, y). What lies outside the nodes is sampled as 0 and splats nothing.

    Attributes
    ----------
    inside : Tensor
        (...) bool, which points lie between nodes.
    """

    def __init__(self, grid: Grid, points: Tensor) -> None:
        self.grid = grid
        rows, columns = grid.shape
        x = (points[..., 0] - grid.x0) / grid.spacing
        y = (points[..., 1] - grid.y0) / grid.spacing
        self.inside = (x >= 0) & (x <= columns - 1) & (y >= 0) & (y <= rows - 1)  # NaN is outside
        x = torch.where(self.inside, x, torch.zeros_like(x))
        y = torch.where(self.inside, y, torch.zeros_like(y))
        column, row = x.floor().clamp(max=columns - 2), y.floor().clamp(max=rows - 2)
        self._x, self._y = x - column, y - row
        first = (row * columns + column).long() if rows * columns < 2**24 else row.long() * columns + column.long()
        self._index = torch.stack([first, first + 1, first + columns, first + columns + 1], dim=-1)
        left, above = 1 - self._x, 1 - self._y
        corners = torch.stack([left * above, self._x * above, left * self._y, self._x * self._y], dim=-1)
        self._weight = corners * self.inside.unsqueeze(-1)

    def __call__(self, image: Tensor) -> Tensor:
        """Return an image (H, W) at the points, (...)."""
        values: Tensor = (image.reshape(-1)[self._index] * self._weight).sum(dim=-1)
        return values

    def adjoint(self, values: Tensor) -> Tensor:
        """Return what values (...) at the points add to the nodes, (H, W)."""
        return self._add(values.unsqueeze(-1) * self._weight, self._index)

    def of_channels(self, images: Tensor) -> Tensor:
        """Return images (C, H, W) at the points, (..., C)."""
        return torch.stack([self(image) for image in images], dim=-1)

    def gradient(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return the image's slope per pixel along x and along y at the points; 0 outside."""
        a, b, c, d = image.reshape(-1)[self._index].unbind(dim=-1)
        scale = self.inside / self.grid.spacing
        along_x = ((1 - self._y) * (b - a) + self._y * (d - c)) * scale
        along_y = ((1 - self._x) * (c - a) + self._x * (d - b)) * scale
        return along_x, along_y

    def normal_diagonal(self, weights: Tensor) -> Tensor:
        """Return the diagonal of S' W S, (H, W), S being this operator and W weights (...)."""
        return self._add(weights.unsqueeze(-1) * self._weight.square(), self._index)

    def normal(self, weights: Tensor) -> Stencil:
        """Return S' W S: each node is coupled to its eight neighbours alone."""
        a, b, c, d = self._weight.unbind(dim=-1)
        ia, ib, ic, _ = self._index.unbind(dim=-1)
        first, weight = torch.stack([ia, ic], dim=-1), weights.unsqueeze(-1)
        right = self._add(weight * torch.stack([a * b, c * d], dim=-1), first)
        below = self._add(weight * torch.stack([a * c, b * d], dim=-1), torch.stack([ia, ib], dim=-1))
        below_right = self._add(weights * a * d, ia)
        below_left = self._add(weights * b * c, ib)
        return Stencil(torch.stack([self.normal_diagonal(weights), right, below, below_right, below_left]))

    def _add(self, values: Tensor, index: Tensor) -> Tensor:
        rows, columns = self.grid.shape
        total = torch.zeros(rows * columns, dtype=values.dtype, device=values.device)
        total.scatter_add_(0, index.reshape(-1), values.reshape(-1))
        return total.reshape(rows, columns)
