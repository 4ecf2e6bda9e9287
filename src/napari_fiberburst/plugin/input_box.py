"""Which layers the burst is in, which axis is which, and what part of it to use."""

from napari.components import ViewerModel
from napari.layers import Image, Layer, Shapes
from qtpy.QtCore import Qt, Signal
from qtpy.QtWidgets import QLineEdit, QListWidget, QListWidgetItem, QVBoxLayout, QWidget

from napari_fiberburst.errors import BurstError
from napari_fiberburst.plugin import METADATA_KEY
from napari_fiberburst.plugin.bursts import BurstSource, guess_axes, region_of, source_of
from napari_fiberburst.plugin.layer_combo import LayerCombo, LayerWatch
from napari_fiberburst.plugin.placement import Placement
from napari_fiberburst.plugin.sections import form_layout, section

_LINES_OF_CHANNELS = 4


class InputBox(QWidget):
    """The burst's layer and the order of its axes; a calibration image, a region and further channels where wanted.

    Parameters
    ----------
    viewer : ViewerModel
        Whose layers.
    """

    changed = Signal()

    def __init__(self, viewer: ViewerModel, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.burst = LayerCombo(viewer, _may_be_burst)
        self.calibration = LayerCombo(viewer, _may_be_calibration, "none (not needed)")
        self.region = LayerCombo(
            viewer, lambda layer: isinstance(layer, Shapes) and not _is_result(layer), "whole frame"
        )
        self.axes = QLineEdit()
        self._channels = QListWidget()
        self._listed: list[Image] = []
        self._viewer = viewer
        self._guessed_for: Layer | None = None
        self._lay_out()
        self.watch = LayerWatch(viewer, self._refresh)
        self.burst.layer_changed.connect(self._take_burst)
        for combo in (self.calibration, self.region):
            combo.layer_changed.connect(self.changed)
        self.axes.textChanged.connect(self._take_axes)
        self._channels.itemChanged.connect(lambda _: self.changed.emit())
        self._take_burst()

    @property
    def layers(self) -> list[Image]:
        """The burst's layers: the one chosen, and those that are further channels of it."""
        if self.burst.layer is None:
            return []
        states = [self._channels.item(row).checkState() for row in range(self._channels.count())]
        checked = Qt.CheckState.Checked
        further = [layer for layer, state in zip(self._listed, states, strict=True) if state == checked]
        return [self.burst.layer, *further]

    def source(self) -> BurstSource:
        """Return the burst that is chosen.

        Raises
        ------
        FiberBurstError
            None is, its axes are unknown, or the region is of no use.
        """
        layers = self.layers
        if not layers:
            raise BurstError(
                "there is no burst: open one as an image layer with time, height and width, or take File > Open "
                "Sample > Fiberburst"
            )
        # S, samples, is another word for channels.
        axes = self.axes.text().strip().upper().replace("S", "C")
        if layers[0].rgb and not axes.endswith("C"):
            raise BurstError(f"the last axis of an RGB layer is its colours; got axes {axes}; let them end in C")
        whole = source_of(layers, axes)
        _ = whole.shape  # refuses axes that do not fit
        shapes = self.region.layer
        return whole if shapes is None else source_of(layers, axes, region_of(shapes, layers[0], axes))

    def placement(self, source: BurstSource) -> Placement:
        """Return where the burst stands in the viewer."""
        (row, _), (column, _) = source.region or ((0, 0), (0, 0))
        return Placement.of(self.layers, source.axes, (row, column))

    def set_enabled(self, is_enabled: bool) -> None:
        """Lock or unlock what a running fit has taken."""
        for widget in (self.burst, self.axes, self.calibration, self.region, self._channels):
            widget.setEnabled(is_enabled)

    def _lay_out(self) -> None:
        self.burst.setToolTip("The image layer with the burst's frames; 10 to 20 of them are a good burst.")
        self.axes.setToolTip(
            "Order of the layer's axes, a letter each: T for the frames, Y, X, C for channels; others have length 1."
        )
        self.calibration.setToolTip("A picture of the bundle with nothing but even light before it. Never needed.")
        self.region.setToolTip("A layer of shapes, whose selected or last rectangle limits the run: for a quick look.")
        self._channels.setToolTip(
            "Layers that are further channels of the same burst; same shape, one grey layer each."
        )
        self._channels.setMaximumHeight(_LINES_OF_CHANNELS * self.fontMetrics().height() + 8)
        first = form_layout()
        first.addRow("burst", self.burst)
        first.addRow("axes", self.axes)
        self._rest = rest = form_layout()
        rest.addRow("calibration", self.calibration)
        rest.addRow("region", self.region)
        rest.addRow("channels", self._channels)
        content = QWidget()
        content.setLayout(rest)
        whole = QVBoxLayout(self)
        whole.setContentsMargins(0, 0, 0, 0)
        whole.addLayout(first)
        whole.addWidget(section("More input", content))

    def _refresh(self) -> None:
        for combo in (self.burst, self.calibration, self.region):
            combo.refresh()
        self._list_channels()

    def _take_burst(self) -> None:
        layer = self.burst.layer
        if layer is not self._guessed_for:
            self._guessed_for = layer
            self.axes.setText("" if layer is None else guess_axes(layer))
        self._list_channels()
        self.changed.emit()

    def _take_axes(self) -> None:
        self._list_channels()
        self.changed.emit()

    def _alike(self) -> list[Image]:
        """Return the layers that could be further channels of the burst chosen."""
        burst = self.burst.layer
        if burst is None or burst.rgb or "C" in self.axes.text().upper():
            return []
        shape = burst.data.shape if not burst.multiscale else None
        return [
            layer
            for layer in self._viewer.layers
            if layer is not burst and _may_be_burst(layer) and not layer.rgb and layer.data.shape == shape
        ]

    def _list_channels(self) -> None:
        chosen = self.layers[1:]
        self._channels.blockSignals(True)
        self._channels.clear()
        self._listed = self._alike()
        for layer in self._listed:
            item = QListWidgetItem(layer.name)
            item.setFlags(item.flags() | Qt.ItemFlag.ItemIsUserCheckable)
            item.setCheckState(Qt.CheckState.Checked if layer in chosen else Qt.CheckState.Unchecked)
            self._channels.addItem(item)
        self._channels.blockSignals(False)
        self._rest.setRowVisible(self._channels, self._channels.count() > 0)


def _may_be_burst(layer: Layer) -> bool:
    """Whether a layer is an image and none of ours."""
    return isinstance(layer, Image) and not _is_result(layer)


def _may_be_calibration(layer: Layer) -> bool:
    return _may_be_burst(layer) and not layer.multiscale


def _is_result(layer: Layer) -> bool:
    return "run" in layer.metadata.get(METADATA_KEY, {})
