"""THE convention of coordinates.

Points are (x, y). In pixels, integers stand at pixel centres: column 0, row 0 is (0, 0). In *unit* coordinates the
outer edges of a frame's pixels stand at -1 and 1, each axis by itself, so the centre of the first of W columns is at
1/W - 1. The fields and the solver think in unit coordinates; everything a user sees is in pixels.
"""

import numpy as np
from numpy.typing import NDArray


def unit_from_pixel(shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the 3x3 matrix that takes pixels of a (height, width) frame to unit coordinates."""
    height, width = shape
    return np.array([[2 / width, 0, 1 / width - 1], [0, 2 / height, 1 / height - 1], [0, 0, 1]])


def in_pixels(unit_homographies: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """Rewrite homographies (..., 3, 3) from unit coordinates of a (height, width) frame to its pixels."""
    to_unit = unit_from_pixel(shape)
    return np.linalg.inv(to_unit) @ unit_homographies @ to_unit
