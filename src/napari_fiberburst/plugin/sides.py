"""The two images that are compared, A and B, and what is made of both. Knows nothing of windows."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.plugin.kept_run import KeptRun
from napari_fiberburst.plugin.placement import Placement

AS_RECORDED = "as recorded"


@dataclass(frozen=True, kw_only=True, eq=False)
class Side:
    """An image, and where it lies.

    Attributes
    ----------
    name : str
        The run's, or `AS_RECORDED`.
    image : numpy.ndarray
        (H, W) or (H, W, C) in intensity units.
    canvas : Canvas
        Where it lies in pixels of frame `reference`.
    reference : int
        The frame that it lies over.
    acquisition : Acquisition
        What is known of the burst.
    placement : Placement
        Where the burst was in the viewer.
    """

    name: str
    image: NDArray[np.float32]
    canvas: Canvas
    reference: int
    acquisition: Acquisition
    placement: Placement

    @property
    def is_blended(self) -> bool:
        """Whether its channels are seen at once, as the colours of one picture."""
        return self.placement.rgb or bool(self.placement.channels)

    @property
    def channels(self) -> int:
        """How many there are."""
        return self.image.shape[2] if self.image.ndim == 3 else 1

    @cached_property
    def world_from_image(self) -> NDArray[np.float64]:
        """3x3, image (y, x) to the viewer's world."""
        placed = self.placement.on_canvas("YX", self.canvas)
        if "affine" in placed:
            return np.asarray(placed["affine"], dtype=np.float64)
        matrix = np.diag([*placed["scale"], 1.0])
        matrix[:2, 2] = placed["translate"]
        return matrix


def image_of(run: KeptRun) -> Side:
    """Return the image of a run.

    Raises
    ------
    FiberBurstError
        It has none yet.
    """
    result = run.result
    if result is None:
        raise FiberBurstError(f"{run.name} has no result yet; wait for its end, or stop it")
    return Side(
        name=run.name,
        image=result.image,
        canvas=result.canvas,
        reference=result.reference,
        acquisition=result.acquisition,
        placement=run.layers.placement,
    )


def frame_of(run: KeptRun) -> Side:
    """Return the frame that a run's image lies over, as it came.

    Raises
    ------
    FiberBurstError
        The run has no result yet, or the burst's file cannot be read any more.
    """
    after = image_of(run)
    try:
        frame = np.asarray(run.source.frames[after.reference], dtype=np.float32)
    except OSError as error:
        raise FiberBurstError(f"the burst of {run.name} cannot be read any more ({error}); open it again") from error
    height, width = frame.shape[:2]
    return Side(
        name=AS_RECORDED,
        image=frame,
        canvas=Canvas.over((0, 0, width, height)),
        reference=after.reference,
        acquisition=after.acquisition,
        placement=after.placement,
    )


def resampled(b: Side, a: Side) -> NDArray[np.float32]:
    """Return B's image on A's canvas, NaN where it does not reach.

    Raises
    ------
    FiberBurstError
        Pixel by pixel, the two have nothing in common.
    """
    if a.channels != b.channels:
        raise FiberBurstError(
            f"channels must be as many in both, got {a.channels} in {a.name} and {b.channels} in {b.name}; let one "
            "flicker with the other"
        )
    if a.reference != b.reference:
        raise FiberBurstError(
            f"{a.name} lies over frame {a.reference} and {b.name} over frame {b.reference}, which have moved against "
            "each other; look at them side by side"
        )
    b_from_a = np.linalg.inv(b.world_from_image) @ a.world_from_image
    if a.canvas.shape == b.canvas.shape and np.allclose(b_from_a, np.eye(3), atol=1e-6):
        return b.image.reshape(a.image.shape)
    rows, columns = np.indices(a.canvas.shape, dtype=np.float64)
    at = np.tensordot(b_from_a[:2], np.stack([rows, columns, np.ones_like(rows)]), axes=1)
    height, width = b.canvas.shape
    inside = (np.abs(at[0] - (height - 1) / 2) <= height / 2) & (np.abs(at[1] - (width - 1) / 2) <= width / 2)
    if not inside.any():
        raise FiberBurstError(f"{a.name} and {b.name} have no place in common; choose two runs of the same region")
    layered = b.image.reshape(height, width, -1)
    # Pixels at the rim reach half a pixel beyond their centres.
    parts = [map_coordinates(layered[..., number], at, order=1, mode="nearest") for number in range(layered.shape[2])]
    moved = np.where(inside[..., None], np.stack(parts, axis=-1), np.float32(np.nan))
    return moved.reshape(a.image.shape)


def difference(a: Side, b: Side) -> tuple[NDArray[np.float32], str]:
    """Return A minus B on A's canvas, and its axes; the mean over channels that are seen at once.

    Raises
    ------
    FiberBurstError
        Pixel by pixel, the two have nothing in common.
    """
    apart = a.image - resampled(b, a)
    if a.is_blended:
        apart = apart.mean(axis=-1)
    return a.placement.arrange(apart, "YXC"[: apart.ndim])


class Curtain:
    """One image that is A left of a line and B right of it, on A's canvas, in the parts that layers show.

    Attributes
    ----------
    parts : list of (str, numpy.ndarray, str)
        As `Placement.parts` returns them; changed in place when the line moves.

    Raises
    ------
    FiberBurstError
        Pixel by pixel, the two have nothing in common.
    """

    def __init__(self, a: Side, b: Side) -> None:
        self._left = a.placement.parts(a.image, a.acquisition)
        self._right = a.placement.parts(resampled(b, a), b.acquisition)
        self.parts = [(kind, np.array(data), axes) for kind, data, axes in self._left]
        self.width = a.canvas.shape[1]

    def draw(self, column: int) -> None:
        """Move the line to the left edge of a column."""
        for (_, mixed, axes), (_, left, _), (_, right, _) in zip(self.parts, self._left, self._right, strict=True):
            across = axes.index("X")
            before, after = ((slice(None),) * across + (part,) for part in (slice(column), slice(column, None)))
            mixed[before], mixed[after] = left[before], right[after]
