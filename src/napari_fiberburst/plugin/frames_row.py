"""Which frames of a long recording are the burst: those that suit best, those about the one shown, or others."""

import operator
from typing import TYPE_CHECKING

from napari.components import ViewerModel
from qtpy.QtCore import Signal
from qtpy.QtWidgets import QLabel, QLineEdit, QPushButton, QVBoxLayout, QWidget
from superqt.utils import create_worker

from napari_fiberburst.errors import BurstError, FiberBurstError
from napari_fiberburst.io.frames import chosen_frames
from napari_fiberburst.plugin.drivers import without_clash
from napari_fiberburst.plugin.problems import why
from napari_fiberburst.plugin.recordings import LONGEST_BURST, recording_in
from napari_fiberburst.plugin.sections import row_of

if TYPE_CHECKING:
    from napari_fiberburst.plugin.bursts import BurstSource

# As many frames as a good burst has.
_FRAMES = 20


class FramesRow(QWidget):
    """Chooses frames of a recording that is longer than a burst; hidden for others.

    Parameters
    ----------
    viewer : ViewerModel
        Whose slider tells which frame is shown.

    Attributes
    ----------
    edit : QLineEdit
        The frames, as Python writes a slice.
    best_button, shown_button : QPushButton
        Take the frames that suit best, or those about the one shown.
    words : QLabel
        What is chosen, and why.
    """

    changed = Signal()

    def __init__(self, viewer: ViewerModel, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._viewer = viewer
        self._whole: BurstSource | None = None
        self._asked: object = None
        self._is_wanted = True
        self.edit, self.words = QLineEdit(), QLabel()
        self.best_button, self.shown_button = QPushButton("Best"), QPushButton("Shown")
        self._lay_out()
        self.edit.textChanged.connect(lambda _: self.changed.emit())
        self.edit.textEdited.connect(lambda _: self._tell())
        self.best_button.clicked.connect(self.take_best)
        self.shown_button.clicked.connect(self._take_shown)
        self.setVisible(False)

    def take(self, whole: "BurstSource | None") -> None:
        """Offer frames of another recording; None, or a burst, has nothing to choose."""
        whole = whole if whole is not None and _is_long(whole) else None
        if whole is not None and self._whole is not None and _is_same(whole, self._whole):
            return
        self._whole, self._asked = whole, None
        self._show()
        self.edit.blockSignals(True)
        self.edit.clear()
        self.edit.blockSignals(False)
        if self._whole is not None:
            self.take_best()

    def set_wanted(self, *, is_wanted: bool) -> None:
        """Show the row where a burst is wanted; what works on all frames has no use for it."""
        self._is_wanted = is_wanted
        self._show()

    def chosen(self, whole: "BurstSource") -> range | None:
        """Return the frames of a burst to take; None for all of them, because it is no longer than a burst.

        Raises
        ------
        BurstError
            None are chosen yet, or there are no such frames.
        """
        if not _is_long(whole):
            return None
        text = self.edit.text().strip()
        if not text:
            raise BurstError(
                f"{whole.name} has {whole.shape[0]:,} frames, of which some 20 make a burst; choose them, such as "
                "100:120, or wait until they are suggested"
            )
        found = chosen_frames(text, whole.shape[0], whole.name)
        return range(found[-1], found[0] + 1, -found.step) if found.step < 0 else found

    def take_best(self) -> None:
        """Look for the frames that suit best, in another thread."""
        if self._whole is None:
            return
        self._asked = asked = object()
        self.words.setText("Looking for the frames that suit best.")
        create_worker(
            _best_of,
            self._whole,
            _connect={
                "returned": lambda best: self._take_found(asked, best),
                "errored": lambda error: self._take_error(asked, error),
            },
            _ignore_errors=True,
        )

    def _take_found(self, asked: object, best: range) -> None:
        if asked is self._asked and self._whole is not None:
            self._put(best)
            self.words.setText(
                f"{best.start} to {best.stop - 1} of {self._whole.shape[0]:,} look best: sharp, moving, in contact."
            )

    def _take_error(self, asked: object, error: Exception) -> None:
        if asked is self._asked:
            self.words.setText(f"No frames can be suggested: {why(error, 'frames could not be looked at')}")

    def _take_shown(self) -> None:
        if self._whole is None:
            return
        # The recording's time is the axis that its letters say, counted from the viewer's last.
        count, axis = self._whole.shape[0], self._whole.axes.index("T")
        shown = self._viewer.dims.current_step[-min(self._viewer.dims.ndim, len(self._whole.axes)) + axis]
        first = max(0, min(shown - _FRAMES // 2, count - _FRAMES))
        self._put(range(first, first + _FRAMES))
        self._tell()

    def _put(self, frames: range) -> None:
        self._asked = None
        self.edit.setText(f"{frames.start}:{frames.stop}")

    def _show(self) -> None:
        self.setVisible(self._is_wanted and self._whole is not None)
        for button in (self.best_button, self.shown_button):  # keys press them where they are not seen
            button.setEnabled(self._whole is not None)

    def _tell(self) -> None:
        self._asked = None
        if self._whole is None:
            return
        try:
            frames = self.chosen(self._whole)
        except FiberBurstError as error:
            self.words.setText(str(error))
        else:
            self.words.setText("" if frames is None else f"{len(frames)} of {self._whole.shape[0]:,} frames.")

    def _lay_out(self) -> None:
        self.edit.setAccessibleName("frames of the recording")
        self.edit.setPlaceholderText("100:120")
        self.edit.setToolTip("The frames that are the burst: 100:120 are 100 to 119, 100:200:5 every fifth.")
        self.best_button.setToolTip("Choose 20 frames that are sharp, moving and in contact.")
        self.shown_button.setToolTip("Choose the 20 frames about the one that is shown.")
        self.words.setWordWrap(True)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        row = row_of(QLabel("frames"), self.edit, self.best_button, self.shown_button)
        row.setStretch(1, 1)
        column.addLayout(row)
        column.addWidget(self.words)


def _is_long(whole: "BurstSource") -> bool:
    return "T" in whole.axes and whole.shape[0] > LONGEST_BURST


def _is_same(one: "BurstSource", other: "BurstSource") -> bool:
    is_of_same = len(one.arrays) == len(other.arrays)
    return is_of_same and one.axes == other.axes and all(map(operator.is_, one.arrays, other.arrays))


def _best_of(whole: "BurstSource") -> range:
    from napari_fiberburst.pipeline.choose import best_burst  # torch takes seconds to load

    with without_clash():
        return best_burst(recording_in(whole), _FRAMES)
