"""A bundle is calibrated from images in even light, against bundles that the simulator knows."""

from dataclasses import replace
from importlib.metadata import version

import numpy as np
import pytest
import tifffile
from PIL import Image
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from skimage import data

from napari_fiberburst import Bundle, Burst, reconstruct
from napari_fiberburst.errors import BundleError
from napari_fiberburst.quality import psnr
from napari_fiberburst.simulation import Camera, SimulatedBurst, simulate

SHAPE = (131, 153)
PITCH = 6.0


@pytest.fixture(scope="module")
def simulated() -> SimulatedBurst:
    return simulate(
        "histology", shape=SHAPE, frames=1, pitch=PITCH, physics="core", dead_cores=0.03, seed=4, jitter=0.05
    )


def photographed(light, camera=None, *, frames=1, seed=0):
    """Return what a camera makes of light (H, W) or (H, W, C), frames times."""
    light = np.broadcast_to(np.atleast_3d(light).astype(np.float32), (frames, *np.atleast_3d(light).shape))
    return (camera or Camera(bits=16)).record(light, np.random.default_rng(seed)).squeeze()


def inner(bundle):
    """Return which cores do not touch the edge of the frame, (N,)."""
    centres, (height, width) = bundle.centres, bundle.shape
    return ((centres > PITCH) & (centres < [width - PITCH, height - PITCH])).all(axis=1)


def gain_error(bundle, transmission):
    """Return the spread of cores' brightness about the true one, relative, common factor aside."""
    true = replace(bundle, transmission=transmission.astype(np.float32)).brightness
    ratio = (bundle.brightness / np.maximum(true, 1e-9))[inner(bundle) & (true > 0.1)]
    return ratio.std() / ratio.mean()


def test_what_a_bundle_has_is_what_the_simulator_has_made(simulated):
    bundle = Bundle.from_image(photographed(0.8 * simulated.transmission))
    lit = simulated.bundle.centres[simulated.bundle.gains > 0]
    distance, _ = cKDTree(bundle.centres).query(lit)
    assert np.median(distance) < 0.1
    assert abs(len(bundle.centres) / len(lit) - 1) < 0.02
    assert bundle.pitch == pytest.approx(PITCH, rel=0.02)
    # A disc of 0.36 pitches whose rim is 0.3 px soft.
    assert bundle.radius == pytest.approx(0.36 * PITCH, rel=0.06)
    dark = simulated.bundle.centres[simulated.bundle.gains == 0]
    dark = dark[((dark > PITCH) & (dark < np.array(SHAPE[::-1]) - PITCH)).all(axis=1)]
    assert (cKDTree(bundle.dead).query(dark)[0] < 0.5 * PITCH).mean() > 0.8
    assert (cKDTree(simulated.bundle.centres).query(bundle.dead)[0] < 0.5 * PITCH).mean() > 0.8
    assert gain_error(bundle, simulated.transmission) < 0.01
    assert not bundle.saturated.any()
    assert bundle.outline.mean() > 0.97
    assert bundle.black == pytest.approx(0, abs=0.005 * 65535)


def test_a_round_field_is_outlined():
    seen = simulate("cat", shape=SHAPE, frames=1, pitch=PITCH, physics="core", outline="circle")
    bundle = Bundle.from_image(photographed(seen.transmission))
    y, x = np.indices(SHAPE)
    inside = np.hypot(x - 76, y - 65) < 131 / 2 - PITCH
    assert (bundle.outline & inside).sum() / (bundle.outline | inside).sum() > 0.75
    assert bundle.outline[inside].mean() > 0.99


def test_more_flats_leave_less_noise_in_the_gains(simulated):
    camera = Camera(bits=16, photons=100)
    few, many = (
        Bundle.from_image(photographed(0.8 * simulated.transmission, camera, frames=frames)) for frames in (1, 16)
    )
    assert gain_error(many, simulated.transmission) < 0.4 * gain_error(few, simulated.transmission)
    assert np.median(many.gain_weights) == pytest.approx(16 * np.median(few.gain_weights), rel=0.1)


