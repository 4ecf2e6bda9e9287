"""A part of the scene that stands for all of it."""

import torch
from torch import Tensor

from napari_fiberburst.operators.grid import Grid


def liveliest(grid: Grid, scene: Tensor, most: int) -> Grid:
    """Return the part of a grid, at most so many nodes a side, in which the scene (H, W) changes most."""
    rows, columns = (min(most, side) for side in grid.shape)
    change = torch.zeros_like(scene)
    change[:-1, :-1] = (scene[1:, :-1] - scene[:-1, :-1]).abs() + (scene[:-1, 1:] - scene[:-1, :-1]).abs()
    total = torch.nn.functional.pad(change.cumsum(0).cumsum(1), (1, 0, 1, 0))
    sums = total[rows:, columns:] - total[:-rows, columns:] - total[rows:, :-columns] + total[:-rows, :-columns]
    row, column = divmod(int(sums.argmax()), sums.shape[1])
    return Grid(grid.x0 + column * grid.spacing, grid.y0 + row * grid.spacing, grid.spacing, (rows, columns))
