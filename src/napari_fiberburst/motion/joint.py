"""Joint registration: scene, motion, gains and exposures of all frames solved together, by Gauss-Newton.

Each sample n, at a fixed place x_n of the frame, has a gain g_n and sees the scene s, through its footprint B, where
frame t's transform T_t takes it, at that frame's exposure a_t:

    v_tn = a_t g_n (B s)(T_t x_n) + noise

Every iteration linearises this in (s, T, g, log a) at once and solves the normal equations by conjugate gradients, with
a membrane prior on the change of s. Alternating between scene, motion and gains takes many times the iterations,
because each hides the errors of the others. The joint iteration finds rotation and perspective from a coarse shift, and
tells a core's gain from the scene behind it.

Some changes no sample shows. One factor may go from the scene to all gains or exposures; and a scene that is brighter
by exp(c p) at the place p looks the same where gains fall by exp(-c x), and exposures by what the frames' shifts make
of it. So the exposures have the geometric mean 1, the gains the median 1 and no slope over the field.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from napari_fiberburst.motion.models import FrameMotion
from napari_fiberburst.operators.cg import Blocks, conjugate_gradients
from napari_fiberburst.operators.filters import blur
from napari_fiberburst.operators.footprint import Footprint
from napari_fiberburst.operators.grid import Grid, Sampling
from napari_fiberburst.operators.jacobian import JointJacobian
from napari_fiberburst.operators.priors import MEMBRANE

# In medians of the residuals: larger ones count less (Huber, 1964).
_HUBER = 2.5
# Variance of the gains about 1 that is expected a priori: bundles measured have 15 to 20 % (1 sigma).
_GAIN_VARIANCE = 0.04
# Relative variance by which an iteration may change an exposure: lamps and contact change by some tens of per cent, and
# the exposures are known to some per cent before the first.
_EXPOSURE_VARIANCE = 0.01
# Relative standard deviation of exposures below which they are taken as one.
_LEAST_FLICKER = 3e-4
# Relative change of the gains from the middle of the field to its edge that the most even bundle may have.
_UNEVENNESS = 0.02
# Alternations of scene and exposures before the first iteration.
_EXPOSURE_ROUNDS = 8
# A gain further from 1 than this factor is not believed.
_LARGEST_GAIN = 50.0
# Levenberg-Marquardt damping, relative to the diagonal, that is always there.
_LEAST_DAMPING = 1e-3
# Of conjugate gradients: iterations at most, and the relative error at which they end. A Gauss-Newton step is only
# right to first order, so solving it further gains nothing.
_CG_ITERATIONS, _CG_TOLERANCE = 24, 1e-2


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
    damping, decay : float
        Levenberg-Marquardt damping of the motion, relative, in the first iteration, and its factor from one to the
        next.
    """

    spacing: float
    smoothness: float
    iterations: int
    dof: int = 8
    damping: float = _LEAST_DAMPING
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
    gains_fixed : bool
        Whether the gains stay as they are because the transmission is known.
    """

    positions: Tensor
    values: Tensor
    weights: Tensor
    core_index: Tensor
    cores: int
    pitch: float
    dof: int
    gains_fixed: bool = False

    def without(self, frames: Tensor) -> "JointProblem":
        """Return the problem without the frames that are marked, (T,) bool."""
        return replace(self, weights=self.weights * (~frames).to(self.weights)[:, None])

    def points(self, motion: FrameMotion) -> Tensor:
        """Return where the samples lie in the scene, (T, N, 2)."""
        return motion.apply(self.positions)

    def grid(self, motion: FrameMotion, spacing: float) -> Grid:
        """Return a grid over all that frames with weight see, its nodes so many pitches apart."""
        positions = self.positions[(self.weights > 0).any(dim=0)]
        points = motion.apply(positions)[(self.weights > 0).any(dim=1)]
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


def start(problem: JointProblem, motion: FrameMotion) -> JointState:
    """Return the state before the first iteration, all gains 1: exposures and scene by the frames as they lie.

    A frame's exposure is its light relative to the mean of all frames where it overlaps them, which changes in turn.
    """
    grid = problem.grid(motion, COARSE.spacing)
    sampling = grid.at(problem.points(motion))
    weights = problem.weights * sampling.inside
    exposures = torch.ones(len(weights)).to(weights)
    for _ in range(_EXPOSURE_ROUNDS):
        nodes = _mean_scene(problem, sampling, exposures)
        light = sampling(nodes)
        agreement, power = ((weights * part).sum(dim=1) for part in (problem.values * light, light**2))
        exposures = torch.where(agreement > 0, agreement / power.clamp_min(1e-12), exposures)
        exposures = exposures / _common_exposure(problem, exposures)
    gains = torch.ones(problem.cores, dtype=weights.dtype, device=weights.device)
    nodes = _mean_scene(problem, sampling, exposures)
    return JointState(motion=motion, grid=grid, scene=nodes, gains=gains, exposures=exposures)


def _mean_scene(problem: JointProblem, sampling: Sampling, exposures: Tensor) -> Tensor:
    """Return the mean of the frames as they lie, each brought to exposure 1."""
    values, weights = problem.values / exposures[:, None], problem.weights * exposures[:, None] ** 2
    return scattered_mean(sampling, values, weights, 1.0 / COARSE.spacing)


def _common_exposure(problem: JointProblem, exposures: Tensor) -> Tensor:
    """Return the geometric mean of the exposures of frames with weight."""
    used = (problem.weights > 0).any(dim=1)
    return exposures[used].log().mean().exp() if bool(used.any()) else exposures.new_tensor(1.0)


def enter(problem: JointProblem, state: JointState, level: Level, radius: float | None) -> JointState:
    """Return the state carried over to a level's grid; `radius` is of the footprint, pixels, None for points."""
    grid = problem.grid(state.motion, level.spacing)
    device = problem.positions.device
    scene = state.grid.at(grid.nodes(device))(state.scene)
    footprint = None if radius is None else Footprint(grid, radius, device)
    moved = replace(state, grid=grid, scene=scene, footprint=footprint)
    light = grid.at(problem.points(moved.motion))(moved.filtered) * moved.exposures[:, None]
    brightness = (problem.weights * light * problem.values).sum() / (problem.weights * light**2).sum()
    return replace(moved, scene=scene * float(brightness))


