"""Long recordings: frames made when they are read, and a truth that holds by independent arithmetic."""

import pickle
import subprocess
import sys
import tracemalloc
from hashlib import sha256
from itertools import pairwise

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from napari_fiberburst.errors import SettingsError
from napari_fiberburst.simulation import PATHS, Camera, Scene, Slide, simulate, simulate_recording

SHAPE = (61, 83)
EXACT = Camera(photons=1e12, read_noise=0, bits=16)
STEP = 1 / 65535


def recorded(scene="slide", **settings):
    return simulate_recording(scene, **{"frames": 40, "shape": SHAPE, "pitch": 5.0, "camera": EXACT, **settings})


def centres(recording):
    """Return where the middles of frames look (T, 2)."""
    middle = np.array([(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2, 1])
    mapped = recording.homographies @ middle
    return mapped[:, :2] / mapped[:, 2:]


def even(level=0.5, size=2000):
    return Scene(np.full((size, size, 1), level, np.float32), (size / 2, size / 2))


def looked_up(picture, x, y):
    """Return a picture (H, W, C) at points, by splines of another order than the simulator's."""
    return np.stack([map_coordinates(band, (y, x), order=3) for band in np.moveaxis(picture, 2, 0)], axis=-1)


@pytest.mark.parametrize("path", PATHS)
def test_truth_is_the_picture_of_the_scene_at_mapped_points(path):
    recording = recorded(path=path, turn=3.0, zoom=0.02, channels=3, seed=5)
    x0, y0, x1, y1 = np.floor(recording.bounds) + np.array([-4, -4, 5, 5])
    fine = 4
    picture = recording.picture((x0, y0, x1, y1), 1 / fine)
    rows, columns = np.indices(SHAPE)
    for number in (0, 17, 39):
        x, y, depth = np.tensordot(recording.homographies[number], np.stack([columns, rows, np.ones(SHAPE)]), 1)
        # The middle of the picture's first pixel lies (1 - 1/fine) / 2 before the bounds' first whole pixel.
        first = 0.5 - 0.5 / fine
        expected = looked_up(picture, fine * (x / depth - x0 + first), fine * (y / depth - y0 + first))
        np.testing.assert_allclose(recording.truth([number])[0], expected, atol=0.01)


def test_two_frames_see_one_point_where_their_homographies_say():
    recording = recorded(path="handheld", turn=3.0, zoom=0.02, step=3.0)
    fixed, moved = recording.truth([10, 16])
    between = np.linalg.inv(recording.homographies[16]) @ recording.homographies[10]
    rows, columns = np.mgrid[20:40, 30:50]
    x, y, depth = np.tensordot(between, np.stack([columns, rows, np.ones(rows.shape)]), 1)
    assert np.hypot(x / depth - columns, y / depth - rows).min() > 8
    smooth = gaussian_filter(fixed, (1.5, 1.5, 0)), gaussian_filter(moved, (1.5, 1.5, 0))
    expected = looked_up(smooth[1], x / depth, y / depth)
    assert np.abs(smooth[0][20:40, 30:50] - expected).max() < 0.03
    assert np.abs(smooth[0][20:40, 30:50] - smooth[1][20:40, 30:50]).max() > 0.1


@pytest.mark.parametrize("physics", ["core", "mask"])
def test_frames_are_those_of_a_simulated_burst(physics):
    recording = recorded(path="spiral", turn=3.0, frames=7, physics=physics, seed=4)
    left, top = 60, 50
    picture = recording.picture((-left, -top, 170, 140))
    # A picture is what a spline goes through, so that the same spline goes on from it.
    burst = simulate(
        Scene(picture, (left, top)),
        shape=SHAPE,
        frames=7,
        motion=recording.homographies,
        physics=physics,
        pitch=5.0,
        camera=EXACT,
        seed=4,
    )
    np.testing.assert_array_equal(recording.bundle.centres, burst.bundle.centres)
    np.testing.assert_allclose(recording.transmission, burst.transmission)
    np.testing.assert_allclose(recording.truth(range(7)), burst.truth, atol=1e-5)
    np.testing.assert_allclose(recording.source.values(range(7)), burst.burst.frames, atol=1.5 * STEP)


def test_frames_are_the_same_in_any_order_after_pickling_and_in_another_process():
    settings = {"path": "handheld", "bending": 2.0, "cells": 3, "gaps": 1, "gap_frames": 5, "flicker": 0.1, "seed": 3}
    source = recorded(camera=Camera(), **settings).source
    frames = source.recorded([31, 2, 17])
    copied = pickle.loads(pickle.dumps(source))
    for number, frame in zip((31, 2, 17), frames, strict=True):
        np.testing.assert_array_equal(copied.recorded([number])[0], frame)
    code = (
        "from napari_fiberburst.simulation import Camera, simulate_recording; from hashlib import sha256;"
        f"source = simulate_recording(frames=40, shape={SHAPE}, pitch=5.0, camera=Camera(), **{settings}).source;"
        "print(sha256(source.recorded([17]).tobytes()).hexdigest(), source.fingerprint)"
    )
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert printed == [sha256(frames[2].tobytes()).hexdigest(), source.fingerprint]
    assert source.fingerprint != recorded(camera=Camera(), **{**settings, "seed": 4}).source.fingerprint
    assert source.fingerprint != recorded(camera=Camera(photons=900), **settings).source.fingerprint


def test_noise_differs_from_frame_to_frame_and_is_the_cameras():
    recording = recorded(even(), frames=30, path=np.tile(np.eye(3), (30, 1, 1)), camera=Camera(photons=400, bits=12))
    frames = recording.source.values(range(30))[..., 0]
    light = recording.transmission * 0.5
    bright = light > 0.2
    measured = frames.std(axis=0, ddof=1)[bright] / np.sqrt(light[bright] / 400 + 0.0014**2)
    assert np.median(measured) == pytest.approx(1, abs=0.03)


def test_a_hundred_thousand_frames_cost_a_few_numbers_each():
    tracemalloc.start()
    long = recorded(frames=100_000, path="handheld", cells=2, gaps=20, turn=3.0, flicker=0.05)
    last = long.source.recorded([99_999])
    held = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert long.source.shape == (100_000, *SHAPE, 1)
    assert last.std() > 0
    assert held < 100_000 * 150 + 8e6


def test_reading_on_holds_no_more():
    source = recorded(frames=3000, path="raster", step=20.0).source
    source.recorded(range(0, 600, 30))
    tracemalloc.start()
    for number in range(600, 3000, 120):
        source.recorded([number])
    held = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert held < 10e6


def test_a_raster_goes_in_overlapping_rows_at_an_even_step():
    positions = centres(recorded(frames=300, step=4.0))
    steps = np.diff(positions, axis=0)
    assert np.abs(steps).sum(axis=1) == pytest.approx(4.0)
    rows = np.unique(positions[:-1][np.abs(steps[:, 1]) < 1e-9, 1].round(6))
    assert len(rows) >= 4
    assert np.diff(rows) == pytest.approx(0.6 * SHAPE[0])
    assert np.ptp(positions[:, 0]) == pytest.approx(np.ptp(positions[:, 1]), rel=0.5)


def test_a_spiral_widens_by_as_much_a_turn_as_its_turns_overlap():
    positions = centres(recorded(frames=800, path="spiral", step=3.0))
    x, y = (positions - positions[0]).T
    angle, radius = np.unwrap(np.arctan2(y, x)[5:]), np.hypot(x, y)[5:]
    assert (radius[-1] - radius[0]) / (angle[-1] - angle[0]) == pytest.approx(0.6 * SHAPE[0] / (2 * np.pi), rel=1e-3)
    assert np.hypot(*np.diff(positions, axis=0).T)[5:] == pytest.approx(3.0, rel=5e-3)


def crossings(path):
    """Return how often a path (T, 2) crosses itself: segments whose ends lie on both sides of each other."""
    starts, ends = path[:-1], path[1:]

    def side(a, b, c):
        return np.sign(
            (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])
        )

    one = starts[:, None], ends[:, None]
    two = starts[None], ends[None]
    cross = (side(*one, two[0]) != side(*one, two[1])) & (side(*two, one[0]) != side(*two, one[1]))
    return int(np.triu(cross, 2).sum())


