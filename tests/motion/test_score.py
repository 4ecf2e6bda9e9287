"""Whether frames bend is told by most of them."""

import numpy as np
import pytest
import torch
from tests.motion.levels import through_levels

from napari_fiberburst.motion.problem import JointProblem
from napari_fiberburst.motion.score import bending_score

SHAPE, PITCH, FRAMES = (120, 140), 5.0, 10


@pytest.fixture
def places():
    """Return where ten frames lie, by shifts."""
    return np.random.default_rng(2).normal(0, 6, (FRAMES, 2)) * (np.arange(FRAMES) > 0)[:, None]


def seen(positions, places, look, bent=(), apart=()):
    """Return what frames see: rigid ones, those that bend by five pixels, and those that lie elsewhere."""
    frames = []
    noise = torch.Generator().manual_seed(0)
    for number, place in enumerate(places):
        at = positions + torch.from_numpy(place).float() + (400.0 if number in apart else 0.0)
        if number in bent:
            at = at + 5 * torch.sin(positions.flip(1) / 12 + number)
        values = look(at, np.eye(3)[None])[0]
        frames.append(values + 0.01 * torch.randn(len(values), generator=noise))
    return torch.stack(frames)


def score(positions, places, values):
    count = len(positions)
    problem = JointProblem(
        positions=positions,
        values=values,
        weights=torch.ones_like(values),
        core_index=torch.arange(count),
        cores=count,
        pitch=PITCH,
        dof=8,
    )
    return bending_score(problem, through_levels(problem, places, SHAPE))


def test_frames_ask_to_bend_where_many_of_them_do(positions, places, look):
    rigid = score(positions, places, seen(positions, places, look))
    half = score(positions, places, seen(positions, places, look, bent=range(5, FRAMES)))
    assert rigid < 1 < half
    assert half > 4 * rigid


def test_one_frame_that_bends_or_lies_elsewhere_does_not_ask_for_others(positions, places, look):
    assert score(positions, places, seen(positions, places, look, bent=(4,))) < 1
    assert score(positions, places, seen(positions, places, look, apart=(4,))) < 1
