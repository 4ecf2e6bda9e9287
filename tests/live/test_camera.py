"""The simulated bundle camera, and how frames are taken from a camera of pymmcore-plus."""

import logging
import subprocess
import sys

import numpy as np
import pytest

from napari_fiberburst import FiberBurstError
from napari_fiberburst.live.camera import CameraSource
from napari_fiberburst.live.micromanager import UniMMCore
from napari_fiberburst.live.simulated_camera import SimulatedBundleCamera, simulated_core


@pytest.fixture
def core():
    core = simulated_core()
    core.setExposure(5)
    return core


def test_every_frame_comes_once_and_closing_stops_the_camera(core):
    source, frames = CameraSource(core), []
    while len(frames) < 12:
        got = source.latest(64)
        assert got.dropped == 0
        assert got.indices.tolist() == list(range(len(frames), len(frames) + len(got.frames)))
        frames.extend(got.frames)
    assert core.isSequenceRunning()
    source.close()
    assert not core.isSequenceRunning()
    assert len(source.latest().frames) == 0
    camera = SimulatedBundleCamera()
    expected = np.empty((256, 256), np.uint8)
    for frame in frames[:12]:
        camera.snap(expected)
        assert np.array_equal(frame[..., 0], expected)


def test_the_simulated_hand_moves_on_without_a_jump_where_its_clip_ends():
    camera = SimulatedBundleCamera()
    shown = np.stack([camera._frames.at(number)[::8, ::8].astype(float) for number in range(236, 246)])
    steps = np.abs(np.diff(shown, axis=0)).mean(axis=(1, 2))
    assert steps.max() < 2 * np.median(steps)
    assert np.array_equal(camera._frames.at(0), camera._frames.at(240))


def test_a_camera_that_stops_by_itself_ends_the_source(core):
    source = CameraSource(core)
    source.latest()
    core.stopSequenceAcquisition()
    for _ in range(100):
        if not len(source.latest().frames):
            break
    else:
        pytest.fail("frames come from a camera that has stopped")


def test_no_camera_and_a_running_one_are_refused(core, tmp_path):
    core.startContinuousSequenceAcquisition(0)
    with pytest.raises(FiberBurstError, match="is running already; stop its live view, or choose the image layer"):
        CameraSource(core)
    core.stopSequenceAcquisition()
    with pytest.raises(FiberBurstError, match="no camera is loaded"):
        CameraSource(UniMMCore(mm_path=str(tmp_path)))


def test_the_log_of_others_stays_as_it_was():
    """In a process of its own, because what is imported is not imported again."""
    program = "import logging, napari_fiberburst.live.simulated_camera; print(logging.root.level)"
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert int(told) == logging.WARNING
