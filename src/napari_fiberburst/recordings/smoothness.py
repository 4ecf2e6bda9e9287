"""How smooth the scene of a window is to be, by what one half of its frames tells of the other."""

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from napari_fiberburst.recordings.changes import find_changes
from napari_fiberburst.recordings.scene import corrected
from napari_fiberburst.recordings.traces import Traces
from napari_fiberburst.recordings.track import Track
from napari_fiberburst.recordings.window import frames_about, view_of
from napari_fiberburst.scene.smoothness import UNTOLD, choose_smoothness

# So many windows are asked, spread over the recording.
_WINDOWS = 5


def smoothness_for(traces: Traces, track: Track, width: int) -> float:
    """Return the weight of the prior for windows of so many frames.

    The median of what some windows ask for, because one that shows little tells it badly. What differs from frame to
    frame is left out: it would be taken for noise, and the scene be smoothed by two to five times as much.
    """
    frames = np.flatnonzero(track.piece >= 0)
    if not len(frames):
        return UNTOLD
    some = frames[np.unique(np.linspace(0, len(frames) - 1, _WINDOWS + 2)[1:-1].astype(int))]
    told = [_told(traces, track, frames_about(track, number, width), number) for number in some.tolist()]
    return float(np.exp(np.median(np.log(told))))


def _told(traces: Traces, track: Track, frames: NDArray[np.int64], number: int) -> float:
    if len(frames) < 2:
        return UNTOLD
    changes = find_changes(traces, track, frames, UNTOLD)
    same = torch.stack([~changes[frame] for frame in frames.tolist()])
    samples = corrected(traces, track, frames)
    grid = view_of(track, number, 0.0)
    points = track.points(frames, traces.template.positions)
    samples = replace(samples, weights=samples.weights * same)
    return choose_smoothness(samples, points, np.arange(len(frames)), grid, torch.zeros(grid.shape)).weight
