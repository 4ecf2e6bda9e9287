"""Registration by scattered samples, against motion that the test makes itself."""

import numpy as np
import pytest
import torch

from napari_fiberburst.coordinates import relative_to, transform_points
from napari_fiberburst.motion.coarse import confidence, find_shifts
from napari_fiberburst.motion.joint import COARSE, FINER, Groupwise
from napari_fiberburst.motion.models import FrameMotion

SHAPE = (120, 140)
PITCH = 5.0


def scene(points):
    x, y = points[..., 0], points[..., 1]
    return 1 + 0.3 * torch.sin(x / 7 + 0.3 * y / 5) + 0.3 * torch.cos(y / 8 - x / 23) + 0.2 * torch.sin((x + y) / 17)


@pytest.fixture
def sensors():
    generator = torch.Generator().manual_seed(1)
    return torch.rand(900, 2, generator=generator) * torch.tensor([139.0, 119.0])


def matrices(angle=0.02, shift=9.0):
    """Return five rigid motions about the frame's middle."""
    found = []
    for number in range(5):
        turn = angle * number
        cosine, sine = np.cos(turn), np.sin(turn)
        centre = np.array([69.5, 59.5])
        linear = np.array([[cosine, -sine], [sine, cosine]])
        offset = centre - linear @ centre + shift * np.array([np.sin(number), 1 - np.cos(number)])
        found.append(np.vstack([np.column_stack([linear, offset]), [0, 0, 1]]))
    return np.array(found)


def look(sensors, homographies):
    motion = FrameMotion(len(homographies), SHAPE)
    motion.scene_from_frame = torch.from_numpy(homographies)
    return scene(motion.apply(sensors))


def error(motion, truth):
    corners = np.array([[0.0, 0], [139, 0], [0, 119], [139, 119]])
    found = relative_to(motion.scene_from_frame.numpy(), 0)
    return np.abs(transform_points(found, corners) - transform_points(truth, corners)).max()


def test_shifts_are_found_to_within_a_pitch(sensors):
    truth = matrices(angle=0.0)
    values = look(sensors, truth)
    found = find_shifts(sensors, values, torch.ones_like(values), SHAPE, PITCH)
    assert found.connected.all()
    np.testing.assert_allclose(found.shifts - found.shifts[0], truth[:, :2, 2], atol=PITCH)


@pytest.mark.parametrize("gains", [False, True])
def test_groupwise_finds_rotation_and_gains(sensors, gains):
    truth = matrices()
    spread = 1 + 0.15 * torch.randn(900, generator=torch.Generator().manual_seed(2)) if gains else torch.ones(900)
    values = look(sensors, truth) * spread
    motion = FrameMotion(5, SHAPE)
    motion.shift(find_shifts(sensors, values, torch.ones_like(values), SHAPE, PITCH).shifts)
    group = Groupwise(sensors, values, torch.ones_like(values), motion, PITCH, freedom=8)
    for level in (COARSE, *FINER):
        group.enter(level)
        for number in range(level.rounds):
            group.round(level, number)
        group.settle()
    assert error(motion, truth) < 0.3
    seen_often = torch.from_numpy((np.abs(sensors.numpy() - [69.5, 59.5]) < [45, 38]).all(axis=1))
    left = (group.gains / spread)[seen_often]
    assert float(left.std() / left.mean()) < 0.02


def test_confidence_tells_the_frame_that_shows_something_else(sensors):
    truth = matrices(angle=0.0)
    values = look(sensors, truth)
    values[3] = torch.rand(900, generator=torch.Generator().manual_seed(3))
    motion = FrameMotion(5, SHAPE)
    motion.scene_from_frame = torch.from_numpy(truth)
    found = confidence(sensors, values, torch.ones_like(values), motion, PITCH)
    assert found[3] < 0.3
    assert np.delete(found, 3).min() > 0.9
