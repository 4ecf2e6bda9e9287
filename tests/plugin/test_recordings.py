"""A long recording is shown without being read, and a burst is chosen from it."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.io import open_recording
from napari_fiberburst.io.video_writer import write_video
from napari_fiberburst.pipeline.choose import best_burst
from napari_fiberburst.plugin.contributions import get_reader
from napari_fiberburst.plugin.recordings import recording_in, recording_layer
from napari_fiberburst.plugin.scrubbing import Frames
from napari_fiberburst.plugin.tasks.mosaic import MosaicTask
from napari_fiberburst.simulation import simulate_recording

MILLISECONDS = 60_000
FRAMES = 300


@pytest.fixture(scope="module")
def recording() -> FrameSource:
    """Return 300 frames of 63 x 75 pixels, a core pattern before a slide that moves."""
    return simulate_recording("slide", shape=(63, 75), frames=FRAMES).source


@dataclass
class Counting:
    """Reads frames of another recording, and notes which."""

    source: FrameSource
    read: list = field(default_factory=list)

    def __call__(self, numbers):
        self.read.extend(numbers)
        return self.source.recorded(numbers)

    def __deepcopy__(self, memo):
        return self  # one that is copied is counted with


@pytest.fixture
def counted(recording):
    """Return the recording, and its reader."""
    reader = Counting(recording)
    return replace(recording, reader=reader), reader


@pytest.mark.parametrize(("ending", "codec"), [(".avi", "mjpeg"), (".mp4", "h264")])
def test_a_video_opens_with_its_name_and_times_and_shows_its_frames(
    make_napari_viewer, tmp_path, recording, ending, codec
):
    path = write_video(recording.take(range(80)), tmp_path / f"clip{ending}", codec=codec, rate=10.0)
    ((frames, look, kind),) = get_reader(str(path))(str(path))
    expected = open_recording(path)
    assert (look["name"], kind) == ("clip", "image")
    np.testing.assert_allclose(look["metadata"]["fiberburst"]["recording"]["times"], np.arange(80) / 10, atol=1e-3)
    viewer = make_napari_viewer()
    layer = viewer.add_image(frames, **look)
    for number in (1, 2, 40, 39, 38, 79, 5):
        viewer.dims.set_current_step(0, number)
        np.testing.assert_array_equal(layer._slice.image.raw, expected.recorded([number])[0, ..., 0])


def test_no_frame_is_read_but_those_shown_and_a_few_about_them(make_napari_viewer, counted):
    source, reader = counted
    viewer = make_napari_viewer()
    data, look, _ = recording_layer(source, "recording")
    layer = viewer.add_image(data, **look)
    viewer.dims.set_current_step(0, 200)
    np.testing.assert_array_equal(layer._slice.image.raw, source.recorded([200])[0, ..., 0])
    assert len(set(reader.read)) < FRAMES / 5
    low, high = layer.contrast_limits
    assert low < np.median(data[200]) < high


def test_steps_back_and_forth_in_a_viewer_read_each_frame_once(viewer, counted, recording):
    source, reader = counted
    layer = viewer.add_image(Frames(source), contrast_limits=(0, 255), multiscale=False)
    reader.read.clear()
    # Back, which reads some at once; forth over frames that are at hand; and one that is not.
    for number in [*range(119, 80, -1), *range(82, 112), 250]:
        viewer.dims.set_current_step(0, number)
        np.testing.assert_array_equal(layer._slice.image.raw, recording.recorded([number])[0, ..., 0])
    assert set(range(81, 120)) | {250} <= set(reader.read)
    assert len(reader.read) == len(set(reader.read)) < 39 + 1 + 2 * 16


def test_who_steps_on_finds_the_next_frames_read_already(counted, qtbot):
    source, reader = counted
    frames = Frames(source)
    _ = frames[100], frames[101]
    qtbot.waitUntil(lambda: {102, 103, 104, 105} <= set(reader.read), timeout=MILLISECONDS)


@pytest.mark.parametrize(
    "key", [np.s_[7], np.s_[-1], np.s_[3:9], np.s_[::50, 4:20], np.s_[[5, 2], :, 3], np.s_[4, 1:5, 2], np.s_[..., 3]]
)
def test_slices_are_those_of_the_array(recording, key):
    part = recording.take(range(60))
    whole = part.recorded(range(60))[..., 0]
    np.testing.assert_array_equal(Frames(part)[key], whole[key])


def test_channels_come_before_height_unless_they_are_colours():
    values = np.random.default_rng(0).integers(0, 255, (60, 20, 30, 3), dtype=np.uint8)
    source = open_recording(values, axes="TYXC")
    np.testing.assert_array_equal(Frames(source)[5], values[5].transpose(2, 0, 1))
    np.testing.assert_array_equal(Frames(source, is_colour=True)[5], values[5])
    np.testing.assert_array_equal(np.asarray(Frames(source)), values.transpose(0, 3, 1, 2))
    _, look, _ = recording_layer(source, "recording")
    assert look["rgb"]


@pytest.fixture
def opened(open_dock, counted, qtbot):
    """Return viewer and dock with a recording whose burst has been suggested, and its reader."""
    source, reader = counted
    viewer, dock = open_dock()
    data, look, _ = recording_layer(source, "recording")
    viewer.add_image(data, **look)
    qtbot.waitUntil(lambda: dock.input.frames.edit.text() != "", timeout=MILLISECONDS)
    return viewer, dock, reader


def test_the_burst_that_suits_best_is_suggested_and_others_can_be_chosen(opened, recording):
    viewer, dock, _ = opened
    row, best = dock.input.frames, best_burst(recording)
    assert row.edit.text() == f"{best.start}:{best.stop}"
    assert f"{best.start} to {best.stop - 1} of {FRAMES}" in row.words.text()
    np.testing.assert_array_equal(dock.input.source().read().frames, recording.burst(best).frames)
    viewer.dims.set_current_step(0, 222)
    row.shown_button.click()
    assert row.edit.text() == "212:232"
    row.edit.setText("100:120:2")
    source = dock.input.source()
    assert source.shape == (10, 63, 75, 1)
    np.testing.assert_array_equal(source.read().frames, recording.burst(range(100, 120, 2)).frames)
    assert "data[100:120:2]" in source.words[0]


def test_what_is_no_frame_is_said(opened):
    _, dock, _ = opened
    dock.input.frames.edit.setText("400:420")
    assert "none of them is in 400:420" in dock.glance.words.text()


def test_a_picture_of_a_recording_reads_its_burst_alone_and_lies_at_its_time(opened, run_through, qtbot):
    viewer, dock, reader = opened
    # The burst that was suggested is looked at in the background.
    qtbot.waitUntil(lambda: "·" in dock.glance.words.text(), timeout=MILLISECONDS)
    dock.input.frames.edit.setText("100:112")
    reader.read.clear()
    run = run_through(dock)
    assert set(reader.read) <= set(range(100, 112)) | {viewer.dims.current_step[0]}
    assert run.result.acquisition.shape[0] == 12
    assert "[100:112]" in run.python
    dock.picture.display.card.switches["stabilised burst"].setChecked(True)
    stabilised = viewer.layers["run 1: stabilised burst"]
    assert stabilised.extent.world[0, 0] == pytest.approx(99.5, abs=0.5)
    assert stabilised.data_to_world((3, 0, 0))[0] == 103


def test_a_burst_has_no_frames_to_choose_and_neither_has_what_works_on_all(opened, burst_layer):
    viewer, dock, _ = opened
    row = dock.input.frames
    assert not row.isHidden()
    dock.choose_task(MosaicTask)
    assert row.isHidden()
    dock.input.burst.value = viewer.add_layer(burst_layer)
    dock.task_bar.setCurrentIndex(0)
    assert row.isHidden()
    assert dock.input.source().chosen is None


def test_a_layer_in_memory_is_a_recording_too(open_dock, recording):
    viewer, dock = open_dock()
    values = recording.recorded(range(80))[..., 0]
    viewer.add_image(values, name="in memory", scale=(1, 0.5, 0.5), units=("pixel", "um", "um"))
    found = recording_in(dock.input.recorded())
    assert found.shape == (80, 63, 75, 1)
    assert found.acquisition.pixel_size == (0.5, 0.5)
    np.testing.assert_array_equal(found.recorded([17])[0, ..., 0], values[17])
