"""A video of a recording lies beside it and is shown frame by frame; it is saved as a film."""

import numpy as np
import pytest
import zarr
from napari.utils.notifications import notification_manager
from qtpy.QtWidgets import QFileDialog

from napari_fiberburst.io import open_recording
from napari_fiberburst.plugin.recordings import recording_layer
from napari_fiberburst.plugin.tasks.video import VideoTask
from napari_fiberburst.simulation import simulate_recording

MILLISECONDS = 60_000


@pytest.fixture
def opened(open_dock):
    """Return viewer and the task for videos: ten frames a second of 97 x 121 pixels, half a micrometre each."""
    recording = simulate_recording("slide", shape=(97, 121), frames=24, rate=10.0).source
    viewer, dock = open_dock()
    data, look, _ = recording_layer(recording, "recording")
    viewer.add_image(data, **look)
    viewer.layers["recording"].scale = (1, 0.5, 0.5)
    viewer.layers["recording"].units = ("pixel", "um", "um")
    dock.choose_task(VideoTask)
    task = dock.task
    task.motion.setCurrentText("shifts")
    return viewer, task


def test_a_video_is_shown_over_the_recording_and_saved_as_a_film(opened, qtbot, tmp_path, monkeypatch):
    viewer, task = opened
    assert not task.film_button.isEnabled()
    task.output.edit.setText(str(tmp_path / "sharp.ome.zarr"))
    task.frames_behind.setValue(5)
    task.start_button.click()
    qtbot.waitUntil(lambda: task.state == "ready", timeout=2 * MILLISECONDS)
    assert "24 of 24 frames have a place; 5 stand behind each" in task.words.text()
    layer, recorded = viewer.layers["sharp"], viewer.layers["recording"]
    finest = layer.data[0] if layer.multiscale else layer.data
    assert finest.shape == recorded.data.shape
    np.testing.assert_allclose(layer.extent.world, recorded.extent.world)
    viewer.dims.set_current_step(0, 7)
    written = zarr.open_array(tmp_path / "sharp.ome.zarr" / "0", mode="r")
    np.testing.assert_array_equal(np.asarray(finest[7]), np.asarray(written[7]))
    layer.contrast_limits = low, high = np.nanpercentile(written, [20, 60])
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *asked: (asked[2], ""))
    task.film_button.click()
    qtbot.waitUntil(lambda: "wrote" in notification_manager.records[-1].message, timeout=MILLISECONDS)
    film = open_recording(tmp_path / "sharp.mp4")
    assert len(film) == 24
    np.testing.assert_allclose(np.diff(film.acquisition.times), 0.1, atol=1e-3)
    shown = film.recorded([7])[0, :97, :121, 0]
    expected = np.clip(255 * (np.nan_to_num(written[7], nan=low) - low) / (high - low), 0, 255)
    # The bar of a scale: a white run near the lower right corner, a whole number of micrometres long.
    assert (shown[97 * 3 // 4 :, 60:] > 235).sum(axis=1).max() >= 2 * 10
    assert np.abs(shown[:80] - expected[:80]).mean() < 4
