"""A burst whose bundle moves on the camera gives the image that it would give with the bundle at rest."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from napari_fiberburst import Burst, load, reconstruct
from napari_fiberburst.quality import motion_error, psnr
from napari_fiberburst.simulation import Faults, simulate

SHAPE = (127, 141)


@pytest.fixture(scope="module")
def shifted():
    """Return the burst `cores` with a bundle that moves by two pixels halfway."""
    faults = Faults(bundle_shift=2.0)
    return simulate("histology", shape=SHAPE, frames=12, pitch=6.0, physics="core", seed=3, faults=faults)


@pytest.fixture(scope="module")
def followed(shifted):
    return reconstruct(shifted.burst, fill=True)


def test_a_bundle_that_moves_costs_little(shifted, followed, cores, fitted):
    # Frames that are moved back are interpolated, which takes some of their finest detail.
    assert psnr(followed.image, shifted.truth[0]) > psnr(fitted.image, cores.truth[0]) - 0.9
    assert any("the bundle moves on the camera" in note for note in followed.notes)
    assert not any("the bundle moves on the camera" in note for note in fitted.notes)


def test_motion_is_that_of_the_frames_as_recorded(shifted, followed):
    assert motion_error(followed.homographies, shifted.homographies, SHAPE) < 0.1
    # As a frame sees it, the scene is where that frame has recorded it.
    inside = (slice(8, -8), slice(8, -8))
    there = followed.frame(11)
    seen = np.isfinite(there).all(axis=-1)[inside]
    assert seen.mean() > 0.5
    assert psnr(there[inside][seen][None], shifted.truth[11][inside][seen][None]) > 26


def test_a_saved_result_keeps_it(followed, tmp_path):
    again = load(followed.save(tmp_path / "moved.npz"))
    np.testing.assert_allclose(again.homographies, followed.homographies)
    np.testing.assert_allclose(again.image, followed.image, atol=1e-3)


def test_two_steps_are_followed_too():
    offset = np.zeros((12, 2))
    offset[4:8], offset[8:] = (1.0, 0.0), (2.0, -1.0)
    still = simulate("histology", shape=(141, 151), frames=12, pitch=5.0, physics="core", seed=3)
    # What the camera sees through a window that moves, which is the same as a mount that does.
    frames = still.arrays()["frames"]
    windows = [
        frame[4 - y : 131 - y, 4 - x : 145 - x] for frame, (x, y) in zip(frames, offset.astype(int), strict=True)
    ]
    result = reconstruct(Burst(np.stack(windows), axes="TYXC", black_level=0, white_level=255), fill=True)
    resting = reconstruct(still.burst.crop((4, 131), (4, 145)), fill=True)
    truth = still.truth[0, 4:131, 4:145]
    assert psnr(result.image, truth) > psnr(resting.image, truth) - 0.9
    np.testing.assert_allclose(result.homographies[:, :2, 2] - resting.homographies[:, :2, 2], -offset, atol=0.3)


def test_a_known_bundle_is_followed(shifted, fitted):
    result = reconstruct(shifted.burst, bundle=fitted.bundle, fill=True)
    assert any("the bundle moves on the camera" in note for note in result.notes)
    assert psnr(result.image, shifted.truth[0]) > psnr(fitted.image, shifted.truth[0]) - 0.7


def test_where_frame_0_is_bad_the_bundle_rests_where_the_reference_has_it(shifted):
    order = [0, *range(6, 12), *range(1, 6)]
    frames = shifted.arrays()["frames"][order]
    # Every core sees another light, so that the frame shows the bundle and cannot be registered.
    y, x = np.indices(SHAPE)
    nearest = cKDTree(shifted.bundle.centres).query(np.stack([x, y], axis=-1))[1]
    light = np.random.default_rng(0).uniform(20, 255, len(shifted.bundle.centres))
    frames[0] = np.rint(shifted.flat * light[nearest][..., None])
    result = reconstruct(Burst(frames, axes="TYXC", black_level=0, white_level=255), fill=True)
    assert result.reference == 1
    relative = np.linalg.inv(shifted.homographies[6]) @ shifted.homographies[order]
    assert motion_error(result.homographies[1:], relative[1:], SHAPE) < 0.15
    assert psnr(result.image, shifted.truth[6]) > 26


def test_networks_learn_the_motion_of_the_frames_as_recorded(shifted):
    small = {"scene_width": 16, "scene_layers": 1, "levels": 8, "batch": 256}
    result = reconstruct(shifted.burst, encoding="hash", iterations=60, device="cpu", **small)
    assert motion_error(result.homographies, shifted.homographies, SHAPE) < 0.2


def test_what_interpolation_does_is_not_taken_for_the_noise_of_the_camera():
    quiet = {"shape": SHAPE, "frames": 12, "pitch": 4.0, "physics": "core", "seed": 3}
    rests = reconstruct(simulate("histology", **quiet).burst)
    moves = reconstruct(simulate("histology", faults=Faults(bundle_shift=0.5), **quiet).burst)
    # It is 0.77 times that at rest, and 0.15 times where the noise is measured in frames that were interpolated.
    assert moves.misfit > 0.7 * rests.misfit


@pytest.mark.parametrize("pitch", [3.5, 4.7])
def test_half_a_pixel_between_sharp_cores_costs_little(pitch):
    sharp = {"shape": (141, 157), "frames": 16, "pitch": pitch, "physics": "core", "seed": 0}
    rests = simulate("histology", **sharp)
    moves = simulate("histology", faults=Faults(bundle_shift=0.5), **sharp)
    images = [reconstruct(simulated.burst, fill=True).image for simulated in (rests, moves)]
    resting, moving = (psnr(image, rests.truth[0]) for image in images)
    assert moving > resting - 1
