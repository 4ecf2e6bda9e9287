"""What a scene shows to the samples of a burst."""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.grid import Grid


class Prediction(NamedTuple):
    """One frame's samples beside what a scene shows to them.

    Attributes
    ----------
    frame : int
        Its number.
    values, light : Tensor
        (N, C) as sampled, and as the scene shows them.
    weights : Tensor
        (N,) how much each sample counts; 0 beyond the scene.
    """

    frame: int
    values: Tensor
    light: Tensor
    weights: Tensor


def predict(
    samples: Samples, points: Tensor, grid: Grid, filtered: Tensor, among: Tensor | None = None
) -> Iterator[Prediction]:
    """Yield what a scene shows to the samples of each frame that has any.

    Parameters
    ----------
    samples : Samples
        As they were taken.
    points : Tensor
        (T, N, 2), where they look in the scene; (T, N, K, 2) where that moves while a frame is exposed.
    grid : Grid
        Of the scene.
    filtered : Tensor
        (C, H, W), the scene as samples see it through their footprint.
    among : Tensor, optional
        (T, N) bool: only these samples, N being another number in each frame.
    """
    for frame, weights in enumerate(samples.weights):
        chosen = weights > 0 if among is None else among[frame] & (weights > 0)
        if not bool(chosen.any()):
            continue
        values, places = samples.values[frame], points[frame]
        if among is not None:
            values, places, weights = values[chosen], places[chosen], weights[chosen]
        sampling = grid.of_looks(places)
        yield Prediction(frame, values, sampling.of_channels(filtered), weights * sampling.inside)


def misfit(
    samples: Samples, points: Tensor, grid: Grid, filtered: Tensor, among: Tensor | None = None
) -> tuple[float, float]:
    """Return the weighted sum of squares by which a scene misses samples, and the sum of the weights."""
    total = mass = torch.zeros((), dtype=torch.float64)
    for part in predict(samples, points, grid, filtered, among):
        total = total + steady.total(part.weights[:, None] * (part.values - part.light) ** 2).cpu().double()
        mass = mass + steady.total(part.weights).cpu().double() * part.values.shape[1]
    return float(total), float(mass)
