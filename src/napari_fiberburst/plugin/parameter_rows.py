"""One row of a form for each parameter. magicgui makes the editor from the parameter's kind, range and choices."""

import sys
from typing import Any

from magicgui.backends._qtpy.widgets import QBaseRangedWidget
from magicgui.widgets import create_widget
from magicgui.widgets.bases import RangedWidget, ValueWidget
from qtpy.QtCore import Signal
from qtpy.QtGui import QValidator
from qtpy.QtWidgets import QAbstractSpinBox, QCheckBox, QDoubleSpinBox, QHBoxLayout, QWidget

from napari_fiberburst.plugin.back import BackButton
from napari_fiberburst.settings.parameter import Parameter

# A bound for numbers that have none, and the least number that counts as above 0.
_LARGEST_FLOAT, _LARGEST_INTEGER, _LEAST_ABOVE_ZERO = sys.float_info.max, 2**63 - 1, 1e-12
_NARROWEST = 70
# What an open parameter shows before a run has chosen.
_START = {"iterations": 1000, "time_budget": 60, "sigma": 5, "learning_rate": 1e-3, "batch": 8192, "smoothness": 0.01}


class NumberBox(QDoubleSpinBox):
    """A spin box for numbers of any size, written as one would: 0.0001, 5, 30."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.setDecimals(12)

    def textFromValue(self, value: float) -> str:
        """Return a number in as few digits as it needs, at most six."""
        return f"{value:.6g}"

    def valueFromText(self, text: str | None) -> float:
        """Read a number, with an exponent too."""
        try:
            return float(text or "")
        except ValueError:
            return self.value()

    def validate(self, text: str | None, position: int) -> tuple[QValidator.State, str, int]:
        """Let anything be typed that may become a number in range."""
        try:
            inside = self.minimum() <= float(text or "") <= self.maximum()
        except ValueError:
            inside = False
        return (QValidator.State.Acceptable if inside else QValidator.State.Intermediate), text or "", position


class _NumberBackend(QBaseRangedWidget):
    """What magicgui needs of a spin box, around ours: its own shows a fixed number of decimals and no exponents."""

    def __init__(self, **options: Any) -> None:
        super().__init__(NumberBox, **options)


class NumberEditor(RangedWidget[float]):
    """magicgui's float spin box with numbers written as one would."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**{**options, "widget_type": _NumberBackend})


class ParameterRow(QWidget):
    """The editor for one parameter. Where the parameter may be left open, a box "auto" says what was chosen.

    Attributes
    ----------
    parameter : Parameter
        What it stands for.
    editor : magicgui.widgets.bases.ValueWidget
        Shows and changes the value.
    auto : QCheckBox or None
        Checked where the parameter is left open; None where it cannot be.
    back : BackButton
        Seen while the value is not the default.
    """

    changed = Signal()

    def __init__(self, parameter: Parameter, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.parameter = parameter
        self.editor = _editor(parameter)
        self.auto = QCheckBox("auto") if parameter.optional else None
        self.back = BackButton(self.label)
        self._default = parameter.default
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.addWidget(self.editor.native, 1)
        if self.auto is not None:
            row.addWidget(self.auto)
            self.auto.setToolTip(f"Leave {self.label} open.")
            self.auto.setAccessibleName(f"{self.label}: auto")
            self.auto.toggled.connect(self._follow_auto)
        row.addWidget(self.back)
        self.back.clicked.connect(self._go_back)
        self.editor.native.setAccessibleName(self.label)
        for part in (self, self.editor.native):
            part.setToolTip(f"{parameter.doc}\n({parameter.name}: {parameter.expected})")
        self.set_value(parameter.default)
        self.editor.changed.connect(lambda _: self.changed.emit())

    @property
    def label(self) -> str:
        """The parameter's name in words."""
        return self.parameter.name.replace("_", " ")

    @property
    def value(self) -> Any:
        """The parameter's value; None where it is left open."""
        return None if self.auto is not None and self.auto.isChecked() else self.editor.value

    def set_value(self, value: Any) -> None:
        """Turn the parameter, without a signal."""
        if self.auto is not None:
            self.auto.blockSignals(True)
            self.auto.setChecked(value is None)
            self.auto.setText("auto")
            self.auto.blockSignals(False)
            self.editor.enabled = value is not None
        if value is not None:
            self._show(value)

    def allow_open(self, is_allowed: bool) -> None:
        """Offer to leave the parameter open, or not where the preset has a value of its own."""
        if self.auto is not None:
            self.auto.setVisible(is_allowed)

    def compare(self, default: Any) -> None:
        """Mark whether the value is another one than the default."""
        self._default = default
        self.back.compare(self.value, default)

    def show_chosen(self, value: Any) -> None:
        """Say which value a run has chosen for an open parameter."""
        if self.auto is None or not self.auto.isChecked():
            return
        number = f"{value:.3g}" if isinstance(value, float) else f"{value}"
        self.auto.setText("auto" if value is None else f"auto ({number})")
        if value is not None:
            self._show(value)

    def _go_back(self) -> None:
        self.set_value(self._default)
        self.changed.emit()

    def _show(self, value: Any) -> None:
        if isinstance(self.editor, RangedWidget):  # magicgui refuses what is out of range
            value = min(max(value, self.editor.min), self.editor.max)
        with self.editor.changed.blocked():
            self.editor.value = value

    def _follow_auto(self, is_auto: bool) -> None:
        self.editor.enabled = not is_auto
        if self.auto is not None:
            self.auto.setText("auto")
        self.changed.emit()


def _editor(parameter: Parameter) -> ValueWidget[Any]:
    """Return an editor for what a parameter allows but None, which magicgui's ranged widgets do not take."""
    if parameter.choices:
        editor = create_widget(widget_type="ComboBox", options={"choices": parameter.choices})
    elif parameter.kind in (int, float):
        start = _START.get(parameter.name, 1) if parameter.default is None else parameter.default
        editor = create_widget(
            start,
            widget_type=NumberEditor if parameter.kind is float else "SpinBox",  # type: ignore[arg-type]
            options=_range(parameter),
        )
    else:
        editor = create_widget(annotation=parameter.kind)
    assert isinstance(editor, ValueWidget)
    if isinstance(editor.native, QAbstractSpinBox):
        editor.native.setKeyboardTracking(False)
    # A spin box asks for room for the longest number that it could ever show.
    editor.native.setMinimumWidth(_NARROWEST)
    return editor


def _range(parameter: Parameter) -> dict[str, float]:
    """Return magicgui's inclusive bounds of a number."""
    largest = _LARGEST_INTEGER if parameter.kind is int else _LARGEST_FLOAT
    least = parameter.least if parameter.least is not None else parameter.above
    if least == 0 and parameter.above is not None:
        least = _LEAST_ABOVE_ZERO
    return {"min": -largest if least is None else least, "max": largest if parameter.most is None else parameter.most}
