"""A rectangle that is drawn while a network learns: that region is learned first."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from napari.layers import Image, Layer, Shapes

from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.plugin.bundles import is_result
from napari_fiberburst.plugin.bursts import BurstSource, region_of

if TYPE_CHECKING:
    from napari.components import ViewerModel

    from napari_fiberburst.control import Region


class RegionWatch:
    """Says which rectangle was drawn last while it watches; none where that was deleted.

    Parameters
    ----------
    viewer : ViewerModel
        Whose Shapes layers to watch, also those that are added meanwhile.
    favoured : callable
        Is given x0, y0, x1, y1 in the burst's pixels, or None.
    """

    def __init__(self, viewer: "ViewerModel", favoured: "Callable[[Region | None], object]") -> None:
        self._viewer, self._favoured = viewer, favoured
        self._watched: list[Shapes] = []
        self._burst: tuple[Image, BurstSource] | None = None
        self._last: Region | None = None

    def begin(self, source: BurstSource) -> None:
        """Watch from now on, for the run of this burst. What was drawn before is not taken."""
        self.end()
        if source.names[0] not in self._viewer.layers:
            return  # a rectangle could not be placed
        self._burst, self._last = (self._viewer.layers[source.names[0]], source), None
        self._viewer.layers.events.inserted.connect(self._take_layer)
        for layer in self._viewer.layers:
            self._watch(layer)

    def end(self) -> None:
        """Watch no more. May be called more than once."""
        self._viewer.layers.events.inserted.disconnect(self._take_layer)
        for layer in self._watched:
            layer.events.data.disconnect(self._take_shapes)
        self._watched, self._burst = [], None

    def _take_layer(self, event: Any) -> None:
        self._watch(event.value)

    def _watch(self, layer: Layer) -> None:
        if isinstance(layer, Shapes) and not is_result(layer):
            layer.events.data.connect(self._take_shapes)
            self._watched.append(layer)

    def _take_shapes(self, event: Any) -> None:
        if self._burst is None:
            return
        layer, source = self._burst
        try:
            (y0, y1), (x0, x1) = region_of(event.source, layer, source.axes)
        except FiberBurstError:  # deleted, still a point, or beyond the frame
            region = None
        else:
            (row, _), (column, _) = source.region or ((0, 0), (0, 0))
            region = (float(x0 - column), float(y0 - row), float(x1 - column), float(y1 - row))
        if region != self._last:
            self._last = region
            self._favoured(region)
