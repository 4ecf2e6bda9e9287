"""One row of a form for each knob, made from the knob itself: its kind, its range, its text."""

from typing import Any

from qtpy.QtCore import Signal
from qtpy.QtGui import QValidator
from qtpy.QtWidgets import QCheckBox, QComboBox, QDoubleSpinBox, QHBoxLayout, QLineEdit, QSpinBox, QWidget

from napari_fiberburst.settings.parameter import Knob

_MOST_INTEGER = 2**31 - 1
_LARGEST = 1e9
_NARROWEST = 70


class NumberBox(QDoubleSpinBox):
    """A spin box for numbers of any size, written as one would: 0.0001, 5, 30."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.setDecimals(12)
        self.setStepType(QDoubleSpinBox.StepType.AdaptiveDecimalStepType)

    def textFromValue(self, value: float) -> str:
        """Return a number in the fewest digits that tell it."""
        return f"{value:.6g}"

    def valueFromText(self, text: str) -> float:
        """Read a number, with an exponent too."""
        try:
            return float(text)
        except ValueError:
            return self.value()

    def validate(self, text: str, position: int) -> tuple[QValidator.State, str, int]:
        """Let anything be typed that may become a number in range."""
        try:
            inside = self.minimum() <= float(text) <= self.maximum()
        except ValueError:
            inside = False
        return (QValidator.State.Acceptable if inside else QValidator.State.Intermediate), text, position


class KnobRow(QWidget):
    """The widgets for one knob; where it may be left open, with a box "auto" that says what was chosen.

    Attributes
    ----------
    knob : Knob
        What it stands for.
    """

    changed = Signal()

    def __init__(self, knob: Knob, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.knob = knob
        self._editor = _editor(knob)
        self._auto = QCheckBox("auto") if knob.optional else None
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.addWidget(self._editor, 1)
        # A spin box asks for room for the longest number it could ever show.
        self._editor.setMinimumWidth(_NARROWEST)
        if self._auto is not None:
            row.addWidget(self._auto)
            self._auto.setToolTip(f"Leave {self.label} open.")
            self._auto.toggled.connect(self._follow_auto)
        for part in (self, self._editor):
            part.setToolTip(f"{knob.doc}\n({knob.name}: {knob.expected})")
        self.set_value(knob.default)
        _changed(self._editor).connect(lambda *_: self.changed.emit())

    @property
    def label(self) -> str:
        """The knob's name in words."""
        return self.knob.name.replace("_", " ")

    @property
    def value(self) -> Any:
        """What the knob is turned to; None where it is left open."""
        if self._auto is not None and self._auto.isChecked():
            return None
        editor = self._editor
        if isinstance(editor, QCheckBox):
            return editor.isChecked()
        if isinstance(editor, QComboBox):
            return editor.currentText()
        return editor.text() if isinstance(editor, QLineEdit) else editor.value()

    def set_value(self, value: Any) -> None:
        """Turn the knob, without a signal."""
        blocked = [part for part in (self._editor, self._auto) if part is not None]
        for part in blocked:
            part.blockSignals(True)
        if self._auto is not None:
            self._auto.setChecked(value is None)
            self._editor.setEnabled(value is not None)
            self._auto.setText("auto")
        if value is not None:
            _set(self._editor, value)
        for part in blocked:
            part.blockSignals(False)

    def allow_open(self, is_allowed: bool) -> None:
        """Offer to leave the knob open, or not where the preset has a value of its own."""
        if self._auto is not None:
            self._auto.setVisible(is_allowed)

    def show_chosen(self, value: Any) -> None:
        """Say what an open knob has come to in a run."""
        if self._auto is None or not self._auto.isChecked():
            return
        number = f"{value:.3g}" if isinstance(value, float) else f"{value}"
        self._auto.setText("auto" if value is None else f"auto ({number})")
        if value is not None:
            self._editor.blockSignals(True)
            _set(self._editor, value)
            self._editor.blockSignals(False)

    def _follow_auto(self, is_auto: bool) -> None:
        self._editor.setEnabled(not is_auto)
        self._auto.setText("auto")
        self.changed.emit()


def _editor(knob: Knob) -> QWidget:
    if knob.choices:
        box = QComboBox()
        box.addItems(knob.choices)
        return box
    if knob.kind is bool:
        return QCheckBox()
    if knob.kind is str:
        return QLineEdit()
    number = QSpinBox() if knob.kind is int else NumberBox()
    least = knob.least if knob.least is not None else (1e-12 if knob.above == 0 else knob.above or -_LARGEST)
    most = knob.most if knob.most is not None else _LARGEST
    if knob.kind is int:
        number.setStepType(QSpinBox.StepType.AdaptiveDecimalStepType)
        least, most = int(least), int(min(most, _MOST_INTEGER))
    number.setRange(least, most)
    number.setKeyboardTracking(False)
    if knob.default is None:
        number.setValue(_START.get(knob.name, 1))
    return number


# What an open knob shows before a run has chosen.
_START = {"iterations": 1000, "time_budget": 60, "sigma": 5, "learning_rate": 1e-3, "batch": 8192, "smoothness": 0.01}


def _set(editor: QWidget, value: Any) -> None:
    if isinstance(editor, QCheckBox):
        editor.setChecked(value)
    elif isinstance(editor, QComboBox):
        editor.setCurrentText(value)
    elif isinstance(editor, QLineEdit):
        editor.setText(value)
    else:
        editor.setValue(value)


def _changed(editor: QWidget) -> Any:
    if isinstance(editor, QCheckBox):
        return editor.toggled
    if isinstance(editor, QComboBox):
        return editor.currentTextChanged
    return editor.editingFinished if isinstance(editor, QLineEdit) else editor.valueChanged
