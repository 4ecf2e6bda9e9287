"""A bundle out of a burst, or out of an image of it in even light: measured once, looked at, and kept."""

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from napari.utils.notifications import show_error, show_info
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QFileDialog, QLabel, QPushButton, QVBoxLayout, QWidget
from superqt.utils import create_worker

from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.plugin.bundles import BundleSource
from napari_fiberburst.plugin.bursts import BurstSource
from napari_fiberburst.plugin.contributions import bundle_layers
from napari_fiberburst.plugin.drivers import without_clash
from napari_fiberburst.plugin.input_box import InputBox
from napari_fiberburst.plugin.problems import why
from napari_fiberburst.plugin.tasks.task import Task

if TYPE_CHECKING:
    import napari

    from napari_fiberburst.bundle.bundle import Bundle

_FROM_BURST = "Measures the bundle in the mean of the burst's frames. An image of it in even light, chosen as bundle, "
_BETTER = "knows the gains of the cores better; so does a run of Picture on a burst that moves (Keep this bundle)."
_FROM_IMAGE = "Measures the bundle in an image of it in even light: "
_KNOWN = "This bundle serves every burst through the same probe, and single frames: choose them, and run Picture."


class BundleTask(Task):
    """Measures the bundle that is chosen, or the burst's own; shows what it has, and saves it.

    Attributes
    ----------
    keep_button : QPushButton
        Saves the bundle that is chosen.
    words, numbers : QLabel
        What will be measured, or what has been; and what the bundle has.
    """

    title: ClassVar[str] = "Bundle"
    tip: ClassVar[str] = "Measure the bundle once, look at it, and keep it for other bursts through the same probe."

    def __init__(self, viewer: "napari.viewer.Viewer", source: InputBox, parent: QWidget | None = None) -> None:
        super().__init__(viewer, source, parent)
        self._measuring = ""
        self.start_button.setText("Calibrate")
        self.keep_button = QPushButton("Keep this bundle…")
        self.words, self.numbers = QLabel(), QLabel()
        self._lay_out()
        self.start_button.clicked.connect(self.calibrate)
        self.keep_button.clicked.connect(self._ask_and_keep)
        source.changed.connect(self._take_input)
        self._take_input()

    @property
    def is_empty(self) -> bool:
        """Whether no bundle is chosen."""
        return self.input.bundle.value is None

    def calibrate(self) -> None:
        """Measure what is chosen, in another thread; then show the bundle and choose it."""
        given = self.input.bundle_source()
        try:
            source = self.input.source() if given is None else given
        except FiberBurstError as error:
            show_error(str(error))
            return
        self._measuring = source.name
        self._take_input()
        create_worker(
            measured, source, _connect={"returned": self._take, "errored": self._take_error}, _ignore_errors=True
        )

    def keep(self, path: str | Path) -> None:
        """Write the bundle that is chosen, or say why not."""
        given = self.input.bundle_source()
        if given is None or given.bundle is None:
            return
        try:
            given.bundle.save(path)
        except FiberBurstError as error:
            show_error(str(error))
        else:
            show_info(f"wrote {path}")

    def _take(self, bundle: "Bundle") -> None:
        name, self._measuring = f"bundle of {self._measuring}", ""
        self.input.add_bundle(bundle_layers(bundle, name))
        self._take_input()

    def _take_error(self, error: Exception) -> None:
        self._measuring = ""
        self._take_input()
        self.words.setText(why(error, "the bundle could not be measured"))

    def _take_input(self) -> None:
        """Say what can be done with what is chosen now."""
        given = self.input.bundle_source()
        known = None if given is None else given.bundle
        if self._measuring:
            words = f"Measuring the bundle in {self._measuring}."
        elif given is None:
            words = _FROM_BURST + _BETTER
        else:
            words = f"{_FROM_IMAGE}{given.name}." if known is None else _KNOWN
        self.words.setText(words)
        self.numbers.setText("" if known is None else _as_table(known))
        self.numbers.setVisible(known is not None)
        self.start_button.setEnabled(not self._measuring and known is None)
        self.keep_button.setEnabled(not self._measuring and known is not None)
        self.kept_changed.emit()

    def _ask_and_keep(self) -> None:
        given = self.input.bundle_source()
        if given is not None:
            suggested = given.path or f"{given.name}.bundle"
            path, _ = QFileDialog.getSaveFileName(self, "Keep bundle", suggested, "Bundle (*.bundle)")
            if path:
                self.keep(path)

    def _lay_out(self) -> None:
        self.start_button.setToolTip("Measure where the cores are, and how much light each passes.")
        self.keep_button.setToolTip("Save the bundle to a file, for other bursts through the same probe.")
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        for label in (self.words, self.numbers):
            label.setWordWrap(True)
            label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        for widget in (self.start_button, self.words, self.numbers, self.keep_button):
            column.addWidget(widget)


def measured(source: BurstSource | BundleSource) -> "Bundle":
    """Calibrate the bundle in a burst, or in an image of it in even light.

    Raises
    ------
    FiberBurstError
        No bundle is seen, or the layers are no usable burst or image.
    """
    from napari_fiberburst.bundle.bundle import Bundle  # torch takes seconds to load

    with without_clash():
        return Bundle.from_image(source.image) if isinstance(source, BundleSource) else Bundle.from_burst(source.read())


def _as_table(bundle: "Bundle") -> str:
    """Return what a bundle has, for a label that knows HTML."""
    from napari_fiberburst.bundle.summary import summary

    rows = "".join(
        f"<tr><td>{escape(name)}&nbsp;&nbsp;</td><td>{escape(value)}</td></tr>" for name, value in summary(bundle)
    )
    return f"<table>{rows}</table>"
