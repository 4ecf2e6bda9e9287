"""What stands behind the pixel under the pointer, in the viewer's status bar."""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from napari.layers import Image

from napari_fiberburst.plugin.kept_run import KeptRun

if TYPE_CHECKING:
    from napari.components import ViewerModel

    from napari_fiberburst.results.reconstruction import Reconstruction

# Of an uncertainty; its value is told to the same decimal.
_DIGITS = 2
_WITHOUT_UNCERTAINTY = 4
# From here on, parts of a sample are not told.
_MANY = 10.0


class Pointing:
    """Says of a run's picture, while the pointer is over it: value, uncertainty, and how many samples it rests on.

    Everywhere else, and over whatever lies on top of a picture, the status bar is napari's own.

    Parameters
    ----------
    viewer : ViewerModel
        Whose pointer.
    runs : callable
        Returns the runs that are kept.
    """

    def __init__(self, viewer: "ViewerModel", runs: Callable[[], Sequence[KeptRun]]) -> None:
        self._viewer, self._runs = viewer, runs
        self.open()

    def open(self) -> None:
        """Follow the pointer. May be called more than once."""
        # napari works its own words out in another thread, after the mouse has moved, and then writes them over any
        # others: these come last.
        self._viewer.events.status.connect(self._tell, position="last")

    def shut(self) -> None:
        """Follow it no more. May be called more than once."""
        self._viewer.events.status.disconnect(self._tell)

    def _tell(self, event: Any) -> None:
        # A string is what somebody else has to say, or these words themselves.
        if not isinstance(event.value, str):
            words = self._words_at(self._viewer.cursor.position)
            if words:
                self._viewer.status = words

    def _words_at(self, point: Sequence[float]) -> str:
        if self._viewer.dims.ndisplay != 2:
            return ""
        of_layer = {layer: run for run in self._runs() for layer in run.layers.images}
        for layer in reversed(self._viewer.layers):
            if not isinstance(layer, Image) or not layer.visible:
                continue
            run = of_layer.get(layer)
            if run is None:
                if layer.get_value(point, world=True) is not None:
                    return ""  # something else lies on top
                continue
            result = run.result
            if result is None or run.layers.shown is not result.image:
                return ""  # it is being turned, or its past is looked at
            row, column = run.layers.placement.pixel_at(layer.world_to_data(point))
            height, width = result.canvas.shape
            if 0 <= row < height and 0 <= column < width and np.isfinite(result.image[row, column]).all():
                return f"{run.name} [{row} {column}]: {pixel_in_words(result, row, column)}"
        return ""


def pixel_in_words(result: "Reconstruction", row: int, column: int) -> str:
    """Return value, uncertainty and samples of a pixel of a result's image, as far as they are known."""
    uncertainty = math.nan if result.uncertainty is None else float(result.uncertainty[row, column])
    is_known = math.isfinite(uncertainty) and uncertainty > 0
    decimals = max(0, _DIGITS - 1 - math.floor(math.log10(uncertainty))) if is_known else None
    values = [
        f"{value:.{_WITHOUT_UNCERTAINTY}g}" if decimals is None else f"{value:.{decimals}f}"
        for value in np.atleast_1d(result.image[row, column])
    ]
    words = ", ".join(values) + ("" if decimals is None else f" ± {uncertainty:.{decimals}f}")
    if result.coverage is None:
        return words
    samples = float(result.coverage[row, column])
    if samples == 0:
        return f"{words}, filled in from the surroundings: no sample has seen it"
    return f"{words}, from {samples:.{0 if samples >= _MANY else 1}f} samples"
