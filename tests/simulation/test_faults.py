"""Faults of recorded bursts: each does what its number says, leaves the rest as it was, and tells the truth."""

from dataclasses import fields

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import cKDTree

from napari_fiberburst.errors import SettingsError
from napari_fiberburst.simulation import Camera, Faults, Scene, simulate

SHAPE = (91, 117)
EXACT = Camera(photons=1e12, read_noise=0, bits=16)
STEP = 0.51 / 65535


def burst_with(scene="tissue", **faults):
    settings = {"shape": SHAPE, "frames": 7, "pitch": 5.0, "physics": "core", "channels": 1, "camera": EXACT}
    choices = {name: faults.pop(name) for name in list(faults) if name not in {item.name for item in fields(Faults)}}
    return simulate(scene, faults=Faults(**faults), **{**settings, **choices})


def even(level=1.0, channels=1):
    return Scene(np.full((200, 240, channels), level, np.float32), (60.0, 50.0))


@pytest.fixture(scope="module")
def clean():
    return burst_with()


@pytest.mark.parametrize(
    "fault",
    [
        {"flicker": 0.2},
        {"deformation": 2.0},
        {"smear": 0.5},
        {"background": 0.3},
        {"offset": 0.2},
        {"vignette": 2.0},
        {"field": 0.8},
        {"overlay": True},
        {"intruder": 0.1},
        {"black_frames": 1},
        {"white_frames": 1},
        {"bundle_shift": 1.5},
        {"contrast": 0.1},
    ],
)
def test_a_fault_changes_the_frames_and_leaves_scene_motion_and_cores_alone(fault, clean):
    faulty = burst_with(**fault)
    assert not np.array_equal(faulty.burst.frames, clean.burst.frames)
    np.testing.assert_array_equal(faulty.homographies, clean.homographies)
    np.testing.assert_array_equal(faulty.scene.image, clean.scene.image)
    np.testing.assert_array_equal(faulty.bundle.centres, clean.bundle.centres)
    np.testing.assert_array_equal(faulty.truth[0], clean.truth[0])


def test_faults_do_not_disturb_one_another():
    both = burst_with(flicker=0.1, deformation=2.0, bundle_shift=1.0)
    np.testing.assert_array_equal(both.exposures, burst_with(flicker=0.1).exposures)
    np.testing.assert_array_equal(both.displacement, burst_with(deformation=2.0).displacement)
    np.testing.assert_array_equal(both.bundle_offsets, burst_with(bundle_shift=1.0).bundle_offsets)


def test_exposures_multiply_the_frames_about_a_geometric_mean_of_1(clean):
    faulty = burst_with(flicker=0.1, camera=Camera(photons=1e12, read_noise=0, bits=16, exposure=0.5))
    assert np.log(faulty.exposures).mean() == pytest.approx(0, abs=1e-12)
    expected = 0.5 * clean.burst.frames * faulty.exposures[:, None, None, None]
    np.testing.assert_allclose(faulty.burst.frames, expected, atol=3 * STEP)


def test_flicker_is_the_relative_spread_of_exposures():
    exposures = burst_with(even(0.3), flicker=0.2, frames=400, shape=(17, 19), pitch=4.0).exposures
    assert exposures.std() / exposures.mean() == pytest.approx(0.2, rel=0.15)


def test_the_truth_is_the_scene_where_motion_and_displacement_point():
    faulty = burst_with(deformation=3.0, deformation_length=40.0)
    rows, columns = np.indices(SHAPE)
    x0, y0 = faulty.scene.origin
    for matrix, displacement, truth in zip(faulty.homographies, faulty.displacement, faulty.truth, strict=True):
        x, y, depth = np.einsum("ij,jhw->ihw", matrix, np.stack([columns, rows, np.ones(SHAPE)]))
        points = (y / depth + displacement[..., 1] + y0, x / depth + displacement[..., 0] + x0)
        expected = map_coordinates(faulty.scene.image[..., 0], points, order=3, mode="mirror")
        assert np.abs(truth[..., 0] - np.clip(expected, 0, 1)).max() < 0.04  # two kinds of splines


