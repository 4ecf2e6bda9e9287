"""Where frames lie, by how pairs of them are shifted."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.sparse.linalg import spsolve

# A pair counts by this power of its correlation, because what is hardly alike is often taken for something else; in so
# many rounds less, the more it misses beyond so many times the median.
_CERTAINTY, _ROUNDS, _USUAL = 4, 6, 2.0


@dataclass(frozen=True, slots=True, eq=False)
class CoarseShifts:
    """Where each frame lies, by shifts alone.

    Attributes
    ----------
    shifts : numpy.ndarray
        (T, 2) pixels, frame to scene.
    confidence : numpy.ndarray
        (T,) correlation, 0 to 1, of the pair that ties a frame to the others.
    connected : numpy.ndarray
        (T,) bool, frames that are tied to the best-connected one.
    pairs : int
        How many pairs of these are alike.
    travel : float
        Root mean square of how far the frames of a pair lie apart, pixels.
    missed : float
        By how much the median pair is shifted otherwise, pixels.
    """

    shifts: NDArray[np.float64]
    confidence: NDArray[np.float64]
    connected: NDArray[np.bool_]
    pairs: int
    travel: float
    missed: float


def placed(
    scores: NDArray[np.float64], is_alike: NDArray[np.bool_], pairwise: NDArray[np.float64], spacing: float
) -> CoarseShifts:
    """Place frames where pairs that are alike say.

    The tree of the best pairs tells which frames belong together. Each of its pairs is off by a part of the spacing,
    and a tree is a long way round from one end of a burst to the other, so all pairs tell together where frames lie.

    Parameters
    ----------
    scores : numpy.ndarray
        (T, T), how alike the frames of a pair are, 0 to 1.
    is_alike : numpy.ndarray
        (T, T) bool, pairs that show the same thing.
    pairwise : numpy.ndarray
        (T, T, 2), from frame j's pixels to frame i's.
    spacing : float
        Pixels, how coarse these are.
    """
    count = len(scores)
    root = int(np.argmax(np.median(scores, axis=1)))
    tree = minimum_spanning_tree(csr_array(np.where(is_alike, 2 - scores, 0)))
    order, before = breadth_first_order(tree, root, directed=False)
    connected, trust, shifts = np.zeros(count, dtype=bool), np.zeros(count), np.zeros((count, 2))
    connected[order] = True
    for frame in order[1:]:
        shifts[frame] = shifts[before[frame]] + pairwise[before[frame], frame]
        trust[frame] = scores[before[frame], frame]
    trust[root] = trust.max()
    first, second = np.nonzero(np.triu(is_alike & connected & connected[:, None], 1))
    others = order[1:]
    if len(others):
        place = np.full(count, -1)
        place[others] = np.arange(len(others))
        lead, certainty = pairwise[first, second], scores[first, second] ** _CERTAINTY
        weights = certainty
        for _ in range(_ROUNDS):
            shifts[others] = _by_pairs(place[first], place[second], lead, weights, len(others))
            missed = np.hypot(*(shifts[second] - shifts[first] - lead).T)
            usual = max(spacing, _USUAL * float(np.median(missed)))
            weights = certainty / (1 + (missed / usual) ** 2) ** 2
    apart = shifts[second] - shifts[first]
    return CoarseShifts(
        shifts=shifts,
        confidence=trust,
        connected=connected,
        pairs=len(first),
        travel=float(np.sqrt(np.square(apart).sum(axis=1).mean())) if len(first) else 0.0,
        missed=float(np.median(np.hypot(*(apart - pairwise[first, second]).T))) if len(first) else 0.0,
    )


def _by_pairs(
    first: NDArray[np.intp],
    second: NDArray[np.intp],
    lead: NDArray[np.float64],
    weights: NDArray[np.float64],
    count: int,
) -> NDArray[np.float64]:
    """Return the shifts (n, 2) that lead best from the first of each pair to its second; the frame -1 lies at 0."""
    rows = np.arange(len(lead))
    design = csr_array((len(lead), count))
    for frames, sign in ((first, -1.0), (second, 1.0)):
        known = frames >= 0
        design = design + csr_array((np.full(known.sum(), sign), (rows[known], frames[known])), design.shape)
    weighted = design.T @ diags_array(weights)
    return np.asarray(spsolve((weighted @ design).tocsc(), weighted @ lead)).reshape(count, 2)