@pytest.mark.parametrize("seed", range(4))
def test_a_hand_wanders_in_loops_at_its_speed(seed):
    positions = centres(recorded(frames=400, path="handheld", step=2.0, seed=seed))
    assert crossings(positions) >= 2
    assert crossings(centres(recorded(frames=400, step=2.0))) == 0
    assert np.sqrt((np.diff(positions, axis=0) ** 2).sum(axis=1).mean()) == pytest.approx(2.0, rel=0.25)
    assert np.ptp(positions, axis=0).min() > SHAPE[0]


def test_laps_return_to_the_same_places_and_turn_on():
    once, thrice = recorded(frames=30, path="handheld"), recorded(frames=90, path="handheld", laps=3, turn=3.0)
    places = centres(thrice)
    np.testing.assert_allclose(places[:30], centres(once), atol=1e-9)
    np.testing.assert_allclose(places[30:60], places[:30][::-1], atol=1e-9)
    np.testing.assert_allclose(places[60:], places[:30], atol=1e-9)
    assert np.abs(thrice.homographies[65] - thrice.homographies[5]).max() > 1e-3


def test_turn_and_zoom_go_as_far_as_they_are_told_slowly():
    matrices = recorded(frames=300, path="raster", turn=3.0, zoom=0.02).homographies
    angles = np.degrees(np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0]))
    zooms = np.log(np.sqrt(np.linalg.det(matrices[:, :2, :2])))
    for values, most in ((angles, 3.0), (zooms, np.log(1.02))):
        assert values[0] == pytest.approx(0, abs=1e-12)
        assert np.abs(values).max() == pytest.approx(most)
        assert np.abs(np.diff(values)).max() < most / 15


