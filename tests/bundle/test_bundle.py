"""What can be done with a bundle: one frame is a burst, crops fit, and every burst makes it better."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from napari_fiberburst import Bundle, Burst, reconstruct
from napari_fiberburst.errors import BundleError, BurstError
from napari_fiberburst.quality import psnr
from napari_fiberburst.simulation import Camera, simulate

PROBE = {"shape": (109, 127), "pitch": 6.0, "physics": "core", "channels": 1, "seed": 3}


def wandering(seed, frames=7):
    """Return shifts that cover a few pitches, (T, 3, 3)."""
    matrices = np.tile(np.eye(3), (frames, 1, 1))
    matrices[1:, :2, 2] = np.cumsum(np.random.default_rng(seed).normal(0, 3, (frames - 1, 2)), axis=0)
    return matrices


def behind_the_probe(scene, seed, **more):
    """Simulate a burst through the one bundle that all tests share."""
    return simulate(scene, frames=7, motion=wandering(seed), camera=Camera(photons=3000), **{**PROBE, **more})


@pytest.fixture(scope="module")
def simulated():
    return behind_the_probe("histology", 0)


@pytest.fixture(scope="module")
def flat_bundle(simulated):
    return Bundle.from_image(np.rint(200 * simulated.transmission).astype(np.uint8), device="cpu")


@pytest.fixture(scope="module")
def rough_bundle(simulated):
    """Return a bundle from a flat of few photons: its gains are off by some five per cent."""
    light = (0.8 * simulated.transmission[..., None]).astype(np.float32)
    return Bundle.from_image(Camera(photons=60).record(light, np.random.default_rng(1))[..., 0], device="cpu")


@pytest.fixture(scope="module")
def behind_the_rough_one(simulated, rough_bundle):
    return reconstruct(simulated.burst, bundle=rough_bundle, device="cpu")


def gain_error(bundle, transmission):
    """Return the spread of cores' brightness about the true one, relative, common factor aside."""
    true = replace(bundle, transmission=transmission.astype(np.float32)).brightness
    inner = ((bundle.centres > 6) & (bundle.centres < np.array(bundle.shape[::-1]) - 7)).all(axis=1)
    ratio = (bundle.brightness / np.maximum(true, 1e-9))[inner & (true > 0.1)]
    return ratio.std() / ratio.mean()


def best_gaussian(frame, truth):
    return max(psnr(gaussian_filter(frame, (sigma, sigma, 0)), truth) for sigma in np.arange(0.5, 5, 0.25))


@pytest.mark.parametrize(("scene", "channels", "gain"), [("histology", 1, 4), ("cat", 1, 4), ("histology", 3, 4)])
@pytest.mark.parametrize("frames", [1, 2])
def test_with_a_bundle_one_frame_is_a_burst(probe, scene, channels, gain, frames):
    seen = probe(scene, channels=channels, frames=frames)
    result = reconstruct(seen.burst, bundle=seen.bundle, fill=True, device="cpu")
    assert result.image.shape == seen.truth.shape[1:]
    image = result.image / np.float32(seen.burst.white_level)
    assert psnr(image, seen.truth[0]) > best_gaussian(seen.burst.frames[0], seen.truth[0]) + gain


def test_one_frame_without_time_axis_is_a_burst_too(probe):
    seen = probe()
    frame = np.rint(seen.burst.frames[0, ..., 0] * 255).astype(np.uint8)
    result = reconstruct(frame, bundle=seen.flat, smoothness=0.1, device="cpu")
    assert result.image.shape == frame.shape
    assert result.homographies.shape == (1, 3, 3)


def test_one_frame_without_a_bundle_says_what_to_do(probe):
    with pytest.raises(BurstError, match=r"give a bundle \(Bundle.from_image"):
        reconstruct(probe().burst, device="cpu")


def test_a_bundle_from_a_burst_tells_where_the_cores_are(simulated, flat_bundle):
    bundle = Bundle.from_burst(simulated.burst, device="cpu")
    assert bundle.pitch == pytest.approx(flat_bundle.pitch, rel=0.02)
    assert len(bundle.centres) == pytest.approx(len(flat_bundle.centres), rel=0.03)
    assert not bundle.gain_weights.any()
    assert bundle.provenance["source"] == "burst"


