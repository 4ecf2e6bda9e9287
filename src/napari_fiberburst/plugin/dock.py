"""The dock widget "Fiber burst reconstruction"."""

from typing import TYPE_CHECKING

from qtpy.QtCore import QEvent, QSize
from qtpy.QtWidgets import QTabBar, QVBoxLayout, QWidget

from napari_fiberburst.plugin.commands import KeyHints, bind_keys
from napari_fiberburst.plugin.empty import EmptyBox
from napari_fiberburst.plugin.glance_box import GlanceBox
from napari_fiberburst.plugin.input_box import InputBox
from napari_fiberburst.plugin.pickers import WheelFilter
from napari_fiberburst.plugin.sections import Column, order_tabs
from napari_fiberburst.plugin.tasks import TASKS
from napari_fiberburst.plugin.tasks.live import LiveTask
from napari_fiberburst.plugin.tasks.picture import PictureTask
from napari_fiberburst.plugin.tasks.task import Task

if TYPE_CHECKING:
    import napari
    from napari.layers import Layer

_WIDTH = 350


class FiberBurstWidget(QWidget):
    """Load a burst, choose what to do with it, and watch that happen.

    Parameters
    ----------
    viewer : napari.viewer.Viewer
        Whose layers are worked on, and where the results go.

    Attributes
    ----------
    empty : EmptyBox
        What is shown while there is no burst.
    input : InputBox
        The burst that is chosen.
    glance : GlanceBox
        What is seen of it.
    tasks : tuple of Task
        What can be done with it, one of `napari_fiberburst.plugin.tasks.TASKS` each.
    task_bar : QTabBar
        Chooses the one that is shown.
    """

    def __init__(self, viewer: "napari.viewer.Viewer", parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._was_docked = False
        self.empty, self.filled = EmptyBox(viewer), QWidget()
        self.input = InputBox(viewer)
        self.glance = GlanceBox(self.input)
        self.tasks = tuple(kind(viewer, self.input) for kind in TASKS)
        self.task_bar = QTabBar()
        self._lay_out()
        self.task_bar.currentChanged.connect(self._show_task)
        self.input.changed.connect(self._show_or_invite)
        for task in self.tasks:
            task.kept_changed.connect(self._show_or_invite)
        self.input.burst_button.clicked.connect(self.empty.ask_for_file)
        self.empty.busy_changed.connect(self.input.burst_button.setDisabled)
        self.empty.opened.connect(lambda layers: self._take_opened(layers[0]))
        self.empty.live_button.clicked.connect(lambda: self.choose_task(LiveTask))
        self.live.burst_kept.connect(self._take_kept)
        bind_keys()
        KeyHints(self)
        self._show_task(0)

    @property
    def picture(self) -> PictureTask:
        """The task that reconstructs, which commands of the Layers menu start."""
        return next(task for task in self.tasks if isinstance(task, PictureTask))

    @property
    def live(self) -> LiveTask:
        """The task that shows a camera."""
        return next(task for task in self.tasks if isinstance(task, LiveTask))

    @property
    def task(self) -> Task:
        """The task that is shown."""
        return self.tasks[self.task_bar.currentIndex()]

    def choose_task(self, kind: type[Task]) -> None:
        """Show the task of a kind."""
        self.task_bar.setCurrentIndex(TASKS.index(kind))

    def start_on(self, layer: "Layer", show: str = "image") -> None:
        """Reconstruct a layer with the form as it is, and show the image or the stabilised burst in the end."""
        self.choose_task(PictureTask)
        self.picture.start_on(layer, show)

    def shut_down(self) -> None:
        """Stop what is running and let go of the viewer. May be called more than once."""
        for task in self.tasks:
            task.shut_down()

    def reset_choices(self) -> None:
        """Follow the viewer's layers; napari calls this when one is added, removed, moved or renamed."""
        self.input.reset_choices()
        self.live.source.layer.reset_choices()

    def sizeHint(self) -> QSize:
        """Ask for a narrow dock: the image is what matters."""
        return QSize(_WIDTH, super().sizeHint().height())

    def event(self, event: QEvent | None) -> bool:
        """Notice when the dock is closed for good: napari takes the widget out of it, and does not delete it."""
        if event is not None and event.type() == QEvent.Type.ParentChange:
            if self.parent() is None and self._was_docked:
                self.shut_down()
            elif self.parent() is not None:
                self.reset_choices()
                for task in self.tasks:
                    task.open()
            self._was_docked = self.parent() is not None
        return super().event(event)

    def _take_opened(self, layer: "Layer") -> None:
        """Choose what has been opened as the burst."""
        self.reset_choices()
        if layer in self.input.burst.choices:
            self.input.burst.value = layer

    def _take_kept(self, layer: "Layer") -> None:
        """Go on with frames that were kept of a live view."""
        self._take_opened(layer)
        self.choose_task(PictureTask)

    def _show_task(self, number: int) -> None:
        for task in self.tasks:
            task.setVisible(task is self.tasks[number])
        shown = self.tasks[number]
        self.input.set_wanted(is_burst_wanted=shown.needs_burst, are_frames_wanted=shown.needs_frames)
        self.glance.setVisible(shown.needs_burst)
        self._show_or_invite()

    def _show_or_invite(self) -> None:
        """Show what can be done with a burst, and what is kept of runs; offer to open one where it is missing."""
        is_without = self.task.needs_frames and self.input.burst.value is None
        self.empty.setVisible(is_without)
        self.filled.setVisible(not is_without or not all(task.is_empty for task in self.tasks))
        self.glance.set_brief(is_brief=not self.picture.is_empty)

    def _lay_out(self) -> None:
        for number, task in enumerate(self.tasks):
            self.task_bar.addTab(task.title)
            self.task_bar.setTabToolTip(number, task.tip)
        self.task_bar.setAccessibleName("task")
        content = QWidget()
        whole = QVBoxLayout(content)
        whole.addWidget(self.empty)
        whole.addWidget(self.filled)
        whole.addStretch(1)
        column = QVBoxLayout(self.filled)
        column.setContentsMargins(0, 0, 0, 0)
        for widget in (self.task_bar, self.input, self.glance, *self.tasks):
            column.addWidget(widget)
        scroll = Column(content, self.picture.runs)
        WheelFilter(scroll)
        order_tabs(content)
        around = QVBoxLayout(self)
        around.setContentsMargins(0, 0, 0, 0)
        around.addWidget(scroll)
