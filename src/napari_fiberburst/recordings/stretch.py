"""Some frames of a video in a row, each solved from those about it, one after the other."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from skimage.morphology import remove_small_holes
from torch import Tensor

from napari_fiberburst.bundle.samples import sample_cores
from napari_fiberburst.io.pyramid import write_frames
from napari_fiberburst.operators.filters import filled_mean
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.recordings.changes import draw_change, find_changes
from napari_fiberburst.recordings.regions import light_of_cores, light_of_regions, write_rows
from napari_fiberburst.recordings.scene import corrected
from napari_fiberburst.recordings.traces import PART, traced
from napari_fiberburst.recordings.track import Track
from napari_fiberburst.recordings.window import Window, frames_about, view_of
from napari_fiberburst.recordings.work import Work
from napari_fiberburst.scene.image import SplineImage
from napari_fiberburst.scene.spline import NormalEquations, assemble
from napari_fiberburst.stored import Stored

# So many frames are solved one after the other: whole parts of the traces, and whole chunks of the video.
STRETCH = PART
# Nodes about what a frame sees that are solved with it, in pitches.
_MARGIN = 2.5
# Iterations of conjugate gradients: for the first frame of a stretch, and for those that start from the one before.
_FIRST_ITERATIONS, _ITERATIONS = 60, 3
# Farther than so many pitches from a core nothing is drawn.
_REACH = 1.0
# A frame without a place is drawn by this Gaussian about each core, pitches.
_ALONE = 0.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plan(Stored):
    """What every stretch needs to know.

    Attributes
    ----------
    track : Track
        Where frames lie.
    path, traces : str
        The OME-Zarr video, and the Zarr group of traces.
    smoothness : float
        Of the scene.
    window : int
        How many frames stand behind each.
    is_stabilised : bool
        Whether frames are shown where they lie on `picture`.
    canvas : tuple
        x0 and y0, rows and columns of `picture`.
    regions : numpy.ndarray or None
        (rows, columns) int64 on `picture`.
    """

    _kind: ClassVar[str] = "plan of a video"

    track: Track
    path: str
    traces: str
    smoothness: float
    window: int
    is_stabilised: bool
    canvas: tuple[float, float, int, int]
    regions: NDArray[np.int64] | None

    @property
    def picture(self) -> Grid:
        """The pixels of a stabilised video, in the largest piece's scene; of a frame where it is not stabilised."""
        x0, y0, rows, columns = self.canvas
        return Grid(x0, y0, 1.0, (rows, columns))


def solve_unit(work: Work, stage: str, number: int) -> None:
    """Solve the frames of one stretch, and write them and their traces."""
    plan, known = Plan.load(work.shared(stage)), work.source.acquisition
    span = known.white_level - known.black_level
    frames = np.arange(number * STRETCH, min((number + 1) * STRETCH, len(work.source)))
    stretch = _Stretch(work, plan, frames)
    shown = [
        stretch.placed(frame) if plan.track.piece[frame] >= 0 else stretch.alone(frame) for frame in frames.tolist()
    ]
    pictures = np.stack(shown) * np.float32(span) + np.float32(work.bundle.black)
    write_frames(Path(plan.path), int(frames[0]), pictures if "C" in known.axes else pictures[:, 0])
    traces = traced(work)
    light = light_of_cores(traces, plan.track, frames, work.bundle.black, span)
    write_rows(Path(plan.traces), "cores", int(frames[0]), light)
    if plan.regions is not None:
        means = light_of_regions(light, plan.track, frames, traces.template.positions, plan.regions, plan.picture)
        write_rows(Path(plan.traces), "regions", int(frames[0]), means)


