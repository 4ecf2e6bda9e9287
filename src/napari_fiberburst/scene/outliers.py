"""Samples that show something else than the object: what passes before it, a reflection, dirt on the camera."""

import math

import torch
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.operators.filters import blur
from napari_fiberburst.operators.grid import Grid, Sampling
from napari_fiberburst.scene.prediction import predict

# In standard deviations of the residuals as they usually are there: what is farther off is something else. Where that
# is found, what lies about it by the second number, within the third in pitches, belongs to it.
_FAR, _ALSO, _ABOUT = 7.0, 2.5, 2.0
# In parts of the contrast of the samples.
_LEAST_SIZE = 0.4
# Frames that have looked at a place, at least.
_LEAST_FRAMES = 6.0
# The median of the size of a normal variable of standard deviation 1.
_MEDIAN_SIZE = 0.6745


def find_outliers(
    samples: Samples,
    points: Tensor,
    grid: Grid,
    filtered: Tensor,
    *,
    far: float = _FAR,
    least_size: float = _LEAST_SIZE,
    spread: float = 1.0,
) -> Tensor:
    """Return which samples show something else than the scene, (T, N) bool.

    Something else covers several cores, so residuals are averaged over neighbours of a frame, which noise and wrong
    gains do not survive. They are held against what is usual for all samples, for those of the frame, for those of the
    core and, where the scene has edges, for those of other frames at the same place; and against the contrast of the
    scene, because the sharpest frames of a burst that is mostly blurred differ from the others by right.

    Parameters
    ----------
    samples : Samples
        Gains and exposures taken out.
    points : Tensor
        (T, N, 2), where they lie in the scene.
    grid : Grid
        Of the scene.
    filtered : Tensor
        (C, H, W), the scene as samples see it through their footprint.
    far : float
        In standard deviations of the residuals as they usually are there: what is farther off is something else.
    least_size : float
        In parts of the contrast of the samples: what differs by less is none.
    spread : float
        Over this Gaussian, in pitches, neighbours are averaged.
    """
    height, width = samples.shape
    in_frame = Grid.over((0, 0, width - 1, height - 1), min(1.0, spread) * samples.pitch).at(samples.positions)
    off, weights = torch.zeros_like(samples.weights), torch.zeros_like(samples.weights)
    for frame, values, light, weight in predict(samples, points, grid, filtered):
        off[frame] = _smooth(in_frame, (values - light).mean(dim=1), weight)
        weights[frame] = weight
    size, counted = off.abs(), weights > 0
    if not bool(counted.any()):
        return counted
    usual = size[counted].median() / _MEDIAN_SIZE
    # A frame that is blurred is off everywhere, and a core at the rim that the model does not fit in every frame.
    known = torch.where(counted, size, torch.nan)
    of_frame, of_core = (known.nanmedian(dim=axis, keepdim=True).values.nan_to_num() / _MEDIAN_SIZE for axis in (1, 0))
    # The mean size, as a normal variable's standard deviation; capped, so that outliers do not make themselves usual.
    there, looked = _smooth_over_frames(samples.pitch, points, size.clamp(max=float(3 * usual)), weights)
    there *= math.sqrt(math.pi / 2)
    score = size / torch.maximum(torch.maximum(there, usual), torch.maximum(of_frame, of_core)).clamp_min(1e-12)
    counted &= _is_shared(in_frame, weights, looked)
    found = (score > far) & (size > least_size * samples.contrast) & counted
    if not bool(found.any()):
        return found
    also = torch.zeros_like(found)
    nodes = max(1.0, _ABOUT / min(1.0, spread))
    for frame in found.any(dim=1).nonzero().flatten().tolist():
        near = in_frame(blur(in_frame.adjoint(found[frame].to(off)), nodes)) > 0.02
        also[frame] = near & (score[frame] > _ALSO) & counted[frame]
    return found | also


def _is_shared(in_frame: Sampling, weights: Tensor, of_all: Tensor) -> Tensor:
    """Return which samples (T, N) lie where enough frames have looked to say which of them is off.

    `of_all` (T, N) is the weight there of all frames.
    """
    of_one = torch.stack([in_frame(blur(in_frame.adjoint(weight), 1.0)) for weight in weights])
    return of_all > _LEAST_FRAMES * of_one


def _smooth(at: Sampling, values: Tensor, weights: Tensor) -> Tensor:
    """Return the local mean of scattered values, at their own places."""
    total, mass = blur(torch.stack([at.adjoint(values * weights), at.adjoint(weights)]), 1.0)
    return at(total / mass.clamp_min(1e-9)) * (at(mass) > 0)


def _smooth_over_frames(spacing: float, points: Tensor, values: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the local mean of values (T, N) at points (T, N, 2) of the scene, and the weight there, both (T, N).

    Frame by frame, because where samples lie on a grid takes many times the memory of their values.
    """
    grid = Grid.around(points, spacing, 2 * spacing, weights > 0)
    total, mass = torch.zeros(2, *grid.shape).to(values)
    for number, weight in enumerate(weights):
        at = grid.at(points[number])
        total += at.adjoint(values[number] * weight)
        mass += at.adjoint(weight)
    total, mass = blur(torch.stack([total, mass]), 1.0)
    smooth = torch.stack([total / mass.clamp_min(1e-9), mass])
    mean, looked = torch.stack([grid.at(part).of_channels(smooth) for part in points]).unbind(dim=-1)
    return mean, looked
