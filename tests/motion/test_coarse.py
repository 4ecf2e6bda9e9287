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


def test_confidence_tells_the_frame_that_shows_something_else(positions, matrices, look):
    truth = matrices(angle=0.0)
    values = look(positions, truth)
    values[3] = torch.rand(900, generator=torch.Generator().manual_seed(3))
    motion = FrameMotion(torch.from_numpy(truth), SHAPE)
    found = confidence(positions, values, torch.ones_like(values), motion, PITCH)
    assert found[3] < 0.3
    assert np.delete(found, 3).min() > 0.9
