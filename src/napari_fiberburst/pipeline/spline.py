"""The self-calibrating fit: align, then solve the scene as a spline. Each stage shows what it has."""

import time
from collections.abc import Callable, Generator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.gains import refreshed
from napari_fiberburst.bundle.samples import Observation
from napari_fiberburst.control import Control
from napari_fiberburst.data.burst import Burst
from napari_fiberburst.device import find_device
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.pipeline.alignment import Alignment
from napari_fiberburst.pipeline.diagnose import bundle_evidence, fit_evidence
from napari_fiberburst.results.progress import Progress
from napari_fiberburst.results.reconstruction import Canvas, Ending, Reconstruction, draw
from napari_fiberburst.scene.image import SplinePicture
from napari_fiberburst.scene.smoothness import UNTOLD, Smoothness, choose_among_neighbours, choose_smoothness
from napari_fiberburst.scene.spline import Normal, assemble
from napari_fiberburst.settings import Settings, Spline

# Rounds and stages that a fit has, about: what is left is told in these.
_PLANNED = 27
# Spacing of the first preview's nodes, pixels or, in coarse bundles, pitches.
_PREVIEW_SPACING, _PREVIEW_PITCHES = 1.5, 0.3


class SelfCalibrated:
    """One self-calibrating fit in the making.

    Parameters
    ----------
    burst, settings
        What to fit, and how.
    image : Tensor, optional
        (H, W, C), the bundle with even light before it.
    """

    def __init__(self, burst: Burst, settings: Settings, image: Tensor | None = None) -> None:
        self._burst, self._settings = burst, settings
        self._device = find_device(settings.device)
        self._started = time.perf_counter()
        self.alignment = Alignment(burst, settings, self._device, image)
        self.ending: Ending = "finished"
        self._losses: list[float] = []
        self.picture: SplinePicture | None = None
        self.canvas = Canvas.over((0, 0, burst.shape[2], burst.shape[1]), settings.upsample)
        self._smoothness: float | None = None
        self._normal: Normal | None = None
        self._scene: Tensor | None = None
        self._chosen: Smoothness | None = None
        self._error: float | None = None

    @property
    def seconds(self) -> float:
        """Time since the start, pauses left out."""
        return time.perf_counter() - self._started

    def run(
        self, control: Control, should_stop: Callable[[], bool] | None
    ) -> Generator[Progress, None, Reconstruction]:
        """Yield progress after every round and stage; return the reconstruction of what was reached."""
        yield from self._watched(self._stages(), control, should_stop)
        if self.ending != "finished":
            self._round_off()
        yield self._report(last=True)
        return self.result()

    def prepare(self, control: Control, should_stop: Callable[[], bool] | None) -> Generator[Progress, None, None]:
        """Calibrate and register, for a network to go on from; yields progress."""
        yield from self._watched(self.align(), control, should_stop)
        self._round_off()

    def _round_off(self) -> None:
        """Make samples, picture and motion belong together, wherever the stages have ended."""
        aligned = self.alignment
        if not aligned.is_registered:
            aligned.notes.append("the run ended before the frames were registered")
        aligned.observation = aligned.in_colour()
        self._keep(*self._solve_quickly())

    def _watched(
        self, stages: Generator[str, None, None], control: Control, should_stop: Callable[[], bool] | None
    ) -> Generator[Progress, None, None]:
        """Report after every stage, until the user or the clock ends it."""
        for _ in stages:
            yield self._report()
            paused = time.perf_counter()
            control.wait_while_paused(should_stop)
            self._started += time.perf_counter() - paused
            if control.stopped or (should_stop is not None and should_stop()):
                self.ending = "stopped"
                return
            budget = self._settings.time_budget
            if budget is not None and self.seconds >= budget:
                self.ending = "time budget"
                return

    def align(self) -> Generator[str, None, None]:
        """Do all but solve the scene, with a first picture on the way."""
        for stage in self.alignment.register():
            if stage == "roughly registered":
                self._keep(*self._solve_quickly())
            yield stage
        self._keep(*self._solve_quickly())
        yield "registered"
        yield from self.alignment.refine()

    def bundle_evidence(self) -> dict[str, Any]:
        """Return what is known of bundle and motion, whatever has fitted the scene."""
        assert self._normal is not None
        return bundle_evidence(self.alignment, self._normal.grid, self.canvas, self._burst)

    def _stages(self) -> Generator[str, None, None]:
        yield "calibrated"
        yield from self.align()
        yield from self.solve()

    def solve(self) -> Generator[str, None, None]:
        """Solve the scene for motion and gains as they are."""
        self._place_canvas()
        grid = self._grid(1 / self._settings.upsample, self.canvas)
        scene = self._refined_scene(grid)
        yield "picture"
        yield from self._solve_finally(grid, scene)

    def _refined_scene(self, grid: Grid) -> Tensor:
        """Solve once, take from it what is left to learn of the gains, and show it."""
        seen, points = self.alignment.observation, self.alignment.points()
        normal = assemble(grid, seen, points)
        smoothness = UNTOLD if self._fixed is None else self._fixed
        scene = normal.solve(smoothness, normal.mean(), 25)
        if not self.alignment.is_still:
            known = self.alignment.calibration.is_trusted
            self.alignment.observation = refreshed(seen, points, grid, normal.through(scene), shares_known=known)
        self._keep(normal, scene, smoothness)
        return scene

    def _solve_finally(self, grid: Grid, scene: Tensor) -> Generator[str, None, None]:
        """Choose the smoothness, ask the samples that were left out, then solve with all of them."""
        aligned = self.alignment
        seen, points = aligned.observation, aligned.points()
        frames = np.flatnonzero(aligned.used)
        if self._fixed is not None:
            self._smoothness = self._fixed
        elif aligned.is_still and seen.radius is None:
            self._smoothness = UNTOLD
        else:
            choose = choose_among_neighbours if aligned.is_still else choose_smoothness
            self._chosen = choose(seen, points, frames, grid, scene.mean(dim=0))
            self._smoothness = self._chosen.weight
        yield "smoothness chosen"
        held = self._held_out(seen)
        normal = assemble(grid, seen, points, (~held).to(points))
        scene = normal.solve(self._smoothness, scene)
        self._error = _missed(seen, points, grid, normal.through(scene), held)
        self._keep(normal, scene, self._smoothness)
        yield "sample error known"
        if held.any():
            rest = assemble(grid, seen, points, held.to(points))
            normal.stencil, normal.light = normal.stencil + rest.stencil, normal.light + rest.light
            scene = normal.solve(self._smoothness, scene)
        self._keep(normal, scene, self._smoothness)

    @property
    def _fixed(self) -> float | None:
        encoding = self._settings.encoding
        return encoding.smoothness if isinstance(encoding, Spline) else None

    def _held_out(self, seen: Observation) -> Tensor:
        """Return which samples (T, N) are left out to tell the error."""
        generator = torch.Generator().manual_seed(self._settings.seed)
        chance = torch.rand(seen.weights.shape, generator=generator).to(seen.weights.device)
        return (chance < self._settings.held_out) & (seen.weights > 0)

    def _solve_quickly(self) -> tuple[Normal, Tensor, float]:
        """Solve a coarse first picture of all that is known so far."""
        seen = self.alignment.in_colour()
        self._place_canvas()
        spacing = max(_PREVIEW_SPACING / self._settings.upsample, _PREVIEW_PITCHES * self.alignment.pitch)
        grid = self._grid(spacing, self.canvas)
        normal = assemble(grid, seen, self.alignment.points(seen))
        smoothness = UNTOLD if self._fixed is None else self._fixed
        return normal, normal.solve(smoothness, normal.mean(), 12), smoothness

    def _place_canvas(self) -> None:
        """Lay the canvas over the reference frame, or over all that any frame saw."""
        bounds = (0.0, 0.0, float(self._burst.shape[2]), float(self._burst.shape[1]))
        if self._settings.canvas == "union":
            points = self.alignment.points()[self.alignment.observation.weights > 0]
            low, high = points.amin(dim=0).floor().tolist(), points.amax(dim=0).ceil().tolist()
            size = max(self._burst.shape[1:3])
            low, high = ([min(max(edge, -5 * size), 5 * size) for edge in corner] for corner in (low, high))
            bounds = (low[0], low[1], high[0] + 1, high[1] + 1)
        self.canvas = Canvas.over(bounds, self._settings.upsample)

    def _grid(self, spacing: float, canvas: Canvas) -> Grid:
        """Return a grid over the canvas and some more, its nodes on pixel centres where the spacing is a pixel's."""
        first = canvas.frame0_from_image[:2, 2]
        last = first + canvas.frame0_from_image[[0, 1], [0, 1]] * (np.array(canvas.shape[::-1]) - 1)
        margin = spacing * np.ceil((self.alignment.pitch + self.alignment.calibration.radius) / spacing)
        return Grid.over((*(first - margin).tolist(), *(last + margin).tolist()), spacing)

    def _keep(self, normal: Normal, scene: Tensor, smoothness: float) -> None:
        """Keep a solution, and the picture it stands for."""
        self._normal, self._scene = normal, scene
        known = normal.density() > 1e-3
        self.picture = SplinePicture(
            scene=normal.picture(scene, smoothness),
            grid=normal.grid,
            known=known,
            reach=self.alignment.pitch,
            fill=self._settings.fill,
            homographies=self.alignment.homographies(),
            black=self.alignment.calibration.black,
        )

    def _report(self, *, last: bool = False) -> Progress:
        aligned = self.alignment
        loss = 4 * aligned.residual**2 if np.isfinite(aligned.residual) else float("nan")
        self._losses.append(loss)
        step = len(self._losses)
        total = step if last else max(_PLANNED, step + 1)
        rate = step / max(self.seconds, 1e-9)
        return Progress(
            step=step,
            iterations=total,
            loss=loss,
            seconds=self.seconds,
            rate=rate,
            remaining=(total - step) / rate,
            homographies=aligned.homographies(),
            settings=self._chosen_settings,
            canvas=self.canvas,
            preview=self._fresh_preview(last=last),
            sample_error=self._error_in_units,
        )

    def _fresh_preview(self, *, last: bool) -> NDArray[np.float32] | None:
        """Return the picture where it is a new one, and asked for."""
        picture = self.picture
        if picture is None or self._settings.preview_every is None or (picture.is_shown and not last):
            return None
        picture.is_shown = True
        return self._draw(picture)

    def _draw(self, picture: SplinePicture) -> NDArray[np.float32]:
        return draw(picture, self.canvas, self.alignment.reference, self._burst)

    @property
    def _chosen_settings(self) -> Settings:
        settings = self._settings
        if isinstance(settings.encoding, Spline) and self._smoothness is not None:
            return replace(settings, encoding=Spline(smoothness=self._smoothness))
        return settings

    @property
    def _error_in_units(self) -> float | None:
        return None if self._error is None else self._error * (self._burst.white_level - self._burst.black_level)

    def result(self) -> Reconstruction:
        """Return the reconstruction, as far as it has come."""
        assert self.picture is not None
        assert self._normal is not None
        assert self._scene is not None
        return Reconstruction(
            image=self._draw(self.picture),
            canvas=self.canvas,
            homographies=self.alignment.homographies(),
            losses=np.array(self._losses, dtype=np.float32),
            settings=self._chosen_settings,
            seconds=self.seconds,
            parameters=self.picture.parameters,
            device=str(self._device),
            ending=self.ending,
            acquisition=self._burst.acquisition,
            renderer=self.picture,
            sample_error=self._error_in_units,
            resolution=None if self._chosen is None else self._chosen.resolution,
            **self.bundle_evidence(),
            **fit_evidence(
                self.alignment, self._normal, self._scene, self.canvas, self._smoothness or UNTOLD, self._burst
            ),
        )


def _missed(seen: Observation, points: Tensor, grid: Grid, through: Tensor, held: Tensor) -> float | None:
    """Return the root mean square by which the scene misses the samples that were left out."""
    total = mass = 0.0
    for number, chosen in enumerate(held):
        if not bool(chosen.any()):
            continue
        at = grid.at(points[number, chosen])
        weights = seen.weights[number, chosen] * at.inside
        for channel, light in zip(seen.values[number, chosen].T, through, strict=True):
            total += float((weights * (channel - at.read(light)) ** 2).sum())
            mass += float(weights.sum())
    return (total / mass) ** 0.5 if mass > 0 else None
