"""A mosaic of a recording is shown; it can be stopped and gone on with, and nothing of a user's is removed."""

import numpy as np
import pytest
import zarr

from napari_fiberburst.io import open_recording
from napari_fiberburst.io.video_writer import write_video
from napari_fiberburst.plugin.contributions import read
from napari_fiberburst.plugin.dock import FiberBurstWidget
from napari_fiberburst.plugin.output_row import work_of
from napari_fiberburst.plugin.tasks.mosaic import MosaicTask
from napari_fiberburst.simulation import simulate_recording

MILLISECONDS = 60_000
FRAMES = 60


@pytest.fixture(scope="module")
def recording():
    """Return 60 frames of 97 x 121 pixels along a raster."""
    return simulate_recording("slide", shape=(97, 121), frames=FRAMES)


@pytest.fixture
def clip(tmp_path, recording):
    """Return them as a file."""
    return write_video(recording.source, tmp_path / "clip.avi")


@pytest.fixture
def opened(open_dock, clip):
    """Return a viewer with the recording open, and the dock's task for mosaics, which is shown."""
    viewer, dock = open_dock()
    for data, look, _ in read(str(clip)):
        viewer.add_image(data, **look)
    dock.choose_task(MosaicTask)
    return viewer, task_of(dock)


def task_of(dock):
    task = next(task for task in dock.tasks if isinstance(task, MosaicTask))
    task.motion.setCurrentText("shifts")
    return task


def run(task, qtbot):
    task.start_button.click()
    qtbot.waitUntil(lambda: task.state == "ready", timeout=MILLISECONDS)


def finest(layer):
    return np.asarray(layer.data[0] if layer.multiscale else layer.data)


def written(task, part=""):
    return np.asarray(zarr.open_array(task.output.path / part / "0", mode="r")[:])


def test_a_mosaic_lies_beside_the_recording_and_is_shown(opened, qtbot, clip, recording):
    viewer, task = opened
    assert task.output.path == clip.with_name("clip-mosaic.ome.zarr")
    run(task, qtbot)
    layer = viewer.layers["clip-mosaic"]
    image = written(task)
    np.testing.assert_array_equal(finest(layer), image)
    low, high = layer.contrast_limits
    assert np.nanmin(image) <= low < high <= np.nanmax(image)
    assert f"{FRAMES} of {FRAMES} frames are placed, in one piece" in task.words.text()
    # The picture is as wide as what the frames have seen.
    corners = recording.homographies @ np.array([[0, 0, 1], [120, 96, 1]]).T[None]
    wide = np.ptp(corners[:, 0] / corners[:, 2])
    assert abs(image.shape[1] - wide) < 0.1 * wide
    assert not work_of(task.output.path).exists()


def test_what_stands_behind_a_mosaic_is_shown_on_demand(opened, qtbot):
    viewer, task = opened
    run(task, qtbot)
    for name in ("coverage", "uncertainty", "frames"):
        assert task.switches[name].isVisibleTo(task)
        assert f"clip-mosaic: {name}" not in viewer.layers
        task.switches[name].setChecked(True)
        np.testing.assert_array_equal(finest(viewer.layers[f"clip-mosaic: {name}"]), written(task, name))
        task.switches[name].setChecked(False)
        assert f"clip-mosaic: {name}" not in viewer.layers


def test_a_mosaic_that_was_stopped_goes_on_to_the_same_bits(opened, qtbot, clip):
    _, task = opened
    task.start_button.click()
    qtbot.waitUntil(lambda: "refining" in task.status.text(), timeout=MILLISECONDS)
    task.stop_button.click()
    qtbot.waitUntil(lambda: task.state == "ready", timeout=MILLISECONDS)
    path = task.output.path
    assert "Start goes on from there" in task.status.text()
    assert work_of(path).exists()
    task._take_input()
    assert task.output.path == path  # the same place is offered, because work was begun there
    traced = next(work_of(path).glob("trace*"))
    before = {file: file.stat().st_mtime_ns for file in traced.glob("0*.safetensors")}
    task.start_button.click()
    qtbot.waitUntil(lambda: "refining" in task.status.text(), timeout=MILLISECONDS)
    assert before
    assert {file: file.stat().st_mtime_ns for file in before} == before
    qtbot.waitUntil(lambda: task.state == "ready", timeout=MILLISECONDS)
    task.output.edit.setText(str(clip.with_name("again.ome.zarr")))
    run(task, qtbot)
    np.testing.assert_array_equal(written(task), np.asarray(zarr.open_array(path / "0", mode="r")[:]))


def test_pausing_holds_the_work(opened, qtbot):
    _, task = opened
    task.start_button.click()
    task.pause_button.click()
    assert task.state == "paused"
    assert task.pause_button.text() == "Continue"
    qtbot.wait(300)
    said = task.status.text()
    qtbot.wait(300)
    assert task.status.text() == said
    task.pause_button.click()
    qtbot.waitUntil(lambda: task.state == "ready", timeout=MILLISECONDS)
    assert task.words.text()


def test_an_output_that_is_there_is_left_alone_and_another_name_suggested(opened, qtbot, clip):
    _, task = opened
    taken = clip.with_name("mine.ome.zarr")
    taken.mkdir()
    (taken / "note.txt").write_text("mine")
    task.output.edit.setText(str(taken))
    task.start_button.click()
    assert task.state == "ready"
    assert "is there already" in task.status.text()
    assert task.output.path == clip.with_name("clip-mosaic.ome.zarr")
    assert (taken / "note.txt").read_text() == "mine"


@pytest.mark.parametrize("deed", ["deleted", "replaced"])
def test_a_recording_that_has_changed_since_is_said(opened, qtbot, clip, recording, deed):
    _, task = opened
    clip.unlink()
    if deed == "replaced":
        write_video(open_recording(recording.source, frames="0:55"), clip)
    run(task, qtbot)
    assert ("there is no" if deed == "deleted" else "has changed since it was opened") in task.status.text()
    assert task.start_button.isEnabled()


def test_two_docks_do_not_write_to_one_place(opened, qtbot, open_dock):
    viewer, first = opened
    second_dock = FiberBurstWidget(viewer)
    viewer.window.add_dock_widget(second_dock, name="second")
    second = task_of(second_dock)
    assert second.output.path == first.output.path
    first.start_button.click()
    second.start_button.click()
    assert second.state == "ready"
    assert "is being written just now" in second.status.text()
    assert second.output.path != first.output.path
    second.start_button.click()
    qtbot.waitUntil(lambda: first.state == second.state == "ready", timeout=2 * MILLISECONDS)
    assert first.words.text()
    assert second.words.text()


def test_a_viewer_closed_while_a_mosaic_is_made_ends_the_work_and_keeps_it(opened, qtbot):
    viewer, task = opened
    task.start_button.click()
    job, path = task.job, task.output.path
    qtbot.waitUntil(lambda: "refining" in task.status.text(), timeout=MILLISECONDS)
    viewer.close()
    qtbot.waitUntil(lambda: job.seconds > 0, timeout=MILLISECONDS)
    assert job.result is None
    assert not job.problem
    assert work_of(path).exists()
