"""An image as a linear spline: values on a regular grid of nodes, bilinear between them."""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from napari_fiberburst.errors import SettingsError
from napari_fiberburst.operators.stencil import Stencil

# Grids beyond this are a sign of a motion gone wrong, not of an image.
_MOST_NODES = 2**27
# Where what lies outside is put, in halves of the grid from its middle: there, torch samples 0.
_BEYOND = -3.0


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
    def around(cls, points: Tensor, spacing: float, margin: float, among: Tensor | None = None) -> "Grid":
        """Cover all finite points (..., 2), or those of them that `among` (...) tells, and a margin about them, pixels.

        Part by part, because a copy of all points would take much memory.
        """
        parts = points.reshape(-1, *points.shape[-2:])
        chosen = [slice(None)] * len(parts) if among is None else among.reshape(-1, points.shape[-2])
        corners = [corner for part, some in zip(parts, chosen, strict=True) for corner in _corners_of(part[some])]
        x0, y0 = (torch.stack(corners).amin(dim=0) - margin).tolist()
        x1, y1 = (torch.stack(corners).amax(dim=0) + margin).tolist()
        return cls.over((x0, y0, x1, y1), spacing)

    def part_about(self, points: Tensor) -> tuple["Grid", tuple[slice, slice]]:
        """Return the part of this grid that points (..., 2) lie in, and which rows and columns that is."""
        flat = points.reshape(-1, 2)
        flat = flat[self.at(flat).inside]
        place = (flat - flat.new_tensor([self.x0, self.y0])) / self.spacing
        low, high = (place.amin(dim=0), place.amax(dim=0)) if len(flat) else (torch.zeros(2), torch.zeros(2))
        left, top = (min(math.floor(at), count - 2) for at, count in zip(low, reversed(self.shape), strict=True))
        right, bottom = (max(math.ceil(at), first + 1) for at, first in zip(high, (left, top), strict=True))
        part = Grid(
            self.x0 + left * self.spacing,
            self.y0 + top * self.spacing,
            self.spacing,
            (bottom - top + 1, right - left + 1),
        )
        return part, (slice(top, bottom + 1), slice(left, right + 1))

    def nodes(self, device: torch.device | None = None) -> Tensor:
        """Return the position (x, y) of every node, (rows, columns, 2)."""
        rows, columns = (torch.arange(count, device=device) * self.spacing for count in self.shape)
        y, x = torch.meshgrid(rows + self.y0, columns + self.x0, indexing="ij")
        return torch.stack([x, y], dim=-1)

    def at(self, points: Tensor) -> "Sampling":
        """Return the operator that samples images at points (..., 2)."""
        return Sampling(self, points)

    def along(self, paths: Tensor) -> "PathSampling":
        """Return the operator that samples the means of images along paths (..., K, 2) of K points."""
        return PathSampling(self, paths)

    def of_looks(self, looks: Tensor) -> "Sampling | PathSampling":
        """Return the operator of samples that look at points (N, 2), or along paths (N, K, 2)."""
        return self.at(looks) if looks.dim() == 2 else self.along(looks)


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
        rows, columns = grid.shape
        x, y = points.unbind(dim=-1)
        x, y = (x - grid.x0) / grid.spacing, (y - grid.y0) / grid.spacing
        self.grid = grid
        self.inside = (x >= 0) & (x <= columns - 1) & (y >= 0) & (y <= rows - 1)  # NaN is outside
        self._place = x, y

    def __call__(self, image: Tensor) -> Tensor:
        """Return an image (H, W) at the points, (...)."""
        return self._read(image[None])[0]

    def adjoint(self, values: Tensor) -> Tensor:
        """Return what values (...) at the points add to the nodes, (H, W)."""
        return self._add(values * self._corners.weight, self._corners.index)

    def of_channels(self, images: Tensor) -> Tensor:
        """Return images (C, H, W) at the points, (..., C)."""
        return self._read(images).movedim(0, -1)

    def with_slopes(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the image at the points, and its slopes per pixel along x and along y there; 0 outside."""
        index, x, y = self._corners.index, self._corners.x, self._corners.y
        a, b, c, d = image.reshape(-1).index_select(0, index.reshape(-1)).reshape(index.shape)
        along_x, along_y = torch.lerp(b - a, d - c, y), torch.lerp(c - a, d - b, x)
        scale = self.inside / self.grid.spacing
        return torch.lerp(a, b, x).addcmul_(y, along_y).mul_(self.inside), along_x * scale, along_y * scale

    def normal_diagonal(self, weights: Tensor) -> Tensor:
        """Return the diagonal of S' W S, (H, W), S being this operator and W weights (...)."""
        return self._add(weights * self._corners.weight.square(), self._corners.index)

    def normal(self, weights: Tensor) -> Stencil:
        """Return S' W S: each node is coupled to its eight neighbours alone."""
        a, b, c, d = self._corners.weight
        first = self._corners.index
        weighted_a, weighted_d = weights * a, weights * d
        right = self._add(torch.stack([weighted_a * b, weighted_d * c]), first[[0, 2]])
        below = self._add(torch.stack([weighted_a * c, weighted_d * b]), first[:2])
        below_right = self._add(weighted_a * d, first[0])
        below_left = self._add(weights * b * c, first[1])
        return Stencil(torch.stack([self.normal_diagonal(weights), right, below, below_right, below_left]))

    @cached_property
    def _normalised(self) -> Tensor:
        """The points in units of half the grid about its middle, (1, 1, M, 2), as torch samples images."""
        halves = ((side - 1) / 2 for side in reversed(self.grid.shape))
        parts = [
            torch.where(self.inside, part / half - 1, _BEYOND) for part, half in zip(self._place, halves, strict=True)
        ]
        return torch.stack(parts, dim=-1).reshape(1, 1, -1, 2)

    @cached_property
    def _corners(self) -> "_Corners":
        """The nodes about each point; only what is splatted needs them."""
        return _Corners.of(self._place, self.inside, self.grid.shape)

    def _read(self, images: Tensor) -> Tensor:
        """Return images (C, H, W) at the points, (C, ...).

        Torch's own interpolation does in one pass what indexing does in five.
        """
        dtype = torch.promote_types(images.dtype, self._normalised.dtype)
        places = self._normalised.to(dtype)
        values = torch.nn.functional.grid_sample(images[None].to(dtype), places, align_corners=True)
        return values.reshape(len(images), *self.inside.shape)

    def _add(self, values: Tensor, index: Tensor) -> Tensor:
        rows, columns = self.grid.shape
        total = torch.zeros(rows * columns, dtype=values.dtype, device=values.device)
        total.scatter_add_(0, index.reshape(-1), values.reshape(-1))
        return total.reshape(rows, columns)


class PathSampling:
    """The mean over K fixed points for each sample, as `Sampling` interpolates at them.

    Parameters
    ----------
    grid : Grid
        The nodes.
    paths : Tensor
        (..., K, 2) as (x, y).

    Attributes
    ----------
    inside : Tensor
        (...) bool, which paths lie between nodes.
    """

    def __init__(self, grid: Grid, paths: Tensor) -> None:
        self._points = grid.at(paths)
        self.inside = self._points.inside.all(dim=-1)

    def __call__(self, image: Tensor) -> Tensor:
        """Return the means of an image (H, W), (...)."""
        return self._points(image).mean(dim=-1)

    def adjoint(self, values: Tensor) -> Tensor:
        """Return what values (...) add to the nodes, (H, W)."""
        count = self._points.inside.shape[-1]
        return self._points.adjoint((values / count)[..., None].expand(*values.shape, count))

    def with_slopes(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the means of an image (H, W), and of its slopes per pixel along x and along y; 0 outside."""
        light, along_x, along_y = (part.mean(dim=-1) for part in self._points.with_slopes(image))
        return light, along_x, along_y

    def of_channels(self, images: Tensor) -> Tensor:
        """Return the means of images (C, H, W), (..., C)."""
        return self._points.of_channels(images).mean(dim=-2)


@dataclass(frozen=True, slots=True, eq=False)
class _Corners:
    """The four nodes about points (...): upper left, upper right, lower left and lower right.

    Attributes
    ----------
    x, y : Tensor
        (...) from the upper left one to the point, nodes.
    index : Tensor
        (4, ...) int64, their numbers.
    weight : Tensor
        (4, ...), how much of the point each has; 0 of points outside.
    """

    x: Tensor
    y: Tensor
    index: Tensor
    weight: Tensor

    @classmethod
    def of(cls, place: tuple[Tensor, Tensor], inside: Tensor, shape: tuple[int, int]) -> "_Corners":
        """Return the nodes about places (x and y, each (...)), in nodes from the first."""
        rows, columns = shape
        x, y = (torch.where(inside, part, torch.zeros_like(part)) for part in place)
        column, row = x.floor().clamp(max=columns - 2), y.floor().clamp(max=rows - 2)
        x, y = x - column, y - row
        first = row.long() * columns + column.long()
        below, right = y * inside, x
        above = (1 - y) * inside
        weight = torch.stack([(1 - right) * above, right * above, (1 - right) * below, right * below])
        return cls(x, y, torch.stack([first, first + 1, first + columns, first + columns + 1]), weight)


def _corners_of(points: Tensor) -> tuple[Tensor, ...]:
    """Return two corners of the box about finite points (N, 2); none where there are none."""
    finite = points[torch.isfinite(points).all(dim=1)]
    return (finite.amin(dim=0), finite.amax(dim=0)) if len(finite) else ()
