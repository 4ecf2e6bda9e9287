"""What the dock shows while there is no burst: ways to open one."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from napari.components import ViewerModel
from napari.layers import Layer
from napari.utils.notifications import show_error
from npe2 import PluginManager
from qtpy.QtCore import Qt, Signal
from qtpy.QtWidgets import QFileDialog, QLabel, QMenu, QPushButton, QVBoxLayout, QWidget
from superqt.utils import create_worker

from napari_fiberburst.io.archive import ARCHIVE_ENDINGS
from napari_fiberburst.io.results import MODEL_ENDING, is_model
from napari_fiberburst.io.tiff import TIFF_ENDINGS
from napari_fiberburst.io.video_container import VIDEO_ENDINGS
from napari_fiberburst.plugin import METADATA_KEY
from napari_fiberburst.plugin.contributions import PLUGIN, LayerData, read, read_model
from napari_fiberburst.plugin.problems import why
from napari_fiberburst.plugin.sections import row_of

_BURSTS, _MODELS = (
    " ".join(f"*{ending}" for ending in endings)
    for endings in ((*TIFF_ENDINGS, *ARCHIVE_ENDINGS, *VIDEO_ENDINGS), (MODEL_ENDING,))
)
_KINDS = f"All that opens here ({_BURSTS} {_MODELS});;Bursts and recordings ({_BURSTS});;Saved results ({_MODELS})"
_INVITATION = (
    "Open a burst, 10 to 20 frames that moved a little, or a recording of any length. Or drop it on the window."
)


class EmptyBox(QWidget):
    """Opens a burst, by the reader of the command line, or a sample; in another thread.

    Parameters
    ----------
    viewer : ViewerModel
        Where to.

    Attributes
    ----------
    open_button, folder_button, sample_button : QPushButton
        Locked while something is opened.
    live_button : QPushButton
        For whoever wants to see a camera.
    words : QLabel
        What to do, or why something could not be opened.
    """

    opened = Signal(object)  # the Layers, which are in the viewer
    busy_changed = Signal(bool)

    def __init__(self, viewer: ViewerModel, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._viewer = viewer
        self.words = QLabel(_INVITATION)
        self.words.setWordWrap(True)
        self.words.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        self.open_button, self.folder_button = QPushButton("Open…"), QPushButton("Open folder…")
        self.sample_button, self.live_button = QPushButton("Try a sample"), QPushButton("Live…")
        self.open_button.setToolTip("Open a video, a TIFF stack, or a burst of fiberburst simulate.")
        self.folder_button.setToolTip("Open a folder of PNG or TIFF frames, or an OME-Zarr image.")
        self.sample_button.setToolTip("Simulate a burst whose truth is known.")
        self.live_button.setToolTip("See the picture of a camera while the probe is held; a simulated one will do.")
        self.samples = QMenu(self.sample_button)
        self.samples.aboutToShow.connect(self._list_samples)
        self.sample_button.setMenu(self.samples)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.words)
        column.addLayout(row_of(self.open_button, self.folder_button))
        column.addLayout(row_of(self.sample_button, self.live_button))
        self.open_button.clicked.connect(self.ask_for_file)
        self.folder_button.clicked.connect(self._ask_for_folder)

    def open(self, path: str) -> None:
        """Open a burst as a layer, with what its file says of it, or a model as those of its run; or say why not."""
        opens = read_model if is_model(Path(path)) else read
        self._load(partial(opens, path), f"Opening {path}")

    def ask_for_file(self) -> None:
        """Let the user choose a file, and open it."""
        path, _ = QFileDialog.getOpenFileName(self, "Open a burst, a recording or a saved result", "", _KINDS)
        if path:
            self.open(path)

    def _ask_for_folder(self) -> None:
        path = QFileDialog.getExistingDirectory(self, "Open a folder of frames, or an OME-Zarr image")
        if path:
            self.open(path)

    def _list_samples(self) -> None:
        """Offer what napari's own menu of samples has of this plugin."""
        self.samples.clear()
        for plugin, samples in PluginManager.instance().iter_sample_data():
            for sample in samples if plugin == PLUGIN else ():
                action = self.samples.addAction(sample.display_name)
                if action is not None:
                    action.triggered.connect(partial(self._load, sample.open, f"Simulating: {sample.display_name}"))

    def _load(self, make: Callable[[], Any], told: str, *_: Any) -> None:
        self._set_busy(is_busy=True, words=told)
        create_worker(make, _connect={"returned": self._take, "errored": self._take_error}, _ignore_errors=True)

    def _take(self, opened: list[LayerData]) -> None:
        self._set_busy(is_busy=False, words=_INVITATION)
        layers = [Layer.create(data, look, kind) for data, look, kind in opened]
        for layer in layers:
            self._viewer.add_layer(layer)
        if "reconstruction" not in layers[0].metadata.get(METADATA_KEY, {}):  # a saved result is no burst
            self.opened.emit(layers)

    def _take_error(self, error: Exception) -> None:
        problem = why(error, "a burst could not be opened")
        self._set_busy(is_busy=False, words=problem)
        if self.isHidden():  # there is a burst already
            show_error(problem)

    def _set_busy(self, *, is_busy: bool, words: str) -> None:
        for button in (self.open_button, self.folder_button, self.sample_button):
            button.setEnabled(not is_busy)
        self.words.setText(words)
        self.busy_changed.emit(is_busy)