def test_the_displacement_has_the_rms_that_was_asked_and_frame_0_is_at_rest():
    displacement = burst_with(deformation=2.5).displacement
    np.testing.assert_array_equal(displacement[0], 0)
    np.testing.assert_allclose(np.sqrt((displacement[1:] ** 2).sum(axis=-1).mean(axis=(1, 2))), 2.5, rtol=1e-5)
    round_one = burst_with(deformation=2.5, field=0.7)
    inside = round_one.displacement[1:, round_one.visible]
    np.testing.assert_allclose(np.sqrt((inside**2).sum(axis=-1).mean(axis=1)), 2.5, rtol=1e-5)


def test_the_correlation_of_a_displacement_falls_to_1_over_e_at_its_length():
    faulty = burst_with(even(0.3), deformation=1.0, deformation_length=12.0, frames=12, shape=(211, 241), pitch=6.0)
    displacement = faulty.displacement[1:]
    power = (displacement**2).mean()
    along_x = (displacement[:, :, 12:] * displacement[:, :, :-12]).mean() / power
    along_y = (displacement[:, 12:] * displacement[:, :-12]).mean() / power
    assert (along_x + along_y) / 2 == pytest.approx(np.exp(-1), abs=0.06)


def test_a_smeared_frame_is_the_mean_of_the_way_it_goes():
    ramp = Scene(np.broadcast_to(np.linspace(0, 1, 300, dtype=np.float32)[None, :, None] ** 2, (200, 300, 1)).copy())
    motion = np.broadcast_to(np.eye(3), (3, 3, 3)).copy()
    motion[:, 0, 2] = [0.0, 10.0, 20.0]
    looks = {"motion": motion, "frames": 3, "physics": "mask"}
    faulty, sharp = burst_with(ramp, smear=0.8, **looks), burst_with(ramp, **looks)
    np.testing.assert_array_equal(faulty.truth, sharp.truth)
    # Of a parabola a x^2, positions spread by a variance v about the middle add a v.
    brighter = ((0.8 * 10) ** 2 / 4 * (0.5**2 + 1) / 2.5) / 299**2
    added = (faulty.burst.frames - sharp.burst.frames)[..., 0]
    bright = sharp.transmission > 0.5
    np.testing.assert_allclose((added / np.maximum(sharp.transmission, 0.1))[:, bright], brighter, atol=6 * STEP)


@pytest.mark.parametrize("physics", ["mask", "core"])
def test_the_background_is_its_part_of_the_mean_light_and_the_same_in_all_frames(physics, clean):
    settings = {"physics": physics, "channels": 3, "scene": even(0.4, 3)}
    faulty, dark = burst_with(background=0.25, **settings), burst_with(**settings)
    added = faulty.burst.frames - dark.burst.frames
    np.testing.assert_allclose(added, np.broadcast_to(faulty.background, added.shape), atol=3 * STEP)
    assert faulty.background.mean() == pytest.approx(0.25 * dark.burst.frames.mean(), rel=1e-3)
    inside = ((dark.bundle.centres > 5) & (dark.bundle.centres < [111, 85])).all(axis=1)
    x, y = np.rint(dark.bundle.centres[inside]).astype(int).T
    of_core = faulty.background[y, x, 0] / dark.transmission[y, x]
    assert of_core.std() / of_core.mean() == pytest.approx(0.3, abs=0.05)


@pytest.mark.parametrize("physics", ["mask", "core"])
def test_offsets_have_their_size_and_are_the_same_in_all_frames(physics):
    settings = {"physics": physics, "channels": 3, "scene": even(0.4, 3)}
    faulty, dark = burst_with(offset=0.3, **settings), burst_with(**settings)
    added = faulty.burst.frames - dark.burst.frames
    np.testing.assert_allclose(added, np.broadcast_to(faulty.background, added.shape), atol=3 * STEP)
    inside = ((dark.bundle.centres > 5) & (dark.bundle.centres < [111, 85])).all(axis=1)
    x, y = np.rint(dark.bundle.centres[inside]).astype(int).T
    of_core = faulty.background[y, x, 0] / dark.transmission[y, x]
    assert np.sqrt((of_core**2).mean()) == pytest.approx(0.3 * 0.4, rel=0.15)


