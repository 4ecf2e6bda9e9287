"""How the object moves: homographies (T, 3, 3), frame-t pixel to frame-0 pixel, [0] the identity."""

import math
from collections.abc import Callable, Mapping

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d


def compose(
    shape: tuple[int, int],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    rotation: NDArray[np.float64],
    log_scale: NDArray[np.float64],
    tilt_x: NDArray[np.float64],
    tilt_y: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Build homographies about the frame's centre from their parts, each (T,).

    Parameters
    ----------
    shape : (int, int)
        Height and width of a frame.
    x, y : numpy.ndarray
        Translation, pixels.
    rotation : numpy.ndarray
        Radians, from x towards y.
    log_scale : numpy.ndarray
        Logarithm of the magnification.
    tilt_x, tilt_y : numpy.ndarray
        Perspective, per pixel: what x and y add to the homogeneous coordinate.
    """
    height, width = shape
    to_centre = np.array([[1, 0, -(width - 1) / 2], [0, 1, -(height - 1) / 2], [0, 0, 1]])
    cosine, sine = np.exp(log_scale) * np.cos(rotation), np.exp(log_scale) * np.sin(rotation)
    one = np.ones_like(x)
    about_centre = np.array([[cosine, -sine, x], [sine, cosine, y], [tilt_x, tilt_y, one]]).transpose(2, 0, 1)
    matrices: NDArray[np.float64] = np.linalg.inv(to_centre) @ about_centre @ to_centre
    return matrices / matrices[:, 2:, 2:]


def apply(matrix: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Map points (..., 2) by a homography; one shared with the solver would hide any error of convention."""
    x, y = points[..., 0], points[..., 1]
    depth = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2]
    mapped_x = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2]) / depth
    mapped_y = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2]) / depth
    return np.stack([mapped_x, mapped_y], axis=-1)


def brownian_motion(
    frames: int,
    shape: tuple[int, int],
    rng: Generator,
    *,
    translation: float = 0.02,
    rotation: float = 0.4,
    scale: float = 0.004,
    perspective: float = 0.005,
    reach: float = 0.17,
) -> NDArray[np.float64]:
    """Walk at random, as published.

    Parameters
    ----------
    frames : int
        T.
    shape : (int, int)
        Height and width of a frame.
    rng : numpy.random.Generator
        Source of the steps.
    translation : float
        Standard deviation of a step on each axis, in parts of the frame's shorter side.
    rotation : float
        The same, degrees.
    scale : float
        The same, relative magnification.
    perspective : float
        The same, change of magnification from one edge to the other.
    reach : float
        The walk turns back at this translation, in parts of the shorter side.
    """
    side = min(shape)
    steps = rng.standard_normal((6, frames))
    steps[:, 0] = 0
    walk = np.cumsum(steps, axis=1)
    spreads = [translation * side] * 2 + [math.radians(rotation), scale] + [perspective / side] * 2
    parts = walk * np.array(spreads)[:, None]
    parts[:2] = _turn_back(parts[:2], reach * side)
    return compose(shape, *parts)


def handheld_motion(
    frames: int,
    shape: tuple[int, int],
    rng: Generator,
    *,
    translation: float = 0.06,
    rotation: float = 1.0,
    scale: float = 0.01,
    perspective: float = 0.01,
    smoothness: float = 3.0,
) -> NDArray[np.float64]:
    """Drift smoothly, as a hand does.

    Parameters
    ----------
    frames, shape, rng
        As in `brownian_motion`.
    translation, rotation, scale, perspective : float
        Standard deviations over the burst, in the units of `brownian_motion`.
    smoothness : float
        Frames over which the motion holds its course.
    """
    side = min(shape)
    margin = math.ceil(4 * smoothness)
    noise = rng.standard_normal((6, frames + 2 * margin))
    smooth = gaussian_filter1d(noise, smoothness, axis=1)[:, margin : margin + frames]
    # White noise filtered by a Gaussian of this width keeps this much of its standard deviation.
    smooth *= math.sqrt(2 * math.sqrt(math.pi) * smoothness)
    spreads = [translation * side] * 2 + [math.radians(rotation), scale] + [perspective / side] * 2
    parts = smooth * np.array(spreads)[:, None]
    return compose(shape, *(parts - parts[:, :1]))


def raster_motion(
    frames: int, shape: tuple[int, int], rng: Generator, *, step: float = 1.5, columns: int | None = None
) -> NDArray[np.float64]:
    """Step through a raster, row by row and back, as a translation stage does.

    Parameters
    ----------
    frames, shape
        As in `brownian_motion`.
    rng : numpy.random.Generator
        Not used: a stage goes where it is told.
    step : float
        Pixels from one position to the next.
    columns : int, optional
        Positions per row; default, as square a raster as there are frames for.
    """
    columns = columns or math.ceil(math.sqrt(frames))
    row, column = np.divmod(np.arange(frames), columns)
    column = np.where(row % 2 == 0, column, columns - 1 - column)
    still = np.zeros(frames)
    return compose(shape, step * column, step * row, still, still, still, still)


MOTIONS: Mapping[str, Callable[..., NDArray[np.float64]]] = {
    "brownian": brownian_motion,
    "handheld": handheld_motion,
    "raster": raster_motion,
}


def _turn_back(path: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
    """Fold a path at +- reach, as a ball between two walls."""
    return reach - np.abs((path + reach) % (4 * reach) - 2 * reach) if reach > 0 else 0 * path
