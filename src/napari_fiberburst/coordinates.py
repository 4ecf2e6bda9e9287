"""The conventions of coordinates, and the one function that applies a transform.

Points are (x, y), and transforms are 3x3 matrices named by direction: ``scene_from_frame`` takes points of a frame into
the scene. There are three frames of reference:

- *pixels*: integers stand at pixel centres, so column 0, row 0 is (0, 0). All that a user sees, and all of the default
  method, is in pixels.
- *half frames*: the middle of the frame is (0, 0), and half of its longer side is 1 on both axes. A rotation is a
  rotation here, whatever the frame's shape, so motion models are defined by their generators in these units.
- *unit coordinates*: the outer edges of the frame's pixels stand at -1 and 1, each axis by itself, so the centre of the
  first of W columns is at 1/W - 1. The networks of the published method take these.
"""

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

# numpy arrays and torch tensors alike: nothing here needs torch.
Points = TypeVar("Points", bound=Any)


def unit_from_pixel(shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the 3x3 matrix that takes pixels of a (height, width) frame to unit coordinates."""
    height, width = shape
    return np.array([[2 / width, 0, 1 / width - 1], [0, 2 / height, 1 / height - 1], [0, 0, 1]])


def half_frame_from_pixel(shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the 3x3 matrix that takes pixels of a (height, width) frame to half frames."""
    height, width = shape
    half = max(height, width) / 2
    x, y = (width - 1) / 2, (height - 1) / 2
    return np.array([[1 / half, 0, -x / half], [0, 1 / half, -y / half], [0, 0, 1]])


def in_pixels(unit_homographies: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """Rewrite homographies (..., 3, 3) from unit coordinates of a (height, width) frame to its pixels."""
    to_unit = unit_from_pixel(shape)
    return np.linalg.inv(to_unit) @ unit_homographies @ to_unit


def transform_points(target_from_source: Any, points: Points) -> Points:
    """Map points by a homography, or by each of several.

    Parameters
    ----------
    target_from_source : numpy.ndarray or Tensor
        (..., 3, 3).
    points : numpy.ndarray or Tensor
        (..., N, 2) as (x, y), of the same kind. Leading axes broadcast: (T, 3, 3) with (N, 2) gives (T, N, 2), and
        (N, 3, 3) with (N, 1, 2) maps every point by its own matrix.

    Returns
    -------
    numpy.ndarray or Tensor
        Infinite or NaN where a point maps to the line at infinity.

    Examples
    --------
    >>> shift = np.array([[1.0, 0, 3], [0, 1, 0], [0, 0, 1]])
    >>> transform_points(shift, np.array([[1.0, 2.0]]))
    array([[4., 2.]])
    """
    # All x together and all y together, because products of long rows are several times as fast as of many pairs.
    mapped = target_from_source[..., :2] @ points.mT + target_from_source[..., 2:]
    found: Points = (mapped[..., :2, :] / mapped[..., 2:, :]).mT
    return found


def relative_to(scene_from_frame: NDArray[np.float64], reference: int) -> NDArray[np.float64]:
    """Return homographies (T, 3, 3) from each frame to a reference frame, whose own is the identity; m_33 is 1.

    The others are NaN where the reference frame sees the scene edge on, so that nothing can be said in its pixels.
    """
    try:
        relative: NDArray[np.float64] = np.linalg.inv(scene_from_frame[reference]) @ scene_from_frame
    except np.linalg.LinAlgError:
        relative = np.full_like(scene_from_frame, np.nan)
    relative[reference] = np.eye(3)
    with np.errstate(divide="ignore", invalid="ignore"):
        return relative / relative[:, 2:, 2:]
