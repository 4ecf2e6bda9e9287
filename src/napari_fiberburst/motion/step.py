"""One step of Gauss-Newton for each frame against a scene: its place and light, and what more freedom would gain."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

# Degrees of freedom: shifts, similarities, affine transforms.
MODELS = (2, 4, 6)
# That an exposure is 1 is known as well as the light of so many cores of full brightness would tell it.
_EXPOSURE_PRIOR = 1.0
# Of a step: pixels along an axis, relative change of exposure, and radians or relative growth, at most.
_MOST_SHIFT, _MOST_EXPOSURE, _MOST_TURN = 2.0, 0.5, 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Samples of frames beside what the scene shows where they lie; all (n, N).

    Attributes
    ----------
    residual : Tensor
        What the scene misses.
    weights : Tensor
        Of the samples.
    light : Tensor
        What the scene shows.
    slopes : (Tensor, Tensor)
        Its slopes along x and y, per pixel.
    """

    residual: Tensor
    weights: Tensor
    light: Tensor
    slopes: tuple[Tensor, Tensor]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """What frames ask for.

    Attributes
    ----------
    exposures : numpy.ndarray
        (n,) float32, after the step.
    scene_from_frame : numpy.ndarray
        (n, 3, 3), where frames lie after it.
    lowered : numpy.ndarray
        (n, 2) by how much each unknown of turns and growth, and of stretches beside them, would lower the residuals'
        square.
    strain : numpy.ndarray
        (n, 4) growth, turn (radians), and stretches along and across the axes of the scene against each frame.
    information : numpy.ndarray
        (n, 4) one over the variance of each, for residuals of variance 1.
    left : Tensor
        (n, N), what the step leaves of the residuals.
    """

    exposures: NDArray[np.float32]
    scene_from_frame: NDArray[np.float64]
    lowered: NDArray[np.float64]
    strain: NDArray[np.float64]
    information: NDArray[np.float64]
    left: Tensor


def stepped(
    points: Tensor,
    seen: Seen,
    *,
    scene_from_frame: NDArray[np.float64],
    exposures: NDArray[np.float32],
    shape: tuple[int, int],
    dof: int,
) -> Step:
    """Return the step of frames whose samples lie at points (n, N, 2) of the scene.

    Parameters
    ----------
    points, seen
        The samples, and what the scene shows to them.
    scene_from_frame, exposures : numpy.ndarray
        (n, 3, 3) and (n,), as they are.
    shape : (int, int)
        Height and width of a frame.
    dof : int
        One of `MODELS`: how free frames are.
    """
    weights, (along_x, along_y) = seen.weights, seen.slopes
    half = max(shape) / 2
    middle = (points * weights[..., None]).sum(dim=1) / weights.sum(dim=1).clamp_min(1e-9)[:, None]
    x, y = ((points - middle[:, None]) / half).unbind(dim=-1)
    turns = [x * along_x + y * along_y, x * along_y - y * along_x]
    stretches = [x * along_x - y * along_y, y * along_x + x * along_y]
    jacobian = torch.stack([seen.light, along_x, along_y, *(half * part for part in turns + stretches)], dim=1)
    weighted = jacobian * weights[:, None]
    normal = weighted @ jacobian.mT
    normal = normal + torch.diag_embed(1e-4 * normal.diagonal(dim1=1, dim2=2) + 1e-9)
    normal[:, 0, 0] += _EXPOSURE_PRIOR
    rhs = (weighted @ seen.residual[..., None])[..., 0]
    steps = {dof: torch.linalg.solve(normal[:, : dof + 1, : dof + 1], rhs[:, : dof + 1]) for dof in MODELS}
    lowered = [(step * rhs[:, : step.shape[1]]).sum(dim=1) for step in steps.values()]
    taken = torch.nn.functional.pad(steps[dof], (0, MODELS[-1] - dof))
    return Step(
        exposures=_exposed(exposures, taken),
        scene_from_frame=_change(taken.double().numpy(), middle.double().numpy()) @ scene_from_frame,
        lowered=torch.stack([(lowered[1] - lowered[0]) / 2, (lowered[2] - lowered[1]) / 2], dim=1).double().numpy(),
        strain=steps[MODELS[-1]][:, 3:].double().numpy(),
        information=1 / torch.linalg.inv(normal).diagonal(dim1=1, dim2=2)[:, 3:].double().numpy(),
        left=seen.residual - (taken[:, None] @ jacobian)[:, 0],
    )


def _exposed(exposures: NDArray[np.float32], step: Tensor) -> NDArray[np.float32]:
    change = step[:, 0].numpy().clip(-_MOST_EXPOSURE, _MOST_EXPOSURE)
    changed: NDArray[np.float32] = exposures * (1 + change)
    return changed


def _change(step: NDArray[np.float64], middle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the affine changes (n, 3, 3) of the scene that steps (n, 7) ask for, about middles (n, 2)."""
    grown, turned, along, across = step[:, 3:].clip(-_MOST_TURN, _MOST_TURN).T
    change = np.zeros((len(step), 3, 3))
    change[:, 0, 0], change[:, 1, 1] = 1 + grown + along, 1 + grown - along
    change[:, 1, 0], change[:, 0, 1], change[:, 2, 2] = turned + across, across - turned, 1
    shift = step[:, 1:3].clip(-_MOST_SHIFT, _MOST_SHIFT)
    change[:, :2, 2] = shift + middle - np.einsum("nij,nj->ni", change[:, :2, :2], middle)
    return change
