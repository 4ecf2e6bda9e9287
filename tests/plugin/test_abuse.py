"""Whatever happens to a run, its layers, its dock or its window: nothing is left behind."""

import gc
import threading
import weakref

import numpy as np
import pytest
from napari.layers import Image
from napari.utils import progress
from napari.utils.notifications import notification_manager

from napari_fiberburst.pipeline import reconstruct as pipeline
from napari_fiberburst.plugin.dock import FiberBurstWidget

MILLISECONDS = 60_000
NETWORK = {"encoding": "fourier", "iterations": 400, "scene_width": 16, "scene_layers": 1, "features": 16, "batch": 64}


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (RuntimeError("the size of tensor a must match"), "the size of tensor a must match"),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory"), "there was not enough memory"),
        (MemoryError(), "there was not enough memory"),
        (ZeroDivisionError("by zero"), "by zero"),
    ],
)
def test_an_error_in_the_solver_leaves_the_form_ready(open_dock, qtbot, burst_layer, monkeypatch, error, words):
    def broken(*args, **choices):
        raise error

    monkeypatch.setattr(pipeline, "reconstruct", broken)
    viewer, dock = open_dock(burst_layer)
    seen = []
    for name in ("finished", "stopped", "failed", "ready"):
        getattr(dock.picture.runner, name).connect(lambda *_, name=name: seen.append(name))
    before = len(notification_manager.records)
    with qtbot.waitSignal(dock.picture.runner.ready, timeout=MILLISECONDS):
        dock.picture.start()
    (notice,) = [record.message for record in list(notification_manager.records)[before:]]
    assert words in notice
    assert seen == ["failed", "ready"]
    assert dock.picture.start_button.isEnabled()
    assert not progress._all_instances
    assert not viewer.window._task_status_manager.is_busy()


def test_an_image_without_numbers_is_a_failure(open_dock, qtbot, burst_layer, monkeypatch):
    right = pipeline.reconstruct

    def blind(*args, **choices):
        result = right(*args, **choices)
        result.image[:] = np.nan
        return result

    monkeypatch.setattr(pipeline, "reconstruct", blind)
    _, dock = open_dock(burst_layer)
    with qtbot.waitSignal(dock.picture.runner.failed, timeout=MILLISECONDS) as failed:
        dock.picture.start()
    assert "came to no numbers" in failed.args[0]
    assert dock.picture.display.status.text() == f"run 1 failed: {failed.args[0]}."


def test_start_twice_is_one_run(open_dock, qtbot, burst_layer):
    _, dock = open_dock(burst_layer)
    dock.picture.form.set_choices({"motion": "translation", "iterations": 1})
    with qtbot.waitSignal(dock.picture.display.complete, timeout=MILLISECONDS):
        dock.picture.start()
        dock.picture.start()
    assert len(dock.picture.runs.runs) == 1


@pytest.mark.parametrize("deed", ["delete burst", "rename burst", "replace data", "delete image"])
def test_layers_may_change_while_running(open_dock, qtbot, burst_layer, deed):
    viewer, dock = open_dock(burst_layer)
    with qtbot.waitSignal(dock.picture.runner.previewed, timeout=MILLISECONDS):
        dock.picture.start()
    if deed == "delete burst":
        viewer.layers.remove(burst_layer)
    elif deed == "rename burst":
        burst_layer.name = "another"
    elif deed == "replace data":
        burst_layer.data = np.zeros((3, 20, 20, 3), np.uint8)
    else:
        viewer.layers.remove(viewer.layers["run 1: image"])
    with qtbot.waitSignal(dock.picture.display.complete, timeout=MILLISECONDS):
        pass
    names = [layer.name for layer in viewer.layers]
    assert dock.picture.runs.run.result.ending == "finished"
    assert ("run 1: image" in names) == (deed != "delete image")
    dock.picture.display.card.switches["coverage"].setChecked(True)
    assert "run 1: coverage" in viewer.layers


def test_a_closed_dock_stops_its_run_and_a_hidden_one_does_not(open_dock, qtbot, burst_layer):
    viewer, dock = open_dock(burst_layer)
    dock.picture.form.set_choices({**NETWORK, "iterations": 100_000})
    seen = []
    dock.picture.runner.ready.connect(lambda: seen.append("ready"))
    with qtbot.waitSignal(dock.picture.runner.reported, timeout=MILLISECONDS):
        dock.picture.start()
    dock.parent().hide()
    qtbot.wait(300)
    assert dock.picture.runner.state == "running"
    job = dock.picture.runner.job
    viewer.window.remove_dock_widget(dock.parent())
    assert job.control.stopped
    qtbot.waitUntil(lambda: not viewer.window._task_status_manager.is_busy(), timeout=MILLISECONDS)
    assert seen == []
    assert not progress._all_instances
    burst_layer.name = "renamed"  # nobody listens any more


