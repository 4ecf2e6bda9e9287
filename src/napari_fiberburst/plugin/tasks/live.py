"""The picture while the probe is held: sharper with every frame, with a light that says what to do."""

import atexit
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from napari.layers import Layer
from napari.utils.notifications import show_error
from qtpy.QtCore import Qt, QTimer, Signal
from qtpy.QtWidgets import QCheckBox, QFileDialog, QLabel, QPushButton, QSpinBox, QVBoxLayout, QWidget
from superqt.utils import create_worker

from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.plugin.contributions import LayerData, read
from napari_fiberburst.plugin.input_box import InputBox
from napari_fiberburst.plugin.live_job import LiveJob, Shown
from napari_fiberburst.plugin.live_layers import LiveLayers
from napari_fiberburst.plugin.live_source_row import LiveSourceRow
from napari_fiberburst.plugin.pace import Pace
from napari_fiberburst.plugin.problems import why
from napari_fiberburst.plugin.sections import form_layout, row_of
from napari_fiberburst.plugin.tasks.task import Task

if TYPE_CHECKING:
    import napari

    from napari_fiberburst.live.sources import Latest

State = Literal["ready", "starting", "live", "frozen"]
_MILLISECONDS = 30
# Part of the time that drawing may take where that is done in software; numbers that change faster cannot be read.
_SHARE, _SECONDS_BETWEEN_NUMBERS = 0.25, 0.5
# A camera that gives nothing for so many seconds has stopped.
_SILENT = 2.0
_LONGEST, _USUAL = 600, 10
_GREEN, _YELLOW, _RED, _GREY = "#3fa34d", "#e0b020", "#d04a3a", "#808080"
# What the light shows, and says, at each advice of the engine.
_LIGHTS = {
    "fine": (_GREEN, "Good"),
    "wait": (_YELLOW, "Learning the bundle: move a little over the object"),
    "move a little": (_YELLOW, "Move a little: gaps between the cores are not seen yet"),
    "hold still": (_YELLOW, "Hold still, or move slower: the picture smears while it is exposed"),
    "too fast": (_RED, "Too fast: move slower"),
    "out of contact": (_RED, "Out of contact: touch the object, or focus"),
    "too bright": (_RED, "Too bright: lower the light or the exposure"),
    "another bundle": (_RED, "These frames show another bundle: choose its own, or none"),
    "the bundle has moved": (_YELLOW, "The bundle has moved on the camera, and is followed"),
    "the camera has stopped": (_RED, "The camera has stopped: all frames are alike"),
}


