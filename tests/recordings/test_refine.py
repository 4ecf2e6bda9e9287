"""Frames held against the scene that they make: what was disturbed comes back."""

from dataclasses import replace

import numpy as np
import pytest
from tests.recordings.conftest import after_similarity, middles, refine_in_turn


@pytest.fixture(scope="module")
def disturbed(hand, located):
    """Return the true track of the largest piece, a disturbed one, and what five rounds make of that."""
    rng = np.random.default_rng(7)
    known = located.track
    frames = known.frames_of(0)
    matrices = known.scene_from_frame.copy()
    matrices[frames] = np.linalg.inv(hand.homographies[frames[0]]) @ hand.homographies[frames]
    true = replace(
        known,
        scene_from_frame=matrices,
        piece=np.where(known.piece == 0, 0, -1),
        exposures=(hand.exposures / np.exp(np.log(hand.exposures[frames]).mean())).astype(np.float32),
        dof=2,
        control=None,
    )
    moved = matrices.copy()
    moved[frames, :2, 2] += rng.normal(0, 0.4, (len(frames), 2))
    gains = (known.gains * np.exp(rng.normal(0, 0.08, known.gains.shape))).astype(np.float32)
    exposures = (true.exposures * np.exp(rng.normal(0, 0.06, len(known)))).astype(np.float32)
    start = replace(true, scene_from_frame=moved, gains=gains, exposures=exposures)
    track = refine_in_turn(located.work, start, 5, "disturbed")
    return true, start, track, frames


def off(track, true, frames):
    found, wanted = middles(track.scene_from_frame[frames]), middles(true.scene_from_frame[frames])
    return np.abs(after_similarity(found, wanted)[0] - wanted)


def test_places_come_back(disturbed):
    true, start, track, frames = disturbed
    assert np.median(off(start, true, frames)) > 0.3
    assert np.median(off(track, true, frames)) < 0.08


def test_exposures_come_back(disturbed):
    true, start, track, frames = disturbed

    def spread(found):
        return np.std(np.log(found.exposures[frames] / true.exposures[frames]))

    assert spread(start) > 0.045
    assert spread(track) < 0.5 * spread(start)


def test_gains_come_back(disturbed):
    true, start, track, _ = disturbed

    def spread(found):
        return np.std(np.log(found.gains / true.gains))

    assert spread(track) < 0.5 * spread(start)
    assert np.median(track.gains) == pytest.approx(1, abs=1e-5)


def test_frames_fit_their_scene(disturbed):
    _, _, track, frames = disturbed
    assert (track.piece[frames] == 0).mean() > 0.95
    assert np.median(track.alike[frames]) > 0.95
    assert 0 < track.error < 0.03
