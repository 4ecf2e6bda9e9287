"""Where live frames come from, as the dock offers it."""

from collections.abc import Callable
from functools import partial
from typing import Any

from napari.components import ViewerModel
from napari.layers import Image, Layer
from qtpy.QtCore import Signal
from qtpy.QtWidgets import (
    QComboBox,
    QDoubleSpinBox,
    QFileDialog,
    QFormLayout,
    QLineEdit,
    QMenu,
    QPushButton,
    QWidget,
)

from napari_fiberburst.errors import BurstError
from napari_fiberburst.live.sources import LiveSource
from napari_fiberburst.plugin.bundles import may_be_burst
from napari_fiberburst.plugin.bursts import guess_axes, source_of
from napari_fiberburst.plugin.pickers import LayerPicker, narrow
from napari_fiberburst.plugin.recordings import recording_in
from napari_fiberburst.plugin.sections import form_layout, row_of

SIMULATED, CAMERA, LAYER, REPLAY, GROWING = "simulated", "camera", "layer", "replay", "growing"
_KINDS = {
    SIMULATED: "simulated camera",
    CAMERA: "camera of Micro-Manager",
    LAYER: "image layer that changes",
    REPLAY: "recording, replayed",
    GROWING: "folder or file that grows",
}
_TIPS = {
    SIMULATED: "The resolution chart through a bundle held by hand, 30 frames of 256 x 256 a second.",
    CAMERA: "The camera that pymmcore-plus has, which other plugins may have loaded; or one of a configuration.",
    LAYER: "A layer that any other plugin keeps changing: its live view, or a stack that grows.",
    REPLAY: "A layer with time, as if it were recorded now.",
    GROWING: "A folder to which frames are added, or a TIFF or OME-Zarr image that grows.",
}
_FASTEST = 1000.0