def test_a_vignette_darkens_the_rim_so_many_times():
    faulty, plain = burst_with(vignette=3.0, field=0.9), burst_with(field=0.9)
    centre = (45, 58)
    assert faulty.shading[centre] == pytest.approx(1, abs=1e-3)
    assert faulty.shading[45, 58 - 40, 0] == pytest.approx(3 ** -((40 / 40.95) ** 2), rel=1e-3)
    ratio = faulty.burst.frames[:, plain.transmission > 0.2] / plain.burst.frames[:, plain.transmission > 0.2]
    expected = np.broadcast_to((faulty.shading / np.maximum(plain.shading, 0.1))[plain.transmission > 0.2], ratio.shape)
    is_bright = plain.burst.frames[:, plain.transmission > 0.2] > 0.05
    np.testing.assert_allclose(ratio[is_bright], expected[is_bright], rtol=1e-3)


def test_without_a_round_field_the_vignette_ends_at_the_corners_and_colours_differ():
    shading = burst_with(vignette=4.0, channels=3).shading
    np.testing.assert_allclose(-np.log(shading[0, 0]) / np.log(4), [0.8, 1.0, 1.2], rtol=1e-5)


def test_the_flat_field_is_what_an_even_white_scene_shows():
    faulty = burst_with(even(1.0, 3), vignette=2.0, field=0.8, contrast=0.08, channels=3)
    np.testing.assert_allclose(faulty.burst.frames[3], faulty.flat, atol=3 * STEP)
    np.testing.assert_allclose(faulty.transmission, faulty.flat.mean(axis=2))


def test_a_round_field_is_black_outside_and_says_what_is_visible():
    faulty = burst_with(field=0.8, background=0.2)
    rows, columns = np.indices(SHAPE)
    distance = np.hypot(rows - 45, columns - 58)
    assert faulty.burst.frames[:, distance > 0.8 * 45.5 + 1].max() == 0
    np.testing.assert_array_equal(faulty.visible, distance < 0.8 * 45.5)
    assert faulty.burst.frames[:, faulty.visible].mean() > 0.02


def test_burned_in_marks_stand_still_in_all_frames_whatever_else_happens():
    faulty = burst_with(overlay=True, field=0.8, flicker=0.3, black_frames=1, white_frames=1)
    plain = burst_with(field=0.8)
    marks = plain.visible & ~faulty.visible
    assert 3 <= marks.sum() < 0.02 * marks.size
    np.testing.assert_allclose(faulty.burst.frames[:, marks], 0.94, atol=STEP)
    outside = ~plain.visible
    shown = faulty.burst.frames[:, outside, 0]
    assert (shown.max(axis=1) > 0.9).all()  # the logo and the scale bar
    np.testing.assert_array_equal(shown > 0.9, np.broadcast_to(shown[0] > 0.9, shown.shape))


def test_an_intruder_covers_its_part_of_the_field_in_its_part_of_the_frames_and_moves():
    faulty, plain = burst_with(intruder=0.08, frames=9, field=0.9), burst_with(frames=9, field=0.9)
    covered = faulty.intruder[:, plain.visible].mean(axis=1)
    assert covered[0] == 0
    assert (covered > 0).sum() == 3
    np.testing.assert_allclose(covered[covered > 0], 0.08, rtol=0.05)
    where = [np.argwhere(mask).mean(axis=0) for mask in faulty.intruder if mask.any()]
    assert np.hypot(*(where[2] - where[0])) > 20
    changed = np.abs(faulty.burst.frames - plain.burst.frames)[..., 0] > 0.05
    reach = np.stack([gaussian_filter(mask.astype(float), 2.0) > 0.01 for mask in faulty.intruder])
    assert changed[faulty.intruder].mean() > 0.4  # the cores that pass light
    assert not changed[~reach].any()


def test_black_and_white_frames_are_never_frame_0_and_are_said_to_be_unusable():
    faulty = burst_with(black_frames=2, white_frames=1, flicker=0.1)
    means = faulty.burst.frames.mean(axis=(1, 2, 3))
    assert faulty.usable[0]
    assert faulty.usable.sum() == 4
    assert sorted(means[~faulty.usable]) == [0, 0, 1]
    assert (0.02 < means[faulty.usable]).all()
    assert (means[faulty.usable] < 0.9).all()


