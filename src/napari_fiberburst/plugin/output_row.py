"""Where the result of long work is written, with a place suggested beside the recording."""

from collections.abc import Collection
from itertools import count
from pathlib import Path

from napari.layers import Layer
from qtpy.QtCore import Signal
from qtpy.QtWidgets import QFileDialog, QLineEdit, QPushButton, QWidget

from napari_fiberburst.plugin import METADATA_KEY
from napari_fiberburst.plugin.sections import row_of

ENDING = ".ome.zarr"


class OutputRow(QWidget):
    """A path, and a button to choose another one.

    Parameters
    ----------
    kind : str
        What is written: "mosaic" or "video".

    Attributes
    ----------
    edit : QLineEdit
        The path.
    """

    changed = Signal()

    def __init__(self, kind: str, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._kind = kind
        self._suggested = ""
        self.edit, self.button = QLineEdit(), QPushButton("…")
        self.edit.setAccessibleName(f"where the {kind} is written")
        self.edit.setToolTip(f"A folder ending in {ENDING}, an OME-Zarr image that other programs open too.")
        self.button.setAccessibleName(f"choose where the {kind} is written")
        self.button.setToolTip("Choose another place.")
        self.button.setFixedWidth(self.button.sizeHint().height() + 8)
        row = row_of(self.edit, self.button)
        row.setContentsMargins(0, 0, 0, 0)
        row.setStretch(0, 1)
        self.setLayout(row)
        self.edit.textChanged.connect(lambda _: self.changed.emit())
        self.button.clicked.connect(self._ask)

    @property
    def path(self) -> Path:
        """The path that is written to."""
        return Path(self.edit.text().strip()).expanduser()

    @property
    def is_own(self) -> bool:
        """Whether a user has chosen the path."""
        return self.edit.text() != self._suggested

    def suggest(self, near: Path) -> None:
        """Suggest a free name, or one where work was begun, beside a recording; a user's own path stays."""
        if not self.is_own:
            self.suggest_free(near, may_go_on=True)

    def suggest_free(self, near: Path, *, may_go_on: bool = False, but_not: Collection[Path] = ()) -> None:
        """Put a name that is free into the row, or, where that is wanted, one where work was begun."""
        for number in count(1):
            # No "-2", because that is how further pieces of one mosaic are called.
            stem = f"{near.name}-{self._kind}{number if number > 1 else ''}"
            path = near.with_name(stem + ENDING)
            is_begun = work_of(path).exists()
            if path in but_not:
                continue
            if (is_begun and may_go_on) or not (is_begun or path.exists()):
                break
        self._suggested = str(path)
        self.edit.setText(self._suggested)
        self.edit.setCursorPosition(len(self._suggested))

    def _ask(self) -> None:
        path, _ = QFileDialog.getSaveFileName(self, f"Where the {self._kind} is written", self.edit.text())
        if path:
            self.edit.setText(path if path.endswith(ENDING) else path + ENDING)


def work_of(path: Path) -> Path:
    """Return the folder that keeps the work on an output that is not done yet."""
    return path.with_name(path.name.removesuffix(ENDING) + ".work")


def stem_of(path: Path) -> Path:
    """Return a file's path without its ending, or both of its endings where the second is .ome."""
    stem = path.with_suffix("") if path.suffix else path
    return stem.with_suffix("") if stem.suffix == ".ome" else stem


def opened_from(layer: Layer) -> list[Path]:
    """Return the full paths of what a layer was opened from; none where it was made here."""
    found = layer.metadata.get(METADATA_KEY, {}).get("recording_path") or layer.source.path or []
    return [Path(path).absolute() for path in ([found] if isinstance(found, str | Path) else found)]


def near(layer: Layer) -> Path:
    """Return the path beside which what comes of a layer is written, without an ending."""
    paths = opened_from(layer)
    if paths:
        return stem_of(paths[0])
    return Path.home() / "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in layer.name)
