"""Where the frames of a burst look: what a registration is."""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.coordinates import relative_to, transform_points
from napari_fiberburst.errors import SettingsError
from napari_fiberburst.motion.displacement import Displacement
from napari_fiberburst.motion.models import FrameMotion
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.stored import Stored

Stage = Literal["none", "shifts", "coarse", "fine", "complete"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GreyScene:
    """The scene as registration sees it, in grey.

    Attributes
    ----------
    grid : Grid
        Its nodes, in scene pixels.
    nodes : Tensor
        (H, W), relative to `light`.
    light : float
        The mean light of the samples, full scale 1.
    """

    grid: Grid
    nodes: Tensor
    light: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registration(Stored):
    """Where every frame of a burst looks, and how far to trust it.

    Attributes
    ----------
    scene_from_frame : numpy.ndarray
        (T, 3, 3) float64, frame-t pixel (x, y) to scene pixel.
    shape : (int, int)
        Height and width of a frame.
    used : numpy.ndarray
        (T,) bool, frames that take part. The others could not be registered.
    confidence : numpy.ndarray
        (T,) 0 to 1, how well each frame agrees with the others where they overlap; NaN while that is not known, and for
        frames that show nothing.
    frame_weights : numpy.ndarray
        (T,) 0 to 1, how much each frame counts: blurred ones fit worse, and count less.
    gains : numpy.ndarray
        (G,) float32, gain of each core relative to what the samples assume; 1 where none was looked for.
    exposures : numpy.ndarray
        (T,) float32, brightness of each frame relative to the others: their geometric mean is 1, of frames that take
        part.
    residual : float
        Root of the weighted mean square of what the model leaves of the samples, full scale 1; NaN before the first
        iteration.
    travel : float
        How far the frames' corners lie from where they are on average, root mean square, pixels; NaN while that is not
        known.
    unexplained : float
        Part of the samples' change from frame to frame that the model does not explain, as a ratio of root mean squares
        without the noise, 0 to 1; NaN while that is not known. It is below 0.2 where the registration has succeeded.
    is_still : bool
        Whether the object moves too little to fill the gaps between cores.
    stage : str
        How far it has come: "none", "shifts", "coarse", "fine" (shear and perspective too), or "complete".
    iterations : int
        Gauss-Newton iterations done.
    notes : tuple of str
        What a user should know.
    scene : GreyScene or None
        The scene that the frames were registered to.
    displacement : Displacement or None
        How frames bend beyond their homographies; None where they were not asked to.
    dof : int
        Degrees of freedom of each frame's transform: 0, 2 (translation), 4 (similarity), 6 (affine), 8 (homography).
    left_out : tuple of int
        Frames that were registered, and take no part because a user has left them out.
    copies : numpy.ndarray or None
        (K, 2) int64, frames that repeat another one, and that one: they lie where it lies, and take no part.
    """

    _kind: ClassVar[str] = "registration"

    scene_from_frame: NDArray[np.float64]
    shape: tuple[int, int]
    used: NDArray[np.bool_]
    confidence: NDArray[np.float64]
    frame_weights: NDArray[np.float32]
    gains: NDArray[np.float32]
    exposures: NDArray[np.float32]
    residual: float = float("nan")
    travel: float = float("nan")
    unexplained: float = float("nan")
    is_still: bool = False
    stage: Stage = "none"
    iterations: int = 0
    notes: tuple[str, ...] = ()
    scene: GreyScene | None = field(default=None, repr=False)
    displacement: Displacement | None = field(default=None, repr=False)
    dof: int = 8
    left_out: tuple[int, ...] = ()
    copies: NDArray[np.int64] | None = None

    @classmethod
    def known(cls, scene_from_frame: NDArray[np.float64], shape: tuple[int, int], cores: int) -> "Registration":
        """Return a registration for motion (T, 3, 3) that is known, such as a simulation's."""
        count = len(scene_from_frame)
        return cls(
            scene_from_frame=np.array(scene_from_frame, dtype=np.float64),
            shape=shape,
            used=np.ones(count, dtype=bool),
            confidence=np.ones(count),
            frame_weights=np.ones(count, np.float32),
            gains=np.ones(cores, np.float32),
            exposures=np.ones(count, np.float32),
            stage="complete",
        )

    @property
    def registered(self) -> NDArray[np.bool_]:
        """(T,) bool, frames whose place is known: that take part, that a user has left out, and copies of these."""
        registered = self.used.copy()
        registered[list(self.left_out)] = True
        if self.copies is not None:
            registered[self.copies[:, 0]] = registered[self.copies[:, 1]]
        return registered

    def with_copies(self, copies: NDArray[np.int64]) -> "Registration":
        """Return the registration with frames where those lie that they repeat; copies are (K, 2) as the attribute."""
        copy, original = copies.T
        matrices, exposures = self.scene_from_frame.copy(), self.exposures.copy()
        matrices[copy], exposures[copy] = matrices[original], exposures[original]
        displacement = self.displacement
        if displacement is not None:
            control = displacement.control.clone()
            control[torch.from_numpy(copy)] = control[torch.from_numpy(original)]
            displacement = Displacement(displacement.grid, control)
        return replace(self, scene_from_frame=matrices, exposures=exposures, displacement=displacement, copies=copies)

    @property
    def reference(self) -> int:
        """The first registered frame: images and homographies are in its pixels, also where it was left out."""
        return int(np.flatnonzero(self.registered)[0])

    @property
    def reference_from_frame(self) -> NDArray[np.float64]:
        """(T, 3, 3), frame-t pixel to the reference frame's pixel; NaN for frames that are not registered."""
        relative = relative_to(self.scene_from_frame, self.reference)
        relative[~self.registered] = np.nan
        return relative

    def without(self, frames: Collection[int]) -> "Registration":
        """Return the registration with these frames left out: they lie where they lay, and count for nothing.

        Raises
        ------
        SettingsError
            There is no such frame, or none would take part any more.
        """
        count = len(self.used)
        if unknown := [frame for frame in frames if not 0 <= frame < count]:
            raise SettingsError(
                f"frames to leave out must be numbers from 0 to {count - 1}, as the burst has them; got {unknown}"
            )
        gone = np.zeros(count, dtype=bool)
        gone[list(frames)] = True
        gone &= self.used
        if not (self.used & ~gone).any():
            raise SettingsError("at least one registered frame must take part; leave fewer frames out")
        return replace(
            self,
            used=self.used & ~gone,
            frame_weights=np.where(gone, 0, self.frame_weights).astype(np.float32),
            left_out=tuple(sorted({*self.left_out, *np.flatnonzero(gone).tolist()})),
        )

    def points(self, positions: Tensor) -> Tensor:
        """Return where places (N, 2) of every frame lie in the reference frame's pixels, (T, N, 2); NaN if unknown."""
        if self.displacement is None:
            points: Tensor = transform_points(torch.from_numpy(self.reference_from_frame).to(positions), positions)
            return points
        points = self.motion.to_reference(self.motion.apply(positions), self.reference)
        return torch.where(torch.from_numpy(self.registered).to(points.device)[:, None, None], points, torch.nan)

    @property
    def motion(self) -> FrameMotion:
        """Frame pixels to scene pixels, as an operator on points."""
        return FrameMotion(torch.from_numpy(self.scene_from_frame), self.shape, self.displacement)

    def as_recorded(self, offsets: NDArray[np.float64]) -> "Registration":
        """Return the registration of the frames as they were before each was moved back by its offset.

        Parameters
        ----------
        offsets : numpy.ndarray
            (T, 2), pixels: what was at pixel x of a frame as registered had been recorded at x + offset. That of the
            reference frame is 0.
        """
        moved = self.scene_from_frame @ FrameMotion.of_shifts(-offsets, self.shape).scene_from_frame.numpy()
        displacement = None if self.displacement is None else self.displacement.moved(torch.from_numpy(offsets))
        return replace(self, scene_from_frame=moved, displacement=displacement)

    def correct(self, samples: Samples) -> Samples:
        """Return samples at gains and exposures of 1, and weighed by how far each frame is to be trusted.

        Parameters
        ----------
        samples : Samples
            Of the frames that were registered, by the bundle as it was before.
        """
        gains, exposures = (torch.from_numpy(part).to(samples.values) for part in (self.gains, self.exposures))
        frame_weights = torch.from_numpy(self.frame_weights)
        return samples.without_gains(gains).without_exposures(exposures).weighted(frame_weights)

    def predicted(self, number: int, pixels: Tensor) -> Tensor:
        """Return the grey light of the scene at pixels (N, 2) of frame `number`, as exposed; 0 where unknown."""
        if self.scene is None or not self.used[number]:
            return torch.zeros(len(pixels)).to(pixels)
        sampling = self.scene.grid.at(self.motion.of_frame(number).apply(pixels)[0])
        return sampling(self.scene.nodes) * (self.scene.light * float(self.exposures[number]))


def unregistered(samples: Samples) -> Registration:
    """Return the registration before anything is known: all frames lie on one another."""
    count = len(samples.values)
    return Registration(
        scene_from_frame=np.tile(np.eye(3), (count, 1, 1)),
        shape=samples.shape,
        used=np.ones(count, dtype=bool),
        confidence=np.full(count, np.nan),
        frame_weights=np.ones(count, np.float32),
        gains=np.ones(samples.cores, np.float32),
        exposures=np.ones(count, np.float32),
    )
