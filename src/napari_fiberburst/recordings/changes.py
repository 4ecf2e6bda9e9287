"""What differs in one frame from the frames about it: a cell that flashes, what passes before the object.

A scene that many frames have made does not know of it. Samples that show something else are kept out of the scene, so
that it leaves no ghost in other frames, and are added to the picture of the frame that they belong to.
"""

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.operators.filters import blur
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.recordings.scene import corrected
from napari_fiberburst.recordings.traces import Traces
from napari_fiberburst.recordings.track import Track
from napari_fiberburst.recordings.window import union, view_of
from napari_fiberburst.scene.outliers import find_outliers
from napari_fiberburst.scene.spline import assemble

# Frames are compared with a scene of so many nodes to a pitch, found in so many iterations, twice.
_NODES, _ITERATIONS = 2.5, (24, 12)
# Frames are compared together as long as all of them see at most so many times the field of one.
_FIELDS = 8.0
# In standard deviations of what usually differs there: what differs by more has changed, as long as that is not less
# than the second number, in parts of the contrast. The third is over what distance neighbours are averaged, in pitches.
_FAR, _LEAST_SIZE, _SPREAD = 4.5, 0.25, 0.6
# What changes is drawn by this Gaussian about each core, pitches.
_SIGMA = 0.42
# Cores to a square pitch; between cores there are about 1.15 everywhere, beyond them fewer.
_LEAST_MASS = 0.2


def find_changes(traces: Traces, track: Track, frames: NDArray[np.int64], smoothness: float) -> dict[int, Tensor]:
    """Return, by the number of each frame, which of its samples (N,) show something else than others at that place.

    Parameters
    ----------
    traces : Traces
        What cores have seen.
    track : Track
        Where frames lie.
    frames : numpy.ndarray
        Numbers of frames in a row, of any pieces.
    smoothness : float
        Of the scene.
    """
    found: dict[int, Tensor] = {}
    for some in _together(track, frames):
        found |= dict(zip(some.tolist(), _compared(traces, track, some, smoothness), strict=True))
    return found


def _together(track: Track, frames: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Return frames in parts that lie on one piece and see no more than fits into memory."""
    most = _FIELDS * track.shape[0] * track.shape[1]
    some: list[int] = []
    seen: Grid | None = None
    for number in frames[np.argsort(track.piece[frames], kind="stable")].tolist():
        view = view_of(track, number, 0.0)
        both = view if seen is None else union([seen, view])
        if some and (track.piece[number] != track.piece[some[0]] or both.shape[0] * both.shape[1] > most):
            yield np.array(some)
            some, both = [], view
        some.append(number)
        seen = both
    if some:
        yield np.array(some)


def _compared(traces: Traces, track: Track, frames: NDArray[np.int64], smoothness: float) -> Tensor:
    """Return which samples (n, N) of frames show something else than the scene that all of them make."""
    samples, points = corrected(traces, track, frames), track.points(frames, traces.template.positions)
    grid = Grid.around(points, max(1.0, samples.pitch / _NODES), samples.pitch)
    found, scene = torch.zeros_like(samples.weights, dtype=torch.bool), None
    for iterations in _ITERATIONS:
        equations = assemble(grid, samples, points, (~found).to(samples.weights))
        scene = equations.solve(smoothness, scene, iterations)
        found = find_outliers(
            samples, points, grid, equations.through(scene), far=_FAR, least_size=_LEAST_SIZE, spread=_SPREAD
        )
    return found


def draw_change(samples: Samples, points: Tensor, changed: Tensor, grid: Grid, filtered: Tensor) -> Tensor:
    """Return what is to be added to the picture of a frame (C, H, W): light that the scene does not have.

    What each core that shows something else differs by is spread about it so that the light adds up to the same.

    Parameters
    ----------
    samples : Samples
        Of one frame, gains and exposure taken out.
    points : Tensor
        (1, N, 2), where they lie in the scene.
    changed : Tensor
        (N,) bool, which of them show something else.
    grid : Grid
        Of the picture.
    filtered : Tensor
        (C, H, W), the scene as samples see it through their footprint.
    """
    own = samples.weights[0] > 0
    sampling = grid.at(points[0][own])
    light = (samples.values[0][own] - sampling.of_channels(filtered)) * changed[own][:, None]
    parts = torch.stack([sampling.adjoint(part) for part in (*light.T, torch.ones_like(light[:, 0]))])
    *total, mass = blur(parts, _SIGMA * samples.pitch / grid.spacing)
    drawn: Tensor = torch.stack(total) / mass.clamp_min(_LEAST_MASS / samples.pitch**2)
    return drawn
