"""How much freedom the motion of frames needs."""

from functools import cache

import numpy as np
import pytest

from napari_fiberburst import reconstruct
from napari_fiberburst.quality import motion_error, psnr
from napari_fiberburst.simulation import simulate

SHAPE = (151, 173)


def motion_like(kind: str, frames: int = 14) -> np.ndarray:
    """Return homographies (T, 3, 3), frame-t pixel to frame-0 pixel, about the middle of the frame."""
    rng = np.random.default_rng(4)
    middle = np.array([[1, 0, SHAPE[1] / 2], [0, 1, SHAPE[0] / 2], [0, 0, 1]])
    matrices = np.tile(np.eye(3), (frames, 1, 1))
    for matrix in matrices[1:]:
        if kind != "translation":
            turn, scale = rng.normal(0, 0.02), 1 + rng.normal(0, 0.01)
            matrix[:2, :2] = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        if kind in ("affine", "homography"):
            matrix[:2, :2] += rng.normal(0, 0.015, (2, 2))
        if kind == "homography":
            matrix[2, :2] = rng.normal(0, 1.5e-4, 2)
        matrix[:2, 2] = rng.normal(0, 5, 2)
    return middle @ matrices @ np.linalg.inv(middle)


@cache
def registered(kind):
    """Return a burst whose frames move in such a way, and its reconstruction."""
    simulated = simulate(
        "histology", shape=SHAPE, frames=14, channels=1, motion=motion_like(kind), pitch=4.7, physics="core", seed=2
    )
    return simulated, reconstruct(simulated.burst, device="cpu")


@pytest.mark.parametrize("kind", ["translation", "similarity", "affine", "homography"])
def test_a_burst_is_registered_with_the_freedom_that_its_frames_have(kind):
    simulated, result = registered(kind)
    assert result.settings.method.motion.name == kind
    assert motion_error(result.homographies, simulated.homographies, SHAPE) < 0.15


def test_frames_of_a_smaller_model_are_members_of_it():
    simulated = simulate(
        "cat", shape=SHAPE, frames=14, motion=motion_like("translation"), pitch=4.7, physics="core", seed=1
    )
    result = reconstruct(simulated.burst, device="cpu")
    np.testing.assert_allclose(result.homographies[:, :2, :2], np.tile(np.eye(2), (14, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(result.homographies[:, 2], np.tile([0, 0, 1.0], (14, 1)), atol=1e-9)


def test_less_freedom_costs_no_quality():
    simulated, chosen = registered("translation")
    free = reconstruct(simulated.burst, motion="homography", device="cpu")
    assert chosen.settings.method.motion.name == "translation"
    truth = simulated.truth[0, ..., 0]
    assert psnr(chosen.image[None], truth[None]) > psnr(free.image[None], truth[None]) - 0.05


@pytest.mark.parametrize("seed", [0, 3])
def test_a_coarse_bundle_does_not_bend_the_frames_of_a_rigid_object(seed):
    simulated = simulate("tissue", shape=(224, 224), frames=20, pitch=12.0, physics="core", seed=seed)
    result = reconstruct(simulated.burst, device="cpu")
    assert not result.bends
    assert motion_error(result.homographies, simulated.homographies, (224, 224)) < 0.5
