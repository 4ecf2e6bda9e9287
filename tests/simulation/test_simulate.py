"""The simulator against scikit-image's own warp, and against what a bundle and a camera do."""

import numpy as np
import pytest
import skimage.data
from scipy.spatial import cKDTree
from skimage.transform import ProjectiveTransform, warp

from napari_fiberburst.errors import SettingsError
from napari_fiberburst.simulation import (
    MOTIONS,
    SCENES,
    Camera,
    Scene,
    brownian_motion,
    make_bundle,
    make_scene,
    raster_motion,
    simulate,
)
from napari_fiberburst.simulation.scenes import usaf_chart

SHAPE = (61, 83)


def test_truth_is_the_scene_warped_by_the_homographies():
    simulated = simulate("cat", shape=SHAPE, frames=6, seed=3)
    image = skimage.data.cat()[98:243, 163:287].astype(np.float64) / 255  # with room around the field
    top, left = (300 - 61) // 2, (451 - 83) // 2
    for matrix, frame in zip(simulated.homographies, simulated.truth, strict=True):
        to_image = ProjectiveTransform(translation_to(left - 163, top - 98) @ matrix)
        expected = warp(image, to_image, output_shape=SHAPE, order=3, mode="reflect")
        assert np.abs(frame - np.clip(expected, 0, 1)).max() < 0.03  # two kinds of cubic
        assert np.abs(frame - expected).mean() < 0.004


def translation_to(x, y):
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])


def test_frame_0_of_a_photograph_is_the_photograph():
    simulated = simulate("histology", shape=SHAPE, frames=2)
    top, left = (512 - 61) // 2, (512 - 83) // 2
    crop = skimage.data.immunohistochemistry()[top : top + 61, left : left + 83] / 255
    np.testing.assert_allclose(simulated.truth[0], crop, atol=1e-4)


def test_a_large_frame_sees_the_photograph_and_its_reflection():
    scene = make_scene("cat", (400, 500), np.random.default_rng(0))
    image = skimage.data.cat() / 255
    x0, y0 = -scene.origin[0], -scene.origin[1]  # where the photograph starts in frame 0
    assert (x0, y0) == (25, 50)
    seen = scene.sample(np.array([[x0 + 3, y0 + 4], [x0 - 3, y0 + 4]], dtype=float))
    np.testing.assert_allclose(seen, [image[4, 3], image[4, 3]], atol=1e-4)


@pytest.mark.parametrize("motion", MOTIONS)
def test_motions_begin_at_the_identity_and_move(motion):
    homographies = simulate(shape=SHAPE, frames=5, motion=motion).homographies
    np.testing.assert_array_equal(homographies[0], np.eye(3))
    assert np.abs(homographies[1:] - np.eye(3)).max() > 0.1


def test_brownian_motion_keeps_its_reach(rng):
    matrices = brownian_motion(500, (100, 150), rng, reach=0.1)
    centre = matrices @ [74.5, 49.5, 1]
    moved = centre[:, :2] / centre[:, 2:] - [74.5, 49.5]
    assert np.abs(moved).max() <= 10.001
    assert np.abs(moved).max() > 8


def test_a_raster_goes_there_and_back(rng):
    matrices = raster_motion(6, SHAPE, rng, step=2.0, columns=3)
    expected = [(0, 0), (2, 0), (4, 0), (4, 2), (2, 2), (0, 2)]
    np.testing.assert_allclose(matrices[:, :2, 2], expected, atol=1e-12)


def test_masked_frames_are_truth_times_transmission():
    simulated = simulate(shape=SHAPE, frames=3, camera=Camera(photons=1e12, read_noise=0))
    expected = simulated.truth * simulated.transmission[..., None]
    np.testing.assert_allclose(simulated.burst.frames, expected, atol=0.51 / 255)


def test_a_scene_that_is_too_large_to_be_drawn_says_what_else_there_is():
    with pytest.raises(SettingsError, match=r"4000 x 4100 pixels look at .* a scene of your own"):
        simulate("tissue", shape=(4000, 4100), frames=1)


