"""The dock's Live task, on sources that are quick."""

import numpy as np
import pytest
import tifffile
from napari.layers import Image
from tests.plugin.conftest import MILLISECONDS

from napari_fiberburst import Bundle
from napari_fiberburst.plugin.commands import show_live
from napari_fiberburst.plugin.contributions import bundle_layers
from napari_fiberburst.plugin.live_layer import LayerSource
from napari_fiberburst.plugin.live_source_row import GROWING, LAYER, REPLAY, SIMULATED
from napari_fiberburst.plugin.tasks.live import LiveTask
from napari_fiberburst.plugin.tasks.picture import PictureTask
from napari_fiberburst.simulation import simulate_recording


@pytest.fixture(scope="module")
def recording():
    return simulate_recording(frames=40, shape=(67, 81), pitch=5.0, path="handheld", step=1.5, seed=1)


@pytest.fixture(scope="module")
def frames(recording):
    return recording.source.recorded(range(40))[..., 0]


@pytest.fixture
def live(open_dock, recording, frames):
    """Return a viewer, its dock and the task, with a recording and the bundle that it was made with."""
    viewer, dock = open_dock(Image(frames, name="clip"))
    dock.choose_task(LiveTask)
    light = np.rint(np.clip(recording.transmission * 255, 0, 255)).astype(np.uint8)
    dock.input.add_bundle(bundle_layers(Bundle.from_image(light), "bundle"))
    return viewer, dock, dock.live


def wait_for(qtbot, condition):
    qtbot.waitUntil(condition, timeout=MILLISECONDS)


def test_without_any_layer_live_is_one_click_away_and_asks_for_no_burst(open_dock):
    _, dock = open_dock()
    assert not dock.filled.isVisibleTo(dock)
    dock.empty.live_button.click()
    assert dock.task is dock.live
    assert dock.filled.isVisibleTo(dock)
    assert not dock.empty.isVisibleTo(dock)
    assert not dock.input.burst.native.isVisibleTo(dock)
    assert dock.input.bundle.native.isVisibleTo(dock)
    dock.choose_task(PictureTask)
    assert dock.empty.isVisibleTo(dock)
    assert dock.input.burst.native.isVisibleTo(dock.filled)


def test_a_replay_is_shown_frozen_and_kept_as_the_burst_it_was(live, qtbot, tmp_path, frames):
    viewer, dock, task = live
    task.source.choose(REPLAY)
    task.source.rate.setValue(8)
    task.start_button.click()
    wait_for(qtbot, lambda: "live" in viewer.layers and task.state == "live")
    # The first frame has a picture before the second one has come.
    wait_for(qtbot, lambda: len(task.job.last(10).frames) > 2)
    task.pause_button.click()
    assert task.state == "frozen"
    shown = viewer.layers["live"].data.copy()
    wait_for(qtbot, lambda: task.state == "ready")
    assert np.array_equal(viewer.layers["live"].data, shown, equal_nan=True)
    assert shown.shape == frames.shape[1:]
    assert np.isfinite(shown).any()
    assert "Stopped" in task.words.text()
    with qtbot.waitSignal(task.burst_kept, timeout=MILLISECONDS):
        task.keep(tmp_path / "kept.ome.tif")
    kept = tifffile.imread(tmp_path / "kept.ome.tif")
    first = next(number for number in range(40) if np.array_equal(frames[number], kept[0]))
    assert np.array_equal(kept, frames[first : first + len(kept)])
    assert len(kept) > 1
    assert dock.task is dock.picture
    assert np.array_equal(np.asarray(dock.input.burst.value.data), kept)


def test_all_frames_are_kept_however_few_are_shown(live, qtbot, tmp_path, frames):
    _, _, task = live
    task.source.choose(REPLAY)
    task.source.rate.setValue(200)
    task.start()
    wait_for(qtbot, lambda: task.state == "ready")
    with qtbot.waitSignal(task.burst_kept, timeout=MILLISECONDS):
        task.keep(tmp_path / "kept.ome.tif")
    assert np.array_equal(tifffile.imread(tmp_path / "kept.ome.tif"), frames)


