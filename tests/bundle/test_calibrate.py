"""The bundle is found from the burst alone, against bundles that the simulator knows."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from napari_fiberburst import Burst, reconstruct
from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.calibrate import calibrate
from napari_fiberburst.bundle.pitch import find_pitch
from napari_fiberburst.bundle.samples import sample
from napari_fiberburst.operators.filters import blur
from napari_fiberburst.quality import psnr
from napari_fiberburst.simulation import Camera, simulate
from napari_fiberburst.simulation.bundle import Bundle as SimulatedBundle


def grey(simulated):
    return torch.from_numpy(simulated.burst.frames).mean(dim=3)


def in_full_scale(burst):
    """Return the black level that calibration finds, full scale 1."""
    return (calibrate(burst).black - burst.black_level) / (burst.white_level - burst.black_level)


@pytest.mark.parametrize("pitch", [3.0, 4.3, 7.0, 12.0, 20.0])
@pytest.mark.parametrize("physics", ["mask", "core"])
def test_the_pitch_is_found(pitch, physics):
    side = max(120, int(17 * pitch))
    simulated = simulate("histology", shape=(side, side + 11), frames=6, pitch=pitch, physics=physics, seed=int(pitch))
    assert find_pitch(grey(simulated).mean(dim=0)) == pytest.approx(pitch, rel=0.05)


def test_the_pitch_of_a_bundle_of_many_grains_is_found():
    """Grains turned at random draw a ring into the spectrum, not six peaks."""
    rng = np.random.default_rng(0)
    shape, pitch = (240, 260), 5.3
    middles = rng.uniform(0, 260, (14, 2))
    centres = []
    for number, angle in enumerate(rng.uniform(0, np.pi / 3, 14)):
        row, column = np.mgrid[-70:70, -70:70].reshape(2, -1)
        lattice = pitch * np.stack([column + 0.5 * (row % 2), row * 3**0.5 / 2], axis=1)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        points = lattice @ turn.T + middles[number]
        nearest = cKDTree(middles).query(points)[1]
        inside = (points > 2).all(axis=1) & (points < [257, 237]).all(axis=1)
        centres.append(points[(nearest == number) & inside])
    centres = np.concatenate(centres)
    bundle = SimulatedBundle(
        centres=centres,
        radii=np.full(len(centres), 0.36 * pitch),
        gains=rng.uniform(0.5, 1, len(centres)),
        pitch=pitch,
        crosstalk=0.0,
    )
    image = torch.from_numpy(bundle.transmission(shape)).float()
    assert find_pitch(image) == pytest.approx(pitch, rel=0.03)


@pytest.mark.parametrize("scene", ["histology", "retina", "usaf", "tissue", "cat"])
def test_a_plain_image_has_no_pitch(scene, rng):
    truth = simulate(scene, shape=(150, 131), frames=3).truth.mean(axis=(0, 3))
    noisy = torch.from_numpy(truth + rng.normal(0, 0.01, truth.shape)).float()
    assert find_pitch(noisy) is None


@pytest.mark.parametrize(("scene", "pitch"), [("histology", 7.0), ("cat", 4.0), ("tissue", 10.0)])
def test_cores_and_transmission_are_found(scene, pitch):
    simulated = simulate(scene, shape=(199, 231), pitch=pitch, physics="core", seed=1)
    found = calibrate(simulated.burst)
    centres = simulated.bundle.centres
    distance, _ = cKDTree(found.centres).query(centres)
    assert (distance < 0.3 * pitch).mean() > 0.97
    assert abs(len(found.centres) / len(centres) - 1) < 0.03
    lit = found.transmission > 0
    assert np.corrcoef(found.transmission[lit], simulated.transmission[lit])[0, 1] > 0.85
    assert found.radius == pytest.approx(0.36 * pitch, rel=0.12)


def test_a_bundle_that_fills_a_circle_has_no_cores_outside():
    simulated = simulate("cat", shape=(180, 220), pitch=6.0, physics="core", outline="circle")
    found = calibrate(simulated.burst)
    outside = np.hypot(*(found.centres - [109.5, 89.5]).T) > 90
    assert not outside.any()
    assert len(found.centres) == pytest.approx(len(simulated.bundle.centres), rel=0.02)


def test_dead_cores_are_found_as_gaps():
    simulated = simulate("cat", shape=(180, 220), pitch=7.0, physics="core", dead_cores=0.04, jitter=0.04)
    found = calibrate(simulated.burst)
    dead = simulated.bundle.centres[simulated.bundle.gains == 0]
    inside = (dead > 8).all(axis=1) & (dead < [211, 171]).all(axis=1)
    distance, _ = cKDTree(found.dead).query(dead[inside])
    assert (distance < 0.5 * 7).mean() > 0.8
    assert len(found.dead) < 1.3 * len(dead)


def test_a_pedestal_is_taken_off():
    camera = Camera(bits=16, pedestal=0.07)
    simulated = simulate("histology", shape=(150, 140), pitch=7.0, camera=camera)
    plain = simulate("histology", shape=(150, 140), pitch=7.0, camera=Camera(bits=16))
    assert in_full_scale(simulated.burst) == pytest.approx(0.07, abs=0.01)
    assert in_full_scale(plain.burst) == pytest.approx(0, abs=0.01)


def test_one_value_a_core_is_the_light_it_gathers():
    simulated = simulate("cat", shape=(150, 140), pitch=8.0, physics="core", frames=3, crosstalk=0.0, channels=1)
    samples = sample(simulated.burst, Bundle.from_image(simulated.transmission))
    smooth = blur(torch.from_numpy(simulated.truth[..., 0]), 0.36 * 8 / 2)
    place = samples.positions.round().long().clamp(min=0)
    inner = (place > 6).all(dim=1) & (place < torch.tensor([133, 143])).all(dim=1)
    expected = smooth[:, place[inner, 1], place[inner, 0]]
    assert np.corrcoef(samples.values[:, inner, 0].ravel(), expected.ravel())[0, 1] > 0.99


def test_saturated_pixels_are_left_out():
    simulated = simulate("histology", shape=(120, 110), pitch=7.0, frames=3)
    bundle = calibrate(simulated.burst)
    frames = simulated.burst.frames.copy()
    frames[1] = 1.0
    spoiled = Burst(frames, black_level=0, white_level=1)
    scaled = replace(bundle, black=bundle.black / simulated.burst.white_level)
    assert not sample(spoiled, scaled, "cores").weights[1].any()
    assert not sample(spoiled, scaled, "pixels").weights[1].any()
    assert sample(spoiled, scaled, "pixels").weights[0].any()


def test_black_and_white_frames_leave_no_trace_in_the_calibration():
    simulated = simulate("histology", shape=(120, 131), frames=6, pitch=7.0, physics="core", channels=1)
    frames = simulated.arrays()["frames"].reshape(6, 120, 131)
    y, x = np.indices((120, 131))
    # Over-exposed in four frames out of six, which is most of them; with three black ones more, four out of nine.
    frames[:4, np.hypot(x - 60, y - 60) < 15] = 255
    spoiled = np.concatenate([frames, np.zeros_like(frames[:3]), np.full_like(frames[:1], 255)])
    alone, among = (calibrate(Burst(part, black_level=0, white_level=255)) for part in (frames, spoiled))
    assert alone.saturated.sum() > 5
    for name in ("centres", "labels", "transmission", "saturated", "outline"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(among, name))


@pytest.mark.parametrize("kind", ["cores", "pixels"])
def test_frames_that_show_nothing_have_no_samples(kind):
    simulated = simulate("histology", shape=(120, 110), pitch=7.0, frames=5)
    frames = simulated.burst.frames.copy()
    frames[1], frames[3] = 0, 1
    weights = sample(Burst(frames, black_level=0, white_level=1), calibrate(simulated.burst), kind).weights
    assert (weights > 0).any(dim=1).tolist() == [True, False, True, False, True]


def test_a_black_and_a_white_frame_cost_nothing():
    """The frames that are left must give what they would have given without those two."""
    simulated = simulate("cat", shape=(151, 163), frames=20, pitch=6.0, physics="core", seed=1)
    frames = simulated.arrays()["frames"]
    spoiled = frames.copy()
    spoiled[5], spoiled[12] = 0, 255
    kept = np.delete(frames, [5, 12], axis=0)
    without, among = (
        psnr(reconstruct(Burst(part, black_level=0, white_level=255), fill=True).image, simulated.truth[0])
        for part in (kept, spoiled)
    )
    assert among > without - 0.1
