"""Solving a window rehearsed on a scene that is known, seen where the samples of the burst look.

How much of a wave is solved for, what becomes of the noise, and how large the error is at each smoothness depends on
where samples happen to lie: in a gap nothing is known, and what falls between samples shows as something else. Formulas
for even sampling miss that, the more the fewer frames there are. So it is measured, on scenes drawn at random with the
spectrum of the one that is looked for (a parametric bootstrap: Efron and Tibshirani, "An introduction to the
bootstrap", 1993, chapter 6).
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from napari_fiberburst.bundle.samples import Samples
from napari_fiberburst.operators.filters import blur
from napari_fiberburst.operators.footprint import Footprint
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.scene.spline import NormalEquations

# A known scene has so many nodes to one of the window, so that reading it between them costs no detail.
_FINER = 3
# The footprint's radius is known to about this part of it; of faint bundles, it is 15 % too large.
_RADIUS_ERROR = 0.1
# Nodes are judged where samples are at least this part as dense as anywhere.
_LEAST_DENSITY = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Rehearsal:
    """What samples would have shown of a scene that is known, and of noise.

    Attributes
    ----------
    nodes : Tensor
        (H, W), the scene at the window's nodes.
    samples : Samples
        Of three channels: the scene; what it would look like besides through a somewhat smaller footprint; noise of
        variance 1 over the weight.
    """

    nodes: Tensor
    samples: Samples

    @classmethod
    def of(
        cls,
        window: Grid,
        samples: Samples,
        points: Tensor,
        frequency: NDArray[np.float64],
        power: NDArray[np.float64],
    ) -> "Rehearsal":
        """Draw a scene with this power (F,) at these frequencies (F,), cycles per node, and look at it.

        Parameters
        ----------
        window : Grid
            That is solved.
        samples, points
            The samples, and where they look (T, N, 2), or (T, N, K, 2) where that moves.
        frequency, power : numpy.ndarray
            Rising frequencies; a scene of white noise of variance 1 has the power 1.
        """
        generator = torch.Generator().manual_seed(0)
        fine, scene = _drawn(window, frequency, power, generator)
        scene = scene.to(points)
        sampling = fine.of_looks(points.reshape(-1, *points.shape[2:]))

        def seen(radius: float | None) -> Tensor:
            shown = scene if radius is None else Footprint(fine, radius, points.device)(scene)
            return sampling(shown).reshape(samples.weights.shape)

        through = seen(samples.radius)
        other = seen(None if samples.radius is None else (1 - _RADIUS_ERROR) * samples.radius) - through
        weights = samples.weights.clamp_min(torch.finfo(samples.weights.dtype).tiny)
        noise = torch.randn(samples.weights.shape, generator=generator).to(weights) / weights.sqrt()
        noise = torch.where(samples.weights > 0, noise, 0.0)
        return cls(scene[::_FINER, ::_FINER], replace(samples, values=torch.stack([through, other, noise], dim=-1)))

    @property
    def scene_and_noise(self) -> Samples:
        """The samples, without those through the smaller footprint."""
        return replace(self.samples, values=self.samples.values[..., [0, 2]])

    def errors(self, equations: NormalEquations, scene: Tensor, smoothness: float) -> tuple[float, float]:
        """Return the mean squared error of a solution (3, H, W) but for noise, and that of noise of variance 1."""
        density = blur(equations.density(), 3.0)
        weight = (density > _LEAST_DENSITY * density.max()).to(scene)
        shown, other, noise = equations.image(scene, smoothness)
        squares = [(part.square() * weight).double().sum() for part in (shown - self.nodes, other, noise)]
        missed, wrong, of_noise = (float(square / weight.double().sum()) for square in squares)
        return missed + wrong, of_noise


def _drawn(
    window: Grid, frequency: NDArray[np.float64], power: NDArray[np.float64], generator: torch.Generator
) -> tuple[Grid, Tensor]:
    """Return a finer grid and a smooth scene on it, without waves that the window's own nodes could not show."""
    height, width = window.shape
    white = np.fft.fft2(torch.randn(height, width, generator=generator).numpy())
    along_y, along_x = np.fft.fftfreq(height), np.fft.fftfreq(width)
    distance = np.hypot(along_y[:, None], along_x)
    waves = white * np.sqrt(np.interp(distance, frequency, power))
    waves[0, 0] = 0
    # A wave of two nodes has no sign, so it could not be told where it lies.
    waves[np.abs(along_y) == 0.5] = 0
    waves[:, np.abs(along_x) == 0.5] = 0
    shape = (height * _FINER, width * _FINER)
    spectrum = np.zeros(shape, complex)
    rows, columns = (np.round(along * side).astype(int) for along, side in ((along_y, height), (along_x, width)))
    spectrum[np.ix_(rows, columns)] = waves * _FINER**2
    return Grid(window.x0, window.y0, window.spacing / _FINER, shape), torch.from_numpy(np.fft.ifft2(spectrum).real)
