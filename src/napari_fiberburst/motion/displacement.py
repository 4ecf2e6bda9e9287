"""How frames bend beyond their homographies: smooth displacements on a grid of control points.

A displacement is a uniform cubic B-spline over the frame, which is smooth in its slopes (Rueckert et al., "Nonrigid
registration using free-form deformations", IEEE Transactions on Medical Imaging 18(8), 1999).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import shift
from torch import Tensor

from napari_fiberburst.operators.grid import Grid

# Nodes from one control point to the next of a table. Between them, a linear spline is off by 1/2000 of the second
# difference of control points, along x and along y.
_NODES = 16


@dataclass(frozen=True, slots=True)
class ControlGrid:
    """Control points over a frame, and one row or column beyond what its splines reach.

    Attributes
    ----------
    spacing : float
        Pixels from one control point to the next; the first but one lies on pixel (0, 0).
    shape : (int, int)
        Rows and columns of control points.
    """

    spacing: float
    shape: tuple[int, int]

    @classmethod
    def over(cls, shape: tuple[int, int], spacing: float) -> "ControlGrid":
        """Cover a frame (height, width)."""
        rows, columns = (math.floor(max(1, side - 1) / spacing) + 4 for side in shape)
        return cls(spacing, (rows, columns))

    def splines(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return which control points frame points (N, 2) depend on, and by what weights: (N, 16) each.

        Beyond the frame, what its edge has goes on.
        """
        rows, columns = self.shape
        limits = torch.tensor([columns - 2, rows - 2]).to(points)
        place = torch.minimum((points / self.spacing + 1).clamp_min(1), limits - 1e-4)
        first = place.floor()
        along_x, along_y = (_cubic(part) for part in (place - first).unbind(dim=-1))
        steps = torch.arange(-1, 3, device=points.device)
        column, row = (part.long()[:, None] + steps for part in first.unbind(dim=-1))
        index = row[:, :, None] * columns + column[:, None, :]
        return index.flatten(1), (along_y[:, :, None] * along_x[:, None, :]).flatten(1)

    @property
    def nodes(self) -> Grid:
        """The nodes of a table over what the splines cover."""
        rows, columns = (_NODES * (count - 3) + 1 for count in self.shape)
        return Grid(0.0, 0.0, self.spacing / _NODES, (rows, columns))

    def table(self, control: Tensor) -> Tensor:
        """Return the values of splines (..., M) at the nodes of a table, (..., rows, columns)."""
        table: Tensor = control.reshape(*control.shape[:-1], *self.shape)
        for axis in (-1, -2):
            table = _between(table.movedim(axis, -1)).movedim(-1, axis)
        return table

    def at(self, points: Tensor) -> "ControlWeights":
        """Return the operator from values at control points to values at frame points (N, 2)."""
        index, weight = self.splines(points)
        size = self.shape[0] * self.shape[1]
        order = index.flatten().argsort(stable=True)
        number = torch.arange(len(points), device=points.device).repeat_interleave(index.shape[1])
        counts = torch.bincount(index.flatten(), minlength=size)
        return ControlWeights(
            to_points=_Rows.of(index, weight),
            to_controls=_Rows(number[order], counts.cumsum(0) - counts, weight.flatten()[order]),
        )


def _between(values: Tensor) -> Tensor:
    """Return cubic splines of control values (..., K) at the nodes of a table, (..., _NODES (K - 3) + 1)."""
    weight = _cubic(torch.arange(_NODES, device=values.device).to(values) / _NODES)
    inner = (values.unfold(-1, 4, 1)[..., None, :] * weight).sum(dim=-1).flatten(-2)
    last = (values[..., -4:] * _cubic(values.new_ones(1))).sum(dim=-1, keepdim=True)
    return torch.cat([inner, last], dim=-1)


