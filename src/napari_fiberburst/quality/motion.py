"""Motion against the truth, with the gauge removed."""

import numpy as np
from numpy.typing import NDArray
from skimage.transform import ProjectiveTransform

# Points per side of the grid on which positions are compared.
_GRID = 9


def motion_error(homographies: NDArray[np.floating], truth: NDArray[np.floating], shape: tuple[int, int]) -> float:
    """Return how far the frames' pixels land from the truth, modulo one homography of the whole scene.

    The data say how frames lie to one another, not where the scene as a whole lies: a homography common to all
    frames (the gauge) can be undone by warping the scene. It is fitted and removed before positions are compared,
    and with it the error that homographies relative to frame 0 share because frame 0's own is off.

    Parameters
    ----------
    homographies, truth : numpy.ndarray
        (T, 3, 3), frame-t pixel to frame-0 pixel. Frames whose homography holds NaN, left out for want of
        registration, do not count.
    shape : (int, int)
        Height and width of a frame.

    Returns
    -------
    float
        Mean distance in pixels, over the field and the frames; NaN where no frame counts.
    """
    known = np.isfinite(homographies).all(axis=(1, 2))
    if not known.any():
        return float("nan")
    homographies, truth = np.asarray(homographies)[known], np.asarray(truth)[known]
    y, x = np.meshgrid(*(np.linspace(0, side - 1, _GRID) for side in shape), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    found, wanted = (_project(matrices, points) for matrices in (homographies, truth))
    gauge = ProjectiveTransform.from_estimate(found, wanted)
    return float(np.hypot(*(gauge(found) - wanted).T).mean())


def _project(matrices: NDArray[np.floating], points: NDArray[np.float64]) -> NDArray[np.float64]:
    mapped = points @ np.asarray(matrices, np.float64).transpose(0, 2, 1)
    flat = mapped.reshape(-1, 3)
    projected: NDArray[np.float64] = flat[:, :2] / flat[:, 2:]
    return projected
