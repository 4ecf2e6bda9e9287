"""One Gauss-Newton step of a joint registration: the normal equations of scene, motion, gains and exposures.

The gains are eliminated. No sample has two, so their block D of the normal equations is diagonal, and with C, what they
share with all others, the step in these solves (A - C D^-1 C') x = b - C D^-1 c, the Schur complement (Golub and Van
Loan, "Matrix computations", section 3.2). A product with it costs as much as one with the whole, and half as many of
them are enough: the slowest to settle is what scene and gains share.
"""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from napari_fiberburst.motion.displacement import ControlWeights
from napari_fiberburst.motion.problem import JointProblem, JointState, Level
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.cg import Blocks, conjugate_gradients
from napari_fiberburst.operators.jacobian import ControlSlopes, GainSlopes, GeneratorSlopes, JointJacobian
from napari_fiberburst.operators.priors import MEMBRANE, THIN_PLATE

# In medians of the residuals: larger ones count less (Huber, 1964).
_HUBER = 2.5
# Gains that are held so are as good as fixed.
_LEAST_GAIN_VARIANCE = 1e-12
# Relative variance by which an iteration may change an exposure: lamps and contact change by some tens of per cent, and
# the exposures are known to some per cent before the first.
_EXPOSURE_VARIANCE = 0.01
# Elastic prior of displacements: curvature from control point to control point, pixels (1 sigma), and how much less a
# displacement itself is held back.
_CURVATURE, _RIDGE = 1.8, 1e-3
# Of conjugate gradients: iterations at most, and the relative error at which they end. A Gauss-Newton step is only
# right to first order, so solving it further gains nothing; displacements go through more levels instead.
_ITERATIONS, _BENDING_ITERATIONS, _TOLERANCE = 12, 8, 1e-2


class MotionTerm(Protocol):
    """The motion's part of the normal equations beside the samples': its prior, and a preconditioner."""

    def prior(self, steps: Tensor) -> Tensor:
        """Return the prior's matrix times steps."""
        ...

    @property
    def pull(self) -> Tensor | float:
        """The prior's negative gradient where the motion stands."""
        ...

    def precondition(self, steps: Tensor) -> Tensor:
        """Return steps multiplied by the inverse of the diagonal's blocks."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class RigidTerm:
    """Generators, damped as by Levenberg and Marquardt.

    Attributes
    ----------
    damping : Tensor
        (T, k).
    inverse : Tensor
        (T, k, k), of each frame's block.
    """

    damping: Tensor
    inverse: Tensor
    pull: float = 0.0

    @classmethod
    def of(cls, slopes: GeneratorSlopes, weights: Tensor, damping: float) -> "RigidTerm":
        """Return the term for samples of these slopes and weights (T, N)."""
        weighted = slopes.slopes * weights.unsqueeze(1)
        blocks = (weighted @ slopes.slopes.mT).cpu().double()
        sizes = blocks.diagonal(dim1=1, dim2=2)
        floor = sizes * damping + sizes.mean() * 1e-6 + 1e-12
        return cls(floor.to(weights), torch.linalg.inv(blocks + torch.diag_embed(floor)).to(weights))

    def prior(self, steps: Tensor) -> Tensor:
        """Return the damping of steps (T, k)."""
        return self.damping * steps

    def precondition(self, steps: Tensor) -> Tensor:
        """Return steps (T, k) by the inverse of each frame's block."""
        return (self.inverse @ steps.unsqueeze(-1)).squeeze(-1)


