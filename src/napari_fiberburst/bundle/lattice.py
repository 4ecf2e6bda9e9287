"""Which pixels belong to which core."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

# In pitches: how far a core's light is counted as its own.
REACH = 0.62


def nearest_core(centres: NDArray[np.float64], outline: NDArray[np.bool_], reach: float) -> NDArray[np.int64]:
    """Return the number of the core nearest to each pixel, (H, W); N where none is within `reach` pixels.

    Pixels outside the bundle's `outline`, (H, W), belong to none.
    """
    labels = np.full(outline.shape, len(centres), dtype=np.int64)
    y, x = np.nonzero(outline)
    tree = cKDTree(centres)
    labels[y, x] = tree.query(np.stack([x, y], axis=1), distance_upper_bound=reach, workers=-1)[1]
    return labels
