"""A bundle whose cores are hardly brighter than the space between them: 5 to 7 % about the local mean."""

import numpy as np
import pytest
import skimage.data
import torch
from scipy.ndimage import gaussian_filter, shift
from scipy.optimize import brentq
from scipy.spatial import cKDTree

from napari_fiberburst import Burst, reconstruct
from napari_fiberburst.bundle.calibrate import calibrate
from napari_fiberburst.bundle.pitch import find_pitch
from napari_fiberburst.quality import motion_error, psnr
from napari_fiberburst.simulation import SCENES, make_bundle, make_scene, simulate

SHAPE, PITCH = (224, 230), 3.8


def contrast(flat):
    """Return the standard deviation about the local mean, relative."""
    return (flat / gaussian_filter(flat, 3 * PITCH)).std()


def faint_bundle(wanted, rng):
    """Return cores, and their even light blurred until it varies by so much."""
    bundle = make_bundle(SHAPE, rng, pitch=PITCH, gain_spread=0.02, jitter=0.015, radius_spread=0.01)
    light = bundle.transmission(SHAPE)
    blurred = brentq(lambda width: contrast(gaussian_filter(light, width)) - wanted, 0.3, 3.0, xtol=1e-3)
    flat = gaussian_filter(light, blurred)
    return bundle, 0.8 * flat / flat.mean()


def faint_burst(scene, physics, wanted=0.066, frames=20, seed=0):
    """Return a burst, its truth, its homographies, and the bundle; steps of 4 px, 8000 electrons, 16 bits."""
    rng = np.random.default_rng(seed)
    bundle, flat = faint_bundle(wanted, rng)
    world = make_scene(scene, SHAPE, rng).with_channels(1)
    heading = rng.uniform(0, 2 * np.pi, frames - 1)
    shifts = np.zeros((frames, 2))
    shifts[1:] = np.cumsum(4 * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    y, x = np.indices(SHAPE)
    pixels = np.stack([x, y], axis=-1)
    truth = np.stack([world.sample(pixels + shift)[..., 0] for shift in shifts])
    light = truth
    if physics == "core":
        # All of a core's cell shows one value, the mean of what falls on it.
        core = cKDTree(bundle.centres).query(pixels.reshape(-1, 2))[1]
        weight = flat.ravel() ** 2
        mass = np.maximum(np.bincount(core, weight, len(bundle.centres)), 1e-9)
        light = np.stack([(np.bincount(core, weight * frame.ravel(), len(mass)) / mass)[core] for frame in truth])
    electrons = rng.poisson(8000 * light.reshape(truth.shape) * flat)
    recorded = np.rint(np.clip(electrons / 10_000, 0, 1) * 65535).astype(np.uint16)
    homographies = np.tile(np.eye(3), (frames, 1, 1))
    homographies[:, :2, 2] = shifts
    return Burst(recorded, black_level=0, white_level=65535), truth, homographies, bundle


def fitted_psnr(image, truth):
    """Return the PSNR after the best gain and offset."""
    design = np.stack([image.ravel(), np.ones(image.size)], axis=1)
    best = design @ np.linalg.lstsq(design, truth.ravel(), rcond=None)[0]
    return psnr(best.reshape(truth.shape), truth)


@pytest.mark.parametrize("scene", ["histology", "cat"])
def test_the_cores_of_a_faint_bundle_are_found(scene):
    burst, _, _, bundle = faint_burst(scene, "core")
    found = calibrate(burst)
    assert found.pitch == pytest.approx(PITCH, rel=0.02)
    inner = (bundle.centres > 3).all(axis=1) & (bundle.centres < np.array(SHAPE[::-1]) - 4).all(axis=1)
    distance, _ = cKDTree(found.centres).query(bundle.centres[inner])
    assert (distance < 0.3 * PITCH).mean() > 0.95
    assert len(found.centres) == pytest.approx(len(bundle.centres), rel=0.03)


@pytest.mark.parametrize("wanted", [0.05, 0.066, 0.09])
def test_the_pitch_of_a_faint_flat_is_found(wanted, rng):
    _, flat = faint_bundle(wanted, rng)
    noisy = flat + rng.normal(0, 0.002, SHAPE)
    assert find_pitch(torch.from_numpy(noisy).float()) == pytest.approx(PITCH, rel=0.02)


def test_the_space_between_faint_cores_is_not_black():
    burst, _, _, _ = faint_burst("histology", "core")
    assert calibrate(burst).black == 0


@pytest.mark.parametrize(("physics", "gain"), [("core", 3.0), ("mask", 10.0)])
def test_a_faint_bundle_is_told_from_the_object(physics, gain):
    burst, truth, homographies, _ = faint_burst("histology", physics)
    result = reconstruct(burst, fill=True)
    assert motion_error(result.homographies, homographies, SHAPE) < 0.2
    frame = burst.frames[0, ..., 0]
    filtered = max(fitted_psnr(gaussian_filter(frame, width), truth[0]) for width in np.arange(0.4, 3, 0.2))
    assert fitted_psnr(result.image, truth[0]) > filtered + gain


# Of cells on a dark ground so little is lit that noise can pass for a bundle.
@pytest.mark.parametrize("scene", sorted({*SCENES} - {"cells"}))
@pytest.mark.parametrize("frames", [6, 10, 20])
def test_the_mean_of_a_plain_burst_shows_no_faint_bundle(scene, frames, rng):
    for motion in ("brownian", "raster"):
        truth = simulate(scene, shape=(187, 191), frames=frames, motion=motion, seed=1).truth.mean(axis=3)
        mean = np.clip(truth + rng.normal(0, 0.01, truth.shape), 0, 1).mean(axis=0)
        assert find_pitch(torch.from_numpy(mean).float()) is None


@pytest.mark.parametrize("name", ["brick", "grass", "gravel", "camera", "coins", "moon", "cell", "clock", "text"])
def test_an_image_of_something_else_shows_no_faint_bundle(name, rng):
    image = getattr(skimage.data, name)().astype(np.float64) / 255
    moved = np.mean([shift(image, step, order=1, mode="reflect") for step in rng.normal(0, 8, (6, 2))], axis=0)
    for shown in (image, moved):
        # Whatever it shows is brought to the contrast of a faint bundle.
        faint = 0.5 + 0.1 * (shown - shown.mean())
        assert find_pitch(torch.from_numpy(shown).float()) is None
        assert find_pitch(torch.from_numpy(faint).float()) is None


@pytest.mark.parametrize("width", [0.0, 0.5, 1.0, 2.0, 4.0])
def test_smooth_noise_shows_no_faint_bundle(width, rng):
    for _ in range(4):
        noise = gaussian_filter(rng.normal(size=(203, 231)), width)
        assert find_pitch(torch.from_numpy(0.5 + 0.03 * noise / noise.std()).float()) is None


def test_what_alternates_from_pixel_to_pixel_is_no_bundle():
    """At the camera's own period there is nothing beyond, so a ring cannot be told from the end of the spectrum."""
    even = (9 + np.indices((91, 103)).sum(axis=0) % 2) / 255
    assert find_pitch(torch.from_numpy(even).float()) is None


def test_the_blocks_of_a_compressed_video_are_no_bundle(rng):
    """They draw lines into the spectrum, but hardly into the image."""
    image = 0.5 + 0.1 * gaussian_filter(rng.normal(size=(208, 232)), 6)
    image[::8] += 0.004
    image[:, ::8] += 0.004
    assert find_pitch(torch.from_numpy(image).float()) is None
