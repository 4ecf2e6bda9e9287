"""The derivative of what samples see, in all that is unknown about it at once."""

from dataclasses import dataclass

import torch
from torch import Tensor

from napari_fiberburst.operators.cg import Blocks
from napari_fiberburst.operators.footprint import Footprint
from napari_fiberburst.operators.grid import Sampling


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointJacobian:
    """The Jacobian of v_tn = a_t g_n (B s)(T_t x_n) in scene s, motion T, gains g and exposures a.

    Blocks are the changes of the scene (H, W), of the motion (T, k) along the generators of its model, of the gains
    (G,), and of the logarithms of the exposures (T,); samples are (T, N).

    Attributes
    ----------
    sampling : Sampling
        At the points T_t x_n, (T, N).
    footprint : Footprint or None
        B; None for points.
    gains : Tensor
        (N,) g_n, of each sample.
    exposures : Tensor
        (T,) a_t.
    light : Tensor
        (T, N), a_t (B s)(T_t x_n).
    slopes : Tensor
        (T, N, k), a_t g_n times the slope of B s along each generator.
    core_index : Tensor
        (N,) int64, which of the gains each sample has.
    cores : int
        G.
    """

    sampling: Sampling
    footprint: Footprint | None
    gains: Tensor
    exposures: Tensor
    light: Tensor
    slopes: Tensor
    core_index: Tensor
    cores: int

    def __call__(self, blocks: Blocks) -> Tensor:
        """Return how the samples change."""
        scene, motion, gains, exposures = blocks
        filtered = scene if self.footprint is None else self.footprint(scene)
        change = self.factors * self.sampling(filtered) + (self.slopes @ motion.unsqueeze(-1)).squeeze(-1)
        return change + self.light * (gains[self.core_index] + self.gains * exposures[:, None])

    def adjoint(self, values: Tensor) -> Blocks:
        """Return the adjoint's scene, motion, gains and exposures."""
        scene = self.sampling.adjoint(values * self.factors)
        scene = scene if self.footprint is None else self.footprint.adjoint(scene)
        motion = (self.slopes.mT @ values.unsqueeze(-1)).squeeze(-1)
        through = values * self.light
        return scene, motion, self.per_core(through), through @ self.gains

    @property
    def factors(self) -> Tensor:
        """(T, N), a_t g_n."""
        return self.exposures[:, None] * self.gains

    def per_core(self, values: Tensor) -> Tensor:
        """Return the sum of values (T, N) over the samples of each core, (G,)."""
        return torch.zeros(self.cores).to(values).index_add_(0, self.core_index, values.sum(dim=0))
