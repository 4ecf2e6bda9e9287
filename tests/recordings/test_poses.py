"""Places of frames from links that are made up, so that the answer is known."""

import numpy as np
import pytest

from napari_fiberburst.recordings.links import Links
from napari_fiberburst.recordings.poses import Poses, solve_poses
from napari_fiberburst.recordings.register import crossings, expected, meetings

COUNT, SIDE = 60, 91.0


def circle(rng, turns=0.03):
    """Return turns and places of frames on a circle that closes, the first at rest."""
    angle = 2 * np.pi * np.arange(COUNT) / COUNT
    place = 150 * (np.exp(1j * angle) - 1)
    turn = np.exp(turns * (np.sin(angle) * 0.3 + 1j * np.sin(2 * angle)))
    return turn, place


def links_of(turn, place, pairs, rng=None, noise=0.0):
    """Return links that say how frames lie, with so much noise."""
    pairs = np.array(pairs)
    first, second = pairs.T
    a, shift = turn[second] / turn[first], (place[second] - place[first]) / turn[first]
    if noise:
        shift = shift + noise * (rng.normal(size=len(pairs)) + 1j * rng.normal(size=len(pairs)))
    return Links(
        pairs=pairs,
        similarity=np.stack([a.real, a.imag, shift.real, shift.imag], axis=1),
        middle=np.zeros((len(pairs), 2)),
        reach=np.full((len(pairs), 2), SIDE / 4),
        alike=np.full(len(pairs), 0.9),
    )


def chain(gaps=(1, 2, 4), count=COUNT):
    return [(number, number + gap) for gap in gaps for number in range(count - gap)]


@pytest.mark.parametrize("dof", [2, 4])
def test_consistent_links_give_exact_places(rng, dof):
    turn, place = circle(rng, turns=0.0 if dof == 2 else 0.03)
    poses = solve_poses(links_of(turn, place, chain()), COUNT, dof)
    np.testing.assert_allclose(poses.place, place, atol=1e-6)
    np.testing.assert_allclose(poses.turn, turn, atol=1e-8)
    assert (poses.piece == 0).all()
    assert poses.error.max() < 1e-6


def test_matrices_lead_the_middle_where_it_lies_and_turn_about_it(rng):
    turn, place = circle(rng)
    poses = solve_poses(links_of(turn, place, chain()), COUNT, 4)
    middle = (60.3, 48.1)
    at = poses.matrices(middle) @ [*middle, 1]
    np.testing.assert_allclose(at[:, 0] + 1j * at[:, 1], place + complex(*middle), atol=1e-6)
    beside = poses.matrices(middle) @ [middle[0] + 10, middle[1], 1] - at
    np.testing.assert_allclose(beside[:, 0] + 1j * beside[:, 1], 10 * turn, atol=1e-6)


def test_a_loop_closes(rng):
    turn, place = circle(rng, turns=0.0)
    noisy = links_of(turn, place, chain((1,)), rng, noise=0.3)
    drifted = solve_poses(noisy, COUNT, 2)
    # It is the sum of all links' noise: 0.3 times the root of 59 on each axis.
    assert 0.5 < abs(drifted.place[-1] - place[-1]) < 12
    closed = solve_poses(noisy + links_of(turn, place, [(0, COUNT - 1)]), COUNT, 2)
    assert abs(closed.place[-1] - place[-1]) < 0.35 * abs(drifted.place[-1] - place[-1])
    assert np.abs(closed.place - place).mean() < np.abs(drifted.place - place).mean()


def test_false_links_are_thrown_out(rng):
    turn, place = circle(rng, turns=0.0)
    pairs = chain()
    good = links_of(turn, place, pairs, rng, noise=0.05)
    is_false = rng.random(len(pairs)) < 0.1
    similarity = good.similarity.copy()
    off = (int(is_false.sum()), 2)
    similarity[is_false, 2:] += rng.uniform(8, 60, off) * rng.choice([-1, 1], off)
    links = Links(pairs=good.pairs, similarity=similarity, middle=good.middle, reach=good.reach, alike=good.alike)
    poses = solve_poses(links, COUNT, 2)
    assert is_false.sum() >= 10
    assert (poses.trust[is_false] < 0.1).all()
    assert (poses.trust[~is_false] > 0.5).all()
    clean = solve_poses(good, COUNT, 2)
    assert np.abs(poses.place - place).max() < np.abs(clean.place - place).max() + 0.15
    assert (poses.piece == 0).all()