@dataclass(frozen=True, slots=True, eq=False)
class ElasticTerm:
    """Control points of displacements (T, 2, M), held by their curvature.

    Attributes
    ----------
    control : Tensor
        (T, 2, M), where they stand.
    shape : (int, int)
        Rows and columns of control points.
    weight : float
        Of the curvature.
    inverse : Tensor
        (T, M, 2, 2), of each control point's block.
    """

    control: Tensor
    shape: tuple[int, int]
    weight: float
    inverse: Tensor

    @classmethod
    def of(
        cls,
        slopes: ControlSlopes,
        controls: ControlWeights,
        weights: Tensor,
        control: Tensor,
        shape: tuple[int, int],
        variance: float,
    ) -> "ElasticTerm":
        """Return the term for samples of these slopes and weights (T, N), and residuals of this variance."""
        weight = max(variance, 1e-9) / _CURVATURE**2
        x, y = slopes.along_x, slopes.along_y
        xx, xy, yy = controls.normal_diagonal(weights * torch.stack([x * x, x * y, y * y])).unbind(dim=0)
        floor = weight * (THIN_PLATE.diagonal + _RIDGE)
        blocks = torch.stack([torch.stack([xx + floor, xy], dim=-1), torch.stack([xy, yy + floor], dim=-1)], dim=-1)
        return cls(control, shape, weight, torch.linalg.inv(blocks))

    def prior(self, steps: Tensor) -> Tensor:
        """Return the prior's matrix times steps (T, 2, M)."""
        plates = THIN_PLATE(steps.reshape(*steps.shape[:2], *self.shape)).flatten(2)
        return self.weight * (plates + _RIDGE * steps)

    @property
    def pull(self) -> Tensor:
        """What draws the displacements back to none."""
        return -self.prior(self.control)

    def precondition(self, steps: Tensor) -> Tensor:
        """Return steps (T, 2, M) by the inverse of each control point's block."""
        return (self.inverse @ steps.mT.unsqueeze(-1)).squeeze(-1).mT


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearised:
    """The normal equations of one iteration, J'WJ + priors, in the changes of scene, motion, gains and exposures."""

    jacobian: JointJacobian
    gains: GainSlopes
    motion: MotionTerm
    weights: Tensor
    residual: Tensor
    variance: float
    gain_change: Tensor  # (G,), how far each gain is from 1
    gain_prior: float
    exposure_prior: float
    gains_fixed: bool
    smoothness: float
    iterations: int

    @classmethod
    def of(cls, problem: JointProblem, state: JointState, level: Level, damping: float) -> "Linearised":
        """Linearise at a state."""
        jacobian, gains = linearise(problem, state, level)
        residual, weights, variance = residuals(problem, jacobian)
        return cls(
            jacobian=jacobian,
            gains=gains,
            motion=_motion_term(problem, state, jacobian, weights, damping, variance),
            weights=weights,
            residual=residual,
            variance=variance,
            gain_change=state.gains - 1,
            # With noise of this variance, and gains of theirs about 1, the gains' prior weighs as much as this.
            gain_prior=max(variance / max(problem.gain_variance, _LEAST_GAIN_VARIANCE), 1e-9),
            exposure_prior=max(variance / _EXPOSURE_VARIANCE, 1e-9),
            gains_fixed=problem.gain_variance == 0,
            smoothness=level.smoothness,
            iterations=_BENDING_ITERATIONS if level.bends else _ITERATIONS,
        )

    def solve(self) -> Blocks:
        """Return the changes of scene, motion and log exposures; the gains are known once these are."""
        jacobian, weights = self.jacobian, self.weights
        weighted = weights * self.residual
        if not self.gains_fixed:
            follow = 1 / (self.gains.normal_diagonal(weights) + self.gain_prior)
            pull = self.gains.adjoint(weighted) - self.gain_prior * self.gain_change
            weighted = weighted - weights * self.gains(follow * pull)
        scene, motion, exposures = jacobian.adjoint(weighted)
        scene_diagonal = jacobian.sampling.normal_diagonal(weights * jacobian.factors**2)
        scene_inverse = 1 / (scene_diagonal + MEMBRANE.diagonal * self.smoothness)
        exposure_inverse = 1 / ((weights * jacobian.values**2).sum(dim=1) + self.exposure_prior)

        def multiply(blocks: Blocks) -> Blocks:
            scene, motion, exposures = blocks
            change = weights * jacobian(blocks)
            if not self.gains_fixed:
                change -= weights * self.gains(follow * self.gains.adjoint(change))
            to_scene, to_motion, to_exposures = jacobian.adjoint(change)
            return (
                to_scene + self.smoothness * MEMBRANE(scene),
                to_motion + self.motion.prior(motion),
                to_exposures + self.exposure_prior * exposures,
            )

        def precondition(blocks: Blocks) -> Blocks:
            scene, motion, exposures = blocks
            return scene * scene_inverse, self.motion.precondition(motion), exposures * exposure_inverse

        return conjugate_gradients(
            multiply,
            (scene, motion + self.motion.pull, exposures),
            precondition,
            iterations=self.iterations,
            tolerance=_TOLERANCE,
        )


def linearise(problem: JointProblem, state: JointState, level: Level) -> tuple[JointJacobian, GainSlopes]:
    """Return the Jacobian of `predict` in scene, motion (as the level moves it) and log exposures, and in gains."""
    points = problem.points(state.motion)
    sampling, filtered = state.grid.at(points), state.filtered
    factors = state.exposures[:, None] * state.gains[problem.core_index]
    light, along_x, along_y = sampling.with_slopes(filtered)
    along_x, along_y = along_x * factors, along_y * factors
    motion: GeneratorSlopes | ControlSlopes
    if level.bends and problem.controls is not None:
        motion = ControlSlopes(along_x, along_y, problem.controls)
    else:
        motion = GeneratorSlopes(state.motion.slopes(points, along_x, along_y, min(level.dof, problem.dof)))
    jacobian = JointJacobian(
        sampling=sampling, footprint=state.footprint, factors=factors, values=factors * light, motion=motion
    )
    return jacobian, GainSlopes(state.exposures[:, None] * light, problem.core_index, problem.cores)


def _motion_term(
    problem: JointProblem,
    state: JointState,
    jacobian: JointJacobian,
    weights: Tensor,
    damping: float,
    variance: float,
) -> MotionTerm:
    displacement = state.motion.displacement
    if isinstance(jacobian.motion, ControlSlopes) and problem.controls is not None and displacement is not None:
        return ElasticTerm.of(
            jacobian.motion, problem.controls, weights, displacement.control, displacement.grid.shape, variance
        )
    assert isinstance(jacobian.motion, GeneratorSlopes)
    return RigidTerm.of(jacobian.motion, weights, damping)


def residuals(problem: JointProblem, jacobian: JointJacobian) -> tuple[Tensor, Tensor, float]:
    """Return what the model leaves (T, N), how much it counts, large residuals less, and its variance."""
    residual = problem.values - jacobian.values
    weights = problem.weights * jacobian.sampling.inside
    weights = weights * huber(residual, weights)
    return residual, weights, float(steady.weighted_mean(residual**2, weights))


def huber(residual: Tensor, weights: Tensor) -> Tensor:
    """Return the weights of Huber's loss, its threshold set by the median of the residuals that count."""
    sizes = residual.abs()
    counted = sizes[weights > 0]
    threshold = _HUBER * counted.median() if counted.numel() else sizes.new_tensor(1.0)
    return (threshold / sizes.clamp_min(1e-9)).clamp(max=1)
