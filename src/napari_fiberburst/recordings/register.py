"""Step 2 of a long recording: where every frame lies, by pairs of frames in time and wherever the path meets itself."""

import gc
from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import combinations
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from napari_fiberburst.recordings.links import Linker, Links, Pair, neighbours
from napari_fiberburst.recordings.poses import Poses, solve_poses
from napari_fiberburst.recordings.traces import traced
from napari_fiberburst.recordings.views import Views
from napari_fiberburst.recordings.work import Doing, Work, complete
from napari_fiberburst.stored import Stored

# Frames are tied to those so many places later.
_GAPS = (1, 2, 4)
# Where a path meets itself is looked for so many times, each time from better poses.
_LOOP_ROUNDS = 2
# In parts of the field's shorter side: frames whose middles are this near see the same place; and how wrong the chain
# of neighbours may have them.
_NEAR, _DRIFT = 0.75, 0.25
# Frames so many places apart belong to other passes of the path; each frame is tied to so many passes at most.
_PASS, _MOST_PASSES = 8, 10
# Of so many pieces, the largest, frames are compared with those of others: those that lie this far apart, in parts of
# the field's shorter side, and so many of a piece.
_MOST_PIECES, _APART, _MOST_KEPT = 8, 0.4, 24
# So many frames before a piece ends and after the next one begins are compared: a probe that was lifted comes down
# near where it was.
_ABOUT_A_GAP = 3
# Pairs to a unit of work: few enough that workers share them evenly, but not so few that they ask for the same images
# again.
_LEAST_PAIRS, _MOST_PAIRS, _EVEN_UNITS = 32, 256, 16


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Asked(Stored):
    """Pairs of frames that may show the same place.

    Attributes
    ----------
    pairs : numpy.ndarray
        (L, 2).
    expected : numpy.ndarray
        (L, 4), how they should lie on one another, as in `Links`.
    is_tied : numpy.ndarray
        (L,) bool, whether anything is expected of them.
    """

    _kind: ClassVar[str] = "list of pairs"

    pairs: NDArray[np.int64]
    expected: NDArray[np.float64]
    is_tied: NDArray[np.bool_]

    @classmethod
    def of(cls, pairs: list[Pair], poses: Poses) -> "Asked":
        """Return pairs, with what poses say of them."""
        both = np.array(pairs, dtype=np.int64).reshape(-1, 2)
        first, second = both.T
        is_tied = (poses.piece[first] == poses.piece[second]) & (poses.piece[first] >= 0)
        return cls(pairs=both, expected=expected(poses, both), is_tied=is_tied)

    @property
    def units(self) -> range:
        """The numbers of the units of work that they make."""
        return range(-(-len(self.pairs) // self._together))

    def unit(self, number: int) -> slice:
        """Return which pairs a unit has."""
        return slice(number * self._together, (number + 1) * self._together)

    @property
    def _together(self) -> int:
        return min(max(-(-len(self.pairs) // _EVEN_UNITS), _LEAST_PAIRS), _MOST_PAIRS)


def link_unit(work: Work, stage: str, number: int) -> None:
    """Link some of the pairs that a stage asks for: where they are expected, or anywhere where nothing is."""
    asked = Asked.load(work.shared(stage))
    own = asked.unit(number)
    pairs, is_tied = asked.pairs[own], asked.is_tied[own]
    linker, radius = _linker(work), _DRIFT * min(work.bundle.shape)
    links = linker.follow(_listed(pairs[is_tied]), asked.expected[own][is_tied], radius)
    (links + linker.find(_listed(pairs[~is_tied]))).save(work.path(stage, number))


@lru_cache(maxsize=1)
def _linker(work: Work) -> Linker:
    return Linker(Views(traced(work)))


def _listed(pairs: NDArray[np.int64]) -> list[Pair]:
    return [(int(first), int(second)) for first, second in pairs]


def registering(work: Work, dof: int | None, client: Any | None) -> Generator[Doing, None, tuple[Links, Poses]]:
    """Find which frames see the same place, and so where each lies, from traces that are there; yields how far that is.

    Parameters
    ----------
    work : Work
        With traces.
    dof : int, optional
        2 for shifts alone, 4 for turns and zoom as well; by default as the frames ask for.
    client : distributed.Client, optional
        Where to do it.
    """
    traces = traced(work)
    side, frames = min(work.bundle.shape), np.flatnonzero(traces.summary.shows)
    tried: set[Pair] = set()
    links, poses = Links.none(), solve_poses(Links.none(), len(traces), 2)
    rounds: list[tuple[str, Callable[[Poses], list[Pair]]]] = [
        *(("neighbours", partial(_at_gap, frames, gap)) for gap in _GAPS),
        ("meetings", partial(meetings, side=side)),
        *[("crossings", partial(crossings, side=side))] * _LOOP_ROUNDS,
    ]
    for number, (name, choose) in enumerate(rounds):
        stage, chosen = f"links-{number}", choose(poses)
        pairs = [pair for pair in chosen if pair not in tried]
        tried.update(pairs)
        work.begin(stage)
        asked = Asked.of(pairs, poses)
        asked.save(work.shared(stage))
        units = asked.units
        for _, left in complete(link_unit, stage, work, units, client):
            yield Doing(f"looking for {name}", number, len(rounds), left, len(units))
        for unit in units:
            links = links + Links.load(work.path(stage, unit))
        poses = solve_poses(links, len(traces), dof)
    # Images and spectra are not needed any more: some 300 MB, held by what refers to itself.
    _linker.cache_clear()
    gc.collect()
    return links, poses


def _at_gap(frames: NDArray[np.int64], gap: int, poses: Poses) -> list[Pair]:
    return list(neighbours(frames, [gap]))


def meetings(poses: Poses, side: float) -> list[Pair]:
    """Return pairs of frames of different pieces that may show the same place, though nothing says so.

    Of each of the largest pieces some frames that lie apart, and those before and after contact was lost.
    """
    placed = np.flatnonzero(poses.piece >= 0)
    gaps = np.flatnonzero(np.diff(poses.piece[placed])) + 1
    pairs = {
        (int(one), int(other))
        for gap in gaps
        for one in placed[max(0, gap - _ABOUT_A_GAP) : gap]
        for other in placed[gap : gap + _ABOUT_A_GAP]
    }
    chosen = []
    for piece in range(min(int(poses.piece.max(initial=-1)) + 1, _MOST_PIECES)):
        frames = np.flatnonzero(poses.piece == piece)
        kept = [int(frames[0])]
        for frame in frames.tolist():
            if np.abs(poses.place[frame] - poses.place[kept]).min() > _APART * side:
                kept.append(frame)
        chosen.append(kept[:: -(-len(kept) // _MOST_KEPT)])
    for first, second in combinations(chosen, 2):
        pairs.update((min(one, other), max(one, other)) for one in first for other in second)
    return sorted(pairs)


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


def expected(poses: Poses, pairs: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return how pairs (L, 2) of frames lie on one another by their poses, (L, 4) as in `Links`."""
    first, second = pairs.T
    turn = poses.turn[second] / poses.turn[first]
    place = (poses.place[second] - poses.place[first]) / poses.turn[first]
    return np.stack([turn.real, turn.imag, place.real, place.imag], axis=1)