class LiveSourceRow(QWidget):
    """Chooses a live source.

    Parameters
    ----------
    viewer : ViewerModel
        Whose layers may be one.

    Attributes
    ----------
    kind : QComboBox
        What kind of source.
    layer : LayerPicker
        The layer that changes, or the recording.
    rate : QDoubleSpinBox
        Frames a second of a replay; 0, the recording's own.
    place : QLineEdit
        A configuration of Micro-Manager, or what grows.
    """

    changed = Signal()

    def __init__(self, viewer: ViewerModel, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.kind, self.layer = QComboBox(), LayerPicker(viewer, _may_be_live)
        self.rate, self.place, self.button = QDoubleSpinBox(), QLineEdit(), QPushButton("…")
        self._lay_out()
        self.kind.currentIndexChanged.connect(self._follow_kind)
        self.layer.changed.connect(lambda _: self.changed.emit())
        self.place.textChanged.connect(lambda _: self.changed.emit())
        self.button.clicked.connect(self._ask)
        self._follow_kind()

    def choose(self, kind: str) -> None:
        """Choose a kind of source."""
        self.kind.setCurrentIndex(self.kind.findData(kind))

    def opener(self) -> Callable[[], LiveSource]:
        """Return what opens the source that is chosen, in another thread.

        Raises
        ------
        BurstError
            It is not told which layer, file or folder.
        """
        kind, place = self.kind.currentData(), self.place.text().strip()
        if kind == SIMULATED:
            return _simulated
        if kind == CAMERA:
            return partial(_camera, place)
        if kind == GROWING:
            if not place:
                raise BurstError("choose the folder or file that grows")
            return partial(_growing, place)
        layer = self.layer.value
        if layer is None:
            raise BurstError("there is no image layer that could be the source; open one")
        if kind == REPLAY:
            return self._replay(layer)
        from napari_fiberburst.plugin.live_layer import LayerSource

        source = LayerSource(layer)
        return lambda: source

    @property
    def source_layer(self) -> Image | None:
        """The layer that frames come from; None where they do not come from one."""
        return self.layer.value if self.kind.currentData() in (LAYER, REPLAY) else None

    def _replay(self, layer: Image) -> Callable[[], LiveSource]:
        burst = source_of([layer], guess_axes(layer))
        if "T" not in burst.axes:
            raise BurstError(f"layer {layer.name!r} has no time axis to be replayed; open a recording")
        recording, rate = recording_in(burst), self.rate.value() or None
        if rate is None and recording.acquisition.times is None:
            raise BurstError(f"layer {layer.name!r} does not tell how many frames it has a second; set a rate")
        return partial(_replayed, recording, rate)

    def _follow_kind(self) -> None:
        kind = self.kind.currentData()
        self.kind.setToolTip(_TIPS[kind])
        self.rows.setRowVisible(self.layer.native, kind in (LAYER, REPLAY))
        self.rows.setRowVisible(self.rate, kind == REPLAY)
        self.rows.setRowVisible(self._place_row, kind in (CAMERA, GROWING))
        label = self.rows.labelForField(self._place_row)
        if label is not None:
            label.setText("configuration" if kind == CAMERA else "path")  # type: ignore[attr-defined]
        self.place.setPlaceholderText("none: the camera that is loaded" if kind == CAMERA else "")
        self.place.clear()
        self.changed.emit()

    def _ask(self) -> None:
        if self.kind.currentData() == CAMERA:
            path = QFileDialog.getOpenFileName(self, "Configuration of Micro-Manager", "", "Configurations (*.cfg)")[0]
            self._take_path(path)
            return
        menu = QMenu(self.button)
        for words, ask in (
            ("Folder…", lambda: QFileDialog.getExistingDirectory(self, "Folder or OME-Zarr image that grows")),
            ("TIFF file…", lambda: QFileDialog.getOpenFileName(self, "File that grows", "", "TIFF (*.tif *.tiff)")[0]),
        ):
            action = menu.addAction(words)
            if action is not None:
                action.triggered.connect(lambda _=False, ask=ask: self._take_path(ask()))
        menu.popup(self.button.mapToGlobal(self.button.rect().bottomLeft()))

    def _take_path(self, path: str) -> None:
        if path:
            self.place.setText(path)

    def _lay_out(self) -> None:
        for kind, words in _KINDS.items():
            self.kind.addItem(words, kind)
        narrow(self.kind)
        self.kind.setAccessibleName("live source")
        self.layer.native.setAccessibleName("layer of the live source")
        self.layer.tooltip = "The layer that frames come from."
        self.rate.setRange(0.0, _FASTEST)
        self.rate.setDecimals(1)
        self.rate.setSpecialValueText("its own")
        self.rate.setSuffix(" / s")
        self.rate.setAccessibleName("frames a second")
        self.rate.setToolTip("Frames a second of the replay; its own, as they were recorded.")
        self.place.setAccessibleName("path of the live source")
        self.place.setToolTip("The file or folder that frames come from, or that tells of the camera.")
        self.button.setAccessibleName("choose the path of the live source")
        self.button.setToolTip("Choose a file or folder.")
        self.button.setFixedWidth(self.button.sizeHint().height() + 8)
        self._place_row = QWidget()
        inside = row_of(self.place, self.button)
        inside.setContentsMargins(0, 0, 0, 0)
        inside.setStretch(0, 1)
        self._place_row.setLayout(inside)
        self.rows: QFormLayout = form_layout()
        self.rows.addRow("source", self.kind)
        self.rows.addRow("layer", self.layer.native)
        self.rows.addRow("rate", self.rate)
        self.rows.addRow("path", self._place_row)
        self.setLayout(self.rows)


def _may_be_live(layer: Layer) -> bool:
    return may_be_burst(layer) and not layer.multiscale


def _simulated() -> LiveSource:
    from napari_fiberburst.live.camera import CameraSource
    from napari_fiberburst.live.simulated_camera import simulated_core

    return CameraSource(simulated_core())


def _camera(configuration: str) -> LiveSource:
    from napari_fiberburst.live.camera import CameraSource
    from napari_fiberburst.live.micromanager import CMMCorePlus

    core = CMMCorePlus.instance()
    if configuration:
        core.loadSystemConfiguration(configuration)
    return CameraSource(core)


def _replayed(recording: Any, rate: float | None) -> LiveSource:
    from napari_fiberburst.live.sources import Replay

    return Replay(recording, rate)


def _growing(path: str) -> LiveSource:
    from napari_fiberburst.live.growing import Growing

    return Growing(path)
