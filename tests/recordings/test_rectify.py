"""Scenes that are stretched as a whole: frames tell it together, though each agrees with its neighbours."""

from dataclasses import replace

import numpy as np
import pytest
from tests.recordings.conftest import SHAPE, after_similarity, middles, refine_in_turn

from napari_fiberburst.recordings import locate
from napari_fiberburst.recordings.rectify import rectified
from napari_fiberburst.recordings.refine import Refinement
from napari_fiberburst.recordings.track import Track
from napari_fiberburst.steps import drain


def stretch(places):
    """Return how far places (n, 2) of the scene are off: stretched along x, sheared, and bent, by up to 1 px."""
    x, y = (places / 400).T
    return np.stack([0.5 * x + 0.3 * x * y, 0.4 * y**2 - 0.2 * x**3], axis=1)


def strain_at(places):
    """Return the four strains of `stretch`, by differences."""
    step = 1e-3
    along_x, along_y = (
        (stretch(places + np.array(way)) - stretch(places - np.array(way))) / (2 * step)
        for way in ((step, 0), (0, step))
    )
    (xx, yx), (xy, yy) = along_x.T, along_y.T
    return np.stack([xx + yy, yx - xy, xx - yy, xy + yx], axis=1) / 2


def track_of(places, dof):
    count = len(places)
    matrices = np.tile(np.eye(3), (count, 1, 1))
    matrices[:, :2, 2] = places - np.array([(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2])
    return Track(
        scene_from_frame=matrices,
        piece=np.zeros(count, np.int64),
        exposures=np.ones(count, np.float32),
        gains=np.ones((5, 1), np.float32),
        weights=np.ones(count, np.float32),
        alike=np.ones(count),
        error=0.01,
        shape=SHAPE,
        dof=dof,
        gain_weights=np.zeros(5, np.float32),
    )


def told(track, strain, certainty):
    count = len(track)
    nothing = np.zeros(count)
    return Refinement(
        frames=np.arange(count),
        scene_from_frame=track.scene_from_frame,
        control=None,
        exposures=track.exposures,
        missed=nothing,
        alike=nothing,
        asked=np.zeros((count, 2)),
        strain=strain,
        certainty=np.full((count, 4), certainty),
        rarity=np.ones(count),
        bending=nothing,
        agreement=None,
        power=None,
    )


@pytest.fixture
def path():
    """Return the middles of 120 frames of a raster, (n, 2), pixels."""
    column, row = np.meshgrid(np.arange(12) * 60.0, np.arange(10) * 45.0)
    return np.stack([column.ravel(), row.ravel()], axis=1)


def off(track, true):
    """Return how far frames are from where they truly lie, but for a shift of all."""
    missed = middles(track.scene_from_frame) - (true @ [1, 1j])
    return np.abs(missed - missed.mean())


def test_rigid_frames_lead_back_to_where_they_lie(path):
    wrong = track_of(path + stretch(path), 2)
    found = rectified(wrong, [told(wrong, strain_at(path), 1e10)])
    assert off(wrong, path).max() > 0.5
    assert off(found, path).max() < 0.01
    np.testing.assert_array_equal(found.scene_from_frame[:, :2, :2], wrong.scene_from_frame[:, :2, :2])


def test_frames_that_turn_and_grow_tell_stretches_alone_and_turn_with_their_scene(path):
    wrong, strain = track_of(path + stretch(path), 4), strain_at(path)
    grown, turned = strain[:, :2].T
    followed = wrong.scene_from_frame.copy()
    middle = followed @ [(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2, 1]
    followed[:, 0, 0] = followed[:, 1, 1] = 1 + grown
    followed[:, 1, 0], followed[:, 0, 1] = turned, -turned
    followed[:, :2, 2] = 0
    followed[:, :2, 2] = (middle - followed @ [(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2, 1])[:, :2]
    wrong = replace(wrong, scene_from_frame=followed)
    found = rectified(wrong, [told(wrong, strain * [0, 0, 1, 1], 1e10)])
    # What turns and grows evenly everywhere, or as a conformal map does, is not told.
    basis = np.stack([(path @ [1, 1j]) ** power for power in range(5)], axis=1)
    missed = middles(found.scene_from_frame) - path @ [1, 1j]
    assert np.abs(missed - basis @ np.linalg.lstsq(basis, missed, rcond=None)[0]).max() < 0.01
    linear = found.scene_from_frame[:, :2, :2]
    np.testing.assert_allclose(linear[:, 0, 0], linear[:, 1, 1], atol=1e-12)


def test_what_is_not_told_stays(path):
    track = track_of(path, 2)
    noise = np.random.default_rng(0).normal(0, 1e-2, (len(path), 4))
    found = rectified(track, [told(track, noise, 1.0)])
    assert off(found, path).max() < 5e-3


def test_a_piece_that_has_lost_its_frames_is_no_hindrance(path):
    wrong = replace(track_of(path + stretch(path), 2), piece=np.ones(len(path), np.int64))
    found = rectified(wrong, [told(wrong, strain_at(path), 1e10)])
    assert off(found, path).max() < 0.01
    assert (found.rarity(4.0) == 1).all()


def test_frames_that_stretch_tell_nothing(path):
    track = track_of(path, 6)
    assert rectified(track, [told(track, strain_at(path), 1e10)]) is track


def test_a_stretched_recording_comes_back(hand, located):
    known = located.track
    frames = known.frames_of(0)
    true = np.linalg.inv(hand.homographies[frames[0]]) @ hand.homographies[frames]
    matrices = known.scene_from_frame.copy()
    matrices[frames] = true
    matrices[frames, 0, 2] *= 1.02
    start = replace(known, scene_from_frame=matrices, piece=np.where(known.piece == 0, 0, -1), dof=2, control=None)
    place = true[:, :2, 2]
    missed = []
    for name, finish in (("stretched", lambda track, parts: track), ("rectified", rectified)):
        track = refine_in_turn(located.work, start, 3, name, finish)
        found = track.scene_from_frame[frames, :2, 2]
        missed.append(np.polyfit(place[:, 0], found[:, 0] - place[:, 0], 1)[0])
    assert missed[0] > 0.005
    assert abs(missed[1]) < 0.2 * missed[0]


def test_what_makes_the_scene_worse_is_taken_back(hand, located, tmp_path, monkeypatch):
    def strained(track, parts):
        matrices = track.scene_from_frame.copy()
        matrices[:, 0, 2] *= 1.03
        return replace(track, scene_from_frame=matrices)

    monkeypatch.setattr(locate, "rectified", strained)
    found = drain(locate.locating(hand.source, tmp_path, bundle=None, dof=2, client=None)).track
    frames = found.frames_of(0)
    true = middles(hand.homographies[frames])
    off = np.abs(after_similarity(middles(found.scene_from_frame[frames]), true)[0] - true)
    assert np.median(off) < 0.12
    assert found.error < 1.05 * located.track.error
