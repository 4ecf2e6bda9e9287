"""Step 2 of a long recording: where every frame lies, by pairs of frames in time and wherever the path meets itself."""

from collections.abc import Generator, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from napari_fiberburst.recordings.links import Linker, Links, Pair, neighbours
from napari_fiberburst.recordings.poses import Poses, solve_poses
from napari_fiberburst.recordings.traces import Traces
from napari_fiberburst.recordings.views import Views

# Frames are tied to those so many places later.
_GAPS = (1, 2, 4)
# Where a path meets itself is looked for so many times, each time from better poses.
_LOOP_ROUNDS = 2
# In parts of the field's shorter side: frames whose middles are this near see the same place; and how wrong the chain
# of neighbours may have them.
_NEAR, _DRIFT = 0.5, 0.25
# Frames so many places apart belong to other passes of the path; each frame is tied to so many passes at most.
_PASS, _MOST_PASSES = 8, 10


def registering(traces: Traces, dof: int | None = None) -> Generator[tuple[str, float], None, tuple[Poses, Views]]:
    """Find where every frame lies; yields what is being done, and how much of it is done, 0 to 1.

    Parameters
    ----------
    traces : Traces
        Of the recording.
    dof : int, optional
        2 for shifts alone, 4 for turns and zoom as well; by default as the frames ask for.
    """
    views = Views(traces)
    linker, side = Linker(views), min(traces.template.shape)
    frames = np.flatnonzero(traces.shows)
    tried: set[Pair] = set()
    links, poses = Links.none(), solve_poses(Links.none(), len(traces), 2)
    rounds = [*(("neighbours", gap) for gap in _GAPS), *[("crossings", 0)] * _LOOP_ROUNDS]
    for number, (name, gap) in enumerate(rounds):
        chosen = crossings(poses, side) if name == "crossings" else list(neighbours(frames, [gap]))
        pairs = [pair for pair in chosen if pair not in tried]
        tried.update(pairs)
        for some in _in_parts(pairs):
            links = links + _linked(linker, some, poses, _DRIFT * side)
            yield name, (number + 1) / len(rounds)
        poses = solve_poses(links, len(traces), dof)
    return poses, views


def _linked(linker: Linker, pairs: list[Pair], poses: Poses, radius: float) -> Links:
    """Return links of pairs: where they are expected, or anywhere where nothing is."""
    first, second = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    tied = (poses.piece[first] == poses.piece[second]) & (poses.piece[first] >= 0)
    known, unknown = ([pair for pair, is_tied in zip(pairs, tied, strict=True) if is_tied == side] for side in (1, 0))
    return linker.follow(known, expected(poses, known), radius) + linker.find(unknown)


def crossings(poses: Poses, side: float) -> list[Pair]:
    """Return pairs of frames that should see the same place, on other passes of the path than their own.

    Of each pass that comes near a frame, the frame that comes nearest.
    """
    found: set[Pair] = set()
    for piece in range(int(poses.piece.max(initial=-1)) + 1):
        frames = np.flatnonzero(poses.piece == piece)
        places = np.stack([poses.place[frames].real, poses.place[frames].imag], axis=1)
        for index, near in enumerate(cKDTree(places).query_ball_point(places, _NEAR * side)):
            numbers = np.sort(frames[near])
            distance = np.abs(poses.place[numbers] - poses.place[frames[index]])
            runs = np.split(np.arange(len(numbers)), np.flatnonzero(np.diff(numbers) > _PASS) + 1)
            nearest = sorted((run[np.argmin(distance[run])] for run in runs), key=lambda at: distance[at])
            for at in nearest[: _MOST_PASSES + 1]:
                first, second = sorted((int(frames[index]), int(numbers[at])))
                if second - first > _PASS:
                    found.add((first, second))
    return sorted(found)


def expected(poses: Poses, pairs: list[Pair]) -> NDArray[np.float64]:
    """Return how pairs of frames lie on one another by their poses, (L, 4) as in `Links`."""
    first, second = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    turn = poses.turn[second] / poses.turn[first]
    place = (poses.place[second] - poses.place[first]) / poses.turn[first]
    return np.stack([turn.real, turn.imag, place.real, place.imag], axis=1)


def _in_parts(pairs: list[Pair], length: int = 256) -> Iterator[list[Pair]]:
    for first in range(0, len(pairs), length):
        yield pairs[first : first + length]