def test_without_contact_frames_are_blurred_then_black():
    settings = {"path": np.tile(np.eye(3), (90, 1, 1)), "frames": 90, "physics": "mask"}
    recording = recorded(gaps=2, gap_frames=9, **settings)
    gaps = np.flatnonzero(~recording.in_contact)
    assert len(gaps) == 18
    assert recording.in_contact[0]
    first, second = np.split(gaps, 2)
    assert np.ptp(first) == np.ptp(second) == 8  # each in one piece
    frames = recording.source.values(range(90))[..., 0]
    whole = recorded(**settings).source.values(range(90))[..., 0]
    np.testing.assert_array_equal(frames[recording.in_contact], whole[recording.in_contact])
    assert frames[first[4]].max() < 1e-4
    lift = 0.3  # third of ten steps, of which a third leave
    lit = recording.transmission > 0.3
    seen = [frame[lit] / recording.transmission[lit] for frame in (whole[0], frames[first[0]])]
    assert seen[1].mean() / seen[0].mean() == pytest.approx((1 - lift) ** 2, rel=0.05)
    assert seen[1].std() / seen[1].mean() < 0.6 * seen[0].std() / seen[0].mean()
    np.testing.assert_array_equal(recording.truth([first[4]]), recording.truth([0]))


def test_a_cut_goes_on_at_another_place_and_is_told():
    smooth, cut = recorded(frames=60), recorded(frames=60, jumps=2, jump=150.0)
    assert len(smooth.cuts) == 0
    assert len(cut.cuts) == 2
    offsets = centres(cut) - centres(smooth)
    steps = np.hypot(*np.diff(offsets, axis=0).T)
    np.testing.assert_array_equal(np.flatnonzero(steps > 1e-9) + 1, cut.cuts)
    assert steps[cut.cuts - 1] == pytest.approx(150.0)
    assert all(later - earlier > 10 for earlier, later in pairwise([0, *cut.cuts, 60]))


