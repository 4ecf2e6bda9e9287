"""A probe that goes to and fro over the same place, so that the nodes behind it move and come back."""

import numpy as np

from napari_fiberburst import Bundle, LiveEngine
from napari_fiberburst.simulation import simulate_recording


def swinging(frames, sizes):
    """Return homographies of swings of so many pixels, one in 40 frames along x and one in 30 along y."""
    turns = 2 * np.pi * np.arange(frames)
    path = np.tile(np.eye(3), (frames, 1, 1))
    for axis, (size, every) in enumerate(zip(sizes, (40, 30), strict=True)):
        path[:, axis, 2] = size * np.sin(turns / every)
    return path


def test_the_scene_stays_one_and_places_true_over_four_swings():
    path = swinging(160, (29.0, 22.0))
    recording = simulate_recording(shape=(121, 143), pitch=5.0, path=path, seed=3)
    bundle = Bundle.from_image(np.rint(np.clip(recording.transmission * 255, 0, 255)).astype(np.uint8))
    engine = LiveEngine(bundle)
    views = [engine.push(frame[..., 0]) for frame in recording.source.recorded(range(160))]
    assert {view.state for view in views} == {"following"}
    assert views[-1].piece == 0
    middle = np.array([71, 60, 1])
    off = np.array([((view.homography - true) @ middle)[:2] for view, true in zip(views, path, strict=True)])[20:]
    assert np.hypot(*(off - np.median(off, axis=0)).T).max() < 1  # a fifth of a pitch
    low, high = np.nanquantile([view.image for view in views[20:]], [0.002, 0.998], axis=(1, 2))
    assert low.min() > -60
    assert high.max() < 400
