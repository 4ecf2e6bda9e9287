"""A wide picture of where the probe has been, pasted together while it goes."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, distance_transform_edt

from napari_fiberburst.live.view import LiveView

# The canvas grows by so many pixels at a time, and not beyond so many in all.
_BLOCK = 256
MOST_PIXELS = 2**24
# Pictures fade towards their rim over this part of their shorter side.
_FADE = 0.15
# What lies there counts as so many pictures at most, so that newer ones show.
_MOST_WEIGHT = 3.0


class LiveMosaic:
    """Pastes pictures where they lie on the first one, and begins anew where the engine does.

    A look around, and no more: frames are placed on the scene as it stands, so a place that the probe comes back to
    after a long way need not meet itself. `napari_fiberburst.mosaic` closes loops.

    Attributes
    ----------
    image : numpy.ndarray
        (rows, columns, C) float32, NaN where no picture lies.
    origin : (int, int)
        Row and column of its first pixel, in pixels of the first frame.
    is_full : bool
        Whether there was no room for a picture.
    """

    def __init__(self) -> None:
        self._piece: int | None = None
        self._clear(1)

    def add(self, view: LiveView) -> None:
        """Take in a picture; one that could not be placed is passed over."""
        if view.state != "following":
            return
        picture = view.image if view.image.ndim == 3 else view.image[..., None]
        if view.piece != self._piece:
            self._piece = view.piece
            self._clear(picture.shape[2])
        known = np.isfinite(picture).all(axis=2)
        height, width = known.shape
        corners = view.homography @ np.array([[0, width - 1, 0, width - 1], [0, 0, height - 1, height - 1], [1.0] * 4])
        x, y = corners[:2] / corners[2]
        if not self._make_room(int(y.min()) - 1, int(y.max()) + 2, int(x.min()) - 1, int(x.max()) + 2):
            return
        top, left = int(y.min()) - 1 - self.origin[0], int(x.min()) - 1 - self.origin[1]
        box = slice(top, top + int(y.max()) - int(y.min()) + 3), slice(left, left + int(x.max()) - int(x.min()) + 3)
        inverse = np.linalg.inv(view.homography)
        back = inverse[[1, 0]][:, [1, 0]]
        offset = inverse[[1, 0], 2] + back @ np.array([top + self.origin[0], left + self.origin[1]])
        shape = self._weight[box].shape
        # A rim of nothing, because distances count from what is not known.
        depth = distance_transform_edt(np.pad(known, 1))[1:-1, 1:-1]
        fade = np.minimum(depth / (_FADE * min(known.shape)), 1).astype(np.float32)
        weight = affine_transform(fade, back, offset, shape, order=1)
        total = self._weight[box] + weight
        share = weight / np.maximum(total, 1e-9)
        for channel in range(picture.shape[2]):
            there = self._light[(*box, channel)]
            # Weighted while it is moved: what is not known would spread.
            light = affine_transform(np.where(known, picture[..., channel], 0) * fade, back, offset, shape, order=1)
            there += np.where(weight > 1e-6, share * (light / np.maximum(weight, 1e-6) - there), 0)
        self._weight[box] = np.minimum(total, _MOST_WEIGHT)

    @property
    def image(self) -> NDArray[np.float32]:
        """All pictures in one."""
        return np.where(self._weight[..., None] > 0, self._light, np.float32(np.nan))

    def _clear(self, channels: int) -> None:
        self.origin, self.is_full = (0, 0), False
        self._light = np.zeros((0, 0, channels), np.float32)
        self._weight = np.zeros((0, 0), np.float32)

    def _make_room(self, top: int, bottom: int, left: int, right: int) -> bool:
        """Let the canvas reach over rows and columns; return whether there is room for them."""
        rows, columns = self._weight.shape
        first = self.origin
        if not self._weight.size:
            first = (top, left)
        rows_from, rows_to = _reach(first[0], first[0] + rows, top, bottom)
        columns_from, columns_to = _reach(first[1], first[1] + columns, left, right)
        if (rows_to - rows_from) * (columns_to - columns_from) > MOST_PIXELS:
            self.is_full = True
            return False
        before, after = (first[0] - rows_from, first[1] - columns_from), (rows_to, columns_to)
        added = [(before[0], after[0] - first[0] - rows), (before[1], after[1] - first[1] - columns)]
        if any(map(any, added)):
            self._light, self._weight = np.pad(self._light, [*added, (0, 0)]), np.pad(self._weight, added)
        self.origin = (rows_from, columns_from)
        return True


def _reach(start: int, stop: int, wanted_start: int, wanted_stop: int) -> tuple[int, int]:
    """Return where an axis begins and ends that reaches over both, longer by whole blocks."""
    before = -(-max(0, start - wanted_start) // _BLOCK) * _BLOCK
    after = -(-max(0, wanted_stop - stop) // _BLOCK) * _BLOCK
    return start - before, stop + after
