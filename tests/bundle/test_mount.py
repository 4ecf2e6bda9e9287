"""A bundle that moves on the camera: it is followed where it moves, and left alone where it rests."""

import numpy as np
import pytest
import torch

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.bundle.mount import Mount, find_mount
from napari_fiberburst.bundle.samples import sample_cores
from napari_fiberburst.simulation import Camera, Faults, simulate

SHAPE = (139, 121)


def grey(simulated):
    return torch.from_numpy(simulated.burst.frames).mean(dim=3)


def steps(count, x, y):
    """Return homographies of an object that goes on by (x, y) pixels from each frame to the next."""
    found = np.tile(np.eye(3), (count, 1, 1))
    found[:, :2, 2] = np.outer(np.arange(count), (x, y))
    return found


@pytest.mark.parametrize("scene", ["histology", "tissue", "usaf"])
@pytest.mark.parametrize(("pitch", "physics"), [(3.0, "mask"), (4.7, "core"), (6.0, "mask"), (8.0, "core")])
@pytest.mark.parametrize("pixels", [0.5, 2.0])
def test_a_bundle_that_moves_is_followed_to_a_tenth_of_a_pixel(scene, pitch, physics, pixels):
    faults = Faults(bundle_shift=pixels)
    simulated = simulate(scene, shape=SHAPE, frames=9, pitch=pitch, physics=physics, seed=5, faults=faults)
    mount = find_mount(grey(simulated))
    assert mount is not None
    np.testing.assert_allclose(mount.offsets, simulated.bundle_offsets, atol=0.1)
    assert "the bundle moves on the camera" in mount.note


@pytest.mark.parametrize("scene", ["histology", "retina", "cat", "usaf", "tissue"])
@pytest.mark.parametrize(("pitch", "physics"), [(3.0, "core"), (4.7, "mask"), (8.0, "mask"), (8.0, "core")])
def test_in_a_bundle_that_rests_nothing_is_found(scene, pitch, physics):
    simulated = simulate(scene, shape=SHAPE, frames=9, pitch=pitch, physics=physics, seed=5)
    assert find_mount(grey(simulated)) is None


@pytest.mark.parametrize(
    "choices",
    [
        {"motion": steps(9, 0.4, 0.2)},
        {"motion": steps(9, 8.0, 5.0)},
        {"motion": steps(2, 1.3, 0.7), "frames": 2},
        {"faults": Faults(flicker=0.2, background=0.3, black_frames=1, white_frames=1)},
        {"faults": Faults(deformation=3, smear=0.3, intruder=0.1, field=0.9, overlay=True)},
        {"faults": Faults(contrast=0.1)},
        {"camera": Camera(photons=200)},
    ],
    ids=["slow", "fast", "two frames", "flicker", "bends", "faint", "noise"],
)
@pytest.mark.parametrize("scene", ["tissue", "usaf"])
def test_what_the_object_and_the_camera_do_is_not_taken_for_the_bundle(scene, choices):
    simulated = simulate(scene, shape=SHAPE, pitch=8.0, seed=5, **{"frames": 9, **choices})
    assert find_mount(grey(simulated)) is None


def test_plain_images_have_no_bundle_to_follow():
    assert find_mount(torch.from_numpy(simulate("cat", shape=SHAPE, frames=5).truth).mean(dim=3)) is None


def test_frames_that_show_nothing_leave_the_bundle_where_it_was():
    simulated = simulate("cat", shape=SHAPE, frames=9, pitch=5.0, seed=5, faults=Faults(bundle_shift=1.5))
    frames = grey(simulated)
    frames[[0, 6]] = 0
    frames[3] = torch.rand(SHAPE, generator=torch.Generator().manual_seed(0))
    mount = find_mount(frames)
    assert mount is not None
    np.testing.assert_allclose(mount.offsets, simulated.bundle_offsets, atol=0.1)


def test_steadied_frames_show_what_the_bundle_at_rest_would():
    rng = np.random.default_rng(1)
    frames = torch.from_numpy(rng.random((2, 23, 31, 3)).astype(np.float32))
    moved = torch.stack([frames[0], frames[1].roll((2, -1), (0, 1))])
    steadied = Mount(np.array([[0.0, 0.0], [-1.0, 2.0]])).steadied(moved)
    torch.testing.assert_close(steadied[:, :-2, 1:], frames[:, :-2, 1:], atol=1e-5, rtol=0)


def test_offsets_can_be_told_from_another_frame():
    mount = Mount(np.array([[0.0, 0.0], [1.0, -0.5], [1.0, -0.5]])).relative_to(1)
    np.testing.assert_allclose(mount.offsets, [[-1, 0.5], [0, 0], [0, 0]])


def test_samples_beyond_the_recorded_frame_count_for_nothing():
    simulated = simulate("cat", shape=SHAPE, frames=3, pitch=6.0, seed=5)
    bundle = Bundle.from_image(simulated.transmission)
    samples = sample_cores(torch.from_numpy(simulated.burst.frames), bundle, simulated.burst)
    seen = Mount(np.array([[0.0, 0.0], [3.0, 0.0], [0.0, -2.0]])).seen(samples)
    x, y = samples.positions.T
    margin = bundle.radius - 0.5
    torch.testing.assert_close(seen.weights[0], samples.weights[0])
    torch.testing.assert_close(seen.weights[1], samples.weights[1] * (x + 3 < SHAPE[1] - 1 - margin))
    torch.testing.assert_close(seen.weights[2], samples.weights[2] * (y - 2 > margin))


def test_frames_that_moved_by_whole_pixels_are_as_recorded():
    offsets = np.array([[0, 0], [0.02, -0.01], [1, 2.01], [0.5, 0], [-1, 0], [0, 0.3]])
    assert Mount(offsets).exact.tolist() == [True, True, True, False, True, False]
    assert Mount(offsets[2:]).exact.all()


def test_frames_whose_bundles_lie_close_have_it_in_one_place():
    offsets = np.array([[0.0, 0.0], [0.04, -0.03], [0.5, 0.0], [0.02, 0.05], [0.46, 0.03], [0.5, 1.0]])
    places = Mount(offsets).places
    assert (places[[1, 3]] == places[0]).all()
    assert places[4] == places[2]
    assert len({places[0], places[2], places[5]}) == 3
    # A bundle that drifts is not in one place for all its frames being near the next.
    assert len(set(Mount(np.linspace(0, 1, 21)[:, None] * [1.0, 0.0]).places)) >= 5
