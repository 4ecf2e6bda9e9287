"""A bundle that is given is where a burst starts from, and is corrected as far as the burst bears that out."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from napari_fiberburst import Bundle, reconstruct
from napari_fiberburst.quality import psnr
from napari_fiberburst.simulation import Camera, simulate

SHAPE = (137, 151)


def recorded(still=False):
    motion = np.tile(np.eye(3), (12, 1, 1)) if still else "brownian"
    camera = Camera(photons=8000, bits=10, exposure=0.8)
    physics = {"physics": "core", "pitch": 4.7, "channels": 1}
    return simulate("histology", shape=SHAPE, frames=12, motion=motion, camera=camera, seed=1, **physics)


def given(simulated):
    return Bundle.from_image(np.rint(800 * simulated.transmission).astype(np.uint16))


def off_by(bundle, spread=0.0, vignette=0.0):
    """Return the bundle with gains that are wrong at random, and by what darkens towards the rim."""
    height, width = bundle.shape
    distance = ((bundle.centres - [width / 2, height / 2]) / (width / 2)) ** 2
    wrong = 1 + spread * np.random.default_rng(0).standard_normal(len(distance))
    factor = np.append(wrong * np.exp(-vignette * distance.sum(axis=1)), 1)[bundle.labels]
    return replace(bundle, transmission=(bundle.transmission * factor).astype(np.float32))


def quality(result, simulated):
    seen = np.isfinite(result.image)
    return psnr(result.image[seen][None], simulated.truth[0, ..., 0][seen][None])


@pytest.fixture(scope="module")
def moving():
    simulated = recorded()
    bundle = given(simulated)
    result = reconstruct(simulated.burst, bundle=bundle)
    return simulated, bundle, result, quality(result, simulated)


@pytest.fixture(scope="module")
def corrected(moving):
    """Return a function that gives what comes of a bundle with gains that are off."""
    simulated, bundle, _, _ = moving
    return cache(lambda **error: reconstruct(simulated.burst, bundle=off_by(bundle, **error)))


def test_exact_gains_stay_as_they_are(moving):
    simulated, bundle, result, best = moving
    change = result.bundle.brightness / bundle.brightness
    assert np.quantile(np.abs(change / np.median(change) - 1), 0.68) < 0.006
    assert not any("corrected" in note for note in result.notes)
    assert best > quality(reconstruct(simulated.burst), simulated) - 0.02


@pytest.mark.parametrize("error", [{"spread": 0.03}, {"spread": 0.08}, {"vignette": 0.1}, {"vignette": 0.3}])
def test_gains_that_are_off_are_corrected_by_a_burst_that_moves(moving, corrected, error):
    simulated, bundle, _, best = moving
    wrong = off_by(bundle, **error)
    result = corrected(**error)
    assert quality(result, simulated) > best - 0.4
    left = result.bundle.brightness / bundle.brightness
    before = wrong.brightness / bundle.brightness
    off, was = (np.quantile(np.abs(part / np.median(part) - 1), 0.68) for part in (left, before))
    assert off < 0.5 * was
    assert result.quality == "good"


def test_a_large_correction_is_told(corrected):
    notes = corrected(spread=0.08).notes
    assert any("corrected the gains of the given bundle by 8 % (rms)" in note for note in notes)
    notes = corrected(spread=0.15).notes
    assert any("as if it were of another bundle" in note for note in notes)


def test_where_nothing_moves_a_given_bundle_is_taken_at_its_word():
    simulated = recorded(still=True)
    wrong = off_by(given(simulated), 0.05)
    result = reconstruct(simulated.burst, bundle=wrong, smoothness=0.02)
    np.testing.assert_allclose(result.bundle.brightness, wrong.brightness, rtol=1e-5)
    assert not any("corrected" in note for note in result.notes)


def test_a_given_bundle_that_has_moved_is_corrected_too(moving):
    simulated, bundle, _, best = moving
    away = np.array([[1, 0, 2.3], [0, 1, -1.6], [0, 0, 1.0]])
    result = reconstruct(simulated.burst, bundle=off_by(bundle, 0.03).moved(away))
    assert any("px" in note for note in result.notes)
    assert quality(result, simulated) > best - 0.8