class _Stretch:
    """The frames of a stretch, which are to be drawn in order."""

    def __init__(self, work: Work, plan: Plan, frames: NDArray[np.int64]) -> None:
        self._work, self._plan, self._traces = work, plan, traced(work)
        track = plan.track
        about = [frames_about(track, int(frame), plan.window) for frame in frames if track.piece[frame] >= 0]
        asked = np.unique(np.concatenate(about)) if about else np.zeros(0, np.int64)
        self._changes = find_changes(self._traces, track, asked, plan.smoothness)
        self._window = Window(self._assembled)
        self._before: tuple[Grid, Tensor] | None = None
        height, width = track.shape
        rows, columns = np.indices((height, width), dtype=np.float64)
        self._pixels = np.stack([columns, rows], axis=-1)
        self._is_seen = near_cores(self._pixels, work.bundle.centres, _REACH * work.bundle.pitch)

    def placed(self, frame: int) -> NDArray[np.float32]:
        """Return a frame that has a place, (C, H, W) in [0, 1] above black."""
        plan, track = self._plan, self._plan.track
        margin = _MARGIN * self._work.bundle.pitch
        grid = view_of(track, frame, margin)
        equations = self._window.about(frames_about(track, frame, plan.window), grid)
        start = None if self._before is None else _start(*self._before, equations, round(margin))
        scene = equations.solve(plan.smoothness, start, _FIRST_ITERATIONS if start is None else _ITERATIONS)
        self._before = grid, scene
        image = equations.image(scene, plan.smoothness)
        changed = self._changes[frame]
        if bool(changed.any()):
            own = np.array([frame])
            samples, points = corrected(self._traces, track, own), track.points(own, self._traces.template.positions)
            image = image + draw_change(samples, points, changed, grid, equations.through(scene))
        return self._stabilised(image, grid, frame) if plan.is_stabilised else self._as_it_lies(image, grid, frame)

    def alone(self, frame: int) -> NDArray[np.float32]:
        """Return a frame that has no place: its own samples, smoothed; nothing where the video is stabilised."""
        _, _, _, channels = self._work.source.shape
        if self._plan.is_stabilised:
            return np.full((channels, *self._plan.picture.shape), np.nan, np.float32)
        values = torch.from_numpy(self._work.source.values([frame]))
        samples = sample_cores(values, self._work.bundle, self._work.source.acquisition)
        samples = samples.without_gains(torch.from_numpy(self._plan.track.gains))
        at = Grid(0.0, 0.0, 1.0, self._plan.track.shape).at(samples.positions)
        weights = samples.weights[0]
        totals = torch.stack([at.adjoint(weights * light) for light in samples.values[0].T])
        image = filled_mean(totals, at.adjoint(weights), _ALONE * self._work.bundle.pitch).numpy()
        return np.where(self._is_seen & bool(weights.any()), image, np.float32(np.nan))

    def _assembled(self, frame: int) -> NormalEquations:
        """Return the equations of one frame, without what shows something else than the scene."""
        track, own = self._plan.track, np.array([frame])
        samples, points = corrected(self._traces, track, own), track.points(own, self._traces.template.positions)
        return assemble(view_of(track, frame, 2.0), samples, points, (~self._changes[frame])[None].to(points))

    def _as_it_lies(self, image: Tensor, grid: Grid, frame: int) -> NDArray[np.float32]:
        drawn = SplineImage(
            scene=image,
            grid=grid,
            known=torch.ones(grid.shape, dtype=torch.bool),
            reach=0.0,
            fill=True,
            homographies=self._plan.track.scene_from_frame[[frame]],
            black=0.0,
        ).render(self._pixels, 0)
        return np.where(self._is_seen, np.moveaxis(drawn, -1, 0), np.float32(np.nan))

    def _stabilised(self, image: Tensor, grid: Grid, frame: int) -> NDArray[np.float32]:
        plan = self._plan
        picture = plan.picture
        shown = np.full((len(image), *picture.shape), np.nan, np.float32)
        if plan.track.piece[frame] != 0:
            return shown
        top, left = round(grid.y0 - picture.y0), round(grid.x0 - picture.x0)
        rows = slice(max(0, top), min(picture.shape[0], top + grid.shape[0]))
        columns = slice(max(0, left), min(picture.shape[1], left + grid.shape[1]))
        if rows.start >= rows.stop or columns.start >= columns.stop:
            return shown
        inner = slice(rows.start - top, rows.stop - top), slice(columns.start - left, columns.stop - left)
        is_seen = self._seen_nodes(grid, frame)[inner]
        shown[:, rows, columns] = np.where(is_seen, image[:, *inner].numpy(), np.float32(np.nan))
        return shown

    def _seen_nodes(self, grid: Grid, frame: int) -> NDArray[np.bool_]:
        """Return which nodes a frame sees, (H, W)."""
        from_scene = torch.from_numpy(np.linalg.inv(self._plan.track.scene_from_frame[frame]))
        nodes = grid.nodes().double()
        places = nodes @ from_scene[:2, :2].T + from_scene[:2, 2]
        height, width = self._plan.track.shape
        columns, rows = (places[..., axis].round().long() for axis in (0, 1))
        inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        seen = torch.from_numpy(self._is_seen)[rows.clamp(0, height - 1), columns.clamp(0, width - 1)]
        found: NDArray[np.bool_] = (seen & inside).numpy()
        return found


def _start(grid: Grid, scene: Tensor, equations: NormalEquations, margin: int) -> Tensor:
    """Return where to begin: the scene of the frame before (C, H, W) where that was seen, the local mean elsewhere.

    In its margin, of so many nodes, that scene was solved from hardly anything, and would need many iterations.
    """
    wanted = equations.grid
    rows, columns = (
        torch.arange(count) + round(start - first)
        for count, start, first in zip(wanted.shape, (wanted.y0, wanted.x0), (grid.y0, grid.x0), strict=True)
    )
    height, width = grid.shape
    seen_rows, seen_columns = (
        (place >= margin) & (place < side - margin) for place, side in ((rows, height), (columns, width))
    )
    before = scene[:, rows.clamp(0, height - 1)][:, :, columns.clamp(0, width - 1)]
    return torch.where(seen_rows[:, None] & seen_columns, before, equations.local_mean())


def near_cores(pixels: NDArray[np.float64], centres: NDArray[np.floating], reach: float) -> NDArray[np.bool_]:
    """Return which pixels (H, W, 2) lie near a core, (H, W), or where one core is missing among others."""
    distance, _ = cKDTree(centres).query(pixels.reshape(-1, 2), distance_upper_bound=reach)
    near: NDArray[np.bool_] = np.isfinite(distance).reshape(pixels.shape[:2])
    filled: NDArray[np.bool_] = remove_small_holes(near, max_size=math.ceil(reach**2))
    return filled
