"""Hard and broken bursts: each gives an image, and says what is wrong with it."""

import logging

import numpy as np
import pytest
import skimage.data
from scipy.ndimage import gaussian_filter

from napari_fiberburst import Burst, load, reconstruct
from napari_fiberburst.errors import BundleError, SettingsError
from napari_fiberburst.quality import motion_error, psnr, ssim
from napari_fiberburst.simulation import Camera, Faults, Scene, simulate

SHAPE = (127, 141)


def still_to(count, *shifts):
    """Return homographies that shift frame t by `shifts[t]`, and leave the others where they are."""
    found = np.tile(np.eye(3), (count, 1, 1))
    for number, (x, y) in enumerate(shifts):
        found[number, :2, 2] = x, y
    return found


def recorded(simulated, change):
    """Return the burst of a simulation with its frames changed as they were recorded."""
    frames = simulated.arrays()["frames"].copy()
    change(frames)
    return Burst(frames, axes="TYXC", black_level=0, white_level=simulated.burst.white_level)


@pytest.mark.parametrize("seed", [1, 733])
def test_few_frames_far_apart_are_not_held_still_by_what_their_cores_differ_by(seed):
    """Cores start as equal where frames are few; what really differs between them does not move."""
    slide = skimage.data.immunohistochemistry().astype(np.float32) / 255
    shape, chosen = (141, 167), [0, 1, 2, 3, 4, 6, 8, 11]
    view = {"shape": shape, "frames": 12, "pitch": 3.5, "channels": 1, "motion": "handheld", "physics": "core"}
    simulated = simulate(Scene(slide, (98, 225)), camera=Camera(photons=8000.0), seed=seed, **view)
    result = reconstruct(Burst(simulated.burst.frames[chosen], axes="TYXC"))
    assert motion_error(result.homographies, simulated.homographies[chosen], shape) < 0.1


def test_without_motion_it_says_so_and_shows_one_frames_worth():
    simulated = simulate("cat", shape=SHAPE, frames=8, pitch=5.0, physics="core", motion=still_to(8))
    result = reconstruct(simulated.burst)
    assert any("too little to fill the gaps" in note for note in result.notes)
    # What cores differ by is smoothed out: the image is as good as the filter that the truth would choose.
    frame, truth = simulated.burst.frames[0], simulated.truth[0]
    filtered = max(psnr(gaussian_filter(frame, (width, width, 0)), truth) for width in np.arange(1, 6, 0.5))
    assert psnr(np.nan_to_num(result.image, nan=np.nanmean(result.image)), truth) > filtered - 0.3


def test_two_frames_are_enough():
    simulated = simulate(
        "cat", shape=SHAPE, frames=2, pitch=5.0, physics="core", motion=still_to(2, (0, 0), (4.3, 2.8))
    )
    result = reconstruct(simulated.burst, fill=True)
    assert result.frames_used == (0, 1)
    assert motion_error(result.homographies, simulated.homographies, SHAPE) < 0.5
    assert psnr(result.image, simulated.truth[0]) > 22


def test_motion_over_half_the_field_is_followed_from_frame_to_frame():
    ways = [(12.0 * number, 7.0 * number) for number in range(8)]
    simulated = simulate("cat", shape=SHAPE, frames=8, pitch=5.0, physics="core", motion=still_to(8, *ways))
    result = reconstruct(simulated.burst)
    assert result.frames_used == tuple(range(8))
    assert motion_error(result.homographies, simulated.homographies, SHAPE) < 0.6


def spoil_black(frames):
    frames[4] = 0


def spoil_white(frames):
    frames[4] = 255


def spoil_noise(frames):
    frames[4] = np.random.default_rng(0).integers(0, 255, frames[4].shape)


@pytest.mark.parametrize("spoil", [spoil_black, spoil_white, spoil_noise])
def test_a_frame_that_shows_nothing_is_left_out_and_named(cores, fitted, spoil, caplog):
    with caplog.at_level(logging.WARNING):
        result = reconstruct(recorded(cores, spoil), fill=True)
    assert result.frames_used == tuple(number for number in range(12) if number != 4)
    assert np.isnan(result.homographies[4]).all()
    # How far it agrees with the others is low, or cannot be asked because it is blank.
    assert not result.confidence[4] > 0.6 * np.nanmedian(result.confidence)
    assert np.isnan(result.confidence[4]) == (spoil is not spoil_noise)
    assert any("left out: 4" in note for note in result.notes)
    assert "left out: 4" in caplog.text
    assert psnr(result.image, cores.truth[0]) > psnr(fitted.image, cores.truth[0]) - 1.0
    # It is drawn as nothing.
    assert np.isnan(result.frame(4)).all()
    assert np.isnan(result.render(bounds=(-500, 0, -400, 50))).all()
    assert np.isnan(result.flow(4)).all()


