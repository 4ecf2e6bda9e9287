"""Stacks of one image a frame that are only made for the frame that is shown."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import dask.array as da
import numpy as np
from dask.delayed import delayed
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from napari_fiberburst.coordinates import transform_points

if TYPE_CHECKING:
    from napari_fiberburst.data.canvas import Canvas


# Fixed-point iterations that find the pixel of a bent frame that shows a place.
_INVERSIONS = 8

# Frame number to (H, W, 2): what takes each of its pixels to the reference frame's.
Flow = Callable[[int], NDArray[np.float64]]


def stabilised(frames: Any, homographies: NDArray[np.float64], canvas: "Canvas", flow: Flow | None = None) -> da.Array:
    """Return the frames as they came, moved onto the canvas: the object stands still, the honeycomb moves.

    Parameters
    ----------
    frames : array
        (T, H, W) or (T, H, W, C), numpy or dask.
    homographies : numpy.ndarray
        (T, 3, 3), frame-t pixel to frame-0 pixel; a frame with NaN becomes 0.
    canvas : Canvas
        Where to.
    flow : callable, optional
        Where frames bend beyond their homographies.

    Returns
    -------
    dask.array.Array
        (T, H', W') or (T, H', W', C) in the frames' type; 0 where a frame did not look.
    """
    shape = (*canvas.shape, *frames.shape[3:])
    moved = [
        da.from_delayed(
            delayed(_move)(frames[index], homography, canvas, None if flow is None else delayed(flow)(index)),
            shape,
            frames.dtype,
        )
        for index, homography in enumerate(homographies)
    ]
    return da.stack(moved)


def residual_maps(residuals: NDArray[np.float32], labels: NDArray[np.int32]) -> da.Array:
    """Return by how much the model misses each core in each frame, as images (T, H, W); NaN outside all cores.

    Parameters
    ----------
    residuals : numpy.ndarray
        (T, N), a value a core and frame.
    labels : numpy.ndarray
        (H, W), the core of each pixel; N where none.
    """
    maps = [da.from_delayed(delayed(_paint)(frame, labels), labels.shape, np.float32) for frame in residuals]
    return da.stack(maps)


def _at(flow: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    at = points[..., ::-1].reshape(-1, 2).T
    parts = [map_coordinates(flow[..., axis], at, order=1, mode="nearest") for axis in (0, 1)]
    return np.stack(parts, axis=-1).reshape(points.shape)


def _move(
    frame: Any, homography: NDArray[np.float64], canvas: "Canvas", flow: NDArray[np.float64] | None = None
) -> NDArray[Any]:
    frame = np.asarray(frame)
    shape = (*canvas.shape, *frame.shape[2:])
    if not np.isfinite(homography).all():
        return np.zeros(shape, frame.dtype)
    points = canvas.points()
    pixels = transform_points(np.linalg.inv(homography), points)
    if flow is not None:
        for _ in range(_INVERSIONS):
            pixels = pixels - (pixels + _at(flow, pixels) - points)
    at = pixels[..., ::-1].transpose(2, 0, 1)
    channels = frame.reshape(*frame.shape[:2], -1)
    moved = [map_coordinates(channel, at, order=1, output=frame.dtype) for channel in channels.transpose(2, 0, 1)]
    return np.stack(moved, axis=-1).reshape(shape)


def _paint(values: NDArray[np.float32], labels: NDArray[np.int32]) -> NDArray[np.float32]:
    return np.append(values, np.float32(np.nan))[labels]