def test_a_viewer_closed_while_running_ends_the_run(open_dock, qtbot, burst_layer):
    viewer, dock = open_dock(burst_layer)
    dock.picture.form.set_choices({**NETWORK, "iterations": 100_000})
    with qtbot.waitSignal(dock.picture.runner.reported, timeout=MILLISECONDS):
        dock.picture.start()
    threads = [thread for thread in threading.enumerate() if thread is not threading.main_thread()]
    viewer.close()
    qtbot.waitUntil(lambda: not progress._all_instances, timeout=MILLISECONDS)
    qtbot.waitUntil(lambda: len(threading.enumerate()) <= len(threads) + 1, timeout=MILLISECONDS)


def test_two_docks_run_side_by_side(open_dock, qtbot, burst_layer):
    viewer, first = open_dock(burst_layer)
    second = FiberBurstWidget(viewer)
    viewer.window.add_dock_widget(second, name="second")
    for dock in (first, second):
        dock.picture.form.set_choices({"motion": "translation", "iterations": 1})
    with qtbot.waitSignals([first.picture.display.complete, second.picture.display.complete], timeout=MILLISECONDS):
        first.picture.start()
        second.picture.start()
    names = {layer.name for layer in viewer.layers}
    assert {"run 1: image", "run 2: image"} <= names


def test_many_starts_and_stops_leave_nothing_behind(open_dock, qtbot, burst_layer):
    viewer, dock = open_dock(burst_layer)
    dock.picture.form.set_choices({"preset": "paper", **NETWORK, "iterations": 100_000})
    qtbot.waitUntil(lambda: dock.picture._missing is not None, timeout=MILLISECONDS)
    for _ in range(10):
        with qtbot.waitSignal(dock.picture.runner.ready, timeout=MILLISECONDS):
            dock.picture.start()
            dock.picture.runner.stop()
        for run in dock.picture.runs.runs:
            dock.picture.runs.remove(run)
    qtbot.wait(100)
    assert not progress._all_instances
    assert [layer.name for layer in viewer.layers] == ["burst"]
    assert not dock.picture.runner._timer.isActive()
    assert not viewer.window._task_status_manager.is_busy()


def test_what_a_removed_run_held_is_let_go_when_the_next_one_starts(open_dock, run_through, qtbot, burst_layer):
    viewer, dock = open_dock(burst_layer)
    dock.picture.form.set_choices({"motion": "translation", "iterations": 1})
    run = run_through(dock, afresh=True)
    gone = [weakref.ref(run.result), weakref.ref(viewer.layers["run 1: image"])]
    dock.picture.runs.remove(run)
    del run
    assert [layer.name for layer in viewer.layers] == ["burst"]
    run_through(dock, afresh=True)  # until now it could have been brought back
    gc.collect()
    assert [reference() for reference in gone] == [None, None]
    assert [layer.name for layer in viewer.layers] == ["burst", "run 1: image"]


def test_animations_are_as_before_when_the_dock_is_closed(open_dock, qtbot, burst_layer):
    from qtpy.QtWidgets import QLabel

    viewer, dock = open_dock(burst_layer)
    window = dock.window()
    movies = [label.movie() for label in window.findChildren(QLabel) if label.movie() is not None]
    dock.picture.form.set_choices({**NETWORK, "iterations": 100_000})
    with qtbot.waitSignal(dock.picture.runner.reported, timeout=MILLISECONDS):
        dock.picture.start()
    assert {movie.speed() for movie in movies} == {4}
    viewer.window.remove_dock_widget(dock.parent())
    assert {movie.speed() for movie in movies} == {100}
    qtbot.waitUntil(lambda: not viewer.window._task_status_manager.is_busy(), timeout=MILLISECONDS)


def test_a_dock_put_back_follows_the_layers_again(open_dock, burst_layer, grey_frames):
    viewer, dock = open_dock(burst_layer)
    viewer.window.remove_dock_widget(dock.parent())
    viewer.window.add_dock_widget(dock, name="again")
    viewer.add_layer(Image(grey_frames, name="late"))
    assert dock.input.burst.native.findText("late") >= 0