def test_without_motion_asked_for_bad_frames_are_left_out_too():
    simulated = simulate("cat", shape=SHAPE, frames=6, pitch=5.0, physics="core", motion=still_to(6))
    result = reconstruct(recorded(simulated, spoil_black), motion="none", smoothness=0.02)
    assert 4 not in result.frames_used
    assert any("equally bright" in note for note in result.notes)
    np.testing.assert_allclose(result.homographies[1], np.eye(3))


def test_where_frame_0_is_bad_the_next_takes_its_place(cores):
    def spoil(frames):
        frames[0] = 0

    result = reconstruct(recorded(cores, spoil), fill=True)
    assert result.reference == 1
    np.testing.assert_allclose(result.homographies[1], np.eye(3), atol=1e-12)
    assert psnr(result.image, cores.truth[1]) > 26


def test_a_duplicated_frame_does_no_harm(cores, fitted):
    def double(frames):
        frames[5] = frames[4]

    result = reconstruct(recorded(cores, double), fill=True)
    assert result.frames_used == tuple(number for number in range(12) if number != 5)
    np.testing.assert_array_equal(result.homographies[4], result.homographies[5])
    assert psnr(result.image, cores.truth[0]) > psnr(fitted.image, cores.truth[0]) - 1.0


def test_a_blurred_frame_counts_for_less(cores, fitted):
    def smear(frames):
        # Moved during the exposure: the sum of what frames 3 to 7 show.
        frames[4] = cores.arrays()["frames"][3:8].mean(axis=0)

    result = reconstruct(recorded(cores, smear), fill=True)
    assert psnr(result.image, cores.truth[0]) > psnr(fitted.image, cores.truth[0]) - 1.5


def test_a_bundle_in_a_circle_leaves_the_corners_empty():
    simulated = simulate("cat", shape=(151, 163), frames=8, pitch=5.0, physics="core", outline="circle", seed=1)
    result = reconstruct(simulated.burst)
    y, x = np.indices((151, 163))
    distance = np.hypot(x - 81, y - 75)
    assert np.isnan(result.image[distance > 115]).all()
    assert np.isfinite(result.image[distance < 65]).all()
    inside = distance < 65
    assert psnr(result.image[inside][None], simulated.truth[0][inside][None]) > 25


def test_without_a_bundle_it_says_so_and_resolves_better_than_one_frame():
    simulated = simulate("cat", shape=SHAPE, frames=10, seed=4)
    noisy = simulated.truth + np.random.default_rng(0).normal(0, 0.03, simulated.truth.shape)
    result = reconstruct(Burst(np.clip(noisy, 0, 1).astype(np.float32)), fill=True)
    assert any("no bundle" in note for note in result.notes)
    assert not result.bundle.is_resolved
    assert motion_error(result.homographies, simulated.homographies, SHAPE) < 0.2
    assert psnr(result.image, simulated.truth[0]) > psnr(noisy[0], simulated.truth[0]) + 2


def test_a_pitch_too_fine_to_resolve_falls_back_to_pixels():
    simulated = simulate("histology", shape=SHAPE, frames=10, pitch=2.6, seed=6)
    result = reconstruct(simulated.burst, fill=True)
    assert any("too close" in note for note in result.notes)
    assert psnr(result.image, simulated.truth[0]) > psnr(simulated.burst.frames[0], simulated.truth[0]) + 4


def test_vignetting_is_told_from_the_object(cores):
    y, x = np.indices(SHAPE)
    shade = 0.35 + 0.65 * np.exp(-((x - 70) ** 2 + (y - 63) ** 2) / 60**2)

    def shadow(frames):
        frames[:] = np.rint(frames * shade[..., None])

    result = reconstruct(recorded(cores, shadow), fill=True)
    assert motion_error(result.homographies, cores.homographies, SHAPE) < 0.2
    assert ssim(result.image, cores.truth[0]) > 0.7


def test_sixteen_bits_with_a_pedestal():
    camera = Camera(bits=16, pedestal=0.05)
    simulated = simulate("histology", shape=SHAPE, frames=12, pitch=6.0, physics="core", seed=3, camera=camera)
    result = reconstruct(simulated.burst, fill=True)
    assert psnr(result.image, simulated.truth[0]) > 27
    assert result.image.mean() > 0.05 * 65535


