"""How smooth the scene should be, chosen by what one part of the burst tells of another."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.filters import blur
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.quality.resolution import ring_correlation
from napari_fiberburst.scene.prediction import misfit
from napari_fiberburst.scene.spline import NormalEquations, assemble

# Smoothness is looked for among these, and between them: where halves of the burst tell, and where neighbours do.
_CANDIDATES = tuple(10 ** (exponent / 2) for exponent in range(1, -7, -1))
_STILL_CANDIDATES = tuple(10 ** (exponent / 2) for exponent in range(5, -4, -1))
# An image this rough has hardly any bias left: it stands for the truth that the other half's images are held to.
_REFERENCE = 0.01
# The smoothness where it cannot be told.
UNTOLD = 0.1
# Smoothness is chosen in a window of at most this many nodes a side.
_WINDOW = 224
# Every core is left out once, with so many others that most of its neighbours stay.
_FOLDS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Smoothness:
    """How smooth the scene should be, and what resolution that gives.

    Attributes
    ----------
    weight : float
        lambda.
    resolution : float or None
        Pixels, the finest period on which two halves of the burst agree; None where that could not be told.
    """

    weight: float
    resolution: float | None


def choose_smoothness(
    samples: Samples, points: Tensor, frames: NDArray[np.intp], grid: Grid, scene: Tensor
) -> Smoothness:
    """Choose the smoothness by which each half of the burst best predicts the scene of the other.

    Even and odd frames are solved apart. The squared difference between the scene from one half, at each smoothness,
    and a nearly unbiased scene from the other is that scene's error plus a constant, because the halves' noise is
    independent. Samples left out cannot tell: a footprint hides from them just the detail, and the noise, that matter.

    Parameters
    ----------
    samples, points
        The samples, and where they lie (T, N, 2).
    frames : numpy.ndarray
        Numbers of the frames that take part, at least two.
    grid : Grid
        Of the scene.
    scene : Tensor
        (H, W), a first scene on that grid: the window is laid where it has most structure.
    """
    window = _window(grid, scene)
    in_grey = replace(samples, values=samples.grey[..., None])
    halves = [assemble(window, in_grey, points, among_frames(half, samples)) for half in (frames[::2], frames[1::2])]
    densities = [blur(half.density(), 3.0) for half in halves]
    both = torch.minimum(*densities)
    sampled = (both > 0.2 * both.max()) & (both > 0)
    if not bool(sampled.any()):
        return Smoothness(UNTOLD, None)
    paths = [
        [half.image(scene, smoothness) for smoothness, scene in zip(_CANDIDATES, _path(half, _CANDIDATES), strict=True)]
        for half in halves
    ]
    reference = min(range(len(_CANDIDATES)), key=lambda index: abs(math.log(_CANDIDATES[index] / _REFERENCE)))
    risks = [
        float(steady.mean(((first - paths[1][reference]) ** 2 + (second - paths[0][reference]) ** 2)[:, sampled]))
        for first, second in zip(*paths, strict=True)
    ]
    weight, nearest = _lowest(np.array(risks), _CANDIDATES)
    soft = (blur(sampled.to(scene), 4.0) * sampled).cpu().numpy()
    first, second = (path[nearest][0].cpu().numpy() for path in paths)
    resolution = window.spacing * ring_correlation(first, second, soft).resolution
    return Smoothness(weight, resolution if math.isfinite(resolution) else None)


def choose_among_neighbours(
    samples: Samples, points: Tensor, frames: NDArray[np.intp], grid: Grid, scene: Tensor
) -> Smoothness:
    """Choose the smoothness by which each core is best predicted from those around it.

    For a burst that does not move. Its halves share every gap, and what cores differ by: neither half tells which part
    of the other's image is object and which is core. Between neighbours, cores differ at random and the object does
    not, so the smoothness that predicts cores left out (cross-validation in folds) takes out what is the cores'.

    Parameters are those of `choose_smoothness`; one frame is enough.
    """
    window = _window(grid, scene)
    in_grey, taking_part = replace(samples, values=samples.grey[..., None]), among_frames(frames, samples)
    count = samples.weights.shape[1]
    fold = torch.randperm(count, generator=torch.Generator().manual_seed(0)).to(points.device) % _FOLDS
    risks = np.zeros(len(_STILL_CANDIDATES))
    for left in range(_FOLDS):
        normal = assemble(window, in_grey, points, taking_part & (fold != left))
        asked = taking_part & (fold == left)
        for index, guess in enumerate(_path(normal, _STILL_CANDIDATES)):
            risks[index] += misfit(in_grey, points, window, normal.through(guess), asked)[0]
    return Smoothness(_lowest(risks, _STILL_CANDIDATES)[0] if risks.any() else UNTOLD, None)


def among_frames(frames: NDArray[np.intp], samples: Samples) -> Tensor:
    """Return which samples are of these frames, (T, 1) bool."""
    among = torch.zeros(len(samples.weights), 1, dtype=torch.bool)
    among[torch.from_numpy(frames)] = True
    return among.to(samples.weights.device)


def _path(normal: NormalEquations, candidates: tuple[float, ...]) -> list[Tensor]:
    """Return the scenes of all candidates, each started from the smoother one before."""
    scene = normal.mean()
    scenes = []
    for smoothness in candidates:
        scene = normal.solve(smoothness, scene, 40)
        scenes.append(scene)
    return scenes


def _lowest(risks: NDArray[np.float64], candidates: tuple[float, ...]) -> tuple[float, int]:
    """Return the smoothness of least risk, by a parabola through the lowest candidate and its neighbours."""
    index = int(np.argmin(risks))
    exponents = np.log10(candidates)
    if not 0 < index < len(risks) - 1:
        return candidates[index], index
    near = slice(index - 1, index + 2)
    curve = np.polyfit(exponents[near], np.log(risks[near] + 1e-300), 2)
    lowest = -curve[1] / (2 * curve[0]) if curve[0] > 0 else exponents[index]
    return float(10 ** np.clip(lowest, exponents[index + 1], exponents[index - 1])), index


def _window(grid: Grid, scene: Tensor) -> Grid:
    """Return the part of a grid, of limited size, in which the scene changes most."""
    rows, columns = (min(_WINDOW, side) for side in grid.shape)
    change = torch.zeros_like(scene)
    change[:-1, :-1] = (scene[1:, :-1] - scene[:-1, :-1]).abs() + (scene[:-1, 1:] - scene[:-1, :-1]).abs()
    total = torch.nn.functional.pad(change.cumsum(0).cumsum(1), (1, 0, 1, 0))
    sums = total[rows:, columns:] - total[:-rows, columns:] - total[rows:, :-columns] + total[:-rows, :-columns]
    row, column = divmod(int(sums.argmax()), sums.shape[1])
    return Grid(grid.x0 + column * grid.spacing, grid.y0 + row * grid.spacing, grid.spacing, (rows, columns))