def _cubic(offset: Tensor) -> Tensor:
    """Return the four cubic B-splines at offsets (N,) in [0, 1] from the second of their knots, (N, 4)."""
    rest = 1 - offset
    splines = [
        rest**3,
        3 * offset**3 - 6 * offset**2 + 4,
        3 * rest**3 - 6 * rest**2 + 4,
        offset**3,
    ]
    return torch.stack(splines, dim=-1) / 6


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """A sparse matrix, row by row.

    Torch sums "bags" of an embedding, which is this product, many times as fast as it multiplies its sparse tensors.

    Attributes
    ----------
    columns : Tensor
        (K,) int64, of each entry.
    first : Tensor
        (R,) int64, each row's first entry.
    entries : Tensor
        (K,).
    """

    columns: Tensor
    first: Tensor
    entries: Tensor

    @classmethod
    def of(cls, columns: Tensor, entries: Tensor) -> "_Rows":
        """Return a matrix of as many entries in each row, both (R, k)."""
        first = torch.arange(0, columns.numel(), columns.shape[1], device=columns.device)
        return cls(columns.flatten(), first, entries.flatten())

    def __matmul__(self, values: Tensor) -> Tensor:
        """Return the product with each of values (..., columns): (..., R)."""
        table = values.reshape(-1, values.shape[-1]).T.contiguous()
        found = torch.nn.functional.embedding_bag(
            self.columns, table, self.first, mode="sum", per_sample_weights=self.entries.to(table)
        )
        return found.T.reshape(*values.shape[:-1], -1)


@dataclass(frozen=True, slots=True, eq=False)
class ControlWeights:
    """Interpolation from M control points to N places, and its adjoint.

    Attributes
    ----------
    to_points, to_controls : _Rows
        N rows of M columns, and the same transposed.
    """

    to_points: _Rows
    to_controls: _Rows

    def __call__(self, control: Tensor) -> Tensor:
        """Return values (..., M) of control points at the places, (..., N)."""
        return self.to_points @ control

    def adjoint(self, values: Tensor) -> Tensor:
        """Return what values (..., N) at the places add to the control points, (..., M)."""
        return self.to_controls @ values

    def normal_diagonal(self, weights: Tensor) -> Tensor:
        """Return the diagonal of S' W S for weights (..., N): (..., M)."""
        return replace(self.to_controls, entries=self.to_controls.entries.square()) @ weights


@dataclass(frozen=True, slots=True, eq=False)
class Displacement:
    """How every frame bends: what is added to the places that its homography gives, scene pixels.

    Attributes
    ----------
    grid : ControlGrid
        Over the frame.
    control : Tensor
        (T, 2, M), of the control points along x and y.
    """

    grid: ControlGrid
    control: Tensor

    @classmethod
    def none(cls, count: int, grid: ControlGrid, device: torch.device) -> "Displacement":
        """Return the displacement of so many frames that do not bend."""
        return cls(grid, torch.zeros(count, 2, grid.shape[0] * grid.shape[1], device=device))

    def at(self, points: Tensor) -> Tensor:
        """Return the displacement of every frame at points (N, 2), (T, N, 2).

        Many points read it from a table, because four nodes are sooner read than sixteen splines.
        """
        nodes, control = self.grid.nodes, self.control.to(points)
        if len(points) <= math.prod(nodes.shape):
            return (_Rows.of(*self.grid.splines(points)) @ control).mT
        rows, columns = nodes.shape
        last = points.new_tensor([columns - 1, rows - 1]) * nodes.spacing
        read = nodes.at(torch.minimum(points.clamp_min(0), last))
        return torch.stack([read.of_channels(frame) for frame in self.grid.table(control)])

    def of_frame(self, number: int) -> "Displacement":
        """Return the displacement of one frame alone."""
        return Displacement(self.grid, self.control[number : number + 1])

    def moved(self, offsets: Tensor) -> "Displacement":
        """Return what bends every frame where its points are moved by its offset (T, 2), pixels.

        Values of control points are interpolated linearly, which is exact enough where offsets are a small part of
        their spacing. Beyond the frame, what its edge has goes on.
        """
        planes = self.control.cpu().numpy().reshape(-1, 2, *self.grid.shape)
        steps = offsets.cpu().numpy() / self.grid.spacing
        moved = [shift(plane, (0, y, x), order=1, mode="nearest") for plane, (x, y) in zip(planes, steps, strict=True)]
        control = torch.from_numpy(np.stack(moved)).to(self.control).reshape(self.control.shape)
        return Displacement(self.grid, control)

    def size(self, shape: tuple[int, int]) -> Tensor:
        """Return the root mean square over each frame (height, width), pixels (T,)."""
        rows, columns = (torch.linspace(0, side - 1, 32) for side in shape)
        y, x = torch.meshgrid(rows, columns, indexing="ij")
        points = torch.stack([x, y], dim=-1).reshape(-1, 2).to(self.control)
        return self.at(points).square().sum(dim=2).mean(dim=1).sqrt()
