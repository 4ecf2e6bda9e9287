"""What the first levels of a registration are held to: samples in even light, and wide frames at coarser scales.

Uneven light stands still while the object moves. Where it changes more over the frame than the object does, the first
iterations would follow it, so its slow changes are taken out of what they see; later ones begin with them as gains.

A shift leaves turns, zoom and perspective, and what these move at a frame's edge grows with its width. Gauss-Newton
finds its way from about as far as detail is wide, so frames that are many cores wide are first registered by what they
show of coarser detail, from the scale in which their shifts were found to that of the first level of all frames, each
scale half of the one before.
"""

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.motion.coarse import spacing_of
from napari_fiberburst.motion.problem import COARSE, FINER, Level
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.filters import filled_mean
from napari_fiberburst.operators.grid import Grid

# The light is a polynomial of this degree over the frame, in logarithms; darker places than this part of its mean have
# none.
_DEGREE, _LEAST_LIGHT = 2, 0.05
# It is taken out where it changes over the frame by so many times what samples change from frame to frame: bursts in
# even light have up to 2.5, which is the object's, and to keep that serves smooth objects best.
_UNEVEN = 3.0
# Pitches from node to node, from which on a scale has levels of its own.
_LEAST_SPACING = 1.0
# Of the Gaussian that smooths samples, in nodes.
_SIGMA = 0.7


def uneven_light(samples: Samples) -> Tensor:
    """Return the slow changes over the frame that all frames have alike, where they are the light's: as gains (G,).

    They are 1 where the light is even, or may be.
    """
    gains = torch.ones(samples.cores).to(samples.values)
    mass = samples.weights.sum(dim=0)
    light = samples.mean_light
    usual = steady.weighted_mean(light, mass)
    seen = (mass > 0) & (light > _LEAST_LIGHT * usual)
    changes = (samples.grey / light.clamp_min(1e-9) - 1).square()
    change = steady.weighted_mean(changes, samples.weights * seen).sqrt()
    height, width = samples.shape
    places = 2 * samples.positions.cpu().double() / torch.tensor([width, height]) - 1
    powers = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    terms = torch.stack([places[:, 0] ** i * places[:, 1] ** j for i, j in powers])
    known = seen.cpu()
    if int(known.sum()) < 2 * len(powers):
        return gains
    logs = (light / usual).clamp_min(_LEAST_LIGHT).log().cpu().double()
    seen_terms = terms * known
    normal, rhs = steady.row_sums(seen_terms[:, None] * terms), steady.row_sums(seen_terms * logs)
    slow = (torch.linalg.solve(normal, rhs)[:, None] * terms).sum(dim=0)
    if float(slow[known].std()) < _UNEVEN * float(change):
        return gains
    slow = (slow - slow[known].median()).clamp(logs[known].min(), logs[known].max())
    gains[samples.core_index] = slow.exp().to(gains)
    return gains


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
    """Return samples of what nodes so many pixels apart can show, grey."""
    height, width = samples.shape
    grid = Grid.over((0, 0, width - 1, height - 1), spacing)
    at = grid.at(samples.positions)

    def of_frame(values: Tensor, weights: Tensor) -> Tensor:
        return at(filled_mean(at.adjoint(values * weights)[None], at.adjoint(weights), _SIGMA)[0])

    values = torch.stack([of_frame(*frame) for frame in zip(samples.grey, samples.weights, strict=True)])
    return replace(samples, values=values[..., None])
