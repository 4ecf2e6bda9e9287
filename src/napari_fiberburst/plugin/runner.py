"""Runs one job at a time in a worker thread, pauses and stops it, and says how it has ended."""

import atexit
import io
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Literal

from napari.qt.threading import FunctionWorker, create_worker
from napari.utils import progress
from qtpy.QtCore import QObject, QThreadPool, QTimer, Signal

from napari_fiberburst.control import Control
from napari_fiberburst.plugin.job import Job
from napari_fiberburst.plugin.pace import Pace

if TYPE_CHECKING:
    from napari_fiberburst.results.progress import Progress

# The window is brought up to date ten times a second, or less often where that would take more than this part of the
# time: where the canvas is drawn in software, as on remote desktops, the fit needs those processors.
_MILLISECONDS = 100
_IMAGES_SHARE, _WORDS_SHARE = 0.1, 0.04

State = Literal["ready", "running", "paused", "stopping"]


class Runner(QObject):
    """Starts, pauses and stops jobs, and says what becomes of them.

    Signals come in this order: `started`, any number of `previewed` and `reported`, one of `finished`, `stopped` and
    `failed`, then `ready`. After `shut_down` none comes; where napari ends its workers, because it closes, `ready`
    alone.

    Attributes
    ----------
    state : str
        "ready", "running", "paused" or "stopping".
    """

    started = Signal(object)  # the Job
    reported = Signal(object)  # its newest Progress
    previewed = Signal(object)  # its newest Progress with a preview
    finished = Signal(object)  # the Job, with its result
    stopped = Signal(object)  # the Job, with its result so far
    failed = Signal(str)  # why, for the user
    ready = Signal()
    state_changed = Signal(str)

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self.state: State = "ready"
        self._job: Job | None = None
        self._worker: FunctionWorker[None] | None = None
        self._progress: progress | None = None
        self._at_exit: Callable[[], None] | None = None
        self._timer = QTimer(self)
        self._timer.setInterval(_MILLISECONDS)
        self._timer.timeout.connect(self._look)
        self._paces = _paces()
        self._has_image = False

    @property
    def job(self) -> Job | None:
        """The job that is running."""
        return self._job

    def start(self, job: Job, name: str) -> None:
        """Run a job.

        Raises
        ------
        RuntimeError
            Another one is running.
        """
        if self._job is not None:
            raise RuntimeError("one run at a time: stop the one that is running first")
        self._job = job
        # A plain function, because a generator's worker swallows RuntimeError, which is what torch raises.
        worker: FunctionWorker[None] = create_worker(job.run, lambda: bool(worker.abort_requested), _ignore_errors=True)
        self._worker = worker
        worker.finished.connect(self._end)
        # Where there is no window for it, napari's bar would go to the terminal.
        self._progress = progress(total=1, desc=name, file=io.StringIO())
        self._at_exit = atexit.register(partial(_end, job.control))
        self._set(state="running")
        self.started.emit(job)
        self._paces = _paces()
        self._has_image = False
        self._timer.start()
        worker.start()

    def pause(self) -> None:
        """Hold the run before its next step."""
        if self._job is not None and self.state == "running":
            self._job.control.pause()
            self._set(state="paused")

    def resume(self) -> None:
        """Let a paused run go on."""
        if self._job is not None and self.state == "paused":
            self._job.control.resume()
            self._set(state="running")

    def stop(self) -> None:
        """End the run after the step it is in; it keeps what it has."""
        if self._job is not None and self.state != "stopping":
            self._job.control.stop()
            self._set(state="stopping")

    def shut_down(self) -> None:
        """Stop for good, without a signal, because the window is closing. May be called more than once."""
        if self._job is not None and self._worker is not None:
            self._job.control.stop()
            # Where napari is closing, Qt may have deleted the worker's signals: then none of them can come any more.
            with suppress(RuntimeError):
                self._worker.finished.disconnect(self._end)
                self._worker.finished.connect(self._job.release)
            self._timer.stop()
            self._close_progress()
        self._job = self._worker = None
        self.state = "ready"

    def _look(self, *, last: bool = False) -> None:
        """Hand on what is new, as often as the window can bear."""
        job, worker = self._job, self._worker
        if job is None or worker is None or worker.abort_requested:
            return
        images, words = self._paces
        for box, signal, pace in ((job.previews, self.previewed, images), (job.reports, self.reported, words)):
            if self._job is not job:
                return  # napari's progress bar processes events, the end of the run among them
            began = time.perf_counter()
            # The first image is what a user waits for.
            is_first = box is job.previews and not self._has_image
            report = box.take() if last or is_first or pace.is_due(began) else None
            if report is not None:
                self._has_image = self._has_image or report.preview is not None
                signal.emit(report)
                self._show_progress(report)
                # Comes back once the window has been drawn.
                QTimer.singleShot(0, partial(pace.note_end, began))

    def _show_progress(self, report: "Progress") -> None:
        bar = self._progress
        if bar is not None and bar.total != report.iterations:
            bar.total = report.iterations
        # A change of its total processes events, the end of the run among them.
        if self._progress is bar and bar is not None:
            bar.update(report.step - bar.n)

    def _end(self) -> None:
        job, worker = self._job, self._worker
        if job is None or worker is None:
            return
        self._timer.stop()
        self._look(last=True)
        self._close_progress()
        if self._at_exit is not None:
            atexit.unregister(self._at_exit)
        self._job = self._worker = self._at_exit = None
        self.state = "ready"
        if worker.abort_requested:
            pass  # napari is closing: there may be no window to show anything in
        elif job.result is None:
            self.failed.emit(job.problem)
        elif job.result.ending == "stopped":
            self.stopped.emit(job)
        else:
            self.finished.emit(job)
        job.release()
        self.state_changed.emit(self.state)
        self.ready.emit()

    def _close_progress(self) -> None:
        if self._progress is not None:
            self._progress.close()
            self._progress = None

    def _set(self, state: State) -> None:
        self.state = state
        self.state_changed.emit(state)


def _paces() -> tuple[Pace, Pace]:
    """Return how often images may be drawn, and all else."""
    return Pace(_IMAGES_SHARE), Pace(_WORDS_SHARE)


def wait_for_workers() -> None:
    """Wait for what other threads are at, because Python is ending: a worker must not outlive the signals it sends."""
    pool = QThreadPool.globalInstance()
    if pool is not None:
        pool.waitForDone()


def _end(control: Control) -> None:
    control.stop()
    wait_for_workers()
