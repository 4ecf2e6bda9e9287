"""Frames as small even images, by which they are found in one another."""

from functools import lru_cache

from torch import Tensor

from napari_fiberburst.motion.coarse import even_images
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.recordings.traces import Traces

# Cells of the images, in pitches, as long as there are at most so many to a side.
_CELL, _MOST_SIDE = 0.43, 192
# In pitches: the images are smoothed over this (sigma), and evened out over that.
_SMOOTHED, _NEIGHBOURHOOD = 0.55, 2.2
# So many images are kept.
_KEPT = 512


class Views:
    """Small images (h, w) of frames, and where they show something, made when they are asked for.

    Each core's light is taken relative to its own mean over the recording, because that is what a wide path leaves of
    its gain; and each image is brought to one brightness and contrast about every pixel.

    Attributes
    ----------
    spacing : float
        Pixels of the frame to a cell.
    shape : (int, int)
        h and w.
    """

    def __init__(self, traces: Traces) -> None:
        self._traces = traces
        template = traces.template
        self._grid = grid_of(template.shape, template.pitch)
        self.spacing, self.shape = self._grid.spacing, self._grid.shape
        self._mean_light = traces.summary.mean_light
        self.at = lru_cache(maxsize=_KEPT)(self._make)

    def _make(self, number: int) -> tuple[Tensor, Tensor]:
        samples = self._traces.samples([number])
        relative = samples.grey / self._mean_light.clamp_min(1e-4)
        weights = samples.weights * (self._mean_light > 1e-4)
        pitch = samples.pitch / self.spacing
        images, mask = even_images(
            samples.positions,
            relative,
            weights,
            self._grid,
            smoothed=max(0.5, _SMOOTHED * pitch),
            neighbourhood=max(2.0, _NEIGHBOURHOOD * pitch),
        )
        return images[0], mask[0]


def grid_of(shape: tuple[int, int], pitch: float) -> Grid:
    """Return the cells of the images of frames (height, width) of a bundle, in frame pixels."""
    height, width = shape
    return Grid.over((0, 0, width - 1, height - 1), max(_CELL * pitch, max(height, width) / _MOST_SIDE))


def middle_of(shape: tuple[int, int], pitch: float) -> tuple[float, float]:
    """Return the middle of the images (x, y), frame pixels: links and poses are about it."""
    grid = grid_of(shape, pitch)
    rows, columns = grid.shape
    return grid.x0 + (columns - 1) / 2 * grid.spacing, grid.y0 + (rows - 1) / 2 * grid.spacing