def test_a_core_shows_the_mean_of_the_scene_over_its_area():
    # A ramp's mean over a disc is its value at the centre.
    columns = np.linspace(0.1, 0.9, 200, dtype=np.float32)
    scene = Scene(np.broadcast_to(columns[None, :, None], (150, 200, 1)).copy(), (50.0, 40.0))
    camera = Camera(photons=1e12, read_noise=0, bits=16)
    settings = {"pitch": 9.0, "crosstalk": 0.0, "physics": "core", "camera": camera}
    simulated = simulate(scene, shape=SHAPE, frames=2, **settings)
    bundle = simulated.bundle
    inside = ((bundle.centres > 6) & (bundle.centres < [83 - 7, 61 - 7])).all(axis=1)
    x, y = np.rint(bundle.centres[inside]).astype(int).T
    expected = np.interp(bundle.centres[inside, 0] + 50, np.arange(200), columns) * bundle.gains[inside]
    shown = simulated.burst.in_original_units(simulated.burst.frames[0])[y, x] / 65535
    np.testing.assert_allclose(shown, expected, atol=0.01)


@pytest.mark.parametrize(("bits", "exposure"), [(8, 1.0), (9, 1.0), (12, 0.2), (16, 0.1)])
def test_full_scale_is_the_cameras(bits, exposure):
    camera = Camera(photons=1e12, read_noise=0, bits=bits, exposure=exposure)
    simulated = simulate(shape=SHAPE, frames=2, camera=camera)
    expected = exposure * simulated.truth * simulated.transmission[..., None]
    np.testing.assert_allclose(simulated.burst.frames, expected, atol=0.51 / (2**bits - 1) + 2e-6)


@pytest.mark.parametrize("crosstalk", [0.0, 0.3])
def test_cores_show_an_even_scene_as_the_transmission(crosstalk):
    white = Scene(np.ones((20, 20, 1), np.float32))
    camera = Camera(photons=1e12, read_noise=0)
    simulated = simulate(white, shape=SHAPE, frames=2, physics="core", camera=camera, crosstalk=crosstalk)
    np.testing.assert_allclose(simulated.burst.frames[1, ..., 0], simulated.transmission, atol=0.51 / 255)


def test_a_core_has_no_detail_inside():
    camera = Camera(photons=1e12, read_noise=0, bits=16)
    simulated = simulate("tissue", shape=SHAPE, frames=2, pitch=12.0, physics="core", camera=camera)
    bundle = simulated.bundle
    inside = ((bundle.centres > 8) & (bundle.centres < [83 - 9, 61 - 9])).all(axis=1)
    x, y = np.rint(bundle.centres[inside]).astype(int).T
    frame = simulated.burst.frames[1]
    np.testing.assert_allclose(frame[y, x], frame[y, x + 1], atol=0.002)


def test_crosstalk_moves_light_between_neighbours_and_loses_none(rng):
    bundle = make_bundle((80, 80), rng, pitch=8.0, jitter=0.0, crosstalk=0.3)
    light = np.zeros(len(bundle.centres))
    middle = np.argmin(np.hypot(*(bundle.centres - 40).T))
    light[middle] = 1
    mixed = bundle.mix(light)
    assert mixed[middle] == pytest.approx(0.7)
    assert np.count_nonzero(mixed) == 7  # six neighbours
    assert mixed.sum() == pytest.approx(1)


def test_the_lattice_is_hexagonal_at_its_pitch(rng):
    bundle = make_bundle((120, 150), rng, pitch=7.0, jitter=0.0)
    inner = bundle.centres[((bundle.centres > 10) & (bundle.centres < [140, 110])).all(axis=1)]
    distances, _ = cKDTree(bundle.centres).query(inner, k=8)
    np.testing.assert_allclose(distances[:, 1:7], 7.0, rtol=1e-6)
    np.testing.assert_allclose(distances[:, 7], 7.0 * np.sqrt(3), rtol=1e-6)


def test_jitter_gain_dead_cores_and_outline(rng):
    bundle = make_bundle((200, 260), rng, pitch=5.0, dead_cores=0.1, gain_spread=0.1, outline="circle")
    assert (bundle.gains == 0).mean() == pytest.approx(0.1, abs=0.03)
    assert bundle.gains[bundle.gains > 0].std() == pytest.approx(0.1, abs=0.02)
    assert np.hypot(*(bundle.centres - [129.5, 99.5]).T).max() <= 95
    corners = bundle.transmission((200, 260))[[0, 0, -1, -1], [0, -1, 0, -1]]
    np.testing.assert_array_equal(corners, 0)


def test_noise_has_the_spread_of_shot_and_read_noise(rng):
    camera = Camera(photons=400.0, read_noise=0.02, bits=16)
    for level in (0.2, 0.8):
        counts = camera.record(np.full((300, 300), level, np.float32), rng) / 65535
        assert counts.mean() == pytest.approx(level, rel=0.01)
        assert counts.std() == pytest.approx(np.sqrt(level / 400 + 0.02**2), rel=0.02)