class LiveTask(Task):
    """Shows what `napari_fiberburst.live.LiveEngine` makes of a camera, while it runs.

    Attributes
    ----------
    source : LiveSourceRow
        Where frames come from.
    seconds : QSpinBox
        For how long raw frames are kept.
    mosaic : QCheckBox
        Whether pictures are pasted together.
    pause_button : QPushButton
        Freezes the picture, or lets it go on.
    stop_button, keep_button : QPushButton
        Ends; and makes a burst of the frames of the last seconds.
    light, words, numbers : QLabel
        What to do, in colour and in words; and how it goes.
    state : str
        "ready", "starting", "live" or "frozen".
    rate, lag : float
        Pictures a second that are made, and seconds from a frame to its picture.
    """

    needs_burst: ClassVar[bool] = False
    needs_frames: ClassVar[bool] = False
    title: ClassVar[str] = "Live"
    tip: ClassVar[str] = "See the picture while the probe is held, sharper with every frame."
    burst_kept = Signal(object)  # the layer

    def __init__(self, viewer: "napari.viewer.Viewer", source: InputBox, parent: QWidget | None = None) -> None:
        super().__init__(viewer, source, parent)
        self.state: State = "ready"
        self._jobs: list[LiveJob] = []  # none, or the one that is
        self._kept_of: LiveJob | None = None
        self._frozen: Latest | None = None
        self._is_learning = False
        self._told = self.rate = self.lag = 0.0
        self._drawing: tuple[float, float] | None = None  # when the last picture was begun, and given to napari
        self._layers: LiveLayers | None = None
        self._source_layer: Layer | None = None
        self._images = Pace(_SHARE)
        self.source = LiveSourceRow(viewer)
        self.seconds, self.mosaic = QSpinBox(), QCheckBox("mosaic")
        self.pause_button, self.stop_button = QPushButton("Freeze"), QPushButton("Stop")
        self.keep_button = QPushButton("Keep as a burst…")
        self.light, self.words, self.numbers = QLabel(), QLabel(), QLabel()
        self._timer = QTimer(self)
        self._timer.setInterval(_MILLISECONDS)
        self._lay_out()
        self._connect()
        self._follow_state("ready")
        self._tell(_GREY, self.tip)

    @property
    def job(self) -> LiveJob | None:
        """The view that is live."""
        return self._jobs[0] if self._jobs else None

    @property
    def is_empty(self) -> bool:
        """Whether nothing is live, and no frames are kept."""
        return self.job is None and self._kept_of is None

    def start(self) -> None:
        """Begin. Does nothing while it is live."""
        if self.job is not None:
            return
        try:
            opener, given = self.source.opener(), self.input.bundle_source()
        except FiberBurstError as error:
            self._tell(_RED, str(error))
            show_error(str(error))
            return
        self._source_layer = self.source.source_layer
        self._layers = LiveLayers(self._viewer, self._source_layer)
        job = LiveJob(opener, None if given is None else given.given, float(self.seconds.value()))
        job.wants_mosaic = self.mosaic.isChecked()
        self._jobs.append(job)
        self._kept_of, self._frozen, self._drawing, self._is_learning = job, None, None, False
        self._images = Pace(_SHARE)
        atexit.register(job.stop)
        self._follow_state("starting")
        self._tell(_YELLOW, "Starting")
        create_worker(job.run, _connect={"finished": partial(self._end, job)})
        self._timer.start()
        self.kept_changed.emit()

    def freeze(self) -> None:
        """Hold the picture, and the frames before it, or go on."""
        if self.job is not None and self.state == "live":
            self._frozen = self.job.last(self.seconds.value())
            self._follow_state("frozen")
        elif self.job is not None and self.state == "frozen":
            self._frozen = None
            self._follow_state("live")

    def stop(self) -> None:
        """End; the frames of the last seconds stay until the next start."""
        if self.job is not None:
            self.job.stop()

    def keep(self, path: str | Path, frames: "Latest | None" = None) -> None:
        """Write the frames of the last seconds as OME-TIFF, and choose them as the burst; in another thread."""
        frames = frames or self._frames_to_keep()
        if frames is None:
            return
        create_worker(
            _written_and_read,
            Path(path),
            frames,
            self._source_layer,
            _connect={"returned": self._take_burst, "errored": self._take_error},
            _ignore_errors=True,
        )

    def shut_down(self) -> None:
        """Stop what is live and let go of it. May be called more than once."""
        self._timer.stop()
        _let_go(self._jobs)
        self._kept_of = self._frozen = None
        self._follow_state("ready")

    def _end(self, job: LiveJob) -> None:
        atexit.unregister(job.stop)
        if job is not self.job:
            return  # the dock has been closed
        self._look()
        self._timer.stop()
        self._jobs.clear()
        if job.problem:
            self._tell(_RED, job.problem)
            show_error(job.problem)
        elif self._is_learning and not job.is_stopped:
            self._tell(_RED, "The source ended before the bundle was learned: choose a bundle, or a longer recording.")
        else:
            self._tell(_GREY, "Stopped. The frames of the last seconds can still be kept.")
        self._follow_state("ready")
        self.kept_changed.emit()

    def _look(self) -> None:
        """Show what is new."""
        job, layers = self.job, self._layers
        if job is None or layers is None:
            return
        if layers.is_removed or (self._source_layer is not None and self._source_layer not in self._viewer.layers):
            job.stop()
            return
        job.wants_mosaic = self.mosaic.isChecked()
        began = time.perf_counter()
        self._note_drawing(began)
        if not self._images.is_due(began):
            return
        shown = job.shown.take()
        if shown is None:
            silent = job.is_waiting
            if silent is not None and silent > _SILENT:
                self._tell(_RED, f"No frame has come for {silent:.0f} s: does the camera run?")
            return
        if self.state == "starting":
            self._follow_state("live")
        if self.state == "frozen":
            return
        layers.show(shown.watched.view, in_mosaic=self.mosaic.isChecked())
        pasted = job.pasted.take()
        if pasted is not None and self.mosaic.isChecked():
            layers.paste(pasted)
        self._drawing = began, time.perf_counter()
        self._is_learning = shown.watched.view.state == "calibrating"
        self.rate, self.lag = shown.rate, shown.watched.lag
        self._tell(*_LIGHTS[shown.watched.view.advice])
        if began - self._told > _SECONDS_BETWEEN_NUMBERS:
            self._told = began
            note = "; the mosaic is full" if pasted is not None and pasted.is_full else ""
            self.numbers.setText(_in_numbers(shown) + note)

    def _note_drawing(self, now: float) -> None:
        """Take in how long the last picture has kept the window from anything else, this timer included."""
        if self._drawing is not None:
            (began, shown), self._drawing = self._drawing, None
            self._images.note(began, max(shown, now - _MILLISECONDS / 1000))

    def _frames_to_keep(self) -> "Latest | None":
        if self._frozen is not None:
            return self._frozen
        return None if self._kept_of is None else self._kept_of.last(self.seconds.value())

    def _ask_and_keep(self) -> None:
        frames = self._frames_to_keep()  # now, and not when the name has been typed
        if frames is None:
            return
        suggested = str(Path.home() / time.strftime("live-%Y%m%d-%H%M%S.ome.tif"))
        path, _ = QFileDialog.getSaveFileName(self, "Keep as a burst", suggested, "OME-TIFF (*.ome.tif)")
        if path:
            self.keep(path, frames)

    def _take_burst(self, opened: list[LayerData]) -> None:
        for data, look, kind in opened:
            layer = Layer.create(data, look, kind)
            self._viewer.add_layer(layer)
            self.burst_kept.emit(layer)

    def _take_error(self, error: Exception) -> None:
        show_error(why(error, "the frames could not be kept"))

    def _tell(self, colour: str, words: str) -> None:
        if words != self.words.text():  # else the dock would be drawn anew
            self.light.setStyleSheet(f"color: {colour}")
            self.words.setText(words)

    def _follow_state(self, state: State) -> None:
        """Offer what can be done now."""
        self.state = state
        is_ready = state == "ready"
        self.start_button.setEnabled(is_ready)
        self.stop_button.setEnabled(not is_ready)
        self.pause_button.setEnabled(state in ("live", "frozen"))
        self.pause_button.setText("Go on" if state == "frozen" else "Freeze")
        self.keep_button.setEnabled(state in ("live", "frozen") or (is_ready and self._kept_of is not None))
        self.source.setEnabled(is_ready)
        self.seconds.setEnabled(is_ready)

    def _connect(self) -> None:
        self.start_button.clicked.connect(lambda: self.start())
        self.pause_button.clicked.connect(self.freeze)
        self.stop_button.clicked.connect(self.stop)
        self.keep_button.clicked.connect(self._ask_and_keep)
        self._timer.timeout.connect(self._look)
        # The window can go without a word to this widget; what is called then must not need it.
        self.destroyed.connect(partial(_let_go, self._jobs))

    def _lay_out(self) -> None:
        self.start_button.setToolTip("Take frames from the source, and show the picture.")
        self.pause_button.setToolTip("Hold the picture, and the frames before it; the camera goes on.")
        self.stop_button.setToolTip("End the live view; the frames of the last seconds can still be kept.")
        self.keep_button.setToolTip(
            "Save the raw frames of the last seconds, and choose them as the burst for Picture."
        )
        self.seconds.setRange(1, _LONGEST)
        self.seconds.setValue(_USUAL)
        self.seconds.setSuffix(" s")
        self.seconds.setAccessibleName("seconds kept")
        self.seconds.setToolTip("For how long raw frames are kept, as far as 1 GiB goes.")
        self.mosaic.setToolTip("Paste pictures together where the probe goes. The Mosaic task does it with care.")
        self.light.setText("●")
        self.light.setAccessibleName("traffic light")
        font = self.light.font()
        font.setPointSize(3 * font.pointSize())
        self.light.setFont(font)
        for label in (self.words, self.numbers):
            label.setWordWrap(True)
            label.setTextFormat(Qt.TextFormat.PlainText)
            label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        rows = form_layout()
        rows.addRow("keep last", self.seconds)
        told = row_of(self.light, self.words)
        told.setStretch(1, 1)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.source)
        column.addLayout(rows)
        column.addWidget(self.mosaic)
        column.addLayout(row_of(self.start_button, self.pause_button, self.stop_button))
        column.addLayout(told)
        column.addWidget(self.numbers)
        column.addWidget(self.keep_button)


def _in_numbers(shown: Shown) -> str:
    watched = shown.watched
    parts = [f"{shown.rate:.0f} pictures a second, {1000 * watched.lag:.0f} ms late"]
    if watched.view.covered:
        parts.append(f"{100 * watched.view.covered:.0f} % seen")
    if shown.skipped:
        parts.append(f"{shown.skipped:,} frame{'s' if shown.skipped > 1 else ''} passed over")
    if shown.lost:
        parts.append(f"{shown.lost:,} lost by the source")
    return "; ".join(parts)


def _written_and_read(path: Path, frames: "Latest", like: Any) -> list[LayerData]:
    from napari_fiberburst.io.tiff import write_frames

    size, unit = None, None
    if like is not None and str(like.units[-1]) != "pixel":
        size, unit = (float(like.scale[-2]), float(like.scale[-1])), str(like.units[-1])
    write_frames(path, frames.frames, frames.times, size, unit)
    return read(str(path))


def _let_go(jobs: list[LiveJob], *_: Any) -> None:
    for job in jobs:
        job.stop()
    jobs.clear()
