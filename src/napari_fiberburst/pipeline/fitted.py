"""What is known of a burst at one moment of its fit."""

from dataclasses import dataclass

from torch import Tensor

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.mount import Mount
from napari_fiberburst.bundle.noise import Noise
from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.motion.registration import Registration
from napari_fiberburst.scene.image import SplineImage
from napari_fiberburst.scene.solve import Draft, Scene


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fitted:
    """What is known of a burst at one moment of its fit.

    Attributes
    ----------
    bundle : Bundle
        That samples are taken with; what gains are found beyond it is in the registration.
    registration : Registration
        Of the frames, with the bundle at rest.
    canvas : Canvas
        Where the image lies.
    mount : Mount or None
        Where the bundle is in the frames as they were recorded; None where it rests.
    samples : Samples or None
        The final samples, in all channels, as they were taken; None until it is known what a sample is.
    scene : Scene or None
        The latest solution.
    draft : Draft or None
        What that was solved from; None for a preview.
    image : SplineImage or None
        The latest image; it knows by itself how the frames lay when it was made.
    notes : tuple of str
        What a user should know, beside the notes of the registration.
    noise : Noise or None
        Of the camera; None where it cannot be told, or not yet.
    dark : Tensor or None
        (H, W) bool, frame pixels without a core that no frame shows light at; None if there are none.
    outliers : Tensor or None
        (T, G) bool, cores that were seen to show something else before the scene was solved; None if none were.
    """

    bundle: Bundle
    registration: Registration
    canvas: Canvas
    mount: Mount | None = None
    samples: Samples | None = None
    scene: Scene | None = None
    draft: Draft | None = None
    image: SplineImage | None = None
    notes: tuple[str, ...] = ()
    noise: Noise | None = None
    dark: Tensor | None = None
    outliers: Tensor | None = None

    @property
    def recorded(self) -> Registration:
        """The registration of the frames as they were recorded."""
        return self.registration if self.mount is None else self.registration.as_recorded(self.mount.offsets)

    @property
    def all_notes(self) -> tuple[str, ...]:
        """All that a user should know before trusting the image."""
        left_out = [str(frame) for frame in self.registration.left_out]
        told = (f"left out by hand: {'frame' if len(left_out) == 1 else 'frames'} {', '.join(left_out)}",)
        return (*self.notes, *self.registration.notes, *(told if left_out else ()))