def iterate(problem: JointProblem, state: JointState, level: Level, number: int) -> tuple[JointState, float]:
    """Do one Gauss-Newton iteration.

    Parameters
    ----------
    problem, state
        Of which, and from where.
    level : Level
        That was entered.
    number : int
        Iterations done at this level.

    Returns
    -------
    JointState, float
        The new state, and the largest displacement of a frame's centre, pixels.
    """
    damping = max(level.damping * level.decay**number, _LEAST_DAMPING)
    system = _Linearised.of(problem, state, level.smoothness, min(level.dof, problem.dof), damping)
    scene, steps, _, log_exposures = system.solve()
    moved = replace(
        state,
        motion=state.motion.moved(steps),
        scene=state.scene + scene,
        exposures=state.exposures * log_exposures.clamp(-1, 1).exp(),
        residual=float(system.variance**0.5),
    )
    if not problem.gains_fixed:
        moved = _level(problem, _with_best_gains(problem, moved, system.gain_prior))
    return moved, state.motion.travel(steps)


def normalise(problem: JointProblem, state: JointState) -> JointState:
    """Return the state with what all gains, and all exposures, have in common moved into the scene."""
    measured = torch.bincount(problem.core_index, minlength=problem.cores) > 0
    common = state.gains[measured].median()
    exposure = _common_exposure(problem, state.exposures)
    return replace(
        state, gains=state.gains / common, exposures=state.exposures / exposure, scene=state.scene * common * exposure
    )


def _level(problem: JointProblem, state: JointState) -> JointState:
    """Return the state with that slope of the gains over the field moved into scene and exposures which is none.

    A bundle is nearly even, so its gains have hardly any slope. Where the exposures vary no more than what is left of
    it makes of them, they are the same for all frames, which tells the slope better.
    """
    device, count = problem.positions.device, problem.cores
    mass = torch.bincount(problem.core_index, minlength=count).to(problem.positions)
    places = torch.zeros(count, 2, device=device).index_add_(0, problem.core_index, problem.positions)
    places = places / mass.clamp_min(1)[:, None]
    measured = mass > 0
    middle = places[measured].mean(dim=0)
    used = (problem.weights > 0).any(dim=1)
    centres = state.motion.apply(middle[None])[:, 0]
    slope = _slope(
        (places[measured] - middle).cpu().double(),
        state.gains[measured].log().cpu().double(),
        (centres - middle)[used].cpu().double(),
        state.exposures[used].log().cpu().double(),
    ).to(places)
    return replace(
        state,
        gains=state.gains * torch.exp(-(places - middle) @ slope),
        exposures=state.exposures * torch.exp(-(centres - middle) @ slope),
        scene=state.scene * torch.exp((state.grid.nodes(device) - middle) @ slope),
    )


