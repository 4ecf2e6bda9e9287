"""Registration by scattered samples, against motion that the test makes itself."""

import numpy as np
import torch

from napari_fiberburst.motion.coarse import confidence, find_shifts
from napari_fiberburst.motion.models import FrameMotion

SHAPE = (120, 140)
PITCH = 5.0


def test_shifts_are_found_to_within_a_pitch(positions, matrices, look):
    truth = matrices(angle=0.0)
    values = look(positions, truth)
    found = find_shifts(positions, values, torch.ones_like(values), SHAPE, PITCH)
    assert found.connected.all()
    np.testing.assert_allclose(found.shifts - found.shifts[0], truth[:, :2, 2], atol=PITCH)


def test_shifts_do_not_drift_along_many_frames(look):
    """A chain of pairs that are off by a pixel each would be off by many at its end."""
    generator = torch.Generator().manual_seed(4)
    steps = torch.randn(120, 2, generator=generator).double()
    truth = np.tile(np.eye(3), (120, 1, 1))
    truth[:, :2, 2] = 20 * np.sin(np.cumsum(steps.numpy(), axis=0) / 20) + np.linspace(0, 40, 120)[:, None]
    positions = torch.rand(900, 2, generator=generator) * torch.tensor([139.0, 119.0])
    values = look(positions, truth)
    found = find_shifts(positions, values, torch.ones_like(values), SHAPE, PITCH)
    assert found.connected.all()
    missed = found.shifts - found.shifts[0] - (truth[:, :2, 2] - truth[0, :2, 2])
    assert np.abs(missed).max() < 0.5 * PITCH


def test_one_pair_that_is_wrong_moves_no_frame(positions, look):
    truth = np.tile(np.eye(3), (9, 1, 1))
    truth[:, 0, 2] = 7.0 * np.arange(9)
    values = look(positions, truth)
    elsewhere = np.array([[0, 0, 400.0], [0, 0, 300.0], [0, 0, 0]])
    values[4] = look(positions, truth[4:5] + elsewhere)[0]
    found = find_shifts(positions, values, torch.ones_like(values), SHAPE, PITCH)
    others = np.delete(np.arange(9), 4)
    missed = found.shifts - truth[:, :2, 2]
    assert np.abs(missed[others] - missed[others].mean(axis=0)).max() < 0.3 * PITCH


def test_confidence_tells_the_frame_that_shows_something_else(positions, matrices, look):
    truth = matrices(angle=0.0)
    values = look(positions, truth)
    values[3] = torch.rand(900, generator=torch.Generator().manual_seed(3))
    motion = FrameMotion(torch.from_numpy(truth), SHAPE)
    found = confidence(positions, values, torch.ones_like(values), motion, PITCH)
    assert found[3] < 0.3
    assert np.delete(found, 3).min() > 0.9
