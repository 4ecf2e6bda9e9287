"""Tracks: scenes are in the pixels of their first frames."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from napari_fiberburst.recordings.bending import control_grid
from napari_fiberburst.recordings.track import Track

SHAPE = (61, 83)


@pytest.fixture
def track():
    """Return two pieces of frames that are turned, stretched and bent; frame 3 is in none."""
    rng = np.random.default_rng(0)
    matrices = np.tile(np.eye(3), (6, 1, 1))
    matrices[:, :2] += rng.normal(0, 0.05, (6, 2, 3))
    matrices[:, :2, 2] += rng.normal(0, 30, (6, 2))
    rows, columns = control_grid(SHAPE).shape
    return Track(
        scene_from_frame=matrices,
        piece=np.array([1, 0, 0, -1, 0, 1]),
        exposures=np.ones(6, np.float32),
        gains=np.ones((5, 1), np.float32),
        weights=np.ones(6, np.float32),
        alike=np.ones(6),
        error=0.01,
        shape=SHAPE,
        dof=6,
        gain_weights=np.zeros(5, np.float32),
        control=rng.normal(0, 2, (6, 2, rows * columns)).astype(np.float32),
    )


def turned(matrix):
    """Return a matrix as the complex turn and growth that are nearest to it."""
    return (matrix[0, 0] + matrix[1, 1]) / 2 + 1j * (matrix[1, 0] - matrix[0, 1]) / 2


def test_first_frames_lie_upright_on_their_own_pixels(track):
    for first in (0, 1):
        matrix = track.anchored().scene_from_frame[first]
        assert turned(matrix) == pytest.approx(1, abs=1e-9)
        middle = np.array([(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2, 1])
        np.testing.assert_allclose(matrix @ middle, middle, atol=1e-9)


def test_frames_lie_on_one_another_as_before(track):
    corners = torch.tensor([[0.0, 0.0], [82.0, 13.0], [31.0, 60.0]])
    before, after = (some.points(np.arange(6), corners).double().numpy() for some in (track, track.anchored()))
    for own in ([1, 2, 4], [0, 5]):
        was, now = (places[own].reshape(-1, 2) @ [1, 1j] for places in (before, after))
        basis = np.stack([was, np.ones_like(was)], axis=1)
        change = np.linalg.lstsq(basis, now, rcond=None)[0]
        np.testing.assert_allclose(basis @ change, now, atol=1e-4)
        assert change[0] == pytest.approx(1 / turned(track.scene_from_frame[own[0]]), abs=1e-5)


def test_frames_without_a_piece_are_left(track):
    np.testing.assert_array_equal(track.anchored().scene_from_frame[3], track.scene_from_frame[3])
    lost = replace(track, piece=np.full(6, -1))
    np.testing.assert_array_equal(lost.anchored().scene_from_frame, track.scene_from_frame)


def test_frames_are_chosen_evenly_over_places(track):
    count = 90
    place = np.concatenate([np.arange(30), np.full(60, 29.0)]) * 10
    matrices = np.tile(np.eye(3), (count, 1, 1))
    matrices[:, 0, 2] = place
    rested = replace(
        track, scene_from_frame=matrices, piece=np.where(np.arange(count) == 40, -1, 0), control=None, dof=2
    )
    rarity = rested.rarity(4.0)
    np.testing.assert_allclose(rarity[:29], 1)
    np.testing.assert_allclose(rarity[[29, 89]], 1 / 60)
    assert rarity[40] == 0
    chosen = rested.spread(rested.frames_of(0), 10, 4.0)
    assert 8 <= len(chosen) <= 10
    assert (place[chosen] == 290).sum() <= 2
    np.testing.assert_array_equal(rested.spread(rested.frames_of(0)[:5], 50, 4.0), np.arange(5))
