"""The scene as a linear spline, solved by conjugate gradients.

Given motion and gains, what sensors see is linear in the scene's nodes s, so the best scene solves

    (B S^T W S B + lambda P) s = B S^T W v

with S the interpolation at the samples' places, W their weights, B the footprint and P the smoothness prior. S^T W S
ties each node to its neighbours alone and is assembled once (`Stencil`), so a step of conjugate gradients costs the
same for ten frames and for a thousand.

Points take the membrane prior, of slopes; footprints the thin plate's, of curvature: it falls off faster beyond the
detail that is there, which undoing a blur needs.
"""

import math

import numpy as np
import torch
from torch import Tensor

from napari_fiberburst.geometry.footprint import Footprint
from napari_fiberburst.geometry.grid import Grid, Stencil, blur, roughness
from napari_fiberburst.optics.observation import Observation

_TOLERANCE = 1e-3
_FREQUENCIES = 33


class Normal:
    """The normal equations of an observation on a grid.

    Parameters
    ----------
    grid : Grid
        Where the scene's nodes are.
    radius : float or None
        Footprint of the sensors, pixels.
    channels : int
        C.
    device : torch.device
        Where.
    """

    def __init__(self, grid: Grid, radius: float | None, channels: int, device: torch.device) -> None:
        self.grid = grid
        self.footprint = None if radius is None else Footprint(grid, radius)
        self._order = 1 if radius is None else 2
        self.stencil = Stencil(torch.zeros(5, *grid.shape, device=device))
        self.light = torch.zeros(channels, *grid.shape, device=device)

    def add(self, points: Tensor, values: Tensor, weights: Tensor) -> None:
        """Add samples at points (N, 2) of values (N, C) and weights (N,)."""
        used = weights > 0
        at, values, weights = self.grid.at(points[used]), values[used], weights[used]
        self.stencil = self.stencil + at.normal(weights)
        for channel, light in zip(values.T, self.light, strict=True):
            light += at.write(channel * weights)

    def through(self, scene: Tensor) -> Tensor:
        """Return the scene (..., H, W) as sensors see it, by their footprint."""
        return scene if self.footprint is None else self.footprint(scene)

    def solve(self, smoothness: float, start: Tensor, iterations: int = 60) -> Tensor:
        """Return the scene (C, H, W), by conjugate gradients with the diagonal as preconditioner.

        Parameters
        ----------
        smoothness : float
            Weight of the prior, in samples of weight 1 to a square pixel; more is smoother.
        start : Tensor
            (C, H, W) to start from.
        iterations : int
            At most.
        """
        weight = smoothness / self.grid.spacing ** (2 * self._order - 2)
        diagonal = self.stencil.diagonal * (1.0 if self.footprint is None else self.footprint.power)
        if self.footprint is not None:
            diagonal = blur(diagonal, 1.0).clamp_min(0)
        inverse = 1 / (diagonal + weight * (4 if self._order == 1 else 20) + 1e-9)
        right = self.through(self.light)
        scene = start
        residual = right - self._multiply(scene, weight)
        search = inverse * residual
        power = (residual * search).sum(dim=(-1, -2), keepdim=True)
        enough = _TOLERANCE**2 * (right.square() * inverse).sum(dim=(-1, -2), keepdim=True)
        for number in range(iterations):
            product = self._multiply(search, weight)
            step = power / (search * product).sum(dim=(-1, -2), keepdim=True).clamp_min(1e-30)
            scene = scene + step * search
            residual = residual - step * product
            before, ready = power, inverse * residual
            power = (residual * ready).sum(dim=(-1, -2), keepdim=True)
            if number % 4 == 3 and bool((power <= enough).all()):  # looking makes the host wait for the device
                break
            search = ready + power / before.clamp_min(1e-30) * search
        return scene

    def mean(self) -> Tensor:
        """Return an even scene of the right brightness, (C, H, W)."""
        mass = self.stencil.bands[0].sum() + 2 * self.stencil.bands[1:].sum()
        level = self.light.sum(dim=(1, 2)) / mass.clamp_min(1e-12)
        return level[:, None, None].expand(-1, *self.grid.shape).clone()

    def density(self) -> Tensor:
        """Return the weight of samples per node, (H, W): what the stencil does to an even scene."""
        return self.stencil(torch.ones_like(self.stencil.diagonal))

    def deviation(self, smoothness: float, variance: float, most: float, reach: float) -> Tensor:
        """Return the posterior's standard deviation of the scene, (H, W), were sampling everywhere as it is nearby.

        Where samples of variance `variance` lie with the density c, every frequency f of the scene has the posterior
        variance `variance` / (c |B(f)|^2 + lambda P(f)); their sum depends on c alone. `most` bounds it by what is
        known of the scene without samples; `reach`, in pixels, is over what distance sampling is averaged.
        """
        weight = smoothness / self.grid.spacing ** (2 * self._order - 2)
        frequency = (torch.arange(_FREQUENCIES) + 0.5) / (2 * _FREQUENCIES)
        prior = (4 * torch.sin(math.pi * frequency) ** 2)[:, None] + (4 * torch.sin(math.pi * frequency) ** 2)[None, :]
        transfer = torch.ones_like(prior) if self.footprint is None else self.footprint.transfer(frequency) ** 2
        densities = torch.logspace(-4, 3, 57)
        table = (variance / (densities[:, None, None] * transfer + weight * prior**self._order)).mean(dim=(1, 2))
        density = blur(self.density(), reach / self.grid.spacing).clamp(1e-4, 1e3).cpu()
        deviation = np.interp(density.log10().numpy(), densities.log10().numpy(), table.sqrt().clamp(max=most).numpy())
        return torch.from_numpy(deviation).to(self.light)

    def _multiply(self, scene: Tensor, weight: float) -> Tensor:
        prior = roughness(scene) if self._order == 1 else roughness(roughness(scene))
        return self.through(self.stencil(self.through(scene))) + weight * prior


def assemble(grid: Grid, observation: Observation, points: Tensor, among: Tensor | None = None) -> Normal:
    """Return the normal equations of an observation whose sensors are at points (T, N, 2) of the scene.

    `among` (T, N) multiplies the weights: 0 leaves samples out.
    """
    normal = Normal(grid, observation.radius, observation.values.shape[2], points.device)
    for number, weights in enumerate(observation.weights):
        if bool((weights > 0).any()):
            chosen = weights if among is None else weights * among[number]
            normal.add(points[number], observation.values[number], chosen)
    return normal
