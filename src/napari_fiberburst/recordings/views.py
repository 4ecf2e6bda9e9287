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
# Frames whose mean light is told from at most so many.
_FRAMES_OF_MEAN = 2000


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
        height, width = template.shape
        self.spacing = max(_CELL * template.pitch, max(height, width) / _MOST_SIDE)
        self._grid = Grid.over((0, 0, width - 1, height - 1), self.spacing)
        self.shape = self._grid.shape
        shown = traces.shows.nonzero()[0]
        samples = traces.samples(shown[:: max(1, len(shown) // _FRAMES_OF_MEAN)])
        self.mean_light = (samples.grey * samples.weights).sum(dim=0) / samples.weights.sum(dim=0).clamp_min(1e-9)
        self.at = lru_cache(maxsize=_KEPT)(self._make)

    @property
    def middle(self) -> tuple[float, float]:
        """The middle of an image (x, y), frame pixels."""
        rows, columns = self.shape
        return self._grid.x0 + (columns - 1) / 2 * self.spacing, self._grid.y0 + (rows - 1) / 2 * self.spacing

    def _make(self, number: int) -> tuple[Tensor, Tensor]:
        samples = self._traces.samples([number])
        relative = samples.grey / self.mean_light.clamp_min(1e-4)
        weights = samples.weights * (self.mean_light > 1e-4)
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