def test_exposure_saturates_and_a_pedestal_lifts(rng):
    camera = Camera(exposure=3.0, pedestal=0.1, bits=12, read_noise=0.0, photons=1e12)
    counts = camera.record(np.array([[0.0, 0.1, 0.9]], np.float32), rng)
    np.testing.assert_array_equal(counts, [[round(0.1 * 4095), round((0.1 + 0.9 * 0.3) * 4095), 4095]])


def test_the_seed_decides_everything():
    first, again, other = (simulate(shape=SHAPE, frames=3, seed=seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(first.burst.frames, again.burst.frames)
    assert not np.array_equal(first.homographies, other.homographies)
    assert not np.array_equal(first.transmission, other.transmission)


@pytest.mark.parametrize("channels", [1, 3, 7])
def test_any_number_of_channels(channels):
    burst = simulate(shape=SHAPE, frames=2, channels=channels).burst
    assert burst.shape == (2, *SHAPE, channels)
    assert burst.axes == ("TYX" if channels == 1 else "TYXC")


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_has_something_to_see(name):
    simulated = simulate(name, shape=SHAPE, frames=2)
    assert simulated.truth.min() >= 0
    assert simulated.truth.max() <= 1
    assert simulated.truth[0].std() > 0.02


def bars(profile):
    """Positions at which a profile crosses the middle between dark and bright."""
    above = profile > 0.475
    return np.flatnonzero(above[1:] != above[:-1])


def test_usaf_elements_grow_finer_by_the_sixth_root_of_two(rng):
    size, shape = 520.0, (600, 600)
    chart = usaf_chart(shape, rng, size=size)
    width = size / 26
    field = chart.sample(np.stack(np.meshgrid(np.arange(600.0), np.arange(600.0)), axis=-1))[..., 0]
    # Group g, element 1, at the bottom right: vertical bars, `width` wide, over five widths.
    row = field[int(300 + 13 * width - 2.5 * width)]
    edges = bars(row[300:])
    np.testing.assert_allclose(np.diff(edges[-6:]), width, atol=1.5)
    # Elements 2 to 6 down the left side: the period of the horizontal bars falls by 2^(1/6) each.
    left = int(300 - 13 * width + 1.5 * width)
    edges = bars(field[:, left])[: 5 * 6].reshape(5, 6)
    periods = (edges[:, 4] - edges[:, 0]) / 2
    np.testing.assert_allclose(periods, 2 * width * 2.0 ** (-np.arange(1, 6) / 6), atol=1.0)


@pytest.mark.parametrize(
    ("choices", "said"),
    [
        ({"scene": "dog"}, "known: histology"),
        ({"motion": "jump"}, "known: brownian"),
        ({"motion": np.zeros((2, 3, 3))}, "begin with the identity"),
        ({"motion": np.stack([np.eye(3), np.zeros((3, 3))])}, "must have an inverse"),
        ({"motion": np.eye(3)}, "must have shape"),
        ({"physics": "wave"}, "known: mask, core"),
        ({"frames": 0}, "frames must be an integer of at least 1"),
        ({"frames": 3.0}, "frames must be an integer"),
        ({"shape": (8, 40)}, "height must be an integer of at least 16"),
        ({"shape": (40,)}, "shape must be"),
        ({"channels": 0}, "channels must be"),
        ({"seed": -1}, "seed must be"),
        ({"jitter": -1}, "jitter must be"),
        ({"pitch": "3"}, "pitch must be"),
        ({"pitch": 1.0}, "pitch must be from 2"),
        ({"dead_cores": 1.0}, "dead_cores must be"),
        ({"outline": "star"}, "known: frame, circle"),
        ({"ptich": 3.0}, "unknown setting 'ptich'; known of the bundle: pitch"),
    ],
)
def test_bad_choices_are_refused(choices, said):
    with pytest.raises(SettingsError, match=said):
        simulate(**{"shape": SHAPE, "frames": 2, **choices})


def test_a_camera_that_cannot_be_is_refused():
    for impossible in ({"bits": 4}, {"bits": 8.5}, {"photons": float("nan")}, {"exposure": -1}, {"pedestal": 1}):
        with pytest.raises(SettingsError, match="8 to 16 bits"):
            Camera(**impossible)
