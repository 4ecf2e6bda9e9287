"""What each task of the dock has in common."""

from typing import TYPE_CHECKING, ClassVar

from qtpy.QtCore import Signal
from qtpy.QtWidgets import QPushButton, QWidget

from napari_fiberburst.plugin.input_box import InputBox

if TYPE_CHECKING:
    import napari

_FIRST_THING_TO_PRESS = "QPushButton:enabled { background-color: #2f6fd0; color: white; font-weight: bold; }"


class Task(QWidget):
    """One thing that can be done with a burst: a few settings, a button that starts it, and what comes of it.

    The dock shows the burst that is chosen above it. A class that is added to `napari_fiberburst.plugin.tasks.TASKS`
    is offered in the dock.

    Parameters
    ----------
    viewer : napari.viewer.Viewer
        Whose layers are worked on, and where what comes of it goes.
    source : InputBox
        What is chosen; every task has the same.

    Attributes
    ----------
    title, tip : str
        How the task is called, and what it does.
    needs_burst : bool
        Whether it works on a burst, some frames of a recording; or else on all of it.
    needs_frames : bool
        Whether it works on frames that have been opened; or else it gets its own.
    start_button : QPushButton
        Starts it, in another thread.
    """

    needs_burst: ClassVar[bool] = True
    needs_frames: ClassVar[bool] = True
    title: ClassVar[str]
    tip: ClassVar[str]
    kept_changed = Signal()  # whether `is_empty` may have

    def __init__(self, viewer: "napari.viewer.Viewer", source: InputBox, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._viewer = viewer
        self.input = source
        self.start_button = QPushButton("Start")
        self.start_button.setStyleSheet(_FIRST_THING_TO_PRESS)

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to show of it once the burst is gone."""
        return True

    def open(self) -> None:
        """Follow the viewer, again where the dock was closed."""

    def shut_down(self) -> None:
        """Stop what is running and let go of the viewer, because the dock is closed. May be called more than once."""
