"""The default method at work: the stages, and the scene as a spline."""

from collections.abc import Generator
from dataclasses import replace

import numpy as np
import torch

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.data.burst import Burst
from napari_fiberburst.motion.registration import Registration
from napari_fiberburst.pipeline.diagnose import diagnose
from napari_fiberburst.pipeline.stages import Fitted, Stages
from napari_fiberburst.pipeline.supervise import Clock, Snapshot
from napari_fiberburst.results.reconstruction import Ending, Reconstruction, draw
from napari_fiberburst.settings import (
    Affine,
    AutoMotion,
    Deformable,
    Homography,
    Settings,
    Similarity,
    SplineMethod,
    Translation,
)
from napari_fiberburst.settings.choices import SplineMotion

# Rounds and stages that a fit has, about: what is left is counted in these.
_PLANNED = 27


class SplineFit:
    """A fit by stages; see `napari_fiberburst.pipeline.supervise.Fit`.

    Parameters
    ----------
    burst : Burst
        What to fit.
    requested : Settings
        What was asked for.
    method : SplineMethod
        How to fit it: the method asked for, or the alignment of a network's.
    device : torch.device
        Where.
    given : Bundle, optional
        The bundle, where it is known.
    """

    def __init__(
        self, burst: Burst, requested: Settings, method: SplineMethod, device: torch.device, given: Bundle | None
    ) -> None:
        self._burst, self._requested, self._method, self._device = burst, requested, method, device
        self._stages = Stages(burst, method, device, seed=requested.seed, given=given)
        self._losses: list[float] = []
        self._fitted: Fitted | None = None

    @property
    def fitted(self) -> Fitted:
        """What is known; only after `conclude`, or once the steps are done."""
        assert self._fitted is not None
        return self._fitted

    def steps(self, clock: Clock) -> Generator[Snapshot | None, None, Ending]:
        """Align, then solve."""
        fitted = yield from self.align()
        fitted = yield from self._watched(self._stages.solve(fitted))
        return "finished"

    def align(self) -> Generator[Snapshot | None, None, Fitted]:
        """Do all but solve the scene: calibrate, register, decide what a sample is."""
        return (yield from self._watched(self._stages.align()))

    def conclude(self, ending: Ending) -> tuple[Snapshot, Ending]:
        """Draw what there is."""
        if ending != "finished":
            self.round_off()
        return self._snapshot(None, is_last=True), ending

    def round_off(self) -> Fitted:
        """Make what is known belong together, with a first image of it."""
        self._fitted = self._stages.round_off(self._fitted)
        return self._fitted

    def result(self, ending: Ending, seconds: float) -> Reconstruction:
        """Return the reconstruction."""
        fitted = self.fitted
        image, scene = fitted.image, fitted.scene
        assert image is not None
        assert scene is not None
        diagnostics = diagnose(
            self._burst,
            fitted.bundle,
            fitted.registration,
            scene,
            fitted.canvas,
            notes=fitted.all_notes,
            noise=fitted.noise,
        )
        if fitted.outliers is not None and diagnostics.outliers is not None:
            early = fitted.outliers.cpu().numpy()
            diagnostics = replace(diagnostics, outliers=diagnostics.outliers | early)
        return Reconstruction(
            image=draw(image, fitted.canvas, fitted.registration.reference, self._burst),
            canvas=fitted.canvas,
            homographies=fitted.recorded.reference_from_frame,
            losses=np.array(self._losses, dtype=np.float32),
            requested=self._requested,
            settings=self._chosen(fitted, is_last=True),
            seconds=seconds,
            parameters=image.parameters,
            device=str(self._device),
            ending=ending,
            acquisition=self._burst.acquisition,
            renderer=image,
            **diagnostics.by_name(),
        )

    def _watched(self, stages: Generator[Fitted | None, None, Fitted]) -> Generator[Snapshot | None, None, Fitted]:
        """Keep what is known, and make a snapshot of it after every stage."""
        while True:
            before = self._fitted
            try:
                self._fitted = next(stages)
            except StopIteration as end:
                self._fitted = end.value
                return self.fitted
            yield None if self._fitted is None else self._snapshot(before)

    def _snapshot(self, before: Fitted | None, *, is_last: bool = False) -> Snapshot:
        """Return a snapshot, with the image where it is another one than before."""
        fitted = self.fitted
        image = fitted.image
        is_new = image is not None and (before is None or before.image is not image)
        # Of intensities in [-1, 1]: twice the full scale of 1.
        self._losses.append(4 * fitted.registration.residual**2)
        step = len(self._losses)
        error = None if fitted.scene is None else fitted.scene.held_out_rmse
        return Snapshot(
            step=step,
            planned=max(_PLANNED, step + 1),
            loss=self._losses[-1],
            homographies=fitted.recorded.reference_from_frame,
            settings=self._chosen(fitted, is_last=is_last),
            canvas=fitted.canvas,
            draw=(lambda: draw(image, fitted.canvas, fitted.registration.reference, self._burst))
            if image is not None and is_new
            else None,
            is_milestone=True,
            held_out_rmse=None if error is None else error * (self._burst.white_level - self._burst.black_level),
        )

    def _chosen(self, fitted: Fitted, *, is_last: bool) -> Settings:
        """Return the settings with all that has been chosen; at the end that is all that was left open."""
        method = self._method
        if fitted.samples is not None:
            method = replace(method, samples=fitted.samples.kind)
        # The smoothness of a draft is a usual one, which may be chosen yet.
        if fitted.scene is not None and (is_last or not fitted.scene.is_draft):
            method = replace(method, smoothness=fitted.scene.smoothness)
        if is_last and isinstance(method.motion, AutoMotion):
            method = replace(method, motion=_motion_of(fitted.registration))
        if is_last:
            method = replace(method, iterations=fitted.registration.iterations or method.iterations or 1)
        return replace(self._requested, method=method, device=str(self._device))


def _motion_of(registration: Registration) -> SplineMotion:
    """Return the model that the frames of a registration move by."""
    if registration.displacement is not None:
        return Deformable()
    return next(model() for model in (Translation, Similarity, Affine, Homography) if model.dof >= registration.dof)