def test_a_burst_that_shows_no_bundle_gives_none(rng):
    with pytest.raises(BundleError, match="no bundle is seen in the mean of these 3 frames; expected a pattern"):
        Bundle.from_burst(Burst(simulate("cat", shape=(97, 101), frames=3).truth))


def test_the_bundle_of_a_result_knows_its_gains(simulated):
    result = reconstruct(simulated.burst, device="cpu")
    assert result.bundle.gains_known
    guess = Bundle.from_burst(simulated.burst, device="cpu")
    assert gain_error(result.bundle, simulated.transmission) < 0.5 * gain_error(guess, simulated.transmission)


def test_a_cropped_bundle_with_a_cropped_burst_shows_the_same(simulated, flat_bundle):
    rows, columns = (11, 98), (20, 117)
    one = Burst(np.rint(simulated.burst.frames[:1] * 255).astype(np.uint8), axes="TYXC", white_level=255)
    whole = reconstruct(one, bundle=flat_bundle, smoothness=0.1, device="cpu").image[slice(*rows), slice(*columns)]
    cropped = one.crop(rows, columns)
    by_hand, by_itself = (
        reconstruct(cropped, bundle=bundle, smoothness=0.1, device="cpu").image
        for bundle in (flat_bundle.crop(rows, columns), flat_bundle)
    )
    np.testing.assert_array_equal(by_hand, by_itself)
    inner = (slice(14, -14), slice(14, -14))
    assert np.sqrt(np.nanmean((by_hand[inner] - whole[inner]) ** 2)) < 0.05 * np.nanstd(whole)


def test_a_crop_keeps_what_belongs_to_its_cores(flat_bundle):
    part = flat_bundle.crop((11, 98), (20, 117))
    part._check()
    assert part.shape == (87, 97)
    y, x = 40, 50
    number, whole = part.labels[y, x], flat_bundle.labels[y + 11, x + 20]
    np.testing.assert_allclose(part.centres[number] + [20, 11], flat_bundle.centres[whole])
    assert part.gain_weights[number] == flat_bundle.gain_weights[whole]


@pytest.mark.parametrize("crop", [((0, 200), (0, 50)), ((5, 5), (0, 50)), ((-3, 40), (0, 50))])
def test_a_crop_beyond_the_frame_is_refused(flat_bundle, crop):
    with pytest.raises(BundleError, match="a crop must lie inside the bundle's frame"):
        flat_bundle.crop(*crop)


def test_a_crop_of_nothing_is_refused():
    seen = simulate("cat", frames=1, outline="circle", **PROBE)
    bundle = Bundle.from_image(np.rint(200 * seen.transmission).astype(np.uint8), device="cpu")
    with pytest.raises(BundleError, match="no core lies in rows 0:9, columns 0:9"):
        bundle.crop((0, 9), (0, 9))


def test_every_burst_brings_the_gains_closer_to_the_truth(simulated, rough_bundle, behind_the_rough_one):
    errors = [gain_error(rough_bundle, simulated.transmission)]
    bundle = rough_bundle.updated(behind_the_rough_one)
    errors.append(gain_error(bundle, simulated.transmission))
    for seed, scene in ((1, "tissue"), (2, "cat")):
        burst = behind_the_probe(scene, seed).burst
        bundle = bundle.updated(reconstruct(burst, bundle=bundle, device="cpu"))
        errors.append(gain_error(bundle, simulated.transmission))
    assert errors == sorted(errors, reverse=True)
    assert errors[1] < 0.9 * errors[0]
    assert errors[-1] < 0.7 * errors[0]
    assert bundle.provenance["bursts"] == 3


def test_an_update_keeps_the_common_factor_and_counts_the_light(rough_bundle, behind_the_rough_one):
    bundle = rough_bundle.updated(behind_the_rough_one)
    ratio = bundle.brightness / np.maximum(rough_bundle.brightness, 1e-9)
    assert np.median(ratio) == pytest.approx(1, abs=0.02)
    assert (bundle.gain_weights >= rough_bundle.gain_weights).all()
    assert bundle.gain_weights.mean() > 1.1 * rough_bundle.gain_weights.mean()
    np.testing.assert_array_equal(bundle.centres, rough_bundle.centres)


