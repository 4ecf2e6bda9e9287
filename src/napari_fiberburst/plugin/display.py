"""What a run shows while it goes and when it is done: its state in words, its image, its curves, its past."""

from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from napari.components import ViewerModel
from qtpy.QtCore import QObject, Qt, Signal
from qtpy.QtGui import QMovie
from qtpy.QtWidgets import QHBoxLayout, QLabel, QProgressBar, QSlider, QVBoxLayout, QWidget
from superqt import QLabeledSlider

from napari_fiberburst.plugin.card import ResultCard
from napari_fiberburst.plugin.curves import Curves
from napari_fiberburst.plugin.history import HistoryEntry
from napari_fiberburst.plugin.job import Job
from napari_fiberburst.plugin.kept_run import KeptRun
from napari_fiberburst.plugin.sections import section

if TYPE_CHECKING:
    from napari_fiberburst.results.progress import Progress

# Per cent of an animation's own pace.
_SLOW, _USUAL = 4, 100
_ENDINGS = {
    "finished": "is finished",
    "stopped": "was stopped, and keeps what it has come to",
    "time budget": "has used up its time",
    "diverged": "came to no numbers, and keeps its last good image",
}
_NOTHING_YET = "Press Start: everything sets itself."


class Display(QObject):
    """Shows the run that is going, then its result; and the past of the run that is selected.

    Its widgets stand in the dock where they belong: `status_box`, `card`, `curve_box` and `past_box`.

    Parameters
    ----------
    viewer : ViewerModel
        Whose theme to follow.
    parent : QObject
        Who owns it.
    """

    complete = Signal(object)  # the KeptRun whose result is shown

    def __init__(self, viewer: ViewerModel, parent: QObject) -> None:
        super().__init__(parent)
        self.status = QLabel(_NOTHING_YET)
        self.status.setWordWrap(True)
        self.status.setToolTip("While a network learns: a rectangle drawn in a Shapes layer is learned first.")
        self.bar = QProgressBar()
        self.slider = QLabeledSlider()
        self._curves = Curves(viewer)
        self.card = ResultCard(viewer)
        self.curve_box = section("Curves", self._curves)
        self.status_box, self.past_box = self._lay_out()
        self._selected: KeptRun | None = None
        self._charted: Sequence[KeptRun] = ()
        self.slider.valueChanged.connect(self._scrub)
        self.curve_box.toggled.connect(lambda _: self._draw_curves())

    def begin(self) -> None:
        """Make way for a new run."""
        # No moving bar for "busy": where the canvas is drawn in software, every repaint takes time from the fit.
        self.bar.setRange(0, 1)
        self.bar.setValue(0)
        self.status.setText("starting")

    def preview(self, run: KeptRun, job: Job, report: "Progress") -> None:
        """Show the image that a running fit has come to, and keep it."""
        if report.preview is not None and job.acquisition is not None:
            run.history.add(HistoryEntry(report.seconds, report.preview, report.canvas))
            run.layers.show_image(report.preview, job.acquisition, report.canvas)
            if run is self._selected:
                self.select(run)

    def report(self, run: KeptRun, job: Job, report: "Progress") -> None:
        """Show where a running fit stands."""
        if job.acquisition is None:
            return
        run.layers.show_frames(report.homographies, job.acquisition.shape[1:3])
        self.card.refresh()
        run.span = job.acquisition.white_level - job.acquisition.black_level
        self._draw_curves()
        self.bar.setRange(0, report.iterations)
        self.bar.setValue(report.step)
        self.status.setText(_status(report))

    def end(self, run: KeptRun, job: Job) -> None:
        """Show the result of a run; then say so."""
        result = job.result
        if result is None:
            return
        run.result = result
        run.scores = next((point.scores for point in reversed(job.curve) if point.scores is not None), None)
        self._draw_curves()
        self.status.setText(f"{run.name} {_ENDINGS[result.ending]}.")
        run.layers.finish(result, run.source.frames)
        self.card.refresh()
        self.complete.emit(run)

    def fail(self, name: str, problem: str) -> None:
        """Say why a run of this name came to nothing."""
        self.status.setText(f"{name} failed: {problem}.")

    def select(self, run: KeptRun | None) -> None:
        """Let card and history be those of a run, at its newest image.

        One that was gone back through shows that image again.
        """
        before = self._selected
        if before is not None and before.result is not None and self.slider.value() < self.slider.maximum():
            result = before.result
            before.layers.show_image(result.image, result.acquisition, result.canvas)
        self._selected = run
        if run is not before:
            self.card.show_run(run)
        self.slider.blockSignals(True)
        self.slider.setMaximum(0 if run is None else max(0, len(run.history.entries) - 1))
        self.slider.setValue(self.slider.maximum())
        self.slider.blockSignals(False)

    def chart(self, runs: Sequence[KeptRun]) -> None:
        """Let curves be those of some runs, by their names."""
        self._charted = runs
        self._curves.clear()
        self._draw_curves()

    def shut_down(self) -> None:
        """Show nothing more. May be called more than once."""
        self._curves.shut()
        self.card.shut()

    def open(self) -> None:
        """Show again, where it was shut down."""
        self._curves.open()
        self.card.open()

    def _lay_out(self) -> tuple[QWidget, QWidget]:
        self.bar.setTextVisible(False)
        self.bar.setVisible(False)
        self.slider.setOrientation(Qt.Orientation.Horizontal)
        self.slider.setMaximum(0)
        for slider in self.slider.findChildren(QSlider):
            slider.setAccessibleName("history")
        self.slider.setToolTip("Goes back through the images of the run that is selected.")
        state, past = QWidget(), QWidget()
        column, row = QVBoxLayout(state), QHBoxLayout(past)
        for layout in (column, row):
            layout.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.bar)
        column.addWidget(self.status)
        row.addWidget(QLabel("history"))
        row.addWidget(self.slider)
        return state, past

    def _draw_curves(self) -> None:
        if self.curve_box.isExpanded():
            self._curves.show_runs(self._charted)

    def _scrub(self, index: int) -> None:
        """Show an image of the past."""
        run = self._selected
        if run is None or run.result is None or index >= len(run.history.entries):
            return
        if index == self.slider.maximum():  # the newest may have been turned since
            run.layers.show_image(run.result.image, run.result.acquisition, run.result.canvas)
        else:
            entry = run.history.entries[index]
            run.layers.show_image(entry.image, run.result.acquisition, entry.canvas)


class AnimationThrottle:
    """Slows the little animations of a window down while a fit is going.

    napari's sign of activity moves 30 times a second. Each time all of the window is drawn, which takes a graphics
    card no time; but where the canvas is drawn in software, it takes more than half of the fit's speed.
    """

    def __init__(self) -> None:
        self._slowed: list[QMovie] = []

    def slow(self, window: QWidget) -> None:
        """Slow down what moves in a window."""
        movies = [label.movie() for label in window.findChildren(QLabel)]
        self._slowed = [movie for movie in movies if movie is not None]
        for movie in self._slowed:
            movie.setSpeed(_SLOW)

    def restore(self) -> None:
        """Let it move as before. May be called more than once, and when the window is gone."""
        for movie in self._slowed:
            with suppress(RuntimeError):  # deleted with its window
                movie.setSpeed(_USUAL)
        self._slowed = []


def _status(report: "Progress") -> str:
    parts = [f"step {report.step} of {report.iterations}", f"{report.rate:.1f} it/s"]
    if report.remaining is not None:
        parts.append(f"{report.remaining:.0f} s left")
    if report.loss == report.loss:  # not NaN, as before the frames are registered
        parts.append(f"loss {report.loss:.3g}")
    return " · ".join(parts)
