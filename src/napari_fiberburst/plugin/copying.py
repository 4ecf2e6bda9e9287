"""Buttons that copy what the form is set to do as a call."""

from collections.abc import Callable

from napari.utils.notifications import show_error
from qtpy.QtCore import Signal
from qtpy.QtWidgets import QApplication, QHBoxLayout, QPushButton, QWidget

from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.plugin.calls import as_command, as_python
from napari_fiberburst.plugin.form import SettingsForm
from napari_fiberburst.plugin.input_box import InputBox


class CopyButtons(QWidget):
    """Copies the call of the next run, in Python or on the command line.

    Parameters
    ----------
    source : InputBox
        Where the burst is chosen.
    form : SettingsForm
        Where the settings are.
    """

    copied = Signal(str)  # in words

    def __init__(self, source: InputBox, form: SettingsForm, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._source, self._form = source, form
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        self.python, self.command = QPushButton("Copy as Python"), QPushButton("Copy as command")
        for button, write in ((self.python, as_python), (self.command, as_command)):
            button.setToolTip("Copy the exact call of what is set here.")
            button.clicked.connect(lambda _, write=write: self._copy(write))
            row.addWidget(button)

    def _copy(self, write: Callable[..., str]) -> None:
        try:
            text = write(self._source.source(), self._form.choices(), self._source.bundle_source())
        except FiberBurstError as error:
            show_error(str(error))
            return
        clipboard = QApplication.clipboard()
        if clipboard is not None:
            clipboard.setText(text)
        self.copied.emit("copied to the clipboard")
