"""Tiles: they cover a picture once, and show no seams."""

from dataclasses import replace

import numpy as np
import pytest

from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.recordings.scene import equations
from napari_fiberburst.recordings.tiles import picture_of, pieces_tiled, tiles_over


@pytest.mark.parametrize(("shape", "side", "halo"), [((97, 121), 32, 9), ((1, 65), 64, 5), ((130, 40), 64, 200)])
def test_every_node_belongs_to_one_tile(shape, side, halo):
    whole = Grid(-7.0, 3.0, 1.0, shape)
    count = np.zeros(shape, int)
    nodes = whole.nodes().numpy()
    for tile in tiles_over(whole, side, halo):
        own = (slice(*tile.rows), slice(*tile.columns))
        count[own] += 1
        np.testing.assert_array_equal(tile.grid.nodes().numpy()[tile.inner], nodes[own])
        above, below, left, right = tile.halo
        assert tile.rows[0] - above == max(0, tile.rows[0] - halo)
        assert tile.rows[1] + below == min(shape[0], tile.rows[1] + halo)
        assert tile.columns[0] - left == max(0, tile.columns[0] - halo)
        assert tile.columns[1] + right == min(shape[1], tile.columns[1] + halo)
    assert (count == 1).all()


def test_every_frame_belongs_to_one_tile_of_its_piece(located):
    track = located.track
    found = [
        (piece, frame) for piece, tile in pieces_tiled(track, 48, 10) for frame in tile.of_frames(track, piece).tolist()
    ]
    wanted = [(int(piece), frame) for frame, piece in enumerate(track.piece) if piece >= 0]
    assert sorted(found) == sorted(wanted)


def test_frames_that_touch_a_tile_are_those_that_see_some_of_it(located):
    track = located.track
    for piece, tile in pieces_tiled(track, 48, 10)[::5]:
        nodes = tile.grid.nodes().reshape(-1, 2).double().numpy()
        for frame in track.frames_of(piece).tolist():
            back = np.linalg.inv(track.scene_from_frame[frame])
            pixels = nodes @ back[:2, :2].T + back[:2, 2]
            sees = ((pixels >= 0) & (pixels <= np.array(track.shape[::-1]) - 1)).all(axis=1).any()
            assert not sees or frame in track.touching(tile.grid, piece)


def test_a_scene_in_tiles_is_the_scene_at_once(located):
    track, traces = located.track, located.traces
    whole = picture_of(track, 0)
    smoothness, pitch = 0.05, traces.template.pitch

    def solved(grid):
        found = equations(traces, track, track.touching(grid, 0), grid)
        return found.image(found.solve(smoothness), smoothness)[0].numpy()

    at_once, tiled = solved(whole), np.zeros(whole.shape)
    for tile in tiles_over(whole, 64, int(np.ceil(8 * pitch))):
        tiled[slice(*tile.rows), slice(*tile.columns)] = solved(tile.grid)[tile.inner]
    seen = np.zeros(whole.shape, bool)
    for corners in track.corners(track.frames_of(0)):
        (x0, y0), (x1, y1) = corners.min(axis=0), corners.max(axis=0)
        rows = slice(int(np.ceil(y0 - whole.y0 + 5)), int(y1 - whole.y0 - 5))
        seen[rows, int(np.ceil(x0 - whole.x0 + 5)) : int(x1 - whole.x0 - 5)] = True
    off = np.abs(tiled - at_once)[seen] / np.ptp(at_once[seen])
    assert np.sqrt(np.mean(off**2)) < 1e-3
    assert off.max() < 0.025


def test_a_piece_that_has_lost_its_frames_has_no_tiles(located):
    track = replace(located.track, piece=np.where(located.track.piece == 0, -1, located.track.piece))
    assert {piece for piece, _ in pieces_tiled(track, 64, 10)} == set(range(1, track.pieces))
