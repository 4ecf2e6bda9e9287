"""Long waves in the places of frames taken out, which scene and frames that are found in turn never correct.

Links miss by thousandths of a pixel, each to the same side, and over hundreds of frames that adds up: the whole picture
is stretched or bent, by tenths of a pixel to a field. A scene made of frames that lie so agrees with them. But a rigid
frame does not fit into a scene that is stretched, so each tells the strain of the scene where it lies: the derivatives
of the displacement by which the scene is wrong. One smooth displacement is fitted to the strains of all frames.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from napari_fiberburst.motion.step import MODELS
from napari_fiberburst.recordings.refine import Refinement
from napari_fiberburst.recordings.track import Track

# The displacement is a polynomial of so many degrees, of the place in halves of the piece's longer side.
_DEGREE = 4
# By so much each of its terms is expected to strain a scene, root mean square; what frames tell less surely stays.
_EXPECTED = 1e-3


def rectified(track: Track, parts: Sequence[Refinement]) -> Track:
    """Return the track with its scenes' smooth strains taken out, where frames are rigid or turn and grow.

    Frames that stretch themselves fit into any scene, and tell nothing.
    """
    if track.dof == MODELS[-1]:
        return track
    strain, certainty = np.zeros((len(track), 4)), np.zeros((len(track), 4))
    for part in parts:
        strain[part.frames], certainty[part.frames] = part.strain, part.certainty
    matrices = track.scene_from_frame.copy()
    for piece in range(track.pieces):
        frames = track.frames_of(piece)
        if not len(frames):
            continue
        back = _back(track.corners(frames).mean(axis=1), strain[frames], certainty[frames], is_rigid=track.dof == 2)
        matrices[frames] = back @ matrices[frames]
    return replace(track, scene_from_frame=matrices)


def _back(
    places: NDArray[np.float64], strain: NDArray[np.float64], certainty: NDArray[np.float64], *, is_rigid: bool
) -> NDArray[np.float64]:
    """Return what takes frames that lie at places (n, 2) to where they lie in a scene without strain (n, 4): (n, 3, 3).

    Frames that turn and grow have followed these two strains, and tell the stretches alone.
    """
    low, high = places.min(axis=0), places.max(axis=0)
    half = max(float((high - low).max()) / 2, 1.0)
    values, slopes = _polynomials((places - (low + high) / 2) / half)
    strains = _strains(slopes / half)
    told = slice(0 if is_rigid else 2, 4)
    weight = np.sqrt(certainty[:, told].ravel())
    prior = np.sqrt((strains**2).mean(axis=(0, 1))) / _EXPECTED
    terms = strains[:, told].reshape(len(weight), -1)
    rhs = np.concatenate([weight * strain[:, told].ravel(), np.zeros(len(prior))])
    coefficients = np.linalg.lstsq(np.concatenate([weight[:, None] * terms, np.diag(prior)]), rhs, rcond=None)[0]
    back = np.tile(np.eye(3), (len(places), 1, 1))
    if not is_rigid:
        grown, turned = (strains[:, :2] @ coefficients).T
        back[:, 0, 0] = back[:, 1, 1] = 1 - grown
        back[:, 1, 0], back[:, 0, 1] = -turned, turned
    moved = places - values @ coefficients.reshape(2, -1).T
    back[:, :2, 2] = moved - np.einsum("nij,nj->ni", back[:, :2, :2], places)
    return back


def _polynomials(places: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return polynomials (n, M) at places (n, 2), and their slopes along x and y, (n, 2, M); none is constant."""
    x, y = places.T[:, :, None]
    exponents = [(i, degree - i) for degree in range(1, _DEGREE + 1) for i in range(degree + 1)]
    i, j = np.array(exponents, dtype=np.float64).T
    slopes = np.stack([i * x ** np.maximum(i - 1, 0) * y**j, j * x**i * y ** np.maximum(j - 1, 0)], axis=1)
    return x**i * y**j, slopes


def _strains(slopes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what each coefficient of a displacement, along x and then along y, adds to the strains, (n, 4, 2M)."""
    along_x, along_y = slopes[:, 0], slopes[:, 1]
    pairs = ((along_x, along_y), (-along_y, along_x), (along_x, -along_y), (along_y, along_x))
    return np.stack([np.concatenate(pair, axis=1) / 2 for pair in pairs], axis=1)
