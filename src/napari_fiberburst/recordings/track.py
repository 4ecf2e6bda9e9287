"""Track: where the frames of a recording lie, how bright they are, and what gains their cores have."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from napari_fiberburst.coordinates import transform_points
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.recordings.bending import basis
from napari_fiberburst.stored import Stored

# Points along each axis by which a plane is fitted to a frame that bends.
_FITTED = 16

Bounds = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Track(Stored):
    """Where the frames of a recording lie, and how bright they are.

    Attributes
    ----------
    scene_from_frame : numpy.ndarray
        (T, 3, 3) float64: pixel of a frame to pixel of the first frame of its piece, (x, y).
    piece : numpy.ndarray
        (T,) int: frames of one number lie on one scene; -1 for frames that could not be placed.
    exposures : numpy.ndarray
        (T,) float32, brightness of each frame relative to the others of its piece.
    gains : numpy.ndarray
        (N, C) float32, gain of each core relative to what the traces assume.
    weights : numpy.ndarray
        (T,) float32, 0 to 1, how much each frame counts: those that fit worse than others count less.
    alike : numpy.ndarray
        (T,) correlation of what each frame shows with the scene that all of them have made, 0 to 1; NaN while that is
        not known.
    error : float
        Root mean square of what the scene misses of samples, full scale 1; NaN while that is not known.
    shape : (int, int)
        Height and width of a frame.
    dof : int
        2 where frames are only shifted, 4 where they turn and grow as well, 6 where they are stretched, too.
    gain_weights : numpy.ndarray
        (N,) float32, how much light the gains rest on, full scale 1: 0 for those that the frames have not told.
    control : numpy.ndarray or None
        (T, 2, M) how frames bend beyond that: displacements of control points along x and y, pixels of the scene; None
        where they do not.
    """

    _kind: ClassVar[str] = "track"

    scene_from_frame: NDArray[np.float64]
    piece: NDArray[np.int64]
    exposures: NDArray[np.float32]
    gains: NDArray[np.float32]
    weights: NDArray[np.float32]
    alike: NDArray[np.float64]
    error: float
    shape: tuple[int, int]
    dof: int
    gain_weights: NDArray[np.float32]
    control: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return len(self.piece)

    @property
    def pieces(self) -> int:
        """How many scenes there are, each with at least two frames."""
        return int(self.piece.max(initial=-1)) + 1

    def anchored(self) -> "Track":
        """Return the track with the scene of each piece in the pixels of its first frame, which refining leaves.

        By a similarity about the middle of that frame: how the one frame is stretched and bent is not the scene's.
        """
        matrices = self.scene_from_frame.copy()
        control = None if self.control is None else self.control.copy()
        for piece in range(self.pieces):
            frames = self.frames_of(piece)
            if not len(frames):
                continue
            back = self._back_from(int(frames[0]))
            matrices[frames] = back @ matrices[frames]
            if control is not None:
                control[frames] = back[:2, :2].astype(np.float32) @ control[frames]
        return replace(self, scene_from_frame=matrices, control=control)

    def _back_from(self, number: int) -> NDArray[np.float64]:
        """Return the similarity (3, 3) that takes the middle of a frame back to where it is in the frame, upright."""
        (a, b, _), (c, d, _), _ = self.scene_from_frame[number]
        middle = (np.array(self.shape[::-1]) - 1) / 2
        back = np.eye(3)
        back[:2, :2] = np.linalg.inv([[(a + d) / 2, (b - c) / 2], [(c - b) / 2, (a + d) / 2]])
        back[:2, 2] = middle - back[:2, :2] @ self.corners(np.array([number]))[0].mean(axis=0)
        return back

    def points(self, numbers: NDArray[np.int64], positions: Tensor) -> Tensor:
        """Return where positions (N, 2) of frames lie in their scene, (n, N, 2)."""
        matrices = torch.from_numpy(self.scene_from_frame[numbers]).to(positions.dtype)
        places: Tensor = transform_points(matrices, positions)
        if self.control is None:
            return places
        control = torch.from_numpy(self.control[numbers])
        return places + (control @ basis(self.shape, positions).T).mT

    def planes(self) -> NDArray[np.float64]:
        """Return the affine transforms (T, 3, 3) that are nearest to where frames lie, bent as they are."""
        if self.control is None:
            return self.scene_from_frame
        height, width = self.shape
        x, y = np.meshgrid(np.linspace(0, width - 1, _FITTED), np.linspace(0, height - 1, _FITTED))
        flat = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
        places = self.points(np.arange(len(self)), torch.from_numpy(flat[:, :2].astype(np.float32))).double().numpy()
        planes = self.scene_from_frame.copy()
        planes[:, :2] = np.einsum("kp,tpi->tik", np.linalg.pinv(flat), places)
        return planes

    def corners(self, numbers: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return where the outer pixels' centres of frames lie in their scene, (n, 4, 2)."""
        height, width = self.shape
        outer = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], dtype=np.float64)
        found: NDArray[np.float64] = transform_points(self.scene_from_frame[numbers], outer)
        return found

    def frames_of(self, piece: int) -> NDArray[np.int64]:
        """Return the numbers of a piece's frames."""
        return np.flatnonzero(self.piece == piece)

    def rarity(self, radius: float) -> NDArray[np.float64]:
        """Return one over how many frames (T,) of its piece lie within a radius of each, pixels, itself included.

        Sums that are weighed by it count each place once, however long the probe has rested there.
        """
        rarity = np.zeros(len(self))
        for piece in range(self.pieces):
            frames = self.frames_of(piece)
            middle = self.corners(frames).mean(axis=1)
            rarity[frames] = 1 / cKDTree(middle).query_ball_point(middle, radius, return_length=True)
        return rarity

    def spread(self, frames: NDArray[np.int64], count: int, radius: float) -> NDArray[np.int64]:
        """Return some of a piece's frames, about so many at most, evenly over the places where they lie."""
        passed = np.cumsum(self.rarity(radius)[frames])
        at = np.searchsorted(passed, np.linspace(0, passed[-1], count + 1)[1:] - passed[-1] / (2 * count))
        some: NDArray[np.int64] = frames[np.unique(at)]
        return some

    def bounds(self, piece: int) -> Bounds:
        """Return x0, y0, x1, y1 of all that a piece's frames see."""
        corners = self.corners(self.frames_of(piece)).reshape(-1, 2)
        (x0, y0), (x1, y1) = corners.min(axis=0), corners.max(axis=0)
        return float(x0), float(y0), float(x1), float(y1)

    def touching(self, grid: Grid, piece: int) -> NDArray[np.int64]:
        """Return the numbers of a piece's frames that see some of a grid."""
        frames = self.frames_of(piece)
        corners = self.corners(frames)
        rows, columns = grid.shape
        last = (grid.x0 + (columns - 1) * grid.spacing, grid.y0 + (rows - 1) * grid.spacing)
        low, high = corners.min(axis=1), corners.max(axis=1)
        touching: NDArray[np.bool_] = ((high >= (grid.x0, grid.y0)) & (low <= last)).all(axis=1)
        return frames[touching]
