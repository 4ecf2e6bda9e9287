"""What the dock says of a burst before it is run."""

import dask.array
import numpy as np
from napari.layers import Image

MILLISECONDS = 60_000


def said(dock, qtbot):
    """Return what is said of the burst once it has been looked at."""
    qtbot.waitUntil(lambda: dock.glance.strip.isVisibleTo(dock.glance), timeout=MILLISECONDS)
    return dock.glance.words.text()


def test_a_burst_is_described_before_it_is_run(open_dock, burst_layer, qtbot):
    _, dock = open_dock(burst_layer)
    assert said(dock, qtbot).startswith("8 frames, 63 x 75, RGB · cores 4.0 px apart · moves by ")
    assert not dock.glance.strip.pixmap().isNull()


def test_another_burst_is_looked_at_anew(open_dock, burst_layer, grey_frames, qtbot):
    viewer, dock = open_dock(burst_layer)
    said(dock, qtbot)
    layer = viewer.add_layer(Image(grey_frames, name="grey", scale=(1, 0.5, 0.5), units=("pixel", "um", "um")))
    dock.input.burst.value = layer
    assert said(dock, qtbot).startswith("8 frames, 63 x 75, grey, 0.5 µm · cores")


def test_what_speaks_against_a_burst_is_said_before_start(open_dock, grey_frames, qtbot):
    still = np.repeat(grey_frames[:1], 6, axis=0)
    _, dock = open_dock(Image(still, name="still"))
    assert "gaps between cores stay" in said(dock, qtbot)


def test_a_layer_that_is_no_burst_says_why(open_dock, grey_frames):
    _, dock = open_dock(Image(grey_frames[0], name="one frame"))
    assert "one frame is a burst only where its bundle is known" in dock.glance.words.text()
    assert dock.glance.strip.isHidden()


def test_few_frames_of_a_lazy_recording_are_read(open_dock, grey_frames, qtbot):
    read = []

    def frame(block_info=None):
        read.append(block_info[None]["chunk-location"][0])
        return grey_frames[read[-1] % len(grey_frames)][None]

    frames = dask.array.map_blocks(frame, chunks=((1,) * 5000, (63,), (75,)), dtype=np.uint8)
    _, dock = open_dock(Image(frames, name="recording"))
    assert said(dock, qtbot).startswith("20 frames of a recording")
    assert len(set(read)) < 500


def test_frames_that_cannot_be_read_are_said(open_dock, qtbot):
    def fail(block_info=None):
        if block_info[None]["chunk-location"][0] > 5:  # not the frame that napari shows first
            raise OSError("the disk is gone")
        return np.full((1, 63, 75), 7, np.uint8)

    frames = dask.array.map_blocks(fail, chunks=((1,) * 9, (63,), (75,)), dtype=np.uint8)
    _, dock = open_dock(Image(frames, name="lost", contrast_limits=(0, 255)))
    qtbot.waitUntil(lambda: "the disk is gone" in dock.glance.words.text(), timeout=MILLISECONDS)
