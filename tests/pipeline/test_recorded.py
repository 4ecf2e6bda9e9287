"""Bursts as they are recorded: what bends, flickers and passes by is followed, and the verdict is true."""

import numpy as np
import pytest

from napari_fiberburst import Burst, load, reconstruct
from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.quality import motion_error, psnr
from napari_fiberburst.settings import Deformable, Homography
from napari_fiberburst.simulation import Camera, Faults, simulate

SHAPE = (157, 171)


def recorded(scene="histology", frames=14, **faults):
    return simulate(
        scene,
        shape=SHAPE,
        frames=frames,
        channels=1,
        physics="core",
        pitch=4.7,
        seed=1,
        camera=Camera(photons=8000, bits=10, exposure=0.8),
        faults=Faults(**faults),
    )


def quality(result, simulated):
    truth = simulated.truth[0]
    visible = np.ones(SHAPE, bool) if simulated.visible is None else simulated.visible
    image = np.nan_to_num(result.image, nan=float(np.nanmean(result.image)))[..., None]
    return psnr(image[visible][None], truth[visible][None])


@pytest.fixture(scope="module")
def clean():
    simulated = recorded()
    result = reconstruct(simulated.burst)
    return simulated, result, quality(result, simulated)


def test_a_clean_burst_is_good_and_rigid(clean):
    _, result, _ = clean
    assert result.quality == "good"
    assert not result.notes
    assert result.settings.method.motion == Homography()
    assert not result.bends
    assert result.exposures.std() < 1e-3
    assert not result.outliers.any()
    assert 1 < result.misfit < 4


@pytest.mark.parametrize("flicker", [0.05, 0.2])
def test_flicker_is_taken_out(clean, flicker):
    simulated = recorded(flicker=flicker)
    result = reconstruct(simulated.burst)
    np.testing.assert_allclose(result.exposures, simulated.exposures, rtol=0.01)
    # In so small a field, cores' gains tell the slope of the light to a per cent only.
    assert quality(result, simulated) > clean[2] - 1.5
    assert result.quality == "good"


@pytest.mark.parametrize("deformation", [1.0, 4.0])
def test_what_bends_is_followed(clean, deformation, tmp_path):
    simulated = recorded(deformation=deformation)
    result = reconstruct(simulated.burst)
    assert result.settings.method.motion == Deformable()
    assert result.bends
    assert quality(result, simulated) > clean[2] - 0.8
    y, x = np.mgrid[12 : SHAPE[0] - 12 : 9, 12 : SHAPE[1] - 12 : 9]
    places = np.stack([x, y], axis=-1)
    errors = []
    for frame in range(1, 14):
        points = np.concatenate([places, np.ones((*x.shape, 1))], axis=-1) @ simulated.homographies[frame].T
        there = points[..., :2] / points[..., 2:] + simulated.displacement[frame][y, x]
        inside = ((there > 8) & (there < np.array(SHAPE[::-1]) - 8)).all(axis=-1)
        errors.append(np.hypot(*(places + result.flow(frame)[y, x] - there)[inside].T))
    assert np.median(np.concatenate(errors)) < 0.25
    assert np.abs(result.flow(0)).max() < 0.02
    # The displacement is what the homographies do not do.
    np.testing.assert_allclose(result.displacement(0), 0, atol=0.02)
    again = load(result.save(tmp_path / "scene.npz"))
    np.testing.assert_allclose(again.flow(3), result.flow(3), atol=1e-3)
    np.testing.assert_allclose(again.frame(3), result.frame(3), atol=0.5)


def test_motion_that_is_asked_for_is_not_replaced():
    simulated = recorded(deformation=4.0)
    result = reconstruct(simulated.burst, motion="homography")
    assert result.settings.method.motion == Homography()
    assert result.quality in ("doubtful", "bad")
    assert any("left out are missed" in note for note in result.notes)


@pytest.mark.parametrize("scene", ["histology", "tissue"])
def test_what_passes_before_the_object_leaves_no_trace(clean, scene):
    free, simulated = recorded(scene), recorded(scene, intruder=0.05)
    best = clean[2] if scene == "histology" else quality(reconstruct(free.burst), free)
    result = reconstruct(simulated.burst)
    assert quality(result, simulated) > best - 1.7  # some of its frames are left out
    centres = result.bundle.centres.round().astype(int)
    hidden = simulated.intruder[:, centres[:, 1].clip(0, SHAPE[0] - 1), centres[:, 0].clip(0, SHAPE[1] - 1)] > 0.6
    used = np.zeros(len(hidden), bool)
    used[list(result.frames_used)] = True
    if hidden[used].any():
        assert result.outliers[used][hidden[used]].mean() > 0.8
    assert result.outliers[used][~hidden[used]].mean() < 0.06


def test_a_slow_object_is_registered_from_the_better_of_two_starts():
    steps = np.cumsum(np.random.default_rng(4).normal(size=(14, 2)), axis=0)
    matrices = np.tile(np.eye(3), (14, 1, 1))
    matrices[:, :2, 2] = steps - steps[0]
    simulated = simulate(
        "tissue", shape=SHAPE, frames=14, channels=1, physics="core", pitch=4.7, motion=matrices, seed=1
    )
    result = reconstruct(simulated.burst)
    assert motion_error(result.homographies, simulated.homographies, SHAPE) < 0.3


def altered(change):
    frames = recorded().arrays()["frames"][..., 0].copy()
    return Burst(change(frames), axes="TYX", black_level=0, white_level=1023)


def with_another_object(frames):
    frames[7:] = recorded("cat").arrays()["frames"][7:, ..., 0]
    return frames


def with_one_frame_mirrored(frames):
    frames[5] = frames[5, :, ::-1]
    return frames


def with_frames_alike(frames):
    return np.repeat(frames[:1], len(frames), axis=0)


def with_dark_frames(frames):
    frames[3:6] = 0
    return frames


def with_three_cores(frames):
    mask = np.zeros(frames.shape[1:], bool)
    mask[70:78, 80:92] = True
    return frames * mask


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (with_another_object, {"doubtful", "bad"}),
        (with_frames_alike, {"doubtful", "bad"}),
        (with_three_cores, {"doubtful", "bad"}),
        (with_one_frame_mirrored, {"good"}),
        (with_dark_frames, {"good"}),
    ],
)
def test_a_burst_that_is_not_one_gets_a_true_verdict_or_an_error(change, said):
    burst = altered(change)
    try:
        result = reconstruct(burst)
    except FiberBurstError:
        assert "good" not in said
        return
    assert result.quality in said
    if change in (with_one_frame_mirrored, with_dark_frames):
        assert any("left out" in note for note in result.notes)


def test_a_deformation_that_folds_is_not_called_good():
    simulated = recorded(deformation=9.0, deformation_length=12.0)
    result = reconstruct(simulated.burst)
    assert quality(result, simulated) > 20 or result.quality != "good"
    assert result.quality != "good"
