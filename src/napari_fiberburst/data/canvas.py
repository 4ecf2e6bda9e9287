"""Canvas: where an image lies."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.coordinates import transform_points
from napari_fiberburst.errors import SettingsError

_MOST_PIXELS = 2**31


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Canvas:
    """Where an image lies in frame-0 pixels.

    Attributes
    ----------
    shape : (int, int)
        Height and width of the image.
    reference_from_image : numpy.ndarray
        3x3: image pixel (x, y) to frame-0 pixel; integers are pixel centres in both.
    """

    shape: tuple[int, int]
    reference_from_image: NDArray[np.float64]

    @classmethod
    def over(cls, bounds: tuple[float, float, float, float], scale: float = 1.0) -> "Canvas":
        """Cover the frame-0 columns x0 to x1 and rows y0 to y1, `scale` image pixels to a frame pixel.

        Parameters
        ----------
        bounds : (float, float, float, float)
            x0, y0, x1, y1, half-open as in slicing: (0, 0, W, H) is frame 0's field; it may reach beyond.
        scale : float
            2 doubles the pixels on each axis. Where a side times scale is no whole number, the image has the
            nearest whole number of pixels and covers the bounds all the same.

        Raises
        ------
        SettingsError
            The bounds are empty or the scale is not positive.
        """
        edges = np.array(bounds)
        if edges.shape != (4,) or edges.dtype.kind not in "iuf" or not np.isfinite(edges).all():
            raise SettingsError(f"bounds must be four numbers x0, y0, x1, y1; got {bounds}")
        x0, y0, x1, y1 = edges.astype(np.float64).tolist()
        if not (x0 < x1 and y0 < y1):
            raise SettingsError(f"bounds must be x0, y0, x1, y1 with x0 < x1 and y0 < y1; got {bounds}")
        if isinstance(scale, str) or not 0 < scale < np.inf:
            raise SettingsError(f"scale must be a number above 0; got {scale!r}")
        width, height = (max(1, round((stop - start) * scale)) for start, stop in ((x0, x1), (y0, y1)))
        if width * height > _MOST_PIXELS:
            raise SettingsError(
                f"an image of {height} x {width} pixels must be drawn in parts; got bounds {bounds} at scale {scale:g}"
            )
        step_x, step_y = (x1 - x0) / width, (y1 - y0) / height
        # Pixel edges meet the bounds, so the first centre lies half a step inside them.
        first_x, first_y = x0 - 0.5 + step_x / 2, y0 - 0.5 + step_y / 2
        matrix = np.array([[step_x, 0, first_x], [0, step_y, first_y], [0, 0, 1]], dtype=np.float64)
        return cls(shape=(height, width), reference_from_image=matrix)

    def points(self, first: int = 0, last: int | None = None) -> NDArray[np.float64]:
        """Return the frame-0 point (x, y) of every pixel of rows `first` up to `last`, (rows, W, 2)."""
        height, width = self.shape
        columns, rows = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)[first:last])
        return transform_points(self.reference_from_image, np.stack([columns, rows], axis=-1))