def test_an_object_that_is_mostly_black():
    simulated = simulate("tissue", shape=SHAPE, frames=12, pitch=5.0, physics="core", seed=8)
    frames = simulated.arrays()["frames"]
    frames = np.where(frames > 60, frames, frames // 6)
    result = reconstruct(Burst(frames, axes="TYXC"), fill=True)
    assert len(result.frames_used) == 12
    assert motion_error(result.homographies, simulated.homographies, SHAPE) < 0.5


def test_frames_of_noise_give_one_frame_and_say_so(rng, tmp_path):
    result = reconstruct(Burst(rng.random((5, 61, 67)).astype(np.float32)))
    assert result.notes
    assert result.image.shape == (61, 67)
    result.save(tmp_path / "noise.ome.tif")
    result.save(tmp_path / "noise.npz")
    assert load(tmp_path / "noise.npz").frames_used == result.frames_used


def test_the_frame_that_stands_for_those_that_cannot_be_registered_is_the_first_that_shows_as_much_as_they_do(rng):
    frames = rng.random((5, 61, 67)).astype(np.float32)
    assert reconstruct(Burst(frames)).frames_used == (0,)
    frames[0] *= 0.1
    assert reconstruct(Burst(frames)).frames_used == (1,)


def test_the_smallest_burst_that_is_allowed(rng):
    result = reconstruct(Burst(rng.random((2, 16, 16)).astype(np.float32)))
    assert result.image.shape == (16, 16)


def test_a_calibration_image_may_be_a_file_and_is_cropped_along(cores, tmp_path):
    np.save(tmp_path / "bundle.npy", cores.transmission * 255)
    burst = cores.burst.crop((10, 117), (5, 131))
    result = reconstruct(burst, calibration=tmp_path / "bundle.npy", fill=True)
    lit = result.bundle.brightness > 0.3
    place = np.rint(result.bundle.centres[lit]).astype(int)
    inside = (place >= 0).all(axis=1) & (place < [126, 107]).all(axis=1)
    there = cores.transmission[place[inside, 1] + 10, place[inside, 0] + 5]
    assert np.corrcoef(there, result.bundle.brightness[lit][inside])[0, 1] > 0.9


@pytest.mark.parametrize(
    ("choices", "error", "said"),
    [
        ({"calibration": np.zeros((27, 29))}, BundleError, "is black"),
        ({"calibration": "no such file.png"}, BundleError, "there is no no such file.png"),
        ({"preset": "paper", "calibration": np.eye(27)}, SettingsError, "no model of the bundle"),
        ({"motion": "flow"}, SettingsError, "needs a network"),
    ],
)
def test_bad_calls_are_refused(cores, choices, error, said):
    with pytest.raises(error, match=said):
        reconstruct(cores.burst, **choices)


VIGNETTED = {"shape": SHAPE, "frames": 12, "pitch": 5.0, "physics": "core", "seed": 2}


def test_a_threefold_vignette_is_taken_for_light_and_costs_little():
    even, shaded = (simulate("histology", faults=Faults(vignette=strength), **VIGNETTED) for strength in (1, 3))
    found, left = (reconstruct(shaded.burst, fill=True, flatten=flatten) for flatten in ("motion", "none"))
    quality = psnr(found.image, shaded.truth[0])
    assert quality > psnr(left.image, shaded.truth[0]) + 0.5
    assert quality > psnr(reconstruct(even.burst, fill=True).image, even.truth[0]) - 0.7
    # The vignette of the last channel is the strongest, and the bundle knows it.
    seen = found.bundle.gains[:, 2] / found.bundle.gains[:, 0]
    x, y = np.rint(found.bundle.centres).astype(int).T
    shading = shaded.shading[y.clip(0, SHAPE[0] - 1), x.clip(0, SHAPE[1] - 1)]
    assert np.corrcoef(np.log(seen), np.log(shading[:, 2] / shading[:, 0]))[0, 1] > 0.9


def test_in_even_light_looking_for_shading_changes_nothing(cores, fitted):
    result = reconstruct(cores.burst, flatten="none", fill=True)
    np.testing.assert_array_equal(result.image, fitted.image)
    np.testing.assert_array_equal(result.bundle.gains, fitted.bundle.gains)


def test_without_motion_the_mean_frames_slow_changes_are_the_lights_where_that_is_asked_for():
    shaded = simulate("cat", faults=Faults(vignette=3), motion=still_to(12), **VIGNETTED)
    equal, falling = (
        reconstruct(shaded.burst, flatten=flatten, smoothness=0.02).bundle for flatten in ("motion", "frame")
    )
    distance = np.hypot(*(equal.centres - np.array(SHAPE[::-1]) / 2).T)
    dimmer = [
        bundle.brightness[distance > 60].mean() / bundle.brightness[distance < 40].mean() for bundle in (equal, falling)
    ]
    assert dimmer[0] > 0.9
    assert dimmer[1] < 0.8