def _slope(places: Tensor, log_gains: Tensor, shifts: Tensor, log_exposures: Tensor) -> Tensor:
    """Return the slope (2,) that is to be moved out of the gains (G,), at places (G, 2), and exposures (T,)."""
    log_gains, log_exposures, shifts = (part - part.mean(dim=0) for part in (log_gains, log_exposures, shifts))
    information = places.T @ places + 1e-9 * torch.eye(2).double()
    by_gains = torch.linalg.solve(information, places.T @ log_gains)
    covariance = torch.linalg.inv(information) * (log_gains - places @ by_gains).square().mean()
    half = places.abs().amax().clamp_min(1.0)
    information = torch.linalg.inv(covariance + (_UNEVENNESS / half) ** 2 * torch.eye(2).double())
    left = log_exposures - shifts @ by_gains
    by_chance = (shifts @ torch.linalg.inv(information) * shifts).sum()
    variance = ((left.square().sum() - by_chance) / max(1, len(left) - 1)).clamp_min(_LEAST_FLICKER**2)
    moments = shifts.T @ shifts / variance
    slope: Tensor = by_gains + torch.linalg.solve(information + moments, shifts.T @ left / variance)
    return slope


def predict(problem: JointProblem, state: JointState) -> Tensor:
    """Return what the model says of the values, (T, N)."""
    light = state.grid.at(problem.points(state.motion))(state.filtered)
    return state.exposures[:, None] * light * state.gains[problem.core_index]


def scattered_mean(sampling: Sampling, values: Tensor, weights: Tensor, sigma: float) -> Tensor:
    """Return the local mean (H, W) of scattered values, over a Gaussian of `sigma` nodes and wider where none is."""
    total = torch.stack([sampling.adjoint(values * weights), sampling.adjoint(weights)])
    near = blur(total, sigma)
    far = blur(near, 3 * sigma)
    everywhere = total[0].sum() / total[1].sum().clamp_min(1e-12)
    faint = 1e-3 * near[1].mean() + 1e-12
    filled = (far[0] + faint * everywhere) / (far[1] + faint)
    return (near[0] + faint * filled) / (near[1] + faint)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Linearised:
    """The normal equations of one iteration, J'WJ + priors, in the changes of scene, motion, gains and exposures."""

    jacobian: JointJacobian
    weights: Tensor
    residual: Tensor
    variance: float
    gain_change: Tensor  # (G,), how far each gain is from 1
    gain_prior: float
    exposure_prior: float
    gains_fixed: bool
    smoothness: float
    damping: Tensor  # (T, k)
    motion_inverse: Tensor  # (T, k, k)

    @classmethod
    def of(cls, problem: JointProblem, state: JointState, smoothness: float, dof: int, damping: float) -> "_Linearised":
        """Linearise at a state."""
        jacobian = linearise(problem, state, dof)
        residual = problem.values - jacobian.gains * jacobian.light
        weights = problem.weights * jacobian.sampling.inside
        weights = weights * _huber(residual, weights)
        variance = float((weights * residual**2).sum() / weights.sum().clamp_min(1e-12))
        weighted = jacobian.slopes * weights.unsqueeze(-1)
        blocks = (weighted.mT @ jacobian.slopes).cpu().double()
        sizes = blocks.diagonal(dim1=1, dim2=2)
        floor = sizes * damping + sizes.mean() * 1e-6 + 1e-12
        return cls(
            jacobian=jacobian,
            weights=weights,
            residual=residual,
            variance=variance,
            gain_change=state.gains - 1,
            # With noise of this variance, and gains of theirs about 1, the gains' prior weighs as much as this.
            gain_prior=max(variance / _GAIN_VARIANCE, 1e-9),
            exposure_prior=max(variance / _EXPOSURE_VARIANCE, 1e-9),
            gains_fixed=problem.gains_fixed,
            smoothness=smoothness,
            damping=floor.to(weights),
            motion_inverse=torch.linalg.inv(blocks + torch.diag_embed(floor)).to(weights),
        )

    def solve(self) -> Blocks:
        """Return the changes of scene, motion, gains and log exposures."""
        jacobian, weights = self.jacobian, self.weights
        scene, motion, gains, exposures = jacobian.adjoint(weights * self.residual)
        scene_diagonal = jacobian.sampling.normal_diagonal(weights * jacobian.factors**2)
        scene_inverse = 1 / (scene_diagonal + MEMBRANE.diagonal * self.smoothness)
        gain_inverse = 1 / (jacobian.per_core(weights * jacobian.light**2) + self.gain_prior)
        if self.gains_fixed:
            gain_inverse = torch.zeros_like(gain_inverse)
        power = (weights * (jacobian.gains * jacobian.light) ** 2).sum(dim=1)
        exposure_inverse = 1 / (power + self.exposure_prior)

        def precondition(blocks: Blocks) -> Blocks:
            scene, motion, gains, exposures = blocks
            moved = (self.motion_inverse @ motion.unsqueeze(-1)).squeeze(-1)
            return scene * scene_inverse, moved, gains * gain_inverse, exposures * exposure_inverse

        return conjugate_gradients(
            self._multiply,
            (scene, motion, gains - self.gain_prior * self.gain_change, exposures),
            precondition,
            iterations=_CG_ITERATIONS,
            tolerance=_CG_TOLERANCE,
        )

    def _multiply(self, blocks: Blocks) -> Blocks:
        scene, motion, gains, exposures = blocks
        to_scene, to_motion, to_gains, to_exposures = self.jacobian.adjoint(self.weights * self.jacobian(blocks))
        return (
            to_scene + self.smoothness * MEMBRANE(scene),
            to_motion + self.damping * motion,
            to_gains + self.gain_prior * gains,
            to_exposures + self.exposure_prior * exposures,
        )


