"""Live view over many frames."""

import tracemalloc
from functools import lru_cache

import numpy as np

from napari_fiberburst import Bundle, LiveEngine
from napari_fiberburst.quality import psnr
from napari_fiberburst.simulation import simulate_recording


@lru_cache
def recorded(shape, frames, **more):
    recording = simulate_recording(frames=frames, shape=shape, pitch=5.0, path="handheld", step=1.5, seed=5, **more)
    bundle = Bundle.from_image(np.rint(np.clip(recording.transmission * 255, 0, 255)).astype(np.uint8))
    return recording, bundle, recording.source.recorded(range(frames))[..., 0]


def test_places_do_not_drift_while_a_hand_comes_back():
    shape = (131, 157)
    recording, bundle, frames = recorded(shape, 200)
    engine = LiveEngine(bundle)
    views = [engine.push(frame) for frame in frames]
    assert {(view.state, view.piece) for view in views} == {("following", 0)}
    corners = np.array([[0, 0, 1], [shape[1] - 1, 0, 1], [0, shape[0] - 1, 1], [shape[1] - 1, shape[0] - 1, 1]])
    off = np.array(
        [
            ((view.homography - truth) @ corners.T)[:2].T
            for view, truth in zip(views, recording.homographies, strict=True)
        ]
    )
    drift = np.linalg.norm(off[20:] - off[20:40].mean(axis=0), axis=2)
    assert np.ptp(recording.homographies[:, :2, 2], axis=0).max() > 0.5 * min(shape)
    assert drift.mean(axis=1).max() < 0.3


def test_the_same_frames_make_the_same_bits():
    _, bundle, frames = recorded((131, 157), 200)
    first, second = LiveEngine(bundle), LiveEngine(bundle)
    for frame in frames[:25]:
        views = first.push(frame), second.push(frame)
        assert views[0].image.tobytes() == views[1].image.tobytes()
        assert views[0].homography.tobytes() == views[1].homography.tobytes()


def test_memory_does_not_grow():
    _, bundle, frames = recorded((64, 75), 60)
    engine = LiveEngine(bundle, improves=False)  # which keeps frames for a while
    there_and_back = np.concatenate([frames, frames[-2:0:-1]])
    held = []
    tracemalloc.start()
    try:
        for _ in range(5):
            for frame in there_and_back:
                engine.push(frame)
            held.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert engine.push(frames[0]).state == "following"
    assert held[-1] - held[1] < 100_000


def test_a_probe_that_turns_is_followed():
    recording, bundle, frames = recorded((131, 157), 60, turn=12.0)
    engine = LiveEngine(bundle)
    views = [engine.push(frame) for frame in frames]
    turns = [np.arctan2(matrix[1, 0], matrix[0, 0]) for matrix in (views[-1].homography, recording.homographies[-1])]
    assert {view.piece for view in views} == {0}
    assert np.ptp([np.arctan2(truth[1, 0], truth[0, 0]) for truth in recording.homographies]) > 0.1
    assert abs(turns[0] - turns[1]) < 0.02
    inner = (slice(12, -12), slice(12, -12))
    truths = recording.truth(range(60))[..., 0]
    assert min(psnr(view.image[inner], truth[inner]) for view, truth in zip(views[20:], truths[20:], strict=True)) > 31
