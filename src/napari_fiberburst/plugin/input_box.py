"""Which layers the burst is in, which axis is which, and what part of it to use."""

from contextlib import suppress
from pathlib import Path
from typing import Any

from napari.components import ViewerModel
from napari.layers import Image, Layer, Shapes
from napari.utils.notifications import show_error
from qtpy.QtCore import Qt, Signal
from qtpy.QtWidgets import QFileDialog, QLineEdit, QListWidget, QListWidgetItem, QPushButton, QVBoxLayout, QWidget

from napari_fiberburst.errors import BurstError, FiberBurstError
from napari_fiberburst.plugin.bundles import BundleSource, bundle_source, is_result, may_be_bundle, may_be_burst
from napari_fiberburst.plugin.bursts import BurstSource, guess_axes, region_of, source_of
from napari_fiberburst.plugin.contributions import LayerData, read_bundle
from napari_fiberburst.plugin.frames_row import FramesRow
from napari_fiberburst.plugin.pickers import LayerPicker
from napari_fiberburst.plugin.placement import Placement
from napari_fiberburst.plugin.recorded import take_recording
from napari_fiberburst.plugin.sections import form_layout, row_of, section

_LINES_OF_CHANNELS = 4


class InputBox(QWidget):
    """The burst's layer and the order of its axes; its bundle, a region and further channels where wanted.

    Parameters
    ----------
    viewer : ViewerModel
        Whose layers.

    Attributes
    ----------
    burst, bundle, region : LayerPicker
        Their `value` is the layer chosen, or None.
    burst_button, open_button : QPushButton
        Open another burst, which is for the dock to do, and a bundle.
    frames : FramesRow
        Which frames of a long recording are the burst.
    axes : QLineEdit
        Order of the burst's axes.
    more : QCollapsible
        What few bursts need: axes, region and further channels.
    channels : QListWidget
        Layers that may be further channels; those that are checked are.
    """

    changed = Signal()

    def __init__(self, viewer: ViewerModel, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.burst = LayerPicker(viewer, may_be_burst)
        self.bundle = LayerPicker(viewer, may_be_bundle, "none (not needed)")
        self.region = LayerPicker(
            viewer, lambda layer: isinstance(layer, Shapes) and not is_result(layer), "whole frame"
        )
        self.burst_button, self.open_button = QPushButton("Open…"), QPushButton("Open…")
        self.frames = FramesRow(viewer)
        self.axes = QLineEdit()
        self.channels = QListWidget()
        self._listed: list[Image] = []
        self._viewer = viewer
        self._guessed_for: Layer | None = None
        self._lay_out()
        self.burst.changed.connect(self._take_burst)
        for picker in (self.bundle, self.region):
            picker.changed.connect(lambda _: self.changed.emit())
        self.open_button.clicked.connect(self._ask_and_open)
        self.axes.textChanged.connect(self._take_axes)
        self.frames.changed.connect(self.changed)
        self.channels.itemChanged.connect(lambda _: self.changed.emit())
        self._take_burst()

    @property
    def layers(self) -> list[Image]:
        """The burst's layers: the one chosen, and those that are further channels of it."""
        if self.burst.value is None:
            return []
        items = [self.channels.item(row) for row in range(self.channels.count())]
        further = [
            layer
            for layer, item in zip(self._listed, items, strict=True)
            if item is not None and item.checkState() == Qt.CheckState.Checked
        ]
        return [self.burst.value, *further]

    def source(self) -> BurstSource:
        """Return the burst that is chosen.

        Raises
        ------
        FiberBurstError
            None is, its axes are unknown, it is one frame and no bundle is chosen, or the region is of no use.
        """
        whole = self.recorded()
        if "T" not in whole.axes and self.bundle.value is None:
            raise BurstError(
                f"a burst needs the axes T, Y, X and perhaps C, and layer {whole.name!r} has the axes {whole.axes}; "
                "one frame is a burst only where its bundle is known: choose or open its bundle, or open the frames as "
                "one stack"
            )
        layers, shapes = self.layers, self.region.value
        used = whole if shapes is None else source_of(layers, whole.axes, region_of(shapes, layers[0], whole.axes))
        frames = self.frames.chosen(whole)
        return used if frames is None else used.take(frames)

    def bundle_source(self) -> BundleSource | None:
        """Return the bundle that is chosen; None where none is."""
        layer = self.bundle.value
        return None if layer is None else bundle_source(layer)

    def open_bundle(self, path: str | Path) -> None:
        """Open a bundle as layers and choose it, or say why not."""
        try:
            opened = read_bundle(str(path))
        except FiberBurstError as error:
            show_error(str(error))
        else:
            self.add_bundle(opened)

    def add_bundle(self, made: list[LayerData]) -> None:
        """Put the layers of a bundle over the burst, where they fit it, and choose the bundle."""
        place = self._place_of_frames(made[0][0].shape)
        layers = [Layer.create(data, {**look, **place}, kind) for data, look, kind in made]
        for layer in layers:
            self._viewer.add_layer(layer)
        self.reset_choices()
        self.bundle.value = layers[0]

    def reset_choices(self) -> None:
        """Follow the viewer's layers."""
        for picker in (self.burst, self.bundle, self.region):
            picker.reset_choices()
        self._list_channels()

    def placement(self, source: BurstSource) -> Placement:
        """Return where the burst stands in the viewer."""
        (row, _), (column, _) = source.region or ((0, 0), (0, 0))
        return Placement.of(self.layers, source.axes, (row, column), source.chosen)

    def set_wanted(self, *, is_burst_wanted: bool, are_frames_wanted: bool) -> None:
        """Show what a task takes: a burst, some frames of it, or nothing but its bundle."""
        self._first.setRowVisible(self._burst_row, are_frames_wanted)
        self.more.setVisible(are_frames_wanted)
        self.frames.set_wanted(is_wanted=is_burst_wanted)

    def set_enabled(self, is_enabled: bool) -> None:
        """Lock or unlock what a running fit has taken."""
        for picker in (self.burst, self.bundle, self.region):
            picker.enabled = is_enabled
        for widget in (self.axes, self.burst_button, self.open_button, self.channels, self.frames):
            widget.setEnabled(is_enabled)

    def _lay_out(self) -> None:
        self.burst.tooltip = "The image layer with the burst's frames; 10 to 20 of them are a good burst."
        self.axes.setToolTip(
            "Order of the layer's axes, a letter each: T for the frames, Y, X, C for channels; others have length 1.\n"
            "One frame, without T, is a burst where its bundle is chosen."
        )
        self.bundle.tooltip = (
            "A bundle that was opened, or an image of the bundle with nothing but even light before it. Never needed, "
            "but with it one frame is a burst."
        )
        self.burst_button.setToolTip("Open another burst or recording: a video, a TIFF stack, or a .burst file.")
        self.open_button.setToolTip("Open a bundle that was kept: a .bundle file.")
        self.burst_button.setAccessibleName("open a burst")
        self.open_button.setAccessibleName("open a bundle")
        self.region.tooltip = "A layer of shapes, whose selected or last rectangle limits the run: for a quick look."
        self.channels.setToolTip("Layers that are further channels of the same burst; same shape, one grey layer each.")
        for picker, name in ((self.burst, "burst"), (self.bundle, "bundle"), (self.region, "region")):
            picker.native.setAccessibleName(name)
        self.axes.setAccessibleName("axes")
        self.channels.setAccessibleName("further channels")
        self.channels.setMaximumHeight(_LINES_OF_CHANNELS * self.fontMetrics().height() + 8)
        self._first = first = form_layout()
        self._burst_row, bundle_row = (
            row_of(picker.native, button)
            for picker, button in ((self.burst, self.burst_button), (self.bundle, self.open_button))
        )
        for name, row in (("burst", self._burst_row), ("bundle", bundle_row)):
            row.setStretch(0, 1)
            first.addRow(name, row)
        self._rest = rest = form_layout()
        rest.addRow("axes", self.axes)
        rest.addRow("region", self.region.native)
        rest.addRow("channels", self.channels)
        content = QWidget()
        content.setLayout(rest)
        whole = QVBoxLayout(self)
        whole.setContentsMargins(0, 0, 0, 0)
        whole.addLayout(first)
        whole.addWidget(self.frames)
        self.more = section("More input", content)
        whole.addWidget(self.more)

    def recorded(self) -> BurstSource:
        """Return all frames of the layers chosen, by the axes given, without a region.

        Raises
        ------
        FiberBurstError
            None is chosen, or the axes are unknown.
        """
        layers = self.layers
        if not layers:
            raise BurstError(
                "there is no burst: open one as an image layer with time, height and width, or take File > Open "
                "Sample > Fiberburst"
            )
        axes = self._axes_given()
        if layers[0].rgb and not axes.endswith("C"):
            raise BurstError(f"the last axis of an RGB layer is its colours; got axes {axes}; let them end in C")
        whole = source_of(layers, axes)
        _ = whole.shape  # refuses axes that do not fit
        return whole

    def axes_of(self, layer: Image) -> str:
        """Return a letter for each axis of a layer: as given where the burst is in it, or else guessed."""
        return self._axes_given() if layer in self.layers and not layer.rgb else guess_axes(layer)

    def _axes_given(self) -> str:
        # S, samples, is another word for channels.
        return self.axes.text().strip().upper().replace("S", "C")

    def _place_of_frames(self, shape: tuple[int, int]) -> dict[str, Any]:
        """Return where the burst's frames lie in the viewer; nothing where they have another size."""
        with suppress(FiberBurstError):
            whole = self.recorded()
            if whole.shape[1:3] == shape:
                return Placement.of(self.layers, whole.axes, (0, 0)).on_canvas("YX")
        return {}

    def _ask_and_open(self) -> None:
        path, _ = QFileDialog.getOpenFileName(self, "Open bundle", "", "Bundle (*.bundle)")
        if path:
            self.open_bundle(path)

    def _take_burst(self) -> None:
        layer = self.burst.value
        if layer is not self._guessed_for:
            self._guessed_for = layer
            axes = "" if layer is None else guess_axes(layer)
            if layer is not None:
                take_recording(self._viewer, layer, axes)
            self.axes.setText(axes)
            if layer is not None and not {"T", "Y", "X"} <= set(axes):
                self.more.expand(animate=False)  # where they can be corrected
            self._offer_frames()
        self._list_channels()
        self.changed.emit()

    def _take_axes(self) -> None:
        self._offer_frames()
        self._list_channels()
        self.changed.emit()

    def _offer_frames(self) -> None:
        """Offer to choose frames where there are more than a burst has."""
        whole = None
        with suppress(FiberBurstError):
            whole = self.recorded()
        self.frames.take(whole)

    def _alike(self) -> list[Image]:
        """Return the layers that could be further channels of the burst chosen."""
        burst = self.burst.value
        if burst is None or burst.rgb or "C" in self.axes.text().upper():
            return []
        shape = burst.data.shape if not burst.multiscale else None
        return [
            layer
            for layer in self._viewer.layers
            if layer not in (burst, self.bundle.value)
            and may_be_burst(layer)
            and not layer.rgb
            and layer.data.shape == shape
        ]

    def _list_channels(self) -> None:
        chosen = self.layers[1:]
        self.channels.blockSignals(True)
        self.channels.clear()
        self._listed = self._alike()
        for layer in self._listed:
            item = QListWidgetItem(layer.name)
            item.setFlags(item.flags() | Qt.ItemFlag.ItemIsUserCheckable)
            item.setCheckState(Qt.CheckState.Checked if layer in chosen else Qt.CheckState.Unchecked)
            self.channels.addItem(item)
        self.channels.blockSignals(False)
        self._rest.setRowVisible(self.channels, self.channels.count() > 0)
