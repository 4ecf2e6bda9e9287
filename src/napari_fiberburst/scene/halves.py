"""Whether two halves of a burst, solved apart at the same motion, show the same scene."""

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.operators.filters import blur
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.scene.smoothness import UNTOLD, among_frames
from napari_fiberburst.scene.spline import assemble

# Between nodes, in pitches, and where samples are pixels at most in those: a comparison needs no finer detail.
_SPACING, _SPACING_OF_PIXELS = 0.5, 2.0
_ITERATIONS = 16
# In nodes, over which the density of samples is averaged; and the part of the highest density that both halves need.
_NEAR, _LEAST_DENSITY = 1.5, 0.15
_LEAST_NODES = 10


def disagreement(samples: Samples, points: Tensor, frames: NDArray[np.intp]) -> float:
    """Return by how much the mean of two halves of a burst would be wrong if their difference were chance.

    The first half of the frames against the second, because what drifts differs most between these.

    Parameters
    ----------
    samples : Samples
        Gains and exposures taken out.
    points : Tensor
        (T, N, 2), where they lie in the scene.
    frames : numpy.ndarray
        Numbers of the frames that take part, in the order they were taken.

    Returns
    -------
    float
        Half the root mean square difference of the scenes in grey, as cores see them, full scale 1, apart from their
        difference in brightness; NaN where the halves do not overlap, or there are none.
    """
    if len(frames) < 2:
        return float("nan")
    spacing = _SPACING * samples.pitch
    if samples.kind == "pixels":
        spacing = min(spacing, _SPACING_OF_PIXELS)
    grid = Grid.around(points[frames], spacing, 2 * samples.pitch)
    in_grey = replace(samples, values=samples.grey[..., None])
    shown, densities = [], []
    for half in (frames[: len(frames) // 2], frames[len(frames) // 2 :]):
        normal = assemble(grid, in_grey, points, among_frames(half, samples))
        shown.append(normal.through(normal.solve(UNTOLD, iterations=_ITERATIONS))[0])
        densities.append(blur(normal.density(), _NEAR))
    both = torch.minimum(*densities) > _LEAST_DENSITY * torch.maximum(*densities).max()
    if int(both.sum()) < _LEAST_NODES:
        return float("nan")
    return float((shown[0] - shown[1])[both].std(correction=0)) / 2
