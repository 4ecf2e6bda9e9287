"""How much freedom the motion of frames needs: translations, similarities, affine transforms, or all of a homography.

A Wald test (1943). Each frame's transform is exp(r) G: a member G of the smaller model, and r along the generators that
the model lacks. With I the information of the samples on all generators, S is what it leaves on r once G has followed,
its Schur complement. Where frames do not need r, the sum of r' S r over them is about the number of parameters in r,
times what the scene's own noise adds. What all frames have in common is the scene's shape, and no motion.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from napari_fiberburst.coordinates import half_frame_from_pixel
from napari_fiberburst.motion.linearised import linearise, residuals
from napari_fiberburst.motion.models import FrameMotion, generators
from napari_fiberburst.motion.problem import FINER, JointProblem, JointState
from napari_fiberburst.operators.jacobian import GeneratorSlopes

# Degrees of freedom of the models that are tried, from the smallest.
_MODELS = (2, 4, 6)
# The smaller model is enough where r' S r is at most so many times the number of parameters. Where it is true, bursts
# of 12 frames and more have 3 to 16, because the frames share a scene that is not known better than they are, and
# smaller ones more. Where it is not, the faintest have 19.
_ENOUGH = 12.0
# Fewer frames do not tell.
_FEWEST_FRAMES = 3
# Splitting a transform goes on until r changes by no more than this, in half frames.
_ROUNDS, _SPLIT = 30, 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Restriction:
    """The motion within a smaller model.

    Attributes
    ----------
    dof : int
        Degrees of freedom.
    motion : FrameMotion
        Of all frames; those without weight are as they were.
    shape : Tensor
        (3, 3) float64, pixel of the new scene to pixel of the old one.
    """

    dof: int
    motion: FrameMotion
    shape: Tensor

    def scene(self, state: JointState) -> Tensor:
        """Return the scene of a state in its new shape, on the same grid, (H, W)."""
        shape = FrameMotion(self.shape[None], self.motion.shape)
        nodes = state.grid.nodes(state.scene.device)
        return state.grid.at(shape.apply(nodes.reshape(-1, 2))[0].reshape(nodes.shape))(state.scene)


def restrict(problem: JointProblem, state: JointState) -> Restriction | None:
    """Return the motion in the smallest model that explains it; None where it needs all that the problem gives it.

    Parameters
    ----------
    problem, state
        Of a registration that has converged, without displacements.
    """
    used = (problem.weights > 0).any(dim=1).cpu()
    if int(used.sum()) < _FEWEST_FRAMES:
        return None
    information = _information(problem, state)[used]
    homographies = state.motion.scene_from_frame[used]
    half = torch.from_numpy(half_frame_from_pixel(state.motion.shape))
    frames = half @ homographies @ torch.linalg.inv(half)
    frames = frames / torch.linalg.det(frames).abs().pow(1 / 3)[:, None, None]
    basis = generators(problem.dof)
    for dof in _MODELS:
        if dof >= problem.dof:
            break
        own = information[:, :dof, :dof] + 1e-9 * torch.eye(dof).double()
        follow = torch.linalg.solve(own, information[:, :dof, dof:])
        schur = information[:, dof:, dof:] - information[:, dof:, :dof] @ follow
        beyond, _ = _split(frames, basis, dof)
        whole = schur.sum(dim=0) + 1e-9 * torch.eye(problem.dof - dof).double()
        common = torch.linalg.solve(whole, torch.einsum("tij,tj->i", schur, beyond))
        shape = _exp(common[None], basis[dof:])[0]
        beyond, members = _split(torch.linalg.inv(shape) @ frames, basis, dof)
        need = float(torch.einsum("ti,tij,tj->", beyond, schur, beyond)) / ((len(beyond) - 1) * (problem.dof - dof))
        if need > _ENOUGH:
            continue
        members = _exp(torch.einsum("tij,tj->ti", follow, beyond), basis[:dof]) @ members
        matrices = state.motion.scene_from_frame.clone()
        matrices[used] = torch.linalg.inv(half) @ members @ half
        motion = replace(state.motion, scene_from_frame=matrices / matrices[:, 2:, 2:])
        return Restriction(dof, motion, torch.linalg.inv(half) @ shape @ half)
    return None


def _information(problem: JointProblem, state: JointState) -> Tensor:
    """Return the information on each frame's generators, (T, k, k) float64, by the variance of the residuals."""
    jacobian, _ = linearise(problem, state, FINER[-1])
    assert isinstance(jacobian.motion, GeneratorSlopes)
    _, weights, variance = residuals(problem, jacobian)
    slopes = jacobian.motion.slopes
    blocks = (slopes * weights[:, None]) @ slopes.mT
    return blocks.cpu().double() / max(variance, 1e-12)


def _split(transforms: Tensor, basis: Tensor, dof: int) -> tuple[Tensor, Tensor]:
    """Split transforms (T, 3, 3) into what goes beyond a smaller model, (T, k - dof), and members of that model."""
    beyond = torch.zeros(len(transforms), len(basis) - dof, dtype=torch.float64)
    for _ in range(_ROUNDS):
        step = _coordinates(_exp(-beyond, basis[dof:]) @ transforms)[:, dof : len(basis)]
        beyond = beyond + step
        if float(step.abs().max()) < _SPLIT:
            break
    return beyond, _exp(-beyond, basis[dof:]) @ transforms


def _coordinates(transforms: Tensor) -> Tensor:
    """Return functions (T, 8) of transforms (T, 3, 3) that are the generators' coordinates near the identity.

    Those beyond a model's degrees of freedom are 0 for its members, wherever these are.
    """
    rows = (transforms / transforms[:, 2:, 2:]).unbind(dim=1)
    (a, b, x), (c, d, y), (p, q, _) = (row.unbind(dim=1) for row in rows)
    return torch.stack([x, y, (c - b) / 2, (a + d) / 2 - 1, (a - d) / 2, (b + c) / 2, p, q], dim=1)


def _exp(steps: Tensor, basis: Tensor) -> Tensor:
    """Return the transforms (T, 3, 3) of steps (T, k) along generators (k, 3, 3)."""
    transforms: Tensor = torch.linalg.matrix_exp(torch.einsum("tk,kij->tij", steps, basis))
    return transforms