def test_homographies_of_ones_own_are_taken_and_can_be_cut():
    own = np.tile(np.eye(3), (12, 1, 1))
    own[:, 0, 2] = 2.5 * np.arange(12)
    own[5:, :2, :2] *= 1.05
    np.testing.assert_array_equal(recorded(path=own, frames=None).homographies, own)
    cut = recorded(path=own, frames=None, jumps=1, jump=90.0)
    np.testing.assert_allclose(cut.homographies[:, :2, :2], own[:, :2, :2])
    assert np.hypot(*(cut.homographies - own)[-1, :2, 2]) == pytest.approx(90.0)


def test_tissue_bends_slowly_and_truth_says_how():
    bent = recorded(frames=120, bending=3.0, path=np.tile(np.eye(3), (120, 1, 1)))
    fields = np.stack([bent.displacement(number) for number in range(120)])
    assert np.abs(fields[0]).max() == 0
    sizes = np.sqrt((fields**2).sum(axis=-1).mean(axis=(1, 2)))
    assert 1.0 < sizes.max() < 6.0  # 3 on average over places, of which a frame sees few
    assert np.abs(np.diff(fields, axis=0)).max() < 0.6
    assert np.abs(np.diff(fields, axis=1)).max() < 0.5
    number = int(sizes.argmax())
    rows, columns = np.indices(SHAPE)
    x, y = columns + fields[number, ..., 0], rows + fields[number, ..., 1]
    expected = looked_up(bent.picture((-20, -20, 103, 81), 0.25), 4 * (x + 20) + 1.5, 4 * (y + 20) + 1.5)
    np.testing.assert_allclose(bent.truth([number])[0], expected, atol=0.01)
    assert recorded().displacement(3) is None


def test_bending_belongs_to_the_tissue():
    bent = recorded(frames=60, bending=3.0, step=2.0)
    number, shift = 50, np.rint(bent.homographies[50, :2, 2]).astype(int)
    still = recorded(frames=60, bending=3.0, path=np.tile(np.eye(3), (60, 1, 1)))
    moved = recorded(frames=60, bending=3.0, path=np.concatenate([[np.eye(3)], np.tile(at(*shift), (59, 1, 1))]))
    wide = still._views.bending.at(number, np.stack(np.meshgrid(np.arange(83), np.arange(61)), -1) + shift)
    np.testing.assert_allclose(moved.displacement(number), wide, atol=1e-4)


def at(x, y):
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])


def test_cells_blink_at_their_places_as_their_traces_say():
    recording = recorded(even(0.3), frames=60, step=1.0, cells=6, flash=0.25, flash_frames=3, bending=1.0)
    truth = recording.truth(range(60))[..., 0]
    rows, columns = np.indices(SHAPE)
    expected = np.full((60, *SHAPE), 0.3)
    for number in range(60):
        moved = recording.homographies[number] @ np.stack([columns.ravel(), rows.ravel(), np.ones(rows.size)])
        points = moved[:2].T.reshape(*SHAPE, 2) + recording.displacement(number)
        for place, trace in zip(recording.cells, recording.traces.T, strict=True):
            near = np.hypot(*np.moveaxis(points - place, -1, 0)) < recording.cell_radius
            expected[number] += trace[number] * near
    edge = 0.13  # of a disc of light a pixel wide
    assert np.abs(truth - expected).max() < edge + 1e-5
    np.testing.assert_allclose(truth.sum(axis=(1, 2)), expected.sum(axis=(1, 2)), rtol=0.002)
    assert set(np.unique(recording.traces)) == {0, np.float32(0.25)}
    assert recording.cell_radius == pytest.approx(0.75 * 5.0)
    assert ((truth > 0.5).any(axis=(1, 2))).sum() > 10
    for trace in recording.traces.T > 0:
        edges = np.flatnonzero(np.diff(np.concatenate([[0], trace, [0]])))
        lengths = edges[1::2] - edges[::2]
        assert len(lengths) > 0
        assert (lengths[edges[1::2] < 60] == 3).all()


