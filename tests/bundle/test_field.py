"""The field is found from the burst alone: round, cut, notched, with marks drawn about it; and none of it is lost."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation

from napari_fiberburst import Burst, reconstruct
from napari_fiberburst.bundle.calibrate import calibrate
from napari_fiberburst.bundle.field import find_field, find_marks, without_rim
from napari_fiberburst.bundle.samples import sample
from napari_fiberburst.quality import psnr
from napari_fiberburst.simulation import SCENES, Faults, make_bundle, make_scene, simulate
from napari_fiberburst.simulation.field import overlay

SHAPE = (211, 257)
MIDDLE = np.array([128.0, 105.0])


def from_middle():
    y, x = np.indices(SHAPE)
    return np.hypot(x - MIDDLE[0], y - MIDDLE[1])


def disc():
    """Return a round field, 70 % of the frame's height across."""
    return from_middle() < 0.35 * SHAPE[0]


def half_disc():
    y, x = np.indices(SHAPE)
    return (from_middle() < 0.45 * SHAPE[0]) & (x + 0.3 * y > 150)


def notched_disc():
    y, x = np.indices(SHAPE)
    return (from_middle() < 0.45 * SHAPE[0]) & ~((np.abs(y - 100) < 25) & (x > 120))


def marks():
    """Return the pixels of a scale bar, letters and a logo."""
    found = np.zeros(SHAPE, dtype=bool)
    found[202:205, 8:59] = True
    found[5:8, 6:36] = True
    for number in range(4):
        found[5:17, 6 + 9 * number : 9 + 9 * number] = True
    found[4:16, 231:249] = True
    found[7:13, 237:243] = False
    return found


def walk(count, step, rng):
    """Return shifts (T, 2) of a path that hardly turns, `step` pixels a frame."""
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.25, count))
    steps = rng.uniform(step - 1, step + 1, (count, 1)) * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    steps[0] = 0
    return np.cumsum(steps, axis=0)


def seen(scene, shifts, rng):
    """Return what lies behind each pixel, (T, H, W)."""
    world = make_scene(scene, SHAPE, rng).with_channels(1)
    y, x = np.indices(SHAPE)
    return np.stack([world.sample(np.stack([x, y], axis=-1) + shift)[..., 0] for shift in shifts])


def recorded(light, noise, rng, drawn=None):
    """Return a burst of light (T, H, W) with noise, and marks that were drawn into its frames."""
    frames = np.clip(light + rng.normal(0, noise, light.shape), 0, 1)
    if drawn is not None:
        frames[:, drawn] = 1
    return Burst(np.rint(frames * 255).astype(np.uint8), black_level=0, white_level=255)


def grey(burst):
    return torch.from_numpy(burst.frames).mean(dim=3)


def error_of_middle(homographies, shifts):
    """Return by how much each frame's middle lies off, pixels."""
    places = homographies @ np.append(MIDDLE, 1.0)
    return np.hypot(*(places[:, :2] / places[:, 2:] - MIDDLE - shifts).T)


# A dark ground at the frame's edge may as well be surroundings.
@pytest.mark.parametrize("scene", sorted({*SCENES} - {"cells"}))
@pytest.mark.parametrize(
    "settings",
    [{"frames": 3, "motion": "raster"}, {"frames": 8, "pitch": 6.0, "physics": "core"}, {"frames": 5, "pitch": 20.0}],
)
def test_a_burst_that_fills_the_frame_loses_nothing(scene, settings):
    simulated = simulate(scene, shape=(151, 163), seed=2, **settings)
    burst = simulated.burst if "pitch" in settings else Burst(simulated.truth)
    assert find_field(grey(burst), settings.get("pitch")).all()
    if "pitch" not in settings:
        bundle = calibrate(burst)
        assert bundle.outline.all()
        np.testing.assert_array_equal(np.unique(bundle.labels), np.arange(38 * 41))


@pytest.mark.parametrize("scene", ["histology", "retina", "tissue"])
@pytest.mark.parametrize("shape", [disc, half_disc, notched_disc])
@pytest.mark.parametrize("noise", [0.002, 0.03])
def test_a_field_of_any_shape_is_found_and_marks_are_not(scene, shape, noise, rng):
    true = shape()
    burst = recorded(seen(scene, walk(16, 5, rng), rng) * true, noise, rng, marks())
    found = find_field(grey(burst))
    inner = without_rim(found).numpy()
    found = found.numpy()
    # What is taken for field is smoothed light, so it reaches some 3 px beyond; the rim that is left out is 6 px wide.
    assert (found & true).sum() > 0.99 * true.sum()
    assert not (inner & marks()).any()
    assert (inner & ~true).sum() < 0.003 * true.sum()
    assert (inner & true).sum() > 0.85 * true.sum()


def test_a_vignette_ends_where_it_is_dark(rng):
    shade = np.clip(1.2 - (from_middle() / 100) ** 2, 0, 1)
    burst = recorded(seen("cat", walk(12, 5, rng), rng) * shade, 0.005, rng)
    found = find_field(grey(burst)).numpy()
    assert found[shade > 0.2].mean() > 0.99
    assert not found[from_middle() > 125].any()


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03])
def test_a_still_burst_keeps_its_field(noise, rng):
    true = disc()
    burst = recorded(seen("cat", np.zeros((8, 2)), rng) * true, noise, rng, marks())
    found = find_field(grey(burst)).numpy()
    assert found[true].all()
    assert found.sum() < 1.2 * true.sum()


