"""One line that tells what is set otherwise than usual, so that nothing is remembered without a word."""

from collections.abc import Mapping
from typing import Any

from qtpy.QtCore import Signal
from qtpy.QtWidgets import QHBoxLayout, QLabel, QPushButton, QWidget

from napari_fiberburst.settings import PRESETS

# What choices that name no preset mean.
DEFAULT_PRESET = {"preset": next(iter(PRESETS))}


class Departures(QWidget):
    """Says what the form holds that is not its default, whether it is left from before, and offers the way back.

    Attributes
    ----------
    words : QLabel
        What is set otherwise.
    back_button : QPushButton
        The way back.
    """

    back_asked = Signal()

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._choices: dict[str, Any] = {}
        self._is_as_last_time = True
        self.words = QLabel()
        self.words.setWordWrap(True)
        self.back_button = QPushButton("Defaults")
        self.back_button.setToolTip("Set everything back to its default.")
        self.back_button.clicked.connect(self.back_asked)
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.addWidget(self.words, 1)
        row.addWidget(self.back_button)
        self._tell()

    def take_choices(self, choices: Mapping[str, Any], usual: Mapping[str, Any]) -> None:
        """Follow the form: what it holds, and what it would hold if nobody had touched it."""
        named = {**(DEFAULT_PRESET if "preset" in usual else {}), **choices}
        changed = {name: value for name, value in named.items() if usual.get(name) != value}
        if changed != self._choices:
            self._is_as_last_time = False
        self._choices = changed
        self._tell()

    def begin_anew(self) -> None:
        """Count what is set now as left from before, because it has not been chosen for the burst that comes."""
        self._is_as_last_time = True
        self._tell()

    def set_enabled(self, is_enabled: bool) -> None:
        """Lock or unlock the way back."""
        self.back_button.setEnabled(is_enabled)

    def _tell(self) -> None:
        named = [
            str(value) if name == "preset" else f"{name.replace('_', ' ')} {value}"
            for name, value in self._choices.items()
        ]
        self.words.setText(f"{'as last time' if self._is_as_last_time else 'set'}: {', '.join(named)}")
        self.setVisible(bool(named))
