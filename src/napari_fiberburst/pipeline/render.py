"""Step 6: draw the scene as an image."""

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.motion.registration import Registration
from napari_fiberburst.results.reconstruction import draw
from napari_fiberburst.scene.image import SplineImage
from napari_fiberburst.scene.solve import Scene

# Nodes with less than this weight of samples have been seen by none.
_LEAST_DENSITY = 1e-3


def image_of(
    scene: Scene, registration: Registration, bundle: Bundle, acquisition: Acquisition, *, fill: bool
) -> SplineImage:
    """Return what can be drawn of a scene."""
    return SplineImage(
        scene=scene.image,
        grid=scene.grid,
        known=scene.equations.density() > _LEAST_DENSITY,
        reach=bundle.pitch,
        fill=fill,
        homographies=registration.reference_from_frame,
        motion=None if registration.displacement is None else registration.motion.cpu(),
        black=bundle.black_in(acquisition),
    )


def render(
    acquisition: Acquisition,
    bundle: Bundle,
    registration: Registration,
    scene: Scene,
    canvas: Canvas | None = None,
    *,
    fill: bool = False,
) -> NDArray[np.float32]:
    """Draw a scene in the intensity units of its burst.

    Parameters
    ----------
    acquisition : Acquisition
        Of the burst, or the burst itself.
    bundle, registration, scene
        That its samples were taken with, where they lie, and what they were solved for.
    canvas : Canvas, optional
        Of the image; by default the field of the reference frame, pixel for pixel.
    fill : bool
        Fill in the image where no core has looked, instead of leaving it empty (NaN).

    Returns
    -------
    numpy.ndarray
        (H, W) or (H, W, C) float32.
    """
    height, width = bundle.shape
    canvas = Canvas.over((0, 0, width, height)) if canvas is None else canvas
    image = image_of(scene, registration, bundle, acquisition, fill=fill)
    return draw(image, canvas, registration.reference, acquisition)