def test_the_bundle_moves_once_at_half_of_the_burst():
    faulty, plain = burst_with(even(), bundle_shift=2.0, frames=6), burst_with(even(), frames=6)
    np.testing.assert_array_equal(faulty.bundle_offsets[:3], 0)
    np.testing.assert_allclose(np.hypot(*faulty.bundle_offsets[3:].T), 2)
    np.testing.assert_array_equal(faulty.burst.frames[:3], plain.burst.frames[:3])
    moved = faulty.bundle.centres + faulty.bundle_offsets[4]
    inside = ((moved > 4) & (moved < [112, 86])).all(axis=1)
    at_cores = map_coordinates(faulty.burst.frames[4, ..., 0], moved[inside].T[::-1], order=1)
    np.testing.assert_allclose(at_cores, faulty.bundle.gains[inside], atol=0.12)
    stood = map_coordinates(faulty.burst.frames[4, ..., 0], faulty.bundle.centres[inside].T[::-1], order=1)
    assert stood.mean() < 0.8 * at_cores.mean()


@pytest.mark.parametrize("contrast", [0.066, 0.2])
def test_a_faint_bundle_has_the_contrast_that_was_asked_and_still_one_value_a_core(contrast):
    flat = burst_with(even(), contrast=contrast).burst.frames[0, ..., 0]
    mean = gaussian_filter(flat, 5.0)
    assert (flat / mean)[10:-10, 10:-10].std() == pytest.approx(contrast, rel=0.1)
    assert flat.min() > 0.2
    faulty = burst_with("tissue", contrast=contrast)
    shown = faulty.burst.frames[2, ..., 0] / faulty.transmission
    inside = ((faulty.bundle.centres > 8) & (faulty.bundle.centres < [108, 82])).all(axis=1)
    x, y = np.rint(faulty.bundle.centres[inside]).astype(int).T
    np.testing.assert_allclose(shown[y, x], shown[y, x + 1], atol=0.03)


def measured_flat(shape=SHAPE, pitch=6.0, channels=1):
    """Return a bundle and a flat field of it in which cores are smooth and the camera adds noise."""
    designed = simulate(shape=shape, frames=1, pitch=pitch, jitter=0.05, gain_spread=0.1, core_radius=0.3)
    noise = np.random.default_rng(4).normal(0, 0.5, (*shape, channels))
    light = 200 * gaussian_filter(designed.transmission, 0.8)[..., None] * np.linspace(1, 0.7, channels)
    return designed, np.clip(light + 3 + noise, 0, 255)


def test_the_cores_of_a_measured_flat_field_are_found():
    designed, flat = measured_flat()
    found = simulate("tissue", flat=flat[..., 0], frames=2, physics="core").bundle
    inner = designed.bundle.centres[((designed.bundle.centres > 6) & (designed.bundle.centres < [110, 84])).all(axis=1)]
    distance, _ = cKDTree(found.centres).query(inner)
    assert (distance < 1).mean() > 0.97
    assert np.median(distance) < 0.2
    assert len(found.centres) < 1.1 * len(designed.bundle.centres)
    assert found.pitch == pytest.approx(6.0, rel=0.06)


def test_a_measured_flat_field_is_the_bundle_in_its_own_colours():
    _, flat = measured_flat(channels=3)
    simulated = simulate(even(1.0, 3), flat=flat, frames=3, physics="core", camera=EXACT)
    assert simulated.burst.shape == (3, *SHAPE, 3)
    expected = np.clip(flat / np.quantile(flat, 0.999), 0, 1)
    np.testing.assert_allclose(simulated.burst.frames[2, 4:-4, 4:-4], expected[4:-4, 4:-4], atol=0.02)
    np.testing.assert_allclose(simulated.burst.frames[2], simulated.flat, atol=2 * STEP)


def test_a_measured_core_gathers_its_cell_by_the_square_of_its_profile():
    _, flat = measured_flat()
    ramp = Scene(np.broadcast_to(np.linspace(0.1, 0.9, 240, dtype=np.float32)[None, :, None], (200, 240, 1)).copy())
    simulated = simulate(ramp, flat=flat, frames=1, physics="core", camera=EXACT)
    shown = simulated.burst.frames[0, ..., 0] / np.maximum(simulated.transmission, 0.05)
    rows, columns = np.indices(SHAPE)
    centres = simulated.bundle.centres
    distance, nearest = cKDTree(centres).query(np.stack([columns, rows], axis=-1))
    for core in np.flatnonzero(((centres > 20) & (centres < [97, 71])).all(axis=1))[::9]:
        cell = (nearest == core) & (distance < 0.7 * simulated.bundle.pitch)
        weights = flat[cell, 0] ** 2
        expected = (weights * simulated.truth[0, cell, 0]).sum() / weights.sum()
        np.testing.assert_allclose(shown[cell & (simulated.transmission > 0.2)], expected, atol=1e-3)


