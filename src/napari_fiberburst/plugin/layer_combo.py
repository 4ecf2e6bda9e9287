"""A combo box of the viewer's layers of one kind, which follows what happens to them."""

from collections.abc import Callable
from typing import Any

from napari.components import ViewerModel
from napari.layers import Layer
from qtpy.QtCore import Signal
from qtpy.QtWidgets import QComboBox, QWidget


class LayerWatch:
    """Calls back when layers are added, removed, moved or renamed, until it is closed.

    Parameters
    ----------
    viewer : ViewerModel
        Whose layers.
    changed : callable
        Called without arguments.
    """

    def __init__(self, viewer: ViewerModel, changed: Callable[[], None]) -> None:
        self._viewer, self._changed = viewer, changed
        self._events: list[Any] = []
        self._renamed: dict[int, Layer] = {}
        self.open()

    def open(self) -> None:
        """Watch, again where it was closed."""
        if self._events:
            return
        self._events = [getattr(self._viewer.layers.events, name) for name in ("inserted", "removed", "reordered")]
        for emitter in self._events:
            emitter.connect(self._follow)
        self._watch_names()

    def close(self) -> None:
        """Stop watching. May be called more than once."""
        for emitter in self._events:
            emitter.disconnect(self._follow)
        for layer in self._renamed.values():
            layer.events.name.disconnect(self._call)
        self._events, self._renamed = [], {}

    def _follow(self, event: Any = None) -> None:
        self._watch_names()
        self._changed()

    def _call(self, event: Any = None) -> None:
        self._changed()

    def _watch_names(self) -> None:
        here = {id(layer): layer for layer in self._viewer.layers}
        for number, layer in list(self._renamed.items()):
            if number not in here:
                layer.events.name.disconnect(self._call)
                del self._renamed[number]
        for number, layer in here.items():
            if number not in self._renamed:
                layer.events.name.connect(self._call)
                self._renamed[number] = layer


class LayerCombo(QComboBox):
    """Chooses one of the viewer's layers; keeps its choice when layers come, go, move or change their name.

    Parameters
    ----------
    viewer : ViewerModel
        Whose layers.
    accepts : callable
        Tells of a layer whether it may be chosen.
    nothing : str, optional
        Text of a first entry that stands for no layer; without it, a layer is chosen wherever there is one.
    """

    layer_changed = Signal()

    def __init__(
        self,
        viewer: ViewerModel,
        accepts: Callable[[Layer], bool],
        nothing: str = "",
        parent: QWidget | None = None,
    ) -> None:
        super().__init__(parent)
        self._viewer, self._accepts, self._nothing = viewer, accepts, nothing
        self._layers: list[Layer | None] = []
        # A long name must not widen the dock.
        self.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
        self.setMinimumContentsLength(12)
        self.refresh()
        self.currentIndexChanged.connect(lambda _: self.layer_changed.emit())

    @property
    def layer(self) -> Layer | None:
        """The layer chosen."""
        index = self.currentIndex()
        return self._layers[index] if 0 <= index < len(self._layers) else None

    def choose(self, layer: Layer | None) -> bool:
        """Choose a layer; return whether it may be."""
        if layer not in self._layers:
            return False
        self.setCurrentIndex(self._layers.index(layer))
        return True

    def refresh(self) -> None:
        """Follow the viewer's layers."""
        before = self.layer
        found: list[Layer | None] = [None] if self._nothing else []
        found += [layer for layer in self._viewer.layers if self._accepts(layer)]
        self.blockSignals(True)
        self.clear()
        self.addItems([self._nothing if layer is None else layer.name for layer in found])
        self._layers = found
        if before in found:
            self.setCurrentIndex(found.index(before))
        elif found:
            self.setCurrentIndex(0)
        self.blockSignals(False)
        if self.layer is not before:
            self.layer_changed.emit()
