"""What a joint registration is about, where it stands, and the levels that it goes through."""

from dataclasses import dataclass, replace

from torch import Tensor

from napari_fiberburst.bundle.bundle import GUESSED_GAINS
from napari_fiberburst.motion.displacement import ControlWeights
from napari_fiberburst.motion.models import FrameMotion
from napari_fiberburst.operators.footprint import Footprint
from napari_fiberburst.operators.grid import Grid

# Levenberg-Marquardt damping, relative to the diagonal, that is always there.
LEAST_DAMPING = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """One level of the way from coarse to fine; lengths in pitches.

    Attributes
    ----------
    spacing : float
        Between the scene's nodes.
    smoothness : float
        Weight of the membrane prior on the change of the scene.
    iterations : int
        At most.
    dof : int
        Generators that move, at most.
    bends : bool
        Whether the control points of the frames' displacements move, instead of their generators.
    damping, decay : float
        Levenberg-Marquardt damping of the motion, relative, in the first iteration, and its factor from one to the
        next.
    """

    spacing: float
    smoothness: float
    iterations: int
    dof: int = 8
    bends: bool = False
    damping: float = LEAST_DAMPING
    decay: float = 1.0


# From a coarse shift to within some tenths of a pixel in shift, rotation and scale. The strong damping of the first
# iterations holds back what is hardly known before the shifts are right.
COARSE = Level(spacing=0.7, smoothness=3.0, iterations=9, dof=4, damping=0.2, decay=0.6)
# From there to a tenth of a pixel, shear and perspective too.
FINER = (
    Level(spacing=0.7, smoothness=1.0, iterations=6, damping=0.1, decay=0.5),
    Level(spacing=0.4, smoothness=0.3, iterations=5),
)
# And to some hundredths of a pixel, with the samples' own footprint in the model.
FINE_CORES = (Level(spacing=0.3, smoothness=0.1, iterations=3), Level(spacing=0.22, smoothness=0.03, iterations=2))
FINE_PIXELS = (Level(spacing=0.25, smoothness=0.1, iterations=2), Level(spacing=0.18, smoothness=0.03, iterations=2))
# Frames that bend, once their homographies are known. The scene is coarse at first: that reaches farther, and a fine
# one would take up what the displacement still misses, so that the residuals told nothing of it. With scenes of 0.6
# pitch at first, displacements of 6 pixels (root mean square) are missed by 3 pixels instead of 0.5.
BENDING = tuple(
    Level(spacing=spacing, smoothness=smoothness, iterations=iterations, bends=True)
    for spacing, smoothness, iterations in (
        (2.2, 3.0, 4),
        (1.5, 2.0, 3),
        (1.0, 1.0, 3),
        (0.6, 0.5, 4),
        (0.4, 0.3, 3),
        (0.25, 0.1, 2),
    )
)
# In pitches: between control points of a displacement.
CONTROL_SPACING = 5.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointProblem:
    """What a joint registration is about, which none of its iterations changes.

    Attributes
    ----------
    positions : Tensor
        (N, 2), where the samples are taken, frame pixels.
    values, weights : Tensor
        (T, N) intensities, about 1, and how much each counts; 0 leaves a sample out.
    core_index : Tensor
        (N,) int64: samples of one core share one gain.
    cores : int
        G, how many cores there are.
    pitch : float
        Unit of the levels' lengths, pixels.
    dof : int
        Degrees of freedom of each frame's motion.
    gain_variance : float
        Of the gains about 1, as far as it is known beforehand; 0 where they stay as they are.
    controls : ControlWeights or None
        From the control points of displacements to the samples; None where frames do not bend.
    places : Tensor or None
        (T,) int64, the place that the bundle has in each frame, where it moves on the camera.
    """

    positions: Tensor
    values: Tensor
    weights: Tensor
    core_index: Tensor
    cores: int
    pitch: float
    dof: int
    gain_variance: float = GUESSED_GAINS
    controls: ControlWeights | None = None
    places: Tensor | None = None

    def without(self, frames: Tensor) -> "JointProblem":
        """Return the problem without the frames that are marked, (T,) bool."""
        return replace(self, weights=self.weights * (~frames).to(self.weights)[:, None])

    def points(self, motion: FrameMotion) -> Tensor:
        """Return where the samples lie in the scene, (T, N, 2)."""
        return motion.apply(self.positions, self.controls)

    def grid(self, motion: FrameMotion, spacing: float) -> Grid:
        """Return a grid over all that frames with weight see, its nodes so many pitches apart."""
        points = self.points(motion)[(self.weights > 0).any(dim=1)][:, (self.weights > 0).any(dim=0)]
        return Grid.around(points, spacing * self.pitch, 2 * self.pitch)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointState:
    """Where a joint registration stands.

    Attributes
    ----------
    motion : FrameMotion
        Of the frames.
    grid : Grid
        Of the scene.
    scene : Tensor
        (H, W) on `grid`.
    gains : Tensor
        (G,), one per core.
    exposures : Tensor
        (T,), one per frame.
    footprint : Footprint or None
        Of the samples, at this level; None for points.
    residual : float
        Root of the weighted mean square of what the model leaves, as of the last iteration; NaN before the first.
    """

    motion: FrameMotion
    grid: Grid
    scene: Tensor
    gains: Tensor
    exposures: Tensor
    footprint: Footprint | None = None
    residual: float = float("nan")

    @property
    def filtered(self) -> Tensor:
        """The scene as samples see it, B s."""
        return self.scene if self.footprint is None else self.footprint(self.scene)
