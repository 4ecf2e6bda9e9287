"""The camera's noise is measured in the burst itself."""

from dataclasses import replace

import pytest
import torch

from napari_fiberburst import calibrate, sample
from napari_fiberburst.bundle.noise import Noise, measure_noise
from napari_fiberburst.simulation import Camera, Faults, simulate

SHAPE = (131, 147)


def measured(photons, **changes):
    look = {"shape": SHAPE, "frames": 12, "channels": 1, "physics": "core", "pitch": 5.0, **changes}
    burst = simulate("histology", camera=Camera(photons=photons, bits=12), **look).burst
    bundle = calibrate(burst, device="cpu")
    grey = torch.from_numpy(burst.frames).mean(dim=3)
    samples = sample(burst, bundle, device="cpu")
    samples = replace(samples, values=samples.grey[..., None])
    return measure_noise(grey, bundle, burst, samples), bundle, burst, samples


@pytest.mark.parametrize("photons", [300.0, 3000.0, 30_000.0])
def test_shot_noise_is_that_of_the_electrons(photons):
    noise, *_ = measured(photons)
    assert noise.shot * photons == pytest.approx(1, abs=0.15)


def test_noise_does_not_depend_on_how_many_pixels_there_are():
    noise, bundle, *_ = measured(3000.0, shape=(483, 521), frames=5)
    assert (bundle.transmission > 0.3).sum() > 80_000  # of which no more than half are asked
    assert noise.shot * 3000 == pytest.approx(1, abs=0.15)


def test_flicker_and_channels_do_not_pass_for_noise():
    flickering, *_ = measured(3000.0, faults=Faults(flicker=0.2))
    colour, *_ = measured(3000.0, channels=3)
    assert flickering.shot * 3000 == pytest.approx(1, abs=0.15)
    assert colour.shot * 3000 * 3 == pytest.approx(1, abs=0.2)  # of the mean of three channels


def test_read_noise_is_what_is_left_in_the_dark():
    noise, *_ = measured(1e7)
    assert noise.read**0.5 == pytest.approx(0.0014, rel=0.35)


def test_a_core_has_less_noise_than_its_pixels():
    _, bundle, burst, samples = measured(3000.0)
    variance = Noise(shot=1e-3, read=0.0).of_samples(bundle, burst, samples)
    light = samples.grey.clamp_min(0)
    used = samples.weights > 0.5
    assert float((variance / (1e-3 * light))[used].median()) < 0.3
    doubled = Noise(shot=2e-3, read=0.0).of_samples(bundle, burst, samples)
    torch.testing.assert_close(doubled, 2 * variance)


def test_without_cores_there_is_nothing_to_measure_by():
    burst = simulate("cat", shape=SHAPE, frames=6, channels=1, pitch=2.4).burst
    bundle = calibrate(burst, device="cpu")
    assert not bundle.is_resolved
    samples = sample(burst, bundle, device="cpu")
    assert measure_noise(torch.from_numpy(burst.frames).mean(dim=3), bundle, burst, samples) is None


def test_the_dark_is_not_without_noise_where_the_light_is_noisier_than_shot_noise(rng):
    """As of profiles that are slightly wrong: their error grows with the square of the light."""
    _, bundle, burst, samples = measured(1e7)
    grey = torch.from_numpy(burst.frames).mean(dim=3)
    grey = grey * (1 + 0.05 * torch.from_numpy(rng.standard_normal(grey.shape)).float())
    rounded = torch.round(255 * grey) / 255
    noise = measure_noise(rounded, bundle, burst, samples)
    assert noise.read >= 1 / 255**2 / 12 * 0.99
    assert 0 < measure_noise(grey, bundle, burst, samples).read < noise.read
