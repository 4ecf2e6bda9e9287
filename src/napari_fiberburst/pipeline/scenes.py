"""The scenes of a burst, from the first preview to the last, and the images that they stand for.

Nothing here needs the frames any more: samples are enough.
"""

from collections.abc import Generator
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.motion.registration import Registration
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.pipeline.fitted import Fitted
from napari_fiberburst.pipeline.render import image_of
from napari_fiberburst.scene.smeared_motion import refine_along
from napari_fiberburst.scene.smoothness import UNTOLD
from napari_fiberburst.scene.solve import Draft, Scene, drafting, finishing, grid_over, solve_quickly
from napari_fiberburst.settings import SplineMethod

# Spacing of a preview's nodes, pixels or, in coarse bundles, pitches.
_PREVIEW_SPACING, _PREVIEW_PITCHES = 1.5, 0.3
# A union of frames reaches at most so many frames' sizes from the reference frame.
_MOST_FIELDS = 5

Value = TypeVar("Value")


class Scenes:
    """Solves scenes for what is known of a burst.

    Parameters
    ----------
    acquisition : Acquisition
        Of the burst.
    method : SplineMethod
        How.
    seed : int
        Draws which samples are left out.
    """

    def __init__(self, acquisition: Acquisition, method: SplineMethod, seed: int) -> None:
        self._acquisition, self._method, self._seed = acquisition, method, seed

    def solve(self, fitted: Fitted, draft: Draft | None = None) -> Generator[Fitted, None, Fitted]:
        """Solve the scene from the final samples, at the smoothness and without the frames that the method says.

        Parameters
        ----------
        fitted : Fitted
            With samples, and with the motion of all frames.
        draft : Draft, optional
            Of these samples where they lie, where there is one: less is left to do.
        """
        samples = fitted.samples
        assert samples is not None
        fitted = self.without_left_out(fitted)
        fitted = replace(fitted, canvas=self.canvas(fitted.registration, samples))
        grid = self.grid(fitted)
        dark = _dark(fitted, grid)
        smoothness = self._method.smoothness
        if draft is None:
            steps = drafting(samples, fitted.registration, grid, is_asked=smoothness is None, dark=dark)
            fitted, draft = yield from self._drawn(fitted, steps)
            if draft.smear is not None:
                fitted, draft = yield from self._drawn_again(fitted, draft, grid, dark)
        final = finishing(
            draft,
            samples,
            fitted.registration,
            grid,
            smoothness=smoothness,
            held_out=self._method.held_out,
            seed=self._seed,
            dark=dark,
        )
        fitted, scene = yield from self._drawn(fitted, final)
        return replace(self.with_scene(fitted, scene), draft=draft)

    def _drawn_again(
        self, fitted: Fitted, draft: Draft, grid: Grid, dark: Tensor | None
    ) -> Generator[Fitted, None, tuple[Fitted, Draft]]:
        """Find the motion of smeared frames again, and what can be learned of their samples where they then lie."""
        samples, before = fitted.samples, fitted.registration
        assert samples is not None
        assert draft.smear is not None
        registration = refine_along(
            draft.refined(samples, before), before, grid, draft.smear, draft.coefficients, draft.smoothness or UNTOLD
        )
        if registration is before:
            return fitted, draft
        yield fitted
        steps = drafting(samples, registration, grid, is_asked=self._method.smoothness is None, dark=dark)
        return (yield from self._drawn(replace(fitted, registration=registration), steps))

    def without_left_out(self, fitted: Fitted) -> Fitted:
        """Leave those frames out that the method says."""
        if not self._method.leave_out:
            return fitted
        return replace(fitted, registration=fitted.registration.without(self._method.leave_out))

    def sketched(self, fitted: Fitted, samples: Samples, registration: Registration) -> Fitted:
        """Solve a coarse scene from some samples, for a preview."""
        spacing = max(_PREVIEW_SPACING / self._method.upsample, _PREVIEW_PITCHES * fitted.bundle.pitch)
        grid = self._grid_of(spacing, fitted)
        dark = _dark(fitted, grid)
        return self.with_scene(fitted, solve_quickly(samples, registration, grid, self._method.smoothness, dark))

    def with_scene(self, fitted: Fitted, scene: Scene) -> Fitted:
        """Return what is known with another scene, and the image that it stands for."""
        if fitted.scene is not None and scene.coefficients is fitted.scene.coefficients:
            return replace(fitted, scene=scene)
        image = image_of(scene, fitted.recorded, fitted.bundle, self._acquisition, fill=self._method.fill)
        return replace(fitted, scene=scene, image=image)

    @property
    def frame_canvas(self) -> Canvas:
        """The canvas over the reference frame."""
        _, height, width, _ = self._acquisition.shape
        return Canvas.over((0, 0, width, height), self._method.upsample)

    def canvas(self, registration: Registration, samples: Samples) -> Canvas:
        """Lay the canvas over the reference frame, or over all that any frame saw."""
        if self._method.canvas == "frame":
            return self.frame_canvas
        points = registration.points(samples.positions)[registration.correct(samples).weights > 0]
        points = points[torch.isfinite(points).all(dim=1)]
        low, high = points.amin(dim=0).floor().tolist(), points.amax(dim=0).ceil().tolist()
        most = _MOST_FIELDS * max(self._acquisition.shape[1:3])
        low, high = ([min(max(edge, -most), most) for edge in corner] for corner in (low, high))
        return Canvas.over((low[0], low[1], high[0] + 1, high[1] + 1), self._method.upsample)

    def grid(self, fitted: Fitted) -> Grid:
        """Return the grid of the final scene: a node to a pixel of the image, and a margin."""
        return self._grid_of(1 / self._method.upsample, fitted)

    def coarse_grid(self, fitted: Fitted) -> Grid:
        """Return a grid on which to compare how well samples predict one another, whatever the image's is."""
        return self._grid_of(max(_PREVIEW_SPACING, _PREVIEW_PITCHES * fitted.bundle.pitch), fitted)

    def _grid_of(self, spacing: float, fitted: Fitted) -> Grid:
        """Return a grid over the canvas and some more, its nodes on pixel centres where the spacing is a pixel's."""
        canvas = fitted.canvas
        first = canvas.reference_from_image[:2, 2]
        last = first + canvas.reference_from_image[[0, 1], [0, 1]] * (np.array(canvas.shape[::-1]) - 1)
        return grid_over((*first.tolist(), *last.tolist()), spacing, fitted.bundle.pitch + fitted.bundle.radius)

    def _drawn(
        self, fitted: Fitted, steps: Generator[Scene, None, Value]
    ) -> Generator[Fitted, None, tuple[Fitted, Value]]:
        """Take the scenes that steps yield into what is known; return that, and what the steps have come to."""
        while True:
            try:
                fitted = self.with_scene(fitted, next(steps))
                yield fitted
            except StopIteration as end:
                return fitted, end.value


def _dark(fitted: Fitted, grid: Grid) -> Tensor | None:
    """Return nodes where the reference frame is dark, (H, W) bool; None if there are none."""
    if fitted.dark is None:
        return None
    height, width = fitted.dark.shape
    column, row = grid.nodes().round().long().unbind(dim=-1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return inside & fitted.dark.cpu()[row.clamp(0, height - 1), column.clamp(0, width - 1)]
