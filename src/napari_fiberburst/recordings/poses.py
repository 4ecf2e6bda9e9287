"""Where every frame of a recording lies, from the links between pairs of them: one sparse least-squares solution."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, diags_array, hstack
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from napari_fiberburst.recordings.links import Links

Complex = NDArray[np.complex128]
# Links whose ends miss one another by more than the scale count less (Cauchy). It is lowered from round to round, in
# pixels, so that a long chain can close before what remains apart is taken for a false link (Black and Rangarajan, "On
# the unification of line processes", International Journal of Computer Vision 19, 1996).
_SCALES = tuple(np.geomspace(30.0, 1.0, 12)) + (1.0,) * 4
# A link that counts less than this in the end is false.
_LEAST_TRUST = 0.1
# Frames that are so much alike show the same place beyond doubt, where they have this part of the usual in common: two
# narrow strips are alike by chance.
_SURELY_ALIKE, _LEAST_COMMON = 0.6, 0.25
# Turns and zooms are believed where they lower the links' mean square error by more than this for each unknown that
# they cost. Independent noise would lower it by one; that of links which share frames lowers it by up to four, and
# turns of a degree by hundreds.
_WORTH = 8.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Poses:
    """Where frames lie.

    Attributes
    ----------
    turn : numpy.ndarray
        (T,) complex128: the point p of a frame, x + i y pixels from its middle, lies at ``turn p + place``.
    place : numpy.ndarray
        (T,) complex128.
    piece : numpy.ndarray
        (T,) int: frames of one number are tied to one another; -1 for a frame that is tied to none.
    trust : numpy.ndarray
        (L,) 0 to 1, how much each link counts in the end.
    error : numpy.ndarray
        (L,) by how much the ends of each link miss one another, root mean square, pixels.
    dof : int
        2 where frames are only shifted, 4 where they turn and grow as well.
    """

    turn: Complex
    place: Complex
    piece: NDArray[np.int64]
    trust: NDArray[np.float64]
    error: NDArray[np.float64]
    dof: int

    def matrices(self, middle: tuple[float, float]) -> NDArray[np.float64]:
        """Return (T, 3, 3): pixel of a frame whose middle is at (x, y) to the pixel of the mosaic, (x, y)."""
        centre = complex(*middle)
        # The middle of a piece's first frame lies where it is in that frame.
        shift = self.place + centre - self.turn * centre
        found = np.zeros((len(self.turn), 3, 3))
        found[:, 0, 0] = found[:, 1, 1] = self.turn.real
        found[:, 1, 0], found[:, 0, 1] = self.turn.imag, -self.turn.imag
        found[:, 0, 2], found[:, 1, 2], found[:, 2, 2] = shift.real, shift.imag, 1
        return found


def solve_poses(links: Links, count: int, dof: int | None = None) -> Poses:
    """Find where frames lie from how pairs of them lie on one another.

    Parameters
    ----------
    links : Links
        Pairs.
    count : int
        Number of frames.
    dof : int, optional
        2 or 4; by default 4 where that explains the links better than chance.
    """
    if dof is not None:
        return _solve(links, count, dof)
    shifted, turned = (_solve(links, count, unknowns) for unknowns in (2, 4))
    placed = int((turned.piece >= 0).sum())
    if not len(links) or not placed:
        return shifted
    told = (turned.trust > _LEAST_TRUST) & (shifted.trust > _LEAST_TRUST)
    if told.mean() < 0.5:  # shifts alone explain hardly any link
        return turned
    # Both as mean squares of the four numbers that each link tells.
    left_by_shifts, left_by_turns = (float(np.sum(found.error[told] ** 2)) for found in (shifted, turned))
    freedom = max(1.0, 2.0 * told.sum() - 2 * placed)
    gained = (left_by_shifts - left_by_turns) / (2 * placed)
    return turned if gained > _WORTH * left_by_turns / freedom else shifted


def _solve(links: Links, count: int, dof: int) -> Poses:
    equations = _Equations(links, count, dof)
    trust = np.ones(len(links))
    turn, place = np.ones(count, complex), np.zeros(count, complex)
    error = np.zeros(len(links))
    for scale in _SCALES if len(links) else ():
        turn, place = equations.solve(trust)
        error = equations.error(turn, place)
        trust = 1 / (1 + (error / scale) ** 2)
    piece = pieces(links.where(trust > _LEAST_TRUST), count)
    return Poses(turn=turn, place=place, piece=piece, trust=trust, error=error, dof=dof)


def pieces(links: Links, count: int) -> NDArray[np.int64]:
    """Return the piece that each frame belongs to (T,), the largest first; -1 for frames that are tied to none.

    A link by which frames are alike beyond doubt ties them; others do where there are two or more between the same
    pieces, because where nothing is in common some shift is always a little alike.
    """
    common = links.reach.prod(axis=1)
    usual = float(np.median(common)) if len(links) else 0.0
    sure = (links.alike >= _SURELY_ALIKE) & (common >= _LEAST_COMMON * usual)
    label = _tied(links.pairs[sure], count)
    while True:
        ends = np.sort(label[links.pairs[~sure]], axis=1)
        between, number = np.unique(ends[ends[:, 0] != ends[:, 1]], axis=0, return_counts=True)
        between = between[number >= 2]
        if not len(between):
            break
        label = _tied(between, int(label.max(initial=0)) + 1)[label]
    sizes = np.bincount(label)
    order = np.argsort(-sizes, kind="stable")
    rank = np.empty(len(sizes), np.int64)
    rank[order] = np.arange(len(sizes))
    return np.where(sizes[label] > 1, rank[label], -1)


def _tied(pairs: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return the connected part that each of so many things belongs to."""
    graph = csr_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)


