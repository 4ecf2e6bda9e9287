"""Whether frames bend beyond the motion that they were registered by."""

from dataclasses import replace

import torch

from napari_fiberburst.motion.displacement import ControlGrid, Displacement
from napari_fiberburst.motion.linearised import linearise, residuals
from napari_fiberburst.motion.problem import FINER, JointProblem, JointState
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.jacobian import ControlSlopes

# In pitches: between the control points that are asked.
_SPACING = 10.0
# A part of the frames, at least, that bends where a burst does.
_LEAST_PART = 0.25
# Control points with less than this part of the median information are at the rim.
_LEAST_INFORMATION = 0.05


def bending_score(problem: JointProblem, state: JointState) -> float:
    """Return how strongly the residuals of rigid frames ask for displacements: about 1 or less where none bends.

    A score test (Rao, 1948): at each control point of each frame, the square of the slope of the misfit along x and
    y, over the variance that residuals without structure would give it; the mean over all of them. It costs one
    linearisation. Where most frames have little and few have much, these were misplaced, so no more counts than a
    quarter of the frames have. Simulated bursts of seven kinds that do not bend have 0.2 to 1.3, and displacements of
    0.3 to 3 pixels (root mean square) 5 to 22.

    Parameters
    ----------
    problem, state
        Of a registration that has converged.
    """
    grid = ControlGrid.over(state.motion.shape, _SPACING * problem.pitch)
    device = problem.positions.device
    still = Displacement.none(len(problem.values), grid, device)
    problem = replace(problem, controls=grid.at(problem.positions))
    state = replace(state, motion=replace(state.motion, displacement=still))
    jacobian, _ = linearise(problem, state, replace(FINER[-1], bends=True))
    slopes = jacobian.motion
    assert isinstance(slopes, ControlSlopes)
    assert problem.controls is not None
    residual, weights, variance = residuals(problem, jacobian)
    score = slopes.adjoint(weights * residual)
    x, y = (problem.controls.normal_diagonal((weights * slope) ** 2) for slope in (slopes.along_x, slopes.along_y))
    information = score.new_empty(score.shape)
    information[:, 0], information[:, 1] = x, y
    known = information > _LEAST_INFORMATION * information[information > 0].median()
    if not bool(known.any()):
        return 0.0
    ratio = torch.where(known, score**2 / (information * variance).clamp_min(1e-20), 0.0)
    used = known.any(dim=2).any(dim=1)
    of_frames = ratio[used].sum(dim=(1, 2)) / known[used].sum(dim=(1, 2))
    return float(min(steady.mean(ratio[known]), of_frames.quantile(1 - _LEAST_PART)))