def test_a_layer_that_another_plugin_changes_is_a_source_until_it_is_deleted(live, qtbot, frames):
    viewer, _, task = live
    camera = viewer.add_image(frames[0].copy(), name="camera", scale=(0.5, 0.5), units="um")
    task.source.choose(LAYER)
    task.source.layer.value = camera
    task.mosaic.setChecked(True)
    task.start()
    wait_for(qtbot, lambda: "live" in viewer.layers)
    for frame in frames[1:12]:
        before = viewer.layers["live"].data.copy()
        camera.data = frame
        wait_for(qtbot, lambda before=before: not np.array_equal(viewer.layers["live"].data, before, equal_nan=True))
    assert task.job is not None
    assert task.job.shown is not None
    assert viewer.layers["live"].scale.tolist() == [0.5, 0.5]
    wait_for(qtbot, lambda: "live mosaic" in viewer.layers)
    viewer.layers.remove(camera)
    wait_for(qtbot, lambda: task.state == "ready")


def test_what_cannot_be_a_source_is_said(live, qtbot, tmp_path):
    viewer, _, task = live
    task.source.choose(REPLAY)
    task.start()
    assert "does not tell how many frames it has a second; set a rate" in task.words.text()
    task.source.choose(GROWING)
    task.start()
    assert task.words.text() == "choose the folder or file that grows"
    task.source.place.setText(str(tmp_path / "none"))
    task.start()
    wait_for(qtbot, lambda: task.state == "ready")
    assert "is not there; choose a folder" in task.words.text()
    assert "live" not in viewer.layers


def test_a_camera_that_changes_its_size_ends_the_view_and_its_frames_are_kept(live, qtbot, frames):
    viewer, _, task = live
    camera = viewer.add_image(frames[0], name="camera")
    task.source.choose(LAYER)
    task.source.layer.value = camera
    task.start()
    wait_for(qtbot, lambda: "live" in viewer.layers)
    camera.data = frames[1, :-4]
    wait_for(qtbot, lambda: task.state == "ready")
    assert "changed from 67 x 81 pixels of uint8 to 63 x 81 pixels of uint8" in task.words.text()
    assert task.keep_button.isEnabled()


def test_a_simulated_camera_runs_and_stops(live, qtbot):
    viewer, dock, task = live
    dock.input.bundle.value = None
    task.source.choose(SIMULATED)
    task.start()
    wait_for(qtbot, lambda: "live" in viewer.layers)
    assert viewer.layers["live"].data.shape == (256, 256)
    task.stop()
    wait_for(qtbot, lambda: task.state == "ready")


def test_closing_the_dock_ends_it(live, qtbot, frames):
    viewer, dock, task = live
    task.source.choose(REPLAY)
    task.source.rate.setValue(2)
    task.start()
    wait_for(qtbot, lambda: "live" in viewer.layers)
    job = task.job
    dock.shut_down()
    assert task.job is None
    wait_for(qtbot, lambda: not job.is_running)


def test_a_layer_hands_out_its_newest_frame_once():
    layer = Image(np.zeros((3, 19, 23), np.uint16))
    source = LayerSource(layer)
    assert source.latest().frames.shape == (1, 19, 23, 1)
    layer.data = np.arange(4, dtype=np.uint16)[:, None, None] * np.ones((19, 23), np.uint16)
    layer.refresh()
    got = source.latest()
    assert (got.frames == 3).all()
    assert (got.dropped, got.indices.tolist()) == (0, [1])
    layer.data[-1] = 7
    layer.refresh()
    assert (source.latest().frames == 7).all()
    source.close()
    assert len(source.latest().frames) == 0
    layer.data = np.ones((2, 19, 23), np.uint16)
    assert len(layer.events.data.callbacks) == len(Image(np.zeros((19, 23))).events.data.callbacks)


def test_a_command_opens_the_dock_at_the_live_view(live):
    _, dock, _ = live
    dock.choose_task(PictureTask)
    show_live()
    assert dock.task is dock.live


def test_a_replay_that_is_shorter_than_calibration_is_told(live, qtbot, frames):
    viewer, dock, task = live
    dock.input.bundle.value = None
    viewer.add_image(frames[:8], name="short")
    task.source.choose(REPLAY)
    task.source.layer.value = viewer.layers["short"]
    task.source.rate.setValue(10)
    task.start()
    wait_for(qtbot, lambda: task.state == "ready")
    assert "ended before the bundle was learned" in task.words.text()
