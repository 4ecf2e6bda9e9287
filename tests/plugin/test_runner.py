"""The runner's signals, whatever the job does."""

import subprocess
import sys
import threading

import pytest
from napari.utils import progress
from qtpy.compat import isalive
from qtpy.QtCore import QCoreApplication, QEvent, QThreadPool, QTimer

from napari_fiberburst.control import Control
from napari_fiberburst.plugin.runner import Runner
from napari_fiberburst.streaming import Latest

MILLISECONDS = 20_000
SIGNALS = ("started", "previewed", "reported", "finished", "stopped", "failed", "ready")


class Result:
    """A result, as far as the runner looks at it."""

    def __init__(self, ending):
        self.ending = ending


class WaitingJob:
    """Does nothing until it is told to stop, or to end."""

    def __init__(self):
        self.control, self.reports, self.previews = Control(), Latest(), Latest()
        self.result, self.problem, self.is_released = None, "", False
        self.may_end = threading.Event()

    def run(self, should_stop):
        while not (self.may_end.wait(0.005) or self.control.stopped or should_stop()):
            pass
        if not self.problem:
            self.result = Result("finished" if self.may_end.is_set() else "stopped")

    def release(self):
        self.is_released, self.result = True, None


@pytest.fixture
def runner(qtbot):
    made = Runner()
    yield made
    made.shut_down()


@pytest.fixture
def seen(runner):
    """Return the names of the signals, as they come."""
    names = []
    for name in SIGNALS:
        getattr(runner, name).connect(lambda *_, name=name: names.append(name))
    return names


def end(qtbot, runner, act):
    with qtbot.waitSignal(runner.ready, timeout=MILLISECONDS):
        act()


def test_finished(qtbot, runner, seen):
    job = WaitingJob()
    runner.start(job, "a run")
    assert runner.state == "running"
    assert len(progress._all_instances) == 1
    end(qtbot, runner, job.may_end.set)
    assert seen == ["started", "finished", "ready"]
    assert job.is_released
    assert not progress._all_instances


def test_stopped(qtbot, runner, seen):
    runner.start(WaitingJob(), "a run")
    end(qtbot, runner, runner.stop)
    assert seen == ["started", "stopped", "ready"]


def test_failed(qtbot, runner, seen):
    job = WaitingJob()
    job.problem = "no luck"
    runner.start(job, "a run")
    words = []
    runner.failed.connect(words.append)
    end(qtbot, runner, job.may_end.set)
    assert seen == ["started", "failed", "ready"]
    assert words == ["no luck"]


def test_closed(qtbot, runner, seen):
    job = WaitingJob()
    runner.start(job, "a run")
    runner.shut_down()
    runner.shut_down()
    assert job.control.stopped
    assert not progress._all_instances
    qtbot.waitUntil(lambda: job.is_released, timeout=MILLISECONDS)
    assert seen == ["started"]


def test_closed_after_qt_has_deleted_the_workers_signals(qtbot, runner, seen):
    """As it happens where napari is closed while a run goes."""
    job = WaitingJob()
    runner.start(job, "a run")
    job.control.stop()
    QThreadPool.globalInstance().waitForDone()
    signals = runner._worker.signals
    signals.deleteLater()
    QCoreApplication.sendPostedEvents(signals, QEvent.Type.DeferredDelete.value)
    assert not isalive(signals)
    runner.shut_down()
    assert runner.state == "ready"
    assert not progress._all_instances
    assert seen == ["started"]


def test_python_may_end_while_a_run_goes():
    """The worker's last signals are sent before Qt's objects go."""
    code = """
import sys, time
from napari_fiberburst.control import Control
from napari_fiberburst.plugin.runner import Runner
from napari_fiberburst.streaming import Latest
from qtpy.QtWidgets import QApplication

class SlowJob:
    control, reports, previews, result = Control(), Latest(), Latest(), None

    def run(self, should_stop):
        while not self.control.stopped:
            time.sleep(0.05)
        time.sleep(0.5)  # the step it is in
        print("done")

app = QApplication(sys.argv)
runner = Runner()
runner.start(SlowJob(), "a run")
app.processEvents()
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (ended.stdout, ended.stderr) == ("done\n", "")


def test_only_one_at_a_time(qtbot, runner):
    job = WaitingJob()
    runner.start(job, "a run")
    with pytest.raises(RuntimeError, match="one run at a time"):
        runner.start(WaitingJob(), "another")
    end(qtbot, runner, job.may_end.set)


def test_pause_and_resume_in_quick_succession_end_running(qtbot, runner):
    job = WaitingJob()
    runner.start(job, "a run")
    for _ in range(20):
        runner.pause()
        runner.resume()
    assert runner.state == "running"
    assert not job.control.paused
    runner.pause()
    assert job.control.paused
    end(qtbot, runner, runner.stop)  # a paused run can be stopped


def test_a_hundred_starts_and_stops_leave_nothing(qtbot, runner):
    def cycle():
        runner.start(WaitingJob(), "a run")
        end(qtbot, runner, runner.stop)

    cycle()
    threads, timers = threading.active_count(), len(runner.findChildren(QTimer))
    for _ in range(100):
        cycle()
    assert threading.active_count() == threads
    assert len(runner.findChildren(QTimer)) == timers
    assert not any(timer.isActive() for timer in runner.findChildren(QTimer))
    # The last worker has told that it is done before its thread is back in the pool.
    qtbot.waitUntil(lambda: QThreadPool.globalInstance().activeThreadCount() == 0)
    assert not progress._all_instances
