"""Bundles that move on the camera or are others than was said, beside what the simulator knows."""

from functools import lru_cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from napari_fiberburst import Bundle, LiveEngine
from napari_fiberburst.quality import match_levels, psnr
from napari_fiberburst.simulation import Camera, simulate_recording

SHAPE, FRAMES = (141, 167), 44


@lru_cache
def recorded(scene="slide", seed=3, **camera):
    return simulate_recording(
        scene,
        frames=FRAMES,
        shape=SHAPE,
        pitch=5.0,
        path="handheld",
        step=1.5,
        seed=seed,
        camera=Camera(**camera),
    )


def bundle_of(recording):
    return Bundle.from_image(np.rint(np.clip(recording.transmission * 255, 0, 255)).astype(np.uint8))


def frames_of(recording, first=0):
    return recording.source.recorded(range(first, FRAMES))[..., 0]


def quality(image, truth):
    inner = (slice(14, -14), slice(14, -14))
    return psnr(match_levels(image[inner], truth[inner]), truth[inner])


@pytest.mark.parametrize("scene", ["slide", "fluorescence"])
@pytest.mark.parametrize("camera", [{}, {"photons": 300, "read_noise": 0.01}], ids=["bright", "dim"])
def test_the_bundle_that_is_there_is_not_taken_for_another(scene, camera):
    recording = recorded(scene, **camera)
    engine = LiveEngine(bundle_of(recording))
    told = {engine.push(frame).advice for frame in frames_of(recording)}
    assert told <= {"fine", "move a little"}


@pytest.mark.parametrize("scene", ["slide", "fluorescence"])
def test_another_bundle_is_told_and_the_right_one_goes_on(scene):
    recording = recorded(scene)
    engine = LiveEngine(bundle_of(recorded(seed=9)))
    views = [engine.push(frame) for frame in frames_of(recording)]
    assert {(view.state, view.advice) for view in views[2:]} == {("lost", "another bundle")}
    right = [engine.push(frame) for frame in frames_of(recorded(seed=9))]
    assert {view.state for view in right[8:]} == {"following"}


@pytest.mark.parametrize("move", [(1, 0), (-1, 2), (0.6, -1.4)])
def test_a_bundle_that_moves_on_the_camera_is_followed(move):
    recording = recorded()
    start = bundle_of(recording)
    engine = LiveEngine(start)
    frames = [frame.astype(np.float32) / 255 for frame in frames_of(recording)]
    views = [engine.push(frame) for frame in frames[:16]]
    moved = [shift(frame, move[::-1], order=3, mode="nearest").clip(0, 1) for frame in frames[16:]]
    views += [engine.push(frame) for frame in moved]
    assert [view.advice for view in views].count("the bundle has moved") == 1
    assert (engine.bundle.centres - start.centres).mean(axis=0) == pytest.approx(move, abs=0.15)
    truth = shift(recording.truth([FRAMES - 1])[0][..., 0], move[::-1], order=3, mode="nearest")
    assert quality(views[-1].image, truth) > 27


def test_a_faint_honeycomb_is_not_taken_for_another_bundle():
    recording = recorded()

    def faint(image):
        return 0.3 * image + 0.7 * gaussian_filter(image, 2.5)

    engine = LiveEngine(Bundle.from_image(np.rint(400 * faint(recording.transmission)).clip(0, 255).astype(np.uint8)))
    told = {engine.push(np.rint(faint(frame.astype(np.float32)))).advice for frame in frames_of(recording)}
    assert "another bundle" not in told
    assert "the bundle has moved" not in told