def test_light_flickers_and_drifts():
    still = np.tile(np.eye(3), (200, 1, 1))
    steady = recorded(path=still, frames=200)
    flickering, drifting = (recorded(path=still, frames=200, **{name: 0.1}) for name in ("flicker", "drift"))
    np.testing.assert_array_equal(steady.exposures, 1)
    assert np.log(flickering.exposures).std() == pytest.approx(0.1, rel=0.2)
    assert np.abs(np.log(drifting.exposures / drifting.exposures[0])).max() == pytest.approx(np.log(1.1))
    assert np.abs(np.diff(drifting.exposures)).max() < 0.01
    frames = flickering.source.values([0, 3]).mean(axis=(1, 2, 3))
    base = steady.source.values([0, 3]).mean(axis=(1, 2, 3))
    np.testing.assert_allclose(frames / base, flickering.exposures[[0, 3]], rtol=1e-3)


def test_a_vendors_display_has_no_cores_a_round_field_and_marks():
    shape = (131, 147)
    shown = recorded(even(), shape=shape, path="spiral", physics="filtered", field=0.9, overlay=True, frames=3)
    raw = recorded(even(), shape=shape, path="spiral", frames=3)
    image = shown.source.values([1])[0, ..., 0]
    rows, columns = np.indices(shape)
    distance = np.hypot(rows - 65, columns - 73)
    inside = (distance < 0.9 * 65 - 4) & shown.visible
    assert image[inside].mean() == pytest.approx(0.5, abs=0.02)
    assert image[inside].std() / image[inside].mean() < 0.05
    cores = raw.source.values([1])[0, ..., 0][inside]
    assert cores.std() / cores.mean() > 0.4
    marks = ~shown.visible & (distance < 0.9 * 65 - 4)
    assert marks.sum() > 10
    np.testing.assert_allclose(image[marks], 0.94, atol=1e-3)
    corner = image[-20:, :20]
    assert (corner == 0).all()


def test_a_slide_has_no_seams_no_repetition_and_detail_at_all_scales():
    slide = Slide(seed=2, channels=1)
    y, x = np.mgrid[-200:300, -250:262].astype(float)
    image = slide.sample(np.stack([x, y], axis=-1))[..., 0]
    assert 0.3 < image.mean() < 0.9
    seams = np.abs(np.diff(image, axis=1)).mean(axis=0)
    at_seams = [edge + 250 - 1 for edge in (-128, 0, 128)]
    assert seams[at_seams].max() < np.quantile(seams, 0.99)
    for offset in (128, 256, 1024):
        elsewhere = slide.sample(np.stack([x + offset, y], axis=-1))[..., 0]
        assert abs(np.corrcoef(image.ravel(), elsewhere.ravel())[0, 1]) < 0.2
    spreads = [
        np.std(gaussian_filter(image, sigma) - gaussian_filter(image, 2 * sigma)) for sigma in (0.5, 1, 2, 4, 8, 16, 32)
    ]
    assert min(spreads) > 0.01
    # Wherever it is looked at from, it is the same.
    np.testing.assert_array_equal(Slide(seed=2, channels=1).sample(np.array([[40.25, -7.5]]))[0, 0], slide_at(slide))
    assert np.abs(Slide(seed=3, channels=1).sample(np.stack([x, y], axis=-1))[..., 0] - image).mean() > 0.05
    colours = Slide(seed=2).sample(np.stack([x, y], axis=-1))
    np.testing.assert_allclose(colours.mean(axis=-1), image, atol=1e-5)


