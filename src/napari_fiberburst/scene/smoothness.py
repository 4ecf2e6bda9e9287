"""How smooth the scene should be, chosen by what one part of the burst tells of another."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.operators.filters import blur
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.quality.resolution import ring_correlation
from napari_fiberburst.scene.prediction import misfit
from napari_fiberburst.scene.spline import NormalEquations

# Smoothness is looked for among these, and between them: where halves of the burst tell, and where neighbours do.
_CANDIDATES = tuple(10 ** (exponent / 2) for exponent in range(1, -7, -1))
_STILL_CANDIDATES = tuple(10 ** (exponent / 2) for exponent in range(5, -4, -1))
# An image this rough has hardly any bias left: it stands for the truth that the other half's images are held to.
_REFERENCE = 0.01
# The smoothness where it cannot be told.
UNTOLD = 0.1
# Of conjugate gradients for each candidate, at most.
_ITERATIONS = 40
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
    grey = samples.values.mean(dim=2, keepdim=True)
    halves = []
    for chosen in (frames[::2], frames[1::2]):
        normal = NormalEquations.empty(window, samples.radius, 1, points.device)
        for number in chosen:
            normal = normal.with_samples(points[number], grey[number], samples.weights[number])
        halves.append(normal)
    densities = [blur(half.density(), 3.0) for half in halves]
    both = torch.minimum(*densities)
    sampled = (both > 0.2 * both.max()) & (both > 0)
    if not bool(sampled.any()):
        return Smoothness(UNTOLD, None)
    found = _Halves(halves, sampled).searched()
    weight, nearest = _lowest(np.array([step.risk for step in found]), tuple(step.smoothness for step in found))
    soft = (blur(sampled.to(scene), 4.0) * sampled).cpu().numpy()
    first, second = (image[0].cpu().numpy() for image in found[nearest].images)
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
    grey = samples.values.mean(dim=2, keepdim=True)
    in_grey = replace(samples, values=grey)
    taking_part = torch.zeros(len(grey), dtype=torch.bool)
    taking_part[torch.from_numpy(frames)] = True
    fold = torch.randperm(grey.shape[1], generator=torch.Generator().manual_seed(0)).to(points.device) % _FOLDS
    risks = np.zeros(len(_STILL_CANDIDATES))
    for left in range(_FOLDS):
        normal = NormalEquations.empty(window, samples.radius, 1, points.device)
        for number in frames:
            normal = normal.with_samples(points[number], grey[number], samples.weights[number] * (fold != left))
        asked = taking_part.to(fold.device)[:, None] & (fold == left)
        for index, guess in enumerate(_path(normal, _STILL_CANDIDATES)):
            risks[index] += misfit(in_grey, points, window, normal.through(guess), asked)[0]
    return Smoothness(_lowest(risks, _STILL_CANDIDATES)[0] if risks.any() else UNTOLD, None)


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """Both halves' scenes at one smoothness.

    Attributes
    ----------
    smoothness : float
        Which.
    scenes, images : tuple of Tensor
        (1, H, W) each half's coefficients, and the smooth image that they stand for.
    risk : float
        Error of the images, plus a constant; NaN until the reference is known.
    """

    smoothness: float
    scenes: tuple[Tensor, Tensor]
    images: tuple[Tensor, Tensor]
    risk: float = math.nan


@dataclass(frozen=True, slots=True, eq=False)
class _Halves:
    """The halves of a burst, and where both have looked, (H, W) bool."""

    equations: list[NormalEquations]
    sampled: Tensor

    def searched(self) -> list[_Candidate]:
        """Return neighbouring candidates from smooth to rough, the best one among them, and not at the end if it can.

        The risk has one lowest place, so the search ends where it rises to both sides. It starts where most bursts end:
        the smoothest candidates take the most iterations and the roughest are the least use.
        """
        first, reference = _CANDIDATES.index(UNTOLD), _CANDIDATES.index(_REFERENCE)
        found: list[_Candidate] = []
        start = tuple(half.mean() for half in self.equations)
        for index in range(first, reference + 1):
            found.append(self._solved(_CANDIDATES[index], start))
            start = found[-1].scenes
        truth = found[-1].images
        found = [self._judged(candidate, truth) for candidate in found]
        last = reference
        while found[-1].risk <= min(step.risk for step in found) and last + 1 < len(_CANDIDATES):
            last += 1
            found.append(self._judged(self._solved(_CANDIDATES[last], found[-1].scenes), truth))
        while found[0].risk <= min(step.risk for step in found) and first > 0:
            first -= 1
            found.insert(0, self._judged(self._solved(_CANDIDATES[first], found[0].scenes), truth))
        return found

    def _solved(self, smoothness: float, start: tuple[Tensor, ...]) -> _Candidate:
        one, other = (
            half.solve(smoothness, scene, _ITERATIONS) for half, scene in zip(self.equations, start, strict=True)
        )
        first, second = self.equations
        return _Candidate(smoothness, (one, other), (first.image(one, smoothness), second.image(other, smoothness)))

    def _judged(self, candidate: _Candidate, truth: tuple[Tensor, Tensor]) -> _Candidate:
        """Return the candidate with its risk: each half's image is held to the other half's nearly unbiased one."""
        (first, second), (one, other) = candidate.images, truth
        risk = float(((first - other) ** 2 + (second - one) ** 2)[:, self.sampled].mean())
        return replace(candidate, risk=risk)


def _path(normal: NormalEquations, candidates: tuple[float, ...]) -> list[Tensor]:
    """Return the scenes of all candidates, each started from the smoother one before."""
    scene = normal.mean()
    scenes = []
    for smoothness in candidates:
        scene = normal.solve(smoothness, scene, _ITERATIONS)
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
