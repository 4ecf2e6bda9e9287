"""On the result card: how smooth the scene is, and which frames it is made from."""

import math
from typing import TYPE_CHECKING

from napari.utils.notifications import show_info
from qtpy.QtCore import Qt, Signal
from qtpy.QtWidgets import QLabel, QLineEdit, QPushButton, QSlider, QVBoxLayout, QWidget

from napari_fiberburst.plugin.kept_run import KeptRun
from napari_fiberburst.plugin.picking import FramePicker
from napari_fiberburst.plugin.sections import row_of
from napari_fiberburst.plugin.turning import Turn, Turning, with_frame

if TYPE_CHECKING:
    from napari.components import ViewerModel

_SPACING = 2
# The slider has so many steps to a factor of ten, from the least to the most smoothness that is of use.
_STEPS_PER_DECADE, _LEAST, _MOST = 20, 1e-4, 1e2


class SteeringBox(QWidget):
    """Turns the smoothness of the run that is shown, and leaves frames out; the picture follows.

    Parameters
    ----------
    viewer : ViewerModel
        Whose slider tells the frame, and where an outline can be clicked.

    Attributes
    ----------
    slider : QSlider
        Smoothness, on a logarithmic scale.
    value : QLabel
        The same as a number.
    back_button : QPushButton
        Goes back to what the run had come to.
    frames : QLineEdit
        The frames left out.
    frame_button : QPushButton
        Leaves out the frame at the viewer's slider, or takes it in again.
    """

    changed = Signal(object)  # a KeptRun that shows something else now

    def __init__(self, viewer: "ViewerModel", parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._viewer = viewer
        self._run: KeptRun | None = None
        self._turnings: dict[KeptRun, Turning] = {}
        self._picker = FramePicker(viewer, self._toggle_picked)
        self.slider, self.value = QSlider(Qt.Orientation.Horizontal), QLabel()
        self.back_button = QPushButton("As chosen")
        self.frames, self.frame_button = QLineEdit(), QPushButton()
        self._frames_row = QWidget()
        self._lay_out()
        self.slider.valueChanged.connect(self._take_slider)
        self.back_button.clicked.connect(self._go_back)
        self.frames.editingFinished.connect(self._take_frames)
        self.frame_button.clicked.connect(self._toggle_at_slider)
        self.show_run(None)

    def open(self) -> None:
        """Follow the viewer's slider and clicks on outlines, again where it was shut."""
        self._viewer.dims.events.current_step.connect(self._name_frame)
        self._picker.open()

    def shut(self) -> None:
        """Follow the viewer no more. May be called more than once."""
        self._viewer.dims.events.current_step.disconnect(self._name_frame)
        self._picker.shut()

    def show_run(self, run: KeptRun | None) -> None:
        """Turn another run from now on."""
        turning = self._turning
        if turning is not None and run is not self._run:
            turning.rest()
        self._run = run
        for gone in [kept for kept in self._turnings if kept.layers.is_removed]:
            self._turnings.pop(gone).deleteLater()
        self.refresh()

    @property
    def is_pending(self) -> bool:
        """Whether what is shown has been turned, and is not judged yet."""
        turning = self._turning
        return turning is not None and turning.run.result is None

    def refresh(self) -> None:
        """Show how the run is turned."""
        turning = self._turning
        self.setVisible(turning is not None)
        self._picker.follow(None if turning is None else turning.run)
        if turning is None:
            for button in (self.back_button, self.frame_button):  # keys press them where they are not seen
                button.setEnabled(False)
            return
        self.slider.blockSignals(True)
        self.slider.setValue(round(_STEPS_PER_DECADE * math.log10(turning.smoothness)))
        self.slider.blockSignals(False)
        self.value.setText(f"{turning.smoothness:.2g}")
        self.back_button.setEnabled(turning.asked != turning.as_chosen)
        if not self.frames.isModified():  # nobody is typing
            self.frames.setText(", ".join(map(str, turning.asked.leave_out)))
        self._frames_row.setVisible("T" in turning.run.layers.placement.axes)
        self._name_frame()

    @property
    def _turning(self) -> Turning | None:
        """What turns the run that is shown; None where there is nothing to turn."""
        run = self._run
        if run is None:
            return None
        if run not in self._turnings and run.result is not None and run.result.solver is not None:
            self._turnings[run] = turning = Turning(run, self)
            turning.changed.connect(self._tell)
        return self._turnings.get(run)

    def _tell(self, run: KeptRun) -> None:
        if run is self._run:
            self.refresh()
        self.changed.emit(run)

    def _take_slider(self, step: int) -> None:
        turning = self._turning
        if turning is not None:
            smoothness = float(f"{10 ** (step / _STEPS_PER_DECADE):.2g}")
            turning.turn(Turn(smoothness=smoothness, leave_out=turning.asked.leave_out))

    def _go_back(self) -> None:
        turning = self._turning
        if turning is not None:
            turning.turn(turning.as_chosen)

    def _take_frames(self) -> None:
        """Leave out what was typed; what is no frame is passed over, and one frame at least stays in."""
        turning = self._turning
        if turning is None:
            return
        words = self.frames.text().replace(",", " ").split()
        typed = {int(word) for word in words if word.isdecimal() and int(word) < turning.count}
        self.frames.setModified(False)
        self._leave_out(turning, tuple(sorted(typed)))

    def _toggle_at_slider(self) -> None:
        frame = self._frame
        if frame is not None:
            self._toggle(frame)

    def _toggle_picked(self, frame: int) -> None:
        self._toggle(frame)
        turning = self._turning
        if turning is not None:
            is_out = frame in turning.asked.leave_out
            self._viewer.status = f"frame {frame} is {'left out' if is_out else 'taken in again'}"

    def _toggle(self, frame: int) -> None:
        turning = self._turning
        if turning is not None:
            self._leave_out(turning, with_frame(turning.asked, frame).leave_out)

    def _leave_out(self, turning: Turning, frames: tuple[int, ...]) -> None:
        if turning.run.layers.would_leave_some(frames):
            turning.turn(Turn(smoothness=turning.asked.smoothness, leave_out=frames))
        else:
            show_info("one frame that was registered has to take part, at least; take another one in first")
        self.refresh()

    @property
    def _frame(self) -> int | None:
        """The frame at the viewer's slider."""
        return None if self._run is None else self._run.layers.placement.frame_at(self._viewer.dims.point)

    def _name_frame(self, event: object = None) -> None:
        turning, frame = self._turning, self._frame
        is_out = turning is not None and frame in turning.asked.leave_out
        number = "" if frame is None else f" {frame}"
        self.frame_button.setText(f"Take in frame{number}" if is_out else f"Leave out frame{number}")
        self.frame_button.setEnabled(turning is not None and frame is not None)

    def _lay_out(self) -> None:
        self.slider.setRange(*(round(_STEPS_PER_DECADE * math.log10(value)) for value in (_LEAST, _MOST)))
        self.slider.setPageStep(_STEPS_PER_DECADE // 4)
        tip = "Turns how smooth the scene is: left is sharper and noisier, right is smoother. The picture follows."
        for widget, name, words in (
            (self.slider, "smoothness", tip),
            (self.value, "smoothness as a number", "Weight of the smoothness prior."),
            (self.back_button, "as chosen", "Goes back to what the run had come to, with all of its frames."),
            (self.frames, "frames left out", "Numbers of frames that the image is made without, such as 3, 7."),
            (
                self.frame_button,
                "leave out or take in the frame at the slider",
                "Makes the image without the frame at the viewer's slider, or with it again. With outlines shown, "
                "Ctrl + click (Cmd on a Mac) inside one does the same.",
            ),
        ):
            widget.setToolTip(words)
            widget.setAccessibleName(name)
        self.value.setMinimumWidth(self.fontMetrics().horizontalAdvance("0.00012"))
        self.frames.setPlaceholderText("none")
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(_SPACING)
        column.addLayout(row_of(QLabel("smoothness"), self.slider, self.value, self.back_button))
        frames = row_of(QLabel("left out"), self.frames, self.frame_button)
        frames.setContentsMargins(0, 0, 0, 0)
        self._frames_row.setLayout(frames)
        column.addWidget(self._frames_row)
