"""What has come of a fit by stages, as a reconstruction."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.motion.registration import Registration
from napari_fiberburst.pipeline.diagnose import diagnose
from napari_fiberburst.pipeline.fitted import Fitted
from napari_fiberburst.results.diagnostics import Ending
from napari_fiberburst.results.reconstruction import Reconstruction, Solver, draw
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Order:
    """What a fit was asked to do.

    Attributes
    ----------
    acquisition : Acquisition
        Of the burst.
    requested : Settings
        As a user has asked.
    method : SplineMethod
        How to fit it: the method asked for, or the alignment of a network's.
    device : torch.device
        Where.
    """

    acquisition: Acquisition
    requested: Settings
    method: SplineMethod
    device: torch.device

    def chosen(self, fitted: Fitted, *, is_last: bool) -> Settings:
        """Return the settings with all that has been chosen; at the end that is all that was left open."""
        method = self.method
        if fitted.samples is not None:
            method = replace(method, samples=fitted.samples.kind)
        # The smoothness of a draft is a usual one, which may be chosen yet.
        if fitted.scene is not None and (is_last or not fitted.scene.is_draft):
            method = replace(method, smoothness=fitted.scene.smoothness)
        if is_last and isinstance(method.motion, AutoMotion):
            method = replace(method, motion=_motion_of(fitted.registration))
        if is_last:
            method = replace(method, iterations=fitted.registration.iterations or method.iterations or 1)
        return replace(self.requested, method=method, device=str(self.device))

    def outcome(
        self, fitted: Fitted, losses: list[float], ending: Ending, seconds: float, solver: Solver | None
    ) -> Reconstruction:
        """Judge what there is, and return it as a reconstruction."""
        image, scene = fitted.image, fitted.scene
        assert image is not None
        assert scene is not None
        diagnostics = diagnose(
            self.acquisition,
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
            image=draw(image, fitted.canvas, fitted.registration.reference, self.acquisition),
            canvas=fitted.canvas,
            homographies=fitted.recorded.reference_from_frame,
            losses=np.array(losses, dtype=np.float32),
            requested=self.requested,
            settings=self.chosen(fitted, is_last=True),
            seconds=seconds,
            parameters=image.parameters,
            device=str(self.device),
            ending=ending,
            acquisition=self.acquisition,
            renderer=image,
            solver=solver,
            **diagnostics.by_name(),
        )


def _motion_of(registration: Registration) -> SplineMotion:
    """Return the model that the frames of a registration move by."""
    if registration.displacement is not None:
        return Deformable()
    return next(model() for model in (Translation, Similarity, Affine, Homography) if model.dof >= registration.dof)
