"""A linear spline at a point."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.live.compiled import compiled


@compiled("f8(f4[:,::1], f8, f8)")
def read(scene: NDArray[np.float32], across: Any, down: Any) -> Any:
    """Return a scene (rows, columns) between four of its nodes, at a column and a row."""
    i, j = int(down), int(across)
    right, below = across - j, down - i
    top = scene[i, j] * (1 - right) + scene[i, j + 1] * right
    bottom = scene[i + 1, j] * (1 - right) + scene[i + 1, j + 1] * right
    return top * (1 - below) + bottom * below
