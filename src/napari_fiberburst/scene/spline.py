"""The scene as a linear spline, solved by conjugate gradients.

Given motion and gains, what cores (or pixels) see is linear in the scene's nodes s, so the best scene solves

    (B S^T W S B + lambda P) s = B S^T W v

with S the interpolation at the samples' places, W their weights, B the footprint and P the smoothness prior. S^T W S
ties each node to its neighbours alone and is assembled once (`Stencil`), so a step of conjugate gradients costs the
same for ten frames and for a thousand.

Points take the membrane prior, of slopes; footprints the thin plate's, of curvature: it falls off faster beyond the
detail that is there, which undoing a blur needs.

Between its nodes a linear spline falls short of a smooth image, so one that fits samples everywhere overshoots at
the nodes, by a fifth at a period of four. `NormalEquations.image` takes that out.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.operators import steady
from napari_fiberburst.operators.cg import Blocks, conjugate_gradients, inner_of_images
from napari_fiberburst.operators.filters import blur, filled_mean
from napari_fiberburst.operators.footprint import Footprint
from napari_fiberburst.operators.grid import Grid, PathSampling, Sampling
from napari_fiberburst.operators.priors import MEMBRANE, THIN_PLATE, SmoothnessPrior
from napari_fiberburst.operators.stencil import Stencil

# Relative error at which conjugate gradients end. It is relative to all the light, and most of that is in the local
# mean, which they start from. They find fine detail last: at 1e-3 it is still missing, which costs images up to 1.3 dB.
_TOLERANCE = 1e-4
_FREQUENCIES = 33
# So many samples are assembled at once: enough that calls cost little, and few enough for any memory.
_SAMPLES_TOGETHER = 200_000
# Nodes with less than this part of the densest sampling are beyond what was seen.
_LEAST_DENSITY = 0.05
# Where frames are dark and no sample has looked, a node weighs so many samples of no light: enough for the prior to let
# go within some pixels.
_DARK_WEIGHT = 0.02
# Nodes repeated beyond the edge, so that a filter finds no step there.
_RIM = 8


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """The normal equations of samples on a grid.

    Attributes
    ----------
    grid : Grid
        Where the scene's nodes are.
    radius : float or None
        Footprint of the samples, pixels; None for points.
    bands : Tensor
        (5, H, W), S^T W S as a `Stencil`.
    rhs : Tensor
        (C, H, W), S^T W v.
    paths : tuple
        Samples that looked along paths while a frame was exposed, and their weights: they tie together nodes that are
        no neighbours, so each product goes through them, and `bands` is of the middle of their paths. Empty for
        samples that stood still.
    """

    grid: Grid
    radius: float | None
    bands: Tensor
    rhs: Tensor
    paths: tuple[tuple[PathSampling, Tensor], ...] = ()

    @classmethod
    def empty(cls, grid: Grid, radius: float | None, channels: int, device: torch.device) -> "NormalEquations":
        """Return the equations of no samples."""
        return cls(
            grid, radius, torch.zeros(5, *grid.shape, device=device), torch.zeros(channels, *grid.shape, device=device)
        )

    def with_samples(self, points: Tensor, values: Tensor, weights: Tensor) -> "NormalEquations":
        """Return the equations with samples of values (..., C) and weights (...), at points (..., 2) or along paths.

        Paths are (..., K, 2).
        """
        used = weights > 0
        looks, values, weights = points[used], values[used], weights[used]
        sampling = self.grid.of_looks(looks)
        weights = weights * sampling.inside
        rhs = torch.stack(
            [light + sampling.adjoint(channel * weights) for channel, light in zip(values.T, self.rhs, strict=True)]
        )
        if isinstance(sampling, Sampling):
            return replace(self, bands=self.bands + sampling.normal(weights).bands, rhs=rhs)
        middle = self.grid.at(looks[:, looks.shape[1] // 2])
        paths = (*self.paths, (sampling, weights))
        return replace(self, bands=self.bands + middle.normal(weights).bands, rhs=rhs, paths=paths)

    def __add__(self, other: "NormalEquations") -> "NormalEquations":
        paths = (*self.paths, *other.paths)
        return replace(self, bands=self.bands + other.bands, rhs=self.rhs + other.rhs, paths=paths)

    def __sub__(self, other: "NormalEquations") -> "NormalEquations":
        """Forget samples that were added; those that looked along paths cannot be told apart any more."""
        return replace(self, bands=self.bands - other.bands, rhs=self.rhs - other.rhs)

    def include(self, part: "NormalEquations", nodes: tuple[slice, slice]) -> None:
        """Add, in place, samples that stood still on a part of this grid, of these rows and columns.

        Hundreds of frames of a wide scene each see little of it.
        """
        self.bands[:, *nodes] += part.bands
        self.rhs[:, *nodes] += part.rhs

    def on(self, grid: Grid) -> "NormalEquations":
        """Return the equations on another grid whose nodes lie at the same places, wider or narrower than this one.

        What nodes beyond the other grid are tied to is taken for 0.
        """
        offsets = ((self.grid.y0, grid.y0), (self.grid.x0, grid.x0))
        there, here = [], []
        for (mine, new), own, side in zip(offsets, self.grid.shape, grid.shape, strict=True):
            start = round((mine - new) / grid.spacing)
            first, last = max(0, start), max(0, start, min(side, start + own))
            there.append(slice(first, last))
            here.append(slice(first - start, last - start))
        bands, rhs = (part.new_zeros(len(part), *grid.shape) for part in (self.bands, self.rhs))
        bands[:, *there], rhs[:, *there] = self.bands[:, *here], self.rhs[:, *here]
        return replace(self, grid=grid, bands=bands, rhs=rhs)

    def darkened(self, dark: Tensor, reach: float) -> "NormalEquations":
        """Return the equations of a scene that is black where frames are dark and no sample has looked nearby.

        A thin plate goes on as it ends, so beyond the last samples it would rise into fog.

        Parameters
        ----------
        dark : Tensor
            (H, W) bool, nodes where frames are dark.
        reach : float
            Pixels, over what distance samples are near.
        """
        few = max(_LEAST_DENSITY * self._usual_density(), 1e-12)
        near = blur(self.density(), reach / self.grid.spacing) / few
        bands = self.bands.clone()
        bands[0] += _DARK_WEIGHT * dark.to(bands.device) * (1 - near).clamp_min(0)
        return replace(self, bands=bands)

    def without_paths(self) -> "NormalEquations":
        """Return the equations to keep once they are solved: of the middle of each path."""
        return replace(self, paths=())

    def normal(self, seen: Tensor) -> Tensor:
        """Return S^T W S times scenes (C, H, W) as samples see them through their footprint."""
        if not self.paths:
            return self.stencil(seen)
        return torch.stack([self._along_paths(channel) for channel in seen])

    def _along_paths(self, channel: Tensor) -> Tensor:
        total = torch.zeros_like(channel)
        for sampling, weights in self.paths:
            total += sampling.adjoint(weights * sampling(channel))
        return total

    @property
    def stencil(self) -> Stencil:
        """S^T W S."""
        return Stencil(self.bands)

    @property
    def footprint(self) -> Footprint | None:
        """B, the footprint of the samples; None for points."""
        if self.radius is None:
            return None
        # A filter is the same wherever the grid lies.
        return Footprint.cached(replace(self.grid, x0=0.0, y0=0.0), self.radius, self.rhs.device)

    @property
    def prior(self) -> SmoothnessPrior:
        """P: of slopes for points, of curvature for footprints."""
        return MEMBRANE if self.radius is None else THIN_PLATE

    def through(self, scene: Tensor) -> Tensor:
        """Return the scene (..., H, W) as samples see it through their footprint."""
        return scene if self.footprint is None else self.footprint(scene)

    def solve(self, smoothness: float, start: Tensor | None = None, iterations: int = 60) -> Tensor:
        """Return the scene (C, H, W), by conjugate gradients with the diagonal as preconditioner.

        Parameters
        ----------
        smoothness : float
            Weight of the prior, in samples of weight 1 to a square pixel; more is smoother.
        start : Tensor, optional
            (C, H, W) to start from; by default the local mean of the samples, which saves half of the iterations.
        iterations : int
            At most.
        """
        weight = self._weight(smoothness)
        diagonal = self.stencil.diagonal * (1.0 if self.footprint is None else self.footprint.power)
        if self.footprint is not None:
            diagonal = blur(diagonal, 1.0).clamp_min(0)
        inverse = 1 / (diagonal + weight * self.prior.diagonal + 1e-9)

        def multiply(blocks: Blocks) -> Blocks:
            (scene,) = blocks
            return (self.through(self.normal(self.through(scene))) + weight * self.prior(scene),)

        (scene,) = conjugate_gradients(
            multiply,
            (self.through(self.rhs),),
            lambda blocks: (inverse * blocks[0],),
            start=(self.local_mean() if start is None else start,),
            iterations=iterations,
            tolerance=_TOLERANCE,
            inner=inner_of_images,
        )
        return scene

    def image(self, scene: Tensor, smoothness: float) -> Tensor:
        """Return the smooth image that a solution (C, H, W) stands for, at the nodes.

        Reading a wave of frequency f by linear interpolation at the distance d from a node, as a part of the spacing,
        gives it the gain (1 - d) cos(2 pi f d) + d cos(2 pi f (1 - d)). Over all samples that has the mean R and the
        mean square A; with the footprint's response B and c samples to a node, the solution has c B R / (c B^2 A +
        lambda P) of the wave, where interpolation without loss would leave c B / (c B^2 + lambda P): the quotient is
        taken out. Without prior it is the filter of projecting onto linear splines, R / A (Unser, "Splines: a perfect
        fit", IEEE Signal Processing Magazine 16(6), 1999).

        Parameters
        ----------
        scene : Tensor
            As `solve` returns it.
        smoothness : float
            What it was solved with.
        """
        density = self.density()
        mean = self._usual_density()
        bands = torch.stack([steady.total(band) for band in self.stencil.bands])
        _, right, below, below_right, below_left = bands / steady.total(density).clamp_min(1e-12)
        ties = below_right + below_left
        along_y, along_x = _frequencies(scene)
        (square_y, gain_y), (square_x, gain_x) = _read_gain(along_y, below + ties), _read_gain(along_x, right + ties)
        square, gain = square_y[:, None] * square_x, gain_y[:, None] * gain_x
        passed = mean * self._transfer(along_y, along_x) ** 2
        prior = self._weight(smoothness) * self.prior.response(along_y, along_x)
        return _passed(scene, (passed * square + prior) / (gain * (passed + prior)).clamp_min(1e-12))

    def carried(self, scene: Tensor, before: float, after: float) -> Tensor:
        """Return about what a solution (C, H, W) at one smoothness becomes at another, as if sampling were even.

        Most of the change is in it, so conjugate gradients that start from it are soon done.
        """
        along_y, along_x = _frequencies(scene)
        passed = self._usual_density() * self._transfer(along_y, along_x) ** 2
        prior = self.prior.response(along_y, along_x)
        stiffness = [(passed + self._weight(weight) * prior).clamp_min(1e-12) for weight in (before, after)]
        return _passed(scene, stiffness[0] / stiffness[1])

    def mean(self) -> Tensor:
        """Return an even scene of the right brightness, (C, H, W): what the smoothest one comes to."""
        mass = steady.total(self.density())
        level = torch.stack([steady.total(channel) for channel in self.rhs]) / mass.clamp_min(1e-12)
        return level[:, None, None].expand(-1, *self.grid.shape).clone()

    def local_mean(self) -> Tensor:
        """Return a scene to start from, (C, H, W): the local mean of the samples, wider where there are few."""
        return filled_mean(self.rhs, self.density(), max((self.radius or 0.0) / self.grid.spacing, 1.0))

    def density(self) -> Tensor:
        """Return the weight of samples per node, (H, W): what the stencil does to an even scene."""
        return self.stencil.row_sums

    def posterior_std(self, smoothness: float, variance: float, most: float, reach: float) -> Tensor:
        """Return the posterior's standard deviation of the scene, (H, W), were sampling everywhere as it is nearby.

        Where samples of variance `variance` lie with the density c, every frequency f of the scene has the posterior
        variance `variance` / (c |B(f)|^2 + lambda P(f)); their sum depends on c alone. `most` bounds it by what is
        known of the scene without samples; `reach`, in pixels, is over what distance sampling is averaged.
        """
        frequency = (torch.arange(_FREQUENCIES) + 0.5) / (2 * _FREQUENCIES)
        prior = self._weight(smoothness) * self.prior.response(frequency, frequency)
        transfer = self._transfer(frequency, frequency) ** 2
        densities = torch.logspace(-4, 3, 57)
        table = (variance / (densities[:, None, None] * transfer + prior)).mean(dim=(1, 2))
        density = blur(self.density(), reach / self.grid.spacing).clamp(1e-4, 1e3).cpu()
        deviation = np.interp(density.log10().numpy(), densities.log10().numpy(), table.sqrt().clamp(max=most).numpy())
        return torch.from_numpy(deviation).to(self.rhs)

    def responses(self, frequency: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return what the footprint passes of the power of waves (F,), cycles per node, and the prior at weight 1."""
        # Halfway between an axis and a diagonal, a function with the grid's symmetry is close to its mean over angles.
        along = torch.from_numpy(frequency).to(self.rhs)
        along_y, along_x = along * math.sin(math.pi / 8), along * math.cos(math.pi / 8)
        passed = self._transfer(along_y, along_x).diagonal() ** 2
        prior = self._weight(1.0) * self.prior.response(along_y, along_x).diagonal()
        return passed.double().cpu().numpy(), prior.double().cpu().numpy()

    def _usual_density(self) -> float:
        """Return the mean weight of samples to a node, where there are any to speak of."""
        density = self.density()
        return float(steady.mean(density[density >= _LEAST_DENSITY * density.max()]))

    def _weight(self, smoothness: float) -> float:
        """Return the prior's weight for nodes that are not a pixel apart."""
        return smoothness / self.grid.spacing ** (2 * self.prior.order - 2)

    def _transfer(self, along_y: Tensor, along_x: Tensor) -> Tensor:
        """Return the footprint's response at frequencies (Fy,) by (Fx,), cycles per node."""
        if self.footprint is None:
            return torch.ones(len(along_y), len(along_x)).to(along_y)
        return self.footprint.transfer(along_y, along_x)


def _frequencies(scene: Tensor) -> tuple[Tensor, Tensor]:
    """Return the frequencies of scenes (C, H, W) and their rim along y and along x, cycles per node."""
    height, width = (side + 2 * _RIM for side in scene.shape[-2:])
    return torch.fft.fftfreq(height).to(scene), torch.fft.rfftfreq(width).to(scene)


def _passed(scene: Tensor, response: Tensor) -> Tensor:
    """Return scenes (C, H, W) through a filter of this response at `_frequencies`."""
    padded = torch.nn.functional.pad(scene[None], (_RIM,) * 4, mode="replicate")[0]
    shown: Tensor = steady.irfft2(torch.fft.rfft2(padded) * response, (padded.shape[-2], padded.shape[-1]))
    return shown[..., _RIM:-_RIM, _RIM:-_RIM]


def _read_gain(frequency: Tensor, offset_variance: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean square and mean of the gain with which waves (F,), cycles per node, are read along one axis.

    `offset_variance` is the mean of d (1 - d) over the samples: 0 where all lie on nodes, 1/6 where they lie
    anywhere. The mean gain is exact for any mixture of the two.
    """
    square = 1 - 2 * offset_variance * (1 - torch.cos(2 * math.pi * frequency))
    return square, 1 - 6 * offset_variance * (1 - torch.sinc(frequency) ** 2)


def assemble(grid: Grid, samples: Samples, points: Tensor, among: Tensor | None = None) -> NormalEquations:
    """Return the normal equations of samples at points (T, N, 2) of the scene, or along paths (T, N, K, 2).

    `among` (T, N) multiplies the weights: 0 leaves samples out.
    """
    equations = NormalEquations.empty(grid, samples.radius, samples.values.shape[2], points.device)
    weights = samples.weights if among is None else samples.weights * among
    together = max(1, _SAMPLES_TOGETHER // max(1, weights.shape[1]))
    for first in range(0, len(weights), together):
        some = slice(first, first + together)
        equations = equations.with_samples(points[some], samples.values[some], weights[some])
    return equations