def test_a_slide_that_glows_is_black_where_the_other_is_clear_and_does_not_saturate():
    y, x = np.mgrid[:150, :170].astype(float)
    points = np.stack([x, y], axis=-1)
    bright, dark = (Slide(seed=2, glows=glows).sample(points) for glows in (False, True))
    np.testing.assert_allclose(dark / 0.5 + bright / 0.95, 1, atol=1e-5)
    recording = recorded("fluorescence", cells=20, flash_frames=9, camera=Camera())
    assert recording.truth(range(0, 40, 5)).max() > 0.5
    assert recording.source.recorded(range(0, 40, 5)).max() < 255


def slide_at(slide):
    return slide.sample(np.array([[40.25, -7.5], [900.0, 31.0], [-80.0, 500.0]]))[0, 0]


def test_a_photograph_is_shown_at_its_own_resolution_and_not_beyond_its_edge():
    recording = recorded("cat", frames=40, step=2.0, channels=3)
    x0, _, x1, y1 = recording.bounds
    assert x1 - x0 > SHAPE[1] + 20
    world = recording.world
    assert world.origin[0] + x0 >= 0
    assert world.origin[0] + x1 <= world.image.shape[1]
    assert world.origin[1] + y1 <= world.image.shape[0]
    with pytest.raises(SettingsError, match=r"the path needs .* of the scene, which has 300 x 451; .* 'slide'"):
        recorded("cat", frames=400, step=9.0)
    with pytest.raises(SettingsError, match="too large to be drawn at once"):
        recorded("tissue", frames=100_000, step=9.0)
    with pytest.raises(SettingsError, match=r"the path needs the scene's columns 0 to .*it has 70 x 90"):
        recorded(Scene(np.full((70, 90, 1), 0.5, np.float32)))


def test_drawn_fibres_are_as_dense_on_a_long_path_as_on_a_short_one():
    near, far = (recorded("tissue", frames=frames, step=4.0) for frames in (100, 800))
    assert far.picture(far.bounds).mean() == pytest.approx(near.picture(near.bounds).mean(), rel=0.15)


def test_a_measured_bundle_is_taken():
    flat = simulate(shape=SHAPE, frames=1, pitch=6.0).transmission
    recording = simulate_recording(frames=5, flat=flat)
    assert recording.source.shape == (5, *SHAPE, 1)
    assert np.corrcoef(recording.transmission.ravel(), flat.ravel())[0, 1] > 0.95


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"path": "zigzag"}, "unknown path 'zigzag'; known: raster, spiral, handheld"),
        ({"path": np.tile(np.eye(3), (40, 1, 1)), "turn": 2.0}, "are of named paths"),
        ({"path": np.eye(3)}, r"homographies must have shape \(40, 3, 3\)"),
        ({"physics": "wave"}, "unknown physics 'wave'; known: core, mask, filtered"),
        ({"laps": 0}, "laps must be an integer of at least 1; got 0"),
        ({"cells": 1.5}, "cells must be an integer of at least 0; got 1.5"),
        ({"turn": -1}, "turn must be a number of at least 0; got -1"),
        ({"rate": 0}, "rate must be above 0"),
        ({"gaps": 5, "gap_frames": 9}, "5 gaps of 9 frames .* do not fit into 40 frames"),
        ({"jumps": 30}, "30 jumps do not fit into 40 frames; take at most 19"),
        ({"flicker": 2}, "flicker"),
        ({"pitch": 1.0}, "pitch must be from 2"),
        ({"colour": 1}, "unknown setting 'colour'"),
    ],
)
def test_what_cannot_be_is_refused(wrong, message):
    with pytest.raises(SettingsError, match=message):
        recorded(**wrong)


def test_a_picture_needs_bounds():
    with pytest.raises(SettingsError, match="a picture needs x0 < x1"):
        recorded(frames=2).picture((0, 0, 0, 5))
