"""The derivative of what samples see, in all that is unknown about it at once."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from napari_fiberburst.operators.cg import Blocks
from napari_fiberburst.operators.footprint import Footprint
from napari_fiberburst.operators.grid import Sampling


class Operator(Protocol):
    """A linear operator and its adjoint."""

    def __call__(self, values: Tensor, /) -> Tensor:
        """Return A x."""
        ...

    def adjoint(self, values: Tensor, /) -> Tensor:
        """Return A' y."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class GeneratorSlopes:
    """How samples (T, N) change as frames move along the generators of their model, (T, k).

    Attributes
    ----------
    slopes : Tensor
        (T, k, N), contiguous: products of rows with it are several times as fast as with columns.
    """

    slopes: Tensor

    def __call__(self, steps: Tensor) -> Tensor:
        """Return how the samples change by steps (T, k)."""
        return (steps.unsqueeze(1) @ self.slopes).squeeze(1)

    def adjoint(self, values: Tensor) -> Tensor:
        """Return the adjoint of values (T, N): (T, k)."""
        return (values.unsqueeze(1) @ self.slopes.mT).squeeze(1)


@dataclass(frozen=True, slots=True, eq=False)
class ControlSlopes:
    """How samples (T, N) change as the control points of each frame's displacement move, (T, 2, M).

    Attributes
    ----------
    along_x, along_y : Tensor
        (T, N), slopes of the samples in the scene.
    weights : Operator
        From control points (..., M) to samples (..., N), the same for all frames.
    """

    along_x: Tensor
    along_y: Tensor
    weights: Operator

    def __call__(self, steps: Tensor) -> Tensor:
        """Return how the samples change by steps (T, 2, M)."""
        x, y = self.weights(steps).unbind(dim=1)
        return self.along_x * x + self.along_y * y

    def adjoint(self, values: Tensor) -> Tensor:
        """Return the adjoint of values (T, N): (T, 2, M)."""
        return self.weights.adjoint(torch.stack([values * self.along_x, values * self.along_y], dim=1))


@dataclass(frozen=True, slots=True, eq=False)
class GainSlopes:
    """How samples (T, N) change with the gains of their cores, (G,).

    Attributes
    ----------
    light : Tensor
        (T, N), what the samples are at gain 1.
    core_index : Tensor
        (N,) int64, which of the gains each sample has.
    cores : int
        G.
    """

    light: Tensor
    core_index: Tensor
    cores: int

    def __call__(self, gains: Tensor) -> Tensor:
        """Return how the samples change by changes of the gains (G,)."""
        return self.light * gains[self.core_index]

    def adjoint(self, values: Tensor) -> Tensor:
        """Return the adjoint of values (T, N): (G,)."""
        return self._per_core(self.light * values)

    def normal_diagonal(self, weights: Tensor) -> Tensor:
        """Return the diagonal of A' W A, (G,), which is all of it; W are weights (T, N)."""
        return self._per_core(weights * self.light**2)

    def _per_core(self, values: Tensor) -> Tensor:
        return torch.zeros(self.cores).to(values).index_add_(0, self.core_index, values.sum(dim=0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointJacobian:
    """The Jacobian of v_tn = a_t g_n (B s)(T_t x_n) in scene s, motion T and exposures a.

    Blocks are the changes of the scene (H, W), of the motion as `motion` takes it, and of the logarithms of the
    exposures (T,); samples are (T, N). Those of the gains are `GainSlopes`.

    Attributes
    ----------
    sampling : Sampling
        At the points T_t x_n, (T, N).
    footprint : Footprint or None
        B; None for points.
    factors : Tensor
        (T, N), a_t g_n.
    values : Tensor
        (T, N), v_tn.
    motion : GeneratorSlopes or ControlSlopes
        Of v_tn.
    """

    sampling: Sampling
    footprint: Footprint | None
    factors: Tensor
    values: Tensor
    motion: GeneratorSlopes | ControlSlopes

    def __call__(self, blocks: Blocks) -> Tensor:
        """Return how the samples change."""
        scene, motion, exposures = blocks
        filtered = scene if self.footprint is None else self.footprint(scene)
        change = self.motion(motion).addcmul_(self.factors, self.sampling(filtered))
        return change.addcmul_(self.values, exposures[:, None])

    def adjoint(self, values: Tensor) -> Blocks:
        """Return the adjoint's scene, motion and exposures."""
        scene = self.sampling.adjoint(values * self.factors)
        scene = scene if self.footprint is None else self.footprint.adjoint(scene)
        return scene, self.motion.adjoint(values), (values * self.values).sum(dim=1)
