"""The mark of a setting that is away from its default, which is also the way back."""

from typing import Any

from qtpy.QtWidgets import QComboBox, QHBoxLayout, QToolButton, QWidget

_ARROW = "↺"


class BackButton(QToolButton):
    """Is at the end of a setting's row while its value is not the default, and takes it back there.

    Parameters
    ----------
    label : str
        Of the row.
    """

    def __init__(self, label: str) -> None:
        super().__init__()
        self._label = label
        self.setText(_ARROW)
        self.setAutoRaise(True)
        self.setVisible(False)

    def compare(self, value: Any, default: Any) -> None:
        """Show or hide it, and tell which default it goes back to; None is one that is left open."""
        words = "auto" if default is None else f"{default}"
        self.setToolTip(f"Not as usual; set {self._label} back to {words}.")
        self.setAccessibleName(f"{self._label}: back to {words}")
        self.setVisible(value != default)


class ChoiceRow(QWidget):
    """A box to choose from by name, with the way back to its default.

    Parameters
    ----------
    label : str
        Of the row.

    Attributes
    ----------
    box : QComboBox
        Where it is chosen.
    back : BackButton
        Seen while something else than the default is chosen.
    """

    def __init__(self, label: str, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.box, self.back = QComboBox(), BackButton(label)
        self.box.setAccessibleName(label)
        self._default = ""
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.addWidget(self.box, 1)
        row.addWidget(self.back)
        self.back.clicked.connect(lambda: self.box.setCurrentText(self._default))

    def compare(self, default: str) -> None:
        """Mark whether something else than the default is chosen."""
        self._default = default
        self.back.compare(self.box.currentText(), default)
