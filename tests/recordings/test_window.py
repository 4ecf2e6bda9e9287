"""Windows of frames that move on, and their normal equations."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.recordings.track import Track
from napari_fiberburst.recordings.window import Window, frames_about, view_of, window_for
from napari_fiberburst.scene.spline import NormalEquations

SHAPE, CORES = (31, 43), 60


def track_of(places, piece=None):
    """Return the track of frames whose first pixels lie at some places (T, 2)."""
    count = len(places)
    matrices = np.tile(np.eye(3), (count, 1, 1))
    matrices[:, :2, 2] = places
    return Track(
        scene_from_frame=matrices,
        piece=np.zeros(count, np.int64) if piece is None else np.array(piece),
        exposures=np.ones(count, np.float32),
        gains=np.ones((CORES, 1), np.float32),
        weights=np.ones(count, np.float32),
        alike=np.ones(count),
        error=0.01,
        shape=SHAPE,
        dof=2,
        gain_weights=np.zeros(CORES, np.float32),
    )


def along(count, step):
    return np.stack([step * np.arange(count), 0.3 * step * np.arange(count)], axis=1)


@pytest.fixture
def assembled(rng):
    """Return what gives the equations of a frame on a grid, and how often it was asked for each."""
    track = track_of(along(30, 2.7))
    seen = torch.from_numpy(rng.random((30, CORES, 2)) * (SHAPE[1] - 1, SHAPE[0] - 1))
    values = torch.from_numpy(rng.random((30, CORES, 1))).float()

    def of_frame(number, grid):
        points = (seen[number] + torch.from_numpy(track.scene_from_frame[number, :2, 2])).float()
        empty = NormalEquations.empty(grid, 1.5, 1, torch.device("cpu"))
        return empty.with_samples(points, values[number], torch.ones(CORES))

    return track, of_frame


def test_a_window_holds_what_was_added_and_nothing_of_what_has_gone(assembled):
    track, of_frame = assembled
    asked = []
    window = Window(lambda number: asked.append(number) or of_frame(number, view_of(track, number, 2.0)))
    for number in range(30):
        frames, grid = frames_about(track, number, 7), view_of(track, number, 12.0)
        found = window.about(frames, grid)
        expected = sum((of_frame(int(frame), grid).bands for frame in frames), torch.zeros(5, *grid.shape))
        # What samples at the rim of the grid are tied to beyond it is not there.
        inner = (slice(None), slice(1, -1), slice(1, -1))
        assert torch.allclose(found.bands[inner], expected[inner], atol=2e-4)
        light = sum((of_frame(int(frame), grid).rhs for frame in frames), torch.zeros(1, *grid.shape))
        assert torch.allclose(found.rhs[inner], light[inner], atol=2e-4)
    assert asked == list(range(30))  # each was added once, however long the window


def test_a_window_that_jumps_away_and_comes_back_begins_anew(assembled):
    track, of_frame = assembled
    window = Window(lambda number: of_frame(number, view_of(track, number, 2.0)))
    grid = view_of(track, 3, 5.0)
    first = window.about(np.array([2, 3, 4]), grid)
    window.about(np.array([20, 21]), view_of(track, 20, 5.0))
    again = window.about(np.array([2, 3, 4]), grid)
    assert torch.equal(first.bands, again.bands)
    assert torch.equal(first.rhs, again.rhs)


def test_equations_are_laid_on_wider_and_narrower_grids(assembled):
    track, of_frame = assembled
    narrow, wide = view_of(track, 0, 2.0), view_of(track, 0, 20.0)
    there = of_frame(0, narrow).on(wide)
    assert torch.allclose(there.bands, of_frame(0, wide).bands, atol=1e-4)
    assert torch.equal(there.on(narrow).rhs, of_frame(0, narrow).rhs)
    beside = of_frame(0, narrow).on(Grid(narrow.x0 + 1000, narrow.y0, 1.0, (9, 11)))
    assert beside.rhs.shape == (1, 9, 11)
    assert not beside.rhs.any()


def test_frames_about_one_are_of_its_piece_and_see_what_it_sees():
    piece = [0] * 10 + [-1] * 3 + [1] * 5 + [0] * 10
    track = track_of(along(28, 1.0), piece)
    assert frames_about(track, 5, 5).tolist() == [3, 4, 5, 6, 7]
    assert frames_about(track, 0, 5).tolist() == [0, 1, 2, 3, 4]
    assert frames_about(track, 9, 5).tolist() == [7, 8, 9, 18, 19]
    assert frames_about(track, 14, 9).tolist() == [13, 14, 15, 16, 17]
    far = track_of(np.concatenate([along(6, 1.0), along(6, 1.0) + np.array([0, SHAPE[0] + 5])]))
    assert frames_about(far, 5, 5).tolist() == [3, 4, 5]


def test_slow_motion_asks_for_longer_windows():
    slow, usual, fast = (window_for(track_of(along(40, step)), 4.7) for step in (0.1, 1.5, 9.0))
    assert slow > usual > fast
    assert all(width % 2 for width in (slow, usual, fast))
    alone = replace(track_of(along(4, 1.0)), piece=np.full(4, -1))
    assert window_for(alone, 4.7) == fast