def test_pieces_are_numbered_by_size_and_lone_frames_belong_to_none(rng):
    turn, place = circle(rng)
    small = [pair for pair in chain() if max(pair) < 20]
    large = [pair for pair in chain() if min(pair) >= 21]
    poses = solve_poses(links_of(turn, place, small + large), COUNT, 4)
    np.testing.assert_array_equal(poses.piece, [1] * 20 + [-1] + [0] * 39)
    for frames in (np.arange(20), np.arange(21, COUNT)):
        # Each piece lies as its first frame does, so only how its frames lie on one another can be told.
        pairs = np.stack([np.full(len(frames) - 1, frames[0]), frames[1:]], axis=1)
        np.testing.assert_allclose(expected(poses, pairs), links_of(turn, place, pairs).similarity, atol=1e-6)
        assert poses.place[frames[0]] == pytest.approx(0, abs=1e-6)


def test_one_doubtful_link_joins_no_pieces_and_two_do(rng):
    turn, place = circle(rng, turns=0.0)
    apart = links_of(turn, place, [pair for pair in chain() if max(pair) < 25 or min(pair) >= 25])
    for between, count in (([(20, 30)], 2), ([(20, 30), (21, 31)], 1)):
        doubtful = links_of(turn, place, between)
        doubtful.alike[:] = 0.45
        assert solve_poses(apart + doubtful, COUNT, 2).piece.max() + 1 == count


def test_a_narrow_strip_in_common_joins_no_pieces(rng):
    turn, place = circle(rng, turns=0.0)
    apart = links_of(turn, place, [pair for pair in chain() if max(pair) < 25 or min(pair) >= 25])
    for part, count in ((0.9, 1), (0.1, 2)):
        between = links_of(turn, place, [(20, 30)])
        between.reach[:, 0] *= part
        assert solve_poses(apart + between, COUNT, 2).piece.max() + 1 == count


@pytest.mark.parametrize("count", [60, 1000])
def test_a_long_chain_does_not_give_way(count):
    # Nothing but neighbours hold it, so that the least pull to anywhere would bend it by pixels.
    place = 9.0 * np.arange(count) * np.exp(1j * np.arange(count) / count)
    turn = np.exp(0.05j * np.arange(count) / count)
    poses = solve_poses(links_of(turn, place, chain(count=count)), count, 4)
    np.testing.assert_allclose(poses.place, place, atol=0.02)  # pixels, after a thousand frames


def test_a_piece_that_a_false_link_ties_does_not_shrink(rng):
    turn, place = circle(rng, turns=0.02)
    apart = links_of(turn, place, [pair for pair in chain() if max(pair) < 25 or min(pair) >= 25], rng, noise=0.3)
    false = links_of(turn, place, [(0, 25)])
    false.similarity[:] = [0.88, -0.03, 85, 38]
    false.reach[:] = SIDE / 12
    poses = solve_poses(apart + false, COUNT, 4)
    np.testing.assert_allclose(np.abs(poses.turn), 1, atol=0.1)


def test_frames_turn_only_where_links_say_so(rng):
    pairs = chain()
    for turns, dof in ((0.0, 2), (0.02, 4)):
        turn, place = circle(rng, turns)
        links = links_of(turn, place, pairs, rng, noise=0.05)
        # Turns are known as well as places are, half a field away.
        links.similarity[:, :2] += 0.05 / (SIDE / 4) * rng.normal(size=(len(pairs), 2))
        assert solve_poses(links, COUNT).dof == dof


def test_nothing_is_said_of_frames_without_links():
    poses = solve_poses(Links.none(), 5)
    assert (poses.piece == -1).all()
    np.testing.assert_array_equal(poses.place, 0)


def test_crossings_are_where_a_path_meets_itself(rng):
    turn = np.ones(COUNT, complex)
    place = np.abs(np.arange(COUNT) - 29.5) * 10 + 0j  # forth and back
    poses = solve_poses(links_of(turn, place, chain()), COUNT, 2)
    pairs = crossings(poses, SIDE)
    first, second = np.array(pairs).T
    assert (second - first > 8).all()
    np.testing.assert_allclose(place[first], place[second], atol=11)
    assert (3, 56) in pairs


def test_frames_before_and_after_a_gap_are_compared():
    piece = np.array([0] * 20 + [-1] * 3 + [1] * 10)
    poses = Poses(
        turn=np.ones(33, complex),
        place=np.arange(33) * (9.0 + 0j),
        piece=piece,
        trust=np.zeros(0),
        error=np.zeros(0),
        dof=2,
    )
    pairs = meetings(poses, 97)
    assert {(19, 23), (17, 25)} <= set(pairs)
    assert all(piece[one] >= 0 and piece[other] >= 0 and piece[one] != piece[other] for one, other in pairs)