class _Equations:
    """The links as linear equations: two points on each axis of what a pair sees in common, seen from both frames.

    With points as complex numbers a similarity is ``turn p + place``, so where frame j's p and frame i's q are the same
    point, ``turn_j p + place_j - turn_i q - place_i = 0``: linear in all unknowns.
    """

    def __init__(self, links: Links, count: int, dof: int) -> None:
        self._links, self._count, self._dof = links, count, dof
        a, b, x, y = links.similarity.T
        middle, reach = links.middle @ [1, 1j], links.reach
        self._here = middle[:, None] + np.stack(
            [reach[:, 0], -reach[:, 0], 1j * reach[:, 1], -1j * reach[:, 1]], axis=1
        )
        self._there = (a + 1j * b)[:, None] * self._here + (x + 1j * y)[:, None]
        alike = links.alike.clip(0, 0.999) ** 2
        self._weight = alike / (1 - alike) * reach.prod(axis=1)
        self._weight /= max(float(np.median(self._weight)), 1e-12) if len(links) else 1.0

    def solve(self, trust: NDArray[np.float64]) -> tuple[Complex, Complex]:
        """Return turns and places (T,); the first frame of each piece, and frames without links, lie as they are."""
        count, rows = self._count, np.arange(4 * len(self._links))
        first, second = (np.repeat(side, 4) for side in self._links.pairs.T)
        here, there = self._here.ravel(), self._there.ravel()
        one = np.ones_like(here)
        weight = np.repeat(self._weight * trust, 4)
        # Of those links that are believed now: a piece that only false ones tie would shrink to nothing, because all
        # that its links miss shrinks with it.
        piece = pieces(self._links.where(trust > _LEAST_TRUST), count)
        roots, lone = np.unique(piece, return_index=True)[1], np.flatnonzero(piece < 0)
        places = csc_array(
            (np.concatenate([one, -one]), (np.tile(rows, 2), np.concatenate([second, first]))),
            shape=(len(rows), count),
        )
        if self._dof == 2:
            solution = self._least_squares(places, there - here, weight, roots, lone)
            return np.ones(count, complex), solution
        turns = csc_array(
            (np.concatenate([here, -there]), (np.tile(rows, 2), np.concatenate([second, first]))),
            shape=(len(rows), count),
        )
        # About 1, so that what is fixed is 0 and what little is asked of frames without links draws them there.
        fixed, free = (np.concatenate([some, some + count]) for some in (roots, lone))
        solution = self._least_squares(csc_array(hstack([turns, places])), there - here, weight, fixed, free)
        return 1 + solution[:count], solution[count:]

    def _least_squares(
        self,
        matrix: csc_array,
        rhs: Complex,
        weight: NDArray[np.float64],
        fixed: NDArray[np.int64],
        lone: NDArray[np.int64],
    ) -> Complex:
        scaled = diags_array(weight) @ matrix
        normal = matrix.conj().T @ scaled
        diagonal = normal.diagonal().real
        # Frames of no piece may be tied to nothing: a trace of a tie keeps the matrix regular. Others need none, and a
        # long chain is so weak that it would give way to one.
        most = max(float(diagonal.max()), 1.0)
        ridge = np.zeros(len(diagonal))
        ridge[lone] = 1e-12 * most
        # Nothing else holds a piece as a whole, so that any weight holds it exactly; a large one would cost digits.
        ridge[fixed] = most
        solution: Complex = splu(csc_array(normal + diags_array(ridge))).solve(scaled.conj().T @ rhs)
        return solution

    def error(self, turn: Complex, place: Complex) -> NDArray[np.float64]:
        """Return by how much the ends of each link miss one another, (L,)."""
        first, second = self._links.pairs.T
        missed = turn[second, None] * self._here + place[second, None]
        missed -= turn[first, None] * self._there + place[first, None]
        error: NDArray[np.float64] = np.sqrt(np.mean(np.abs(missed) ** 2, axis=1))
        return error