def test_a_dark_part_of_the_object_is_field_too(rng):
    """Dark tissue that covers a third of the field moves, or has light about it."""
    true, shifts = disc(), walk(16, 5, rng)
    y, x = np.indices(SHAPE)
    light = seen("cat", shifts, rng)
    for frame, (right, down) in zip(light, shifts, strict=True):
        frame[np.hypot(x + right - 140, y + down - 105) < 40] = 0
    found = find_field(grey(recorded(light * true, 0.005, rng, marks()))).numpy()
    assert found[true].mean() > 0.99
    assert not (found & marks()).any()


def test_an_object_that_moves_on_a_dark_ground_is_no_field(rng):
    """Its outline moves along with it; that of a field stands still."""
    y, x = np.indices(SHAPE)
    shifts = walk(16, 3, rng)
    light = seen("cat", shifts, rng)
    for frame, (right, down) in zip(light, shifts, strict=True):
        frame[np.hypot(x + right - 128, y + down - 105) > 60] = 0.02
    assert find_field(grey(recorded(light, 0.01, rng))).all()


def test_pixels_outside_the_field_are_no_samples(rng):
    true = disc()
    burst = recorded(seen("histology", walk(8, 5, rng), rng) * true, 0.005, rng, marks())
    bundle = calibrate(burst)
    assert bundle.pattern == "none"
    np.testing.assert_array_equal(bundle.labels < len(bundle.centres), bundle.outline)
    assert np.hypot(*(bundle.centres - MIDDLE).T).max() < 0.35 * SHAPE[0]
    cores, pixels = (sample(burst, bundle, kind) for kind in ("cores", "pixels"))
    assert (cores.weights > 0).all()
    assert len(pixels.positions) == bundle.outline.sum()


@pytest.mark.parametrize("scene", ["histology", "retina"])
def test_motion_follows_the_object_and_not_a_static_outline(scene):
    rng = np.random.default_rng(0)
    true, shifts = disc(), walk(16, 5, rng)
    assert np.abs(shifts).max() > 40
    burst = recorded(seen(scene, shifts, rng) * true, 0.01, rng, marks())
    result = reconstruct(burst)
    assert result.frames_used == tuple(range(16))
    assert np.median(error_of_middle(result.homographies, shifts)) < 0.1
    # Where no frame's field has looked there is no image, whatever has been drawn there.
    y, x = np.indices(SHAPE)
    distance = np.min([np.hypot(x - MIDDLE[0] - right, y - MIDDLE[1] - down) for right, down in shifts], axis=0)
    assert np.isnan(result.image[distance > 0.35 * SHAPE[0] + 4]).all()
    assert np.isfinite(result.image[distance < 0.35 * SHAPE[0] - 8]).all()


@pytest.mark.parametrize("is_cut", [False, True])
def test_a_round_bundle_with_marks_about_it_has_cores_only_inside(is_cut):
    rng = np.random.default_rng(0)
    laid = make_bundle(SHAPE, rng, pitch=5.0, crosstalk=0.0)
    kept = np.hypot(*(laid.centres - MIDDLE).T) < 70
    if is_cut:
        kept &= laid.centres[:, 0] > 110
    bundle = replace(laid, centres=laid.centres[kept], radii=laid.radii[kept], gains=laid.gains[kept])
    shifts = walk(12, 5, rng)
    truth = seen("histology", shifts, rng)
    profiles = bundle.profiles(SHAPE)
    gathered = (profiles.T @ truth.reshape(12, -1).T) / profiles.sum(axis=0)[:, None]
    light = (profiles @ (gathered * bundle.gains[:, None])).T.reshape(truth.shape)
    result = reconstruct(recorded(light, 0.01, rng, marks()))
    found = result.bundle.centres
    assert result.bundle.is_resolved
    assert (np.hypot(*(found - MIDDLE).T) < 76).all()
    assert len(found) == pytest.approx(kept.sum(), rel=0.02)
    assert np.median(error_of_middle(result.homographies, shifts)) < 0.3
    _, x = np.indices(SHAPE)
    inside = (from_middle() < 65) & ((x > 118) | (not is_cut))
    assert psnr(result.image[inside][None] / 255, truth[0][inside][None]) > 27


def marked(scene, **more):
    """Return a burst with a round field, a logo, a scale bar, and a cross within the field."""
    faults = Faults(field=0.8, overlay=True)
    return simulate(scene, shape=(157, 171), pitch=4.7, physics="core", faults=faults, seed=1, **more)


@pytest.mark.parametrize("scene", ["histology", "tissue", "usaf"])
def test_marks_are_found_with_their_edges_and_no_core_is_taken_for_one(scene):
    made = marked(scene)
    found = find_marks(grey(made.burst)).numpy()
    burned_in = overlay(found.shape, 0.4 * found.shape[0])
    assert found[burned_in].all()
    assert not (found & ~binary_dilation(burned_in, np.ones((3, 3)))).any()


@pytest.mark.parametrize("scene", ["histology", "tissue", "usaf"])
def test_bursts_without_marks_have_none(scene):
    assert not find_marks(grey(simulate(scene, shape=(101, 117), physics="core", seed=1).burst)).any()


def test_a_mark_in_the_field_draws_no_spots_beside_it():
    made = marked("tissue")
    y, x = np.indices(made.visible.shape)
    where = made.visible & (np.hypot(x - 85, y - 78) < 45)
    image = reconstruct(made.burst, fill=True).image / 255
    assert psnr(image[where][None], made.truth[0][where][None]) > 27


def test_marks_are_left_out_of_a_known_bundle_too():
    made, clean = marked("tissue"), simulate("tissue", shape=(157, 171), pitch=4.7, physics="core", seed=1)
    found = find_marks(grey(made.burst)).numpy()
    bundle = reconstruct(made.burst, bundle=calibrate(clean.burst), iterations=2, smoothness=0.02).bundle
    assert (bundle.labels[found] == len(bundle.centres)).all()
    assert not bundle.transmission[found].any()
