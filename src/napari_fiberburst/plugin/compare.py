"""Two images compared: one after the other, on both sides of a line, side by side, or one less the other."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from napari.components import ViewerModel
from napari.layers import Image
from napari.utils.colormaps import Colormap
from qtpy.QtCore import Qt, QTimer
from qtpy.QtWidgets import QComboBox, QLabel, QPushButton, QSlider, QVBoxLayout, QWidget

from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.plugin.kept_run import KeptRun
from napari_fiberburst.plugin.sections import row_of
from napari_fiberburst.plugin.sides import AS_RECORDED, Curtain, Side, difference, frame_of, image_of
from napari_fiberburst.plugin.stage import Stage

_WAYS = {
    "flicker": "One after the other in the same place, at the press of a button.",
    "curtain": "A left of a line, B right of it; a slider moves the line.",
    "side by side": "A left, B right; both are moved and enlarged together.",
    "difference": "A minus B: red where A is brighter, blue where B is.",
}
# Brighter differences than this part of all are shown in the strongest colour.
_STRONGEST = 99.9
_DIVERGING = Colormap([[0.13, 0.4, 0.67], [0.97, 0.97, 0.97], [0.7, 0.09, 0.17]], name="blue white red")
_TIP = Qt.ItemDataRole.ToolTipRole
# A combo box shows this many letters of a run's name at least, however narrow the dock is.
_LETTERS = 6


class CompareBox(QWidget):
    """Compares the run that is selected, A, with another, or with the burst as recorded, B.

    While it does, temporary layers stand in the viewer in place of all others. They go, and what was shown before comes
    back, when the button is released, and whenever something happens to the runs, or a layer comes or goes.

    Parameters
    ----------
    viewer : ViewerModel
        Where to.

    Attributes
    ----------
    button : QPushButton
        Down while two images are compared.
    way, other : QComboBox
        How, and what B is.
    flip : QPushButton
        Shows B while it is down, where one is shown after the other.
    line : QSlider
        The column where B begins, where there is a curtain.
    words : QLabel
        What is shown, or why there is nothing to show.
    """

    def __init__(self, viewer: ViewerModel, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        # While layers are added or deleted is no time to delete one more.
        self._soon = QTimer(self)
        self._soon.setSingleShot(True)
        self._soon.timeout.connect(self.stop)
        self._stage = Stage(viewer, self._soon.start, self.stop)
        self._a: KeptRun | None = None
        self._offered: list[tuple[KeptRun, str]] = []
        self._sides: tuple[list[Any], list[Any]] = ([], [])
        self._curtain: Curtain | None = None
        self.button, self.way, self.other = QPushButton("Compare"), QComboBox(), QComboBox()
        self.flip, self.line, self.words = QPushButton(), QSlider(Qt.Orientation.Horizontal), QLabel()
        self._lay_out()
        self._connect()
        self.offer(None, ())

    def offer(self, a: KeptRun | None, others: Sequence[KeptRun]) -> None:
        """Let A be a run, and B one of these others or the burst as recorded; ends comparing where these are new."""
        for widget in (self.button, self.way, self.other):
            widget.setEnabled(a is not None and a.result is not None)
        offered = [(run, run.name) for run in (*([] if a is None else [a]), *others)]
        if a is self._a and offered == self._offered:
            return
        self.stop()
        self._a, self._offered = a, offered
        before = self.other.currentData()
        with _quiet(self.other):
            self.other.clear()
            self.other.addItem(AS_RECORDED, None)
            self.other.setItemData(0, "The frame that the image lies over, honeycomb and all.", _TIP)
            for run in others:
                self.other.addItem(run.name, run)
            if before in others:
                self.other.setCurrentIndex(1 + others.index(before))

    def stop(self) -> None:
        """Compare no more. May be called more than once."""
        self._soon.stop()
        self._stage.clear()
        self._sides, self._curtain = ([], []), None
        with _quiet(self.button):
            self.button.setChecked(False)
        self.flip.setVisible(False)
        self.line.setVisible(False)
        self._tell("")

    def _start(self) -> None:
        """Compare what is chosen, or say why that cannot be."""
        self.stop()
        run = self._a
        if run is None:
            return
        ways: dict[str, Callable[[Side, Side], None]] = {
            "flicker": self._flicker,
            "curtain": self._draw_curtain,
            "side by side": self._put_side_by_side,
            "difference": self._subtract,
        }
        try:
            other = self.other.currentData()
            a, b = image_of(run), frame_of(run) if other is None else image_of(other)
            ways[self.way.currentText()](a, b)
        except FiberBurstError as error:
            self.stop()
            self._tell(f"Nothing to compare: {error}.")
            return
        with _quiet(self.button):
            self.button.setChecked(True)

    def _flicker(self, a: Side, b: Side) -> None:
        self._show_both(a, b)
        self.flip.setVisible(True)
        self.flip.setFocus()  # for the space bar
        with _quiet(self.flip):
            self.flip.setChecked(False)
        self._show_a_or_b(False)

    def _draw_curtain(self, a: Side, b: Side) -> None:
        self._curtain = Curtain(a, b)
        middle = self._curtain.width // 2
        self._curtain.draw(middle)
        self._stage.set_up()
        layers = self._stage.show_parts(self._curtain.parts, a, f"{a.name} | {b.name}", self._looks)
        self._sides = (layers, [])
        with _quiet(self.line):
            self.line.setRange(0, self._curtain.width)
            self.line.setValue(middle)
        self.line.setVisible(True)
        self._tell(f"left: A, {a.name}; right: B, {b.name}")

    def _put_side_by_side(self, a: Side, b: Side) -> None:
        counts = [max(1, len(side.placement.channels)) for side in (a, b)]
        if counts[0] != counts[1]:
            raise FiberBurstError(
                f"{a.name} is shown in {counts[0]} layers and {b.name} in {counts[1]}, which the grid cannot tell "
                "apart; let one flicker with the other"
            )
        self._show_both(a, b)
        self._stage.side_by_side(counts[0])
        self._tell(f"left: A, {a.name}; right: B, {b.name}")

    def _subtract(self, a: Side, b: Side) -> None:
        apart, axes = difference(a, b)
        known = np.abs(apart[np.isfinite(apart)])
        most = float(np.percentile(known, _STRONGEST)) if known.size else 0.0
        most = most or 1.0  # where nothing differs
        placed = a.placement.on_canvas(axes, a.canvas)
        layer = Image(apart, colormap=_DIVERGING, contrast_limits=(-most, most), **placed)
        self._stage.set_up()
        self._stage.show(layer, f"{a.name} - {b.name}")
        mean = " (mean of the channels)" if a.is_blended else ""
        self._tell(f"A, {a.name}, minus B, {b.name}{mean}; from {-most:.3g} (blue) to {most:.3g} (red)")

    def _show_both(self, a: Side, b: Side) -> None:
        """Add B, and A above it, both as A looks: at another contrast, the same light would look different."""
        self._stage.set_up()
        right = self._stage.show_side(b, "B", self._looks)
        self._sides = (self._stage.show_side(a, "A", self._looks), right)

    @property
    def _looks(self) -> list[Any]:
        return [] if self._a is None else self._a.layers.images

    def _show_a_or_b(self, is_b: bool) -> None:
        for layers, is_shown in zip(self._sides, (not is_b, is_b), strict=True):
            for layer in layers:
                layer.visible = is_shown
        name = self.other.currentText() if is_b else "" if self._a is None else self._a.name
        self.flip.setText(f"shown: {'B' if is_b else 'A'}, {name}")

    def _move_line(self, column: int) -> None:
        if self._curtain is not None:
            self._curtain.draw(column)
            for layer in self._sides[0]:
                layer.refresh()

    def _tell(self, words: str) -> None:
        self.words.setText(words)
        self.words.setVisible(bool(words))

    def _lay_out(self) -> None:
        self.button.setCheckable(True)
        self.button.setToolTip("Show the run selected above (A) and another image (B) alone; press again to end it.")
        self.flip.setCheckable(True)
        self.flip.setAccessibleName("show the other one")
        self.flip.setToolTip("Show the other one of the two. The space bar presses it, too.")
        self.other.setToolTip("What to compare with the run selected above.")
        self.line.setToolTip("Moves the line between A and B.")
        for number, (way, tip) in enumerate(_WAYS.items()):
            self.way.addItem(way)
            self.way.setItemData(number, tip, _TIP)
        self.way.setToolTip("How to compare:\n" + "\n".join(f"{way}: {tip}" for way, tip in _WAYS.items()))
        for widget, name in ((self.way, "way to compare"), (self.other, "image to compare with"), (self.line, "line")):
            widget.setAccessibleName(name)
        for combo in (self.way, self.other):
            combo.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
            combo.setMinimumContentsLength(_LETTERS)
        self.words.setWordWrap(True)
        self.words.setTextFormat(Qt.TextFormat.PlainText)  # with names that users have given
        row = row_of(self.button, self.way, self.other)
        row.setStretch(2, 1)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addLayout(row)
        column.addWidget(self.flip)
        column.addWidget(self.line)
        column.addWidget(self.words)

    def _connect(self) -> None:
        self.button.toggled.connect(lambda on: self._start() if on else self.stop())
        for combo in (self.way, self.other):
            combo.activated.connect(lambda _: self._start() if self._stage.is_set else self._tell(""))
        self.flip.toggled.connect(self._show_a_or_b)
        self.line.valueChanged.connect(self._move_line)
        self.destroyed.connect(self._stage.abandon)


@contextmanager
def _quiet(widget: QWidget) -> Iterator[None]:
    """Let a widget be changed as if by nobody."""
    widget.blockSignals(True)
    yield
    widget.blockSignals(False)
