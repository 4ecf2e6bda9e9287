"""The first levels of frames that are many cores wide, by samples that were smoothed.

A shift leaves turns, zoom and perspective, and what these move at a frame's edge grows with its width. Gauss-Newton finds
its way from about as far as detail is wide, so wide frames are first registered by what they show of coarser detail,
from the scale in which their shifts were found to that of the first level of all frames, each scale half of the one
before.
"""

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.motion.coarse import spacing_of
from napari_fiberburst.motion.problem import COARSE, FINER, Level
from napari_fiberburst.operators.filters import filled_mean
from napari_fiberburst.operators.grid import Grid

# Pitches from node to node, from which on a scale has levels of its own.
_LEAST_SPACING = 1.0
# Of the Gaussian that smooths samples, in nodes.
_SIGMA = 0.7


def scales(shape: tuple[int, int], pitch: float) -> Iterator[tuple[float, tuple[Level, ...]]]:
    """Return the scales of frames (height, width) before the first level of all frames, the coarsest first.

    Returns
    -------
    iterator of (float, tuple of Level)
        From node to node, pixels, and the levels. None where frames are not wide.
    """
    spacing = spacing_of(shape, pitch) / pitch
    while spacing > _LEAST_SPACING:
        yield spacing * pitch, tuple(replace(level, spacing=spacing) for level in (COARSE, FINER[0]))
        spacing /= 2


def smoothed(samples: Samples, spacing: float) -> Samples:
    """Return samples of what nodes so many pixels apart can show: grey, and with no gains to be found any more."""
    height, width = samples.shape
    grid = Grid.over((0, 0, width - 1, height - 1), spacing)
    at = grid.at(samples.positions)

    def of_frame(values: Tensor, weights: Tensor) -> Tensor:
        return at(filled_mean(at.adjoint(values * weights)[None], at.adjoint(weights), _SIGMA)[0])

    values = torch.stack([of_frame(*frame) for frame in zip(samples.grey, samples.weights, strict=True)])
    return replace(samples, values=values[..., None], gain_variance=0.0)
