"""A combo box of the viewer's layers of one kind, and an event filter that keeps the wheel for scrolling the dock."""

from collections.abc import Callable
from typing import Any

from magicgui.widgets import ComboBox
from napari.components import ViewerModel
from napari.layers import Layer
from qtpy.QtCore import QEvent, QObject, Qt
from qtpy.QtWidgets import QAbstractSpinBox, QApplication, QComboBox, QGraphicsView, QScrollArea, QSlider

_SHORTEST_NAME = 12


class LayerPicker(ComboBox):
    """Chooses one of the viewer's layers.

    Its choice stays when layers are added, removed, moved or renamed; napari calls `reset_choices` then.

    Parameters
    ----------
    viewer : ViewerModel
        Whose layers.
    accepts : callable
        Says whether a layer may be chosen.
    nothing : str, optional
        Text of a first entry that stands for no layer. Without it, a layer is chosen wherever there is one.
    """

    def __init__(self, viewer: ViewerModel, accepts: Callable[[Layer], bool], nothing: str = "") -> None:
        self.null_string = nothing
        super().__init__(
            choices=lambda _: [(layer.name, layer) for layer in viewer.layers if accepts(layer)],
            nullable=bool(nothing),
        )
        narrow(self.native)

    def reset_choices(self, *_: Any) -> None:
        """Follow the viewer's layers."""
        before = self.value
        with self.changed.blocked():
            # magicgui tells entries by their text: a layer that was renamed would no longer be the one chosen.
            self.native.clear()
            super().reset_choices()
            if before in self.choices:
                self.value = before
        if self.value is not before:
            self.changed.emit(self.value)


class WheelFilter(QObject):
    """Lets the wheel scroll the dock, whatever is under the pointer.

    Nobody means to turn a setting, or to zoom a plot, by scrolling past it.

    Parameters
    ----------
    area : QScrollArea
        What scrolls.
    """

    def __init__(self, area: QScrollArea) -> None:
        super().__init__(area)
        self._area = area
        content = area.widget()
        assert content is not None
        for kind in (QAbstractSpinBox, QComboBox, QSlider):
            for widget in content.findChildren(kind):
                widget.setFocusPolicy(Qt.FocusPolicy.StrongFocus)  # the wheel shall not give it the focus either
                widget.installEventFilter(self)
        for plot in content.findChildren(QGraphicsView):
            viewport = plot.viewport()
            assert viewport is not None
            viewport.installEventFilter(self)

    def eventFilter(self, watched: QObject | None, event: QEvent | None) -> bool:
        """Hand a wheel event to the scroll area."""
        if event is None or event.type() != QEvent.Type.Wheel:
            return False
        QApplication.sendEvent(self._area.verticalScrollBar(), event)
        event.accept()
        return True


def narrow(box: QComboBox) -> None:
    """Let no long entry widen the dock."""
    box.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
    box.setMinimumContentsLength(_SHORTEST_NAME)
