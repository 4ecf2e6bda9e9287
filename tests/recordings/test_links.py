"""Frames found in one another: against the simulator's truth."""

import numpy as np
import pytest

from napari_fiberburst.recordings.links import Linker, Links, neighbours
from napari_fiberburst.recordings.views import Views


@pytest.fixture(scope="module")
def neighbouring(turning):
    pairs = list(neighbours(np.arange(40), [1, 2, 4]))
    return turning.linker.find(pairs), pairs


def test_similarities_of_frames_that_turn(turning, neighbouring):
    links, pairs = neighbouring
    assert len(links) == len(pairs)
    true = np.array([turning.similarity(*pair) for pair in links.pairs])
    off = links.similarity - true
    # Where the pair has something in common: a turn about another point than its middle moves the frame's own middle.
    middle = links.middle @ [1, 1j]
    missed = np.abs((off[:, 0] + 1j * off[:, 1]) * middle + off[:, 2] + 1j * off[:, 3])
    assert np.median(missed) < 0.15
    assert np.percentile(missed, 95) < 0.6
    assert np.median(np.hypot(*off[:, :2].T)) < 2e-3
    assert np.hypot(*true[:, 2:].T).max() > 10


def test_links_have_no_pull_along_the_motion(turning, neighbouring):
    links, _ = neighbouring
    true = np.array([turning.similarity(*pair) for pair in links.pairs])
    shift, off = true[:, 2:], (links.similarity - true)[:, 2:]
    along = (off * shift).sum(axis=1) / np.hypot(*shift.T)
    # The mean light of so short a recording still holds the object, which draws frames together a little.
    assert abs(along.mean()) < 0.12
    assert abs(np.median(along)) < 0.12


def test_following_from_near_comes_to_the_same_place(turning, neighbouring):
    links, _ = neighbouring
    chosen = links.where(np.arange(len(links)) % 7 == 0)
    expected = chosen.similarity + np.array([0, 0, 1.5, -1.0])
    followed = turning.linker.follow([tuple(pair) for pair in chosen.pairs.tolist()], expected, 20.0)
    assert len(followed) == len(chosen)
    order = np.argsort([chosen.pairs.tolist().index(pair) for pair in followed.pairs.tolist()])
    np.testing.assert_allclose(followed.similarity[order][:, 2:], chosen.similarity[:, 2:], atol=0.05)


def test_links_are_put_together_and_chosen():
    assert len(Links.none() + Links.none()) == 0
    assert list(neighbours(np.array([3, 5, 9, 10]), [2])) == [(3, 9), (5, 10)]


def test_frames_of_other_places_are_not_linked(hand, located):
    linker, cut = Linker(Views(located.traces)), int(hand.cuts[0])
    pairs = [(first, second) for first in range(4, cut, 5) for second in range(cut + 2, cut + 14, 4)]
    # Nothing is seen in both: their middles are farther apart than a frame is wide.
    apart = [abs(complex(*(hand.homographies[j] - hand.homographies[i])[:2, 2])) for i, j in pairs]
    pairs = [pair for pair, distance in zip(pairs, apart, strict=True) if distance > 121]
    assert len(pairs) > 10
    links = linker.find(pairs)
    # Some that the lifted probe has blurred are alike by chance: what they tie is asked of the pieces.
    assert len(links) <= 0.2 * len(pairs)
