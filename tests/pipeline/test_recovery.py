"""The published method recovers motion and scene where the paper says it should.

The networks are narrower and the steps larger than published, so that a fit takes seconds. The bundles are finer than
the encodings can follow: where one can, the method explains the burst by the honeycomb itself.
"""

import numpy as np
import pytest

from napari_fiberburst import Burst, reconstruct
from napari_fiberburst.quality import motion_error, psnr
from napari_fiberburst.simulation import brownian_motion, simulate

SHAPE = (157, 171)
NETWORKS = {
    "scene_width": 64,
    "scene_layers": 3,
    "motion_width": 64,
    "batch": 1024,
    "learning_rate": 5e-4,
    "device": "cpu",
}
# Each encoding up to some 12 cycles across the frame, where the bundle has 78.
COARSE = {
    "fourier": {"sigma": 1.5, "features": 64},
    "nerf": {"highest_octave": 2},
    "siren": {"omega_0": 8.0},
    "hash": {"levels": 5},
}
UNMOVED = np.tile(np.eye(3), (8, 1, 1))


@pytest.fixture(scope="module")
def simulated():
    return simulate("cat", shape=SHAPE, frames=8, pitch=2.2, seed=7)


@pytest.mark.parametrize("encoding", COARSE)
def test_homographies_and_scene_through_a_bundle(simulated, encoding):
    result = reconstruct(
        simulated.burst, preset="paper", encoding=encoding, iterations=600, **COARSE[encoding], **NETWORKS
    )
    unregistered = motion_error(UNMOVED, simulated.homographies, SHAPE)
    assert motion_error(result.homographies, simulated.homographies, SHAPE) < 0.5 * unregistered
    assert_better_than_the_frames(result, simulated)


@pytest.mark.parametrize(
    "motion",
    [
        {"motion": "flow", "flow_omega_0": 5.0},
        # The weight against a loss of narrower networks; the prior makes it slower.
        {"motion": "flow_tv", "tv_weight": 0.05, "iterations": 1000},
    ],
    ids=lambda motion: motion["motion"],
)
def test_optical_flow_and_scene_through_a_bundle(simulated, motion):
    choices = {"iterations": 400, **motion, **COARSE["fourier"], **NETWORKS, "motion_layers": 2}
    result = reconstruct(simulated.burst, preset="paper", **choices)
    assert flow_error(result.flow, simulated.homographies) < 0.6 * flow_error(no_flow, simulated.homographies)
    assert_better_than_the_frames(result, simulated)


@pytest.mark.parametrize("encoding", ["fourier", "siren"])
def test_homographies_without_a_bundle(simulated, encoding):
    burst = Burst(simulated.truth)
    result = reconstruct(burst, preset="paper", encoding=encoding, iterations=500, **COARSE[encoding], **NETWORKS)
    assert motion_error(result.homographies, simulated.homographies, SHAPE) < 1.0


def test_no_motion_memorises_every_frame(simulated):
    choices = {name: value for name, value in NETWORKS.items() if name != "motion_width"}
    result = reconstruct(
        Burst(simulated.truth), preset="paper", motion="none", iterations=300, **COARSE["fourier"], **choices
    )
    for t in (0, 3, 7):
        errors = [np.mean((result.frame(t) - frame) ** 2) for frame in simulated.truth]
        assert np.argmin(errors) == t
    np.testing.assert_array_equal(result.flow(3), 0)


def test_the_order_of_the_other_frames_does_not_matter():
    # Frames move by some pixels: so far the motion network finds its way in any order.
    motion = brownian_motion(8, SHAPE, np.random.default_rng(4), translation=0.012, rotation=0.2, scale=0.002)
    simulated = simulate("cat", shape=SHAPE, frames=8, pitch=2.2, seed=4, motion=motion)
    shuffled = Burst(simulated.burst.frames[[0, 5, 2, 7, 1, 6, 3, 4]])
    scores = []
    for frames in (simulated.burst, shuffled):
        first = reconstruct(frames, preset="paper", encoding="siren", iterations=600, **COARSE["siren"], **NETWORKS)
        settled = reconstruct(frames, initial=first, iterations=200, learning_rate=1e-4)
        scores.append(psnr(settled.image, simulated.truth[0]))
    assert scores[1] == pytest.approx(scores[0], abs=0.5)
    assert min(scores) > psnr(simulated.burst.frames.mean(axis=0), simulated.truth[0]) + 3


def assert_better_than_the_frames(result, simulated):
    """Far better than the captured frame and than the mean of the frames as they lie."""
    truth, frames = simulated.truth[0], simulated.burst.frames
    assert psnr(result.image, truth) > max(psnr(frames[0], truth), psnr(frames.mean(axis=0), truth)) + 3


def flow_error(flow, homographies):
    """Median distance in pixels between a flow and that of the true homographies."""
    height, width = SHAPE
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    distances = []
    for t, matrix in enumerate(homographies):
        mapped = pixels @ matrix.T
        truth = mapped[..., :2] / mapped[..., 2:] - pixels[..., :2]
        distances.append(np.hypot(*np.moveaxis(flow(t) - truth, -1, 0)))
    return np.nanmedian(distances)


def no_flow(t):
    return np.zeros((*SHAPE, 2))
