"""Frames that smear while they are exposed: the mean of many that are simulated on the way."""

import numpy as np
import pytest

from napari_fiberburst import Bundle, LiveEngine
from napari_fiberburst.simulation import Camera, simulate_recording

SHAPE, PITCH, FRAMES, SLOW, MOMENTS = (141, 167), 5.0, 30, 12, 6


def recorded(scene, seed, step, part):
    """Return frames that go slowly at first and then by so many pixels each, for part of which they are exposed."""
    rng = np.random.default_rng(seed)
    start, place, moments = rng.uniform(0, 2 * np.pi), np.zeros(2), []
    for number in range(FRAMES):
        angle = start + 0.5 * np.sin(number / 6)
        way = (1.0 if number < SLOW else step) * np.array([np.cos(angle), np.sin(angle)])
        exposed = part if number >= SLOW else 0.0
        moments += [place + exposed * ((k + 0.5) / MOMENTS - 0.5) * way for k in range(MOMENTS)]
        place = place + way
    path = np.tile(np.eye(3), (len(moments), 1, 1))
    path[:, :2, 2] = np.array(moments) - moments[0]
    ideal = Camera(bits=16, photons=1e9, read_noise=0)
    recording = simulate_recording(scene, shape=SHAPE, pitch=PITCH, path=path, seed=seed, camera=ideal)
    light = recording.source.recorded(range(len(moments)))[..., 0].astype(np.float32) / 65535
    light = light.reshape(FRAMES, MOMENTS, *SHAPE).mean(axis=1)
    noisy = light + rng.standard_normal(light.shape) * np.sqrt(light / 10_000 + 0.0014**2)
    bundle = Bundle.from_image(np.rint(np.clip(recording.transmission * 255, 0, 255)).astype(np.uint8))
    return bundle, np.rint(255 * noisy.clip(0, 1)).astype(np.uint8)


def advised(scene, seed, step, part):
    bundle, frames = recorded(scene, seed, step, part)
    engine = LiveEngine(bundle)
    return [engine.push(frame).advice for frame in frames]


@pytest.mark.parametrize("scene", ["slide", "fluorescence"])
@pytest.mark.parametrize("seed", [1, 2, 5])
def test_frames_that_smear_are_told(scene, seed):
    advice = advised(scene, seed, 4.0, 0.9)
    assert "hold still" not in advice[:SLOW]
    assert "hold still" in advice[SLOW : SLOW + 6]


@pytest.mark.parametrize("scene", ["slide", "fluorescence"])
@pytest.mark.parametrize("seed", [1, 2, 5])
def test_frames_that_are_sharp_are_not(scene, seed):
    assert "hold still" not in advised(scene, seed, 4.0, 0.0)
