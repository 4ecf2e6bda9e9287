"""Frames move along the generators of their model, and nowhere else."""

import numpy as np
import pytest
import torch

from napari_fiberburst.motion.models import DEGREES_OF_FREEDOM, FrameMotion


@pytest.mark.parametrize("model", DEGREES_OF_FREEDOM)
def test_the_tangent_is_how_points_move(model):
    freedom = DEGREES_OF_FREEDOM[model]
    points = torch.rand(30, 2) * torch.tensor([37.0, 31.0])
    for generator in range(freedom):
        motion = FrameMotion(1, (31, 37))
        step = torch.zeros(1, freedom)
        step[0, generator] = 1e-3
        along_x, along_y = motion.tangent(points, freedom)
        motion.move(step)
        moved = (motion.apply(points)[0] - points) / 1e-3
        expected = torch.stack([along_x[:, generator], along_y[:, generator]], dim=1)
        torch.testing.assert_close(moved, expected, rtol=0.02, atol=0.05)


def test_a_similarity_keeps_angles_and_an_affine_parallels():
    motion = FrameMotion(2, (31, 37))
    motion.move(torch.tensor([[0.1, -0.2, 0.3, 0.1], [0, 0, 0, 0]]))
    linear = motion.scene_from_frame[0, :2, :2].numpy()
    np.testing.assert_allclose(linear.T @ linear, np.eye(2) * (linear.T @ linear)[0, 0], atol=1e-9)
    motion = FrameMotion(1, (31, 37))
    motion.move(torch.tensor([[0.1, -0.2, 0.3, 0.1, 0.2, -0.1]]))
    np.testing.assert_allclose(motion.scene_from_frame[0, 2], [0, 0, 1], atol=1e-9)


def test_motion_is_relative_to_the_frame_asked_for():
    motion = FrameMotion(3, (31, 37))
    motion.shift(np.array([[1.0, 2.0], [4.0, 6.0], [0.0, 0.0]]))
    relative = motion.relative_to(1)
    np.testing.assert_allclose(relative[1], np.eye(3))
    np.testing.assert_allclose(relative[0, :2, 2], [-3, -4])
