"""What was seen is forgotten sooner where it changes."""

import numpy as np
import pytest

from napari_fiberburst import Bundle, LiveEngine
from napari_fiberburst.quality import match_levels, psnr
from napari_fiberburst.simulation import Camera, simulate_recording

SHAPE, FRAMES = (141, 167), 90


def watched(half_life=None, **recorded):
    """Return the half-lives of a recording's frames, and the PSNR of the last ones."""
    recording = simulate_recording(frames=FRAMES, shape=SHAPE, pitch=5.0, path="handheld", seed=3, **recorded)
    flat = np.rint(np.clip(recording.transmission * 255, 0, 255)).astype(np.uint8)
    engine = LiveEngine(Bundle.from_image(flat), half_life=half_life, improves=False)
    views = [engine.push(frame) for frame in recording.source.recorded(range(FRAMES))[..., 0]]
    inner = (slice(12, -12), slice(12, -12))
    found = []
    for number in range(FRAMES - 30, FRAMES, 5):
        image, truth = views[number].image[inner], recording.truth([number])[0, ..., 0][inner]
        found.append(psnr(match_levels(image[..., None], truth[..., None]), truth[..., None]))
    return np.array([view.half_life for view in views]), float(np.mean(found))


@pytest.mark.parametrize("step", [0.5, 3.0])
def test_tissue_that_bends_is_forgotten_sooner(step):
    lives, itself = watched(step=step, bending=5.0)
    _, fixed = watched(step=step, bending=5.0, half_life=20)
    assert lives[20:].min() < 10
    assert itself > fixed + 0.4


@pytest.mark.parametrize("camera", [Camera(), Camera(photons=300, read_noise=0.01)], ids=["bright", "dim"])
def test_what_is_at_rest_is_remembered(camera):
    lives, _ = watched(step=2.0, camera=camera)
    assert np.all(lives[10:] > 15)


def test_the_half_life_can_be_set_by_hand():
    lives, short = watched(step=2.0, half_life=4)
    _, longer = watched(step=2.0, half_life=20)
    assert set(lives) == {4.0}
    assert longer > short + 0.5
