"""How frames of a recording bend beyond affine transforms, because tissue does."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from napari_fiberburst.motion.displacement import ControlGrid
from napari_fiberburst.operators.priors import THIN_PLATE

# Intervals between control points along the longer side of a frame.
_INTERVALS = 4
# Elastic prior: curvature from control point to control point, pixels (1 sigma), and how much less a displacement
# itself is held back.
_CURVATURE, _RIDGE = 1.8, 1e-3
# Pixels that a control point moves in one step, at most.
_MOST_STEP = 2.0
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


@dataclass(frozen=True, slots=True, eq=False)
class Bend:
    """What frames ask for beyond planes: a step of Gauss-Newton each, held back by elasticity.

    Attributes
    ----------
    shown : Tensor
        (N, M), what each control point does at the samples.
    shape : (int, int)
        Height and width of a frame.
    weights, residual : Tensor
        (n, N).
    slopes : tuple of Tensor
        (n, N) along x and y.
    typical : Tensor
        (n,) root mean square of the residuals.
    """

    shown: Tensor
    shape: tuple[int, int]
    weights: Tensor
    residual: Tensor
    slopes: tuple[Tensor, Tensor]
    typical: Tensor

    def step(self, number: int, control: Tensor | None) -> tuple[Tensor, float]:
        """Return a frame's step (2, M), and what part of the residuals' root mean square it leaves.

        From where its control points are (2, M), or from none.
        """
        weights, residual = self.weights[number], self.residual[number]
        jacobian = torch.cat([self.shown * slope[number][:, None] for slope in self.slopes], dim=1)
        weighted = jacobian * weights[:, None]
        prior = torch.kron(torch.eye(2), elastic(self.shape, float(self.typical[number]) ** 2))
        rhs = weighted.T @ residual
        pulled = rhs if control is None else rhs - prior @ control.reshape(-1)
        step = torch.linalg.solve(weighted.T @ jacobian + prior, pulled)
        square = float((weights * residual.square()).sum())
        left = math.sqrt(max(0.0, 1 - float(step @ rhs) / square)) if square > 0 else 1.0
        return step.clamp(-_MOST_STEP, _MOST_STEP).reshape(2, -1), left