def test_a_dark_image_gives_black_level_and_each_cores_own_light(simulated, rng):
    camera = Camera(bits=16, pedestal=0.03)
    own = rng.uniform(0, 0.2, len(simulated.bundle.centres)) * (simulated.bundle.gains > 0)
    glow = (simulated.bundle.profiles(SHAPE) @ own).reshape(SHAPE)
    flat = photographed(0.7 * simulated.transmission + glow, camera)
    bundle = Bundle.from_image(flat, dark=photographed(glow, camera))
    assert bundle.black == pytest.approx(0.03 * 65535, abs=0.002 * 65535)
    number = cKDTree(simulated.bundle.centres).query(bundle.centres)[1]
    # An offset is an amplitude of the core's profile: what it glows, in parts of what it passes.
    level = np.quantile(simulated.transmission[simulated.transmission > 0.02], 0.97)
    expected = own[number] / simulated.bundle.gains[number] * level * 0.97 * 65535
    known = inner(bundle) & (simulated.bundle.gains[number] > 0.3)
    assert np.corrcoef(bundle.offsets[known, 0], expected[known])[0, 1] > 0.99
    assert np.median(bundle.offsets[known, 0] / expected[known]) == pytest.approx(1, abs=0.08)
    assert gain_error(bundle, simulated.transmission) < 0.01


def test_one_frame_behind_glowing_cores_is_clean_with_a_dark_image(simulated, rng):
    own = rng.uniform(0, 0.3, len(simulated.bundle.centres)) * (simulated.bundle.gains > 0)
    glow = (simulated.bundle.profiles(SHAPE) @ own).reshape(SHAPE)
    frame = photographed(0.6 * simulated.burst.frames[0] + glow[..., None])
    flat, dark = photographed(0.6 * simulated.transmission + glow), photographed(glow)
    burst = Burst(frame[None], axes="TYXC", white_level=65535)
    with_dark, without = (
        reconstruct(burst, bundle=bundle, fill=True, smoothness=0.02, device="cpu").image
        for bundle in (Bundle.from_image(flat, dark=dark), Bundle.from_image(flat))
    )
    truth = simulated.truth[0]
    assert psnr(with_dark / np.float32(65535), truth) > psnr(without / np.float32(65535), truth) + 2


def test_colour_gives_each_cores_gain_in_each_channel(simulated, rng):
    count = len(simulated.bundle.centres)
    tint = rng.normal(1, 0.08, (count, 3)) * [0.9, 0.6, 0.4]
    light = simulated.bundle.profiles(SHAPE) @ (tint * simulated.bundle.gains[:, None])
    bundle = Bundle.from_image(photographed(0.7 * light.reshape(*SHAPE, 3)))
    number = cKDTree(simulated.bundle.centres).query(bundle.centres)[1]
    expected = tint / tint.mean(axis=1, keepdims=True)
    expected = (expected / np.median(expected, axis=0))[number]
    known = inner(bundle) & (simulated.bundle.gains[number] > 0.3)
    assert bundle.gains.shape == (len(bundle.centres), 3)
    assert np.abs(bundle.gains[known] - expected[known]).max() < 0.04


def test_saturated_cores_are_named(simulated):
    light = 0.5 * simulated.transmission
    centres = simulated.bundle.centres[simulated.bundle.gains > 0]
    bright = centres[np.hypot(*(centres - [70, 60]).T) < 12]
    y, x = np.indices(SHAPE)
    light[np.hypot(x - 70, y - 60) < 12 + PITCH / 2] *= 4
    bundle = Bundle.from_image(photographed(light, Camera(bits=8)))
    near = cKDTree(bundle.centres[bundle.saturated]).query(bright)[0] < 0.5 * PITCH
    assert near.mean() > 0.6
    assert (np.hypot(*(bundle.centres[bundle.saturated] - [70, 60]).T) < 12 + PITCH).all()


@pytest.mark.parametrize("ending", ["tif", "png", "npy"])
def test_images_are_read_from_files_and_named(tmp_path, simulated, ending):
    flat = photographed(0.8 * simulated.transmission, Camera(bits=8))
    path = tmp_path / f"flat.{ending}"
    {"tif": tifffile.imwrite, "png": lambda file, array: Image.fromarray(array).save(file), "npy": np.save}[ending](
        path, flat
    )
    bundle = Bundle.from_image(path)
    np.testing.assert_array_equal(bundle.transmission, Bundle.from_image(flat).transmission)
    assert bundle.provenance["files"] == [path.name]
    assert bundle.provenance["version"] == version("napari-fiberburst")
    assert bundle.provenance["source"] == "image"
    assert len(bundle.provenance["date"]) == len("2026-01-01")


