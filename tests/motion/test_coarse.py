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


def test_what_stands_still_does_not_hold_a_faint_object():
    generator = torch.Generator().manual_seed(5)
    positions = torch.rand(900, 2, generator=generator) * torch.tensor([139.0, 119.0])
    truth = np.tile(np.eye(3), (10, 1, 1))
    truth[:, :2, 2] = np.cumsum(np.random.default_rng(0).normal(0, 4, (10, 2)), axis=0)
    still = smooth_pattern(positions)
    faint = torch.stack([smooth_pattern(positions + torch.tensor(place) + 500) for place in truth[:, :2, 2]])
    values = (1 + 0.3 * still) * (1 + 0.03 * faint)
    found = find_shifts(positions, values.float(), torch.ones_like(values).float(), SHAPE, PITCH)
    assert found.connected.all()
    missed = found.shifts - truth[:, :2, 2]
    assert np.abs(missed - missed.mean(axis=0)).max() < 0.5 * PITCH
    assert found.travel > 2 * PITCH


def smooth_pattern(points):
    """Return a random pattern (N,) at points (N, 2), of detail some 15 pixels wide."""
    generator = torch.Generator().manual_seed(6)
    waves = 0.4 * torch.randn(40, 2, generator=generator).double() / 3
    phases = 6.3 * torch.rand(40, generator=generator).double()
    return torch.cos(points.double() @ waves.T + phases).mean(dim=-1) * 5


def test_an_object_that_hardly_moves_is_not_taken_apart(positions, look):
    truth = np.tile(np.eye(3), (8, 1, 1))
    truth[:, :2, 2] = np.random.default_rng(1).normal(0, 0.4, (8, 2))
    values = look(positions, truth)
    found = find_shifts(positions, values, torch.ones_like(values), SHAPE, PITCH)
    assert found.connected.all()
    missed = found.shifts - truth[:, :2, 2]
    assert np.abs(missed - missed.mean(axis=0)).max() < 0.3 * PITCH
