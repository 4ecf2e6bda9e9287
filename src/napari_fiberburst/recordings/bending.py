"""How frames of a recording bend beyond affine transforms, because tissue does."""

import torch
from torch import Tensor

from napari_fiberburst.motion.displacement import ControlGrid
from napari_fiberburst.operators.priors import THIN_PLATE

# Intervals between control points along the longer side of a frame.
_INTERVALS = 4
# Elastic prior: curvature from control point to control point, pixels (1 sigma), and how much less a displacement
# itself is held back.
_CURVATURE, _RIDGE = 1.8, 1e-3
# Least variance of residuals, full scale 1: beyond the camera's noise there is always some that no scene explains.
_LEAST_VARIANCE = 1e-9


def control_grid(shape: tuple[int, int]) -> ControlGrid:
    """Return the control points over frames (height, width)."""
    return ControlGrid.over(shape, max(shape) / _INTERVALS)


def basis(shape: tuple[int, int], positions: Tensor) -> Tensor:
    """Return what each of M control points does at frame positions (N, 2): (N, M)."""
    grid = control_grid(shape)
    index, weight = grid.splines(positions)
    count = grid.shape[0] * grid.shape[1]
    return torch.zeros(len(positions), count).to(weight).scatter_add_(1, index, weight)


def elastic(shape: tuple[int, int], variance: float) -> Tensor:
    """Return the matrix (M, M) of the elastic prior along one axis, for residuals of some variance."""
    rows, columns = control_grid(shape).shape
    unit = torch.eye(rows * columns).reshape(-1, rows, columns)
    plate = THIN_PLATE(unit).reshape(rows * columns, -1) + _RIDGE * torch.eye(rows * columns)
    return plate * (max(variance, _LEAST_VARIANCE) / _CURVATURE**2)
