"""Images as icons."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from qtpy.QtCore import Qt
from qtpy.QtGui import QIcon, QPixmap

from napari_fiberburst.io.picture import as_picture, encode_png

# Dots of an icon to a pixel of an ordinary screen: finer screens show them all.
_DOTS = 2


def icon_of(image: NDArray[np.floating[Any]], side: int) -> QIcon:
    """Return an image in intensity units, (H, W) or (H, W, C), as an icon of at most so many screen pixels a side."""
    step = max(1, min(image.shape[:2]) // (2 * _DOTS * side))
    whole = QPixmap()
    whole.loadFromData(encode_png(as_picture(image[::step, ::step])), "PNG")
    small = whole.scaled(
        _DOTS * side,
        _DOTS * side,
        Qt.AspectRatioMode.KeepAspectRatio,
        Qt.TransformationMode.SmoothTransformation,
    )
    icon = QIcon(small)
    # Where its row is selected, it is not tinted.
    icon.addPixmap(small, QIcon.Mode.Selected)
    return icon