def test_a_measured_flat_field_is_cropped_about_its_middle_and_dims_a_mask():
    _, flat = measured_flat()
    simulated = simulate(even(0.5), flat=flat, shape=(61, 73), frames=2, camera=EXACT)
    part = np.clip(flat[15:76, 22:95] / np.quantile(flat[15:76, 22:95], 0.999), 0, 1)
    shown = simulated.burst.frames[1]
    is_cell = shown > 0  # nearly all pixels; cores are not found where only their edge is in the frame
    assert is_cell.mean() > 0.95
    np.testing.assert_allclose(shown[is_cell], 0.5 * part[is_cell], atol=2 * STEP)


def test_frames_that_are_taken_bring_their_truth():
    faulty = burst_with(flicker=0.1, deformation=2.0, intruder=0.1, black_frames=1, bundle_shift=1.0)
    some = faulty.take([0, 5, 3])
    for name in ("truth", "homographies", "exposures", "usable", "bundle_offsets", "displacement", "intruder"):
        np.testing.assert_array_equal(getattr(some, name), getattr(faulty, name)[[0, 5, 3]])
    np.testing.assert_array_equal(some.burst.frames, faulty.burst.frames[[0, 5, 3]])
    assert some.burst.axes == faulty.burst.axes
    with pytest.raises(SettingsError, match="begin with frame 0"):
        faulty.take([1, 2])


def test_arrays_hold_what_there_is_and_nothing_else(clean):
    assert not {"displacement", "intruder", "background", "shading", "visible", "flat"} & set(clean.arrays())
    faulty = burst_with(deformation=1.0, background=0.1, vignette=2.0, channels=3, intruder=0.1, overlay=True).arrays()
    assert faulty["displacement"].shape == (7, *SHAPE, 2)
    assert faulty["intruder"].shape == (7, *SHAPE)
    assert faulty["flat"].shape == faulty["shading"].shape == faulty["background"].shape == (*SHAPE, 3)
    assert faulty["visible"].shape == SHAPE
    np.testing.assert_array_equal(faulty["usable"], True)


@pytest.mark.parametrize(
    ("faults", "said"),
    [
        ({"flicker": -0.1}, "flicker must be a number of at least 0"),
        ({"deformation": float("nan")}, "deformation must be"),
        ({"deformation_length": 1.0}, "deformation_length must be"),
        ({"smear": 2.0}, "smear must be"),
        ({"vignette": 0.5}, "vignette must be a number of at least 1"),
        ({"field": 1.5}, "field must be"),
        ({"overlay": 1}, "overlay must be true or false"),
        ({"intruder": 0.9}, "intruder must be"),
        ({"intruder_frames": 0.0}, "intruder_frames must be a number above 0"),
        ({"black_frames": 1.5}, "black_frames must be an integer"),
        ({"black_frames": 4, "white_frames": 3}, "at most 6 of 7 frames"),
        ({"contrast": 3.0}, "contrast must be from"),
        ({"contrast": 1e-6}, "contrast must be from"),
    ],
)
def test_faults_out_of_range_are_refused(faults, said):
    with pytest.raises(SettingsError, match=said):
        burst_with(**faults)


@pytest.mark.parametrize(
    ("choices", "said"),
    [
        ({"flat": np.ones(40)}, "shape must be"),
        ({"flat": np.ones((40, 50, 2))}, "flat must be an image"),
        ({"flat": np.ones((40, 50)), "shape": (60, 40)}, "shape must fit into flat, 40 x 50"),
        ({"flat": -np.ones((40, 50))}, "flat must hold finite intensities"),
        ({"flat": np.zeros((40, 50))}, "flat must hold finite intensities"),
        ({"flat": np.full((40, 50), np.nan)}, "flat must hold finite intensities"),
        ({"flat": np.ones((40, 50))}, "flat must show the cores"),
        ({"flat": np.ones((40, 50)), "crosstalk": 1.5}, "crosstalk must be from 0 to 1"),
        ({"flat": np.ones((40, 50)), "pitch": 5.0}, "unknown setting 'pitch'; known of a bundle given by its flat"),
    ],
)
def test_flat_fields_that_are_none_are_refused(choices, said):
    with pytest.raises(SettingsError, match=said):
        simulate("tissue", frames=2, **choices)