def test_several_files_and_a_stack_are_averaged_alike(tmp_path, simulated):
    flats = photographed(0.8 * simulated.transmission, frames=3)
    paths = [tmp_path / f"flat{number}.tif" for number in range(3)]
    for path, flat in zip(paths, flats, strict=True):
        tifffile.imwrite(path, flat)
    tifffile.imwrite(tmp_path / "stack.tif", flats, photometric="minisblack")
    expected = Bundle.from_image(flats)
    for given in (paths, tmp_path / "stack.tif"):
        np.testing.assert_array_equal(Bundle.from_image(given).transmission, expected.transmission)


def flat_of(simulated):
    return photographed(0.8 * simulated.transmission, Camera(bits=8))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda flat: np.minimum(flat.astype(int) * 40, 255).astype(np.uint8), "is saturated: [0-9]+%"),
        (lambda flat: np.zeros_like(flat), "is black throughout.*light the bundle"),
        (lambda flat: np.full_like(flat, 255), "is even throughout"),
        (lambda flat: flat // 200, "is black: 99 %.*expose longer"),
        (lambda flat: np.where(flat > 100, np.nan, flat.astype(float)), "finite intensities.*NaN"),
        (lambda flat: flat[0], "must hold finite intensities"),
        (lambda flat: flat[:0], "must hold finite intensities"),
        (lambda flat: flat.astype(complex), "must hold finite intensities"),
        (lambda flat: flat[:9, :9], "at least"),
        (lambda flat: data.camera()[200:331, 100:253], "shows no bundle; expected a pattern of cores"),
    ],
    ids=["saturated", "black", "white", "dark", "nan", "a line", "nothing", "complex", "tiny", "a photograph"],
)
def test_a_flat_that_cannot_be_one_is_refused(simulated, spoil, said):
    with pytest.raises(BundleError, match=said):
        Bundle.from_image(spoil(flat_of(simulated)))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda flat: np.minimum(flat.astype(int) + 20, 255).astype(np.uint8), "is brighter than.*exchange the two"),
        (lambda flat: flat[:, 1:] // 9, "must have the size of.* 131 x 153; got 131 x 152"),
        (lambda flat: flat * np.float32("nan"), "finite"),
    ],
    ids=["brighter", "another size", "nan"],
)
def test_a_dark_image_that_cannot_be_one_is_refused(simulated, spoil, said):
    flat = flat_of(simulated)
    with pytest.raises(BundleError, match=said):
        Bundle.from_image(flat, dark=spoil(flat))


def test_files_that_cannot_be_used_are_named(tmp_path, simulated):
    good, small, torn, words = (tmp_path / name for name in ("good.tif", "small.tif", "torn.tif", "words.npy"))
    flat = flat_of(simulated)
    tifffile.imwrite(good, flat)
    tifffile.imwrite(small, flat[:-3])
    torn.write_bytes(good.read_bytes()[:5000])
    np.save(words, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    for given, said in (
        (torn, "torn.tif"),
        (words, "words.npy"),
        (tmp_path / "none.tif", "none.tif"),
        (tmp_path, "expected the file of an image"),
        ([good, small], "small.tif has 128 x 153"),
    ):
        with pytest.raises(BundleError, match=said):
            Bundle.from_image(given)


@pytest.mark.parametrize("pitch", [5.0, 7.0])
def test_the_cameras_blur_is_not_taken_for_a_wider_footprint(pitch):
    simulated = simulate("cat", shape=(139, 121), frames=1, pitch=pitch, seed=5)
    true = float(simulated.bundle.radii.mean())
    for blur in (0.0, 0.06, 0.1):
        flat = gaussian_filter(simulated.transmission, blur * pitch)
        assert Bundle.from_image(flat).radius == pytest.approx(true, rel=0.06)
