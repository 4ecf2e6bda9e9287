"""What lies between bundle and recording: a round field, a vignette, and marks that a recorder burns in."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.simulation.faults import Faults

# By how much the logarithm of the vignette differs from the first channel to the last, about its mean.
_COLOUR_SPREAD = 0.2


@dataclass(frozen=True, kw_only=True, eq=False)
class Optics:
    """What stands still between bundle and recording.

    Attributes
    ----------
    radius : float
        Of the field, pixels: the round one, or what fits into the frame.
    field : numpy.ndarray
        (H, W) bool: where something of the object is seen.
    shading : numpy.ndarray or None
        (H, W, C) float32: what vignette and round field leave of the light.
    marks : numpy.ndarray
        (H, W) bool: where something is burned in.
    visible : numpy.ndarray or None
        (H, W) bool: in the field and not burned in; None where that is the whole frame.
    """

    radius: float
    field: NDArray[np.bool_]
    shading: NDArray[np.float32] | None
    marks: NDArray[np.bool_]
    visible: NDArray[np.bool_] | None


def make_optics(faults: Faults, shape: tuple[int, int], channels: int, *, is_circle: bool) -> Optics:
    """Lay out the optics of these faults, for a bundle that fills the frame or the circle that fits into it.

    The vignette's rim is that of the field where the field is round, and otherwise the frame's corners.
    """
    is_round = is_circle or faults.field is not None
    radius = (1.0 if faults.field is None else faults.field) * min(shape) / 2
    disc = round_field(shape, radius)
    shading = None
    if faults.vignette > 1 or faults.field is not None:
        rim = radius if is_round else float(np.hypot(shape[0] - 1, shape[1] - 1)) / 2
        shading = vignette(shape, channels, faults.vignette, rim)
        if faults.field is not None:
            shading *= disc[..., None]
    field = disc > 0.5 if is_round else np.ones(shape, dtype=np.bool_)
    marks = overlay(shape, radius) if faults.overlay else np.zeros(shape, dtype=np.bool_)
    visible = field & ~marks
    return Optics(radius=radius, field=field, shading=shading, marks=marks, visible=None if visible.all() else visible)


def round_field(shape: tuple[int, int], radius: float) -> NDArray[np.float32]:
    """Return a disc about the frame's middle, (H, W), 1 inside and 0 outside, with an edge of one pixel."""
    disc: NDArray[np.float32] = np.clip(radius + 0.5 - _distance(shape), 0, 1).astype(np.float32)
    return disc


def vignette(shape: tuple[int, int], channels: int, strength: float, rim: float) -> NDArray[np.float32]:
    """Return the part of the light (H, W, C) that a vignette leaves: 1 in the middle, 1 / strength at the rim.

    The logarithm falls with the square of the distance; in colour it is 0.8 to 1.2 times as large, from the first
    channel to the last.

    Parameters
    ----------
    shape : (int, int)
        Height and width.
    channels : int
        C.
    strength : float
        How many times darker the rim is.
    rim : float
        Where the rim is, pixels from the middle.
    """
    strengths = np.linspace(1 - _COLOUR_SPREAD, 1 + _COLOUR_SPREAD, channels) if channels > 1 else np.ones(1)
    fallen = (_distance(shape) / rim) ** 2
    left: NDArray[np.float32] = np.exp(-np.log(strength) * strengths * fallen[..., None]).astype(np.float32)
    return left


def overlay(shape: tuple[int, int], radius: float) -> NDArray[np.bool_]:
    """Return where marks are burned in, (H, W): a logo and a scale bar in opposite corners, a mark in the field.

    Parameters
    ----------
    shape : (int, int)
        Height and width.
    radius : float
        Of the field, pixels; the last mark lies at six tenths of it, towards the upper right.
    """
    height, width = shape
    marks = np.zeros(shape, dtype=np.bool_)
    size = max(4, round(0.12 * min(shape)))
    rows, columns = np.indices((size, size))
    ring = np.abs(np.hypot(rows - (size - 1) / 2, columns - (size - 1) / 2) - (size - 1) / 2) <= max(0.8, size / 10)
    logo = ring | (np.abs(rows - columns) <= size / 12)
    marks[1 : size + 1, 1 : size + 1] = logo
    thickness = max(1, size // 5)
    marks[height - 2 - thickness : height - 2, width - 2 - size : width - 2] = True
    x, y = round((width - 1) / 2 + 0.42 * radius), round((height - 1) / 2 - 0.42 * radius)
    arm = max(1, size // 4)
    marks[y, x - arm : x + arm + 1] = True
    marks[y - arm : y + arm + 1, x] = True
    return marks


def _distance(shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the distance of every pixel from the frame's middle, (H, W)."""
    rows, columns = np.indices(shape, dtype=np.float64)
    distance: NDArray[np.float64] = np.hypot(columns - (shape[1] - 1) / 2, rows - (shape[0] - 1) / 2)
    return distance
