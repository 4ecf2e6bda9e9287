"""Step 4 of a long recording on a part of its scene: its normal equations, which are sums over samples.

So frames are added a few at a time, and need no more memory than the scene.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.operators.grid import Grid, Sampling
from napari_fiberburst.quality.resolution import RingCorrelation
from napari_fiberburst.recordings.traces import Traces
from napari_fiberburst.recordings.track import Track
from napari_fiberburst.scene.smoothness import UNTOLD, choose_smoothness
from napari_fiberburst.scene.spline import NormalEquations, assemble

# So many samples of frames are looked at together.
_SAMPLES_TOGETHER = 200_000
# The smoothness is chosen in a window of so many nodes a side, from so many frames at most.
_WINDOW, _FRAMES_TOLD = 224, 200
# Samples that the scene misses by more than this many times its usual error show something else.
_OUTLIER = 5.0


def frames_together(traces: Traces, frames: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Return the numbers of frames in parts that fit into memory."""
    together = max(1, _SAMPLES_TOGETHER // max(1, traces.template.cores))
    for first in range(0, len(frames), together):
        yield frames[first : first + together]


def corrected(traces: Traces, track: Track, frames: NDArray[np.int64]) -> Samples:
    """Return the samples of frames without the gains and exposures that are known, weighed by how well frames fit."""
    samples = traces.samples(frames).without_gains(torch.from_numpy(track.gains))
    return samples.without_exposures(torch.from_numpy(track.exposures[frames])).weighted(
        torch.from_numpy(track.weights[frames])
    )


def equations(
    traces: Traces, track: Track, frames: NDArray[np.int64], grid: Grid, filtered: Tensor | None = None
) -> NormalEquations:
    """Return the normal equations of frames on a grid.

    `filtered` (C, H, W) is a scene as cores see it: samples that show something else have no part.
    """
    template = traces.template
    total = NormalEquations.empty(grid, template.radius, template.values.shape[2], torch.device("cpu"))
    for some in frames_together(traces, frames):
        samples, points = corrected(traces, track, some), track.points(some, template.positions)
        belongs = None if filtered is None else _belonging(samples, grid.at(points), filtered, track.error)
        part, nodes = grid.part_about(points)
        total.include(assemble(part, samples, points, belongs), nodes)
    return total


def _belonging(samples: Samples, sampling: Sampling, filtered: Tensor, error: float) -> Tensor:
    """Return which samples (T, N) the scene shows as they are, within what it usually misses."""
    missed = (samples.grey - sampling(filtered.mean(dim=0))).abs()
    return (missed <= _OUTLIER * error).to(missed)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Told:
    """What a part of the recording tells of the whole.

    Attributes
    ----------
    smoothness : float
        Weight of the prior.
    agreement : RingCorrelation or None
        Of two halves of the frames that share no core, in pixels; None where that is not known.
    """

    smoothness: float
    agreement: RingCorrelation | None


def told_by(traces: Traces, track: Track, piece: int) -> Told:
    """Choose how smooth a piece is to be, where its liveliest frame with many others about it looks."""
    frames = track.frames_of(piece)
    middle = track.corners(frames).mean(axis=1)
    rarity = track.rarity(traces.template.pitch)[frames]
    near = np.array([rarity[some].sum() for some in cKDTree(middle).query_ball_point(middle, min(track.shape) / 4)])
    lively = traces.summary.contrast.numpy()[frames] * (near >= np.median(near))
    x, y = middle[int(np.argmax(lively))]
    half = _WINDOW // 2
    window = Grid(float(round(x)) - half, float(round(y)) - half, 1.0, (_WINDOW, _WINDOW))
    touching = track.touching(window, piece)
    if len(touching) < 2:
        return Told(smoothness=UNTOLD, agreement=None)
    touching = track.spread(touching, _FRAMES_TOLD, traces.template.pitch)
    samples, points = corrected(traces, track, touching), track.points(touching, traces.template.positions)
    empty = torch.zeros(window.shape)
    halves = np.arange(len(touching))
    chosen = choose_smoothness(samples, points, halves, window, empty)
    apart = choose_smoothness(_of_two_bundles(samples), points, halves, window, empty)
    return Told(smoothness=max(chosen.weight, apart.weight), agreement=apart.agreement)


def _of_two_bundles(samples: Samples) -> Samples:
    """Return the samples (T, N) as if even and odd frames had been recorded by different cores.

    Where a path is gone again and again, each place is seen by the same cores, and what is wrong with their gains is in
    both halves of the frames: they would agree on it. Halves that share no core do not.
    """
    is_first = torch.rand(samples.cores, generator=torch.Generator().manual_seed(0)) < 0.5
    own = torch.where(torch.arange(len(samples.weights))[:, None] % 2 == 0, is_first, ~is_first)
    return replace(samples, weights=samples.weights * own[:, samples.core_index])
