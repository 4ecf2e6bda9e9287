"""How far frames moved while they were exposed, and what their samples saw of the scene on the way.

A sample then shows the mean of the scene along its path. The path is known from where the frames lie, up to how long
they were exposed: one number of the burst, found by how well the scene explains the samples.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.scene.prediction import misfit, predict
from napari_fiberburst.scene.spline import assemble
from napari_fiberburst.scene.window import liveliest

Way = Literal["to next", "to both"]
# Points to a path.
_MOMENTS = 5
# Parts of a step that are tried, the first one without a smear; and the one by which the residuals are asked for any.
# No exposure lasts longer than a step, but a path that is no straight line may look longer.
_PARTS, _PROBED = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25), 0.5
# Residuals go with what a smear by half a step would do, by at least this factor. A scene that is smooth leaves some of
# its detail in them, so that bursts that are not smeared have -0.12 to -2.3, and those smeared by two pixels 0.03 up.
_LEAST_SCORE = -0.045
# In a window of so many nodes a side, at this smoothness and with so many iterations, the misfit has to fall by this
# part. It does not in bursts that are not smeared.
_WINDOW, _SMOOTHNESS, _ITERATIONS, _LEAST_GAIN = 128, 0.01, 24, 0.03
_FEWEST_FRAMES = 5


@dataclass(frozen=True, slots=True, eq=False)
class Smear:
    """What frames did while they were exposed.

    Attributes
    ----------
    part : float
        Of a step, over which they moved.
    steps : Tensor
        (T, N, 2), where each sample's look went from one frame to the next, pixels of the scene.
    way : "to next" or "to both"
        Whether a frame moved as to the next one, or as from the one before to the next.
    """

    part: float
    steps: Tensor
    way: Way = "to next"

    @classmethod
    def of(cls, part: float, way: Way, points: Tensor, frames: NDArray[np.intp]) -> "Smear":
        """Return that of frames, numbers in the order they were taken, whose samples lie at points (T, N, 2)."""
        return cls(part, (_to_next if way == "to next" else _to_both)(points, frames), way)

    @property
    def length(self) -> float:
        """How far samples moved in frames that take part, pixels (root mean square)."""
        moved = self.steps[self.steps.flatten(1).any(dim=1)]  # those left out have no steps
        return self.part * float(steady.mean(moved.square().sum(dim=2)).sqrt())

    def paths(self, points: Tensor) -> Tensor:
        """Return where samples looked that were at points (T, N, 2) in the middle, (T, N, K, 2)."""
        moments = self.part * ((torch.arange(_MOMENTS) + 0.5) / _MOMENTS - 0.5).to(points)
        return points[:, :, None] + moments[:, None] * self.steps[:, :, None]


def find_smear(
    samples: Samples, points: Tensor, frames: NDArray[np.intp], grid: Grid, filtered: Tensor, scene: Tensor
) -> Smear | None:
    """Find how far the frames moved while they were exposed; None where that is not seen.

    Parameters
    ----------
    samples, points
        The samples, and where they lie in the middle of the exposure (T, N, 2).
    frames : numpy.ndarray
        Numbers of the frames that take part, in the order in which they were taken.
    grid : Grid
        Of the scene.
    filtered, scene : Tensor
        (C, H, W), the scene as samples see it through their footprint, and as it is.
    """
    if samples.kind != "cores" or len(frames) < _FEWEST_FRAMES:
        return None
    grey = replace(samples, values=samples.grey[..., None])
    light = filtered.mean(dim=0, keepdim=True)
    ways = [Smear.of(_PROBED, way, points, frames) for way in get_args(Way)]
    scores = [_score(grey, points, grid, light, way) for way in ways]
    if max(scores) < _LEAST_SCORE:
        return None
    way = ways[int(np.argmax(scores))]
    window = liveliest(grid, scene.mean(dim=0), _WINDOW)
    within = _within(window, grey, replace(way, part=_PARTS[-1]).paths(points))
    left = np.array([_left(within, replace(way, part=part).paths(points), window) for part in _PARTS])
    return replace(way, part=_lowest(left)) if left.min() < (1 - _LEAST_GAIN) * left[0] else None


def _to_next(points: Tensor, frames: NDArray[np.intp]) -> Tensor:
    """Return the way from each frame to the next, in one frame's time; the last goes on as the one before."""
    steps = torch.zeros_like(points)
    for before, after in pairwise(frames):
        steps[before] = (points[after] - points[before]) / float(after - before)
        steps[after] = steps[before]
    return steps.nan_to_num()


def _to_both(points: Tensor, frames: NDArray[np.intp]) -> Tensor:
    """Return the way through each frame from the one before it to the one after it, in one frame's time."""
    steps = torch.zeros_like(points)
    first, last = np.concatenate([frames[:1], frames[:-1]]), np.concatenate([frames[1:], frames[-1:]])
    for frame, before, after in zip(frames, first, last, strict=True):
        steps[frame] = (points[after] - points[before]) / float(after - before)
    return steps.nan_to_num()


def _score(samples: Samples, points: Tensor, grid: Grid, light: Tensor, way: Smear) -> float:
    """Return by what factor the residuals go with what a smear along the way would do to the scene."""
    agreement = power = 0.0
    paths = way.paths(points)
    along = predict(samples, paths, grid, light)
    for part, smeared in zip(predict(samples, points, grid, light), along, strict=True):
        weights = torch.minimum(part.weights, smeared.weights)
        change = (smeared.light - part.light)[:, 0]
        agreement += float(steady.total(weights * change * (part.values - part.light)[:, 0]))
        power += float(steady.total(weights * change**2))
    return agreement / power if power > 0 else -np.inf


def _lowest(left: NDArray[np.float64]) -> float:
    """Return the part of a step at which the misfit (P,) is least, between those that were tried."""
    index = int(np.clip(np.argmin(left), 1, len(_PARTS) - 2))
    near = slice(index - 1, index + 2)
    curve = np.polyfit(_PARTS[near], left[near], 2)
    lowest = -curve[1] / (2 * curve[0]) if curve[0] > 0 else _PARTS[int(np.argmin(left))]
    return float(np.clip(lowest, _PARTS[0], _PARTS[-1]))


def _within(window: Grid, samples: Samples, paths: Tensor) -> Samples:
    """Return those samples that see nothing beyond a window, along paths (T, N, K, 2) and a pitch beside them.

    What a sample sees there no scene in the window explains, and that is less the longer the path: where the object is
    smooth, it would pass for a smear.
    """
    first = torch.tensor([window.x0, window.y0]).to(paths)
    last = first + torch.tensor([window.shape[1] - 1.0, window.shape[0] - 1.0]).to(paths) * window.spacing
    inside = ((paths > first + samples.pitch) & (paths < last - samples.pitch)).all(dim=3).all(dim=2)
    return replace(samples, weights=samples.weights * inside)


def _left(samples: Samples, looks: Tensor, window: Grid) -> float:
    """Return the mean square by which the best scene in a window misses the samples that look into it."""
    equations = assemble(window, samples, looks)
    scene = equations.solve(_SMOOTHNESS, iterations=_ITERATIONS)
    missed, mass = misfit(samples, looks, window, equations.through(scene))
    return missed / max(mass, 1e-12)