def test_gains_that_are_well_known_hardly_change(rough_bundle, behind_the_rough_one):
    sure = replace(rough_bundle, gain_weights=np.full_like(rough_bundle.gain_weights, 900))
    changes = [
        np.std(bundle.updated(behind_the_rough_one).brightness / np.maximum(bundle.brightness, 1e-9))
        for bundle in (rough_bundle, sure)
    ]
    assert changes[1] < 0.01 * changes[0]


def test_a_burst_that_does_not_move_tells_nothing_of_gains(probe):
    seen = probe()
    same = seen.bundle.updated(reconstruct(seen.burst, bundle=seen.bundle, smoothness=0.1, device="cpu"))
    np.testing.assert_array_equal(same.transmission, seen.bundle.transmission)
    np.testing.assert_array_equal(same.gain_weights, seen.bundle.gain_weights)


def test_a_burst_that_was_cropped_or_behind_a_moved_bundle_improves_it_too(probe):
    seen = probe("cat", frames=7, motion=wandering(0), shift=(1.3, -0.6), degrees=0.6, camera=Camera(photons=3000))
    light = (0.8 / 200 * seen.flat)[..., None].astype(np.float32)
    rough = Bundle.from_image(Camera(photons=60).record(light, np.random.default_rng(1))[..., 0], device="cpu")
    before = gain_error(rough, seen.flat / 200)
    result = reconstruct(seen.burst.crop((10, 121), (5, 133)), bundle=rough, device="cpu")
    assert any("was found" in note for note in result.notes)
    better = rough.updated(result)
    inside = better.gain_weights > rough.gain_weights
    assert 0.5 < inside.mean() < 1
    assert gain_error(better, seen.flat / 200) < before
    np.testing.assert_array_equal(better.brightness[~inside], rough.brightness[~inside])


def test_a_bundle_kept_from_a_moved_burst_can_be_improved_in_its_turn(probe):
    seen = probe(frames=7, motion=wandering(0), shift=(1.3, -0.6), degrees=0.6)
    kept = reconstruct(seen.burst, bundle=seen.bundle, device="cpu").bundle
    again = reconstruct(seen.burst, bundle=kept, device="cpu")
    assert not again.notes
    assert (kept.updated(again).gain_weights > kept.gain_weights).mean() > 0.9


def test_a_result_of_another_bundle_improves_nothing(probe, flat_bundle, behind_the_rough_one):
    other = probe(seed=8, shape=(109, 127), frames=4, motion=wandering(4, 4))
    with pytest.raises(BundleError, match=r"of another bundle: \d+% of the cores lie where this one has them"):
        flat_bundle.updated(reconstruct(other.burst, bundle=other.bundle, device="cpu"))


def test_a_result_without_a_bundle_improves_nothing(flat_bundle, fit, tiny_burst):
    with pytest.raises(BundleError, match="has measured no gains"):
        flat_bundle.updated(fit(tiny_burst, iterations=1))


def test_a_bundle_serves_recordings_of_other_levels(probe):
    seen = probe(brightness=0.7)
    brighter = Burst(
        (np.rint(seen.burst.frames * 255) + 40).astype(np.uint16), axes="TYXC", black_level=0, white_level=4095
    )
    lifted = replace(seen.bundle, black=seen.bundle.black + 40)
    first = reconstruct(seen.burst, bundle=seen.bundle, device="cpu", smoothness=0.1).image
    second = reconstruct(brighter, bundle=lifted, device="cpu", smoothness=0.1).image
    np.testing.assert_allclose(second - 40, first, atol=0.3)


def test_the_image_of_a_bundle_marks_dead_and_saturated_cores(flat_bundle):
    marked = replace(
        flat_bundle,
        dead=np.array([[30.0, 40.0]]),
        saturated=np.arange(len(flat_bundle.centres)) == flat_bundle.labels[60, 60],
    )
    image = marked.to_image()
    assert image.shape == (109, 127, 3)
    blue, red = image[40, 30].astype(int), image[flat_bundle.labels == flat_bundle.labels[60, 60]].astype(int)
    assert blue[2] > 2 * blue[0]
    assert (red[:, 0] >= red[:, 1]).all()
    assert red[:, 0].sum() > 2 * red[:, 1].sum()
    plain = flat_bundle.to_image()[flat_bundle.labels == flat_bundle.labels[20, 20]]
    assert (plain == plain[:, :1]).all()