def linearise(problem: JointProblem, state: JointState, dof: int) -> JointJacobian:
    """Return the Jacobian of `predict` in scene, motion, gains and log exposures."""
    points = problem.points(state.motion)
    sampling, filtered = state.grid.at(points), state.filtered
    gains = state.gains[problem.core_index]
    slope_x, slope_y = sampling.gradient(filtered)
    along_x, along_y = state.motion.tangent(points, dof)
    slopes = slope_x.unsqueeze(-1) * along_x + slope_y.unsqueeze(-1) * along_y
    return JointJacobian(
        sampling=sampling,
        footprint=state.footprint,
        gains=gains,
        exposures=state.exposures,
        light=state.exposures[:, None] * sampling(filtered),
        slopes=slopes * (state.exposures[:, None] * gains).unsqueeze(-1),
        core_index=problem.core_index,
        cores=problem.cores,
    )


def _with_best_gains(problem: JointProblem, state: JointState, prior: float) -> JointState:
    """Return the state with the best gains for scene and motion as they are.

    The joint step leaves out the product of two changes, which can be large where a gain is hardly known.
    """
    sampling = state.grid.at(problem.points(state.motion))
    light = state.exposures[:, None] * sampling(state.filtered)
    weights = problem.weights * sampling.inside
    weights = weights * _huber(problem.values - state.gains[problem.core_index] * light, weights)
    agreement, power = (
        torch.zeros_like(state.gains).index_add_(0, problem.core_index, part.sum(dim=0))
        for part in (weights * problem.values * light, weights * light**2)
    )
    gains = (agreement + prior) / (power + prior)
    return replace(state, gains=gains.clamp(1 / _LARGEST_GAIN, _LARGEST_GAIN))


def _huber(residual: Tensor, weights: Tensor) -> Tensor:
    """Return the weights of Huber's loss, its threshold set by the median of the residuals that count."""
    sizes = residual.abs()
    counted = sizes[weights > 0]
    threshold = _HUBER * counted.median() if counted.numel() else sizes.new_tensor(1.0)
    return (threshold / sizes.clamp_min(1e-9)).clamp(max=1)
