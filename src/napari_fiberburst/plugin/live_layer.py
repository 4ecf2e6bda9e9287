"""An image layer that another plugin keeps changing, as a live source: so every camera that napari shows is one."""

from threading import Condition
from typing import Any

import numpy as np
from napari.layers import Image
from numpy.typing import NDArray

from napari_fiberburst.live.clocks import Clock, RealClock
from napari_fiberburst.live.sources import Latest


class LayerSource:
    """Hands out the newest frame of a layer whenever its data have changed.

    Of a layer with further axes in front, such as a stack that grows, the newest frame is the last one. Where the data
    are written in place, `layer.refresh()` tells. To be made in the thread of the window, where layers change.

    Parameters
    ----------
    layer : napari.layers.Image
        Not multi-scale.

    Attributes
    ----------
    clock : Clock
        That the times of frames are read on, when the layer changes.
    """

    def __init__(self, layer: Image) -> None:
        self.clock: Clock = RealClock()
        self._layer = layer
        self._come = Condition()
        self._newest: NDArray[Any] | None = None
        self._seconds = 0.0
        self._count = self._handed_out = 0
        self._is_open = True
        for event in (layer.events.data, layer.events.set_data):
            event.connect(self._take)
        self._take()

    def latest(self, n: int = 1) -> Latest:
        """Wait until the layer has changed, and return its newest frame; those before it cannot be had any more."""
        with self._come:
            self._come.wait_for(lambda: self._count > self._handed_out or not self._is_open)
            new = self._count - self._handed_out
            if not new or self._newest is None:
                return Latest.of([], self._count, [])
            self._handed_out = self._count
            return Latest.of([self._newest], self._count - 1, self._seconds, new - 1)

    def close(self) -> None:
        """End. The layer is let go when it changes next, because this may be another thread than the window's."""
        with self._come:
            self._is_open = False
            self._come.notify_all()

    def _take(self, *_: Any) -> None:
        if not self._is_open:
            for event in (self._layer.events.data, self._layer.events.set_data):
                event.disconnect(self._take)
            return
        frame = _newest_frame(self._layer)
        # Layers are drawn anew for other reasons, too.
        if self._newest is not None and np.array_equal(frame, self._newest):
            return
        with self._come:
            self._newest, self._seconds = frame, self.clock.now()
            self._count += 1
            self._come.notify_all()


def _newest_frame(layer: Image) -> NDArray[Any]:
    """Return a copy of the last frame of a layer, (H, W, C)."""
    own = 3 if layer.rgb else 2
    frame = np.array(layer.data[(-1,) * (len(layer.data.shape) - own)])
    return frame if layer.rgb else frame[..., None]
